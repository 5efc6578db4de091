"""The linear scripts that `search_gains.py` found for several rigs at once, of `pose_generalist` and `track_generalist`
([docs/learning.md](../docs/learning.md#several-rigs-at-once))."""

from __future__ import annotations

from typing import ClassVar

from multilift_marl.control.scripted_formation import Formation, FormationLead

Gains = tuple[tuple[str, int, int, float], ...]


class PoseRigs(Formation):
    """Of `pose_generalist`: 28 minutes from `formation_feedback`, by six of its twelve rigs in each generation, in
    turn, 6 episodes of each a candidate."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.583),
        ("payload_error_integral", 1, 1, -0.583),
        ("payload_error_integral", 2, 2, -0.671),
        ("payload_error", 0, 0, -0.137),
        ("payload_error", 1, 1, -0.137),
        ("payload_velocity", 0, 0, -0.322),
        ("payload_velocity", 1, 1, -0.322),
        ("payload_velocity", 2, 2, -0.423),
        ("tracking_error", 0, 0, -0.425),
        ("tracking_error", 1, 1, -0.425),
        ("rotation_error_integral", 1, 2, 0.515),
        ("payload_rotation_error", 1, 2, 0.306),
        ("payload_error", 2, 2, 0.021),
        ("tracking_error", 2, 2, -0.702),
        ("payload_angular_velocity", 1, 2, 0.005),
        ("rotation_error_integral", 2, 1, -0.003),
        ("payload_rotation_error", 2, 1, 0.079),
        ("payload_angular_velocity", 2, 1, -0.002),
        ("payload_rotation_error", 1, 0, 0.179),
        ("payload_angular_velocity", 1, 0, 0.021),
        ("heading", 0, 0, 0.003),
    )


class TrackRigs(FormationLead):
    """Of `track_generalist`: 28 minutes from `formation_lead`, as above."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, 0.019),
        ("payload_error_integral", 1, 1, 0.019),
        ("payload_error_integral", 2, 2, -0.193),
        ("payload_error", 0, 0, -0.147),
        ("payload_error", 1, 1, -0.147),
        ("payload_error", 2, 2, -0.161),
        ("payload_velocity", 0, 0, -0.121),
        ("payload_velocity", 1, 1, -0.121),
        ("payload_velocity", 2, 2, 0.024),
        ("tracking_error", 0, 0, 0.132),
        ("tracking_error", 1, 1, 0.132),
        ("tracking_error", 2, 2, 0.005),
        ("rotation_error_integral", 1, 2, -0.005),
        ("payload_rotation_error", 1, 2, -0.050),
        ("payload_angular_velocity", 1, 2, -0.010),
        ("rotation_error_integral", 2, 1, 0.050),
        ("payload_rotation_error", 2, 1, -0.095),
        ("payload_angular_velocity", 2, 1, -0.009),
        ("payload_rotation_error", 1, 0, 0.068),
        ("payload_angular_velocity", 1, 0, -0.001),
        ("target_velocity", 0, 0, 0.006),
        ("target_velocity", 1, 1, 0.006),
        ("target_acceleration", 0, 0, -0.000),
        ("target_acceleration", 1, 1, -0.000),
        ("target_ahead_200ms", 0, 0, -0.101),
        ("target_ahead_200ms", 1, 1, -0.101),
        ("target_ahead_400ms", 0, 0, 0.050),
        ("target_ahead_400ms", 1, 1, 0.050),
        ("heading", 0, 0, 0.007),
    )
