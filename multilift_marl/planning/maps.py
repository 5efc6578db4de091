"""Maps of the task `navigate`: obstacles between a start and a goal, drawn from a seed.

Lengths are in units of the resting formation's width over that of four falcons (`unit_length`), so that a level is as
hard for every team: a gap is narrow or wide for a formation. A map is a function of level, seed and team alone.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.rig.system import System
from multilift_marl.sim.obstacles import BOX, CYLINDER, SPHERE, Obstacles, clear_obstacles, place_obstacle

LEVELS = ("sparse", "dense", "narrow", "unknown")
CAPACITY = 16  # rows that a map needs at most
FALCONS = 1.48  # [m] width of the resting formation of four falcons
LENGTH = 8.0  # from start to goal, like the next ones in units of length
WIDTH = 3.0  # the payload may stray from the line between them
FIELD = 2.6  # obstacles stand as far as this before and behind the middle, and ...
SIDE = 2.8  # ... to its sides
TALL = 3.0  # height of pillars and walls, more than a team under the ceiling reaches
LEVEL = 1.4  # height of start and goal, at least
CEILING = 1.7  # of the payload
PILLARS = {"sparse": (7, 1.15), "dense": (14, 0.72), "unknown": (11, 0.85)}  # how many; least gaps between them
RADIUS = 0.12, 0.32  # of pillars
GAPS = 0.5, 0.8  # range of the widths of a narrow map's gaps over the resting formation's
WALLS = 3  # of a narrow map
MAX_WALLS = CAPACITY // 2
_DRAWS = 4000


class Obstacle(NamedTuple):
    """A fixed obstacle, see `obstacles.place_obstacle`."""

    kind: int
    size: tuple[float, float, float]
    position: tuple[float, float, float]
    yaw: float


class Map(NamedTuple):
    """Obstacles between a start and a goal [m]."""

    start: np.ndarray
    """(3,) of the payload, which heads along x."""
    goal: np.ndarray
    """(3,)."""
    low: np.ndarray
    """(3,) of the space that the payload may use."""
    high: np.ndarray
    obstacles: tuple[Obstacle, ...]


def formation_width(system: System) -> float:
    """Return the greatest horizontal extent of the resting formation along x or y, drones included [m]."""
    half = np.array([vehicle.half_size for vehicle in system.vehicles])[:, :2]
    payload = system.payload_size[:2] / 2
    ends = np.vstack([system.slots[:, :2] + half, system.slots[:, :2] - half, payload, -payload])
    return float((ends.max(axis=0) - ends.min(axis=0)).max())


def unit_length(system: System) -> float:
    """Return the unit of a map's lengths [m]."""
    return formation_width(system) / FALCONS


def draw_map(level: str, seed: int, system: System, gaps: tuple[float, float] = GAPS, walls: int = WALLS) -> Map:
    """Return the map of a level that belongs to a seed; a narrow one has `walls` with `gaps`."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(LEVELS.index(level),)))
    unit = unit_length(system)
    height = max(LEVEL * unit, float(system.payload_size[2]) + 0.5)
    start = np.array([-LENGTH / 2 * unit, rng.uniform(-0.8, 0.8) * unit, height])
    goal = np.array([LENGTH / 2 * unit, rng.uniform(-0.8, 0.8) * unit, height])
    low = np.array([-(LENGTH / 2 + 1.0) * unit, -WIDTH * unit, 0.6 * height])
    high = np.array([(LENGTH / 2 + 1.0) * unit, WIDTH * unit, max(CEILING * unit, height + 0.3)])
    placed = (
        _walls(rng, unit, formation_width(system), gaps, walls)
        if level == "narrow"
        else _pillars(rng, unit, *PILLARS[level])
    )
    return Map(start, goal, low, high, tuple(placed))


def place_map(env: int, drawn: Map, obstacles: Obstacles, first: int = 0) -> None:
    """Put a map's obstacles into the rows of one environment from `first` on."""
    clear_obstacles(env, obstacles, first)
    for row, each in enumerate(drawn.obstacles, first):
        place_obstacle(env, row, obstacles, *each)


def _pillars(rng: np.random.Generator, unit: float, count: int, apart: float) -> list[Obstacle]:
    """Draw round and square pillars and, one in five, balls in mid-air, surfaces `apart` from each other."""
    placed: list[Obstacle] = []
    discs = np.zeros((0, 3))
    for _ in range(_DRAWS):
        if len(placed) == count:
            break
        x, y = rng.uniform((-FIELD, -SIDE), (FIELD, SIDE)) * unit
        radius = rng.uniform(*RADIUS) * unit
        gaps = np.hypot(discs[:, 0] - x, discs[:, 1] - y) - discs[:, 2] - radius
        if (gaps < apart * unit).any():
            continue
        discs = np.vstack([discs, (x, y, radius)])
        form, turned, height = rng.uniform(), rng.uniform(0.0, pi / 2), rng.uniform(1.2, 2.4) * unit
        if form < 0.2:
            placed.append(Obstacle(SPHERE, (radius, radius, radius), (x, y, height), 0.0))
        elif form < 0.6:
            placed.append(Obstacle(CYLINDER, (radius, radius, TALL * unit / 2), (x, y, TALL * unit / 2), 0.0))
        else:
            half = radius / 2**0.5  # its corners on the circle
            placed.append(Obstacle(BOX, (half, half, TALL * unit / 2), (x, y, TALL * unit / 2), turned))
    return placed


def _walls(
    rng: np.random.Generator, unit: float, width: float, gaps: tuple[float, float], walls: int
) -> list[Obstacle]:
    """Draw walls across the way, each with a gap of a width between `gaps` over the formation's `width` [m]."""
    placed = []
    thick, end, top = 0.1 * unit, (WIDTH + 1.5) * unit, TALL * unit / 2
    middle = rng.uniform(-0.3, 0.3) * unit
    for wall in range(walls):
        x = (wall - (walls - 1) / 2) * min(2.2, 2 * FIELD / max(walls, 1)) * unit + rng.uniform(-0.2, 0.2) * unit
        half = 0.5 * rng.uniform(*gaps) * width
        middle = float(np.clip(middle + rng.uniform(-1.4, 1.4) * unit, -2.0 * unit, 2.0 * unit))
        lean = rng.uniform(-0.15, 0.15)  # of the wall from the perpendicular [rad]
        for side in (-1.0, 1.0):
            length = (end - side * middle - half) / 2
            out = side * (half + length)
            place = (x - sin(lean) * out, middle + cos(lean) * out, top)
            placed.append(Obstacle(BOX, (thick, length, top), place, lean))
    return placed
