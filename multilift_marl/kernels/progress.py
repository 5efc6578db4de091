"""How many kernels are compiled so far, shown meanwhile."""

from __future__ import annotations

import contextlib
import sys


class Progress:
    """How many kernels are compiled, on one line of a terminal that is there only meanwhile."""

    def __init__(self) -> None:
        self._compiled = self._width = 0

    def begin(self, name: str) -> None:
        """Show that a kernel is compiled now."""
        if sys.stderr is None or not sys.stderr.isatty():
            return
        line = f"compiling kernel {self._compiled + 1}: {name.replace('_', ' ').strip()}"
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


progress = Progress()
