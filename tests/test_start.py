"""The first start: kernels are compiled by two processes, and what they compile is what one would have compiled."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from conftest import make, zeros

import multilift_marl as ml
from multilift_marl import _compile_helper, _compiler, _kernel_cache, _precompile
from multilift_marl._jit import bind, kernel, kernel_name
from multilift_marl.config.load import load_config

STEP = """
import hashlib, sys
import numpy as np
import multilift_marl as ml
from multilift_marl import _precompile
AFTER_IMPORT
vec = ml.make_vec("hover", num_envs=3, num_threads=2, seed=4)
vec.reset(seed=4)
observation, reward, *_ = vec.step(np.zeros((3, vec.num_drones, vec.action_size)))
print(hashlib.sha256(observation.tobytes() + reward.tobytes()).hexdigest(), _precompile._helper is not None)
"""
KILLED = """
import threading
from multilift_marl import _kernel_cache
waited = _kernel_cache.wait_for
def wait_for(path, name):
    found = waited(path, name)
    if _precompile._helper is not None:
        _precompile._helper.process.kill()
    return found
_kernel_cache.wait_for = wait_for
"""
needs_two = pytest.mark.skipif(_precompile.cpu_count() < 2, reason="a helper needs a CPU of its own")


def begin(folder: Path, after_import: str = "", **variables: str) -> subprocess.Popen[str]:
    """Return a fresh process whose kernels are in a folder."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(Path(ml.__file__).parents[1])}
    command = [sys.executable, "-c", STEP.replace("AFTER_IMPORT", after_import)]
    return subprocess.Popen(
        command, env=environment | variables, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def finish(process: subprocess.Popen[str]) -> tuple[str, bool, str]:
    """Return the digest of what was observed and rewarded, whether there was a helper, and the warnings."""
    told, warnings = process.communicate(timeout=300)
    assert process.returncode == 0, warnings
    digest, helped = told.split()
    return digest, helped == "True", warnings


def wait_until_gone(pid: int) -> bool:
    """Return whether a process has ended, soon."""
    psutil = pytest.importorskip("psutil")
    for _ in range(100):
        if not psutil.pid_exists(pid) or psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
            return True
        time.sleep(0.1)
    return False


@pytest.mark.slow
@needs_two
def test_cold_starts_at_the_same_time_step_as_a_warm_one_does(tmp_path):
    cold = [begin(tmp_path), begin(tmp_path)]
    digests = [finish(process) for process in cold]
    warm = finish(begin(tmp_path))
    assert {digest for digest, _, _ in digests} == {warm[0]}
    assert [helped for _, helped, _ in digests] == [True, True]
    assert warm[1:] == (False, "")  # nothing was missing
    assert not list(tmp_path.rglob("*.tmp"))


@pytest.mark.slow
@needs_two
def test_a_start_whose_helper_dies_goes_on(tmp_path):
    digest, helped, _ = finish(begin(tmp_path, KILLED))
    assert helped
    assert finish(begin(tmp_path))[0] == digest


@pytest.mark.slow
def test_on_one_cpu_there_is_no_helper(tmp_path):
    alone = "_precompile.cpu_count = lambda: 1"
    digest, helped, _ = finish(begin(tmp_path, alone))
    assert not helped
    assert finish(begin(tmp_path))[0] == digest


@needs_two
def test_a_helper_ends_with_the_process_that_started_it(tmp_path):
    wait = "helper = _precompile.Helper(ml.load_config('hover')); print(helper.process.pid, flush=True); input()"
    process = subprocess.Popen(
        [sys.executable, "-c", f"import multilift_marl as ml; from multilift_marl import _precompile; {wait}"],
        env=os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(ml.__file__).parents[1])},
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert process.stdout is not None
    helper = int(process.stdout.readline())
    process.kill()
    process.communicate()
    assert wait_until_gone(helper)


@pytest.mark.parametrize("task", ["hover", "gate"])
def test_a_helper_knows_all_kernels_of_an_environment(task):
    known = set(_compile_helper._list_kernels(load_config(task)))
    names = {each.__name__ for each, _ in known}
    assert {"apply_loads", "read_state", "check", "reward", "observe", "observe_state", "fly"} <= names
    before = {(each, types): each.overloads.get(types) for each, types in known}
    vec = make(task, num_envs=3)
    vec.reset(seed=0)
    vec.step(zeros(vec))
    missing = [each.__name__ for each, types in before if types not in each.overloads]
    inner = [e.__name__ for e, t in before if isinstance(e.overloads[t].entry_point, _compiler._Inner)]
    assert not missing and not inner


@pytest.fixture
def shifted_doubled(monkeypatch):
    """Two kernels, compiled anew by each test: one that is read from a file has not been merged here."""
    monkeypatch.setattr(_kernel_cache, "cache_folder", lambda module: None)

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
    assert isinstance(doubled.overloads[types].entry_point, _compiler._Inner)
    assert doubled(5.0) == 10.0
    assert not isinstance(doubled.overloads[types].entry_point, _compiler._Inner)


def test_recorded_calls_are_those_that_would_be_compiled(shifted_doubled):
    shifted, doubled = shifted_doubled
    values = np.array([3.0])
    with _compiler.recorded() as calls:
        call = bind(shifted, values, 1.0)
        call()
        assert doubled(1.0) == 2.0
    assert values[0] == 7.0  # ran as Python
    assert [each.__name__ for each, _ in calls] == ["_shifted", "_doubled"]
    assert kernel_name(call) == " shifted"
    compiled = bind(shifted, values, 1.0)
    assert calls[0][1] in shifted.overloads
    compiled()
    assert values[0] == 15.0


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
    monkeypatch.setattr(_precompile, "_helper", None)
    progress = _precompile._Progress()
    progress.begin("observe_state")
    line = "compiling kernel 1: observe state"
    assert terminal.shown.endswith(f"\r{line}")
    progress.end()
    assert terminal.shown.endswith(f"\r{' ' * len(line)}\r")
    progress.begin("fly")
    assert terminal.shown.endswith("compiling kernel 2: fly")
