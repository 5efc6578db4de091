"""What the scripts of all peers share: their arguments, their set-points, and one way to count and to time.

It needs Python alone, so that each peer's environment can import it. A script gives a function that simulates all its
drones for one policy period towards set-points that leap to and fro every two seconds of simulated time.
"""

from __future__ import annotations

import json
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable
from importlib.metadata import version

LEAP = 0.3  # [m] along x, of every set-point
LEAP_TIME = 2.0  # [s] simulated
WARM_UP = 20  # policy periods that are not timed: compilation, first allocations


def arguments() -> tuple[int, float, int]:
    """Return the number of drones, the seconds to measure and the threads, from drones=<n> seconds=<s> threads=<t>."""
    given = dict(part.split("=") for part in sys.argv[1:])
    return int(given.get("drones", 4)), float(given.get("seconds", 5.0)), int(given.get("threads", 1))


def grid(drones: int, spacing: float = 1.0) -> list[tuple[float, float, float]]:
    """Return a place for each drone 1 m above the ground, `spacing` [m] apart."""
    side = int((drones - 1) ** 0.5) + 1
    return [(spacing * (i % side), spacing * (i // side), 1.0) for i in range(drones)]


def measure(
    step: Callable[[float], tuple[float, int]],
    period: float,
    drones: int,
    seconds: float,
    packages: tuple[str, ...],
    **facts: object,
) -> None:
    """Fly for `seconds` of wall time and print what was measured as one line of JSON.

    Args:
        step: simulates one policy period of all drones with set-points that are displaced by its argument [m] along x;
            returns their mean distance from these [m] and how many worlds were reset after a crash.
        period: simulated time of one call of `step` [s].
        drones: drones that `step` simulates.
        seconds: wall time to measure [s].
        packages: distributions whose versions are reported.
        facts: anything else to report.
    """
    for _ in range(WARM_UP):
        step(0.0)
    errors: list[float] = []
    resets = 0
    steps = 0
    leap = LEAP
    since_leap = 0.0
    began = time.perf_counter()
    used = time.process_time()
    while (wall := time.perf_counter() - began) < seconds:
        distance, crashed = step(leap)
        resets += crashed
        steps += 1
        since_leap += period
        if since_leap >= LEAP_TIME:
            errors.append(distance)
            leap = LEAP - leap
            since_leap = 0.0
    used = time.process_time() - used
    found = {
        "drones": drones,
        "rate": drones * steps * period / wall,
        "simulated": steps * period,
        "wall": wall,
        "cores_used": used / wall,
        "resets": resets,
        "error": statistics.mean(errors) if errors else None,
        "policy_hz": round(1 / period, 6),
        "versions": {name: version(name) for name in packages} | {"python": platform.python_version()},
    }
    print(json.dumps(found | facts | {"cores": os.cpu_count()}))
