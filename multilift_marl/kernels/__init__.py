"""Compiled functions for tasks, rewards and observations of one's own.

- `inlined`: a small function that kernels call, such as a reward term; compiled with them.
- `kernel`: a function that Python calls; compiled at its first call.
- `drawing`: the same, with a generator of random numbers among its arguments, such as a task's start.
"""

from __future__ import annotations

from multilift_marl.kernels.jit import drawing, inlined, kernel

__all__ = ["drawing", "inlined", "kernel"]
