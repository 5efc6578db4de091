"""Pushes (`push.`): sudden changes of velocity of single bodies at random times, as by a hand or a collision."""

from __future__ import annotations

from math import ceil, log
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import norm, scale
from multilift_marl.rig.system import System
from multilift_marl.rng import normal_vector, uniform
from multilift_marl.sim.state_io import body_dof


class Pushes(NamedTuple):
    """When each body is pushed next; body 0 is the payload, 1 + n drone n."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    left: np.ndarray
    """(E, N + 1) int64, physics steps until then."""


class PushConstants(NamedTuple):
    """What pushes need to know, by body."""

    interval: float
    """Mean of the time between two pushes of a body, in physics steps."""
    force: np.ndarray
    """(N + 1,) that gives a free body the largest change of velocity in one physics step [N]."""
    torque: np.ndarray
    """(N + 1, 3) about each of its axes, by the largest angular velocity [N m]; zero of the payload."""


def make_pushes(system: System, num_envs: int) -> tuple[Pushes, PushConstants] | None:
    """Return the pushes of `system`; None where it has none."""
    push, n = system.push, system.num_drones
    if not (push.payload_velocity or push.drone_velocity or push.drone_rates):
        return None
    inertia = np.array([vehicle.inertia for vehicle in system.vehicles])
    # Δv/h times the mass: the whole change within one physics step.
    change = np.array([push.payload_velocity, *[push.drone_velocity] * n]) / system.timestep
    constants = PushConstants(
        interval=push.interval / system.timestep,
        force=change * np.array([system.payload_mass, *system.drone_mass]),
        torque=np.vstack([np.zeros(3), inertia * push.drone_rates / system.timestep]),
    )
    return Pushes(np.zeros(num_envs, np.uint64), np.zeros((num_envs, n + 1), np.int64)), constants


@kernel
def start_pushes(e, pushes, interval):
    """Draw when the bodies of environment e are pushed first."""
    for b in range(pushes.left.shape[1]):
        pushes.left[e, b] = _wait(e, pushes, interval)


@kernel
def _wait(e, pushes, interval):
    """Return the physics steps until the next push: exponential, so that pushes are a Poisson process."""
    # `uniform` is in (0, 1], so the logarithm is finite, and the wait at least 0 steps, which counts as the next one.
    return ceil(-interval * log(uniform(e, pushes)))


@kernel
def _any_direction(e, pushes):
    """Return a vector of a direction uniform on the sphere and a length uniform up to 1."""
    way = normal_vector(e, pushes)
    return scale(uniform(e, pushes) / max(norm(way), 1e-12), way)


@kernel
def apply_pushes(rows, pushes, c):
    """Add to the loads of a physics step what pushes the bodies in it.

    Args:
        rows: Rows of the environments, in which `apply_loads` has written the other loads.
        pushes: Pushes of all environments, written.
        c: PushConstants.
    """
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        for b in range(pushes.left.shape[1]):
            pushes.left[e, b] -= 1
            if pushes.left[e, b] > 0:
                continue
            pushes.left[e, b] = _wait(e, pushes, c.interval)
            at = rows.force + body_dof(b, rows)
            x, y, z = scale(c.force[b], _any_direction(e, pushes))
            rows.state[i, at] += x
            rows.state[i, at + 1] += y
            rows.state[i, at + 2] += z
            if b > 0:  # the payload's turning is that of its cables
                x, y, z = _any_direction(e, pushes)
                rows.state[i, at + 3] += c.torque[b, 0] * x
                rows.state[i, at + 4] += c.torque[b, 1] * y
                rows.state[i, at + 5] += c.torque[b, 2] * z
