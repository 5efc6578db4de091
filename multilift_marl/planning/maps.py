"""Maps of the task `navigate`: obstacles between a start and a goal, drawn from a seed.

Lengths are in units of the resting formation's width over that of four falcons (`unit_length`): a gap is narrow or wide
for a formation. A map is a function of level, course, seed and team alone.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.rig.system import System
from multilift_marl.sim.obstacles import BOX, CYLINDER, SPHERE, Obstacles, clear_obstacles, place_obstacle

LEVELS = ("sparse", "dense", "narrow", "unknown", "low")
CAPACITY = 16  # rows that a map of the usual length needs at most
FALCONS = 1.4637  # [m] width of the resting formation of four falcons
LENGTH = 8.0  # from start to goal, like the next ones in units of length
WIDTH = 3.0  # the payload may stray from the line between them
MARGIN = 1.4  # at both ends without obstacles
SIDE = 2.8  # obstacles stand as far as this to the sides of the middle
LEVEL = 1.4  # height of start and goal, at least
RISE = 0.2  # by which they may be higher
CEILING = 0.3  # of the payload above that level, 0.1 m added
PILLARS = {"sparse": (7, 1.15), "dense": (14, 0.72), "unknown": (11, 0.85)}  # how many on LENGTH; least gaps
RADIUS = 0.12, 0.32  # of pillars
GAPS = 0.5, 0.8  # range of the widths of a narrow map's gaps over the resting formation's
ALONE = 4.0
SPARE = 0.15  # that a gap is wider, and a slot higher, than the payload, at least
SLOTS = 1.0, 1.15  # range of the heights of a low map's slots over the resting formation's
DEPTH = 0.4, 0.8  # of those slots along the way
APART = 3.8  # from one to the next, at most
SILL = 0.45, 0.1  # from so far below the height of start and goal to so far above, their lower edges
ROOM = 0.05  # [m] above the payload over a sill
SPAN = 2.4  # length of a low formation, and ...
CLIMB = 0.25  # ... by how much of the way beyond that the next sill may be higher or lower
WALLS = 3  # of a narrow or low map
MAX_WALLS = CAPACITY // 2
_DRAWS = 4000


class Course(NamedTuple):
    """What a level leaves open."""

    length: float = LENGTH
    """From start to goal."""
    pillars: tuple[int, int] | None = None
    """Least and greatest number of pillars, where there is room; None: `PILLARS`, more on a longer course."""
    gaps: tuple[float, float] = GAPS
    walls: int = WALLS
    slots: tuple[float, float] = SLOTS

    @property
    def field(self) -> float:
        """How far before and behind the middle obstacles stand."""
        return self.length / 2 - MARGIN

    def most_pillars(self, level: str) -> int:
        """Return how many pillars a map of a level has at most."""
        usual = round(PILLARS[level][0] * self.field / COURSE.field)
        return usual if self.pillars is None else self.pillars[1]

    def capacity(self, level: str) -> int:
        """Return how many rows of obstacles the maps of a level need."""
        return max(CAPACITY, self.most_pillars(level)) if level in PILLARS else CAPACITY


COURSE = Course()


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
    """Return the greatest horizontal extent of the resting formation along x or y, drones included [m].

    Of a single drone, which cannot draw in, that counts `ALONE` times: gaps are narrower than formations.
    """
    half = np.array([vehicle.half_size for vehicle in system.vehicles])[:, :2]
    payload = system.payload_size[:2] / 2
    ends = np.vstack([system.slots[:, :2] + half, system.slots[:, :2] - half, payload, -payload])
    return float((ends.max(axis=0) - ends.min(axis=0)).max()) * (ALONE if system.num_drones == 1 else 1.0)


def formation_height(system: System) -> float:
    """Return the height of the resting formation from the payload's lowest point, drones included [m]."""
    above = system.slots[:, 2] + [vehicle.half_size[2] for vehicle in system.vehicles]
    half = float(system.payload_size[2]) / 2
    middle = float(system.payload_center[2])
    return max(float(above.max()), middle + half) - (middle - half)


def unit_length(system: System) -> float:
    """Return the unit of a map's lengths [m]."""
    return formation_width(system) / FALCONS


def draw_map(level: str, seed: int, system: System, course: Course = COURSE) -> Map:
    """Return the map of a level that belongs to a seed."""
    rng = np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(LEVELS.index(level),)))
    unit = unit_length(system)
    height = max(LEVEL * unit, float(system.payload_size[2]) + 0.5)
    start, goal = (
        np.array([side * course.length / 2 * unit, rng.uniform(-0.8, 0.8) * unit, height + rng.uniform(0, RISE) * unit])
        for side in (-1, 1)
    )
    low = np.array([-(course.length / 2 + 1.0) * unit, -WIDTH * unit, 0.6 * height])
    high = np.array([(course.length / 2 + 1.0) * unit, WIDTH * unit, height + 0.1 + CEILING * unit])
    # No team flies over what stands on the ground, its cables upright and the payload at the ceiling.
    reach = float(system.cable_length.max() + np.linalg.norm(system.anchors, axis=1).max())
    tall = high[2] + reach + 0.1
    if level == "low":
        placed = _slots(rng, unit, tall, height, system, course)
    elif level == "narrow":
        least = float(system.payload_size[:2].min()) + SPARE * unit
        placed = _walls(rng, unit, tall, (formation_width(system), least), course)
    else:
        balls, count = (height - 0.2 * unit, height + reach), course.most_pillars(level)
        if course.pillars is not None:
            count = int(rng.integers(course.pillars[0], count + 1))
        placed = _pillars(rng, unit, tall, balls, count, PILLARS[level][1], course.field)
    return Map(start, goal, low, high, tuple(placed))


