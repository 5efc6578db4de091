"""How the drones of task `loss` come to know that one of them is lost.

Where it is not broadcast, by how the payload tilts; and drones that do not know its tilt, by their own cable. When
another drone's cable goes slack, the tension of a neighbour's rises and its end sinks; the tension of the one opposite
falls and its end rises. By how much follows from rigid cables, drones that are point masses with unchanged thrust, and
the payload's inertia (`expect_changes`). Two drones whose loss has the same effect are told apart by where the payload
swings: away from the lost one, whose cable no longer draws it there.
"""

from __future__ import annotations

from math import cos, hypot, sin

import numpy as np

from multilift_marl.kernels.jit import inlined
from multilift_marl.math3d import add, mat, mul, put, scale, sub, vec
from multilift_marl.mdp.env_data import load_row
from multilift_marl.rig.system import System

LEAD = 0.1  # [s] by which a tilt is foreseen: 4 drones notice a loss 0.13 s after it, 6 after 0.17 s
WINDOW = 0.1  # [s] in which tension and climb change, by motors of 0.05 s
MATCH = 0.55  # [-] of the change that a loss brings, from which on it is noticed
LEAST_CHANGE = 0.2  # [-] that can be told from swings: after two seconds these match up to 0.5 of 0.3
ALIKE = 0.05  # [-] changes that differ by less tell nothing apart
SETTLED = 2.0  # [s] payloads that start tilted swing, and tensions with them; nothing is looked for until then
SIDE_SECONDS = 0.4  # [s] after a loss was noticed: the payload has swung by 5 to 20 cm


def expect_changes(system: System, drone_mass: np.ndarray) -> np.ndarray:
    """Return what each drone's cable does within `WINDOW` when another drone is lost, (N lost, N, 2).

    With s the changes of tension, G the cables' directions as wrenches on the payload, M its inertia, m the drones'
    masses and w the wrench that is lost, (Gᵀ M⁻¹ G + diag(1/m)) s = Gᵀ M⁻¹ w: along each remaining cable its two ends
    accelerate alike.

    Args:
        system: of the team.
        drone_mass: (N,) [kg].

    Returns:
        Change of the tension over that at rest [-], and of the vertical velocity of the cable's end at the payload
        [m/s], half of what the first acceleration makes of it, as the drones pull it back.
    """
    n, force = system.num_drones, system.formation_force
    size = np.linalg.norm(force, axis=1)
    # (N, 6): what each cable exerts on the payload at rest, force and moment about the centre of mass.
    wrench = np.hstack([force, np.cross(system.anchors, force)])
    inertia = np.zeros((6, 6))
    inertia[:3, :3] = system.payload_mass * np.eye(3)
    inertia[3:, 3:] = np.reshape(system.inertia_matrix, (3, 3))
    changes = np.zeros((n, n, 2))
    for lost in range(n):
        keep = np.delete(np.arange(n), lost)
        directions = (wrench[keep] / size[keep, None]).T
        effect = directions.T @ np.linalg.solve(inertia, np.column_stack([directions, wrench[lost]]))
        # Last column: Gᵀ M⁻¹ w, how the lost wrench's end accelerates the anchors along the cables.
        tension = np.linalg.solve(effect[:, :-1] + np.diag(1.0 / drone_mass[keep]), effect[:, -1])
        # Acceleration of the payload without w, with the changed tensions; at an anchor a + α × r (at rest, so without
        # ω² terms).
        linear, angular = np.split(np.linalg.solve(inertia, directions @ tension - wrench[lost]), 2)
        climb = (linear + np.cross(angular, system.anchors[keep]))[:, 2]
        changes[lost, keep] = np.column_stack([tension / size[keep], 0.5 * WINDOW * climb])
    return changes


@inlined
def coming_tilt(e, n, v):
    """Return the level part of the rotation vector to which the payload turns in `LEAD` as drone n knows it [rad]."""
    k = load_row(n, v)
    spin = mul(mat(v.payload_estimate.rotation, e, k), vec(v.payload_estimate.body_rates, e, k))
    return add(vec(v.estimated_errors.rotation, e, k), scale(LEAD, spin))[:2]


