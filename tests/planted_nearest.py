"""Which tests to try for a fault, in which order; for tests/planted_faults.py."""

from __future__ import annotations

import ast
import gzip
import importlib.util
import json
import os
import re
import subprocess
import sys
from collections import defaultdict
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from planted_mutations import Fault

UNINTERPRETED = (  # they start processes, compile, or look at documents and recorded results
    "checkpoints", "examples", "export", "honest_training", "hooks", "kernels", "leaks", "memory", "model_cards",
    "new_task", "package", "peers", "platforms", "plugins", "release", "result_scripts", "results", "site", "soak",
    "start", "train_command", "types", "view", "view_browser", "window", "workers",
)  # fmt: skip
MOST = 400  # tests tried as Python
STATED = (  # tests of numbers that are assigned at import, by what documents and recipes say of them
    "tests/policies/test_tuned_numbers.py", "tests/mdp/test_task_tables.py::test_the_reference_of_the_tasks",
)  # fmt: skip


@dataclass
class Entry:
    """What one test does."""

    test: str
    seconds: float
    passed: bool
    slow: bool
    calls: frozenset[int]
    guessed: bool = False
    """Of other variants of the test."""


@dataclass
class Choice:
    """Names of tests, nearest first."""

    fast: list[str]
    """As Python, whole."""
    stopped: list[str]
    """As Python, which take long."""
    rest: list[str]
    """To be compiled."""
    calling: set[str]
    """All that call the faulty function, where everything is installed."""


class Survey:
    """Which functions tests call."""

    def __init__(self, entries: list[Entry], numbers: dict[str, int]):
        self.entries, self.numbers = entries, numbers

    @classmethod
    def read(cls, path: Path) -> Survey:
        """Read a file that planted_survey has written, also one that was compressed since."""
        numbers: dict[str, int] = {}
        entries = {}
        data = gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else path.read_bytes()
        for line in data.decode().splitlines():
            each = json.loads(line)
            calls = frozenset(numbers.setdefault(name, len(numbers)) for name in each["calls"])
            entry = Entry(each["test"], each["seconds"], each["passed"], each["slow"], calls)
            if not each["skipped"]:
                entries[entry.test] = entry
        return cls(list(entries.values()), numbers)


def test_files(root: Path) -> list[str]:
    """Return the files whose tests can be run as Python."""
    names = sorted((root / "tests").rglob("test_*.py"))
    return [path.relative_to(root).as_posix() for path in names if path.stem.removeprefix("test_") not in UNINTERPRETED]


