"""The balance of momentum of the whole team: gravity, thrust, drag and the hidden force change it, no cable does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.state_io import body_dof
from multilift_marl.sim.world import World
from multilift_marl.validation.asymmetric_team import Team, make_team, poses, take_off, velocities
from multilift_marl.validation.conservation import totals
from multilift_marl.validation.experiment import Curve, Plot, Result, Row, order_row

_LIMIT = 1e-9


def momentum(fast: bool) -> Result:
    """A team flies in wind, its cables slack at first: linear and angular momentum of all of it about a fixed point."""
    result, seconds = Result(), 1.0 if fast else 5.0
    caption = "What the time step adds to or takes from the team's momentum over one second, relative to all impulses."
    plot = Plot(
        "momentum", "drift of the team's momentum", "time step [ms]", "relative drift", caption=caption, log=True
    )
    for name, error in zip(("linear", "angular"), massless_balance(make_team("massless"), seconds), strict=True):
        quantity = f"{name} momentum less impulses, each step, relative"
        result.rows.append(Row("momentum, massless", quantity, 0.0, error, error, _LIMIT))
    for model in ("massless", "chain"):
        team = make_team(model)
        linear, angular = momentum_drift(team, seconds)
        for name, error, limit in (("linear", linear, _LIMIT), ("angular", angular, 1e-3)):
            quantity = f"{name} momentum less impulses, {seconds:g} s at 4 ms, relative"
            result.rows.append(Row(f"momentum, {model}", quantity, 0.0, error, error, limit))
        steps = (2e-3, 1e-3, 5e-4)
        drift = [momentum_drift(replace(team, timestep=step), 1.0)[1] for step in steps]
        plot.curves.append(Curve(f"{model}, angular", 1e3 * np.array(steps), np.array(drift)))
        order = order_row(f"momentum, {model}", "drift of the angular momentum in 1 s", drift, steps, least=0.8)
        result.rows.append(order)  # rotors that saturate in one step or the next leave it below 1
    result.plots.append(plot)
    return result


def massless_balance(team: Team, seconds: float) -> tuple[float, float]:
    """Return the largest residuals of linear and angular momentum of all steps, relative to the loads' impulses.

    A step changes velocities at the place and attitude where it began, so the balance is taken there. The gyroscopic
    torque enters as the integrator takes it: with its value at the start of the step, and with its linear change over
    the step as well for a body without a stretched cable ("Gyroscopic derivatives for free bodies" in MuJoCo's
    computation chapter).
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
        free = np.concatenate([[not tied.any()], ~tied])[:, None]
        gyroscopic = np.cross(w, inertia * w) + free * (np.cross(turned, inertia * w) + np.cross(w, inertia * turned))
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
        about = sums.angular + np.cross(sums.center, sums.linear)
        return np.concatenate([sums.linear, about]), sums.center, sums.mass * GRAVITY

    start, impulse, size = total()[0], np.zeros(6), np.zeros(2)
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

    The torques are in the frames of the bodies. What chains add for MuJoCo is taken off again.
    """
    shard = world.shards[0]
    first = shard.rows.force + np.array([body_dof(b, shard.rows) for b in range(1 + world.num_drones)])
    applied = shard.rows.state[0][first[:, None] + np.arange(6)]
    if world.nodes is not None:
        applied = applied - world.cables.motion.impulse[0] / world.system.timestep
    return applied[:, :3], applied[:, 3:]


def _masses(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return masses (1 + N,) [kg] and principal moments (1 + N, 3) [kg m²] of payload and drones."""
    system, vehicle = world.system, world.system.vehicle
    mass = np.array([system.payload_mass] + [vehicle.mass] * system.num_drones)
    return mass, np.array([system.payload_inertia] + [vehicle.inertia] * system.num_drones)
