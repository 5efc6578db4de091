"""The package's rooms, its folders and single modules: what imports what, how large they are, and former names."""

from __future__ import annotations

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

import multilift_marl as ml
from multilift_marl._renamed import RENAMED

PACKAGE = Path(ml.__file__).parent
LOWEST_FIRST = (
    "errors", "physical", "_platform", "_versions", "_files", "remember", "_interrupt", "realtime", "_renamed",
    "kernels", "rng", "math3d", "schema", "plugins", "trust", "rig", "config", "sim", "control", "mdp", "sensing",
    "planning", "diffmpc", "navigation", "tasks", "rendering", "envs", "policies", "_ray", "evaluation", "agents",
    "command", "deploy", "viewer", "validation", "cli", "benchmark", "export", "plan",
)  # fmt: skip


def sources() -> Iterator[tuple[str, Path]]:
    """Yield the rooms and files of the package; its own `__init__`, which offers names of many, has none."""
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).parts
        if parts != ("__init__.py",):
            yield parts[0].removesuffix(".py"), path


def imports(path: Path) -> Iterator[str]:
    """Yield what a file imports of the package, in functions and for types alone too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names if name.name.startswith("multilift_marl."))
        elif isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "multilift_marl":
            assert node.module is not None and not node.level
            yield from (f"{node.module}.{name.name}" for name in node.names)


def test_no_room_imports_one_above_it():
    rank = {room: number for number, room in enumerate(LOWEST_FIRST)}
    upwards = []
    for room, path in sources():
        assert room in rank, f"{room} has no place in the order of rooms, see docs/architecture.md"
        for name in imports(path):
            other = name.split(".")[1]
            if other in rank and rank[other] > rank[room]:
                upwards.append(f"{path.relative_to(PACKAGE)} imports {name}")
    assert not upwards


def test_no_room_is_more_than_an_eighth_of_the_package():
    lines: dict[str, int] = {}
    for room, path in sources():
        lines[room] = lines.get(room, 0) + len(path.read_text(encoding="utf-8").splitlines())
    assert max(lines.values()) < sum(lines.values()) / 8


def test_the_map_of_files_shows_rooms_in_their_order_and_files_that_are_there():
    root = PACKAGE.parent
    page = (root / "docs" / "architecture.md").read_text(encoding="utf-8")
    listed = re.findall(r"^(\w+)  +\w", page.partition("## Rooms")[2].partition("## Configurations")[0], re.M)
    folders = {path.name for path in PACKAGE.iterdir() if (path / "__init__.py").is_file()}
    assert listed == [room for room in LOWEST_FIRST if room in folders]
    paths = re.findall(r"`(\w[\w./]*(?:/|\.py|\.yml|\.yaml))`", page)
    assert len(paths) > 100
    missing = [path for path in paths if not (PACKAGE / path).exists() and not (root / path).exists()]
    assert not missing


@pytest.mark.parametrize("former", sorted(RENAMED))
def test_a_former_name_gives_the_same_module(former):
    assert importlib.import_module(former) is importlib.import_module(RENAMED[former])
    assert importlib.import_module(former).__spec__.name == RENAMED[former]


def test_a_module_within_a_renamed_folder_is_found_and_one_that_never_was_is_not():
    from multilift_marl.px4 import mavlink as former

    from multilift_marl.deploy.px4 import mavlink

    assert former is mavlink
    with pytest.raises(ModuleNotFoundError):
        importlib.import_module("multilift_marl.px4.nothing")


@pytest.mark.parametrize(
    "command", ["view", *(pytest.param(name, marks=pytest.mark.slow) for name in ("px4", "ros", "sitl", "viewer"))]
)
def test_commands_have_short_names(command):
    done = subprocess.run([sys.executable, "-m", f"multilift_marl.{command}", "--help"], capture_output=True, text=True)
    assert done.returncode == 0 and f"python -m multilift_marl.{command.removesuffix('er')}" in done.stdout
