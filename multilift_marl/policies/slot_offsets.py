"""Actions of `reference` that ask for places beside the drones' slots."""

from __future__ import annotations

import numpy as np

from multilift_marl.control.formation import Goal


def offset_actions(beside: np.ndarray, goal: Goal, largest: float) -> np.ndarray:
    """Return actions (E, N, 4) in [-1, 1] for offsets from the slots (E, N, 3) [m], world frame; headings as at rest.

    Args:
        beside: the offsets.
        goal: of the teams.
        largest: offset of a full action [m], `control.max_offset`.
    """
    c, s = goal.slot_frame[..., 0], goal.slot_frame[..., 1]
    x, y, z = np.moveaxis(beside, -1, 0)
    return np.clip(np.stack([c * x + s * y, c * y - s * x, z, 0.0 * z], axis=-1) / largest, -1.0, 1.0)
