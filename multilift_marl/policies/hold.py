"""Baselines for the action interfaces other than `reference`: `hold_<interface>`.

One linear PD law with an integral for the acceleration of each drone, converted to each interface; `full_state`, whose
slots the controller holds, needs the integral alone. All are linear maps of the observation, so that a learned policy
can start from them (`train.residual`) and gains can be tuned by CMA-ES (`results/search_gains.py`). Conversions are
those of the first vehicle where a team has several.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.config.units import unit_size
from multilift_marl.physical import GRAVITY
from multilift_marl.policies.formation import PLANNED, Formation, FormationIntegral

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

YAW_GAIN = 2.0  # [1/s] of the heading
STIFFNESS, DAMPING = 16.0, 8.0  # [1/s²], [1/s] of a drone about its slot: 4 rad/s, critically damped
OWN_PLANNED = {"slot_error": ("planned_position",), "velocity": ("planned_velocity", "target_velocity")}
INTEGRAL = 8.0  # [1/s³] of the payload's error: what `formation_integral` does to a slot, times the stiffness


class HoldAcceleration(Formation):
    """Every drone is drawn to its slot, and against the integral of the payload's error.

    Class attributes:
        GAINS: what is observed, its axis in the slot frame, the axis of the acceleration, m/s² for each unit.
    """

    INTERFACE: ClassVar[str] = "acceleration"
    GAINS: ClassVar[tuple[tuple[str, int, int, float], ...]] = tuple(
        (name, axis, axis, -gain)
        for name, gain in (("slot_error", STIFFNESS), ("velocity", DAMPING), ("payload_error_integral", INTEGRAL))
        for axis in range(3)
    )
    REFUSAL = ""

    def __init__(self, vec: MultiliftVec):
        self._vec = vec
        super().__init__(vec)

    def law(self) -> np.ndarray:
        """Return L (3, D) with which the acceleration [m/s²] is L times the observation."""
        law = np.zeros((3, len(self._names)), np.float32)
        for name, axis, moved, gain in self.GAINS:
            law[moved, self._column(name, axis)] += gain
            for column in self._planned(name, axis):
                law[moved, column] -= gain
        return law

    def _planned(self, name: str, axis: int) -> list[int]:
        """Return where the planned value of what is observed stands, where a task has one."""
        names = (f"{planned}_{axis}" for planned in (*PLANNED.get(name, ()), *OWN_PLANNED.get(name, ())))
        return [self._names.index(planned) for planned in names if planned in self._names]

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        control = self._vec.config.control
        matrix = np.zeros((len(self._actions), len(self._names)), np.float32)
        matrix[:3] = self.law() / control.max_acceleration
        matrix[3] = self._turn_back() / control.max_yaw_rate
        return matrix

    def _column(self, name: str, axis: int) -> int:
        return self._names.index(f"{name}_{axis}")

    def _turn_back(self) -> np.ndarray:
        """Return the map (D,) of the observation to the yaw rate that turns a drone to the target's heading [rad/s]."""
        row = np.zeros(len(self._names), np.float32)
        row[self._column("heading", 1)] = -YAW_GAIN
        return row


class HoldVelocity(HoldAcceleration):
    """The same law by velocities: those whose error, times the law's damping, is its acceleration."""

    INTERFACE = "velocity"

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        control, law = self._vec.config.control, self.law()
        matrix = np.zeros((len(self._actions), len(self._names)), np.float32)
        for axis in range(3):
            column = self._column("velocity", axis)
            # The law's a = ... - d v is d (v_wanted - v): the rest of the law over d is the velocity that is wanted.
            damping = max(-law[axis, column], 1e-3)
            law[axis, column] = 0.0
            matrix[axis] = law[axis] / damping / control.max_velocity
        matrix[3] = self._turn_back() / control.max_yaw_rate
        return matrix


class HoldAccRates(HoldAcceleration):
    """The same law, with the tilt rates that follow from it while the drone moves at its velocity."""

    INTERFACE = "acc_rates"

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        control, law = self._vec.config.control, self.law()
        matrix = np.zeros((len(self._actions), len(self._names)), np.float32)
        matrix[:3] = law / control.max_acceleration

        # The slot error changes by the velocity beside the slot's, and the tilt by jerk / g: outward about the sideways
        # axis.
        for axis, rate, sign in ((0, 4, 1.0), (1, 3, -1.0)):
            # ȧ = (∂a/∂slot error) · velocity; a tilt rate Ω about y gives g Ω along x, one about x gives -g Ω along y.
            gain = sign * law[axis, self._column("slot_error", axis)] / GRAVITY / control.max_tilt_rate
            matrix[rate, self._column("velocity", axis)] += gain
            for column in self._planned("velocity", axis):
                matrix[rate, column] -= gain
        return matrix


class HoldFullState(FormationIntegral):
    """Slots that the controller holds, moved against the integral of the payload's error."""

    INTERFACE = "full_state"


