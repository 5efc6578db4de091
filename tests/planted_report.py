"""What fails in a copy of the package with a fault: a plugin of pytest, for tests/planted_faults.py.

One line of JSON for each test and for each file that cannot be collected. The first failure ends the run; a test that
has no more time ends it too where PLANTED_STOP_LATE says so, and is passed over elsewhere.
"""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest

OUTPUT = Path(os.environ["PLANTED_REPORT"])
STOP_LATE = os.environ.get("PLANTED_STOP_LATE") == "1"


def pytest_configure(config):
    from multilift_marl.kernels import cache as _kernel_cache

    _kernel_cache.KEPT = 100_000  # kernels of many copies share a folder


def _write(**entry) -> None:
    with OUTPUT.open("a", encoding="utf-8") as file:
        file.write(json.dumps(entry) + "\n")


def pytest_collectreport(report):
    if report.failed:
        _write(test=report.nodeid, outcome="uncollected", message=str(report.longrepr)[-300:])


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item, call):
    report = (yield).get_result()
    if report.failed:
        text = str(call.excinfo.value)
        late = "Timeout (>" in text
        message = f"{call.excinfo.typename}: {text}"[:300]
        _write(test=item.nodeid, outcome="late" if late else "failed", message=message)
        if STOP_LATE or not late:
            item.session.shouldstop = "a test failed"
    elif report.when == "call":
        _write(test=item.nodeid, outcome=report.outcome, message="")
