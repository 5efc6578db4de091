"""Processes that end with the one that starts them, or are ended together."""

from __future__ import annotations

import ctypes
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterable
from typing import Any

from multilift_marl._interrupt import signals_waiting

_PR_SET_PDEATHSIG = 1  # of Linux's prctl
_POLL = 0.02  # [s]


def end_with_parent() -> None:
    """Let Linux end this process when the one that started it has ended, however that was."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def end_together(processes: Iterable[subprocess.Popen[Any]], *steps: tuple[int, float]) -> None:
    """End processes that lead groups of their own, and return when all have ended.

    Signals to this process wait meanwhile, so that none of them is left behind.

    Args:
        processes: started with `start_new_session`; some may have ended.
        steps: signals, and the seconds that processes have after each; what is left then is killed.
    """
    running = list(processes)
    with signals_waiting():
        for number, seconds in (*steps, (signal.SIGKILL, float("inf"))):
            running = [process for process in running if process.poll() is None]
            for process in running:
                os.killpg(process.pid, number)
            end = time.monotonic() + seconds
            while time.monotonic() < end and any(process.poll() is None for process in running):
                time.sleep(_POLL)
