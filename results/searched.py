"""The best linear scripts that `search_gains.py` found for flights, by name: baselines, and scripts to learn from.

Each is a policy of one's own, `results/searched.py:HoverRealistic`. Gains are those that the search printed.
"""

from __future__ import annotations

from typing import ClassVar

from multilift_marl.control.scripted_formation import Formation
from multilift_marl.control.scripted_hold import HoldAcceleration

Gains = tuple[tuple[str, int, int, float], ...]


class HoverRealistic(Formation):
    """Of `hover_realistic` by references: 30 minutes from `formation_feedback`, 64 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.677),
        ("payload_error_integral", 1, 1, -0.677),
        ("payload_error_integral", 2, 2, -0.662),
        ("payload_error", 0, 0, -0.196),
        ("payload_error", 1, 1, -0.196),
        ("payload_error", 2, 2, -0.164),
        ("payload_velocity", 0, 0, -0.452),
        ("payload_velocity", 1, 1, -0.452),
        ("payload_velocity", 2, 2, -0.253),
        ("tracking_error", 0, 0, -0.305),
        ("tracking_error", 1, 1, -0.305),
        ("tracking_error", 2, 2, 0.402),
        ("rotation_error_integral", 1, 2, 0.738),
        ("payload_rotation_error", 1, 2, 0.264),
        ("payload_angular_velocity", 1, 2, 0.047),
        ("rotation_error_integral", 2, 1, -0.134),
        ("payload_rotation_error", 2, 1, 0.106),
        ("payload_angular_velocity", 2, 1, 0.037),
        ("payload_rotation_error", 1, 0, 0.244),
        ("payload_angular_velocity", 1, 0, -0.011),
    )


class HoverRealisticAcceleration(HoldAcceleration):
    """Of `hover_realistic` by accelerations: 14 minutes from `hold_acceleration`, 48 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("slot_error", 0, 0, -15.978),
        ("slot_error", 1, 1, -15.978),
        ("slot_error", 2, 2, -8.477),
        ("velocity", 0, 0, -5.940),
        ("velocity", 1, 1, -5.940),
        ("velocity", 2, 2, -6.152),
        ("payload_error_integral", 0, 0, -9.214),
        ("payload_error_integral", 1, 1, -9.214),
        ("payload_error_integral", 2, 2, -14.781),
        ("payload_error", 0, 0, 0.462),
        ("payload_error", 1, 1, 0.462),
        ("payload_error", 2, 2, -4.295),
        ("payload_velocity", 0, 0, -3.784),
        ("payload_velocity", 1, 1, -3.784),
        ("payload_velocity", 2, 2, -0.133),
        ("rotation_error_integral", 1, 2, 10.536),
        ("payload_rotation_error", 1, 2, 2.803),
        ("payload_angular_velocity", 1, 2, 0.547),
        ("rotation_error_integral", 2, 1, -6.161),
        ("payload_rotation_error", 2, 1, 1.176),
        ("payload_angular_velocity", 2, 1, 0.015),
        ("payload_rotation_error", 1, 0, 0.954),
        ("payload_angular_velocity", 1, 0, 0.027),
        ("heading", 0, 0, -0.814),
    )


SEARCHED: dict[str, type[Formation]] = {"hover_realistic": HoverRealistic}
"""The best one of a flight."""
