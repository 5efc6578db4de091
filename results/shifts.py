"""Teams under changes that they did not see in training: each change alone, the same episodes for all teams.

  python results/shifts.py hover [flight ...]     the learned team of seed 0 and the best script of each flight
                                                  -> results/<flight>/shifts.json

Changes are hidden from the drones: controllers, scripts and policies keep the nominal values. Only teams of another
number of drones know how many they are. `python results/reproduce.py table` writes the tables of the documents.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from flights import FLIGHTS, HERE, SCRIPTED, error_metric
from searched import SEARCHED, settings_of
from tables import best_script

from multilift_marl._files import write_whole
from multilift_marl.config.load import load_config
from multilift_marl.control.scripted import make_scripted
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.rollout import measure_episodes

EPISODES, SEED = 250, 2000


class Shift(NamedTuple):
    """A change: configuration values, and what is fixed of the hidden parameters, as factors of the nominal ones."""

    title: str
    overrides: dict[str, Any]
    factors: dict[str, Any]


def list_shifts(num_drones: int) -> list[Shift]:
    """Return the changes for a team of so many drones; the first is none."""
    weaker = [0.85] + [1.0] * (num_drones - 1)
    lag, thrust = (f"randomization.vehicle_{name}" for name in ("rotor_time_constant", "thrust_coefficient"))
    return [
        Shift("none", {}, {}),
        Shift("payload 35 % heavier", {}, {"payload_mass": 1.35}),
        Shift("cables 20 % longer", {}, {"cable_length": 1.2}),
        Shift("motors 30 % slower", {lag: 0.3}, {"vehicle_rotor_time_constant": 1.3}),
        Shift("actions 2 steps late", {"randomization.action_delay": [2, 2]}, {}),
        Shift("steady wind of 4 m/s", {"wind.velocity": [4.0, 0.0, 0.0]}, {}),
        Shift("one drone 15 % weaker", {thrust: 0.15}, {"vehicle_thrust_coefficient": weaker}),
        Shift("one drone less", {"env.num_drones": num_drones - 1}, {}),
        Shift("one drone more", {"env.num_drones": num_drones + 1}, {}),
        Shift("chains as cables", {"cable.model": "chain"}, {}),
    ]


def fly(flight: str, shift: Shift, overrides: dict[str, Any], maker: Callable[[MultiliftVec], Any]) -> dict[str, float]:
    """Return success, error [m] and attitude error [deg] of a team in one change, means over episodes."""
    chosen = FLIGHTS[flight]
    given = chosen.overrides | overrides | shift.overrides | {"env.num_envs": EPISODES, "env.num_threads": 1}
    vec = MultiliftVec(load_config(chosen.config, given), EVALUATION)
    nominal = vec.world.parameters
    fixed = {}
    for name, factor in shift.factors.items():
        relative = name.startswith("vehicle_")  # these are factors themselves
        fixed[name] = np.asarray(factor) * (1.0 if relative else getattr(nominal, name)[:1])
        fixed[name] = np.broadcast_to(fixed[name], getattr(nominal, name).shape)
    observation, _ = vec.reset(seed=SEED, options={"randomization": fixed} if fixed else None)
    result = measure_episodes(vec, maker(vec), observation)
    names = {"success": "success_rate", "error": error_metric(chosen), "angle": "payload_attitude_error_deg"}
    return {key: float(result[name].mean()) for key, name in names.items()}


def main(flights: list[str]) -> None:
    """Evaluate, print and write."""
    import torch

    from multilift_marl.agents.policy import load_policy

    torch.set_num_threads(1)
    for flight in flights:
        best, weights = best_script(flight), HERE / FLIGHTS[flight].recipe / "seed0" / "policy.pt"
        teams: list[tuple[str, dict[str, Any], Callable[[MultiliftVec], Any]]] = []
        if weights.is_file():  # of some flights there is a script alone
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
                    row[team] = fly(flight, shift, own, maker)
                except (ConfigError, ValueError) as error:  # a team that cannot lift so much, for example
                    row[team] = {"refused": str(error)}
            rows.append(row)
            print(flight, row, flush=True)
        content = {"episodes": EPISODES, "seed": SEED, "rows": rows}
        write_whole(HERE / flight / "shifts.json", f"{json.dumps(content, indent=1)}\n".encode())


if __name__ == "__main__":
    sys.exit(__doc__) if len(sys.argv) < 2 else main(sys.argv[1:])
