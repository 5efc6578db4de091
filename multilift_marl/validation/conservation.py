"""What a team keeps while nothing but gravity acts on it: whole flights of tumbling teams at the default time step."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Curve, Plot, Result, Row

_HEIGHT = 2000.0  # [m] of the start: a fall of 10 s stays far from the ground


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
    state, p, system = world.state, world.parameters, world.system
    mass = np.append(p.payload_mass[env], p.vehicle_mass[env])
    position = np.vstack([state.payload_position[env], state.drone_position[env]])
    velocity = np.vstack([state.payload_velocity[env], state.drone_velocity[env]])
    rotation = np.concatenate([state.payload_rotation[env][None], state.drone_rotation[env]])
    rates = np.vstack([state.payload_body_rates[env], state.drone_body_rates[env]])
    inertia = np.vstack([system.payload_inertia, [vehicle.inertia for vehicle in system.vehicles]])
    spin = np.einsum("bij,bj->bi", rotation, inertia * rates)
    stored = 0.0
    for n in range(world.num_drones):
        points = world.cable_points(env, n)
        links = int(system.cable_segments[n])
        stretch = np.linalg.norm(np.diff(points, axis=0), axis=1) - p.cable_length[env, n] / links
        stretch = stretch if world.nodes is not None else np.maximum(stretch, 0.0)
        stored += 0.5 * links * p.cable_stiffness[env, n] * float((stretch**2).sum())
        if world.nodes is not None:
            mass = np.append(mass, np.full(links - 1, system.cable_mass[n] / (links - 1)))
            position = np.vstack([position, world.nodes.position[env, n, : links - 1]])
            velocity = np.vstack([velocity, world.nodes.velocity[env, n, : links - 1]])
    linear, center = mass @ velocity, mass @ position / mass.sum()
    offset, speed = position - center, velocity - linear / mass.sum()
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
    state, turning = world.state, rate * np.array(axis)
    state.payload_position[:, 2] += _HEIGHT
    state.drone_position[..., 2] += _HEIGHT
    center = totals(world).center
    state.payload_velocity[0] = np.cross(turning, state.payload_position[0] - center)
    state.drone_velocity[0] = np.cross(turning, state.drone_position[0] - center)
    state.payload_body_rates[0] = state.payload_rotation[0].T @ turning
    state.drone_body_rates[0] = np.einsum("nji,j->ni", state.drone_rotation[0], turning)
    state.rotor_speed[:] = 0.0
    world.load(np.ones(1, bool))
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
        shard.batch.expand("opt.disableflags")[:] |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return world


def free_flight(world: World, seconds: float) -> tuple[Drift, np.ndarray, np.ndarray]:
    """Let a team fall; return its drift, times (T,) [s] and energies (T, 2) over the first: left, and with dampers."""
    start, h = totals(world), world.system.timestep
    thrust, taken, times, energies = np.zeros((1, world.num_drones, 4)), 0.0, [], []
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
    result, seconds = Result(), 3.0 if fast else 10.0
    plot = Plot(
        "conservation", "energy of tumbling teams on chains", "time [s]", "energy over that at the start",
        caption="Energy of teams that tumble in free fall on chains and lose it in snatches; with what dampers took.",
    )  # fmt: skip
    flights = (
        (4, 1.1, (1.0, 0.0, 0.0)),
        (4, 2.0, (0.0, 0.0, 1.0)),
        (4, 2.0, (1.0, 0.0, 0.0)),
        (6, 2.0, (0.6, 0.48, 0.64)),
    )
    for model in ("chain", "massless"):
        for count, rate, axis in flights:
            drift, times, energies = free_flight(without_contact(tumbling_team(model, count, rate, axis)), seconds)
            name = f"tumbling, {model}, {count} drones, {rate:g} rad/s about {axis}"
            result.rows.append(
                Row(name, "speed of the centre of mass off free fall [m/s]", 0.0, drift.speed, drift.speed, 1e-6)
            )
            result.rows.append(Row(name, "angular momentum, relative change", 0.0, drift.angular, drift.angular, 1e-3))
            if model == "chain":
                about = "xyz"[int(np.argmax(axis))] if max(axis) == 1.0 else "an oblique axis"
                plot.curves.append(Curve(f"{count} drones, {rate:g} rad/s about {about}", times, energies[:, 0]))
                plot.curves.append(
                    Curve("" if len(plot.curves) > 1 else "with dampers", times, energies[:, 1], theory=True)
                )
                result.rows.append(
                    Row(
                        name,
                        "energy with what dampers took, relative change",
                        0.0,
                        drift.balance,
                        abs(drift.balance),
                        0.01,
                    )
                )
    result.plots.append(plot)
    for model in ("chain", "massless"):
        error = cut_loose(model)
        result.rows.append(
            Row(f"cut loose, {model}", "velocity off free fall after 2 s [m/s]", 0.0, error, error, 1e-6)
        )
    return result


def cut_loose(model: str) -> float:
    """Return by how much a drone with its cable broken misses the velocity of free fall after 2 s [m/s]."""
    world = tumbling_team(model, 4, 1.1, (1.0, 0.0, 0.0))
    thrust, broken = np.zeros((1, 4, 4)), np.zeros((1, 4), bool)
    world.step(thrust, 100)
    broken[0, 1] = True
    world.break_cables(broken)
    before = world.state.drone_velocity[0, 1].copy()
    world.step(thrust, 500)
    return float(np.abs(world.state.drone_velocity[0, 1] - before + [0.0, 0.0, 2.0 * GRAVITY]).max())
