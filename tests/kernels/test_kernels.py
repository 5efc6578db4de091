"""Compiled kernels: none outlives a source it was compiled from; neither damage nor a full disk stops anybody."""

from __future__ import annotations

import os
import pickle
import shutil
import subprocess
import sys
from io import BytesIO
from pathlib import Path

import pytest
from conftest import make, zeros
from numba.core import types

import multilift_marl as ml
from multilift_marl.kernels import cache as _kernel_cache
from multilift_marl.kernels.compiler import _Unpickler

WEIGHTS = """
from multilift_marl.physical import GRAVITY
import numpy as np
from multilift_marl.rig.constants import RigArrays
from multilift_marl.sim.state import SystemState, hover_drone
state = SystemState.zeros(1, 1)
one = np.ones(1)
three = np.zeros((1, 3))
four, inverse = np.ones((1, 4)), np.ones((1, 4, 4))
rig = RigArrays(three, three, False, True, three, one, one, three, one, inverse, one, four, *[one] * 4, 1.0, 1.0)
hover_drone(0, 0, state, (0.0, 0.0, 0.0), 0.0, rig)
print((state.rotor_speed**2).sum() / GRAVITY)
"""
COMPILING = "compiling kernels of the simulation for the first time, which takes up to a minute\n"
NORM = "from multilift_marl.math3d import norm; print(norm((0.0, 0.6, 0.8)))"  # little to compile
OUTSIDE = """
import tunables
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import clip
from tunables import OFFSET, shifted

@kernel
def value(x):
    return shifted(clip(x, 0.0, 1.0)) + OFFSET + tunables.DEEP

print(value(2.0))
"""
TUNABLES = """
from multilift_marl.kernels.jit import kernel

OFFSET = 10.0
DEEP = 100.0

@kernel
def shifted(x):
    return x + 1000.0
"""

SHARED = """
from multilift_marl.kernels.jit import kernel

@kernel
def first(values):
    return values.size + 0.5
"""
VERSION = """
from typing import NamedTuple
from shared import first

class Numbers(NamedTuple):
    size: float

def value():
    return first(Numbers({size}))
"""


@pytest.fixture
def package(tmp_path):
    """Return a copy of the package without compiled kernels."""
    copy = tmp_path / "multilift_marl"
    shutil.copytree(Path(ml.__file__).parent, copy, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(Path(ml.__file__).parents[1] / "configs", tmp_path / "configs")
    return copy


def run(code: str | Path, folder: Path, limit: int | None = None, **variables: str) -> tuple[float, str]:
    """Return what a fresh process prints there, and its warnings; kernels are kept beside their source.

    Args:
        limit: bytes that a file may have.
    """
    kept = {key: value for key, value in os.environ.items() if key not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    command = [sys.executable, *(["-c", code] if isinstance(code, str) else [str(code)])]
    resource = pytest.importorskip("resource") if limit else None
    limited = None if limit is None else lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))
    environment = kept | {"PYTHONPATH": str(folder), "PYTHONDONTWRITEBYTECODE": "1"} | variables
    told = subprocess.run(
        command, cwd=folder, env=environment, capture_output=True, text=True, check=True, preexec_fn=limited
    )
    return float(told.stdout), told.stderr


def kernels(folder: Path) -> list[Path]:
    return sorted(folder.rglob("*.kernel"))


@pytest.mark.slow
def test_no_compiled_kernel_outlives_a_constant_it_was_compiled_with(package, tmp_path):
    assert run(WEIGHTS, tmp_path)[0] == pytest.approx(1)
    constants = package / "physical.py"
    source = constants.read_text(encoding="utf-8")
    assert "GRAVITY = 9.81" in source
    constants.write_text(source.replace("GRAVITY = 9.81", "GRAVITY = 3.71"))
    assert run(WEIGHTS, tmp_path)[0] == pytest.approx(1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("file", "old", "new", "result"),
    [
        ("multilift_marl/math3d.py", "return min(max(value, low), high)", "return low + 0.5", 1110.5),
        ("tunables.py", "OFFSET = 10.0", "OFFSET = 20.0", 1121.0),
        ("tunables.py", "DEEP = 100.0", "DEEP = 200.0", 1211.0),
        ("tunables.py", "1000.0", "2000.0", 2111.0),
    ],
)
def test_kernels_of_others_are_compiled_anew_when_what_they_use_has_changed(package, tmp_path, file, old, new, result):
    (tmp_path / "outside.py").write_text(OUTSIDE)
    (tmp_path / "tunables.py").write_text(TUNABLES)
    assert run(tmp_path / "outside.py", tmp_path)[0] == 1111
    source = (tmp_path / file).read_text(encoding="utf-8")
    assert old in source
    (tmp_path / file).write_text(source.replace(old, new))
    assert run(tmp_path / "outside.py", tmp_path)[0] == result


