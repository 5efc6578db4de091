"""The state of a whole team that carries a payload along a given motion of its pose.

Pose and its derivatives ask for a force and a moment; cable forces that exert them, the nearest to those of a formation
that holds the payload at rest, point along the cables, so every drone's place follows, and with its acceleration its
thrust (differential flatness, Sreenath and Kumar, RSS 2013). Those nominal forces are the formation's shape, which may
change on the way. Derivatives are differences of five poses, of second order in the time between them.
"""

from __future__ import annotations

from math import asin, atan2, cos, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.control.cable_forces import WrenchDistribution, distribute_wrench, make_wrench_distribution
from multilift_marl.control.formation import wrap
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    add,
    cross,
    heading,
    matmul,
    mul,
    norm,
    put,
    rotation_vector,
    row,
    scale,
    sub,
    tmul,
    transpose,
    turn,
    unit,
    vec,
)
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.team_model import TeamModel
from multilift_marl.rig.system import System

STEP = 0.02  # [s] between the poses of a state
SAMPLES = 5  # poses of a state
SHAPES = slice(1, 4)  # of these, the poses at which the formation's shape counts
MIN_LIFT = 0.1  # of a cable's nominal force, that its vertical component is at least


class FlatTeam(NamedTuple):
    """What `set_flat_state` needs of a team."""

    model: TeamModel
    force: np.ndarray
    """(N, 3) of each cable on the resting payload, its heading frame [N]: the nominal ones of a constant shape."""
    distribution: WrenchDistribution
    step: float
    """[s] between the poses of a state."""


def make_flat_team(model: TeamModel, system: System, step: float = STEP) -> FlatTeam:
    """Return the numbers of a team, whose poses are `step` [s] apart."""
    return FlatTeam(model, system.formation_force.copy(), make_wrench_distribution(system.anchors), step)


def steady_shape(team: FlatTeam) -> np.ndarray:
    """Return the nominal forces (3, N, 3) of the formation at rest, as `set_flat_state` takes them."""
    return np.tile(team.force, (3, 1, 1))


class FlatWork(NamedTuple):
    """Arrays that `set_flat_state` works in."""

    force: np.ndarray
    """(3, N, 3) of the cables on the payload, a step before, at, and after the state [N]."""
    place: np.ndarray
    """(3, N, 3) of the drones [m]."""

    @classmethod
    def of(cls, num_drones: int) -> FlatWork:
        """Return arrays for N drones."""
        return cls(np.zeros((3, num_drones, 3)), np.zeros((3, num_drones, 3)))


class FlatMotion(NamedTuple):
    """How a team moves about a state: five poses of its payload, `FlatTeam.step` apart, and its formation's shape."""

    position: np.ndarray
    """(5, 3) of the payload [m]."""
    rotation: np.ndarray
    """(5, 3, 3) its attitude there."""
    shape: np.ndarray
    """(3, N, 3) nominal forces of the cables on the resting payload at the three poses in the middle, its heading
    frame [N]."""


@kernel
def set_flat_state(motion, yaw, load, team, w, x):
    """Write the state (12 + 7 N,) of a team that moves so.

    Args:
        motion: FlatMotion.
        yaw: which the state's yaw is near to [rad]: it may exceed π.
        load: (7,) other force, moment and mass of the payload, see `team_model.accelerations`.
        team: FlatTeam.
        w: FlatWork.
        x: written.
    """
    position, rotation, shape = motion
    count, step = shape.shape[1], team.step
    q = 6 + 2 * count
    # At the three poses in the middle: forces and places there are differentiated in turn.
    for i in range(3):
        _place_team(i, motion, load, team, w)
    middle = _matrix(rotation, 2)
    put(x[0:3], row(position, 2))
    roll, pitch, turned = euler_angles(middle)
    x[3], x[4], x[5] = roll, pitch, yaw + wrap(turned - yaw)
    put(x[q : q + 3], scale(0.5 / step, sub(row(position, 3), row(position, 1))))
    # The mean angular velocity over two steps, from the world into the payload's frame.
    put(x[q + 3 : q + 6], tmul(middle, scale(0.5 / step, _turned(rotation, 1, 3))))
    for n in range(count):
        before, here, after = unit(vec(w.force, 0, n)), unit(vec(w.force, 1, n)), unit(vec(w.force, 2, n))
        f, m = vec(w.force, 1, n), team.model.drone_mass[n]
        for i in range(2):
            x[6 + 2 * n + i] = here[i]
            x[q + 6 + 2 * n + i] = (after[i] - before[i]) * (0.5 / step)
        # Newton's law of the drone, whose thrust holds the cable, its weight and its inertia: F = f + m (p̈ + g e_z).
        middle_place = vec(w.place, 1, n)
        moved = sub(add(vec(w.place, 0, n), vec(w.place, 2, n)), scale(2.0, middle_place))
        thrust = add(f, scale(m, add(scale(1.0 / step**2, moved), (0.0, 0.0, GRAVITY))))
        put(x[2 * q + 3 * n : 2 * q + 3 * n + 3], thrust)


