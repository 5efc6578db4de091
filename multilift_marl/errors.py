"""The package's exceptions: one sentence that names the culprit and the cure."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable


class ConfigError(ValueError):
    """A configuration, an override or a physical system that cannot be."""


class CheckpointError(RuntimeError):
    """A checkpoint that is missing, truncated or foreign."""


class RenderingError(RuntimeError):
    """Pictures were asked for and cannot be made."""


def nearest(name: str, names: Iterable[str], full: Callable[[str], str] = str, otherwise: str = "") -> str:
    """Return "; did you mean 'x'?" for the closest of `names`, or the list of them where none is close.

    Args:
        name: what was given.
        names: what is known.
        full: turns the closest into what is to be written in its place.
        otherwise: the cure where none is close.
    """
    names = sorted(names)
    close = difflib.get_close_matches(name, names, n=1, cutoff=0.5)
    return f"; did you mean '{full(close[0])}'?" if close else f"; known: {', '.join(names)}{otherwise}"


def pip_install(extra: str) -> str:
    """Return the command that installs an extra of this package, from an index or in a clone."""
    return f'pip install "multilift_marl[{extra}]" (in a clone: pip install -e ".[{extra}]")'