def test_kernels_are_read_back_not_compiled_again_and_the_first_time_says_so(package, tmp_path):
    assert run(NORM, tmp_path)[1] == COMPILING
    written = {path: path.stat().st_mtime_ns for path in kernels(package)}
    assert {path.parent.name.split("-")[0] for path in written} == {"math3d"}
    assert run(NORM, tmp_path)[1] == ""
    assert written == {path: path.stat().st_mtime_ns for path in kernels(package)}


@pytest.mark.slow
@pytest.mark.parametrize("damage", ["emptied", "cut", "flipped", "foreign"])
def test_a_damaged_file_counts_as_missing(package, tmp_path, damage):
    run(NORM, tmp_path)
    for path in kernels(package):
        content = path.read_bytes()
        middle = len(content) // 2
        damaged = {
            "emptied": b"",
            "cut": content[:middle],
            "flipped": content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :],
            "foreign": b"no kernel" * 100,
        }[damage]
        path.write_bytes(damaged)
        bad = path, damaged
    value, warnings = run(NORM, tmp_path)
    assert value == pytest.approx(1) and warnings == COMPILING
    assert bad[0].read_bytes() != bad[1]  # mended


@pytest.mark.slow
def test_where_nothing_can_be_written_kernels_are_compiled_each_time(package, tmp_path):
    (package / "__pycache__").write_text("a file in the folder's place: nobody can write there, root neither")
    value, warnings = run(NORM, tmp_path, HOME="/dev/null", XDG_CACHE_HOME="/dev/null/caches")
    assert value == pytest.approx(1)
    assert warnings.startswith("compiled kernels cannot be kept: ") and warnings.count("\n") == 1
    assert "NUMBA_CACHE_DIR" in warnings


READ_ONLY = """
import tempfile

def refuse(*arguments, **options):
    raise OSError(30, "Read-only file system")

tempfile.TemporaryFile = refuse
"""


@pytest.mark.slow
def test_kernels_are_read_where_nothing_can_be_written(package, tmp_path):
    nowhere = {"HOME": "/dev/null", "XDG_CACHE_HOME": "/dev/null/caches"}
    assert run(NORM, tmp_path)[1] == COMPILING
    assert run(READ_ONLY + NORM, tmp_path, **nowhere) == (pytest.approx(1), "")
    for path in kernels(package):
        path.write_bytes(b"damaged")
    value, warnings = run(READ_ONLY + NORM, tmp_path, **nowhere)
    assert value == pytest.approx(1) and warnings.startswith("compiled kernels cannot be kept: ")


@pytest.mark.slow
def test_no_compiled_kernel_outlives_the_compiler_it_came_from(package, tmp_path):
    assert run(NORM, tmp_path)[1] == COMPILING
    for module in ("numba", "llvmlite"):
        other = f"import {module}; {module}.__version__ = '99.0.0'; "
        assert run(other + NORM, tmp_path) == (pytest.approx(1), COMPILING)
    assert run(NORM, tmp_path)[1] == ""


@pytest.mark.slow
def test_kernels_that_check_bounds_are_others(package, tmp_path):
    assert run(NORM, tmp_path)[1] == COMPILING
    assert run(NORM, tmp_path, NUMBA_BOUNDSCHECK="1")[1] == COMPILING


@pytest.mark.slow
def test_a_package_that_is_read_only_keeps_kernels_in_the_users_cache(package, tmp_path):
    (package / "__pycache__").write_text("a file in the folder's place")
    assert run(NORM, tmp_path, XDG_CACHE_HOME=str(tmp_path / "caches")) == (pytest.approx(1), COMPILING)
    first = kernels(tmp_path / "caches")
    with open(package / "math3d.py", "a", encoding="utf-8") as file:
        file.write("CHANGED = True\n")
    assert run(NORM, tmp_path, XDG_CACHE_HOME=str(tmp_path / "caches")) == (pytest.approx(1), COMPILING)
    assert len(kernels(tmp_path / "caches")) == 2 * len(first) > 0


@pytest.mark.slow
def test_kernels_go_where_numba_is_told(package, tmp_path):
    run(NORM, tmp_path, NUMBA_CACHE_DIR=str(tmp_path / "told"))
    assert kernels(tmp_path / "told") and not kernels(package)


@pytest.mark.slow
def test_a_full_disk_costs_time_alone(package, tmp_path):
    value, warnings = run(NORM, tmp_path, limit=1000)
    assert value == pytest.approx(1) and not kernels(package)
    first, second = warnings.splitlines(keepends=True)
    assert first == COMPILING and second.startswith("compiled kernels cannot be kept in ")
    assert not list(package.rglob("*.tmp"))


