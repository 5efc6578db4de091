"""Action interfaces: what the numbers in [-1, 1] mean. One class each, all in the table at the end.

An interface turns actions into set-points once for each policy step (`act`), and set-points into rotor thrusts at the
control rate (`follow`). Vectors are given in the drone's slot frame (x outward from the payload, y to the left of it, z
up), body rates in the body frame. An action of zero hovers as well as the interface can, under the nominal payload.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, NamedTuple

import numpy as np

from multilift_marl._jit import bind, kernel
from multilift_marl.config.schema import ControlConfig
from multilift_marl.control.allocation import allocate
from multilift_marl.control.formation import Goal, Reference, smooth, smooth_moving, to_goal_frame
from multilift_marl.control.gains import Gains, drone_gains
from multilift_marl.control.geometric import control, fly, hook_moment
from multilift_marl.control.scales import THRUST, YAW_RATE, ActionComponent, rate_components, vector_components
from multilift_marl.control.setpoints import (
    STILL,
    Setpoint,
    fly_acc_rates,
    fly_acceleration,
    fly_rates,
    fly_velocity,
    smooth_velocity,
    track_own_state,
    track_own_state_to_yaw,
)
from multilift_marl.math3d import add, heading, mat, norm, put, scale, thrust_frame, turn, vec
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.state import SystemState

Call = Callable[[], None]


class Team(NamedTuple):
    """What an interface reads and writes."""

    state: SystemState
    goal: Goal
    reference: Reference
    setpoint: Setpoint
    cable_force: np.ndarray
    """(E, N, 3) what the drones pull their cables with, any rejected disturbance included [N]."""
    thrust: np.ndarray
    """(E, N, 4) rotor thrusts, written [N]."""
    gains: Gains


class Interface:
    """An action interface.

    Class attributes:
        numbers: of an action, each with its frame, unit and full scale.
        rejects: values of `control.disturbance` that go with it, beside "none".
    """

    numbers: ClassVar[tuple[ActionComponent, ...]]
    supports: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: ControlConfig, dt: float):
        self.settings, self.dt = settings, dt

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: Team) -> Call:
        """Return the call that turns `action` (E, N, A) in [-1, 1] of environments lo to hi into set-points."""
        raise NotImplementedError

    def control_step(self, lo: int, hi: int, team: Team) -> tuple[Call, ...]:
        """Return what is called in turn at every control step, the last of them for the thrusts."""
        raise NotImplementedError

    def control_step_moving_goal(self, lo: int, hi: int, plan: Call, set_action: Call, team: Team) -> tuple[Call, ...]:
        """Return the same as `follow` for goals that move, by calling `plan`, at every control step."""
        return plan, *self.control_step(lo, hi, team)

    def thrusts(self, team: Team) -> np.ndarray:
        """Return the thrusts (E, N, K) [N] that the last action set itself, K of its numbers."""
        return team.thrust[..., :0]


class ReferenceAction(Interface):
    """Offset of the drone's slot in the formation about the target payload pose; zero is the scripted formation."""

    numbers = (
        *vector_components("m", "max_offset", "offset of the own slot"),
        ActionComponent("yaw", "target", "rad", "max_yaw", "own heading relative to the target's"),
    )
    supports = ("integral", "indi")

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: Team) -> Call:
        """See `Interface.act`."""
        ranges = (self.settings.max_offset, self.settings.max_yaw)
        return bind(_command_offset, lo, hi, action, team.goal, team.reference, *ranges)

    def control_step(self, lo: int, hi: int, team: Team) -> tuple[Call, ...]:
        """See `Interface.follow`."""
        smoothing = (self.settings.reference_frequency, self.settings.reference_speed, self.dt)
        flown = (team.state, team.reference, team.cable_force, team.thrust, team.gains)
        if self.settings.disturbance == "none":  # both in one call, which is quicker
            return (bind(control, lo, hi, *flown, *smoothing),)
        return bind(smooth, lo, hi, team.reference, *smoothing), bind(fly, lo, hi, *flown)

    def control_step_moving_goal(self, lo: int, hi: int, plan: Call, set_action: Call, team: Team) -> tuple[Call, ...]:
        """See `Interface.ride`."""
        smoothing = (self.settings.reference_frequency, self.settings.reference_speed, self.dt)
        flown = (team.state, team.reference, team.cable_force, team.thrust, team.gains)
        left = Reference.zeros(*team.reference.yaw.shape)
        leave = bind(to_goal_frame, lo, hi, team.reference, team.goal, left)
        moved = bind(smooth_moving, lo, hi, team.reference, team.goal, left, *smoothing)
        return leave, plan, set_action, moved, bind(fly, lo, hi, *flown)


