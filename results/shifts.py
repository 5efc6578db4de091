"""Robustness to unseen shifts: each change alone, the same episodes for all policies.

  python results/shifts.py hover [flight ...]     the learned policy of seed 0 and the best baseline
                                                  -> results/<flight>/shifts.json
  ... episodes=20                                 a look at fewer episodes: printed, not kept

Changes are hidden from the drones: controllers, baselines and policies keep the nominal values. Only the number of
drones is known to them. `python results/reproduce.py table` writes the tables of the documents.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from typing import Any

from flights import FLIGHTS, HERE, SCRIPTED, error_metric
from script import check_known, read_options, run_script
from searched import SEARCHED, settings_of
from tables import best_baseline

from multilift_marl._files import write_whole
from multilift_marl.config.load import load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.evaluation.suites import Shift, list_shifts
from multilift_marl.policies.baselines import make_scripted

EPISODES, SEED = 250, 2000


def fly(
    flight: str, shift: Shift, overrides: dict[str, Any], maker: Callable[[MultiliftVec], Any], episodes: int
) -> dict[str, float]:
    """Return success, error [m] and attitude error [deg] of a team in one change, means over episodes."""
    chosen = FLIGHTS[flight]
    given = chosen.overrides | overrides | shift.overrides | {"env.num_threads": 1}
    result = run_episodes(load_config(chosen.config, given), maker, episodes, SEED, factors=shift.factors)
    names = {"success": "success_rate", "error": error_metric(chosen), "angle": "payload_attitude_error_deg"}
    return {key: float(result[name].mean()) for key, name in names.items()}


def main(arguments: list[str]) -> None:
    """Evaluate, print, and write what all the episodes gave."""
    flights = [each for each in arguments if "=" not in each]
    episodes = read_options([each for each in arguments if "=" in each], {"episodes": EPISODES})["episodes"]
    if not flights:
        sys.exit(__doc__)
    check_known("flight", flights, FLIGHTS)
    if missing := [flight for flight in flights if not best_baseline(flight)]:
        raise ConfigError(
            f"no baseline of {missing[0]} has been evaluated; first: python results/reproduce.py evaluate {missing[0]}"
        )
    import torch

    from multilift_marl.agents.policy import load_policy

    torch.set_num_threads(1)
    for flight in flights:
        best, weights = best_baseline(flight), HERE / FLIGHTS[flight].recipe / "seed0" / "policy.pt"
        teams: list[tuple[str, dict[str, Any], Callable[[MultiliftVec], Any]]] = []
        if weights.is_file():  # of some flights there are baselines alone
            policy = load_policy(weights)
            scales = {f"control.{key}": getattr(policy.config.control, key) for key in ("max_offset", "max_yaw")}
            teams.append(("learned", scales, policy.bind))
        if best == "searched":
            teams.append((best, settings_of(flight), SEARCHED[flight]))
        else:
            teams.append((best, SCRIPTED, partial(make_scripted, best)))
        rows = []
        drones = load_config(FLIGHTS[flight].config, FLIGHTS[flight].overrides).env.num_drones
        for shift in list_shifts(drones):
            row: dict[str, Any] = {"shift": shift.title}
            for team, own, maker in teams:
                try:
                    row[team] = fly(flight, shift, own, maker, episodes)
                except (ConfigError, ValueError) as error:  # a team that cannot lift so much, for example
                    row[team] = {"refused": str(error)}
            rows.append(row)
            print(flight, row, flush=True)
        content = {"episodes": EPISODES, "seed": SEED, "rows": rows}
        if episodes == EPISODES:
            write_whole(HERE / flight / "shifts.json", f"{json.dumps(content, indent=1)}\n".encode())


if __name__ == "__main__":
    run_script(main)
