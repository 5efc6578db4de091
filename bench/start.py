"""Time to the first step: of a first start, without compiled kernels, of later ones, and of the import alone.

    python bench/start.py [repeats=3] [task=hover] [num_envs=8]

Each start is a fresh process: import, `make_vec`, `reset` and a step. A first start has an empty folder of its own as
`NUMBA_CACHE_DIR`; the later one finds the kernels there. Stated are medians, the least and the largest, and the
CPU time of all processes of a start, which depends less on what else runs on the machine.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

import multilift_marl as ml
from multilift_marl.config.load import parse_overrides

DEFAULTS = {"repeats": 3, "task": "hover", "num_envs": 8}
STEP = """
import numpy as np, multilift_marl as ml
vec = ml.make_vec("{task}", num_envs={num_envs})
vec.reset(seed=0)
vec.step(np.zeros((vec.num_envs, vec.num_drones, vec.action_size)))
"""
IMPORT = "import multilift_marl"
TIMED = """
import os, time
begin = time.perf_counter()
{code}
print(time.perf_counter() - begin)
from multilift_marl import _precompile
if _precompile._helper is not None:
    _precompile._helper.process.wait()  # else its CPU time would not count
print(sum(os.times()[:4]))
"""


def start(code: str, folder: str) -> tuple[float, float]:
    """Return how long a fresh process took to its last step [s], and the CPU time of it and its helper [s]."""
    package = str(Path(ml.__file__).parents[1])
    environment = os.environ | {"NUMBA_CACHE_DIR": folder, "PYTHONPATH": package}
    command = [sys.executable, "-c", TIMED.format(code=code)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True)
    wall, spent = (float(line) for line in done.stdout.split())
    return wall, spent


def describe(name: str, measured: Iterable[tuple[float, float]]) -> str:
    """Return a row of the table."""
    walls, spent = zip(*measured, strict=True)
    median, cpu = statistics.median(walls), statistics.median(spent)
    return f"| {name} | {median:.2f} | {min(walls):.2f} - {max(walls):.2f} | {cpu:.1f} |"


def main(arguments: list[str]) -> None:
    """Measure and print the table."""
    options = DEFAULTS | parse_overrides(arguments)
    code = STEP.format(**options)
    first, later, imported = [], [], []
    began = time.perf_counter()
    for _ in range(options["repeats"]):
        with tempfile.TemporaryDirectory() as folder:
            first.append(start(code, folder))
            later.append(start(code, folder))
            imported.append(start(IMPORT, folder))
    print(f"| start, {options['task']} | median s | least - largest | CPU s |\n|---|---|---|---|")
    print(describe("first, kernels are compiled", first))
    print(describe("later, kernels are loaded", later))
    print(describe("import alone", imported))
    print(f"{options['repeats']} repeats in {time.perf_counter() - began:.0f} s", file=sys.stderr)


if __name__ == "__main__":
    main(sys.argv[1:])
