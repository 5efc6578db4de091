"""The best linear scripts that `search_gains.py` found for flights, by name: baselines, and scripts to learn from.
Those by accelerations and tilt rates are in `searched_acc_rates.py`, those of paths in `searched_track.py`, those for
several rigs in `searched_rigs.py`, those of losses in `searched_loss.py`.

Each is a policy of one's own, `results/searched.py:HoverRealistic`. Gains are those that the search printed.
"""

from __future__ import annotations

from typing import Any, ClassVar

from searched_acc_rates import HoverAccRates, PoseTudelft, TrackAgile
from searched_loss import LossOnboard, LossRealistic
from searched_rigs import TrackRigs
from searched_track import TrackFollow, TrackFollowGentle, TrackRealistic, TrackRealisticFast

from multilift_marl.control.scripted_formation import Formation, FormationNarrow
from multilift_marl.control.scripted_hold import HoldCtbr

Gains = tuple[tuple[str, int, int, float], ...]


class HoverRigs(Formation):
    """Of `hover_generalist`, one for all rigs in units of the cables: 32 minutes from `formation_feedback`, in turn by
    six of the rigs and by the other six, 6 episodes of each a candidate. At 1 m it is the same in SI units."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -1.052),
        ("payload_error_integral", 1, 1, -1.052),
        ("payload_error_integral", 2, 2, -1.003),
        ("payload_error", 0, 0, -0.010),
        ("payload_error", 1, 1, -0.010),
        ("payload_error", 2, 2, -0.052),
        ("payload_velocity", 0, 0, -0.154),
        ("payload_velocity", 1, 1, -0.154),
        ("payload_velocity", 2, 2, 0.010),
        ("tracking_error", 0, 0, -0.090),
        ("tracking_error", 1, 1, -0.090),
        ("tracking_error", 2, 2, -0.318),
        ("rotation_error_integral", 1, 2, 0.679),
        ("payload_rotation_error", 1, 2, 0.207),
        ("payload_angular_velocity", 1, 2, 0.101),
        ("rotation_error_integral", 2, 1, -0.214),
        ("payload_rotation_error", 2, 1, 0.209),
        ("payload_angular_velocity", 2, 1, 0.022),
        ("payload_rotation_error", 1, 0, 0.394),
        ("payload_angular_velocity", 1, 0, -0.009),
        ("heading", 0, 0, 0.014),
    )


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


class GateRealistic(FormationNarrow):
    """Of `gate_realistic`: 11 minutes from `formation_narrow`, 40 episodes a candidate, and 25 minutes from there by
    success, 96 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("heading", 0, 0, -0.544),
        ("payload_error_integral", 0, 0, -0.338),
        ("payload_error_integral", 1, 1, -0.338),
        ("payload_error_integral", 2, 2, -0.914),
        ("payload_velocity", 0, 0, -0.418),
        ("payload_velocity", 1, 1, -0.418),
        ("payload_error", 0, 0, 0.183),
        ("payload_error", 1, 1, 0.183),
        ("payload_error", 2, 2, 0.011),
        ("payload_velocity", 2, 2, -0.107),
        ("tracking_error", 0, 0, -0.447),
        ("tracking_error", 1, 1, -0.447),
        ("tracking_error", 2, 2, -0.142),
        ("rotation_error_integral", 1, 2, 0.648),
        ("payload_rotation_error", 1, 2, 0.032),
        ("payload_angular_velocity", 1, 2, -0.032),
        ("rotation_error_integral", 2, 1, -0.495),
        ("payload_rotation_error", 2, 1, -0.037),
        ("payload_angular_velocity", 2, 1, -0.005),
        ("payload_rotation_error", 1, 0, 0.106),
        ("payload_angular_velocity", 1, 0, -0.074),
        ("target_velocity", 0, 0, -0.012),
        ("target_velocity", 1, 1, -0.012),
        ("gap", 0, 0, -0.069),
        ("gap", 1, 1, -0.069),
    )


