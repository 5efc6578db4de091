"""Signals that end a process: one word while a command of this package imports; a thread that hears of them at once.

Python calls handlers of signals in the main thread, between two instructions: not while that compiles a kernel, say.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from types import TracebackType
from typing import Any, NoReturn, Self

from multilift_marl._platform import STOPPING, handles_signals

_SCRIPTS = [os.path.abspath(f"{__file__}/../../{name}") for name in ("train.py", "evaluate.py")]
_MODULES = tuple(
    f"multilift_marl.{name}" for name in ("cli.", "view", "export", "benchmark", "ros", "px4", "sitl", "validation")
)

last_acts: set[Callable[[], object]] = set()
"""What `end_process` still calls, for processes that would outlive this one."""


def _begin_quiet_import() -> None:
    """Until `end_quiet_import`, let Ctrl-C end the process with one word, if it is a command of this package."""
    path = os.path.abspath(sys.argv[0]) if sys.argv else ""
    program = os.path.basename(path)
    module = program == "-m" and any(word.startswith(_MODULES) for word in sys.orig_argv)
    ours = module or program.startswith("multilift-") or path in _SCRIPTS
    if ours and handles_signals() and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, _stop)


def end_quiet_import() -> None:
    """Let Ctrl-C raise KeyboardInterrupt again."""
    if handles_signals() and signal.getsignal(signal.SIGINT) is _stop:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def _stop(signum: int, frame: Any) -> None:
    end_now(signum)  # an exception could be swallowed by what is being imported


def end_now(number: int) -> None:
    """End this process, as the signal of this number does, with one word."""
    try:
        os.write(2, b"\nstopped\n" if os.isatty(2) else b"stopped\n")  # below a bar, and what the key has shown
    finally:
        end_process(128 + number)


def end_process(status: int) -> NoReturn:
    """End this process after `last_acts`, whatever its threads are doing."""
    try:
        for act in list(last_acts):
            with suppress(Exception):
                act()
    finally:
        os._exit(status)


def leave(status: int) -> NoReturn:
    """End this process with what it has printed, after `last_acts`, without what the interpreter does at its end."""
    for stream in (sys.stdout, sys.stderr):
        with suppress(OSError, ValueError, AttributeError):  # a terminal that is gone, closed or none
            stream.flush()
    end_process(status)


class Watch:
    """A thread that hears of the signals of `STOPPING` at once, while this context lasts in the main thread.

    What is ignored (nohup) stays ignored; in other threads nothing happens. A process that is forked meanwhile has
    Python's own handlers again.

    Args:
        hear: called by that thread with the number of each signal.
        handle: their handler in the main thread; None for one that does nothing.
    """

    def __init__(self, hear: Callable[[int], None], handle: Callable[[int, Any], None] | None = None):
        self._hear, self._handle = hear, handle or (lambda number, frame: None)
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if not handles_signals():
            return self
        import socket  # not while a command begins

        self._input, self._output = socket.socketpair()
        self._output.setblocking(False)
        self._before_fd = signal.set_wakeup_fd(self._output.fileno(), warn_on_full_buffer=False)
        for number in STOPPING:
            if number == signal.SIGINT or signal.getsignal(number) != signal.SIG_IGN:
                self._before[number] = signal.signal(number, self._handle) or signal.SIG_DFL
        _active.add(self)
        threading.Thread(target=self._listen, name="multilift_marl-signals", daemon=True).start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        if not self._before:
            return
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before = {}
        signal.set_wakeup_fd(self._before_fd)
        self._output.close()
        _active.discard(self)

    def leave_child(self) -> None:
        """Leave signals alone in a forked child, which has no thread that hears of them: its socket is the parent's."""
        signal.set_wakeup_fd(-1)
        for number in self._before:
            signal.signal(number, signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL)
        self._before = {}
        self._input.close()
        self._output.close()

    def _listen(self) -> None:
        with self._input:
            while content := self._input.recv(64):
                for number in content:
                    if number in self._before:
                        self._hear(number)


_active: set[Watch] = set()
_masks = threading.local()  # of the threads that fork


def _before_fork() -> None:
    """Let signals wait that come to the child before it is ready for them."""
    _masks.before = signal.pthread_sigmask(signal.SIG_BLOCK, STOPPING if _active else ())


def _after_fork() -> None:
    signal.pthread_sigmask(signal.SIG_SETMASK, _masks.before)


def _leave_child() -> None:
    while _active:
        _active.pop().leave_child()
    _after_fork()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before_fork, after_in_parent=_after_fork, after_in_child=_leave_child)


def ending_at_once() -> Watch:
    """Return a context in which there is nothing to lose: a signal ends the process, whatever it is doing."""
    return Watch(end_now)


@contextmanager
def interrupted_by_signals() -> Iterator[None]:
    """Let SIGTERM and SIGHUP do as Ctrl-C does, so that nothing is left running; what is ignored (nohup) stays so."""

    def interrupt(number: int, frame: Any) -> None:
        raise KeyboardInterrupt

    numbers = [n for n in STOPPING if n != signal.SIGINT and signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, interrupt) for number in numbers if handles_signals()}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)


@contextmanager
def signals_waiting() -> Iterator[None]:
    """Let signals of `STOPPING` wait until this context ends, whichever thread gets them; ignored ones stay so."""
    came: list[int] = []
    numbers = [n for n in STOPPING if handles_signals() and signal.getsignal(n) is not signal.SIG_IGN]
    before = {number: signal.signal(number, lambda which, frame: came.append(which)) for number in numbers}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler or signal.SIG_DFL)
        if came:
            signal.raise_signal(came[0])


_begin_quiet_import()
