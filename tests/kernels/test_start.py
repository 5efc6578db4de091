"""The first start: kernels are compiled once, others find them on disk; inner ones, and what is shown meanwhile."""

from __future__ import annotations

import ctypes
import math
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.kernels import compiler
from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.kernels.progress import Progress

STEP = """
import hashlib
import numpy as np
import multilift_marl as ml
vec = ml.make_vec("hover", num_envs=3, num_threads=2, seed=4)
vec.reset(seed=4)
observation, reward, *_ = vec.step(np.zeros((3, vec.num_drones, vec.action_size)))
print(hashlib.sha256(observation.tobytes() + reward.tobytes()).hexdigest())
"""


# A kernel of the package that merges dozens of others: seconds where a step takes a minute.
KERNEL = """
import hashlib
import numpy as np
import multilift_marl as ml
from multilift_marl.planning.team_model import accelerations, make_model, ModelWork, state_size
model = make_model(ml.load_config("hover", {"env.num_drones": 3}).system)
state, work = np.linspace(0.0, 0.3, state_size(3)), ModelWork.of(3)
accelerations(state, model, np.zeros(7), work)
print(hashlib.sha256(work.acceleration.tobytes()).hexdigest())
"""


def begin(folder: Path, code: str) -> subprocess.Popen[str]:
    """Return a fresh process whose kernels are in a folder."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(Path(ml.__file__).parents[1])}
    return subprocess.Popen(
        [sys.executable, "-c", code], env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finish(process: subprocess.Popen[str]) -> tuple[str, str]:
    """Return the digest of what was observed and rewarded, and the warnings."""
    digest, warnings = process.communicate(timeout=300)
    assert process.returncode == 0, warnings
    return digest, warnings


@pytest.mark.slow
@pytest.mark.parametrize("code", [KERNEL, STEP], ids=["kernel", "step"])
def test_cold_starts_at_the_same_time_do_as_a_warm_one_does(tmp_path, code):
    cold = [begin(tmp_path, code), begin(tmp_path, code)]
    digests = {finish(process)[0] for process in cold}
    assert finish(begin(tmp_path, code)) == (digests.pop(), "") and not digests  # nothing was missing
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.fixture
def shifted_doubled(monkeypatch):
    """Two kernels, compiled anew by each test: one that is read from a file has not been merged here."""
    monkeypatch.setattr(compiler, "cache_folder", lambda module: None)

    @kernel
    def _doubled(x):
        return 2.0 * x

    @kernel
    def _shifted(values, by):
        values[0] = _doubled(values[0]) + by

    return _shifted, _doubled


def test_a_kernel_that_others_merge_can_be_called_by_python_too(shifted_doubled):
    shifted, doubled = shifted_doubled
    values = np.array([3.0])
    bind(shifted, values, 1.0)()
    assert values[0] == 7.0
    types = doubled.signatures[0]
    assert isinstance(doubled.overloads[types].entry_point, compiler._Inner)
    assert doubled(5.0) == 10.0
    assert not isinstance(doubled.overloads[types].entry_point, compiler._Inner)


cosine = ctypes.CFUNCTYPE(ctypes.c_double, ctypes.c_double)(math.cos)  # at an address of this process


def _cosine(x):
    return cosine(x)


def _raised(x):
    return _cosine(x) + 1.0


def test_a_kernel_that_calls_a_c_function_works_but_is_not_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "cache_folder", lambda module: tmp_path)
    monkeypatch.setitem(globals(), "_cosine", kernel(_cosine))
    assert kernel(_raised)(0.5) == math.cos(0.5) + 1.0
    assert _cosine(0.5) == math.cos(0.5)
    assert not list(tmp_path.iterdir())


class _Terminal:
    def __init__(self) -> None:
        self.shown = ""

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> None:
        self.shown += text

    def flush(self) -> None:
        pass


def test_progress_is_a_line_of_a_terminal_that_goes_away(monkeypatch):
    terminal = _Terminal()
    monkeypatch.setattr(sys, "stderr", terminal)
    progress = Progress()
    progress.begin("observe_state")
    line = "compiling kernel 1: observe state"
    assert terminal.shown.endswith(f"\r{line}")
    progress.end()
    assert terminal.shown.endswith(f"\r{' ' * len(line)}\r")
    progress.begin("fly")
    assert terminal.shown.endswith("compiling kernel 2: fly")