class GateWalls(FormationNarrow):
    """Of `gate_three`: 14 minutes from `formation_narrow`, 64 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("heading", 0, 0, -0.710),
        ("payload_error_integral", 0, 0, -0.136),
        ("payload_error_integral", 1, 1, -0.136),
        ("payload_error_integral", 2, 2, -0.454),
        ("payload_velocity", 0, 0, -0.171),
        ("payload_velocity", 1, 1, -0.171),
        ("payload_error", 0, 0, 0.234),
        ("payload_error", 1, 1, 0.234),
        ("payload_error", 2, 2, -0.220),
        ("payload_velocity", 2, 2, -0.037),
        ("tracking_error", 0, 0, -0.214),
        ("tracking_error", 1, 1, -0.214),
        ("tracking_error", 2, 2, 0.323),
        ("rotation_error_integral", 1, 2, 0.010),
        ("payload_rotation_error", 1, 2, -0.061),
        ("payload_angular_velocity", 1, 2, 0.041),
        ("rotation_error_integral", 2, 1, -0.011),
        ("payload_rotation_error", 2, 1, -0.063),
        ("payload_angular_velocity", 2, 1, 0.010),
        ("payload_rotation_error", 1, 0, 0.012),
        ("payload_angular_velocity", 1, 0, -0.019),
        ("target_velocity", 0, 0, -0.027),
        ("target_velocity", 1, 1, -0.027),
        ("gap", 0, 0, -0.025),
        ("gap", 1, 1, -0.025),
    )


class GateTeams(FormationNarrow):
    """Of `gate` with 3 to 6 drones, found by hand: the formation is drawn in less than by `formation_narrow`, and each
    drone moves towards the middle of its gap by 0.8 of its distance from there, so that a ring becomes an ellipse."""

    GAINS: ClassVar[Gains] = (
        ("heading", 0, 0, -0.3),
        ("gap", 0, 0, -0.8),
        ("gap", 1, 1, -0.8),
        ("velocity", 0, 0, -0.1),
        ("velocity", 1, 1, -0.1),
        ("payload_error_integral", 0, 0, -0.5),
        ("payload_error_integral", 1, 1, -0.5),
        ("payload_error_integral", 2, 2, -0.5),
        ("payload_velocity", 0, 0, -0.3),
        ("payload_velocity", 1, 1, -0.3),
    )


class GateTeamsLarge(FormationNarrow):
    """Of `gate` with seven or eight drones: 15 minutes by success with eight, 24 episodes a candidate, from `GateTeams`
    with slots 0.5 m farther out that move by 1.8 times their distance; then 9 minutes with seven and eight, 16 of each.
    The ring becomes a long ellipse."""

    GAINS: ClassVar[Gains] = (
        ("heading", 0, 0, 0.291),
        ("gap", 0, 0, -1.904),
        ("gap", 1, 1, -1.904),
        ("velocity", 0, 0, -0.170),
        ("velocity", 1, 1, -0.170),
        ("payload_error_integral", 0, 0, -0.006),
        ("payload_error_integral", 1, 1, -0.006),
        ("payload_error_integral", 2, 2, -0.424),
        ("payload_velocity", 0, 0, -0.237),
        ("payload_velocity", 1, 1, -0.237),
        ("payload_error", 0, 0, -0.615),
        ("payload_error", 1, 1, -0.615),
        ("payload_error", 2, 2, 0.386),
        ("payload_velocity", 2, 2, 0.121),
        ("tracking_error", 0, 0, -0.379),
        ("tracking_error", 1, 1, -0.379),
        ("tracking_error", 2, 2, 0.542),
        ("rotation_error_integral", 1, 2, -0.093),
        ("payload_rotation_error", 1, 2, 0.424),
        ("payload_angular_velocity", 1, 2, 0.032),
        ("rotation_error_integral", 2, 1, 0.217),
        ("payload_rotation_error", 2, 1, -0.037),
        ("payload_angular_velocity", 2, 1, -0.012),
        ("payload_rotation_error", 1, 0, 0.314),
        ("payload_angular_velocity", 1, 0, -0.004),
        ("target_velocity", 0, 0, 0.152),
        ("target_velocity", 1, 1, 0.152),
    )


class RecoverRealistic(Formation):
    """Of `recover_realistic`: 26 minutes from `HoverRealistic`, 64 episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -1.129),
        ("payload_error_integral", 1, 1, -1.129),
        ("payload_error_integral", 2, 2, -1.061),
        ("payload_error", 0, 0, -0.360),
        ("payload_error", 1, 1, -0.360),
        ("payload_error", 2, 2, 0.010),
        ("payload_velocity", 0, 0, -0.407),
        ("payload_velocity", 1, 1, -0.407),
        ("payload_velocity", 2, 2, -0.144),
        ("tracking_error", 0, 0, -0.778),
        ("tracking_error", 1, 1, -0.778),
        ("tracking_error", 2, 2, 0.562),
        ("rotation_error_integral", 1, 2, 0.432),
        ("payload_rotation_error", 1, 2, 0.480),
        ("payload_angular_velocity", 1, 2, 0.013),
        ("rotation_error_integral", 2, 1, -0.116),
        ("payload_rotation_error", 2, 1, -0.015),
        ("payload_angular_velocity", 2, 1, 0.049),
        ("payload_rotation_error", 1, 0, -0.090),
        ("payload_angular_velocity", 1, 0, 0.043),
        ("heading", 0, 0, 0.297),
    )


