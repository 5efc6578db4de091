"""Computing time of each part of the air: speed of the core with it, as a ratio to the core without any.

    python bench/air.py [repeats=5] [seconds=1.0] [any configuration key]

All are measured alternately in one run, and the medians reported, as in bench.py.
"""

from __future__ import annotations

import json
import statistics
import sys

import multilift_marl as ml
from bench import core, measure, settings
from multilift_marl.config.load import load_config

WIND = {"wind.velocity": [3.0, 0.0, 0.0]}
PARTS = {
    "off": {},
    "wind": WIND,
    "wind, turbulence": WIND | {"wind.turbulence": True},
    "gust": {"wind.gust": [2.0, 0.0, 0.0]},
    "wash": {"wind.wash": True, "wind.inflow": False},
    "inflow": {"wind.inflow": True},
    "ground effect": {"wind.ground_effect": True},
    "moments": {"wind.roll_moment": 0.01, "vehicle.rolling_moment": 1e-6},
}


def main(arguments: list[str]) -> dict:
    """Measure, print a table, and return the numbers."""
    values, repeats, seconds = settings({"env.num_envs": 256}, arguments)
    everything = {key: value for part in PARTS.values() for key, value in part.items()}
    runners = {
        name: core(ml.make_vec(load_config("hover", values | part)))
        for name, part in (PARTS | {"all": everything}).items()
    }
    rates = measure(runners, repeats, seconds)
    result = {}
    print(f"medians of {repeats}")
    print("| switched on | steps/s | ratio to none (least - largest) |")
    print("|---|---|---|")
    for name, found in rates.items():
        ratios = [rate / reference for rate, reference in zip(found, rates["off"], strict=True)]
        rate = statistics.median(found)
        ratio = statistics.median(ratios)
        result[name] = {"steps_per_s": rate, "ratio": ratio}
        print(f"| {name} | {rate:,.0f} | {ratio:.2f} ({min(ratios):.2f} - {max(ratios):.2f}) |")
    return result


if __name__ == "__main__":
    print(json.dumps(main(sys.argv[1:])))
