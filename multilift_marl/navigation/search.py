"""Search for a way among obstacles: A* over position, yaw and shape of a team, on a lattice.

A state is a cell, a yaw and a shape of `FormationShapes.choices`. A step goes to one of 26 neighbouring cells, to the
next yaw or to a linked shape. States are checked as they are reached. The heuristic is the payload's own shortest way
to the goal, which costs more where it is close to obstacles.
"""

from __future__ import annotations

from math import cos, pi, prod, sin, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import kernel
from multilift_marl.navigation.formation_shapes import FormationShapes
from multilift_marl.navigation.team_clearance import (
    Scene,
    TeamBody,
    local_point,
    payload_clearance,
    team_clearance,
    team_reach,
    write_arms,
)
from multilift_marl.sim.obstacle_distance import local_distance

YAWS = 16  # of the lattice
MOST = 200_000_000  # states of a lattice: 4 GB, of which few are ever touched
GREED = 1.3  # [-] weight of the heuristic: the way found costs at most so many times the least
CAUTION = 2.0  # [-] cost of a metre beside obstacles, and ...
SQUEEZE = 0.3  # ... of one in the narrowest shape, over one in the open
CLIMB = 1.5  # [-] of a metre of height
TURN = 0.5  # [m] cost of a radian of yaw
RESHAPE = 0.4  # [m] of a mode
UNKNOWN = 1e9
MEASURED, REACHED, CLOSED = 1, 2, 4


class Lattice(NamedTuple):
    """The states of a search."""

    low: np.ndarray
    """(3,) position of the first cell [m]."""
    step: np.ndarray
    """(3,) between cells [m]."""
    counts: np.ndarray
    """(3,) int64 cells."""
    yaw: float
    """[rad] of the first yaw."""
    arms: np.ndarray
    """(S, N, 3) of each shape, see `write_arms`."""
    reach: np.ndarray
    """(S,) see `team_reach`."""
    size: np.ndarray
    """(S,) sum of each shape's coordinates, 0 at rest."""
    linked: np.ndarray
    """(S, S) see `FormationShapes`."""
    goal: np.ndarray
    """(2,) int64 cell and yaw of the goal, whose shape is the resting one."""
    clearance: np.ndarray
    """(2,) from obstacles at least, and that beyond which more is worth nothing [m]."""


class SearchWork(NamedTuple):
    """Arrays of a search over Q states, of which few are ever used."""

    status: np.ndarray
    """(Q,) uint8, a sum of MEASURED, REACHED and CLOSED; 0 of a state not looked at."""
    cost: np.ndarray
    """(Q,) of the best way to each [m], if REACHED."""
    clearance: np.ndarray
    """(Q,) of each [m], if MEASURED."""
    parent: np.ndarray
    """(Q,) int32 the state before it, if REACHED."""
    price: np.ndarray
    """(C,) of a metre of the payload's way in each cell, `UNKNOWN` where it does not fit."""
    ahead: np.ndarray
    """(C,) heuristic of each cell [m]."""
    key: np.ndarray
    """(H,) of the heap."""
    state: np.ndarray
    """(H,) int32 of the heap."""


class Search(NamedTuple):
    """A search: its states, the team and the obstacles, and its arrays."""

    lattice: Lattice
    body: TeamBody
    scene: Scene
    work: SearchWork


