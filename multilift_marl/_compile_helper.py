"""The process that `_precompile.py` starts: it compiles the kernels of a configuration from the last to the first."""

from __future__ import annotations

import base64
import contextlib
import os
import pickle
import signal
import sys
import threading
from typing import Any

from multilift_marl._compiler import recorded
from multilift_marl._platform import handles_signals
from multilift_marl._precompile import BEGIN, END, TOTAL, disable_helper
from multilift_marl.envs.core import MultiliftVec


def run() -> None:
    """Compile what the process that started this one asks for, and end with it."""
    disable_helper()
    if handles_signals():
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the other process; this one ends with it
    parent, _, request = sys.stdin.readline().partition(" ")
    theirs = set[str]()
    threading.Thread(target=_hear, args=(theirs,), daemon=True).start()
    try:
        for kernel, types in reversed(_list_kernels(pickle.loads(base64.b64decode(request)))):
            if os.name == "posix" and os.getppid() != int(parent):  # others may hold the other end of our input
                break
            path = kernel._cache.path(types, kernel.targetctx)
            if str(path) not in theirs and not path.exists():
                print(BEGIN, path, flush=True)
                kernel.compile(types)
                print(END, path, flush=True)
    finally:
        os._exit(0)  # without waiting for the thread


def _hear(theirs: set[str]) -> None:
    """Note the kernels that the other process compiles; end with it."""
    try:
        for line in sys.stdin:
            theirs.add(line.rstrip("\n"))
    finally:
        os._exit(0)


def _list_kernels(config: Any) -> list[Any]:
    """Return the kernels, and their types, of environments of a configuration, in the order of their first use."""
    few = min(config.env.num_envs, 2)
    small = config.model_copy(update={"env": config.env.model_copy(update={"num_envs": few, "num_threads": 1})})
    with contextlib.suppress(Exception), recorded() as calls:
        MultiliftVec(small).reset(seed=0)
    print(TOTAL, len(calls), flush=True)
    return calls