class RecoverRates(HoldCtbr):
    """Of `recover_crazymarl_rates`: 8 minutes from `hold_ctbr` at 50 Hz without noise, 48 episodes a candidate, then 25
    minutes at 250 Hz with it, 64 episodes."""

    GAINS: ClassVar[Gains] = (
        ("slot_error", 0, 0, -12.368),
        ("slot_error", 1, 1, -12.368),
        ("slot_error", 2, 2, -15.821),
        ("velocity", 0, 0, -6.719),
        ("velocity", 1, 1, -6.719),
        ("velocity", 2, 2, -8.019),
        ("payload_error_integral", 0, 0, -2.598),
        ("payload_error_integral", 1, 1, -2.598),
        ("payload_error_integral", 2, 2, -13.158),
        ("payload_error", 0, 0, 7.009),
        ("payload_error", 1, 1, 7.009),
        ("payload_error", 2, 2, 0.144),
        ("payload_velocity", 0, 0, 1.815),
        ("payload_velocity", 1, 1, 1.815),
        ("payload_velocity", 2, 2, -1.551),
        ("rotation_error_integral", 1, 2, 2.919),
        ("payload_rotation_error", 1, 2, -0.251),
        ("payload_angular_velocity", 1, 2, 0.436),
        ("rotation_error_integral", 2, 1, 0.209),
        ("payload_rotation_error", 2, 1, 4.269),
        ("payload_angular_velocity", 2, 1, -0.159),
        ("payload_rotation_error", 1, 0, 1.422),
        ("payload_angular_velocity", 1, 0, 0.336),
        ("heading", 0, 0, -0.903),
    )


