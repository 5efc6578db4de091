"""The written example of a new task works, and is short."""

import subprocess
import sys
from pathlib import Path

EXAMPLE = Path(__file__).parents[1] / "examples" / "new_task.py"


def test_a_new_task_takes_under_a_hundred_lines_and_flies(tmp_path):
    assert len(EXAMPLE.read_text().splitlines()) < 100
    done = subprocess.run([sys.executable, EXAMPLE], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "100% of 64 teams lifted their payload\n", done.stderr
