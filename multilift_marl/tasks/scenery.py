"""What stands around in a task, to be drawn: see `Task.scenery`."""

from __future__ import annotations

from typing import NamedTuple

from multilift_marl.math3d import IDENTITY
from multilift_marl.rig.obstacles import BOX, NONE
from multilift_marl.sim.obstacles import Obstacles

_GREY = (0.42, 0.47, 0.53, 0.6)
_MOVING = (0.80, 0.45, 0.20, 0.8)


class Box(NamedTuple):
    """A box to draw, or another body of `rig.obstacles` that fits into it."""

    size: tuple[float, float, float]
    """Half its edges [m]."""
    position: tuple[float, float, float]
    """Of its middle [m]."""
    rgba: tuple[float, float, float, float]
    """Colour and opacity, 0 to 1."""
    rotation: tuple[float, ...] = IDENTITY
    """9 numbers, its own frame to world."""
    kind: int = BOX
    """BOX, CYLINDER, SPHERE or HULL."""
    hull: int = 0
    """Number of a HULL."""


def draw_obstacles(env: int, obstacles: Obstacles) -> list[Box]:
    """Return the obstacles of one environment, moving ones in a colour of their own."""
    shown = []
    for m, kind in enumerate(obstacles.kind[env].tolist()):
        if kind != NONE:
            size, place = (tuple(array[env, m].tolist()) for array in (obstacles.size, obstacles.position))
            colour = _MOVING if obstacles.travel[env, m].any() else _GREY
            turned = tuple(obstacles.rotation[env, m].ravel().tolist())
            shown.append(Box(size, place, colour, turned, kind, int(obstacles.hull[env, m])))
    return shown