@inlined
def lowest_corner(e, tilt, v):
    """Return the drone whose corner of the payload sinks most by a tilt."""
    lowest, who = 1e9, 0
    for k in range(v.rig.azimuth.shape[0]):
        azimuth = v.goal.yaw[e] + v.rig.azimuth[k]
        height = tilt[0] * sin(azimuth) - tilt[1] * cos(azimuth)  # of tilt x corner
        if height < lowest:
            lowest, who = height, k
    return who


@inlined
def notice_loss(e, v):
    """Let drones know of a loss: when it is broadcast, when the payload tilts as it does then, or by their cables.

    What they know of the payload is that of the last policy step where sensors measure it.
    """
    lost = v.mask.lost[e, v.own.who[e]]
    for n in range(v.own.known.shape[1]):
        if v.settings.by_cable:
            detect_drone_loss(e, n, v)
            continue
        tilt = coming_tilt(e, n, v)
        noticed = hypot(tilt[0], tilt[1]) > v.settings.noticed_angle
        if not v.own.known[e, n] and (lost if v.settings.broadcast else noticed):
            v.own.known[e, n] = True
            v.own.known_who[e, n] = v.own.who[e] if v.settings.broadcast else lowest_corner(e, tilt, v)
            v.own.known_when[e, n] = v.own.when[e] if v.settings.broadcast else v.time[e]


@inlined
def detect_drone_loss(e, n, v):
    """Let drone n know of a loss by its own cable, and who it is by how the payload swings then."""
    # 1. How tension and climb of the cable's end have changed.
    past, here = v.own.past[e, n], vec(v.payload_estimate.position, e, n)
    tension, climb = v.payload_estimate.tension[e, n] / v.resting_tension[n], v.payload_estimate.velocity[e, n, 2]
    more_tension, more_climb = tension - past[0, 0], climb - past[0, 1]
    for i in range(past.shape[0] - 1):
        # The oldest entry is `WINDOW` ago.
        past[i, 0], past[i, 1] = past[i + 1, 0], past[i + 1, 1]
    past[past.shape[0] - 1, 0], past[past.shape[0] - 1, 1] = tension, climb

    # 2. The drone whose loss brings the change nearest to it, where it is large enough along that. It may be one of
    # several. A change of 0.1 in tension weighs as much as one of 0.1 m/s: both vary by that.
    if not v.own.known[e, n]:
        nearest = 1e9
        for k in range(v.own.known.shape[1]):
            first, second = v.settings.changes[k, n, 0], v.settings.changes[k, n, 1]
            # The projection on the expected change is at least `MATCH` of it.
            matched = first * more_tension + second * more_climb > MATCH * (first * first + second * second)
            gap = hypot(more_tension - first, more_climb - second)
            if k != n and matched and gap < nearest and v.time[e] > SETTLED:
                nearest = gap
                v.own.known[e, n], v.own.known_who[e, n], v.own.known_when[e, n] = True, k, v.time[e]
                v.own.unsure[e, n] = True
                put(v.own.noticed_at[e, n], here)
        return

    # 3. Of these the one from which the payload has swung away most.
    if v.own.unsure[e, n] and v.time[e] >= v.own.known_when[e, n] + SIDE_SECONDS:
        moved = sub(here, vec(v.own.noticed_at, e, n))
        found, least = v.own.known_who[e, n], 1e9
        for k in range(v.own.known.shape[1]):
            azimuth = v.goal.yaw[e] + v.rig.azimuth[k]
            toward = moved[0] * cos(azimuth) + moved[1] * sin(azimuth)
            alike = abs(v.settings.changes[k, n, 0] - v.settings.changes[found, n, 0]) < ALIKE
            if k != n and alike and toward < least:
                v.own.known_who[e, n], least = k, toward
        v.own.unsure[e, n] = False
