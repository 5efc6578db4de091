"""Costs of limits that a planned trajectory exceeds: ½ w s² h for an excess s, in Gauss-Newton form.

Kernels add to `linear` and to the lower triangle of `quadratic` of an IterationWork, see `riccati.recur`.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, dot, matrow, mul, row, scale, sub, vec
from multilift_marl.planning.team_model import TeamModel, set_rotation
from multilift_marl.rig.system import System
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sim.obstacle_bodies import box_distance
from multilift_marl.sim.obstacle_distance import point_distance
from multilift_marl.sim.obstacles import NONE, Obstacles

CABLE_POINTS = 0.25, 0.5, 0.75  # of a cable's length, where its distance from obstacles counts


class TeamPoints(NamedTuple):
    """Spheres on a team that are to stay clear of obstacles."""

    corners: np.ndarray
    """(8, 3) of the payload, its frame [m]."""
    radius: np.ndarray
    """(N,) of those about the drones; cables and corners have none [m]."""
    reach: float
    """From the payload's centre of mass, that no point is beyond [m]."""
    clearance: float
    """That each is to keep [m]."""
    weight: float
    """1/σ² of what is missing, in each second."""


class Surroundings(NamedTuple):
    """What one team is to stay clear of: obstacles, which go on as they move, and drones that are not its own."""

    env: int
    obstacles: Obstacles
    ahead: float
    """[s] of the plan's start, from the time at which they are so."""
    points: TeamPoints
    others: np.ndarray
    """(K + 1, M, 4) where such drones are beside the payload at each step, world frame, and least distances [m]."""


def make_points(settings: PlannerConfig, system: System, model: TeamModel) -> TeamPoints:
    """Return the points of a team."""
    half, signs = np.array(system.payload_size) / 2, np.indices((2, 2, 2)).reshape(3, 8).T * 2 - 1
    corners = np.array(system.payload_center) + signs * half
    radius = np.array([np.linalg.norm(vehicle.half_size) for vehicle in system.vehicles])
    radius += np.linalg.norm(system.hooks, axis=1)
    far = (np.linalg.norm(model.anchors, axis=1) + model.length + radius).max()
    reach = max(float(far), float(np.linalg.norm(corners, axis=1).max()))
    return TeamPoints(corners, radius, reach, settings.clearance, settings.clearance_tolerance**-2.0)


@kernel
def add_tensions(k, q, size, h, objective, w):
    """Add the cost of cables that pull less than they must, in the middle of a step: half of its input counts."""
    for n in range(objective.tension.shape[0]):
        short = objective.tension[n] - w.tension[k, n]
        if short <= 0.0:
            continue
        slope, weight = w.tension_slope[k, n], h * objective.weights[0]
        for i in range(3, size):
            part = weight * slope[i]
            w.linear[i] -= short * part
            for j in range(i + 1):
                w.quadratic[i, j] += part * slope[j]
        for i in range(objective.rate.shape[0]):
            part = 0.5 * h * weight * slope[2 * q + i]
            w.right[i, size] -= short * part
            for j in range(size):
                w.right[i, j] += part * slope[j]
            for j in range(objective.rate.shape[0]):
                w.input[i, j] += part * 0.5 * h * slope[2 * q + j]


@kernel
def add_thrusts(x, q, h, objective, quadratic, linear):
    """Add the cost of thrusts beyond their limits, by the direction of the thrust vector."""
    for n in range(objective.thrust.shape[0]):
        at = 2 * q + 3 * n
        thrust = sqrt(x[at] ** 2 + x[at + 1] ** 2 + x[at + 2] ** 2) + 1e-12
        excess = max(thrust - objective.thrust[n, 1], 0.0) + min(thrust - objective.thrust[n, 0], 0.0)
        if excess != 0.0:
            weight = h * objective.weights[1]
            for i in range(3):
                part = weight * x[at + i] / thrust
                linear[at + i] += excess * part
                for j in range(i + 1):
                    quadratic[at + i, at + j] += part * x[at + j] / thrust


@kernel
def place_drones(x, q, model, w):
    """Write where the drones are beside the payload, and the derivatives by attitude (3) and by c (2 of 8)."""
    m = w.model
    set_rotation(x, m.rotation, m.turning)
    for n in range(model.anchors.shape[0]):
        arm, length = model.anchors[n], model.length[n]
        cx, cy = x[6 + 2 * n], x[7 + 2 * n]
        z = sqrt(max(1.0 - cx * cx - cy * cy, 0.01))
        for i in range(3):
            rotation = m.rotation[i]
            w.place[n, i] = rotation[0] * arm[0] + rotation[1] * arm[1] + rotation[2] * arm[2]
            for k in range(3):
                turning = m.turning[k, i]
                w.place_slope[n, i, k] = turning[0] * arm[0] + turning[1] * arm[1] + turning[2] * arm[2]
            w.place_slope[n, i, 3] = length * 1.0 * (i == 0)
            w.place_slope[n, i, 4] = length * 1.0 * (i == 1)
        w.place_slope[n, 2, 3], w.place_slope[n, 2, 4] = -length * cx / z, -length * cy / z
        w.place[n, 0] += length * cx
        w.place[n, 1] += length * cy
        w.place[n, 2] += length * z


