"""The linear scripts by accelerations and tilt rates that `search_gains.py` found, see `searched.py`."""

from __future__ import annotations

from typing import ClassVar

from multilift_marl.control.scripted_hold import HoldAccRates

Gains = tuple[tuple[str, int, int, float], ...]


class HoverAccRates(HoldAccRates):
    """Of `hover` by accelerations and tilt rates, for return: 8 minutes from `hold_acc_rates`, 48 episodes each."""

    GAINS: ClassVar[Gains] = (
        ("slot_error", 0, 0, -16.534),
        ("slot_error", 1, 1, -16.534),
        ("slot_error", 2, 2, -13.023),
        ("velocity", 0, 0, -3.835),
        ("velocity", 1, 1, -3.835),
        ("velocity", 2, 2, -4.597),
        ("payload_error_integral", 0, 0, -10.970),
        ("payload_error_integral", 1, 1, -10.970),
        ("payload_error_integral", 2, 2, -12.189),
        ("payload_error", 0, 0, 3.877),
        ("payload_error", 1, 1, 3.877),
        ("payload_error", 2, 2, 0.112),
        ("payload_velocity", 0, 0, -1.167),
        ("payload_velocity", 1, 1, -1.167),
        ("payload_velocity", 2, 2, -0.712),
        ("rotation_error_integral", 1, 2, 5.591),
        ("payload_rotation_error", 1, 2, 1.637),
        ("payload_angular_velocity", 1, 2, 0.675),
        ("rotation_error_integral", 2, 1, 1.528),
        ("payload_rotation_error", 2, 1, 4.557),
        ("payload_angular_velocity", 2, 1, 1.020),
        ("payload_rotation_error", 1, 0, -0.945),
        ("payload_angular_velocity", 1, 0, 0.169),
        ("heading", 0, 0, 2.177),
    )


class PoseTudelft(HoldAccRates):
    """Of `pose_tudelft`, without a plan: 9 minutes from `hold_acc_rates`, 64 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("slot_error", 0, 0, -12.163),
        ("slot_error", 1, 1, -12.163),
        ("slot_error", 2, 2, -14.872),
        ("velocity", 0, 0, -6.217),
        ("velocity", 1, 1, -6.217),
        ("velocity", 2, 2, -9.105),
        ("payload_error_integral", 0, 0, -5.037),
        ("payload_error_integral", 1, 1, -5.037),
        ("payload_error_integral", 2, 2, -7.434),
        ("payload_error", 0, 0, 2.999),
        ("payload_error", 1, 1, 2.999),
        ("payload_error", 2, 2, 3.231),
        ("payload_velocity", 0, 0, -1.570),
        ("payload_velocity", 1, 1, -1.570),
        ("payload_velocity", 2, 2, 0.988),
        ("rotation_error_integral", 1, 2, 0.264),
        ("payload_rotation_error", 1, 2, 0.737),
        ("payload_angular_velocity", 1, 2, -0.817),
        ("rotation_error_integral", 2, 1, -0.390),
        ("payload_rotation_error", 2, 1, -2.128),
        ("payload_angular_velocity", 2, 1, 0.512),
        ("payload_rotation_error", 1, 0, -1.249),
        ("payload_angular_velocity", 1, 0, 0.768),
        ("heading", 0, 0, -0.026),
    )


class TrackAgile(HoldAccRates):
    """Of `track` with `control.max_acceleration=12`: from `hold_acc_rates` 14 minutes at 5 m/s and 8 m/s² by 10 s,
    later than which it was unstable, 13 by whole episodes, and 11 at 2 m/s and 4 m/s²; 12 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("slot_error", 0, 0, -26.812),
        ("slot_error", 1, 1, -26.812),
        ("slot_error", 2, 2, -8.793),
        ("velocity", 0, 0, -6.465),
        ("velocity", 1, 1, -6.465),
        ("velocity", 2, 2, -7.868),
        ("payload_error_integral", 0, 0, 1.083),
        ("payload_error_integral", 1, 1, 1.083),
        ("payload_error_integral", 2, 2, -8.999),
        ("payload_error", 0, 0, -1.789),
        ("payload_error", 1, 1, -1.789),
        ("payload_error", 2, 2, -4.237),
        ("payload_velocity", 0, 0, -8.883),
        ("payload_velocity", 1, 1, -8.883),
        ("payload_velocity", 2, 2, -1.679),
        ("rotation_error_integral", 1, 2, 8.262),
        ("payload_rotation_error", 1, 2, -1.365),
        ("payload_angular_velocity", 1, 2, -0.868),
        ("rotation_error_integral", 2, 1, 12.402),
        ("payload_rotation_error", 2, 1, -7.295),
        ("payload_angular_velocity", 2, 1, 1.580),
        ("payload_rotation_error", 1, 0, -4.454),
        ("payload_angular_velocity", 1, 0, 0.840),
        ("target_velocity", 0, 0, -2.763),
        ("target_velocity", 1, 1, -2.763),
        ("target_acceleration", 0, 0, 0.788),
        ("target_acceleration", 1, 1, 0.788),
        ("target_ahead_200ms", 0, 0, -12.152),
        ("target_ahead_200ms", 1, 1, -12.152),
        ("target_ahead_400ms", 0, 0, 13.961),
        ("target_ahead_400ms", 1, 1, 13.961),
        ("heading", 0, 0, 10.142),
    )
