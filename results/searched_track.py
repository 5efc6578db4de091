"""The linear scripts of `track` by references that `search_gains.py` found, see `searched.py`."""

from __future__ import annotations

from typing import ClassVar

from multilift_marl.control.scripted_formation import Formation

Gains = tuple[tuple[str, int, int, float], ...]


class TrackRealistic(Formation):
    """Of `track_realistic` at 2 m/s and 4 m/s²: three quarters of what a search of 12 minutes from `TrackFollow` found
    there, which lost one payload of 100, and a quarter of `TrackRealisticFast`."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.494),
        ("payload_error_integral", 1, 1, -0.494),
        ("payload_error_integral", 2, 2, -0.906),
        ("payload_error", 0, 0, -0.572),
        ("payload_error", 1, 1, -0.572),
        ("payload_velocity", 0, 0, -0.452),
        ("payload_velocity", 1, 1, -0.452),
        ("payload_velocity", 2, 2, -0.160),
        ("tracking_error", 0, 0, -0.189),
        ("tracking_error", 1, 1, -0.189),
        ("rotation_error_integral", 1, 2, 0.822),
        ("payload_rotation_error", 1, 2, 0.205),
        ("payload_error", 2, 2, -0.088),
        ("tracking_error", 2, 2, 0.176),
        ("payload_angular_velocity", 1, 2, 0.036),
        ("rotation_error_integral", 2, 1, 0.267),
        ("payload_rotation_error", 2, 1, -0.142),
        ("payload_angular_velocity", 2, 1, 0.066),
        ("payload_rotation_error", 1, 0, -0.069),
        ("payload_angular_velocity", 1, 0, 0.035),
        ("target_velocity", 0, 0, -0.045),
        ("target_velocity", 1, 1, -0.045),
        ("target_acceleration", 0, 0, 0.008),
        ("target_acceleration", 1, 1, 0.008),
        ("heading", 0, 0, 0.393),
    )


class TrackFollow(Formation):
    """Of `track_follow` at 2 m/s and 4 m/s²: 20 minutes from `formation_feedback`, 32 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.300),
        ("payload_error_integral", 1, 1, -0.300),
        ("payload_error_integral", 2, 2, -0.834),
        ("payload_error", 0, 0, -0.482),
        ("payload_error", 1, 1, -0.482),
        ("payload_velocity", 0, 0, -0.755),
        ("payload_velocity", 1, 1, -0.755),
        ("payload_velocity", 2, 2, -0.094),
        ("tracking_error", 0, 0, -0.618),
        ("tracking_error", 1, 1, -0.618),
        ("rotation_error_integral", 1, 2, 0.745),
        ("payload_rotation_error", 1, 2, 0.209),
        ("payload_error", 2, 2, -0.019),
        ("tracking_error", 2, 2, 0.279),
        ("payload_angular_velocity", 1, 2, 0.034),
        ("rotation_error_integral", 2, 1, 0.083),
        ("payload_rotation_error", 2, 1, -0.155),
        ("payload_angular_velocity", 2, 1, 0.046),
        ("payload_rotation_error", 1, 0, -0.010),
        ("payload_angular_velocity", 1, 0, 0.074),
        ("target_velocity", 0, 0, -0.052),
        ("target_velocity", 1, 1, -0.052),
        ("target_acceleration", 0, 0, 0.014),
        ("target_acceleration", 1, 1, 0.014),
        ("heading", 0, 0, 0.388),
    )


class TrackFollowGentle(Formation):
    """The same at 2 m/s and 2 m/s²: 6 minutes from `TrackFollow`."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.310),
        ("payload_error_integral", 1, 1, -0.310),
        ("payload_error_integral", 2, 2, -0.929),
        ("payload_error", 0, 0, -0.489),
        ("payload_error", 1, 1, -0.489),
        ("payload_velocity", 0, 0, -0.733),
        ("payload_velocity", 1, 1, -0.733),
        ("payload_velocity", 2, 2, -0.067),
        ("tracking_error", 0, 0, -0.719),
        ("tracking_error", 1, 1, -0.719),
        ("rotation_error_integral", 1, 2, 0.805),
        ("payload_rotation_error", 1, 2, 0.199),
        ("payload_error", 2, 2, -0.003),
        ("tracking_error", 2, 2, 0.155),
        ("payload_angular_velocity", 1, 2, 0.044),
        ("rotation_error_integral", 2, 1, -0.040),
        ("payload_rotation_error", 2, 1, -0.233),
        ("payload_angular_velocity", 2, 1, 0.049),
        ("payload_rotation_error", 1, 0, -0.069),
        ("payload_angular_velocity", 1, 0, 0.068),
        ("target_velocity", 0, 0, -0.017),
        ("target_velocity", 1, 1, -0.017),
        ("target_acceleration", 0, 0, 0.019),
        ("target_acceleration", 1, 1, 0.019),
        ("heading", 0, 0, 0.398),
    )


class TrackRealisticFast(Formation):
    """The same at 5 m/s and 8 m/s²: 7 minutes from what was found at 2 m/s and 4 m/s²."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.637),
        ("payload_error_integral", 1, 1, -0.637),
        ("payload_error_integral", 2, 2, -0.834),
        ("payload_error", 0, 0, -0.427),
        ("payload_error", 1, 1, -0.427),
        ("payload_velocity", 0, 0, -0.337),
        ("payload_velocity", 1, 1, -0.337),
        ("payload_velocity", 2, 2, -0.198),
        ("tracking_error", 0, 0, 0.029),
        ("tracking_error", 1, 1, 0.029),
        ("rotation_error_integral", 1, 2, 0.999),
        ("payload_rotation_error", 1, 2, 0.277),
        ("payload_error", 2, 2, -0.080),
        ("tracking_error", 2, 2, 0.328),
        ("payload_angular_velocity", 1, 2, 0.010),
        ("rotation_error_integral", 2, 1, 0.376),
        ("payload_rotation_error", 2, 1, -0.238),
        ("payload_angular_velocity", 2, 1, 0.078),
        ("payload_rotation_error", 1, 0, -0.053),
        ("payload_angular_velocity", 1, 0, 0.020),
        ("target_velocity", 0, 0, -0.065),
        ("target_velocity", 1, 1, -0.065),
        ("target_acceleration", 0, 0, 0.022),
        ("target_acceleration", 1, 1, 0.022),
        ("heading", 0, 0, 0.298),
    )
