"""Momentum and energy of whole teams: conserved in free fall, balanced by the loads in controlled flight."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.physical import GRAVITY
from multilift_marl.sim.contact import APART, search_contacts
from multilift_marl.sim.state_io import body_dof
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Plot, Result
from multilift_marl.validation.symmetry import Team, make_team, poses, take_off, velocities

_HEIGHT = 2000.0  # [m] of the start: a fall of 10 s stays far from the ground
_LIMIT = 1e-9  # of the balance of momentum, relative to all impulses


class Totals(NamedTuple):
    """Sums over payload, drones and the nodes of chains."""

    mass: float
    """[kg]"""
    center: np.ndarray
    """(3,) centre of mass [m]."""
    linear: np.ndarray
    """(3,) momentum [kg m/s]."""
    angular: np.ndarray
    """(3,) angular momentum about the centre of mass [N m s]."""
    energy: float
    """Kinetic, about the centre of mass, and of stretched cables [J]."""


def totals(world: World, env: int = 0) -> Totals:
    """Return the sums of environment `env`, from the state alone."""
    state = world.state
    p = world.parameters
    system = world.system
    mass = np.append(p.payload_mass[env], p.vehicle_mass[env])
    position = np.vstack([state.payload_position[env], state.drone_position[env]])
    velocity = np.vstack([state.payload_velocity[env], state.drone_velocity[env]])
    rotation = np.concatenate([state.payload_rotation[env][None], state.drone_rotation[env]])
    rates = np.vstack([state.payload_body_rates[env], state.drone_body_rates[env]])
    inertia = np.vstack([system.payload_inertia, [vehicle.inertia for vehicle in system.vehicles]])
    # R J ω, own angular momenta in the world frame: of bodies whose principal axes are the axes of their frames.
    spin = np.einsum("bij,bj->bi", rotation, inertia * rates)
    stored = 0.0
    for n in range(world.num_drones):
        points = world.cable_points(env, n)
        links = int(system.cable_segments[n])
        stretch = np.linalg.norm(np.diff(points, axis=0), axis=1) - p.cable_length[env, n] / links
        # Links of chains resist being pushed together, massless cables do not.
        stretch = stretch if world.nodes is not None else np.maximum(stretch, 0.0)
        # ½ (n k) s² for each of n links, which in series have the stiffness k of the whole cable.
        stored += 0.5 * links * p.cable_stiffness[env, n] * float((stretch**2).sum())
        if world.nodes is not None:
            mass = np.append(mass, np.full(links - 1, system.cable_mass[n] / (links - 1)))
            position = np.vstack([position, world.nodes.position[env, n, : links - 1]])
            velocity = np.vstack([velocity, world.nodes.velocity[env, n, : links - 1]])
    linear = mass @ velocity
    center = mass @ position / mass.sum()
    offset = position - center
    speed = velocity - linear / mass.sum()
    angular = (np.cross(offset, mass[:, None] * speed)).sum(axis=0) + spin.sum(axis=0)
    energy = 0.5 * float(mass @ (speed**2).sum(axis=1)) + 0.5 * float((inertia * rates**2).sum()) + stored
    return Totals(float(mass.sum()), center, linear, angular, energy)


def tumbling_team(
    model: str, num_drones: int, rate: float, axis: tuple[float, float, float], **overrides: Any
) -> World:
    """Return a team that turns as one about its centre of mass, high above the ground, rotors off, without drag.

    Args:
        model: of the cables.
        num_drones: N.
        rate: [rad/s].
        axis: unit vector.
        **overrides: configuration values, with __ for the dot.
    """
    values = {"env.num_drones": num_drones, "cable.model": model}
    system = load_config("hover", values | {key.replace("__", "."): value for key, value in overrides.items()}).system
    vehicles = tuple(replace(vehicle, drag=(0.0, 0.0, 0.0)) for vehicle in system.vehicles)
    world = World(replace(system, vehicles=vehicles, payload_drag_area=0.0), 1, 1)
    state = world.state
    turning = rate * np.array(axis)
    state.payload_position[:, 2] += _HEIGHT
    state.drone_position[..., 2] += _HEIGHT
    center = totals(world).center
    state.payload_velocity[0] = np.cross(turning, state.payload_position[0] - center)
    state.drone_velocity[0] = np.cross(turning, state.drone_position[0] - center)
    state.payload_body_rates[0] = state.payload_rotation[0].T @ turning
    state.drone_body_rates[0] = np.einsum("nji,j->ni", state.drone_rotation[0], turning)
    state.rotor_speed[:] = 0.0
    world.load(np.ones(1, bool))
    # After `load`, which lets motors run again.
    world.hidden_loads.motors_off[:] = True
    return world


class Drift(NamedTuple):
    """By how much a flight in free fall leaves what it should keep."""

    speed: float
    """Of the centre of mass from that of free fall [m/s]."""
    angular: float
    """Change of the angular momentum over its size [-]."""
    energy: float
    """Change of energy, and of that with what dampers took, over the energy at the start [-]."""
    balance: float


def without_contact(world: World) -> World:
    """Let the bodies of a world pass through each other, which takes no energy."""
    for shard in world.shards:
        shard.proximity[:] = APART
        search_contacts(shard.batch, shard.proximity)
        shard.find_close = lambda: False
    return world


def free_flight(world: World, seconds: float) -> tuple[Drift, np.ndarray, np.ndarray]:
    """Let a team fall; return its drift, times (T,) [s] and energies (T, 2) over the first: left, and with dampers."""
    start = totals(world)
    h = world.system.timestep
    thrust = np.zeros((1, world.num_drones, 4))
    taken = 0.0
    times = []
    energies = []
    steps = round(seconds / h)
    for i in range(1, steps + 1):
        world.step(thrust)
        taken += float(world.cables.motion.dissipated[0]) if world.nodes is not None else 0.0
        if i % round(0.1 / h) == 0:
            energy = totals(world).energy
            times.append(i * h)
            energies.append([energy / start.energy, (energy + taken) / start.energy])
    end = totals(world)
    fallen = start.linear / start.mass - [0.0, 0.0, GRAVITY * steps * h]
    turned = np.linalg.norm(end.angular - start.angular) / np.linalg.norm(start.angular)
    speed = float(np.abs(end.linear / end.mass - fallen).max())
    if world.diverged[0]:
        speed = np.inf
    return Drift(speed, float(turned), energies[-1][0] - 1, energies[-1][1] - 1), np.array(times), np.array(energies)


def conservation(fast: bool) -> Result:
    """Teams tumble in free fall with their rotors off and pass through each other; a drone is cut loose."""
    seconds = 3.0 if fast else 10.0
    plot = Plot(
        "conservation", "energy of tumbling teams on chains", "time [s]", "energy over that at the start",
        caption="Energy of teams that tumble in free fall on chains and lose it in snatches; with what dampers took.",
    )  # fmt: skip
    result = Result(plots=[plot])
    flights = (
        (4, 1.1, (1.0, 0.0, 0.0), "x"),
        (4, 2.0, (0.0, 0.0, 1.0), "z"),
        (4, 2.0, (1.0, 0.0, 0.0), "x"),
        (6, 2.0, (0.6, 0.48, 0.64), "an oblique axis"),
    )
    for model in ("chain", "massless"):
        for i, (count, rate, axis, about) in enumerate(flights):
            drift, times, energies = free_flight(without_contact(tumbling_team(model, count, rate, axis)), seconds)
            name = f"tumbling, {model}, {count} drones, {rate:g} rad/s about {axis}"
            result.check(name, "speed of the centre of mass off free fall [m/s]", drift.speed, 1e-6)
            result.check(name, "angular momentum, relative change", drift.angular, 1e-3)
            if model == "chain":
                result.check(name, "energy with what dampers took, relative change", drift.balance, 0.01)
                plot.add(f"{count} drones, {rate:g} rad/s about {about}", times, energies[:, 0])
                plot.add("" if i else "with dampers", times, energies[:, 1], theory=True)
    for model in ("chain", "massless"):
        result.check(f"cut loose, {model}", "velocity off free fall after 2 s [m/s]", cut_loose(model), 1e-6)
    return result


def cut_loose(model: str) -> float:
    """Return by how much a drone with its cable broken misses the velocity of free fall after 2 s [m/s]."""
    world = tumbling_team(model, 4, 1.1, (1.0, 0.0, 0.0))
    thrust = np.zeros((1, 4, 4))
    broken = np.zeros((1, 4), bool)
    world.step(thrust, 100)
    broken[0, 1] = True
    world.break_cables(broken)
    before = world.state.drone_velocity[0, 1].copy()
    world.step(thrust, 500)
    return float(np.abs(world.state.drone_velocity[0, 1] - before + [0.0, 0.0, 2.0 * GRAVITY]).max())


def momentum(fast: bool) -> Result:
    """A team flies in wind, its cables slack at first: linear and angular momentum of all of it about a fixed point."""
    seconds = 1.0 if fast else 5.0
    caption = "What the time step adds to or takes from the team's momentum over one second, relative to all impulses."
    title = "drift of the team's momentum"
    plot = Plot("momentum", title, "time step [ms]", "relative drift", caption=caption, log="xy")
    result = Result(plots=[plot])
    for name, error in zip(("linear", "angular"), massless_balance(make_team("massless"), seconds), strict=True):
        result.check("momentum, massless", f"{name} momentum less impulses, each step, relative", error, _LIMIT)
    for model in ("massless", "chain"):
        team = make_team(model)
        linear, angular = momentum_drift(team, seconds)
        for name, error, limit in (("linear", linear, _LIMIT), ("angular", angular, 1e-3)):
            quantity = f"{name} momentum less impulses, {seconds:g} s at 4 ms, relative"
            result.check(f"momentum, {model}", quantity, error, limit)
        steps = (2e-3, 1e-3, 5e-4)
        drift = [momentum_drift(replace(team, timestep=step), 1.0)[1] for step in steps]
        plot.add(f"{model}, angular", 1e3 * np.array(steps), np.array(drift))
        # rotors that saturate in one step or the next leave the order below 1
        result.order(f"momentum, {model}", "drift of the angular momentum in 1 s", drift, steps, least=0.8)
    return result


def massless_balance(team: Team, seconds: float) -> tuple[float, float]:
    """Return the largest residuals of linear and angular momentum of all steps, relative to the loads' impulses.

    A step changes velocities at the place and attitude where it began, so the balance is taken there. The gyroscopic
    torque enters as the integrator takes it: with its value at the start of the step, and with its linear change over
    the step as well for a body without a stretched cable ("Gyroscopic derivatives for free bodies" in MuJoCo's
    computation chapter), less what `sim/rotation.py` adds to make a midpoint rule of it.
    """
    (world, steer), worst = take_off(team), np.zeros(2)
    system, h = world.system, world.system.timestep
    mass, inertia = _masses(world)
    for i in range(round(seconds / h)):
        if i % system.control_interval == 0:
            steer()
        (r, attitude), (v, w) = poses(world), velocities(world)
        world.step(world.thrust)
        pushed, turned = (after - before for after, before in zip(velocities(world), (v, w), strict=True))
        force, torque = loads(world)
        force = force + mass[:, None] * [0, 0, -GRAVITY]
        span = np.linalg.norm(r[1:] - r[0] - system.anchors @ attitude[0].T, axis=1)
        tied = span > system.cable_length
        # Any stretched cable holds the payload; a drone is held by its own alone.
        free = np.concatenate([[not tied.any()], ~tied])[:, None]
        gyroscopic = np.cross(w, inertia * w) - world.cables.gyroscopic[0]
        gyroscopic += free * (np.cross(turned, inertia * w) + np.cross(w, inertia * turned))
        linear = (mass[:, None] * pushed - h * force).sum(axis=0)
        spin = np.einsum("nij,nj->i", attitude, inertia * turned - h * (torque - gyroscopic))
        angular = np.cross(r, mass[:, None] * pushed - h * force).sum(axis=0) + spin
        scale = h * np.abs(force).sum(), h * np.abs(np.cross(r, force)).sum()
        worst = np.maximum(worst, [np.abs(linear).max() / scale[0], np.abs(angular).max() / scale[1]])
    return float(worst[0]), float(worst[1])


def momentum_drift(team: Team, seconds: float) -> np.ndarray:
    """Return by how much linear and angular momentum end off the sum of impulses, (2,), relative to their sizes."""
    world, steer = take_off(team)
    h = world.system.timestep

    def total() -> tuple[np.ndarray, np.ndarray, float]:
        """Return linear and angular momentum about the origin (6,), the centre of mass (3,) and the weight [N]."""
        sums = totals(world)
        # About the origin it is that about the centre of mass, and c × p (König).
        about = sums.angular + np.cross(sums.center, sums.linear)
        return np.concatenate([sums.linear, about]), sums.center, sums.mass * GRAVITY

    start = total()[0]
    impulse = np.zeros(6)
    size = np.zeros(2)
    for i in range(round(seconds / h)):
        if i % world.system.control_interval == 0:
            steer()
        (r, attitude), (_, center, weight) = poses(world), total()
        world.step(world.thrust)
        force, torque = loads(world)
        torque = np.einsum("nij,nj->ni", attitude, torque)
        down = np.array([0, 0, -weight])
        moment = np.cross(r, force).sum(axis=0) + torque.sum(axis=0) + np.cross(center, down)
        impulse += h * np.concatenate([force.sum(axis=0) + down, moment])
        size += h * np.array([np.abs(force).sum(), np.abs(np.cross(r, force)).sum()])
    off = np.abs(total()[0] - start - impulse).reshape(2, 3)
    return off.max(axis=1) / size


def loads(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return force (1 + N, 3) [N] and torque (1 + N, 3) [N m] on payload and drones in the last step.

    The torques are in the frames of the bodies. What cable models add for MuJoCo is taken off again.
    """
    shard = world.shards[0]
    first = shard.rows.force + np.array([body_dof(b, shard.rows) for b in range(1 + world.num_drones)])
    applied = shard.rows.state[0][first[:, None] + np.arange(6)]
    if world.nodes is not None:
        applied = applied - world.cables.motion.impulse[0] / world.system.timestep
        return applied[:, :3], applied[:, 3:]
    return applied[:, :3], applied[:, 3:] - world.cables.gyroscopic[0]


def _masses(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return masses (1 + N,) [kg] and principal moments (1 + N, 3) [kg m²] of payload and drones."""
    system, vehicle = world.system, world.system.vehicle
    mass = np.array([system.payload_mass] + [vehicle.mass] * system.num_drones)
    return mass, np.array([system.payload_inertia] + [vehicle.inertia] * system.num_drones)