class VelocityAction(Interface):
    """Velocity outward, sideways and upward, and yaw rate; the velocity is smoothed at control.reference_frequency."""

    numbers = (*vector_components("m/s", "max_velocity", "own velocity"), YAW_RATE)
    supports = ("indi",)

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: Team) -> Call:
        """See `Interface.act`."""
        ranges = (self.settings.max_velocity, self.settings.max_yaw_rate)
        return bind(_command_vector, lo, hi, action, team.goal, team.reference, team.setpoint.velocity, *ranges)

    def control_step(self, lo: int, hi: int, team: Team) -> tuple[Call, ...]:
        """See `Interface.follow`."""
        smoothing = (self.settings.reference_frequency, self.dt)
        moved = bind(smooth_velocity, lo, hi, team.state, team.reference, team.setpoint, *smoothing)
        flown = bind(fly_velocity, lo, hi, team.state, team.reference, team.cable_force, team.thrust, team.gains)
        return moved, flown


class AccelerationAction(Interface):
    """Acceleration outward, sideways and upward, and yaw rate."""

    numbers = (*vector_components("m/s²", "max_acceleration", "own acceleration"), YAW_RATE)
    supports = ("indi",)

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: Team) -> Call:
        """See `Interface.act`."""
        ranges = (self.settings.max_acceleration, self.settings.max_yaw_rate)
        return bind(_command_vector, lo, hi, action, team.goal, team.reference, team.reference.acceleration, *ranges)

    def control_step(self, lo: int, hi: int, team: Team) -> tuple[Call, ...]:
        """See `Interface.follow`."""
        moved = bind(track_own_state, lo, hi, team.state, team.reference, self.dt)
        flown = bind(fly_acceleration, lo, hi, team.state, team.reference, team.cable_force, team.thrust, team.gains)
        return moved, flown


class AccRatesAction(Interface):
    """Acceleration outward, sideways and upward, and roll and pitch rates; the yaw is the target's.

    The rates are those of the attitude that the acceleration asks for (Zeng et al., arXiv 2508.01522).
    """

    numbers = (
        *vector_components("m/s²", "max_acceleration", "own acceleration"),
        *rate_components("roll", "pitch", meaning="angular velocity of the attitude that this asks for,"),
    )
    supports = ("indi",)

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: Team) -> Call:
        """See `Interface.act`."""
        ranges = (self.settings.max_acceleration, self.settings.max_tilt_rate)
        return bind(_command_acc_rates, lo, hi, action, team.goal, team.reference, team.setpoint.rates, *ranges)

    def control_step(self, lo: int, hi: int, team: Team) -> tuple[Call, ...]:
        """See `Interface.follow`."""
        smoothing = (self.settings.reference_frequency, self.dt)
        rates = team.setpoint.rates
        moved = bind(track_own_state_to_yaw, lo, hi, team.state, team.reference, *smoothing)
        flown = bind(
            fly_acc_rates, lo, hi, team.state, team.reference, rates, team.cable_force, team.thrust, team.gains
        )
        return moved, flown


class CtbrAction(Interface):
    """Collective thrust and body rates; a thrust of zero is that of hovering, ± 1 the limits."""

    numbers = (
        ActionComponent("thrust", "body", "N", THRUST, "thrust of the four rotors together"),
        *rate_components("roll", "pitch"),
        *rate_components("yaw", limit="max_yaw_rate"),
    )

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: Team) -> Call:
        """See `Interface.act`."""
        ranges = (self.settings.max_tilt_rate, self.settings.max_yaw_rate)
        where = (team.state, team.reference, team.setpoint, team.cable_force)
        return bind(_command_rates, lo, hi, action, *where, team.gains, *ranges)

    def thrusts(self, team: Team) -> np.ndarray:
        """See `Interface.thrusts`."""
        return team.setpoint.thrust[..., None]

    def control_step(self, lo: int, hi: int, team: Team) -> tuple[Call, ...]:
        """See `Interface.follow`."""
        rates, total = team.setpoint.rates, team.setpoint.thrust
        return (bind(fly_rates, lo, hi, team.state, rates, total, team.cable_force, team.thrust, team.gains),)


