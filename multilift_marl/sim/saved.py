"""Saved states of environments: whether one fits, before anything is changed."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def fingerprint(value: Any, num_envs: int) -> np.ndarray:
    """Return the SHA-256 of nested dataclasses, sequences, arrays and plain values, (E, 32) uint8.

    Numbers count to six digits, so that it is the same on machines that round differently.
    """
    digest = hashlib.sha256(";".join(_parts(value)).encode())
    return np.tile(np.frombuffer(digest.digest(), np.uint8), (num_envs, 1))


def _parts(value: Any) -> Iterator[str]:
    if is_dataclass(value):
        for field in fields(value):
            yield field.name
            yield from _parts(getattr(value, field.name))
    elif isinstance(value, set | frozenset):
        yield from _parts(sorted(value))  # a set's own order differs from process to process
    elif isinstance(value, list | tuple) or np.ndim(value):
        yield f"{len(value)}:"
        for part in value:
            yield from _parts(part)
    elif isinstance(value, int | float):
        yield f"{value:.6g}" if abs(value) > 1e-12 else "0"
    else:
        yield str(value)


def flatten(record: Any, prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Return the arrays of a named tuple, those of named tuples within it too, by dotted name."""
    for name, value in record._asdict().items():
        if isinstance(value, tuple):
            yield from flatten(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value


def check_saved(saved: Mapping[str, Any], expected: Mapping[str, np.ndarray], diverged: str, *same: str) -> None:
    """Refuse a saved state that is none of these environments.

    Args:
        saved: as given by the user.
        expected: the state of the environments as they are.
        diverged: key of the environments in which numbers need not be finite.
        same: keys that must hold what `expected` holds: which system it is, which task.

    Raises:
        ValueError: a key is missing or unknown, or an array is of another shape or type, holds NaN or infinite numbers
            (where the environments hold none) or belongs to another system.
    """
    for key in sorted({*expected, *saved}, key=lambda key: (key != diverged, str(key))):  # that one first
        if wrong := _misfit(key, saved, expected, diverged, same):
            raise ValueError(f"the saved state does not fit these environments: '{key}' {wrong}")


def check_counts(saved: Mapping[str, np.ndarray], limits: Mapping[str, tuple[int, int]]) -> None:
    """Refuse a saved state, which fits otherwise, with whole numbers that no environment holds.

    Args:
        saved: as `check_saved` has accepted it.
        limits: least and largest value by key; keys that are not saved do not count.

    Raises:
        ValueError: naming the key.
    """
    for key, (low, high) in limits.items():
        array = saved.get(key)
        if array is not None and ((array < low) | (array > high)).any():
            odd = array[(array < low) | (array > high)].flat[0]
            raise ValueError(
                f"the saved state does not fit these environments: '{key}' holds {odd}, not from {low} to {high}; give "
                "what state_dict() returned"
            )


def _misfit(
    key: str, saved: Mapping[str, Any], expected: Mapping[str, np.ndarray], diverged: str, same: tuple[str, ...]
) -> str:  # fmt: skip
    cure = "use the configuration it was saved with"
    if key not in saved:
        return "is missing"
    if key not in expected:
        return f"is unknown; {cure}"
    array = saved[key]
    like = expected[key]
    if not isinstance(array, np.ndarray):
        return f"is {type(array).__name__}, expected an array; give what state_dict() returned"
    if array.shape != like.shape:
        return f"has shape {array.shape}, expected {like.shape}; {cure}"
    if array.dtype != like.dtype:
        return f"has dtype {array.dtype}, expected {like.dtype}; give what state_dict() returned"
    if key in same and (array != like).any():
        return f"is that of another; {cure}"
    if like.dtype.kind == "f":
        lost = np.isnan(array) | (np.isinf(array) & np.isfinite(like))
        if lost.any() and (lost.reshape(len(lost), -1).any(axis=1) & ~np.asarray(saved[diverged], bool)).any():
            return "holds NaN or infinite numbers; save environments that are sound"
    return ""
