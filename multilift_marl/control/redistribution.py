"""What the remaining drones do after a loss: give way to the falling drone, then go where they hold the payload.

Statics alone: the payload's weight, the lost drone's that hangs from its anchor, and the remaining cables balance in
force and moment. The payload is tilted as little as thrust and the range of the slots' offsets allow.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.control.cable_forces import balance_forces
from multilift_marl.control.gains import Gains
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import clip
from multilift_marl.physical import GRAVITY
from multilift_marl.remember import remember
from multilift_marl.rig.system import System, resting_rotations

TILTS = np.radians(np.arange(0.0, 71.0))  # tried in this order
AXES = np.radians(np.arange(0.0, 360.0, 5.0))  # horizontal axes of the tilt
LEAST_HEIGHT = 0.2  # [m] of a drone above the payload; lower ones are a failure
THRUST_SHARE = 0.8  # of its largest thrust, which a drone may need at rest
GIVE_OUT, GIVE_DOWN, GIVE_NEAR = 0.2, 0.2, 0.5  # [m] outward, down, and further down times the cosine to the lost slot
GIVE_SECONDS = 0.9  # after a loss; the falling drone snatches at its cable after 0.6
WAIT, RAMP = 1.0, 3.0  # [s] after a loss until the slots set off to where they hold the payload, and that they take


class Redistribution(NamedTuple):
    """How the remaining drones hold the payload."""

    tilt: float
    """Of the payload [rad]."""
    force: np.ndarray
    """(N, 3) of each cable on the payload, in the target's heading frame [N]; 0 of the lost one's."""
    thrust: np.ndarray
    """(N,) of each drone over its largest [-]."""
    offset: np.ndarray
    """(N, 3) of each slot, in its slot frame [m]."""


def redistribute(
    system: System, gains: Gains, lost: int, hangs: bool, thrust_share: float, max_offset: float
) -> Redistribution | None:
    """Return the least tilted equilibrium without drone `lost`; None if there is none.

    At each attitude the cable forces are those nearest to the formation's that balance.

    Args:
        system, gains: of the team.
        lost: the drone.
        hangs: whether it hangs on its cable; else both are gone.
        thrust_share: of its largest thrust that a drone may use.
        max_offset: largest offset of a slot along each axis [m].
    """
    keep = np.delete(np.arange(system.num_drones), lost)
    weight = GRAVITY * (gains.mass[lost] + system.cable_mass[lost]) if hangs else 0.0
    for tilt in TILTS:
        attitude = _tilted(tilt, AXES if tilt else AXES[:1])
        # 1. Least change of the formation's forces that balances weights and moments.
        arms = np.einsum("aij,nj->ani", attitude, system.anchors)
        wrench = np.zeros((len(attitude), 6))
        wrench[:, 2] = GRAVITY * system.payload_mass + weight
        # The lost drone's weight acts at its anchor, downward: the others have to exert the opposite wrench.
        wrench[:, 3:] = np.cross(arms[:, lost], [0.0, 0.0, weight])
        force, missed = balance_forces(arms[:, keep], system.formation_force[keep], wrench)
        # Two cables exert no moment about the line of their anchors: what they miss of one shows here.
        balanced = missed < 1e-6
        # 2. Where the drones are that exert them, each held by the spring that its position gain is.
        size = np.linalg.norm(force, axis=2, keepdims=True)
        stretched = system.cable_length[keep, None] + size / system.cable_stiffness[keep, None]
        place = arms[:, keep] + stretched * force / size - _hook_arms(force, keep, system)
        moved = place - system.slots[keep]
        stiffness = (gains.mass * gains.k_p)[keep, None]
        # Beyond the place itself: a drone pulled by ΔF hangs back by ΔF/κ, so its slot is put that much farther.
        offset = _to_slots(moved + (force - system.formation_force[keep]) / stiffness, system.slot_azimuth[keep])
        # 3. What is possible.
        lifted = force + GRAVITY * (gains.mass + system.cable_mass)[keep, None] * [0.0, 0.0, 1.0]
        thrust = np.linalg.norm(lifted, axis=2) / (4 * gains.thrust_max[keep])
        height = place[..., 2].min(axis=1)
        possible = balanced & (thrust.max(axis=1) <= thrust_share) & (height >= LEAST_HEIGHT)
        possible &= np.abs(offset).max(axis=(1, 2)) <= max_offset
        if possible.any():
            # Tilts are tried in rising order: among the axes of the first possible one, that which asks least of any
            # drone.
            best = np.where(possible, thrust.max(axis=1), np.inf).argmin()
            found = Redistribution(float(tilt), *(np.zeros((system.num_drones, *shape)) for shape in ((3,), (), (3,))))
            found.force[keep] = force[best]
            found.thrust[keep] = thrust[best]
            found.offset[keep] = offset[best]
            return found
    return None


@remember
def redistributed_slots(system: System, gains: Gains, hangs: bool, max_offset: float) -> np.ndarray:
    """Return by how much each slot moves for each lost drone, (N lost, N, 3) in slot frames [m]; 0 where none holds.

    Args:
        system, gains, hangs, max_offset: see `redistribute`; no drone needs more than `THRUST_SHARE`.
    """
    offsets = np.zeros((system.num_drones, system.num_drones, 3))
    for lost in range(system.num_drones):
        found = redistribute(system, gains, lost, hangs, THRUST_SHARE, max_offset)
        if found is not None:
            offsets[lost] = found.offset
    return offsets


@kernel
def plan_offset(seconds: float, held: np.ndarray, cosine: float, hangs: bool) -> tuple[float, float, float]:
    """Return by how much a slot is to move, so many seconds after a loss, in its frame [m].

    Until the falling drone has snatched at its cable, drones give way: the snatch is then less than half as hard. A
    plan that lets them all sink by half a metre alone makes it harder.

    Args:
        seconds: since the loss.
        held: where the slot holds the payload (3,), see `redistributed_slots`.
        cosine: of the angle from the slot's azimuth to the lost one's.
        hangs: whether the lost drone hangs on its cable.
    """
    giving = 1.0 if hangs and seconds < GIVE_SECONDS else 0.0
    share = clip((seconds - WAIT) / RAMP, 0.0, 1.0)
    # Without a step of velocity at either end.
    share = share**2 * (3.0 - 2.0 * share)
    down = GIVE_DOWN + GIVE_NEAR * cosine
    return share * held[0] + giving * GIVE_OUT, share * held[1], share * held[2] - giving * down


def _hook_arms(force: np.ndarray, drones: np.ndarray, system: System) -> np.ndarray:
    """Return where the hooks of drones that hold cable forces (A, M, 3) [N] are beside them, alike [m]."""
    if not system.hooks.any():
        return np.zeros(3)
    vehicles, heading = tuple(system.vehicles[n] for n in drones), system.heading[drones]
    held = force + GRAVITY * system.cable_mass[drones, None] * [0.0, 0.0, 1.0]
    turned = np.array([resting_rotations(vehicles, each, heading) for each in held])
    return np.einsum("anij,nj->ani", turned, system.hooks[drones])


def _tilted(tilt: float, axes: np.ndarray) -> np.ndarray:
    """Return attitudes (A, 3, 3) tilted about horizontal axes at these azimuths (A,)."""
    x, y, zero = np.cos(axes), np.sin(axes), np.zeros_like(axes)
    k = np.moveaxis(np.array([[zero, zero, y], [zero, zero, -x], [-y, x, zero]]), 2, 0)
    return np.eye(3) + np.sin(tilt) * k + (1 - np.cos(tilt)) * k @ k


def _to_slots(vectors: np.ndarray, azimuth: np.ndarray) -> np.ndarray:
    """Return vectors (A, N, 3) in the slot frames at these azimuths (N,)."""
    c, s = np.cos(azimuth), np.sin(azimuth)
    x, y, z = np.moveaxis(vectors, 2, 0)
    return np.stack([c * x + s * y, c * y - s * x, z], axis=2)
