"""Shapes of a formation that hold the payload at rest: the resting one, narrow and low ones, and all between them.

Cable forces f = f₀ + Σ c_j m_j balance the payload's weight for any coordinates c, since the modes m_j are internal
forces: neither sum nor moment. They point along the cables, so that they are the formation's shape. Each mode leads
straight to the narrowest formation across one axis of the payload, or to the lowest one, that keeps drones and cables
apart, cables taut and steep; there c_j = 1.
"""

from __future__ import annotations

from math import atan2, hypot
from typing import NamedTuple

import numpy as np

from multilift_marl.control.cable_forces import RANK, wrench_matrix
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, norm, put, row, scale, segment_distance, sub, unit
from multilift_marl.mdp.failures import make_limits
from multilift_marl.remember import remember
from multilift_marl.rig.separation import SAFE_SPARE
from multilift_marl.rig.system import System

MIN_TENSION = 0.25  # of each cable over its resting one
MAX_TENSION = 2.0
MAX_LEAN = np.deg2rad(50.0)  # of cables from the vertical, or 5° more than at rest
CABLE_SPARE = 1.2  # distance of cables over the limit
MIN_GAIN = 0.02  # [m] by which a mode narrows or lowers the formation, at least
_SHARES = np.arange(1, 9) / 8  # of a mode at which it is to be flown
_CAUTION = 0.005  # beyond all limits, and ...
_PENALTY = 10.0  # of what breaks them, over extents, while the least shape is searched for
_LONGER, _DRAWN_IN = (1.0, 1.5, 2.0), (0.5, 0.25, 0.0)
_SCALES = (  # of level forces along x and y, to begin, by the axis whose extent is to be least
    [(narrow, along) for along in _LONGER for narrow in _DRAWN_IN],
    [(along, narrow) for along in _LONGER for narrow in _DRAWN_IN],
    [(wide, wide) for wide in (1.3, 1.6, 2.0)],
)
_PARTS = 1.0, 0.98, 0.95, 0.9, 0.8, 0.7  # of a mode that ends outside the limits, tried in turn, and ...
_LOW_PARTS = 1.0, 0.98, 0.95, 0.94, 0.93, 0.92, 0.91, 0.9, 0.8, 0.7  # ... of the lowest
_ITERATIONS = 60
_STEP = 1e-6  # of finite differences, over the largest force


class FormationShapes(NamedTuple):
    """Cable forces at rest of all shapes: `rest` + Σ c_j `modes`_j; and of shapes that a search chooses from."""

    rest: np.ndarray
    """(N, 3) of the resting formation, in the payload's heading frame [N]."""
    modes: np.ndarray
    """(J, N, 3) internal forces [N], the lowest last; none of one drone, or where no shape is narrower or lower."""
    choices: np.ndarray
    """(S, J) coordinates c of the shapes to choose from, the resting one first."""
    linked: np.ndarray
    """(S, S) bool, whether one may become the other directly."""

    def forces(self, coordinates: np.ndarray) -> np.ndarray:
        """Return the cable forces (..., N, 3) of coordinates (..., J) [N]."""
        return self.rest + np.tensordot(coordinates, self.modes, axes=1)


class ShapeLimits(NamedTuple):
    """What a shape has to keep, and the geometry by which it is measured."""

    anchors: np.ndarray
    length: np.ndarray
    tension: np.ndarray
    """(N,) at rest [N]."""
    separation: np.ndarray
    """(N, N) of drones, at least [m]."""
    cables: np.ndarray
    """(N, N) distances of cables, at least [m]."""
    lean: np.ndarray
    """(N,) of cables, at most [rad]."""


def make_shape_limits(system: System) -> ShapeLimits:
    """Return the limits of a team's shapes."""
    force = system.formation_force
    lean = np.arctan2(np.hypot(force[:, 0], force[:, 1]), force[:, 2])
    return ShapeLimits(
        anchors=system.anchors,
        length=system.cable_length,
        tension=np.linalg.norm(force, axis=1),
        separation=SAFE_SPARE * system.min_separation,
        cables=CABLE_SPARE * make_limits(system).cables,
        lean=np.maximum(MAX_LEAN, lean + np.deg2rad(5.0)),
    )


