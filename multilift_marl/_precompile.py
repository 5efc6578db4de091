"""A second process (`_compile_helper.py`) compiles kernels from the last to the first, this one in their order.

They meet in the middle: each finds on disk what the other has compiled. The helper learns what there is to compile from
a small environment of the same configuration, whose kernels run as Python. It reads from its standard input, and writes
to its standard output, a line for each kernel that is begun, so that no kernel is compiled twice; it ends with the
process that started it, as its input does. Where it cannot start, or dies, all is compiled here, later.
"""

from __future__ import annotations

import base64
import contextlib
import multiprocessing
import os
import pickle
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

from multilift_marl._platform import cpu_count

_COMMAND = "import sys; sys.path.append({path!r}); from multilift_marl._compile_helper import run; run()"
_PATIENCE = 60.0  # [s] for a kernel that the helper has begun
BEGIN, END, TOTAL = "begin", "end", "total"  # first words of lines


class Helper:
    """The second process, as seen from the first.

    Args:
        config: of the environments whose kernels are wanted.
    """

    def __init__(self, config: Any):
        request = base64.b64encode(pickle.dumps(config)).decode()
        command = _COMMAND.format(path=str(Path(__file__).parents[1]))
        self.process = subprocess.Popen(
            [sys.executable, "-P", "-c", command],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL,
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0), text=True, bufsize=1,
        )  # fmt: skip
        assert self.process.stdin is not None and self.process.stdout is not None
        self._input, self._output = self.process.stdin, self.process.stdout
        self.total, self.owner = 0, os.getpid()
        self._begun, self._ended = set[str](), set[str]()
        self._news = threading.Condition()
        threading.Thread(target=self._listen, name="multilift_marl-precompile", daemon=True).start()
        self._send(f"{os.getpid()} {request}")

    def take(self, path: Path) -> bool:
        """Return whether the helper has compiled this kernel, once it has; else tell it to leave the kernel to us."""
        name = str(path)
        with self._news:
            if name in self._begun:
                self._news.wait_for(lambda: name not in self._begun or name in self._ended, _PATIENCE)
            if name in self._ended:
                return True
        self._send(name)
        return False

    def count(self) -> int:
        """Return how many kernels it has compiled."""
        return len(self._ended)

    def _send(self, line: str) -> None:
        with contextlib.suppress(OSError, ValueError):  # it has ended
            self._input.write(f"{line}\n")

    def _listen(self) -> None:
        with contextlib.suppress(OSError, ValueError):
            for line in self._output:
                word, _, rest = line.rstrip("\n").partition(" ")
                with self._news:
                    if word == BEGIN:
                        self._begun.add(rest)
                    elif word == END:
                        self._ended.add(rest)
                    elif word == TOTAL:
                        self.total = int(rest)
                    self._news.notify_all()
        with self._news:
            self._begun &= self._ended
            self._news.notify_all()
        self.process.wait()


class _Progress:
    """How many kernels are compiled, on one line of a terminal that is there only meanwhile."""

    def __init__(self) -> None:
        self._compiled = self._width = 0

    def begin(self, name: str) -> None:
        """Show that a kernel is compiled now."""
        if sys.stderr is None or not sys.stderr.isatty():
            return
        done, total = self._compiled + (_helper.count() if _helper else 0), _helper.total if _helper else 0
        of = f" of {total}" if total > done else ""
        line = f"compiling kernel {done + 1}{of}: {name.replace('_', ' ').strip()}"
        self._show(line)

    def end(self) -> None:
        """Show that it is compiled."""
        self._compiled += 1
        if self._width:
            self._show("")

    def _show(self, line: str) -> None:
        with contextlib.suppress(OSError, ValueError):
            sys.stderr.write(f"\r{line:<{self._width}}\r{line}")
            sys.stderr.flush()
        self._width = len(line)


_helper: Helper | None = None
_offer: Any = None  # configuration of the environments that are being built
_disabled = False  # whether this process starts no helper
_progress = _Progress()


def offer(config: Any) -> None:
    """State what is being built, in case that its kernels must be compiled; None: it is built."""
    global _offer
    _offer = config


def wait_for(path: Path, name: str) -> bool:
    """Return whether a kernel that was missing is there now, compiled by a helper; else it is to be compiled here.

    Args:
        path: of its file.
        name: of the kernel.
    """
    if _offer is not None:
        _start_helper()
    if _helper is not None and _helper.owner == os.getpid() and _helper.take(path):  # not after a fork
        return True
    _progress.begin(name)
    return False


def end() -> None:
    """State that the kernel is compiled."""
    _progress.end()


def disable_helper() -> None:
    """Start no helper from this process, as in the helper itself."""
    global _disabled
    _disabled = True


def _start_helper() -> None:
    """Start a helper, unless there is one, or one would not help: on a single CPU, or in one of several processes."""
    global _helper
    config, running = _offer, _helper is not None and _helper.process.poll() is None
    offer(None)
    several = _disabled or multiprocessing.parent_process() is not None
    if running or several or cpu_count() < 2 or not sys.executable or getattr(sys, "frozen", False):
        return
    with contextlib.suppress(Exception):  # no memory, no processes; a configuration with what cannot be pickled
        _helper = Helper(config)
