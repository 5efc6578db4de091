"""What stands around in a task, to be drawn: see `Task.scenery`."""

from __future__ import annotations

from typing import NamedTuple


class Box(NamedTuple):
    """A box to draw."""

    size: tuple[float, float, float]
    """Half its edges [m]."""
    position: tuple[float, float, float]
    """Of its middle [m]."""
    rgba: tuple[float, float, float, float]
    """Colour and opacity, 0 to 1."""