@kernel
def add_separations(x, q, problem, w):
    """Add the cost of drones that come too close to each other."""
    h, model, objective = problem.step, problem.model, problem.objective
    count = model.anchors.shape[0]
    place_drones(x, q, model, w)
    lever = w.lever
    for n in range(count):
        for o in range(n):
            d0, d1, d2 = sub(row(w.place, n), row(w.place, o))
            distance = sqrt(d0 * d0 + d1 * d1 + d2 * d2) + 1e-12
            short = objective.separation[n, o] - distance
            if short <= 0.0:
                continue
            lever[:] = 0.0
            for i in range(3):
                d = (w.place[n, i] - w.place[o, i]) / distance
                for k in range(3):
                    lever[3 + k] += d * (w.place_slope[n, i, k] - w.place_slope[o, i, k])
                for k in range(2):
                    lever[6 + 2 * n + k] += d * w.place_slope[n, i, 3 + k]
                    lever[6 + 2 * o + k] -= d * w.place_slope[o, i, 3 + k]
            for i in range(3, q):
                part = h * objective.weights[2] * lever[i]
                w.linear[i] -= short * part
                for j in range(i + 1):
                    w.quadratic[i, j] += part * lever[j]


@kernel
def add_neighbours(k, q, problem, w):
    """Add the cost of drones that come too close to drones that are not of the team, after `add_separations`."""
    others, lever = problem.around.others, w.lever
    for n in range(problem.model.anchors.shape[0]):
        for m in range(others.shape[1]):
            d0, d1, d2 = sub(row(w.place, n), (others[k, m, 0], others[k, m, 1], others[k, m, 2]))
            distance = sqrt(d0 * d0 + d1 * d1 + d2 * d2) + 1e-12
            short = others[k, m, 3] - distance
            if short <= 0.0:
                continue
            # These drones do as they said, whatever the payload does: by the own arm (3) and the own cable (2) alone.
            lever[:] = 0.0
            for i in range(3):
                d = (w.place[n, i] - others[k, m, i]) / distance
                for j in range(3):
                    lever[3 + j] += d * w.place_slope[n, i, j]
                for j in range(2):
                    lever[6 + 2 * n + j] += d * w.place_slope[n, i, 3 + j]
            for i in range(3, q):
                part = problem.step * problem.objective.weights[2] * lever[i]
                w.linear[i] -= short * part
                for j in range(i + 1):
                    w.quadratic[i, j] += part * lever[j]


@kernel
def add_clearances(k, x, q, problem, w):
    """Add the cost of drones, cables and payload that come too close to obstacles, after `add_separations`."""
    model, around = problem.model, problem.around
    env, obstacles, points = around.env, around.obstacles, around.points
    payload, r = (x[0], x[1], x[2]), w.model.rotation
    attitude = r[0, 0], r[0, 1], r[0, 2], r[1, 0], r[1, 1], r[1, 2], r[2, 0], r[2, 1], r[2, 2]
    for m in range(obstacles.kind.shape[1]):
        if obstacles.kind[env, m] == NONE:
            continue
        # What has moved by `gone` then is as far from a point as it is now from the point less `gone`.
        gone = scale(around.ahead + k * problem.step, vec(obstacles.velocity, env, m))
        middle = sub(payload, gone)
        if box_distance(env, m, middle, obstacles) > points.reach + points.clearance:
            continue
        for p in range(points.corners.shape[0]):
            _add_clearance(m, (middle, attitude), row(points.corners, p), (0, 0.0, 0.0), problem, w)
        for n in range(model.anchors.shape[0]):
            anchor = row(model.anchors, n)
            for share in CABLE_POINTS:
                _add_clearance(m, (middle, attitude), anchor, (n, share, 0.0), problem, w)
            _add_clearance(m, (middle, attitude), anchor, (n, 1.0, points.radius[n]), problem, w)


@kernel
def _add_clearance(m, pose, arm, sphere, problem, w):
    """Add the cost of a sphere on the team: its centre is at `arm` on the payload, and a share of cable n from there.

    Args:
        m: the obstacle.
        pose: of the payload: its place in a frame that moves with the obstacle [m], and its attitude.
        arm: in the payload's frame [m].
        sphere: n, the share, and its radius [m].
        problem, w: see `riccati.recur`.
    """
    (middle, attitude), (n, share, radius) = pose, sphere
    around, lever = problem.around, w.lever
    cable = sub(row(w.place, n), mul(attitude, row(problem.model.anchors, n)))
    point = add(middle, add(mul(attitude, arm), scale(share, cable)))
    distance, nearest = point_distance(around.env, m, point, around.obstacles)
    short = around.points.clearance + radius - distance
    if short <= 0.0 or abs(distance) < 1e-9:
        return
    normal = scale(1.0 / distance, sub(point, nearest))
    # By place (3), attitude (3) and the cable's c (2).
    slope = w.place_slope[n]
    for i in range(3):
        lever[i] = normal[i]
        lever[3 + i] = dot(normal, mul(matrow(w.model.turning, i), arm))
    for i in range(2):
        lever[6 + i] = share * (normal[0] * slope[0, 3 + i] + normal[1] * slope[1, 3 + i] + normal[2] * slope[2, 3 + i])
    weight = problem.step * around.points.weight
    for i in range(8):
        a = i if i < 6 else 2 * n + i
        part = weight * lever[i]
        w.linear[a] -= short * part
        for j in range(i + 1):
            w.quadratic[a, j if j < 6 else 2 * n + j] += part * lever[j]
