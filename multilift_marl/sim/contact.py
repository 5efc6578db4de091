"""Contact of ground, payload and drones: where they touch, how stiffly, and which of them are fast."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl._jit import kernel
from multilift_marl.math3d import dot, norm, row, sub, vec
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import Vehicle

STIFFNESS = 6e4  # [1/s²] over the effective mass; with DAMPING a penetration fades with a time constant of 80 ms
DAMPING = 5e3  # [1/s] likewise: takes an approach away within a step, so nothing bounces, nor passes what it has met
_FAST = 2.0  # [m/s] bodies that approach each other no faster meet before they can pass each other
_SPECULATIVE = int(mujoco.mjtEnableBit.mjENBL_SPECULATIVE)


def drone_half_size(vehicle: Vehicle) -> np.ndarray:
    """Return the half edges (3,) of a drone's collision box [m]."""
    return vehicle.arm * np.array([0.7, 0.7, 0.3])


def add_contact(spec: mujoco.MjSpec, num_drones: int) -> None:
    """Let ground, payload and drones touch each other, by pairs: cheaper than MuJoCo's sweep over all bodies.

    What contacts are like stands in the `pair_*` fields of the compiled model, not in those of its geoms.
    """
    names = ("floor", "payload", *(f"drone_{i}" for i in range(num_drones)))
    for name in names:
        spec.geom(name).contype = spec.geom(name).conaffinity = 0
    for one, other in combinations(names, 2):
        spec.add_pair(geomname1=one, geomname2=other, solref=[-STIFFNESS, -DAMPING])


class Bodies(NamedTuple):
    """Payload and drones as spheres."""

    radius: np.ndarray
    """(1 + N,) about the origins of their frames [m]."""
    timestep: float
    """[s]"""


def make_bodies(system: System) -> Bodies:
    """Return the bodies of `system`."""
    payload = np.linalg.norm(system.payload_size / 2) + np.linalg.norm(system.payload_center)
    drones = [np.linalg.norm(drone_half_size(vehicle)) for vehicle in system.vehicles]
    return Bodies(np.array([payload, *drones]), system.timestep)


@kernel
def find_fast(lo, hi, state, fast, bodies):
    """Find the environments in which bodies approach each other fast and might meet within a step.

    Args:
        lo, hi: the environments.
        state: SystemState.
        fast: written, (hi - lo,) bool.
        bodies: Bodies.

    Returns:
        Whether any of `fast` has changed.
    """
    changed = False
    for e in range(lo, hi):
        found = False
        pace = row(state.payload_velocity, e)
        quickest = dot(pace, pace)
        for n in range(bodies.radius.shape[0] - 1):
            velocity = vec(state.drone_velocity, e, n)
            quickest = max(quickest, dot(velocity, velocity))
        # Where all are slower than half of it, as in most steps, no two approach each other fast.
        for i in range(1, bodies.radius.shape[0] if 4.0 * quickest > _FAST * _FAST else 1):
            place, velocity = vec(state.drone_position, e, i - 1), vec(state.drone_velocity, e, i - 1)
            for j in range(i):
                if j == 0:
                    other, pace = row(state.payload_position, e), row(state.payload_velocity, e)
                else:
                    other, pace = vec(state.drone_position, e, j - 1), vec(state.drone_velocity, e, j - 1)
                away, opening = sub(place, other), sub(velocity, pace)
                if dot(away, opening) < 0.0:
                    speed = norm(opening)
                    reach = bodies.radius[i] + bodies.radius[j] + 2.0 * bodies.timestep * speed
                    found = found or (speed > _FAST and dot(away, away) < reach * reach)
        changed = changed or fast[e - lo] != found
        fast[e - lo] = found
    return changed


def set_speculative(batch: Batch, fast: np.ndarray) -> None:
    """Let MuJoCo look for contacts of the step to come in the simulations in `fast` (n,) bool.

    In all of them it would cost a seventh of a step's time.
    """
    flags = batch.expand("opt.enableflags")
    flags.reshape(len(fast), -1)[:, 0] = np.where(fast, flags.reshape(len(fast), -1)[:, 0] | _SPECULATIVE, 0)
