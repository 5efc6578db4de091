"""Vectors, rotations and quaternions against plain NumPy."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest

from multilift_marl import math3d

VECTORS = [tuple(v) for v in np.random.default_rng(0).normal(size=(6, 3))]
PAIRS = list(zip(VECTORS[:3], VECTORS[3:], strict=True))
AXES = [(1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0), *(tuple(v / np.linalg.norm(v)) for v in np.array(VECTORS))]
ANGLES = [-3.0, -0.5, 1e-7, 0.7, 2.0, pi]


def rodrigues(axis, angle):
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * k @ k


def flat(matrix):
    return tuple(float(x) for x in np.asarray(matrix).ravel())


def square(numbers):
    return np.array(numbers).reshape(3, 3)


def close(actual, expected, tolerance=1e-12):
    np.testing.assert_allclose(np.array(actual), np.array(expected), rtol=0, atol=tolerance)


@pytest.mark.parametrize("a, b", PAIRS)
@pytest.mark.parametrize(
    "ours, reference",
    [(math3d.add, np.add), (math3d.sub, np.subtract), (math3d.cross, np.cross), (math3d.dot, np.dot)],
)
def test_vector_operations(ours, reference, a, b):
    close(ours(a, b), reference(a, b))


@pytest.mark.parametrize("a, b", PAIRS)
def test_matrix_operations(a, b):
    left, right = rodrigues(AXES[3], 1.0) * 2.0, np.outer(a, b) + np.eye(3)
    close(square(math3d.matmul(flat(left), flat(right))), left @ right)
    close(math3d.mul(flat(right), a), right @ a)
    close(math3d.tmul(flat(right), a), right.T @ a)
    close(square(math3d.transpose(flat(right))), right.T)
    close(math3d.column(flat(right), 1), right[:, 1])
    close(square(math3d.from_columns(a, b, a)), np.stack([a, b, a], axis=1))


@pytest.mark.parametrize("a", VECTORS)
def test_unit_has_length_one_and_the_direction(a):
    close(np.linalg.norm(math3d.unit(a)), 1.0)
    close(np.cross(math3d.unit(a), a), 0.0)


def test_unit_of_zero_is_up():
    assert math3d.unit((0.0, 0.0, 0.0)) == (0.0, 0.0, 1.0)


@pytest.mark.parametrize("largest, expected", [(10.0, (0.0, 3.0, 4.0)), (5.0, (0.0, 3.0, 4.0)), (1.0, (0.0, 0.6, 0.8))])
def test_limit_shortens_only_what_is_longer(largest, expected):
    close(math3d.limit((0.0, 3.0, 4.0), largest), expected)


@pytest.mark.parametrize("value, expected", [(-2.0, -1.0), (0.5, 0.5), (7.0, 3.0)])
def test_clip(value, expected):
    assert math3d.clip(value, -1.0, 3.0) == expected


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", ANGLES)
def test_axis_angle_is_rodrigues_formula(axis, angle):
    close(square(math3d.axis_angle(axis, angle)), rodrigues(axis, angle))


@pytest.mark.parametrize("angle", ANGLES)
def test_rotations_about_z(angle):
    close(square(math3d.rot_z(angle)), rodrigues((0, 0, 1), angle))
    close(math3d.turn(np.cos(angle), np.sin(angle), VECTORS[0]), rodrigues((0, 0, 1), angle) @ VECTORS[0])


@pytest.mark.parametrize("length", [1e-3, 1.0, 40.0])
@pytest.mark.parametrize("seed", range(4))
def test_any_quaternion_gives_a_proper_rotation(seed, length):
    q = np.random.default_rng(seed).normal(size=4)
    m = square(math3d.quat_to_mat(*(length * q / np.linalg.norm(q))))
    close(m @ m.T, np.eye(3))
    close(np.linalg.det(m), 1.0)


def test_quaternion_and_its_negative_are_one_rotation():
    q = (0.5, -0.1, 0.3, 0.8)
    assert math3d.quat_to_mat(*q) == math3d.quat_to_mat(*(-x for x in q))


@pytest.mark.parametrize("largest", range(4))
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_quaternion_round_trip_in_every_branch(largest, sign):
    q = np.array([0.2, -0.3, 0.25, 0.15])
    q[largest] = sign * 0.9
    q /= np.linalg.norm(q)
    back = np.array(math3d.mat_to_quat(math3d.quat_to_mat(*(float(x) for x in q))))
    close(back * np.sign(back @ q), q)


@pytest.mark.parametrize("axis", AXES)
def test_quaternion_round_trip_of_half_a_turn(axis):
    half_turn = 2 * np.outer(axis, axis) - np.eye(3)
    q = math3d.mat_to_quat(flat(half_turn))
    close(np.linalg.norm(q), 1.0)
    close(square(math3d.quat_to_mat(*q)), half_turn)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", [0.0, 1e-14, 1e-9, 1e-4, 1.0, 3.0, pi - 1e-6])
def test_rotation_vector_is_axis_times_angle(axis, angle):
    close(math3d.rotation_vector(math3d.axis_angle(axis, angle)), angle * np.array(axis), 1e-9)


@pytest.mark.parametrize("axis", AXES)
def test_rotation_vector_of_half_a_turn_has_length_pi(axis):
    vector = np.array(math3d.rotation_vector(flat(2 * np.outer(axis, axis) - np.eye(3))))
    close(np.abs(vector @ axis), pi, 1e-9)


@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("angle", [0.3, 1.2])
def test_heading_is_the_zxy_yaw(axis, angle):
    m = rodrigues(axis, angle)
    close(math3d.heading(flat(m)), np.arctan2(-m[0, 1], m[1, 1]))


def eqs_28_to_30(force, yaw):
    b3 = np.array(force) / np.linalg.norm(force)
    b2 = np.cross(b3, [np.cos(yaw), np.sin(yaw), 0])
    b2 /= np.linalg.norm(b2)
    return np.stack([np.cross(b2, b3), b2, b3], axis=1)


FORCES = [(0.0, 0.0, 9.81), (3.0, -2.0, 5.0), (-8.0, 1.0, 0.5), (1.0, 2.0, -3.0)]


@pytest.mark.parametrize("force", FORCES)
@pytest.mark.parametrize("yaw", [-2.5, 0.0, 0.6, 3.1])
def test_thrust_frame_is_equations_28_to_30(force, yaw):
    close(square(math3d.thrust_frame(force, yaw)), eqs_28_to_30(force, yaw))


@pytest.mark.parametrize("force", FORCES[:3])
@pytest.mark.parametrize("yaw", [-2.5, 0.0, 0.6, 3.1])
def test_heading_of_a_thrust_frame_is_the_yaw_asked_for(force, yaw):
    close(math3d.heading(math3d.thrust_frame(force, yaw)), yaw)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
@pytest.mark.parametrize("yaw", [-2.5, 0.0, 0.6])
def test_thrust_frame_of_a_force_along_the_heading_keeps_the_y_axis_horizontal(yaw, sign):
    force = (sign * 4 * np.cos(yaw), sign * 4 * np.sin(yaw), 0.0)
    m = square(math3d.thrust_frame(force, yaw))
    close(m @ m.T, np.eye(3), 1e-9)
    close(np.linalg.det(m), 1.0, 1e-9)
    close(m[:, 2], np.array(force) / 4, 1e-9)
    close(m[2, 1], 0.0, 1e-9)


def test_thrust_frame_of_no_force_is_upright():
    close(square(math3d.thrust_frame((0.0, 0.0, 0.0), 0.6)), rodrigues((0, 0, 1), 0.6))


def brute_force(p1, q1, p2, q2, steps=400):
    """Return the least distance on a grid, and by how much it may exceed the true one."""
    t = np.linspace(0, 1, steps + 1)[:, None]
    first, second = p1 + t * (q1 - p1), p2 + t * (q2 - p2)
    slack = (np.linalg.norm(q1 - p1) + np.linalg.norm(q2 - p2)) / (2 * steps)
    return np.linalg.norm(first[:, None] - second[None], axis=-1).min(), slack


@pytest.mark.parametrize("seed", range(12))
def test_segment_distance_against_brute_force(seed):
    points = np.random.default_rng(seed).uniform(-1, 1, (4, 3))
    distance = math3d.segment_distance(*(tuple(point) for point in points))
    grid, slack = brute_force(*points)
    assert grid - slack <= distance <= grid + 1e-12
    close(math3d.segment_distance(*(tuple(points[i]) for i in (3, 2, 0, 1))), distance)


@pytest.mark.parametrize(
    "p1, q1, p2, q2, expected",
    [
        ((-1, 0, 0), (1, 0, 0), (0, -1, 0), (0, 1, 0), 0.0),
        ((-1, 0, 0), (1, 0, 0), (0, -1, 2), (0, 1, 2), 2.0),
        ((0, 0, 0), (1, 0, 0), (0, 3, 0), (1, 3, 0), 3.0),
        ((0, 0, 0), (1, 0, 0), (5, 3, 0), (4, 3, 0), 18**0.5),
        ((0, 0, 0), (1, 0, 0), (3, 0, 0), (5, 0, 0), 2.0),
        ((0, 0, 0), (2, 0, 0), (1, 0, 0), (5, 0, 0), 0.0),
        ((0, 0, 0), (1, 0, 0), (1, 0, 0), (1, 1, 1), 0.0),
        ((0, 0, 0), (1, 1, 1), (2, 2, 2 + 1e-9), (3, 3, 3), 3**0.5),
    ],
    ids=["crossing", "skew", "parallel", "antiparallel", "in line", "overlapping", "sharing an end", "almost in line"],
)
def test_segment_distance_of_special_pairs(p1, q1, p2, q2, expected):
    points = [tuple(float(x) for x in point) for point in (p1, q1, p2, q2)]
    close(math3d.segment_distance(*points), expected, 1e-8)


def test_eased_ways_are_smooth_to_the_third_derivative():
    t, h = np.linspace(0.9, 3.2, 60), 1e-4
    values = np.array([[math3d.ease(x + k * h, 1.0, 2.0) for k in (-1, 0, 1)] for x in t])
    slopes = (values[:, 2] - values[:, 0]) / (2 * h)
    np.testing.assert_allclose(slopes[:, :3], values[:, 1, 1:], atol=2e-5)
    assert tuple(math3d.ease(1.0, 1.0, 2.0)) == (0, 0, 0, 0) and tuple(math3d.ease(3.0, 1.0, 2.0)) == (1, 0, 0, 0)