class HoldCtbr(HoldAcceleration):
    """The same law by thrust and body rates: tilts lead to level accelerations, thrust to the vertical one."""

    INTERFACE = "ctbr"
    TILT_GAIN: ClassVar[float] = 8.0  # [1/s] of a tilt from the desired one; rate loops are faster

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        control, law = self._vec.config.control, self.law()
        matrix = np.zeros((len(self._actions), len(self._names)), np.float32)
        gains = self._vec.controller.gains
        # The load follows its drone: both are accelerated.
        mass = float(np.mean(gains.mass + gains.load_share))
        force, hover = self._force_at_rest(), self._hover_thrust()

        # More or less thrust than at rest, by the range above it; that below is about as large.
        matrix[0] = law[2] * mass / (4 * float(np.min(gains.thrust_max)) - hover)

        # A tilt from that at rest gives g times as much acceleration of drone and load.
        lean = float(np.hypot(*force[:2])) / hover
        for axis, rate, sign in ((0, 2, 1.0), (1, 1, -1.0)):
            # The level part of the thrust axis that gives the acceleration: force over hover thrust.
            wanted = law[axis] * mass / hover
            wanted[self._column("thrust_axis", axis)] -= 1.0
            if axis == 0:
                wanted[self._column("heading", 0)] += lean  # the cosine of a small heading stands for 1
            matrix[rate] = sign * self.TILT_GAIN * wanted / control.max_tilt_rate
        matrix[3] = self._turn_back() / control.max_yaw_rate
        return matrix

    def _force_at_rest(self) -> np.ndarray:
        """Return what the first drone's rotors exert at rest, in the frame of a level payload (3,) [N]."""
        weight = float(self._vec.controller.gains.mass[0]) * GRAVITY
        return self._vec.world.system.hook_force[0] + np.array([0.0, 0.0, weight])

    def _hover_thrust(self) -> float:
        return float(np.linalg.norm(self._force_at_rest()))


class HoldCtbm(HoldCtbr):
    """The same law by thrust and moments: those that turn a drone at the body rates of `hold_ctbr`."""

    INTERFACE = "ctbm"
    TILT_GAIN = 9.0
    RATE_GAIN: ClassVar[float] = 45.0  # [1/s] of a body rate from the desired one
    YAW_RATE_GAIN: ClassVar[float] = 15.0  # [1/s] rotors that change speed turn the drone at once: more oscillates
    RATES: ClassVar[str] = "turned_rates"

    @classmethod
    def refusal(cls, vec: MultiliftVec) -> str:
        """See `Formation.refusal`; a policy step must not turn a rate back by more than all of it."""
        config, gain = vec.config, cls.RATE_GAIN
        if config.env.units == "cable":
            gain *= unit_size("rad/s", config.system)
        if gain > config.env.policy_hz:
            return (
                f"baseline hold_{cls.INTERFACE} holds the attitude by itself, and "
                f"env.policy_hz={config.env.policy_hz:g} is too slow for that; raise it to {gain:.3g} or more"
            )
        return super().refusal(vec)

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        control, matrix = self._vec.config.control, super().matrix()
        full = (control.max_tilt_rate, control.max_tilt_rate, control.max_yaw_rate)
        for axis, gain in enumerate((self.RATE_GAIN, self.RATE_GAIN, self.YAW_RATE_GAIN)):
            matrix[1 + axis] *= full[axis]
            matrix[1 + axis, self._column(self.RATES, axis)] -= 1.0
            matrix[1 + axis] *= gain / control.max_angular_acceleration
        return matrix


class HoldRotor(HoldCtbm):
    """The same law by the rotors' thrusts: those that exert the thrust and the moments of `hold_ctbm`.

    An action above zero has another range than one below it. Moments, for which some rotors do more and others less,
    are divided by the mean of both, the thrust by that above.
    """

    INTERFACE = "rotor"
    RATES = "body_rates"

    @classmethod
    def refusal(cls, vec: MultiliftVec) -> str:
        """See `Formation.refusal`."""
        if vec.config.control.heading != "outward":
            return (
                "baseline hold_rotor is one map for all drones, whose rotors must be in the same places about their "
                "slots; set control.heading=outward"
            )
        return super().refusal(vec)

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        # Rows of `wrench`: thrust over its range, angular accelerations over theirs; the latter times J are moments.
        gains, wrench = self._vec.controller.gains, super().matrix()
        inverse, range_ = gains.allocation[0], (gains.thrust_max[0] - gains.thrust_min[0]) / 2
        moments = self._vec.config.acting.max_angular_acceleration * gains.inertia[0][:, None] * wrench[1:]
        matrix = np.outer(4 * inverse[:, 0], wrench[0]) + inverse[:, 1:] @ moments / range_
        return matrix.astype(np.float32)