def make_lattice(
    start: np.ndarray, goal: np.ndarray, space: np.ndarray, step: np.ndarray, body: TeamBody, shapes: FormationShapes,
    clearance: tuple[float, float],
) -> Lattice:  # fmt: skip
    """Return the lattice of a search, which has a state at the start.

    Args:
        start, goal: (4,) x, y, z [m] and yaw [rad].
        space: (2, 3) lowest and highest position of the payload [m].
        step: (3,) between cells [m].
        body, shapes: the team.
        clearance: see `Lattice`.
    """
    below = np.floor((start[:3] - space[0]) / step + 1e-6).astype(np.int64)
    above = np.floor((space[1] - start[:3]) / step + 1e-6).astype(np.int64)
    low, count = start[:3] - below * step, below + above + 1
    cell = np.clip(np.rint((goal[:3] - low) / step).astype(np.int64), 0, count - 1)
    turned = (goal[3] - start[3] + pi) % (2 * pi) - pi
    arms = np.zeros((len(shapes.choices), *body.rest.shape))
    for shape, coordinates in enumerate(shapes.choices):
        write_arms(coordinates, body, arms[shape])
    return Lattice(
        low=low,
        step=step,
        counts=count,
        yaw=float(start[3]),
        arms=arms,
        reach=np.array([team_reach(each, body) for each in arms]),
        size=np.abs(shapes.choices).sum(axis=1),
        linked=shapes.linked,
        goal=np.array([(cell[0] * count[1] + cell[1]) * count[2] + cell[2], round(turned / (2 * pi / YAWS)) % YAWS]),
        clearance=np.array(clearance),
    )


def search_route(
    lattice: Lattice, start: np.ndarray, shape: int, body: TeamBody, scene: Scene, most: int
) -> tuple[np.ndarray, int]:
    """Return the states (K,) of the best way found, none if there is none, and how many states were expanded.

    Args:
        lattice: of the search.
        start, shape: (4,) its first state's pose, the choice of its shape.
        body, scene: the team and the obstacles.
        most: states to expand.

    Raises:
        ConfigError: more states than `MOST`.
    """
    cells = prod(lattice.counts.tolist())
    states = cells * YAWS * len(lattice.arms)
    if states > MOST:
        low, high = (np.round(end, 2).tolist() for end in (lattice.low, lattice.low + lattice.step * lattice.counts))
        raise ConfigError(
            f"the payload's space from {low} to {high} m has {states:.2g} states of a search for a route, more than "
            f"{MOST:.0e}; bound it closer to the way, by task_options.low and task_options.high"
        )
    work = SearchWork(
        status=np.zeros(states, np.uint8),
        cost=np.empty(states),
        clearance=np.empty(states),
        parent=np.empty(states, np.int32),
        price=np.full(cells, UNKNOWN),
        ahead=np.full(cells, UNKNOWN),
        key=np.empty(max(8 * cells, 24 * most) + 64),
        state=np.empty(max(8 * cells, 24 * most) + 64, np.int32),
    )
    search = Search(lattice, body, scene, work)
    measure_way(search)
    cell = np.rint((start[:3] - lattice.low) / lattice.step).astype(np.int64)
    first = (cell[0] * lattice.counts[1] + cell[1]) * lattice.counts[2] + cell[2]
    last, expanded = expand_states(int(first) * YAWS * len(lattice.arms) + shape, search, most)
    if last < 0:
        return np.zeros(0, np.int64), expanded
    way = [last]
    while work.parent[way[-1]] >= 0:
        way.append(int(work.parent[way[-1]]))
    return np.array(way[::-1]), expanded


def states_at(way: np.ndarray, lattice: Lattice, shapes: FormationShapes) -> np.ndarray:
    """Return position, yaw (without leaps) and shape of states (K,), (K, 4 + J)."""
    count = len(lattice.arms)
    cell, yaw, shape = way // (YAWS * count), way // count % YAWS, way % count
    index = np.stack([cell // lattice.counts[2] // lattice.counts[1], cell // lattice.counts[2] % lattice.counts[1],
                      cell % lattice.counts[2]], axis=1)  # fmt: skip
    turned = np.unwrap(lattice.yaw + yaw * (2 * pi / YAWS))
    return np.column_stack([lattice.low + index * lattice.step, turned, shapes.choices[shape]])


@kernel
def push(work, size, key, state):
    """Put a state on the heap of `size`; return its new size."""
    if size >= work.key.shape[0]:
        return size
    i = size
    while i > 0:
        above = (i - 1) // 2
        if work.key[above] <= key:
            break
        work.key[i], work.state[i] = work.key[above], work.state[above]
        i = above
    work.key[i], work.state[i] = key, state
    return size + 1