def drone_places(system: System, forces: np.ndarray) -> np.ndarray:
    """Return where drones are in the payload's frame, (..., N, 3) [m], whose cables exert forces (..., N, 3)."""
    along = forces / np.linalg.norm(forces, axis=-1, keepdims=True)
    return system.anchors + system.cable_length[:, None] * along


def find_breach(forces: np.ndarray, system: System) -> str | None:
    """Return which limit of a shape its cable forces (N, 3) [N] break, in words; None if none."""
    limits = make_shape_limits(system)
    spare = np.zeros(num_spares(len(forces)))
    write_spares(forces, limits, spare)
    n = len(forces)
    pairs = n * (n - 1) // 2
    names = ["the distance of drones"] * pairs + ["the distance of cables"] * pairs
    names += ["the tension of a cable"] * 2 * n + ["the lean of a cable"] * n
    worst = int(spare.argmin())
    return names[worst] if spare[worst] < -1e-9 else None


@remember
def make_shapes(system: System, low: bool = False) -> FormationShapes:
    """Return the shapes of a team, with `low` also low ones; those of an equal system are remembered."""
    rest = system.formation_force.copy()
    limits = make_shape_limits(system)
    modes = []
    if system.num_drones > 1:
        free = _internal_forces(system)
        found = (_least(axis, system, limits, free) for axis in ((1, 0, 2) if low else (1, 0)))
        modes = [mode for mode in found if mode is not None]
    shapes = FormationShapes(rest, np.array(modes).reshape(-1, *rest.shape), np.zeros((0, 0)), np.zeros((0, 0)))
    return _with_choices(shapes, limits)


def has_low(modes: np.ndarray, system: System) -> bool:
    """Return whether the modes (J, N, 3) of a team's shapes include the low one."""
    return len(modes) > len(make_shapes(system).modes)


def _with_choices(shapes: FormationShapes, limits: ShapeLimits) -> FormationShapes:
    """Return shapes with the choices: at rest, halfway and at the end of each mode, linked where all between hold."""
    count = len(shapes.modes)
    ends = [share * axis for axis in np.eye(count) for share in (0.5, 1.0)]
    choices = np.array([np.zeros(count), *ends])
    apart = np.abs(choices[:, None] - choices[None]).max(axis=-1, initial=0.0)
    linked = apart == 0.5
    for i, j in zip(*np.nonzero(linked), strict=True):
        between = choices[i] + np.linspace(0, 1, 17)[:, None] * (choices[j] - choices[i])
        linked[i, j] = all(_holds(shapes.forces(each), limits) for each in between)
    return shapes._replace(choices=choices, linked=linked)


def _holds(forces: np.ndarray, limits: ShapeLimits) -> bool:
    spare = np.zeros(num_spares(len(forces)))
    write_spares(forces, limits, spare)
    return bool(spare.min(initial=0.0) >= -1e-9)


def _internal_forces(system: System) -> np.ndarray:
    """Return an orthonormal basis (K, N, 3) of the forces that exert no wrench."""
    matrix = wrench_matrix(system.anchors)
    _, sizes, rows = np.linalg.svd(matrix)
    rank = int((sizes > RANK * sizes[0]).sum())
    return rows[rank:].reshape(-1, *system.anchors.shape)


def _least(axis: int, system: System, limits: ShapeLimits, free: np.ndarray) -> np.ndarray | None:
    """Return the mode (N, 3) to the formation of the least extent along an axis, None if none is less.

    Minimises the drones' offsets along the axis beyond the payload's own half size, under the limits as penalties,
    by Levenberg and Marquardt's method from several scaled formations.
    """
    rest = system.formation_force
    radius = max(float(np.linalg.norm(vehicle.half_size)) for vehicle in system.vehicles)
    enough = max(0.0, float(system.payload_size[axis]) / 2 - radius)
    most = _extent(rest, system, axis)
    if most < enough + MIN_GAIN:
        return None
    best, least = None, most - MIN_GAIN
    for scales in _SCALES[axis]:
        scaled = rest.copy()
        scaled[:, :2] *= scales
        first = np.tensordot(free, scaled - rest, axes=2)
        mode = np.tensordot(_minimize(first, rest, free, (axis, enough), limits), free, axes=1)
        # Of a mode that ends outside the limits, the part that is within.
        for share in _LOW_PARTS if axis == 2 else _PARTS:
            within = all(_holds(rest + part * share * mode, limits) for part in np.linspace(0, 1, 33))
            extent = max(enough, _extent(rest + share * mode, system, axis))
            if within and extent < least - 1e-3:
                best, least = share * mode, extent
            if within:
                break
    return best