@kernel
def euler_angles(m):
    """Return roll, pitch and yaw of Rz(yaw) Ry(pitch) Rx(roll)."""
    return atan2(m[7], m[8]), -asin(min(max(m[6], -1.0), 1.0)), atan2(m[3], m[0])


@kernel
def _matrix(rotation, i):
    return (
        rotation[i, 0, 0], rotation[i, 0, 1], rotation[i, 0, 2],
        rotation[i, 1, 0], rotation[i, 1, 1], rotation[i, 1, 2],
        rotation[i, 2, 0], rotation[i, 2, 1], rotation[i, 2, 2],
    )  # fmt: skip


@kernel
def _turned(rotation, i, j):
    """Return the rotation vector from attitude i to attitude j, world frame [rad]."""
    return rotation_vector(matmul(_matrix(rotation, j), transpose(_matrix(rotation, i))))


@kernel
def _place_team(i, motion, load, team, w):
    """Write cable forces and places of the drones at pose i + 1 of five."""
    position, rotation, shape = motion
    model, step = team.model, team.step
    here, attitude = row(position, i + 1), _matrix(rotation, i + 1)
    velocity = scale(0.5 / step, sub(row(position, i + 2), row(position, i)))
    change = sub(add(row(position, i), row(position, i + 2)), scale(2.0, here))
    rates = scale(0.5 / step, _turned(rotation, i, i + 2))
    # Angular acceleration: the difference of the mean rates of the step before and of the one after.
    spin = scale(1.0 / step**2, sub(_turned(rotation, i + 1, i + 2), _turned(rotation, i, i + 1)))
    # What the cables have to exert: inertia, weight and drag, less the other force that is known of.
    force = scale(model.payload_mass + load[6], add(scale(1.0 / step**2, change), (0.0, 0.0, GRAVITY)))
    force = sub(add(force, scale(model.drag * norm(velocity), velocity)), (load[0], load[1], load[2]))
    body_rates, body_spin = tmul(attitude, rates), tmul(attitude, spin)
    # Euler's equation in the payload's frame, J ω̇ + ω × J ω; the result goes back to the world frame.
    moment = add(_times(model.inertia, body_spin), cross(body_rates, _times(model.inertia, body_rates)))
    moment = mul(attitude, sub(moment, (load[3], load[4], load[5])))
    psi = heading(attitude)
    c, s = cos(psi), sin(psi)
    for n in range(shape.shape[1]):
        # Nominal forces turn with the heading alone, as the formation does; only what they lack is distributed.
        nominal = turn(c, s, vec(shape, i, n))
        put(w.force[i, n], nominal)
        force = sub(force, nominal)
        moment = sub(moment, cross(mul(attitude, row(model.anchors, n)), nominal))
    linear, angular = distribute_wrench(force, moment, attitude, team.distribution)
    for n in range(shape.shape[1]):
        arm = mul(attitude, row(model.anchors, n))
        f = add(vec(w.force, i, n), add(linear, cross(angular, arm)))
        f = (f[0], f[1], max(f[2], MIN_LIFT * shape[i, n, 2]))  # a cable cannot push
        put(w.force[i, n], f)
        put(w.place[i, n], add(add(here, arm), scale(model.length[n], unit(f))))


@kernel
def _times(matrix, vector):
    return (
        matrix[0, 0] * vector[0] + matrix[0, 1] * vector[1] + matrix[0, 2] * vector[2],
        matrix[1, 0] * vector[0] + matrix[1, 1] * vector[1] + matrix[1, 2] * vector[2],
        matrix[2, 0] * vector[0] + matrix[2, 1] * vector[1] + matrix[2, 2] * vector[2],
    )
