"""The scripted team `payload_geometric`: one geometric controller for the payload, which all drones serve.

Force and moment on the payload follow from its errors in position and attitude on SE(3), with integrals (Lee, IEEE TCST
26(4), 2018; Sreenath and Kumar, RSS 2013); pulls of the cables, by minimum norm about those of the formation with every
cable pulling, from force and moment; places of the drones, which act by the `reference` interface, from the pulls.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.control.cable_forces import MIN_TENSION_RATIO, drone_offset, solve_cable_forces
from multilift_marl.control.gains import make_gains
from multilift_marl.math3d import (
    add,
    clip,
    cross,
    limit,
    matmul,
    matrow,
    mul,
    norm,
    put,
    rotation_vector,
    row,
    scale,
    sub,
    transpose,
    turn,
    vec,
)
from multilift_marl.rig.vehicles import GRAVITY

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


class PayloadGains(NamedTuple):
    """Gains of the payload's controller: accelerations that correct its errors, and a lead.

    Those of attitude and rates are negative: what is commanded arrives about a third of a swing late, through the
    smoothed reference and the drone, so that a push along an error comes as one against its rate (docs/pose.md).
    """

    position: tuple[float, float, float] = (2.5, 2.5, 6.0)
    """k_x of each axis [1/s²]."""
    velocity: tuple[float, float, float] = (2.5, 2.5, 0.0)
    """k_v [1/s]."""
    integral: tuple[float, float, float] = (8.5, 8.5, 20.0)
    """k_i [1/s³]."""
    attitude: float = -15.0
    """k_R [1/s²]."""
    rates: float = -0.7
    """k_Ω [1/s]."""
    attitude_integral: float = 2.0
    """k_I [1/s³]."""
    lead: float = 0.6
    """Of the offsets, over 3/ω: 1 makes up for the delay of the smoothed reference, to first order [-]."""


MAX_FORCE = 0.5  # of the payload's weight, that corrects errors


class PayloadGeometric:
    """Centralised: it reads the true state of payload and goal in `vec`, but neither masses nor forces that are hidden.

    It flies about `task.way`, and remembers only its last offsets, for the lead: the integrals are the task's. The law
    is that of Lee (IEEE TCST 26(4), 2018), see the head of this file.

    Args:
        vec: environments with the interface `reference`; read at every `act`.
        gains: None for the tuned ones.
    """

    def __init__(self, vec: MultiliftVec, gains: PayloadGains | None = None):
        self._vec, system, control = vec, vec.world.system, vec.config.control
        self._gains = PayloadGains() if gains is None else gains
        drone = make_gains(control, system)
        ahead = self._gains.lead * 3.0 / control.reference_frequency / vec.task.dt
        self._numbers = (drone.mass * drone.k_p, ahead, control.max_offset)
        self._inertia = system.inertia_matrix
        self._action = np.zeros((vec.num_envs, vec.num_drones, vec.action_size))
        self._pull, self._last = np.zeros((2, vec.num_envs, vec.num_drones, 3))
        self._fresh = np.ones(vec.num_envs, bool)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 4) in [-1, 1] for the present state of the environments, whose observations these are.

        Raises:
            ValueError: observations of another number of environments.
        """
        vec, task = self._vec, self._vec.task
        if np.shape(observation)[:2] != self._action.shape[:2]:
            raise ValueError(
                f"payload_geometric reads the state of its {vec.num_envs} environments of {vec.num_drones} drones, but "
                f"the observation has shape {np.shape(observation)}; give the observations of all of them"
            )
        _steer(
            0, vec.num_envs, vec.world.state, task.planned, task.errors, task.rig, task.hanging, self._inertia,
            self._gains, *self._numbers, self._pull, self._last, self._fresh, self._action,
        )  # fmt: skip
        return self._action.copy()

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget the last offsets of the environments in the mask (E,) (None: all)."""
        self._fresh[slice(None) if mask is None else mask] = True


@kernel
def _times(a, b):
    """Return the product of each component."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@kernel
