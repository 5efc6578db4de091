"""What an action interface is: its numbers, the frames that they are in, and what it reads and writes.

An interface turns actions into set-points once for each policy step (`set_action`), and set-points into rotor thrusts
at the control rate (`control_step`). Vectors are given in the drone's slot frame (x outward from the payload, y to the
left of it, z up), body rates in the slot body frame: the body's, turned about its z axis so that x points outward. So a
number means the same to all drones, which share a network. Zero hovers as well as the interface can. The interfaces are
in `actions.py`.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cos, sin
from typing import ClassVar, NamedTuple

import numpy as np

from multilift_marl.control.formation import Goal, Reference
from multilift_marl.control.gains import Gains
from multilift_marl.control.geometric import fly
from multilift_marl.control.obstacle_margin import Surroundings
from multilift_marl.control.setpoints import Setpoint
from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.math3d import turn
from multilift_marl.schema.control import ControlConfig
from multilift_marl.sim.state import SystemState

Call = Callable[[], None]


class ActionComponent(NamedTuple):
    """One number of an action, in [-1, 1]."""

    name: str
    frame: str
    unit: str
    limit: str
    """Key of `control` with what 1 stands for, -1 for its opposite, of FACTOR for its inverse; THRUST, see there."""
    meaning: str


FACTOR = "max_weight"
"""The limit of factors: a number is the power of it by which something is multiplied, which 0 leaves as it is."""
THRUST = ""
"""The limit of thrusts, each drone's own: -1 is the least that rotors can give, 0 the one at rest, 1 the largest."""


def vector_components(unit: str, limit: str, meaning: str, prefix: str = "") -> tuple[ActionComponent, ...]:
    """Return the three numbers of a vector in the slot frame; `meaning` says of what, `prefix` begins their names."""
    return tuple(
        ActionComponent(prefix + name, "slot", unit, limit, f"{meaning}, {where}")
        for name, where in (("outward", "away from the payload"), ("sideways", "to the left of that"), ("up", "upward"))
    )


AXES = "about the axis that points outward", "about that to its left", "about body z"


def tilt_rate_components(meaning: str) -> tuple[ActionComponent, ...]:
    """Return the body rates that tilt a drone; `meaning` says of what."""
    names = ("outward_rate", "sideways_rate")
    return tuple(
        ActionComponent(name, "slot body", "rad/s", "max_tilt_rate", f"{meaning} {axis}")
        for name, axis in zip(names, AXES[:2], strict=True)
    )


def moment_component(name: str, axis: str) -> ActionComponent:
    """Return the moment about one of `AXES`, as the angular acceleration that it causes."""
    full = "max_angular_acceleration"
    return ActionComponent(f"{name}_moment", "slot body", "rad/s²", full, f"angular acceleration {axis}")


YAW_RATE = ActionComponent("yaw_rate", "world", "rad/s", "max_yaw_rate", "change of the heading, about the vertical")


class ControlContext(NamedTuple):
    """What an interface reads and writes."""

    state: SystemState
    goal: Goal
    reference: Reference
    setpoint: Setpoint
    cable_force: np.ndarray
    """(E, N, 3) force of the drones on their cables, any rejected disturbance included [N]."""
    thrust: np.ndarray
    """(E, N, 4) rotor thrusts, written [N]."""
    gains: Gains
    around: Surroundings | None = None
    """What drones know of it; None: no set-point is moved by it."""


class Interface:
    """An action interface.

    Class attributes:
        numbers: of an action, each with its frame, unit and full scale.
        by_rates: whether actions are about body rates: drones observe their own in the slot body frame, too.
        commands_force: whether it writes the force on each cable that is fed forward, `Setpoint.cable_force`, which is
            the formation's otherwise.
        supports: values of `control.disturbance` that go with it, beside "none".
    """

    numbers: ClassVar[tuple[ActionComponent, ...]]
    by_rates: ClassVar[bool] = False
    commands_force: ClassVar[bool] = False
    supports: ClassVar[tuple[str, ...]] = ()

    def __init__(self, settings: ControlConfig, dt: float):
        self.settings = settings
        self.dt = dt

    def set_action(self, lo: int, hi: int, action: np.ndarray, team: ControlContext) -> Call:
        """Return the call that turns `action` (E, N, A) in [-1, 1] of environments lo to hi into set-points."""
        raise NotImplementedError

    def control_step(self, lo: int, hi: int, team: ControlContext) -> tuple[Call, ...]:
        """Return what is called in turn at every control step, the last of them for the thrusts."""
        return (bind(fly, lo, hi, team.state, team.reference, team.cable_force, team.thrust, team.gains, None),)

    def control_step_moving_goal(
        self, lo: int, hi: int, plan: Call, set_action: Call, team: ControlContext
    ) -> tuple[Call, ...]:
        """Return the same as `control_step` for goals that move, by calling `plan`, at every control step."""
        return plan, *self.control_step(lo, hi, team)

    def thrusts(self, team: ControlContext) -> np.ndarray:
        """Return the thrusts (E, N, K) [N] that the last action set itself, K of its numbers."""
        return team.thrust[..., :0]


@kernel
def in_world(e, n, action, goal, full):
    """Return the first three numbers of an action, times `full`, turned from the slot frame into the world."""
    commanded = (full * action[e, n, 0], full * action[e, n, 1], full * action[e, n, 2])
    return turn(goal.slot_frame[e, n, 0], goal.slot_frame[e, n, 1], commanded)


@kernel
def from_slot_body(vector, yaw, slot_frame):
    """Return a vector of the slot body frame in the body frame of a drone with heading `yaw` [rad]."""
    c, s = cos(yaw), sin(yaw)
    along, across = slot_frame[0], slot_frame[1]  # cosine and sine of the slot's heading
    return turn(c * along + s * across, c * across - s * along, vector)


@kernel
def to_slot_body(vector, yaw, slot_frame):
    """Return a vector of the body frame of a drone with heading `yaw` [rad] in the slot body frame."""
    c, s = cos(yaw), sin(yaw)
    along, across = slot_frame[0], slot_frame[1]
    return turn(c * along + s * across, s * along - c * across, vector)