class RecoverRatesSuccess(HoldCtbr):
    """Of `recover_crazymarl_rates`: 20 minutes from `RecoverRates`, from which the learned teams start, by success, 96
    episodes a candidate, a spread of 0.4."""

    GAINS: ClassVar[Gains] = (
        ("slot_error", 0, 0, -13.068),
        ("slot_error", 1, 1, -13.068),
        ("slot_error", 2, 2, -9.786),
        ("velocity", 0, 0, -6.091),
        ("velocity", 1, 1, -6.091),
        ("velocity", 2, 2, -4.596),
        ("payload_error_integral", 0, 0, -3.374),
        ("payload_error_integral", 1, 1, -3.374),
        ("payload_error_integral", 2, 2, -9.021),
        ("payload_error", 0, 0, 7.180),
        ("payload_error", 1, 1, 7.180),
        ("payload_error", 2, 2, -0.539),
        ("payload_velocity", 0, 0, 1.188),
        ("payload_velocity", 1, 1, 1.188),
        ("payload_velocity", 2, 2, -2.586),
        ("rotation_error_integral", 1, 2, 5.410),
        ("payload_rotation_error", 1, 2, -0.278),
        ("payload_angular_velocity", 1, 2, 0.529),
        ("rotation_error_integral", 2, 1, -1.722),
        ("payload_rotation_error", 2, 1, 4.702),
        ("payload_angular_velocity", 2, 1, 1.245),
        ("payload_rotation_error", 1, 0, 1.609),
        ("payload_angular_velocity", 1, 0, -0.097),
        ("heading", 0, 0, -0.354),
    )


class RecoverSuccess(Formation):
    """Of `recover_realistic`: 25 minutes from `RecoverRealistic`, from which the learned teams start, by success, 96
    episodes a candidate."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -1.138),
        ("payload_error_integral", 1, 1, -1.138),
        ("payload_error_integral", 2, 2, -1.051),
        ("payload_error", 0, 0, -0.262),
        ("payload_error", 1, 1, -0.262),
        ("payload_error", 2, 2, -0.202),
        ("payload_velocity", 0, 0, -0.503),
        ("payload_velocity", 1, 1, -0.503),
        ("payload_velocity", 2, 2, -0.189),
        ("tracking_error", 0, 0, -0.673),
        ("tracking_error", 1, 1, -0.673),
        ("tracking_error", 2, 2, 0.703),
        ("rotation_error_integral", 1, 2, 0.529),
        ("payload_rotation_error", 1, 2, 0.498),
        ("payload_angular_velocity", 1, 2, 0.039),
        ("rotation_error_integral", 2, 1, 0.005),
        ("payload_rotation_error", 2, 1, -0.101),
        ("payload_angular_velocity", 2, 1, 0.070),
        ("payload_rotation_error", 1, 0, 0.022),
        ("payload_angular_velocity", 1, 0, 0.042),
        ("heading", 0, 0, 0.282),
    )


SEARCHED: dict[str, type[Formation]] = {
    "hover": HoverRigs,
    "hover_acc_rates": HoverAccRates,
    "hover_realistic": HoverRealistic,
    "pose_tudelft": PoseTudelft,
    "track_2_4": TrackAgile,
    "track_5_8": TrackAgile,
    "track_rates_2_4": TrackAgile,
    "track_rates_5_8": TrackAgile,
    "track_realistic_2_4": TrackRealistic,
    "track_realistic_5_8": TrackRealisticFast,
    "gate_realistic": GateRealistic,
    "gate_two": GateWalls,
    "gate_three": GateWalls,
    "recover_realistic": RecoverSuccess,
    "loss": LossRealistic,
    "loss_snap": LossRealistic,
    "loss_realistic": LossRealistic,
    "loss_onboard": LossOnboard,
    "recover_crazymarl_rates": RecoverRatesSuccess,
    "track_generalist": TrackRigs,
    "track_follow_2_2": TrackFollowGentle,
    "track_follow_2_4": TrackFollow,
}
"""The best one of a flight."""
SCALES: dict[str, dict[str, float]] = {
    "track_2_4": {"control.max_acceleration": 12.0},
    "track_5_8": {"control.max_acceleration": 12.0},
}
"""Full scales of its actions, where they are not those of the flight [m/s²]."""


def settings_of(flight: str) -> dict[str, Any]:
    """Return the keys of the best script of a flight: by what it acts, and full scales."""
    return {"control.action": SEARCHED[flight].INTERFACE} | SCALES.get(flight, {})