class RotorAction(Interface):
    """Thrust of each rotor, zero: its own at hover, ± 1: its limits. Nothing else holds the attitude."""

    numbers = tuple(ActionComponent(f"rotor_{k}", "body", "N", THRUST, f"thrust of rotor {k}") for k in range(4))

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: Team) -> Call:
        """See `Interface.act`."""
        return bind(
            _command_rotors, lo, hi, action, team.state, team.reference, team.cable_force, team.thrust, team.gains
        )

    def thrusts(self, team: Team) -> np.ndarray:
        """See `Interface.thrusts`."""
        return team.thrust

    def control_step(self, lo: int, hi: int, team: Team) -> tuple[Call, ...]:
        """See `Interface.follow`."""
        return ()


@kernel
def _in_world(e, n, action, goal, full):
    """Return the first three numbers of an action, times `full`, turned from the slot frame into the world."""
    asked = (full * action[e, n, 0], full * action[e, n, 1], full * action[e, n, 2])
    return turn(goal.slot_frame[e, n, 0], goal.slot_frame[e, n, 1], asked)


@kernel
def _command_offset(lo, hi, action, goal, reference, max_offset, max_yaw):
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            put(reference.command[e, n], add(vec(goal.slots, e, n), _in_world(e, n, action, goal, max_offset)))
            reference.command_yaw[e, n] = goal.drone_yaw[e] + max_yaw * action[e, n, 3]


@kernel
def _command_vector(lo, hi, action, goal, reference, vector, largest, max_yaw_rate):
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            put(vector[e, n], _in_world(e, n, action, goal, largest))
            reference.yaw_rate[e, n] = max_yaw_rate * action[e, n, 3]


@kernel
def _command_acc_rates(lo, hi, action, goal, reference, rates, max_acceleration, max_tilt_rate):
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            put(reference.acceleration[e, n], _in_world(e, n, action, goal, max_acceleration))
            rates[e, n, 0] = max_tilt_rate * action[e, n, 3]
            rates[e, n, 1] = max_tilt_rate * action[e, n, 4]
            reference.command_yaw[e, n] = goal.drone_yaw[e]


@kernel
def _hover_thrust(e, n, cable_force, g):
    """Return the thrust [N] that carries a drone and its pull."""
    return norm(add(vec(cable_force, e, n), (0.0, 0.0, g.mass[n] * GRAVITY)))


@kernel
def _between(action, low, middle, high):
    """Return `low` for an action of -1, `middle` for 0, `high` for 1, and what lies between in proportion."""
    return middle + action * ((high - middle) if action > 0.0 else (middle - low))


@kernel
def _command_rates(lo, hi, action, state, reference, setpoint, cable_force, g, max_tilt_rate, max_yaw_rate):
    track_own_state(lo, hi, state, reference, 0.0)
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            hover = _hover_thrust(e, n, cable_force, g)
            setpoint.thrust[e, n] = _between(action[e, n, 0], 4.0 * g.thrust_min[n], hover, 4.0 * g.thrust_max[n])
            tilting = scale(max_tilt_rate, (action[e, n, 1], action[e, n, 2], 0.0))
            put(setpoint.rates[e, n], (tilting[0], tilting[1], max_yaw_rate * action[e, n, 3]))


@kernel
def _command_rotors(lo, hi, action, state, reference, cable_force, thrust, g):
    track_own_state(lo, hi, state, reference, 0.0)
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            total, yaw = _hover_thrust(e, n, cable_force, g), heading(mat(state.drone_rotation, e, n))
            rotors = (0.25 * total, 0.25 * total, 0.25 * total, 0.25 * total)
            if g.hooked:
                d, rest = (
                    drone_gains(g, n),
                    thrust_frame(add(vec(cable_force, e, n), (0.0, 0.0, g.mass[n] * GRAVITY)), yaw),
                )
                moment = hook_moment(n, rest, vec(cable_force, e, n), STILL, g)
                rotors = allocate(total, moment, d.allocation, d.thrust_min, d.thrust_max)
            for k in range(4):
                thrust[e, n, k] = _between(action[e, n, k], g.thrust_min[n], rotors[k], g.thrust_max[n])


ACTIONS: dict[str, type[Interface]] = {
    "reference": ReferenceAction,
    "velocity": VelocityAction,
    "acceleration": AccelerationAction,
    "acc_rates": AccRatesAction,
    "ctbr": CtbrAction,
    "rotor": RotorAction,
}
