"""Baselines that move the slots of a formation, by the `reference` interface: linear maps of the observation."""

from __future__ import annotations

from math import cos, radians
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.payload import per_drone

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

INTEGRAL_GAIN = 0.5  # [1/s]
PLANNED = {  # of what is observed, the planned value, where a task has one
    "payload_error": ("planned_position",),
    "payload_velocity": ("planned_velocity", "target_velocity"),
    "payload_rotation_error": ("planned_rotation",),
}
LEAD_TIME = 0.4  # [s] that a payload's acceleration follows a moved slot: the lags of reference and drone
LEAD_GAIN = 0.87  # [-] of h a / g; the RMSE of `track` is least at 0.81 for the curve (2, 2), at 1 for (2, 4)
NARROWING = 0.7  # [m] inward from the slots; 0.5 to 0.7 m pass a gap of 1 m, at 0.8 m drones collide

Gains = tuple[tuple[str, int, int, float], ...]


class Formation:
    """Every drone holds its slot about the target payload pose: the zero action of the `reference` interface.

    Args:
        vec: environments with the interface `INTERFACE`.

    Class attributes:
        INTERFACE: by which it acts.
        GAINS: how a policy based on this one moves the slots: what is observed, its axis in the slot frame, the axis of
            the slot's offset, and metres for each unit.
        NEEDS: observations without which the policy cannot act.
        REFUSAL: what is said where they are missing in {task}.

    Raises:
        ConfigError: the environments do not observe what the policy needs; see `refusal`.
    """

    INTERFACE: ClassVar[str] = "reference"
    GAINS: ClassVar[Gains] = ()
    NEEDS: ClassVar[tuple[str, ...]] = ()
    REFUSAL: ClassVar[str] = ""

    def __init__(self, vec: MultiliftVec):
        if refusal := self.refusal(vec):
            raise ConfigError(refusal)
        self._names, self._actions = vec.observation_names, vec.action_names
        self._max_offset = vec.config.control.max_offset
        self._matrix = self.matrix()

    def matrix(self) -> np.ndarray:
        """Return M (A, D) float32 with which the action is M times the observation, clipped to [-1, 1]."""
        matrix = np.zeros((len(self._actions), len(self._names)), np.float32)
        for name, axis, moved, gain in self.GAINS:
            matrix[moved, self._names.index(f"{name}_{axis}")] += gain / self._max_offset
            # The error from the plan: gain · (observed - planned), both from the goal.
            for planned in PLANNED.get(name, ()):
                if f"{planned}_{axis}" in self._names:
                    matrix[moved, self._names.index(f"{planned}_{axis}")] -= gain / self._max_offset
        return matrix

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., N, A) float32 in [-1, 1] for observations (..., N, D)."""
        # No `@`: BLAS rounds a row in other ways where there are more of them.
        return np.clip(np.einsum("...d,ad->...a", np.asarray(observation, np.float32), self._matrix), -1, 1)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget nothing: the integral is part of the observation."""

    @classmethod
    def refusal(cls, vec: MultiliftVec) -> str:
        """Return why the policy cannot act in the environments; "" if it can."""
        known = all(name in vec.observation_names for name in cls.NEEDS)
        return "" if known else cls.REFUSAL.format(task=vec.config.task)


class FormationIntegral(Formation):
    """The formation with its slots moved against the clipped integral of the payload's position error.

    By -k ∫ e dt [m], k = 0.5 1/s, along each axis of a drone's slot frame; a full action is `control.max_offset`.
    """

    GAINS = tuple(("payload_error_integral", axis, axis, -INTEGRAL_GAIN) for axis in range(3))


class FormationFeedback(Formation):
    """The formation with its slots moved by linear feedback of what a drone observes.

    Level, against the payload's error from where it should be by now, the integral of that and its velocity, and
    against the drone's own distance from its reference, which shows the wind's force before the payload moves; up
    and down also so that the payload turns back to its target attitude.
    """

    GAINS = (
        ("payload_error_integral", 0, 0, -0.55),
        ("payload_error_integral", 1, 1, -0.55),
        ("payload_error_integral", 2, 2, -0.5),
        ("payload_error", 0, 0, -0.15),
        ("payload_error", 1, 1, -0.15),
        ("payload_velocity", 0, 0, -0.4),
        ("payload_velocity", 1, 1, -0.4),
        ("payload_velocity", 2, 2, -0.25),
        ("tracking_error", 0, 0, -0.45),
        ("tracking_error", 1, 1, -0.45),
        ("rotation_error_integral", 1, 2, 0.55),
        ("payload_rotation_error", 1, 2, 0.2),
    )