def _importable(path: Path) -> bool:
    """Return whether all that a test file imports is installed."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        names = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
            names = [node.module]
        for name in names:
            top = name.split(".")[0]
            if (
                top != "multilift_marl"
                and importlib.util.find_spec(top) is None
                and not any((folder / f"{top}.py").is_file() for folder in (path.parent, path.parents[1]))
            ):
                return False
    return True


class Chooser:
    """Orders tests for a fault.

    Args:
        root: of the sources.
        survey: of the tests.
        slow: whether slow tests are tried too.
    """

    def __init__(self, root: Path, survey: Survey, slow: bool):
        self.root, self.survey = root, survey
        files = (root / "tests").rglob("test_*.py")
        self.texts = {p.relative_to(root).as_posix(): p.read_text(encoding="utf-8") for p in files}
        self.files = [name for name in self.texts if _importable(root / name)]
        self.default = self._collect("not slow")
        self.tests = self._collect("") if slow else self.default
        known = {entry.test: entry for entry in survey.entries}
        variants = defaultdict(list)
        for entry in survey.entries:
            variants[entry.test.split("[")[0]].append(entry)
        self.entries: list[Entry] = []
        self.unknown: list[str] = []
        default = set(self.default)
        for test in self.tests:
            others = variants.get(test.split("[")[0])
            if test in known:
                self.entries.append(known[test])
            elif others:
                calls = frozenset().union(*(other.calls for other in others))
                mean = sum(other.seconds for other in others) / len(others)
                passed = all(other.passed for other in others)
                self.entries.append(Entry(test, mean, passed, test not in default, calls, True))
            else:
                self.unknown.append(test)
        self._slow = {test for test in self.tests if test not in default}

    def is_slow(self, test: str) -> bool:
        """Return whether a test is none of the default ones."""
        return test in self._slow

    def _collect(self, marks: str) -> list[str]:
        environment = os.environ | {"NUMBA_DISABLE_JIT": "1", "PYTHONDONTWRITEBYTECODE": "1"}
        environment["PYTHONPATH"] = str(self.root)
        command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-m", marks, "-p", "no:cacheprovider"]
        done = subprocess.run([*command, *self.files], cwd=self.root, env=environment, capture_output=True, text=True)
        if done.returncode:
            raise SystemExit(f"tests cannot be collected:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
        return [line for line in done.stdout.splitlines() if line.startswith("tests/") and "::" in line]

    @cached_property
    def _uses(self) -> list[tuple[str, str, tuple[str, ...], set[str]]]:
        """File, qualified name, what is assigned at import, and names used: of each function and statement."""
        found = []
        for path in (self.root / "multilift_marl").rglob("*.py"):
            file = path.relative_to(self.root / "multilift_marl").as_posix()
            for node in ast.parse(path.read_text(encoding="utf-8")).body:
                found += _uses_of(file, node, [], False)
        return found

    def _affected(self, fault: Fault) -> set[str]:
        """Return the functions that a fault changes, as surveys name them."""
        if not fault.names and fault.function:
            return {f"{fault.file}:{fault.function}"}
        names, affected = set(fault.names) or {fault.function.split(".")[-1]}, set[str]()
        for _ in range(3):  # through what is made of them at import
            more = set[str]()
            for file, function, targets, used in self._uses:
                if names & used and (file == fault.file or function or targets):
                    if function:
                        affected.add(f"{file}:{function}")
                    else:
                        more |= set(targets)
            if more <= names:
                break
            names |= more
        return affected

    def _nearness(self, fault: Fault) -> dict[str, float]:
        """Return a factor for each file of tests, below 1 for those that speak of the faulty function or module."""
        stem, name = Path(fault.file).stem, (fault.names or (fault.function,))[0].split(".")[-1]
        factors = {}
        for file, text in self.texts.items():
            factors[file] = 0.3 if stem in file else 1.0
            if name and re.search(rf"\b{re.escape(name)}\b", text):
                factors[file] *= 0.1
            if f"{stem} import" in text or f"import {stem}" in text:
                factors[file] *= 0.3
        return factors

    def _calling(self, affected: set[int]) -> set[str]:
        """Return all tests of the survey that call one of these functions, also those that cannot run here."""
        return {entry.test for entry in self.survey.entries if entry.calls & affected}

    def choose(self, fault: Fault, seconds: float) -> Choice:
        """Return the tests for a fault; those as Python take about `seconds` of the survey's time."""
        affected = {self.survey.numbers[name] for name in self._affected(fault) if name in self.survey.numbers}
        covering = [entry for entry in self.entries if entry.calls & affected] if affected else []
        factors = self._nearness(fault)
        near = {test: factors[test.split("::")[0]] for test in self.tests}

        def distance(entry: Entry) -> tuple[bool, float]:
            cost = (0.02 + entry.seconds) * (1 + len(entry.calls) / 200)
            return entry.guessed and entry.seconds > 0.05, near[entry.test] * cost

        covering.sort(key=distance)
        files = {entry.test.split("::")[0] for entry in covering[:10]}
        if fault.names:  # what is assigned at import is read by tests that call nothing
            files |= {*(name.split("::")[0] for name in STATED), *(f for f, factor in factors.items() if factor < 0.3)}
        seen = {entry.test for entry in covering}
        others = [e for e in self.entries if e.test not in seen and (not affected or e.test.split("::")[0] in files)]
        others.sort(key=distance)
        fast, spent = list[str](), 0.0
        stated = [entry for entry in others if fault.names and entry.test.startswith(STATED)]
        first = {entry.test for entry in stated}
        for entry in (*stated, *(each for each in (*covering, *others) if each.test not in first)):
            if entry.passed and spent + entry.seconds <= seconds and len(fast) < MOST:
                fast.append(entry.test)
                spent += entry.seconds
        longer = (*stated, *(entry for entry in covering if entry.test not in first))
        stopped = [entry.test for entry in longer if not entry.passed and not entry.guessed][:12]
        taken = set(fast)
        rest = [entry.test for entry in covering if entry.test not in taken]
        related = sorted((test for test in self.unknown if near[test] < 1), key=near.__getitem__)
        rest = [*rest, *related] if affected else [*related, *rest]
        return Choice(fast, stopped, rest, self._calling(affected))


def _uses_of(
    file: str, node: ast.AST, scope: list[str], inside: bool
) -> list[tuple[str, str, tuple[str, ...], set[str]]]:
    """Return the uses of names in a statement."""
    if isinstance(node, ast.ClassDef):
        found = []
        for each in node.body:
            found += _uses_of(file, each, [*scope, node.name], False)
        return found
    if isinstance(node, ast.FunctionDef):
        name = [*scope, *(["<locals>"] if inside else []), node.name]
        found = [(file, ".".join(name), (), _names(node))]
        for each in ast.walk(node):
            if isinstance(each, ast.FunctionDef) and each is not node:
                found.append((file, ".".join([*name, "<locals>", each.name]), (), _names(each)))
        return found
    if isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        found = [each.id for target in targets for each in ast.walk(target) if isinstance(each, ast.Name)]
        return [(file, "", tuple(found), _names(node.value) if node.value is not None else set())]
    return [(file, "", (), _names(node))]


def _names(node: ast.AST) -> set[str]:
    """Return all names and attributes that are used."""
    names = {each.id for each in ast.walk(node) if isinstance(each, ast.Name)}
    return names | {each.attr for each in ast.walk(node) if isinstance(each, ast.Attribute)}
