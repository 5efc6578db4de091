"""Action interfaces: what the numbers in [-1, 1] mean. One class each, all in the table at the end."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

import numpy as np

from multilift_marl._jit import bind, kernel
from multilift_marl.config.schema import ControlConfig
from multilift_marl.control.formation import Goal, Reference
from multilift_marl.math3d import add, put, turn, vec


class ReferenceAction:
    """Offset of the drone's slot in the formation about the target payload pose; zero is the scripted formation.

    Components, in the drone's slot frame (x outward from the payload, y to the left of it, z up): outward, sideways
    and upward offset, each ± control.max_offset [m], and yaw relative to the target's, ± control.max_yaw [rad].
    """

    names: ClassVar[tuple[str, ...]] = ("outward", "sideways", "up", "yaw")

    def __init__(self, control: ControlConfig):
        self.max_offset, self.max_yaw = control.max_offset, control.max_yaw

    def bind(self, lo: int, hi: int, action: np.ndarray, goal: Goal, reference: Reference) -> Callable[[], None]:
        """Return the call that writes the commands of environments lo to hi for `action` (E, N, 4) in [-1, 1]."""
        return bind(_command_offset, lo, hi, action, goal, reference, self.max_offset, self.max_yaw)


@kernel
def _command_offset(lo, hi, action, goal, reference, max_offset, max_yaw):
    for e in range(lo, hi):
        for n in range(action.shape[1]):
            c, s = goal.slot_frame[e, n, 0], goal.slot_frame[e, n, 1]
            offset = (max_offset * action[e, n, 0], max_offset * action[e, n, 1], max_offset * action[e, n, 2])
            put(reference.command[e, n], add(vec(goal.slots, e, n), turn(c, s, offset)))
            reference.command_yaw[e, n] = goal.yaw[e] + max_yaw * action[e, n, 3]


ACTIONS: dict[str, type[ReferenceAction]] = {"reference": ReferenceAction}
