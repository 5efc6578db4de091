"""Kernels as Python: closed forms of small functions, without a minute of compiling."""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType, ModuleType, SimpleNamespace
from typing import Any

import numpy as np

from multilift_marl.kernels.compiler import Kernel
from multilift_marl.math3d import axis_angle

_known: dict[Any, Callable[..., Any]] = {}


def plain(function: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel as Python, with all that it calls."""
    python = getattr(function, "py_func", function)
    if python not in _known:
        scope = dict(python.__globals__)
        copy = FunctionType(python.__code__, scope, python.__name__, python.__defaults__, python.__closure__)
        _known[python] = copy
        used = python.__code__.co_names
        for name in used:
            value = scope.get(name)
            if isinstance(value, Kernel):
                scope[name] = plain(value)
            elif isinstance(value, ModuleType) and value.__name__.startswith("multilift_marl"):
                parts = {part: getattr(value, part) for part in used if hasattr(value, part)}
                scope[name] = SimpleNamespace(
                    **{part: plain(each) if isinstance(each, Kernel) else each for part, each in parts.items()}
                )
    return _known[python]


def turned(axis, angle: float) -> np.ndarray:
    """Return the rotation (3, 3) by an angle [rad] about an axis of any length."""
    return np.array(plain(axis_angle)(tuple(np.array(axis, float) / np.linalg.norm(axis)), angle)).reshape(3, 3)


def record(**fields: Any) -> SimpleNamespace:
    """Return what has these fields, in place of a named tuple with many more."""
    return SimpleNamespace(**fields)
