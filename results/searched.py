"""The CMA-ES-tuned linear policy of each flight of the tables; gains are in `multilift_marl/policies/gains`.

Each is a policy of one's own, too: `results/searched.py:HoverRealistic`.
"""

from __future__ import annotations

from typing import Any

from multilift_marl.policies.formation import Formation
from multilift_marl.policies.tuned import __getattr__ as __getattr__  # classes by the names of files of runs
from multilift_marl.policies.tuned import tuned_policy

_NAMES = {
    "hover": "hover_rigs",
    "hover_acc_rates": "hover_acc_rates",
    "hover_realistic": "hover_realistic",
    "pose_tudelft": "pose_tudelft",
    "track_2_4": "track_agile",
    "track_5_8": "track_agile",
    "track_rates_2_4": "track_agile",
    "track_rates_5_8": "track_agile",
    "track_realistic_2_4": "track_wash",
    "track_realistic_5_8": "track_realistic_fast",
    "gate_realistic": "gate_realistic",
    "gate_realistic_3": "gate_realistic",
    "gate_realistic_5": "gate_realistic",
    "gate_two": "gate_walls",
    "gate_three": "gate_walls",
    "recover_realistic": "recover_wash",
    "loss": "loss_realistic",
    "loss_snap": "loss_realistic",
    "loss_realistic": "loss_wash",
    "loss_onboard": "loss_onboard",
    "recover_crazymarl_rates": "recover_rates_success",
    "track_generalist": "track_rigs",
    "track_follow_2_2": "track_follow_gentle",
    "track_follow_2_4": "track_follow",
}
SEARCHED: dict[str, type[Formation]] = {flight: tuned_policy(name) for flight, name in _NAMES.items()}
"""The best one of a flight."""
SCALES: dict[str, dict[str, float]] = {
    "track_2_4": {"control.max_acceleration": 12.0},
    "track_5_8": {"control.max_acceleration": 12.0},
}
"""Full scales of its actions, where they are not those of the flight [m/s²]."""


def settings_of(flight: str) -> dict[str, Any]:
    """Return the keys of the tuned policy of a flight: its actions, and full scales."""
    return {"control.action": SEARCHED[flight].INTERFACE} | SCALES.get(flight, {})
