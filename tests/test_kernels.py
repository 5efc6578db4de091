"""Compiled kernels: none outlives a constant that it was compiled with."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import multilift_marl as ml

HOVER = """
from multilift_marl.config.system import GRAVITY
from multilift_marl.sim.rows import hover_drone
from multilift_marl.sim.state import SystemState
state = SystemState.zeros(1, 1)
hover_drone(0, 0, state, (0.0, 0.0, 0.0), 0.0, 1.0, 1.0)
print((state.rotor_speed**2).sum() / GRAVITY)
"""


def test_no_compiled_kernel_outlives_a_constant_it_was_compiled_with(tmp_path):
    package = tmp_path / "multilift_marl"
    shutil.copytree(Path(ml.__file__).parent, package, ignore=shutil.ignore_patterns("__pycache__"))

    def weights_lifted() -> float:
        told = subprocess.run([sys.executable, "-c", HOVER], cwd=tmp_path, capture_output=True, text=True, check=True)
        return float(told.stdout)

    assert weights_lifted() == pytest.approx(1)
    constants = package / "config" / "system.py"
    constants.write_text(constants.read_text(encoding="utf-8").replace("GRAVITY = 9.81", "GRAVITY = 3.71"))
    assert weights_lifted() == pytest.approx(1)
