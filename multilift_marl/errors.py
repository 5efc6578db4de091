"""The package's exceptions: one sentence that names the culprit and the cure."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


class ConfigError(ValueError):
    """A configuration, an override or a physical system that cannot be."""


class CheckpointError(RuntimeError):
    """A checkpoint that is missing, truncated or foreign."""


class RenderingError(RuntimeError):
    """Pictures were asked for and cannot be made."""


def nearest(name: str, names: Iterable[str]) -> str:
    """Return "; did you mean 'x'?" for the closest of `names`, or the list of them where none is close."""
    names = sorted(names)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean '{close[0]}'?" if close else f"; known: {', '.join(names)}"
