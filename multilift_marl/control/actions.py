"""The action interfaces, one class each, all in the table at the end; see `action_interface.py`."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from multilift_marl.control.action_interface import (
    AXES,
    FACTOR,
    THRUST,
    YAW_RATE,
    ActionComponent,
    Call,
    ControlContext,
    Interface,
    from_slot_body,
    in_world,
    moment_component,
    tilt_rate_components,
    vector_components,
)
from multilift_marl.control.allocation import allocate
from multilift_marl.control.formation import Reference, Smoothing, smooth, smooth_moving, to_goal_frame
from multilift_marl.control.full_state import FullStateAction
from multilift_marl.control.gains import drone_gains
from multilift_marl.control.geometric import fly, fly_rates, hook_moment
from multilift_marl.control.obstacle_margin import Margins, keep_clear
from multilift_marl.control.setpoints import smooth_velocity, track_own_state, track_own_state_to_yaw
from multilift_marl.control.swing import shift_with_swing
from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.math3d import add, heading, mat, norm, put, scale, thrust_frame, vec
from multilift_marl.physical import GRAVITY
from multilift_marl.schema.control import ControlConfig

PLANNER_WEIGHTS = {
    "position": "the payload's horizontal position",
    "height": "its height",
    "tilt": "its roll and pitch",
    "yaw": "its yaw",
    "velocity": "its horizontal velocity",
    "climb": "its vertical velocity",
    "tilt_rate": "its body rates about x and y",
    "yaw_rate": "that about z",
    "cable": "the own cable's direction",
    "cable_rate": "its rate",
    "thrust": "the own thrust vector",
    "thrust_rate": "its rate",
    "end": "the state at the end of the horizon",
}


class ReferenceAction(Interface):
    """Offset of the drone's slot in the formation about the target payload pose; zero keeps the formation."""

    numbers = (
        *vector_components("m", "max_offset", "offset of the own slot"),
        ActionComponent("yaw", "target", "rad", "max_yaw", "own heading relative to the one at rest"),
    )
    supports = ("integral", "indi")

    def __init__(self, settings: ControlConfig, dt: float):
        super().__init__(settings, dt)
        self._smoothing = Smoothing(settings.reference_frequency, settings.reference_speed, dt)

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        ranges = (self.settings.max_offset, self.settings.max_yaw)
        if (shift := self.settings.swing_shift) and team.around is not None:
            return bind(_command_offset_with_swing, lo, hi, action, team, *ranges, shift)
        return bind(_command_offset, lo, hi, action, team, *ranges)

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        smoothed = bind(smooth, lo, hi, team.reference, self._smoothing)
        return *self._keep_clear(lo, hi, team), smoothed, *super().control_step(lo, hi, team)

    def control_step_moving_goal(
        self, lo: int, hi: int, plan: Call, set_action: Call, team: ControlContext
    ) -> tuple[Call, ...]:
        """See `Interface.control_step_moving_goal`."""
        before = Reference.zeros(*team.reference.yaw.shape)
        relative = bind(to_goal_frame, lo, hi, team.reference, team.goal, before)
        smoothed = bind(smooth_moving, lo, hi, team.reference, team.goal, before, self._smoothing)
        kept = self._keep_clear(lo, hi, team)
        return relative, plan, set_action, *kept, smoothed, *super().control_step(lo, hi, team)

    def _keep_clear(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        margins = Margins.of(self.settings)
        return (bind(keep_clear, lo, hi, team, margins, self._smoothing),) if any(margins) else ()


class VelocityAction(Interface):
    """Velocity outward, sideways and upward, and yaw rate; the velocity is smoothed at control.reference_frequency."""

    numbers = (*vector_components("m/s", "max_velocity", "own velocity"), YAW_RATE)
    supports = ("indi",)

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        ranges = (self.settings.max_velocity, self.settings.max_yaw_rate)
        return bind(_command_vector, lo, hi, action, team.goal, team.reference, team.setpoint.velocity, *ranges)

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        smoothing = (self.settings.reference_frequency, self.dt)
        smoothed = bind(smooth_velocity, lo, hi, team.state, team.reference, team.setpoint, *smoothing)
        return smoothed, *super().control_step(lo, hi, team)


class AccelerationAction(Interface):
    """Acceleration outward, sideways and upward, and yaw rate."""

    numbers = (*vector_components("m/s²", "max_acceleration", "own acceleration"), YAW_RATE)
    supports = ("indi",)

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        ranges = (self.settings.max_acceleration, self.settings.max_yaw_rate)
        return bind(_command_vector, lo, hi, action, team.goal, team.reference, team.reference.acceleration, *ranges)

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        tracked = bind(track_own_state, lo, hi, team.state, team.reference, self.dt)
        return tracked, *super().control_step(lo, hi, team)


class AccRatesAction(Interface):
    """Acceleration outward, sideways and upward, and the rates of its tilt; the yaw is the target's.

    The rates are those of the attitude that the acceleration asks for (Zeng et al., arXiv 2508.01522). An acceleration
    alone says nothing of how it will change: these rates feed forward what the jerk would.
    """

    numbers = (
        *vector_components("m/s²", "max_acceleration", "own acceleration"),
        *tilt_rate_components("angular velocity of the attitude that this asks for,"),
    )
    by_rates = True
    supports: ClassVar[tuple[str, ...]] = ("indi",)

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        ranges = (self.settings.max_acceleration, self.settings.max_tilt_rate)
        return bind(_command_acc_rates, lo, hi, action, team, *ranges)

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        smoothing = (self.settings.reference_frequency, self.dt)
        tracked = bind(track_own_state_to_yaw, lo, hi, team.state, team.reference, *smoothing)
        followed = (team.state, team.reference, team.cable_force, team.thrust, team.gains)
        return tracked, bind(fly, lo, hi, *followed, team.setpoint.rates)


class PlannerWeightsAction(AccRatesAction):
    """Weights of a model-predictive planner, which flies the team by `acc_rates`; zero: those of `planner`.

    Each is that of `planner`, times `control.max_weight` to the power of the number: a planner minimises squared
    deviations, each over its squared tolerance. Those of the payload, and of the end, are the geometric mean of what
    the drones say; those of a cable and a thrust are its drone's own.
    """

    numbers = tuple(
        ActionComponent(f"{name}_weight", "-", "-", FACTOR, f"factor on the planner's weight of {meaning}")
        for name, meaning in PLANNER_WEIGHTS.items()
    )
    supports: ClassVar[tuple[str, ...]] = ()  # the planner rejects unknown forces


class CtbrAction(Interface):
    """Collective thrust and body rates; a thrust of zero is that of hovering, ± 1 the limits."""

    numbers = (
        ActionComponent("thrust", "body", "N", THRUST, "thrust of the four rotors together"),
        *tilt_rate_components("angular velocity"),
        ActionComponent("yaw_rate", "slot body", "rad/s", "max_yaw_rate", "angular velocity about body z"),
    )
    by_rates = True

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        return bind(_command_rates, lo, hi, action, team, self.settings.max_tilt_rate, self.settings.max_yaw_rate)

    def thrusts(self, team: ControlContext) -> np.ndarray:
        """See `Interface.thrusts`."""
        return team.setpoint.thrust[..., None]

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        return (bind(fly_rates, lo, hi, team.state, team.setpoint, team.cable_force, team.thrust, team.gains),)


class CtbmAction(CtbrAction):
    """Collective thrust and body moments: as much as the rotors' own thrusts, in the slot body frame.

    Moments are given as the angular accelerations that they cause in a drone which does not turn, as far as its rotors
    can exert them: about yaw they saturate far earlier than about the others. Nothing else holds the attitude.
    """

    numbers = (CtbrAction.numbers[0], *map(moment_component, ("outward", "sideways", "yaw"), AXES))

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        return bind(_command_moments, lo, hi, action, team, self.settings.max_angular_acceleration)

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        return ()


class RotorAction(Interface):
    """Thrust of each rotor, zero: its own at hover, ± 1: its limits. Nothing else holds the attitude.

    Which rotor is on the outside differs from drone to drone, unless they face outward (`control.heading`).
    """

    numbers = tuple(ActionComponent(f"rotor_{k}", "body", "N", THRUST, f"thrust of rotor {k}") for k in range(4))

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """See `Interface.set_action`."""
        return bind(_command_rotors, lo, hi, action, team)

    def thrusts(self, team: ControlContext) -> np.ndarray:
        """See `Interface.thrusts`."""
        return team.thrust

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """See `Interface.control_step`."""
        return ()


@kernel
def _command_offset(lo, hi, action, team, max_offset, max_yaw):
    goal, g = team.goal, team.gains
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            put(team.reference.command[e, n], add(vec(goal.slots, e, n), in_world(e, n, action, goal, max_offset)))
            team.reference.command_yaw[e, n] = goal.drone_yaw[e] + g.heading[n] + max_yaw * action[e, n, 3]


@kernel
def _command_offset_with_swing(lo, hi, action, team, max_offset, max_yaw, shift):
    _command_offset(lo, hi, action, team, max_offset, max_yaw)
    shift_with_swing(lo, hi, team, shift)


@kernel
def _command_vector(lo, hi, action, goal, reference, vector, largest, max_yaw_rate):
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            put(vector[e, n], in_world(e, n, action, goal, largest))
            reference.yaw_rate[e, n] = max_yaw_rate * action[e, n, 3]


@kernel
def _command_acc_rates(lo, hi, action, team, max_acceleration, max_tilt_rate):
    reference, goal = team.reference, team.goal
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            put(reference.acceleration[e, n], in_world(e, n, action, goal, max_acceleration))
            asked = (max_tilt_rate * action[e, n, 3], max_tilt_rate * action[e, n, 4], 0.0)
            # By the yaw that the reference has now, not by the one commanded below.
            put(team.setpoint.rates[e, n], from_slot_body(asked, reference.yaw[e, n], goal.slot_frame[e, n]))
            reference.command_yaw[e, n] = goal.drone_yaw[e] + team.gains.heading[n]


@kernel
def _hover_force(cable_force, mass):
    """Return the force [N] that carries a drone of a mass [kg] and the force on its cable."""
    return add(cable_force, (0.0, 0.0, mass * GRAVITY))


@kernel
def _between(action, low, middle, high):
    """Return `low` for an action of -1, `middle` for 0, `high` for 1, and what lies between in proportion."""
    return middle + action * ((high - middle) if action > 0.0 else (middle - low))


@kernel
def _command_rates(lo, hi, action, team, max_tilt_rate, max_yaw_rate):
    track_own_state(lo, hi, team.state, team.reference, 0.0)
    setpoint, g = team.setpoint, team.gains
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            hover = norm(_hover_force(vec(team.cable_force, e, n), g.mass[n]))
            setpoint.thrust[e, n] = _between(action[e, n, 0], 4.0 * g.thrust_min[n], hover, 4.0 * g.thrust_max[n])
            asked = (max_tilt_rate * action[e, n, 1], max_tilt_rate * action[e, n, 2], max_yaw_rate * action[e, n, 3])
            yaw = heading(mat(team.state.drone_rotation, e, n))
            put(setpoint.rates[e, n], from_slot_body(asked, yaw, team.goal.slot_frame[e, n]))


@kernel
def _command_moments(lo, hi, action, team, max_angular_acceleration):
    track_own_state(lo, hi, team.state, team.reference, 0.0)
    g = team.gains
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            d = drone_gains(g, n)
            cable, attitude = vec(team.cable_force, e, n), mat(team.state.drone_rotation, e, n)
            hover = norm(_hover_force(cable, d.mass))
            total = _between(action[e, n, 0], 4.0 * d.thrust_min, hover, 4.0 * d.thrust_max)
            team.setpoint.thrust[e, n] = total
            asked = scale(max_angular_acceleration, (action[e, n, 1], action[e, n, 2], action[e, n, 3]))
            asked = from_slot_body(asked, heading(attitude), team.goal.slot_frame[e, n])
            # No term ω × J ω: the policy commands what turns a drone that does not turn yet.
            moment = (d.inertia[0] * asked[0], d.inertia[1] * asked[1], d.inertia[2] * asked[2])
            moment = add(moment, hook_moment(n, attitude, cable, (0.0, 0.0, 0.0), g))
            rotors = allocate(total, moment, d.allocation, d.thrust_min, d.thrust_max)
            for k in range(4):
                team.thrust[e, n, k] = rotors[k]


@kernel
def _command_rotors(lo, hi, action, team):
    track_own_state(lo, hi, team.state, team.reference, 0.0)
    g = team.gains
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            # Rotor thrusts at rest: equal ones, unless the cable is tied off the centre of mass.
            force = _hover_force(vec(team.cable_force, e, n), g.mass[n])
            total = norm(force)
            rotors = (0.25 * total, 0.25 * total, 0.25 * total, 0.25 * total)
            if g.hooked:
                d = drone_gains(g, n)
                attitude = thrust_frame(force, heading(mat(team.state.drone_rotation, e, n)))
                moment = hook_moment(n, attitude, vec(team.cable_force, e, n), (0.0, 0.0, 0.0), g)
                rotors = allocate(total, moment, d.allocation, d.thrust_min, d.thrust_max)
            for k in range(4):
                team.thrust[e, n, k] = _between(action[e, n, k], g.thrust_min[n], rotors[k], g.thrust_max[n])


ACTIONS: dict[str, type[Interface]] = {
    "reference": ReferenceAction,
    "velocity": VelocityAction,
    "acceleration": AccelerationAction,
    "acc_rates": AccRatesAction,
    "full_state": FullStateAction,
    "planner_weights": PlannerWeightsAction,
    "ctbr": CtbrAction,
    "ctbm": CtbmAction,
    "rotor": RotorAction,
}
