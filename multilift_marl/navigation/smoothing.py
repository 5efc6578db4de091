"""Smooth knots of a route that keep away from obstacles: an elastic band, by Levenberg and Marquardt's method.

Knots are pose and shape, evenly apart in a length to which yaw and shape count too. Their cost is the band's: squared
first and second differences, the coordinates of the shape, and squared shortfalls of the distances that every body is
to keep from every obstacle, and of the limits of shapes. Its Hessian (of Gauss and Newton) is banded.
"""

from __future__ import annotations

from math import cos, sin, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, dot, norm, put, row, scale, sub, turn
from multilift_marl.navigation.formation_shapes import ShapeLimits, num_spares, write_spares
from multilift_marl.navigation.search import RESHAPE, TURN
from multilift_marl.navigation.team_clearance import (
    Scene,
    TeamBody,
    cable_clearance,
    local_point,
    payload_clearance,
    team_reach,
)
from multilift_marl.sim.obstacle_distance import local_distance

SPACING = 0.12  # [m] of knots
TENSION = 1.0  # [-] of the band: weight of squared first differences
STIFFNESS = 0.5  # [m²] of squared second ones
RELAX = 0.05  # [1/m²] of squared coordinates of the shape
COMFORT = 20.0  # [1/m²] of squared shortfalls of the distance that is comfortable, and ...
SAFETY = 4000.0  # ... of that which is to be kept
LIMITS = 40_000.0  # of squared excesses over the shapes' limits
ITERATIONS = 60
_DIFFERENCE = 1e-5


class Band(NamedTuple):
    """What a band is to keep."""

    body: TeamBody
    scene: Scene
    limits: ShapeLimits
    space: np.ndarray
    """(2, 3) lowest and highest position of the payload [m]."""
    scale: np.ndarray
    """(4 + J,) length of a unit of each coordinate [m]."""
    safe: np.ndarray
    """(K,) distance from obstacles that each knot keeps [m]."""
    comfort: float
    """[m] beyond which more distance is worth nothing."""
    spacing: float
    """[m] of knots."""
    lead: np.ndarray
    """(4 + J,) from a knot before the first one to that, with a motion that goes on; zeros without."""


class BandWork(NamedTuple):
    """Arrays of one assembly for n = K (4 + J) unknowns."""

    hessian: np.ndarray
    """(n, 3 (4 + J)) rows of the lower triangle from the diagonal backwards."""
    factor: np.ndarray
    """The same of its Cholesky factor."""
    gradient: np.ndarray
    """(n,)."""
    arms: np.ndarray
    """(N, 3) cables of a knot [m]."""
    slope: np.ndarray
    """(J, N, 3) their derivatives by the coordinates of the shape."""
    forces: np.ndarray
    """(N, 3) [N]."""
    spare: np.ndarray
    """(1 + J, ...) what is left of the shape's limits, and with each coordinate a little more."""
    row: np.ndarray
    """(4 + J,) derivative of one distance."""


def coordinate_scale(modes: int) -> np.ndarray:
    """Return the length of a unit of each coordinate of a knot (4 + J,) [m]."""
    return np.array([1.0, 1.0, 1.0, TURN, *[2 * RESHAPE] * modes])


