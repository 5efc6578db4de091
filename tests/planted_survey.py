"""Which functions of the package each test calls: a plugin of pytest, for tests/planted_faults.py.

Kernels must not be compiled, or they are not seen. A test that takes longer than a limit is stopped: what it has called
by then counts. Time is the processor's, so that other work does not matter. One line of JSON for each test; tests that
the file already holds are not run again.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from pathlib import Path

import pytest

PACKAGE = str(Path(__file__).resolve().parents[1] / "multilift_marl") + os.sep
OUTPUT = Path(os.environ.get("PLANTED_SURVEY", "survey.jsonl"))
LIMIT = float(os.environ.get("PLANTED_LIMIT", "1.0"))  # [s] of processor time
VARIANTS = 2  # of each parametrised test

_seen: set = set()


class _Stopped(BaseException):
    """A test has had its time."""


def _stop(number, frame):
    raise _Stopped


def _note(frame, event, argument):
    """Remember what is called; no lines are traced."""
    _seen.add(frame.f_code)


def _spread(items: list, count: int) -> list:
    """Return at most `count` items, the first and the last among them."""
    if len(items) <= count:
        return items
    return [items[round(i * (len(items) - 1) / (count - 1))] for i in range(count)]


def pytest_collection_modifyitems(config, items):
    known = set()
    if OUTPUT.is_file():
        known = {json.loads(line)["test"] for line in OUTPUT.read_text(encoding="utf-8").splitlines()}
    groups: dict[str, list] = {}
    for item in items:
        groups.setdefault(item.nodeid.split("[")[0], []).append(item)
    items[:] = [item for group in groups.values() for item in _spread(group, VARIANTS) if item.nodeid not in known]
    for item in items:
        item.add_marker(pytest.mark.timeout(60 * LIMIT, method="signal"), append=False)
    signal.signal(signal.SIGPROF, _stop)


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_call(item):
    signal.setitimer(signal.ITIMER_PROF, LIMIT)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_protocol(item, nextitem):
    _seen.clear()
    item.outcomes = []
    began = time.process_time()
    threading.settrace(_note)
    sys.settrace(_note)
    yield
    sys.settrace(None)
    threading.settrace(None)
    seconds = time.process_time() - began
    found = {code for code in _seen.copy() if code.co_filename.startswith(PACKAGE)}
    names = sorted({f"{Path(code.co_filename[len(PACKAGE) :]).as_posix()}:{code.co_qualname}" for code in found})
    entry = {
        "test": item.nodeid,
        "seconds": round(seconds, 3),
        "passed": item.outcomes == ["passed"] * 3,
        "stopped": "stopped" in item.outcomes,
        "skipped": "skipped" in item.outcomes,
        "slow": item.get_closest_marker("slow") is not None,
        "calls": names,
    }
    with OUTPUT.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    report = (yield).get_result()
    stopped = call.excinfo is not None and (
        call.excinfo.errisinstance(_Stopped) or "Timeout" in str(call.excinfo.value)
    )
    item.outcomes.append("stopped" if stopped else report.outcome)
