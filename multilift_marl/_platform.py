"""What operating systems do differently: CPUs, locks of files, signals."""

from __future__ import annotations

import os
import platform
import signal
import sys
import threading
from pathlib import Path

STOPPING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))
"""Signals that ask a process to end, those that this system knows."""
_LOCKED_BYTE = 1 << 30  # far behind what the file holds, which others may then read


def cpu_count() -> int:
    """Return the number of CPUs that this process may use; that of the machine where the system does not tell."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def cpu_name() -> str:
    """Return the name of the processor, "" if unknown."""
    info = Path("/proc/cpuinfo")
    if info.is_file():
        for line in info.read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


def lock_file(file: int) -> None:
    """Lock an open file for this process until it is closed.

    Raises:
        OSError: another process has locked it.
    """
    if sys.platform == "win32":
        import msvcrt

        os.lseek(file, _LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(file, msvcrt.LK_NBLCK, 1)
        finally:
            os.lseek(file, 0, os.SEEK_SET)
    else:
        import fcntl

        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


def handles_signals() -> bool:
    """Return whether this thread may set handlers of signals: only the main thread may."""
    return threading.current_thread() is threading.main_thread()