def space_knots(states: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Return knots (K, D) evenly apart along states (S, D), and the length between them [m]."""
    steps = np.linalg.norm(np.diff(states, axis=0) * weights, axis=1)
    along = np.append(0.0, np.cumsum(steps))
    count = max(int(np.ceil(along[-1] / SPACING)), 6)
    at = np.linspace(0, along[-1], count + 1)
    return np.stack([np.interp(at, along, column) for column in states.T], axis=1), max(along[-1] / count, 1e-9)


def smooth_knots(knots: np.ndarray, band: Band) -> np.ndarray:
    """Return knots (K, D) of least cost; the first and the last stay."""
    works = [make_work(knots, band) for _ in range(2)]
    fixed = len(knots) - 2
    cost = assemble(knots, band, works[0])
    # Levenberg-Marquardt: a trial that costs more is dropped, and the next step is shorter and steeper.
    damping = 1e-3
    for _ in range(ITERATIONS):
        change = np.zeros_like(knots)
        solve_band(works[0], damping, change[1:-1].reshape(-1))
        trial = knots + change
        then = assemble(trial, band, works[1])
        if then >= cost:
            damping *= 8.0
            if damping > 1e8:
                break
            continue
        gained = cost - then
        works.reverse()
        knots, cost, damping = trial, then, max(damping / 8.0, 1e-6)
        if gained < 1e-4 * cost / max(fixed, 1) ** 0.5:
            break
    return knots


def make_work(knots: np.ndarray, band: Band) -> BandWork:
    """Return the arrays of a band with knots (K, 4 + J)."""
    count, size = knots.shape
    inner, drones = (count - 2) * size, len(band.limits.length)
    return BandWork(
        hessian=np.zeros((inner, 3 * size)),
        factor=np.zeros((inner, 3 * size)),
        gradient=np.zeros(inner),
        arms=np.zeros((drones, 3)),
        slope=np.zeros((size - 4, drones, 3)),
        forces=np.zeros((drones, 3)),
        spare=np.zeros((size - 3, num_spares(drones))),
        row=np.zeros(size),
    )


@kernel
def assemble(knots, band, w):
    """Write Hessian and gradient of the cost of the inner knots; return the cost."""
    count, size = knots.shape
    w.hessian[:] = 0.0
    w.gradient[:] = 0.0
    cost = 0.0
    h = band.spacing

    # The band: a difference of order 1 or 2 of each coordinate, over lengths of h.
    for order in range(1, 3):
        weight = TENSION / h if order == 1 else STIFFNESS / h**3
        for k in range(count - order):
            for i in range(size):
                pull = weight * band.scale[i] ** 2
                if order == 1:
                    value = knots[k + 1, i] - knots[k, i]
                else:
                    value = knots[k + 2, i] - 2.0 * knots[k + 1, i] + knots[k, i]
                cost += 0.5 * pull * value * value
                # The coefficients of a difference, -1, 1 or 1, -2, 1, are its derivatives by the knots. The first and
                # the last knot stay, and have no unknowns. Rows of the Hessian go from the diagonal to the left.
                for a in range(order + 1):
                    p = k + a
                    share = (2.0 * a - 1.0) if order == 1 else (1.0 - 3.0 * (a % 2))
                    if p == 0 or p == count - 1:
                        continue
                    w.gradient[(p - 1) * size + i] += pull * share * value
                    for b in range(a + 1):
                        q = k + b
                        other = (2.0 * b - 1.0) if order == 1 else (1.0 - 3.0 * (b % 2))
                        if q > 0:
                            w.hessian[(p - 1) * size + i, (p - q) * size] += pull * share * other

    # The second difference at the first knot, where the band goes on with a motion.
    for i in range(size):
        if band.lead[i] != 0.0 or band.lead[0] != 0.0:
            pull = STIFFNESS / h**3 * band.scale[i] ** 2
            value = knots[1, i] - knots[0, i] - band.lead[i]
            cost += 0.5 * pull * value * value
            w.gradient[i] += pull * value
            w.hessian[i, 0] += pull

    # Each knot alone.
    for k in range(1, count - 1):
        first = (k - 1) * size
        for i in range(size):
            low, high, pull = 0.0, 1.0, SAFETY * h * RELAX
            value = knots[k, i]
            # Positions stay in the payload's space, yaw is free, a mode is between 0 and 1 and drawn to 0: at rest.
            if i < 3:
                low, high, pull = band.space[0, i], band.space[1, i], SAFETY * h
            elif i == 3:
                continue
            else:
                soft = RELAX * h
                cost += 0.5 * soft * value * value
                w.gradient[first + i] += soft * value
                w.hessian[first + i, 0] += soft
            over = value - min(max(value, low), high)
            if over != 0.0:
                cost += 0.5 * pull * over * over
                w.gradient[first + i] += pull * over
                w.hessian[first + i, 0] += pull
        cost += _keep_shape(knots[k], first, band, w)
        cost += _keep_away(knots[k], first, band.safe[k], band, w)
    return cost


@kernel
def _keep_shape(knot, first, band, w):
    """Add the shortfalls of the limits of a knot's shape, and write its arms and their derivatives; return the cost."""
    modes, drones = w.slope.shape[0], w.arms.shape[0]
    body = band.body
    for n in range(drones):
        f = row(body.rest, n)
        for j in range(modes):
            f = add(f, scale(knot[4 + j], (body.modes[j, n, 0], body.modes[j, n, 1], body.modes[j, n, 2])))
        put(w.forces[n], f)
        size = norm(f)
        u = scale(1.0 / size, f)
        put(w.arms[n], scale(body.length[n], u))
        for j in range(modes):
            m = (body.modes[j, n, 0], body.modes[j, n, 1], body.modes[j, n, 2])
            # d(f/|f|) = (1 - u uᵀ) df / |f|: the cable turns, its length stays.
            put(w.slope[j, n], scale(body.length[n] / size, sub(m, scale(dot(u, m), u))))
    if modes == 0:
        return 0.0
    write_spares(w.forces, band.limits, w.spare[0])
    least = 0.0
    for i in range(w.spare.shape[1]):
        least = min(least, w.spare[0, i])
    if least == 0.0:
        return 0.0
    for j in range(modes):
        for n in range(drones):
            for i in range(3):
                w.forces[n, i] += _DIFFERENCE * body.modes[j, n, i]
        write_spares(w.forces, band.limits, w.spare[1 + j])
        for n in range(drones):
            for i in range(3):
                w.forces[n, i] -= _DIFFERENCE * body.modes[j, n, i]
    cost = 0.0
    for i in range(w.spare.shape[1]):
        if w.spare[0, i] < 0.0:
            w.row[:] = 0.0
            for j in range(modes):
                w.row[4 + j] = (w.spare[1 + j, i] - w.spare[0, i]) / _DIFFERENCE
            cost += _add_shortfall(-w.spare[0, i], LIMITS * band.spacing, first, w)
    return cost


@kernel
def _keep_away(knot, first, safe, band, w):
    """Add the shortfalls of a knot's distances from all obstacles; return the cost."""
    scene, body = band.scene, band.body
    here, c, s = (knot[0], knot[1], knot[2]), cos(knot[3]), sin(knot[3])
    reach = team_reach(w.arms, body) + band.comfort
    cost = 0.0
    for m in range(scene.kind.shape[0]):
        if local_distance(scene.kind[m], scene.size[m], local_point(scene, m, here))[0] > reach:
            continue
        far, normal, spot = payload_clearance(scene, m, here, c, s, body, band.comfort)
        if far < band.comfort:
            _set_row(normal, sub(spot, here), -1, 0.0, c, s, w)
            cost += _add_distance(far, safe, first, band, w)
        for n in range(w.arms.shape[0]):
            anchor, arm = turn(c, s, row(body.anchors, n)), turn(c, s, row(w.arms, n))
            a = add(here, anchor)
            found = cable_clearance(scene, m, a, add(a, arm), body.radius[n], band.comfort)
            if found[0] < band.comfort:
                _set_row(found[1], add(anchor, scale(found[2], arm)), n, found[2], c, s, w)
                cost += _add_distance(found[0], safe, first, band, w)
            if found[3] < band.comfort:
                _set_row(found[4], add(anchor, arm), n, 1.0, c, s, w)
                cost += _add_distance(found[3], safe, first, band, w)
    return cost


@kernel
def _set_row(normal, offset, n, share, c, s, w):
    """Write the derivative of a distance: of a point at an offset from the payload, at a share of cable n if any."""
    for i in range(3):
        w.row[i] = normal[i]
    w.row[3] = normal[1] * offset[0] - normal[0] * offset[1]  # normal · (ẑ × offset), by yaw
    for j in range(w.slope.shape[0]):
        w.row[4 + j] = 0.0
        if n >= 0:
            moved = turn(c, s, (w.slope[j, n, 0], w.slope[j, n, 1], w.slope[j, n, 2]))
            w.row[4 + j] = share * dot(normal, moved)


@kernel
def _add_distance(far, safe, first, band, w):
    """Add the two shortfalls of a distance whose derivative is in `w.row`; return their cost."""
    cost = _add_shortfall(band.comfort - far, COMFORT * band.spacing, first, w)
    if far < safe:
        cost += _add_shortfall(safe - far, SAFETY * band.spacing, first, w)
    return cost


@kernel
def _add_shortfall(short, weight, first, w):
    """Add a shortfall of a quantity, whose derivative is in `w.row`; return its cost."""
    for i in range(w.row.shape[0]):
        w.gradient[first + i] -= weight * short * w.row[i]
        for j in range(i + 1):
            w.hessian[first + i, i - j] += weight * w.row[i] * w.row[j]
    return 0.5 * weight * short * short


@kernel
def solve_band(w, damping, x):
    """Write x with (H + damping diag(H)) x = -g, by Cholesky's method in the band."""
    count, width = w.hessian.shape
    for i in range(count):
        for j in range(max(0, i - width + 1), i + 1):
            total = w.hessian[i, i - j]
            if i == j:
                total *= 1.0 + damping
            for k in range(max(0, i - width + 1), j):
                total -= w.factor[i, i - k] * w.factor[j, j - k]
            w.factor[i, i - j] = sqrt(max(total, 1e-12)) if i == j else total / w.factor[j, 0]
    for i in range(count):
        total = -w.gradient[i]
        for k in range(max(0, i - width + 1), i):
            total -= w.factor[i, i - k] * x[k]
        x[i] = total / w.factor[i, 0]
    for i in range(count - 1, -1, -1):
        total = x[i]
        for k in range(i + 1, min(count, i + width)):
            total -= w.factor[k, k - i] * x[k]
        x[i] = total / w.factor[i, 0]