def _extent(forces: np.ndarray, system: System, axis: int) -> float:
    return float(np.abs(drone_places(system, forces)[:, axis]).max())


def _minimize(
    x: np.ndarray, rest: np.ndarray, free: np.ndarray, goal: tuple[int, float], limits: ShapeLimits
) -> np.ndarray:
    """Return the coordinates of internal forces of least cost; `goal`: the axis, and offset that is enough [m]."""
    size = _num_residuals(len(rest))
    unit_force = float(limits.tension.max())
    forces = np.zeros_like(rest)

    def residuals(x: np.ndarray) -> np.ndarray:
        values = np.zeros(size)
        write_residuals(rest, np.tensordot(x, free, axes=1), *goal, limits, forces, values)
        return np.append(values, 0.02 * x / unit_force)

    now, damping = residuals(x), 1e-3
    for _ in range(_ITERATIONS):
        step = _STEP * unit_force
        slope = np.stack([(residuals(x + step * axis) - now) / step for axis in np.eye(len(x))], axis=1)
        normal = slope.T @ slope
        for _ in range(8):
            change = np.linalg.solve(normal + damping * np.eye(len(x)) / unit_force**2, -slope.T @ now)
            then = residuals(x + change)
            if then @ then < now @ now:
                break
            damping *= 4.0
        else:
            return x
        gained = now @ now - then @ then
        x, now, damping = x + change, then, max(damping / 6.0, 1e-9)
        if gained < 1e-6 * (now @ now):
            return x
    return x


def num_spares(n: int) -> int:
    """Return how many limits the shape of N drones has."""
    return n * (n - 1) + 3 * n


def _num_residuals(n: int) -> int:
    return len(_SHARES) * num_spares(n) + n


@kernel
def write_spares(forces, limits, spare):
    """Write what is left of each limit of a shape: distances [m], tensions over those at rest, leans [rad]."""
    count = forces.shape[0]
    pairs = count * (count - 1) // 2
    pair = 0
    for i in range(count):
        a = row(limits.anchors, i)
        end = add(a, scale(limits.length[i], unit(row(forces, i))))
        for j in range(i):
            b = row(limits.anchors, j)
            other = add(b, scale(limits.length[j], unit(row(forces, j))))
            spare[pair] = norm(sub(end, other)) - limits.separation[i, j]
            spare[pairs + pair] = segment_distance(a, end, b, other) - limits.cables[i, j]
            pair += 1
        ratio = norm(row(forces, i)) / limits.tension[i]
        spare[2 * pairs + i] = ratio - MIN_TENSION
        spare[2 * pairs + count + i] = MAX_TENSION - ratio
        lean = atan2(hypot(forces[i, 0], forces[i, 1]), forces[i, 2])
        spare[2 * pairs + 2 * count + i] = limits.lean[i] - lean


@kernel
def write_residuals(rest, mode, axis, enough, limits, forces, residuals):
    """Write by how much a mode breaks limits on its way, and how far drones are beyond the offset that is enough.

    Args:
        rest, mode: (N, 3) [N].
        axis: of the offset.
        enough: offset [m].
        limits: ShapeLimits.
        forces: (N, 3), to work in.
        residuals: written.
    """
    count = rest.shape[0]
    spares = count * (count - 1) + 3 * count
    for k in range(_SHARES.shape[0]):
        for i in range(count):
            put(forces[i], add(row(rest, i), scale(_SHARES[k], row(mode, i))))
        spare = residuals[k * spares : (k + 1) * spares]
        write_spares(forces, limits, spare)
        for i in range(spares):
            spare[i] = _PENALTY * min(spare[i] - _CAUTION, 0.0)
    for i in range(count):
        end = add(row(limits.anchors, i), scale(limits.length[i], unit(row(forces, i))))
        residuals[_SHARES.shape[0] * spares + i] = max(abs(end[axis]) - enough, 0.0)
