"""`results/reproduce.py` evaluates by processes that end with it."""

import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

RESULTS = Path(__file__).parents[2] / "results"
EVALUATE = """
import sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import reproduce

def fly(job):
    Path(job.team).touch()
    time.sleep(600)

if __name__ == "__main__":
    reproduce.fly = fly
    reproduce.list_jobs = lambda *_: [reproduce.Job("none", team, "") for team in ("a", "b")]
    reproduce.evaluate(["none"], 2)
"""


@pytest.mark.skipif(not RESULTS.is_dir(), reason="an sdist holds no results")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
@pytest.mark.slow
def test_processes_of_an_evaluation_that_is_killed_end_too(tmp_path, number):
    (tmp_path / "evaluate.py").write_text(EVALUATE)
    process = subprocess.Popen([sys.executable, "evaluate.py", str(RESULTS)], cwd=tmp_path)
    deadline = time.monotonic() + 300
    while not ((tmp_path / "a").exists() and (tmp_path / "b").exists()):
        assert process.poll() is None and time.monotonic() < deadline
        time.sleep(0.1)
    started = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    assert process.wait(60) == -number
    _, alive = psutil.wait_procs(started, timeout=60)
    for each in alive:
        each.kill()
    assert len(started) >= 2 and not alive
