"""Contact of ground, payload and drones: where they touch, how stiffly, and which of them are fast."""

from __future__ import annotations

from itertools import combinations

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl._jit import kernel
from multilift_marl.math3d import dot, norm, row, sub, vec
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import Vehicle

STIFFNESS = 6e4  # [1/s²] over the effective mass; with DAMPING a penetration fades with a time constant of 80 ms
DAMPING = 5e3  # [1/s] over the effective mass: stops an approach within a step, without bouncing or passing through
_FAST = 2.0  # [m/s] bodies that approach each other no faster meet before they can pass each other
_SPECULATIVE = int(mujoco.mjtEnableBit.mjENBL_SPECULATIVE)


def drone_half_size(vehicle: Vehicle) -> np.ndarray:
    """Return the half edges (3,) of a drone's collision box [m]."""
    return vehicle.arm * np.array([0.7, 0.7, 0.3])


def add_contact(spec: mujoco.MjSpec, num_drones: int) -> None:
    """Let ground, payload and drones touch each other, by pairs: cheaper than MuJoCo's sweep over all bodies.

    The contacts' parameters are in the `pair_*` fields of the compiled model, not in those of its geoms.
    """
    names = ("floor", "payload", *(f"drone_{i}" for i in range(num_drones)))
    for name in names:
        spec.geom(name).contype = spec.geom(name).conaffinity = 0
    for one, other in combinations(names, 2):
        spec.add_pair(geomname1=one, geomname2=other, solref=[-STIFFNESS, -DAMPING])


def body_radii(system: System) -> np.ndarray:
    """Return the radii (1 + N,) of spheres about payload and drones, at the origins of their frames [m]."""
    payload = np.linalg.norm(system.payload_size / 2) + np.linalg.norm(system.payload_center)
    return np.array([payload, *(np.linalg.norm(drone_half_size(vehicle)) for vehicle in system.vehicles)])


@kernel
def find_fast(lo, state, fast, radii, timestep):
    """Find the environments in which bodies approach each other fast and might meet within a step.

    Args:
        lo: the first of the environments.
        state: SystemState.
        fast: (environments,) bool, written.
        radii: `body_radii` (1 + N,) [m].
        timestep: [s].

    Returns:
        Whether any of `fast` has changed.
    """
    count = radii.shape[0]
    changed = False
    for i in range(fast.shape[0]):
        e = lo + i
        # Where all are slower than half of the limit, as in most steps, no two approach each other fast.
        velocity = row(state.payload_velocity, e)
        quickest = dot(velocity, velocity)
        for n in range(count - 1):
            velocity = vec(state.drone_velocity, e, n)
            quickest = max(quickest, dot(velocity, velocity))

        # Pairs of a drone with the payload and with the drones before it.
        found = False
        for b in range(1, count if 4.0 * quickest > _FAST * _FAST else 1):
            place = vec(state.drone_position, e, b - 1)
            velocity = vec(state.drone_velocity, e, b - 1)
            for j in range(b):
                other = row(state.payload_position, e) if j == 0 else vec(state.drone_position, e, j - 1)
                pace = row(state.payload_velocity, e) if j == 0 else vec(state.drone_velocity, e, j - 1)
                away = sub(place, other)
                opening = sub(velocity, pace)
                if dot(away, opening) < 0.0:
                    speed = norm(opening)
                    reach = radii[b] + radii[j] + 2.0 * timestep * speed
                    found = found or (speed > _FAST and dot(away, away) < reach * reach)
        changed = changed or fast[i] != found
        fast[i] = found
    return changed


def set_speculative(batch: Batch, fast: np.ndarray) -> None:
    """Let MuJoCo search for contacts of the step to come in the simulations in `fast` (n,) bool.

    In all of them it would cost a seventh of a step's time.
    """
    flags = batch.expand("opt.enableflags")
    flags.reshape(len(fast), -1)[:, 0] = np.where(fast, flags.reshape(len(fast), -1)[:, 0] | _SPECULATIVE, 0)