class FormationGusts(Formation):
    """The formation with its slots moved by linear feedback that holds tilted payloads in turbulent wind.

    Against the payload's position and level velocity more than by `FormationFeedback`, against the drone's own lag and
    the integral of the payload's tilt less; drones also move along the tangent at their slot, against the payload's
    turning about the vertical, and outward where it tilts towards them. The gains are rounded from a search like that
    of `results/search_gains.py` for `configs/pose_wind.yaml`.
    """

    GAINS = (
        ("payload_error_integral", 0, 0, -0.57),
        ("payload_error_integral", 1, 1, -0.57),
        ("payload_error_integral", 2, 2, -0.74),
        ("payload_error", 0, 0, -0.5),
        ("payload_error", 1, 1, -0.5),
        ("payload_error", 2, 2, -0.54),
        ("payload_velocity", 0, 0, -0.54),
        ("payload_velocity", 1, 1, -0.54),
        ("payload_velocity", 2, 2, -0.22),
        ("tracking_error", 0, 0, -0.12),
        ("tracking_error", 1, 1, -0.12),
        ("rotation_error_integral", 1, 2, 0.16),
        ("payload_rotation_error", 1, 2, 0.34),
        ("payload_angular_velocity", 1, 2, 0.03),
        ("rotation_error_integral", 2, 1, -0.73),
        ("payload_rotation_error", 2, 1, 0.09),
        ("payload_angular_velocity", 2, 1, 0.02),
        ("payload_rotation_error", 1, 0, 0.27),
        ("payload_angular_velocity", 1, 0, 0.05),
    )


class FormationLead(Formation):
    """The formation displaced by what the payload's acceleration to come asks of its cables.

    Their forces lie along gravity and acceleration together (the payload's flatness, Sreenath and Kumar 2013), so that
    drones are h a / g ahead of their slots with h the height of the formation's cables; a is that of `LEAD_TIME` ahead,
    from the observed places that the target will pass.
    """

    AHEAD = tuple(f"target_ahead_{round(1000 * share * LEAD_TIME)}ms" for share in (1, 2))
    NEEDS = tuple(f"{name}_0" for name in AHEAD)
    REFUSAL = (
        "formation_lead needs to observe where the target will go, and task {task} has no such part; take formation"
    )

    def __init__(self, vec: MultiliftVec):
        lengths = vec.world.system.cable_length
        length = float(np.mean(lengths)) if vec.config.env.units == "si" else 1.0
        upright = [cos(radians(angle)) for angle in per_drone(vec.config.cable.angle, len(lengths), "cable.angle")]
        longer = lengths / lengths.sum()  # each cable's share of all, by which it counts
        self._height = length * (upright[0] + float(longer @ (np.array(upright) - upright[0])))
        super().__init__(vec)

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        matrix = super().matrix()
        # h a/g with a = (x(2 T) - 2 x(T) + x(0))/T²; x(0), the target itself, is 0 in what is observed.
        gain = LEAD_GAIN * self._height / GRAVITY / LEAD_TIME**2 / self._max_offset
        for axis in range(2):
            for name, weight in zip(self.AHEAD, (-2, 1), strict=True):  # a second difference
                matrix[axis, self._names.index(f"{name}_{axis}")] += weight * gain
        return matrix


class FormationNarrow(Formation):
    """The formation drawn in by a constant, so that it passes a gap, with integral and velocity feedback.

    The constant is `NARROWING` times the cosine of the drone's own heading, which is 1 but for the noise. Velocity
    counts relative to the target's.
    """

    GAINS = (
        ("heading", 0, 0, -NARROWING),
        *FormationIntegral.GAINS,
        ("payload_velocity", 0, 0, -0.3),
        ("payload_velocity", 1, 1, -0.3),
    )
    NEEDS = ("clearance_0",)
    REFUSAL = "formation_narrow is for gaps, and task {task} has none; take formation_feedback"


class FormationRedistributed(FormationIntegral):
    """The formation with its integral; after a loss, the slots give way, then go where the others hold the payload.

    Where that is, the task computes by statics and lets the drones observe; see `control/redistribution.py`.
    """

    GAINS = (*FormationIntegral.GAINS, *(("planned_offset", axis, axis, 1.0) for axis in range(3)))
    NEEDS = ("planned_offset_0",)
    REFUSAL = "formation_redistributed is for the loss of a drone, and task {task} has none; take formation_integral"
