"""How a training is stopped: after its iteration, or in the middle of one that takes too long."""

from __future__ import annotations

import _thread
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import TracebackType
from typing import Any, Self

from multilift_marl._interrupt import Watch, end_now, end_process
from multilift_marl.errors import CheckpointError

PATIENCE = 1.0  # [s] for an iteration to end by itself
LAST_PATIENCE = 4.0  # [s] for the main thread to give it up, and for workers to end


class Abandoned(KeyboardInterrupt):
    """An iteration is given up: it took too long after a signal."""


class Stopper:
    """What signals do to a training while this context lasts; threads other than the main one leave them alone.

    The first one sets `asked`, so that the training ends after its iteration. `PATIENCE` later the main thread gets
    `Abandoned`. Where it is in a call that does not come back, another thread calls `rescue` and ends the process
    `LAST_PATIENCE` later. A second signal ends it at once; the first never breaks off the writing of a checkpoint.
    A process that goes on after the training (see `ends`) gets KeyboardInterrupt where it would be ended.

    Args:
        rescue: writes what the last iteration left, if that is not yet on the disk.
        say: shows a text.

    Attributes:
        ends: whether the process may be ended, which does nothing but train.
        worth: whether there is something to save; where there is not, the first signal ends it at once.
        asked: whether a signal has come.
        status: exit status of a process that stops for it.
    """

    def __init__(self, rescue: Callable[[], object], say: Callable[[str], object]):
        self._rescue, self._say = rescue, say
        self.ends, self.worth, self.asked, self.status = False, False, False, 128 + signal.SIGINT
        self._known, self._handled = threading.Event(), 0
        self._lock, self._writing = threading.Lock(), False
        self._expired, self._nudges, self._over = False, 0, False
        self._ending = threading.Lock()
        self._timers: list[threading.Timer] = []
        self._watch = Watch(self._hear, self._handle)

    def __enter__(self) -> Self:
        self._watch.__enter__()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: BaseException | None, trace: TracebackType | None
    ) -> None:
        with self._lock:
            for timer in self._timers:
                timer.cancel()
        self._watch.__exit__(kind, value, trace)

    @contextmanager
    def writing(self) -> Iterator[None]:
        """Write a checkpoint meanwhile."""
        self._writing = self.worth = True
        try:
            with self._lock:
                yield
        finally:
            self._writing = False

    def end(self) -> None:
        """State that no iteration runs any more: from now on the main thread is left alone, whose handlers may be gone.

        Ray, when it ends, takes them away.
        """
        self._over = True
        # Whoever holds it has looked at `_over` before: no nudge comes after this returns.
        with self._ending:  # behind a nudge that is under way
            pass

    def _hear(self, number: int) -> None:
        """Note a signal, in the thread that hears of it at once."""
        if self._nudges:  # our own
            self._nudges -= 1
            return
        if self.asked or not self.worth:
            if self.ends:
                end_now(number)
            self._known.set()
            return
        self.asked, self.status = True, 128 + number
        self._known.set()
        # Timers run in threads: the main one may be in a call that does not come back.
        last = [(PATIENCE + LAST_PATIENCE, self._force)] if self.ends else []
        for seconds, act in [(PATIENCE, self._nudge), *last]:
            timer = threading.Timer(seconds, act)
            timer.daemon = True
            timer.start()
            self._timers.append(timer)
        self._say("stopping after this iteration, within seconds; press Ctrl-C again to stop at once")

    def _handle(self, number: int, frame: Any) -> None:
        """Give up the iteration, which only the main thread can do, once it has had its time."""
        self._known.wait(1.0)  # for the other thread
        if self._expired:
            self._expired = False
            if not (self._writing or self._over):
                raise Abandoned
            return
        self._handled += 1
        if not self.ends and (self._handled > 1 or not self.worth):
            raise KeyboardInterrupt

    def _nudge(self) -> None:
        """Have the main thread come to `_handle`, also out of a system call."""
        # A process that a signal ended has the status 128 + its number.
        number, main = self.status - 128, threading.main_thread().ident
        with self._ending:
            if self._over:
                return
            # Counted before it is sent, for the thread that hears of it would take it for a second signal of the user.
            self._expired, self._nudges = True, self._nudges + 1
            if hasattr(signal, "pthread_kill") and main is not None:
                signal.pthread_kill(main, number)
            else:
                _thread.interrupt_main(signal.Signals(number))

    def _force(self) -> None:
        """End the process, once no checkpoint is being written."""
        with self._lock:
            try:
                self._rescue()
            except CheckpointError as error:  # which says where the run is
                self._say(f"error: {error}")
            finally:
                end_process(self.status)
