"""Computing time of each hidden parameter and sensing option: the core with it over the core without, and over MuJoCo.

    python bench/randomization.py [repeats=5] [seconds=1.0] [any configuration key]

All are measured alternately in one run, as in bench.py.
"""

from __future__ import annotations

import json
import statistics
import sys

import multilift_marl as ml
from bench import core, measure, mujoco_alone, settings
from multilift_marl.config.load import load_config

CASES = {  # name: options beside the shipped configuration
    "inertia": {"payload_inertia": 0.2},
    "centre of mass": {"payload_center_of_mass": (0.02, 0.02, 0.02)},
    "cable length": {"cable_length": 0.05},
    "cable stiffness": {"cable_stiffness": 0.3},
    "vehicle mass": {"vehicle_mass": 0.1},
    "rotors and drag": {
        "vehicle_thrust_coefficient": 0.05, "vehicle_rotor_time_constant": 0.2, "vehicle_drag": 0.3,
        "payload_drag": 0.3,
    },
    "wind": {"wind": 3.0},
    "noise and bias": {"observation_noise": "standard", "observation_bias": "standard"},
    "delays": {"observation_delay": (0, 2), "action_delay": (0, 2)},
}  # fmt: skip


def main(arguments: list[str]) -> dict:
    """Measure, print a table, and return the numbers."""
    values, repeats, seconds = settings({"env.num_envs": 256}, arguments)
    everything = {key: width for case in CASES.values() for key, width in case.items()}
    cases = {"off": {}, **CASES, "everything": everything}
    teams = {
        name: ml.make_vec(load_config("hover", values | {f"randomization.{key}": width for key, width in case.items()}))
        for name, case in cases.items()
    }
    off = teams["off"]
    runners = {"mujoco": mujoco_alone(off, len(off.world.shards)), **{name: core(team) for name, team in teams.items()}}
    rates = measure(runners, repeats, seconds)
    result = {}
    print(f"{off.num_drones} drones, {off.num_envs} environments; medians of {repeats}")
    print("| on | core / MuJoCo alone | relative to off |")
    print("|---|---|---|")
    for name in cases:
        ratios = [
            statistics.median(a / b for a, b in zip(rates[name], rates[other], strict=True))
            for other in ("mujoco", "off")
        ]
        result[name] = {"ratio": float(ratios[0]), "against_off": float(ratios[1])}
        print(f"| {name} | {ratios[0]:.2f} | {ratios[1]:.2f} |")
    return result


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
