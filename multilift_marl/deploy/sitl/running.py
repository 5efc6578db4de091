"""Running processes of a pipeline: what they print, when they end, and how they are ended."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from io import FileIO
from pathlib import Path
from queue import Empty, SimpleQueue

from multilift_marl._interrupt import signals_waiting
from multilift_marl.deploy.processes import end_together, end_with_parent

_POLL = 0.05  # [s]
_LAST_WORDS = 1.0  # [s] for what a process has printed to be read after its end
_END_FLIGHT = ((signal.SIGINT, 10.0),)  # [s]: it ends its autopilots, which takes up to 5 s
# A policy lets drones, which are gone, sink by the first; others need up to 2 s to leave DDS, and no second one.
_END_NODES = ((signal.SIGINT, 4.0), (signal.SIGINT, 4.0))


class Process(subprocess.Popen[bytes]):
    """A process that is begun in a session of its own, so that Ctrl-C reaches this one alone.

    Args:
        name: of what it does.
        command: its program and arguments.

    Attributes:
        seconds: that it has run, once it has ended.
        cpu_seconds: of it, and of processes that it waited for.
    """

    def __init__(self, name: str, command: Sequence[str]):
        self.name, self.seconds, self.cpu_seconds = name, math.nan, math.nan
        self._begin = time.monotonic()
        super().__init__(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env=os.environ | {"PYTHONUNBUFFERED": "1"}, start_new_session=True, preexec_fn=_prepare,
        )  # fmt: skip

    def poll(self) -> int | None:
        """Return its exit status, negative for a signal; None while it runs."""
        if self.returncode is None:
            pid, status, used = os.wait4(self.pid, os.WNOHANG)
            if pid:
                self.returncode = os.waitstatus_to_exitcode(status)
                self.seconds, self.cpu_seconds = time.monotonic() - self._begin, used.ru_utime + used.ru_stime
        return self.returncode

    @property
    def ending(self) -> str:
        """How it has ended, in words."""
        return f"signal {-self.returncode}" if self.returncode < 0 else f"status {self.returncode}"


def _prepare() -> None:
    end_with_parent()
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # what shells start behind them begins deaf to it


class Pipeline:
    """Running processes, the first of which is what the others fly; a context that ends them, the first one first.

    Args:
        commands: by name.
        folder: for a log of each.

    Attributes:
        processes: as started.
        early: those that have ended before the first one.
    """

    def __init__(self, commands: Mapping[str, Sequence[str]], folder: Path):
        self.processes: list[Process] = []
        self.early: list[Process] = []
        self._readers: dict[str, threading.Thread] = {}
        self._logs: dict[str, FileIO] = {}
        self._lines: SimpleQueue[tuple[str, bytes]] = SimpleQueue()
        self._width = max(len(name) for name in commands)
        try:
            for name, command in commands.items():
                self._logs[name] = FileIO(folder / f"{name}.log", "w")
                self.processes.append(Process(name, command))
            for process in self.processes:  # after all forks, which threads might disturb
                self._readers[process.name] = threading.Thread(target=self._read, args=(process,), daemon=True)
                self._readers[process.name].start()
        except BaseException:
            self.close()
            raise

    def wait(self) -> int:
        """Show what all print and who ends until the first has ended; return the exit status of the whole."""
        first, *nodes = self.processes
        while first.returncode is None:
            self._show(_POLL)
            self.early += [node for node in nodes if self._has_ended(node)]
            self._has_ended(first)
        status = first.returncode
        return 128 - status if status < 0 else status or int(bool(self.early))

    def close(self) -> None:
        """End them all, and show their last words."""
        with signals_waiting():
            end_together(self.processes[:1], *_END_FLIGHT)
            self._show_last(self.processes[:1])
            end_together(self.processes[1:], *_END_NODES)
            self._show_last(self.processes)
            for log in self._logs.values():
                log.close()

    def describe(self) -> str:
        """Return a table of the processes, all of which have ended."""
        lines = [f"{'process':<{self._width}}  {'s':>8}  {'CPU s':>8}  ended by"]
        for each in self.processes:
            lines.append(f"{each.name:<{self._width}}  {each.seconds:>8.1f}  {each.cpu_seconds:>8.1f}  {each.ending}")
        return "\n".join(lines)

    def _has_ended(self, process: Process) -> bool:
        """Return whether a process has ended since the last time, and say so."""
        if process.returncode is not None or process.poll() is None:
            return False
        self._readers[process.name].join(_LAST_WORDS)
        self._show()
        print(f"{process.name} has ended ({process.ending})", flush=True)
        return True

    def _read(self, process: Process) -> None:
        """Take each line that a process prints, in a thread of its own, so that none waits for another."""
        assert process.stdout is not None
        with process.stdout as output:
            for line in output:
                self._lines.put((process.name, line))

    def _show(self, seconds: float = 0.0) -> None:
        """Print and log the lines that have come, or that come within some seconds."""
        end = time.monotonic() + seconds
        with suppress(Empty):
            while True:
                name, line = self._lines.get(timeout=max(end - time.monotonic(), 0.0))
                self._logs[name].write(line)
                print(f"{name:<{self._width}} | {line.decode('utf-8', 'replace').rstrip()}", flush=True)

    def _show_last(self, processes: Sequence[Process]) -> None:
        """Print and log what ended processes have printed; a terminal or disk that is gone keeps none from ending."""
        for process in processes:
            if process.name in self._readers:
                self._readers[process.name].join(_LAST_WORDS)
        with suppress(OSError):
            self._show()

    def __enter__(self) -> Pipeline:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