@kernel
def pop(work, size):
    """Take the first state off the heap; return it and the new size."""
    first = work.state[0]
    size -= 1
    key, state = work.key[size], work.state[size]
    i = 0
    while True:
        below = 2 * i + 1
        if below >= size:
            break
        if below + 1 < size and work.key[below + 1] < work.key[below]:
            below += 1
        if work.key[below] >= key:
            break
        work.key[i], work.state[i] = work.key[below], work.state[below]
        i = below
    work.key[i], work.state[i] = key, state
    return first, size


@kernel
def measure_way(search):
    """Write the payload's way from each cell to the goal (Dijkstra), `UNKNOWN` where there is none."""
    lattice, body, scene, work = search
    # How close each cell is to obstacles.
    count, step = lattice.counts, lattice.step
    thinnest = min(body.half[0], body.half[1], body.half[2]) + lattice.clearance[0]
    wide = lattice.reach[0] + lattice.clearance[1]
    across, layer = count[2], count[1] * count[2]
    goal = lattice.goal[0]
    for cell in range(work.price.shape[0]):
        place = place_of(cell, 0.0, lattice)
        here, far = (place[0], place[1], place[2]), wide
        for m in range(scene.kind.shape[0]):
            far = min(far, local_distance(scene.kind[m], scene.size[m], local_point(scene, m, here))[0])
        if cell == goal or (far >= thinnest and _payload_fits(cell, far, lattice, body, scene)):
            work.price[cell] = 1.0 + CAUTION * (1.0 - max(far, 0.0) / wide) ** 2

    # From the goal outwards.
    work.ahead[goal] = 0.0
    size = push(work, 0, 0.0, goal)
    while size > 0:
        key = work.key[0]
        cell, size = pop(work, size)
        if key > work.ahead[cell]:
            continue
        x, y, z = cell // layer, cell // across % count[1], cell % across
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    u, v, w = x + i, y + j, z + k
                    if u < 0 or v < 0 or w < 0 or u >= count[0] or v >= count[1] or w >= count[2]:
                        continue
                    other = u * layer + v * across + w
                    length = sqrt((i * step[0]) ** 2 + (j * step[1]) ** 2 + (CLIMB * k * step[2]) ** 2)
                    cost = key + 0.5 * (work.price[cell] + work.price[other]) * length
                    if work.price[other] < UNKNOWN and cost < work.ahead[other]:
                        work.ahead[other] = cost
                        size = push(work, size, cost, other)