def _steer(
    lo, hi, state, way, errors, rig, hanging, inertia, g, stiffness, ahead, max_offset, cable_force, last, fresh, action
):
    """Write the actions (E, N, 4) of environments lo to hi.

    Args:
        lo, hi: the environments.
        state: SystemState.
        way: Goal that the drones fly about.
        errors: whose integrals count.
        rig, hanging: Rig, Hanging.
        inertia: of the payload in its frame, 9 numbers [kg m²].
        g: PayloadGains.
        stiffness: force of each drone for each metre from its reference (N,) [N/m].
        ahead: lead of the offsets [policy steps].
        max_offset: of a full action [m].
        pull: (E, N, 3) written with the pulls that are wanted [N].
        last: (E, N, 3) the last offsets, written [m].
        fresh: (E,) bool, environments that have none; written.
        action: written.
    """
    mass = hanging.payload_mass
    for e in range(lo, hi):
        if not _carried(e, way, rig):  # nothing is to be held yet: the formation alone
            action[e], last[e], fresh[e] = 0.0, 0.0, True
            continue
        attitude, payload = matrow(way.rotation, e), matrow(state.payload_rotation, e)
        apart = sub(row(state.payload_position, e), row(way.position, e))
        moving = sub(row(state.payload_velocity, e), row(way.velocity, e))
        twisted = rotation_vector(matmul(payload, transpose(attitude)))
        spinning = sub(mul(payload, row(state.payload_body_rates, e)), row(way.angular_velocity, e))
        wanted = add(_times(g.position, apart), _times(g.velocity, moving))
        wanted = add(wanted, _times(g.integral, row(errors.position_integral, e)))
        force = limit(scale(-mass, wanted), MAX_FORCE * mass * GRAVITY)
        turning = add(scale(g.attitude, twisted), scale(g.rates, spinning))
        turning = add(turning, scale(g.attitude_integral, row(errors.rotation_integral, e)))
        body = matmul(matmul(attitude, inertia), transpose(attitude))
        moment = scale(-1.0, mul(body, turning))
        for n in range(rig.slots.shape[0]):
            put(cable_force[e, n], _own(e, n, way, rig, hanging))
            arm = mul(attitude, (rig.anchors[n, 0], rig.anchors[n, 1], rig.anchors[n, 2]))
            force, moment = add(force, vec(cable_force, e, n)), add(moment, cross(arm, vec(cable_force, e, n)))
        solve_cable_forces(force, moment, attitude, rig.anchors, MIN_TENSION_RATIO, cable_force[e])
        for n in range(rig.slots.shape[0]):
            old, new = _own(e, n, way, rig, hanging), vec(cable_force, e, n)
            offset = add(
                sub(drone_offset(n, new, hanging), drone_offset(n, old, hanging)),
                scale(1.0 / stiffness[n], sub(new, old)),
            )
            change = (0.0, 0.0, 0.0) if fresh[e] else sub(offset, vec(last, e, n))
            put(last[e, n], offset)
            offset = add(offset, scale(ahead, change))
            offset = turn(way.slot_frame[e, n, 0], -way.slot_frame[e, n, 1], offset)
            for j in range(3):
                action[e, n, j] = clip(offset[j] / max_offset, -1.0, 1.0)
        fresh[e] = False


@kernel
def _carried(e, way, rig):
    """Return whether the cables are meant to pull at least half of what they do at rest, in all."""
    wanted, rest = 0.0, 0.0
    for n in range(rig.slots.shape[0]):
        wanted, rest = wanted + norm(vec(way.cable_force, e, n)), rest + norm(row(rig.force, n))
    return wanted >= 0.5 * rest


@kernel
def _own(e, n, way, rig, hanging):
    """Return the pull on the payload that the way needs of cable n: `way.pull` leaves the load's inertia out [N]."""
    share = rig.force[n, 2] / GRAVITY
    inertial = scale(share, add(row(way.acceleration, e), vec(way.slot_acceleration, e, n)))
    return sub(add(vec(way.cable_force, e, n), inertial), (0.0, 0.0, hanging.weight[n]))
