"""Time to the first step: of a first start, without compiled kernels, of later ones, and of the import alone.

    python bench/start.py [repeats=3] [task=hover] [num_envs=8] [install=false]

Each start is a fresh process: import, `make_vec`, `reset` and a step. A first start has an empty folder of its own as
`NUMBA_CACHE_DIR`; the later one finds the kernels there. Stated are medians, the least and the largest, and the
CPU time of a start, which depends less on what else runs on the machine. With `install=true` each
repeat begins with a new virtual environment: pip installs the package from this clone, its dependencies from pip's
cache or the network, then the first step is made; `install=train` installs the extra for training, too.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
import venv
from collections.abc import Iterable
from pathlib import Path

import multilift_marl as ml
from multilift_marl.config.load import parse_overrides

DEFAULTS = {"repeats": 3, "task": "hover", "num_envs": 8, "install": False}
ROOT = Path(__file__).parents[1]
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
print(sum(os.times()[:4]))
"""


def start(code: str, folder: str, python: str = sys.executable) -> tuple[float, float]:
    """Return how long a fresh process took to its last step [s], and its CPU time [s]."""
    package = str(Path(ml.__file__).parents[1])
    environment = os.environ | {"NUMBA_CACHE_DIR": folder}
    if python == sys.executable:
        environment["PYTHONPATH"] = package
    command = [python, "-c", TIMED.format(code=code)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, text=True, check=True, cwd=folder)
    wall, spent = (float(line) for line in done.stdout.split())
    return wall, spent


def install(code: str, extra: str) -> tuple[tuple[float, float], tuple[float, float]]:
    """Return wall and CPU time [s] of pip's installation into a new environment, and of both it and the first step."""
    with tempfile.TemporaryDirectory() as folder:
        venv.create(Path(folder) / "new", with_pip=True)
        python = str(Path(folder) / "new" / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python"))
        began, spent = time.perf_counter(), sum(os.times()[2:4])
        subprocess.run([python, "-m", "pip", "install", "-q", f"{ROOT}{extra}"], check=True, cwd=folder)
        wall, cpu = time.perf_counter() - began, sum(os.times()[2:4]) - spent
        first = start(code, folder, python)
    return (wall, cpu), (wall + first[0], cpu + first[1])


def describe(name: str, measured: Iterable[tuple[float, float]]) -> str:
    """Return a row of the table."""
    walls, spent = zip(*measured, strict=True)
    median, cpu = statistics.median(walls), statistics.median(spent)
    return f"| {name} | {median:.2f} | {min(walls):.2f} - {max(walls):.2f} | {cpu:.1f} |"


def main(arguments: list[str]) -> None:
    """Measure and print the table."""
    options = DEFAULTS | parse_overrides(arguments)
    code = STEP.format(**options)
    began = time.perf_counter()
    if options["install"]:
        extra = "[train]" if options["install"] == "train" else ""
        measured = [install(code, extra) for _ in range(options["repeats"])]
        print("| from nothing | median s | least - largest | CPU s |\n|---|---|---|---|")
        print(describe(f"pip install multilift_marl{extra}", [each for each, _ in measured]))
        print(describe(f"... to the first step of {options['task']}", [both for _, both in measured]))
        print(f"{options['repeats']} repeats in {time.perf_counter() - began:.0f} s", file=sys.stderr)
        return
    first, later, imported = [], [], []
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
