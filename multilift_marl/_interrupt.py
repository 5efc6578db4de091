"""Ctrl-C while a command of this package is still importing what it needs: one word, as later on."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

from multilift_marl._platform import handles_signals

_SCRIPTS = [os.path.abspath(f"{__file__}/../../{name}") for name in ("train.py", "evaluate.py")]
_MODULES = ("multilift_marl.cli.", "multilift_marl.view", "multilift_marl.export")


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
    os.write(2, b"stopped\n")
    os._exit(130)  # an exception could be swallowed by what is being imported


_begin_quiet_import()
