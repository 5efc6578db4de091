"""Compiled kernels: none outlives a constant that it was compiled with."""

from __future__ import annotations

import fcntl
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import multilift_marl as ml

HOVER = """
from multilift_marl.config.system import GRAVITY
import numpy as np
from multilift_marl.sim.standing import Drones, hover_drone
from multilift_marl.sim.state import SystemState
state = SystemState.zeros(1, 1)
one = np.ones(1)
hover_drone(0, 0, state, (0.0, 0.0, 0.0), 0.0, Drones(one, one, np.ones((1, 4, 4)), np.zeros((1, 3)), False))
print((state.rotor_speed**2).sum() / GRAVITY)
"""


def own_cache() -> dict[str, str]:
    """Return an environment in which kernels are kept beside their source."""
    return {key: value for key, value in os.environ.items() if key != "NUMBA_CACHE_DIR"}


def test_no_compiled_kernel_outlives_a_constant_it_was_compiled_with(tmp_path):
    package = tmp_path / "multilift_marl"
    shutil.copytree(Path(ml.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))

    def weights_lifted() -> float:
        told = subprocess.run(
            [sys.executable, "-c", HOVER], cwd=tmp_path, env=own_cache(), capture_output=True, text=True, check=True
        )
        return float(told.stdout)

    assert weights_lifted() == pytest.approx(1)
    constants = package / "config" / "vehicles.py"
    source = constants.read_text(encoding="utf-8")
    assert "GRAVITY = 9.81" in source
    constants.write_text(source.replace("GRAVITY = 9.81", "GRAVITY = 3.71"))
    assert weights_lifted() == pytest.approx(1)


def test_processes_take_turns_at_the_cache(tmp_path):
    """Two that compile different signatures of a kernel at once would give both the same file."""
    source = tmp_path / "doubled.py"
    source.write_text(
        "from multilift_marl._jit import kernel\n\n\n@kernel\ndef doubled(x):\n    return x + x\n\n\n"
        "print('ready', flush=True)\nprint(doubled(3), flush=True)\n"
    )
    folder = tmp_path / "__pycache__"
    folder.mkdir()
    with open(folder / "kernels.lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        process = subprocess.Popen([sys.executable, source], env=own_cache(), stdout=subprocess.PIPE, text=True)
        assert process.stdout.readline() == "ready\n"
        with pytest.raises(subprocess.TimeoutExpired):
            process.wait(timeout=5)
        assert not list(folder.glob("*.nbi"))
    assert process.communicate(timeout=60)[0] == "6\n"
    assert len(list(folder.glob("*.nbi"))) == 1
