"""Memory that episodes must not keep: each draws random numbers of its own, and leaves nothing behind."""

from __future__ import annotations

import gc
import tracemalloc

import numpy as np
import pytest
from conftest import make

EPISODES = 4 * 60


@pytest.mark.slow
@pytest.mark.few_tasks
def test_episodes_keep_no_memory(task):
    vec = make(task, num_envs=4, num_threads=1)
    every = np.ones(4, bool)
    vec.reset(seed=0)
    tracemalloc.start()
    try:
        for _ in range(20):  # what is made once
            vec.reset(mask=every)
        before = tracemalloc.get_traced_memory()[0]
        for _ in range(EPISODES // 4):
            vec.reset(mask=every)
        gc.collect()
        grown = tracemalloc.get_traced_memory()[0] - before
    finally:
        tracemalloc.stop()
    assert grown < 300 * EPISODES  # a generator of random numbers is 2.9 kB, what Numba allots for it 48 bytes more