def place_map(env: int, drawn: Map, obstacles: Obstacles, first: int = 0) -> None:
    """Put a map's obstacles into the rows of one environment from `first` on."""
    clear_obstacles(env, obstacles, first)
    for row, each in enumerate(drawn.obstacles, first):
        place_obstacle(env, row, obstacles, *each)


def _pillars(
    rng: np.random.Generator, unit: float, tall: float, balls: tuple[float, float], count: int, apart: float,
    field: float,
) -> list[Obstacle]:  # fmt: skip
    """Draw pillars `tall` [m], round and square, and, one in five, balls between two heights, surfaces `apart`."""
    placed: list[Obstacle] = []
    discs = np.zeros((0, 3))
    for _ in range(_DRAWS):
        if len(placed) == count:
            break
        x, y = rng.uniform((-field, -SIDE), (field, SIDE)) * unit
        radius = rng.uniform(*RADIUS) * unit
        gaps = np.hypot(discs[:, 0] - x, discs[:, 1] - y) - discs[:, 2] - radius
        if (gaps < apart * unit).any():
            continue
        discs = np.vstack([discs, (x, y, radius)])
        form, turned, height = rng.uniform(), rng.uniform(0.0, pi / 2), rng.uniform(*balls)
        if form < 0.2:
            placed.append(Obstacle(SPHERE, (radius, radius, radius), (x, y, height), 0.0))
        elif form < 0.6:
            placed.append(Obstacle(CYLINDER, (radius, radius, tall / 2), (x, y, tall / 2), 0.0))
        else:
            half = radius / 2**0.5  # its corners on the circle
            placed.append(Obstacle(BOX, (half, half, tall / 2), (x, y, tall / 2), turned))
    return placed


def _slots(
    rng: np.random.Generator, unit: float, tall: float, height: float, system: System, course: Course
) -> list[Obstacle]:
    """Draw walls `tall` [m] across the way, each open between a sill and a beam from one side to the other.

    `height`: of start and goal, at least [m].
    """
    placed, walls = [], course.walls
    apart = min(APART, 2 * course.field / max(walls - 1, 1))
    step = CLIMB * max(apart - SPAN, 0.0)
    level = rng.uniform(-SILL[0], SILL[1])
    thick, resting = float(system.payload_size[2]), formation_height(system)
    # Over its sill the payload is below the ceiling, with room for a route.
    most = height + CEILING * unit - thick / 2 + float(system.payload_center[2]) - ROOM
    for wall in range(walls):
        x = ((wall - (walls - 1) / 2) * apart + rng.uniform(-0.1, 0.1)) * unit
        half = 0.5 * rng.uniform(*DEPTH) * unit
        sill = min(height + level * unit, most)
        beam = sill + max(rng.uniform(*course.slots) * resting, thick + SPARE * unit)
        for foot, top in ((0.0, sill), (beam, max(tall, beam + 0.1))):
            size = half, (WIDTH + 1.5) * unit, (top - foot) / 2
            placed.append(Obstacle(BOX, size, (x, 0.0, (foot + top) / 2), 0.0))
        level = float(np.clip(level + rng.uniform(-step, step), -SILL[0], SILL[1]))
    return placed


def _walls(
    rng: np.random.Generator, unit: float, tall: float, widths: tuple[float, float], course: Course
) -> list[Obstacle]:
    """Draw walls `tall` [m] across the way with gaps: as `gaps` over the first of `widths`, at least the second [m]."""
    placed, walls = [], course.walls
    thick, end, top = 0.1 * unit, (WIDTH + 1.5) * unit, tall / 2
    middle = rng.uniform(-0.3, 0.3) * unit
    for wall in range(walls):
        x = (wall - (walls - 1) / 2) * min(2.2, 2 * course.field / max(walls, 1)) * unit + rng.uniform(-0.2, 0.2) * unit
        half = 0.5 * max(rng.uniform(*course.gaps) * widths[0], widths[1])
        middle = float(np.clip(middle + rng.uniform(-1.4, 1.4) * unit, -2.0 * unit, 2.0 * unit))
        lean = rng.uniform(-0.15, 0.15)  # of the wall from the perpendicular [rad]
        for side in (-1.0, 1.0):
            length = (end - side * middle - half) / 2
            out = side * (half + length)
            place = (x - sin(lean) * out, middle + cos(lean) * out, top)
            placed.append(Obstacle(BOX, (thick, length, top), place, lean))
    return placed
