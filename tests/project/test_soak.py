"""The soak test notices what it is for: memory that grows, threads that stay, numbers that are none."""

import mmap
import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[2] / "bench"))
import soak


def test_growth_is_counted_after_the_warm_up():
    watch = soak.Watch()
    watch.samples = [(0, 100.0, 2), (10, 150.0, 3), (20, 150.5, 3), (30, 170.0, 5)]
    assert watch.growth() == 20.0 > soak.BOUND
    assert watch.new_threads() == 2


@pytest.mark.slow
def test_memory_that_is_held_is_seen(monkeypatch):
    monkeypatch.setattr(soak.gc, "collect", lambda: 0)  # seconds each time, of all that the tests' process holds
    watch, held = soak.Watch(), []
    for steps in range(8):
        watch.sample(steps)
        held.append(mmap.mmap(-1, 16_000_000))  # of the system: an allocator may have memory to spare
        held[-1].write(b"1" * 16_000_000)
    assert watch.growth() > soak.BOUND


def test_numbers_that_are_none_end_it():
    soak.check_finite("hover", np.zeros(3), 1.0)
    with pytest.raises(SystemExit, match="hover: NaN"):
        soak.check_finite("hover", np.zeros(3), np.array([0.0, np.nan]))


@pytest.mark.parametrize("growth, status", [(0.0, 0), (9.0, 1)])
def test_exit_status_is_that_of_the_bound(monkeypatch, capsys, growth, status):
    watch = soak.Watch()
    watch.samples = [(0, 100.0, 2), (100, 100.0, 2), (200, 100.0, 2), (300, 100.0 + growth, 2)]
    monkeypatch.setattr(soak, "fly", lambda *arguments: (watch, 5))
    assert soak.main(["mode=random", "task=hover"]) == status
    assert "| hover | 300 | 5 |" in capsys.readouterr().out
