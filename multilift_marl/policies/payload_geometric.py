"""The baseline `payload_geometric`: one geometric controller for the payload, which all drones serve.

Force and moment on the payload follow from its errors in position and attitude on SE(3), with integrals (Lee, IEEE TCST
26(4), 2018; Sreenath and Kumar, RSS 2013); from them the cable forces, by minimum norm about those of the formation
with every cable taut; from these the places of the drones, which act by the `reference` interface.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from multilift_marl.control.cable_forces import MIN_TENSION_RATIO, drone_offset, solve_cable_forces
from multilift_marl.control.gains import make_gains
from multilift_marl.kernels.jit import kernel
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
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.constants import RigArrays

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
CARRIED = 0.5  # of the tension at rest, from which on the payload counts as carried


class PayloadLaw(NamedTuple):
    """Constants of the control law, for one team."""

    gains: PayloadGains
    rig: RigArrays
    inertia: tuple[float, ...]
    """Of the payload in its frame, 9 numbers [kg m²]."""
    stiffness: np.ndarray
    """(N,) force of each drone for each metre from its reference [N/m]."""
    lead_steps: float
    """Lead of the offsets [policy steps]."""
    max_offset: float
    """Of a full action [m]."""


class PayloadMemory(NamedTuple):
    """What the law remembers from step to step."""

    cable_force: np.ndarray
    """(E, N, 3) last desired forces of the cables on the payload [N]."""
    offset: np.ndarray
    """(E, N, 3) last offsets of the slots [m]."""
    fresh: np.ndarray
    """(E,) bool, environments that have no last offsets."""


class PayloadGeometric:
    """Centralised: it reads the true state of payload and goal in `vec`, but neither masses nor forces that are hidden.

    It acts about `task.planned`, and remembers only its last offsets, for the lead: the integrals are the task's. The
    law is that of Lee (IEEE TCST 26(4), 2018), see the head of this file.

    Args:
        vec: environments with the interface `reference`; read at every `act`.
        gains: None for the tuned ones.

    Class attributes:
        INTERFACE: by which it acts.
    """

    INTERFACE: ClassVar[str] = "reference"

    def __init__(self, vec: MultiliftVec, gains: PayloadGains | None = None):
        system, control, task = vec.world.system, vec.config.acting, vec.task
        gains = PayloadGains() if gains is None else gains
        drone = make_gains(control, system)
        lead_steps = gains.lead * 3.0 / control.reference_frequency / task.dt
        stiffness = drone.mass * drone.k_p
        self._vec = vec
        self._law = PayloadLaw(gains, task.rig, system.inertia_matrix, stiffness, lead_steps, control.max_offset)
        shape = (vec.num_envs, vec.num_drones)
        self._memory = PayloadMemory(np.zeros((*shape, 3)), np.zeros((*shape, 3)), np.ones(vec.num_envs, bool))
        self._action = np.zeros((*shape, vec.action_size))

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
        _act(vec.world.state, task.planned, task.errors, self._law, self._memory, self._action)
        return self._action.copy()

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget the last offsets of the environments in the mask (E,) (None: all)."""
        self._memory.fresh[slice(None) if mask is None else mask] = True


@kernel
def _times(a, b):
    """Return the product of each component."""
    return (a[0] * b[0], a[1] * b[1], a[2] * b[2])


@kernel
def _act(state, planned, errors, law, memory, action):
    """Write the actions (E, N, 4).

    Args:
        state: SystemState.
        planned: Goal that the team is to follow.
        errors: of the task, whose integrals count.
        law: PayloadLaw.
        memory: PayloadMemory, written.
        action: written.
    """
    g, rig = law.gains, law.rig
    mass = rig.payload_mass
    for e in range(action.shape[0]):
        if not _is_carried(e, planned, rig):  # nothing is to be held yet: the formation alone
            action[e] = 0.0
            memory.offset[e] = 0.0
            memory.fresh[e] = True
            continue

        # Errors of position, velocity, attitude and angular velocity from the plan.
        attitude = matrow(planned.rotation, e)
        payload = matrow(state.payload_rotation, e)
        position_error = sub(row(state.payload_position, e), row(planned.position, e))
        velocity_error = sub(row(state.payload_velocity, e), row(planned.velocity, e))
        rotation_error = rotation_vector(matmul(payload, transpose(attitude)))
        rate_error = sub(mul(payload, row(state.payload_body_rates, e)), row(planned.angular_velocity, e))

        # Force and moment that correct them.
        feedback = add(_times(g.position, position_error), _times(g.velocity, velocity_error))
        feedback = add(feedback, _times(g.integral, row(errors.position_integral, e)))
        force = limit(scale(-mass, feedback), MAX_FORCE * mass * GRAVITY)
        turning = add(scale(g.attitude, rotation_error), scale(g.rates, rate_error))
        turning = add(turning, scale(g.attitude_integral, row(errors.rotation_integral, e)))
        # J in the world frame, of the planned attitude; gains are per unit of mass and inertia.
        inertia = matmul(matmul(attitude, law.inertia), transpose(attitude))
        moment = scale(-1.0, mul(inertia, turning))

        # With what the planned cable forces exert, the wrench on the payload; the nearest cable forces that exert it.
        for n in range(rig.slots.shape[0]):
            nominal = _planned_force(e, n, planned, rig)
            arm = mul(attitude, row(rig.anchors, n))
            force = add(force, nominal)
            moment = add(moment, cross(arm, nominal))
            put(memory.cable_force[e, n], nominal)
        solve_cable_forces(force, moment, attitude, rig.anchors, MIN_TENSION_RATIO, memory.cable_force[e])

        # Slots from which the drones exert them, stretch of cables and of position loops included.
        for n in range(rig.slots.shape[0]):
            old = _planned_force(e, n, planned, rig)
            new = vec(memory.cable_force, e, n)
            moved = sub(drone_offset(n, new, rig), drone_offset(n, old, rig))
            offset = add(moved, scale(1.0 / law.stiffness[n], sub(new, old)))

            # Lead by the offset's last change, to the slot frame, to the range of actions.
            change = (0.0, 0.0, 0.0) if memory.fresh[e] else sub(offset, vec(memory.offset, e, n))
            put(memory.offset[e, n], offset)
            offset = add(offset, scale(law.lead_steps, change))
            offset = turn(planned.slot_frame[e, n, 0], -planned.slot_frame[e, n, 1], offset)
            for j in range(3):
                action[e, n, j] = clip(offset[j] / law.max_offset, -1.0, 1.0)
        memory.fresh[e] = False


@kernel
def _is_carried(e, planned, rig):
    """Return whether the planned tensions are at least `CARRIED` of those at rest, in all."""
    tension = 0.0
    rest = 0.0
    for n in range(rig.slots.shape[0]):
        tension += norm(vec(planned.cable_force, e, n))
        rest += norm(row(rig.force, n))
    return tension >= CARRIED * rest


@kernel
def _planned_force(e, n, planned, rig):
    """Return the force of cable n on the payload in the plan, which holds it without the load's inertia [N]."""
    # `planned.cable_force` leaves out the load's inertia, which the controllers add by their set-points' accelerations.
    load_share = rig.force[n, 2] / GRAVITY
    inertial = scale(load_share, add(row(planned.acceleration, e), vec(planned.slot_acceleration, e, n)))
    return sub(add(vec(planned.cable_force, e, n), inertial), (0.0, 0.0, rig.cable_weight[n]))