def test_only_the_newest_folders_of_a_modules_former_sources_stay(tmp_path, monkeypatch):
    monkeypatch.setattr(_kernel_cache, "KEPT", 3)
    monkeypatch.setattr(_kernel_cache, "_home", lambda: tmp_path)
    for age in range(6):
        for module in ("sim.world", "math3d"):
            folder = tmp_path / f"{module}-{age}"
            folder.mkdir()
            os.utime(folder, (1000 - age, 1000 - age))
    current = _kernel_cache.cache_folder.__wrapped__("multilift_marl.sim.world")
    left = {folder.name for folder in tmp_path.glob("sim.world-*")}
    assert left == {current.name, "sim.world-0", "sim.world-1", "sim.world-2"}
    assert len(list(tmp_path.glob("math3d-*"))) == 6


RECORD = """
from typing import NamedTuple
import numpy as np
from multilift_marl.kernels.jit import kernel
from multilift_marl.mdp.initial_states import record

class Pair(NamedTuple):
    FIELDS

print(record(Pair(1.0, 2.0)))
"""


def test_only_the_newest_files_of_a_composed_kernel_stay(tmp_path):
    for number in range(_kernel_cache.KEPT_COMPOSED + 5):
        for name in ("reward-1", "observe-1"):
            path = tmp_path / f"{name}-{number:032d}.kernel"
            path.write_bytes(b"")
            os.utime(path, (number, number))
    _kernel_cache.forget_composed(path.with_name(f"reward-1-{number:032d}.kernel"))
    left = sorted(file.name for file in tmp_path.glob("reward-1-*"))
    assert left == [f"reward-1-{k:032d}.kernel" for k in range(5, _kernel_cache.KEPT_COMPOSED + 5)]
    assert len(list(tmp_path.glob("observe-1-*"))) == _kernel_cache.KEPT_COMPOSED + 5


@pytest.mark.slow
def test_a_kernel_is_compiled_for_the_order_of_a_records_fields(package, tmp_path):
    """The type of a named tuple states the types of its fields, not their names."""
    with open(package / "mdp" / "initial_states.py", "a", encoding="utf-8") as file:
        file.write("\n\n@kernel\ndef record(pair):\n    return pair.left - pair.right\n")
    for fields, expected in (("left: float; right: float", -1.0), ("right: float; left: float", 1.0)):
        (tmp_path / "pair.py").write_text(RECORD.replace("FIELDS", fields))
        assert run(tmp_path / "pair.py", tmp_path)[0] == expected


def test_it_flies_without_the_compiler(package, tmp_path):
    code = (
        "import numpy as np, multilift_marl as ml\n"
        "vec = ml.make_vec('hover', num_envs=1, num_drones=2, num_threads=1)\n"
        "vec.reset(seed=3)\n"
        "print(vec.step(np.zeros((1, 2, vec.action_size)))[1].sum())"
    )
    vec = make("hover", num_envs=1, num_drones=2)
    vec.reset(seed=3)
    compiled = vec.step(zeros(vec))[1].sum()
    assert run(code, tmp_path, NUMBA_DISABLE_JIT="1")[0] == pytest.approx(compiled, rel=1e-6)


def test_kernels_of_another_module_with_tuples_of_the_same_name_are_not_read_nor_is_it_imported(tmp_path):
    """Two versions of a user's file: reading the kernels of the one would import it, and register its task anew."""
    (tmp_path / "shared.py").write_text(SHARED)
    (tmp_path / "old.py").write_text(VERSION.format(size="1.0"))
    (tmp_path / "new.py").write_text(VERSION.format(size="2.0"))
    keep = {
        "NUMBA_CACHE_DIR": str(tmp_path / "kept"),
        "PYTHONPATH": f"{tmp_path}{os.pathsep}{Path(ml.__file__).parents[1]}",
    }
    code = "import sys, {0}; value = {0}.value(); assert {1!r} not in sys.modules; print(value)"
    assert run(code.format("old", "new"), tmp_path, **keep)[0] == 1.5
    assert run(code.format("new", "old"), tmp_path, **keep)[0] == 2.5


def test_reading_kernels_imports_nothing_of_ones_own(tmp_path, monkeypatch):
    (tmp_path / "strange.py").write_text("class Numbers: pass")
    monkeypatch.syspath_prepend(tmp_path)
    stored = b"cstrange\nNumbers\n."  # a reference to the class
    with pytest.raises(pickle.UnpicklingError, match="strange is not imported"):
        _Unpickler(BytesIO(stored)).load()
    assert "strange" not in sys.modules
    assert _Unpickler(BytesIO(b"cnumba.core.types\nArray\n.")).load() is types.Array