@kernel
def _payload_fits(cell, far, lattice, body, scene):
    """Return whether the payload alone fits into a cell at one of the yaws; `far`: that from obstacles [m]."""
    widest = 0.0
    for i in range(3):
        widest += (abs(body.center[i]) + body.half[i]) ** 2
    least = lattice.clearance[0]
    if far >= sqrt(widest) + least:
        return True
    for yaw in range(YAWS // 2):  # its box is the same turned by π
        place, fits = place_of(cell, yaw * 1.0, lattice), True
        here, c, s = (place[0], place[1], place[2]), cos(place[3]), sin(place[3])
        for m in range(scene.kind.shape[0]):
            fits = fits and payload_clearance(scene, m, here, c, s, body, least)[0] >= least
        if fits:
            return True
    return False


@kernel
def check_state(state, search):
    """Return the clearance of a state [m], measured once."""
    lattice, body, scene, work = search
    if not work.status[state] & MEASURED:
        work.status[state] |= MEASURED
        shapes = lattice.arms.shape[0]
        cell, yaw, shape = state // (YAWS * shapes), state // shapes % YAWS, state % shapes
        work.clearance[state] = team_clearance(
            place_of(cell, yaw * 1.0, lattice), lattice.arms[shape], body, scene, lattice.reach[shape],
            lattice.clearance[1],
        )  # fmt: skip
    return work.clearance[state]


@kernel
def place_of(cell, yaw, lattice):
    """Return x, y, z and yaw of a cell at a yaw of the lattice."""
    count, low, step = lattice.counts, lattice.low, lattice.step
    x, y, z = cell // (count[1] * count[2]), cell // count[2] % count[1], cell % count[2]
    return low[0] + x * step[0], low[1] + y * step[1], low[2] + z * step[2], lattice.yaw + yaw * (2.0 * pi / YAWS)


@kernel
def still_ahead(cell, yaw, shape, lattice, work):
    """Return the heuristic of a state [m]: of its cell, its yaw and its shape."""
    turned = abs(yaw - lattice.goal[1])
    turned = min(turned, YAWS - turned)
    return work.ahead[cell] + TURN * turned * (2.0 * pi / YAWS) + RESHAPE * lattice.size[shape]


@kernel
def reach_state(state, other, length, search, size):
    """Let a way lead from a state to another if that is free, and the best to it so far; return the heap's new size."""
    lattice, body, scene, work = search
    status = work.status[other]
    if status & CLOSED or (status & REACHED and work.cost[state] + length >= work.cost[other]):
        return size
    shapes = lattice.arms.shape[0]
    cell, yaw, shape = other // (YAWS * shapes), other // shapes % YAWS, other % shapes
    if work.ahead[cell] >= UNKNOWN:
        return size
    clear = check_state(other, search)
    if clear < lattice.clearance[0]:
        return size
    # A thin obstacle may be between two states whose clearances do not overlap.
    before = state // (YAWS * shapes)
    if cell != before and clear + work.clearance[state] < length:
        a, b = place_of(before, yaw * 1.0, lattice), place_of(cell, yaw * 1.0, lattice)
        middle = (0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]), 0.5 * (a[2] + b[2]), a[3])
        between = team_clearance(middle, lattice.arms[shape], body, scene, lattice.reach[shape], lattice.clearance[1])
        if between < lattice.clearance[0]:
            return size
    short = 1.0 - clear / lattice.clearance[1]
    cost = work.cost[state] + length * (1.0 + CAUTION * short * short + SQUEEZE * lattice.size[shape])
    if status & REACHED and cost >= work.cost[other]:
        return size
    work.cost[other], work.parent[other] = cost, state
    work.status[other] |= REACHED
    return push(work, size, cost + GREED * still_ahead(cell, yaw, shape, lattice, work), other)


@kernel
def expand_states(first, search, most):
    """Expand states from the first in order of cost and heuristic; return the goal's, or -1, and how many."""
    lattice, work = search.lattice, search.work
    count, step = lattice.counts, lattice.step
    shapes = lattice.arms.shape[0]
    across, layer = count[2], count[1] * count[2]
    work.cost[first], work.parent[first] = 0.0, -1
    work.status[first] |= REACHED
    check_state(first, search)
    size, expanded = push(work, 0, 0.0, first), 0
    while size > 0 and expanded < most:
        state, size = pop(work, size)
        if work.status[state] & CLOSED:
            continue
        work.status[state] |= CLOSED
        expanded += 1
        cell, yaw, shape = state // (YAWS * shapes), state // shapes % YAWS, state % shapes
        if cell == lattice.goal[0] and yaw == lattice.goal[1] and shape == 0:
            return state, expanded

        # to the neighbouring cells
        x, y, z = cell // layer, cell // across % count[1], cell % across
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    u, v, w = x + i, y + j, z + k
                    if u < 0 or v < 0 or w < 0 or u >= count[0] or v >= count[1] or w >= count[2]:
                        continue
                    other = ((u * layer + v * across + w) * YAWS + yaw) * shapes + shape
                    length = sqrt((i * step[0]) ** 2 + (j * step[1]) ** 2 + (CLIMB * k * step[2]) ** 2)
                    if length > 0.0:
                        size = reach_state(state, other, length, search, size)

        # to the next yaws and shapes
        for turned in range(-1, 2, 2):
            other = (cell * YAWS + (yaw + turned) % YAWS) * shapes + shape
            size = reach_state(state, other, TURN * 2.0 * pi / YAWS, search, size)
        for form in range(shapes):
            if lattice.linked[shape, form]:
                other = (cell * YAWS + yaw) * shapes + form
                size = reach_state(state, other, 0.5 * RESHAPE, search, size)
    return -1, expanded
