"""The best linear scripts that `search_gains.py` found for the loss of a drone; see `searched.py`."""

from __future__ import annotations

from typing import ClassVar

from multilift_marl.control.scripted_formation import FormationRedistributed

Gains = tuple[tuple[str, int, int, float], ...]


class LossRealistic(FormationRedistributed):
    """Of `loss_realistic`, and the best of `loss` and `loss_snap`: three searches of 30 minutes in all from
    `formation_redistributed` by success, 96 episodes a candidate. What gains most: the slots are 0.66 m farther out
    from the start."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.820),
        ("payload_error_integral", 1, 1, -0.820),
        ("payload_error_integral", 2, 2, -0.610),
        ("planned_offset", 0, 0, 0.961),
        ("planned_offset", 1, 1, 0.961),
        ("planned_offset", 2, 2, 0.961),
        ("payload_error", 0, 0, 0.187),
        ("payload_error", 1, 1, 0.187),
        ("payload_error", 2, 2, -0.122),
        ("payload_velocity", 0, 0, -0.161),
        ("payload_velocity", 1, 1, -0.161),
        ("payload_velocity", 2, 2, 0.106),
        ("tracking_error", 0, 0, -0.142),
        ("tracking_error", 1, 1, -0.142),
        ("tracking_error", 2, 2, 0.509),
        ("rotation_error_integral", 1, 2, 0.049),
        ("payload_rotation_error", 1, 2, -0.135),
        ("payload_angular_velocity", 1, 2, -0.082),
        ("rotation_error_integral", 2, 1, 0.256),
        ("payload_rotation_error", 2, 1, -0.466),
        ("payload_angular_velocity", 2, 1, 0.035),
        ("payload_rotation_error", 1, 0, 0.124),
        ("payload_angular_velocity", 1, 0, -0.017),
        ("heading", 0, 0, 0.663),
        ("lost_direction", 0, 0, 0.167),
        ("lost_direction", 1, 1, 0.167),
        ("team_lost", 0, 2, -0.042),
    )


class LossOnboard(FormationRedistributed):
    """Of `loss` by onboard sensors alone: a search of 25 minutes from `LossRealistic` by success, 96 episodes each,
    where a loss is announced. What gains most: nothing of what each drone takes for the payload's velocity."""

    GAINS: ClassVar[Gains] = (
        ("payload_error_integral", 0, 0, -0.399),
        ("payload_error_integral", 1, 1, -0.399),
        ("payload_error_integral", 2, 2, -0.626),
        ("planned_offset", 0, 0, 0.807),
        ("planned_offset", 1, 1, 0.807),
        ("planned_offset", 2, 2, 0.793),
        ("payload_error", 0, 0, 0.101),
        ("payload_error", 1, 1, 0.101),
        ("payload_error", 2, 2, 0.043),
        ("payload_velocity", 0, 0, 0.004),
        ("payload_velocity", 1, 1, 0.004),
        ("payload_velocity", 2, 2, -0.031),
        ("tracking_error", 0, 0, 0.028),
        ("tracking_error", 1, 1, 0.028),
        ("tracking_error", 2, 2, 0.678),
        ("rotation_error_integral", 1, 2, 0.205),
        ("payload_rotation_error", 1, 2, -0.128),
        ("payload_angular_velocity", 1, 2, -0.077),
        ("rotation_error_integral", 2, 1, 0.157),
        ("payload_rotation_error", 2, 1, -0.514),
        ("payload_angular_velocity", 2, 1, 0.071),
        ("payload_rotation_error", 1, 0, 0.226),
        ("payload_angular_velocity", 1, 0, -0.003),
        ("heading", 0, 0, 0.763),
        ("lost_direction", 0, 0, 0.197),
        ("lost_direction", 1, 1, 0.197),
        ("team_lost", 0, 2, 0.081),
        ("velocity", 0, 0, -0.139),
        ("velocity", 1, 1, -0.139),
    )
