"""Costs of limits that a planned trajectory exceeds: ½ w s² h for an excess s, in Gauss-Newton form.

Kernels add to `linear` and to the lower triangle of `quadratic` of an IterationWork, see `riccati.recur`.
"""

from __future__ import annotations

from math import sqrt

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import row, sub
from multilift_marl.planning.team_model import set_rotation


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
