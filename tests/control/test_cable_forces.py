"""Cable forces that exert a wrench: balance, least change, lower bounds, by closed forms; targets teams can hold."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import floats, make_system

from multilift_marl.config.load import load_config
from multilift_marl.control.cable_forces import (
    BALANCED,
    balance_forces,
    distribute_wrench,
    is_positive,
    is_stable,
    make_wrench_distribution,
    place_balanced,
    solve_cable_forces,
    wrench_matrix,
)
from multilift_marl.control.formation import Goal, place_formation
from multilift_marl.math3d import axis_angle
from multilift_marl.planning.trajectory import attitude_of
from multilift_marl.rig.constants import make_rig

LEVEL = floats(np.eye(3))
SQUARE = np.array([[0.3, 0.2, 0.1], [-0.3, 0.2, 0.1], [-0.3, -0.2, 0.1], [0.3, -0.2, 0.1]])
OUTWARD = np.array([[1.0, 1.0, 3.0], [-1.0, 1.0, 3.0], [-1.0, -1.0, 3.0], [1.0, -1.0, 3.0]])


def solve(force, moment, given, anchors=SQUARE, attitude=LEVEL, least=-np.inf) -> tuple[np.ndarray, float]:
    """Return the cable forces (N, 3) and the imbalance."""
    cable_force = np.array(given, float)
    left = solve_cable_forces(floats(force), floats(moment), attitude, anchors, least, cable_force)
    return cable_force, left


@pytest.mark.parametrize("shape", [(3,), (4, 3), (2, 5, 3)])
def test_the_wrench_matrix_sums_forces_and_their_moments(shape):
    arms, force = np.random.default_rng(0).normal(size=(2, *np.atleast_2d(np.zeros(shape)).shape))
    exerted = np.einsum("...ij,...j->...i", wrench_matrix(arms), force.reshape(*arms.shape[:-2], -1))
    np.testing.assert_allclose(exerted[..., :3], force.sum(axis=-2), atol=1e-14)
    np.testing.assert_allclose(exerted[..., 3:], np.cross(arms, force).sum(axis=-2), atol=1e-14)


def test_forces_that_already_balance_stay_as_they_are():
    cable_force, left = solve([0, 0, 12], [0, 0, 0], OUTWARD)
    np.testing.assert_allclose(cable_force, OUTWARD, atol=1e-12)
    assert left < 1e-9


def test_without_bounds_the_change_is_the_pseudo_inverses():
    rng = np.random.default_rng(0)
    turn = np.reshape(axis_angle((0.6, 0.0, 0.8), 0.7), (3, 3))
    wrench, matrix = rng.normal(size=6) + [0, 0, 12, 0, 0, 0], wrench_matrix(SQUARE @ turn.T)
    cable_force, left = solve(wrench[:3], wrench[3:], OUTWARD, attitude=floats(turn))
    expected = OUTWARD.ravel() + np.linalg.pinv(matrix) @ (wrench - matrix @ OUTWARD.ravel())
    np.testing.assert_allclose(cable_force.ravel(), expected, atol=1e-9)
    assert left < 1e-9


@pytest.mark.parametrize("anchors", [SQUARE, SQUARE[:3], SQUARE[:2], np.zeros((1, 3))])
def test_without_bounds_all_solvers_agree(anchors):
    rng, given = np.random.default_rng(0), OUTWARD[: len(anchors)]
    turn = np.reshape(axis_angle((0.6, 0.0, 0.8), 0.7), (3, 3))
    arms = anchors @ turn.T
    for _ in range(20):
        wrench, matrix = rng.normal(size=6) + [0, 0, 12, 0, 0, 0], wrench_matrix(arms)
        cable_force, _ = solve(wrench[:3], wrench[3:], given, anchors, floats(turn))
        lacking = wrench - matrix @ given.ravel()
        linear, angular = distribute_wrench(
            floats(lacking[:3]), floats(lacking[3:]), floats(turn), make_wrench_distribution(anchors)
        )
        tolerance = 1e-5 if len(anchors) < 3 else 1e-10
        np.testing.assert_allclose(given + linear + np.cross(angular, arms), cable_force, atol=tolerance)
        if len(anchors) != 2:  # two cables leave a part of the moment, which this solver weighs otherwise
            balanced, _ = balance_forces(arms[None], given, wrench[None])
            np.testing.assert_allclose(balanced[0], cable_force, atol=tolerance)


def test_a_moment_shifts_force_from_one_side_to_the_other():
    cable_force, _ = solve([0, 0, 12], [0.8, 0, 0], [[0, 0, 3.0]] * 4, anchors=SQUARE * [1, 1, 0])
    np.testing.assert_allclose(cable_force[:, 2], 3 + 0.8 / (4 * 0.2) * np.sign(SQUARE[:, 1]), atol=1e-9)
    np.testing.assert_allclose(cable_force[:, :2], 0, atol=1e-9)


def test_bounded_forces_meet_the_conditions_of_a_minimum():
    rng, met = np.random.default_rng(1), 0
    direction = OUTWARD / np.linalg.norm(OUTWARD, axis=1, keepdims=True)
    bound = 0.5 * np.linalg.norm(OUTWARD, axis=1)
    for _ in range(200):
        wrench = rng.normal(size=6) * [2, 2, 2, 0.5, 0.5, 0.5] + [0, 0, 12, 0, 0, 0]
        cable_force, left = solve(wrench[:3], wrench[3:], OUTWARD, least=0.5)
        if left > 1e-9:
            continue  # these cables cannot exert it
        spare = (direction * cable_force).sum(axis=1) - bound
        assert spare.min() > -1e-9
        tight = spare < 1e-7
        met += tight.any()
        # f - n = Gᵀ(λ, μ) + a u, with a ≥ 0 where the bound is met and 0 elsewhere
        columns = [wrench_matrix(SQUARE).T]
        for i in np.flatnonzero(tight):
            column = np.zeros((4, 3))
            column[i] = direction[i]
            columns.append(column.reshape(-1, 1))
        multipliers, *_ = np.linalg.lstsq(np.hstack(columns), (cable_force - OUTWARD).ravel(), rcond=None)
        np.testing.assert_allclose(np.hstack(columns) @ multipliers, (cable_force - OUTWARD).ravel(), atol=1e-7)
        assert (multipliers[6:] > -1e-7).all()
    assert met > 20


def test_what_cables_cannot_exert_is_left_over_and_does_no_harm():
    line = np.array([[0.3, 0, 0], [-0.3, 0, 0]])
    cable_force, left = solve([0, 0, 6], [0.5, 0.6, 0], [[0, 0, 3.0]] * 2, anchors=line)
    np.testing.assert_allclose(cable_force, [[0, 0, 2.0], [0, 0, 4.0]], atol=1e-5)
    assert left == pytest.approx(0.5, abs=1e-5)


def test_one_cable_exerts_the_force_on_a_point():
    cable_force, left = solve([1, -2, 9], [0, 0, 0], [[0, 0, 9.0]], anchors=np.zeros((1, 3)))
    np.testing.assert_allclose(cable_force, [[1, -2, 9]], atol=1e-6)
    assert left < 1e-6


def placed(system, yaw: float, roll: float, place, pitch: float = 0.0) -> Goal:
    goal, rig = Goal.zeros(1, system.num_drones), make_rig(system)
    goal.position[0] = [0.3, -0.2, 1.5]
    goal.rotation[0] = np.reshape(attitude_of(yaw, roll, pitch), (3, 3))
    place(goal, rig)
    return goal


@pytest.mark.parametrize("model", ["massless", "chain"])
@pytest.mark.parametrize("num_drones", [1, 2, 3, 4, 6])
def test_level_targets_are_those_of_the_formation_bit_for_bit(num_drones, model):
    system = make_system(num_drones, **{"cable.model": model})
    ours = placed(system, 0.7, 0.0, lambda goal, rig: place_balanced(0, goal, rig))
    plain = placed(system, 0.7, 0.0, lambda goal, rig: place_formation(0, goal, rig))
    for mine, theirs in zip(ours, plain, strict=True):
        assert mine.tobytes() == theirs.tobytes()


@pytest.mark.parametrize("model", ["massless", "chain"])
@pytest.mark.parametrize("num_drones", [3, 4, 6])
@pytest.mark.parametrize("roll", [0.3, -0.7])
def test_a_tilted_payload_is_balanced_and_slots_lie_along_the_forces(num_drones, model, roll):
    system, held = make_system(num_drones, **{"cable.model": model}), []
    goal = placed(system, 2.0, roll, lambda goal, rig: held.append(place_balanced(0, goal, rig)))
    cable_force = goal.cable_force[0] - [[0, 0, w] for w in make_rig(system).cable_weight]
    weight = 9.81 * system.payload_mass
    arms = system.anchors @ goal.rotation[0].T
    assert held == [True]
    np.testing.assert_allclose(cable_force.sum(axis=0), [0, 0, weight], atol=BALANCED * weight)
    np.testing.assert_allclose(np.cross(arms, cable_force).sum(axis=0), 0, atol=BALANCED * weight)
    assert np.linalg.norm(cable_force, axis=1).min() > 0.2 * np.linalg.norm(system.formation_force, axis=1).min()
    cables = goal.slots[0] - goal.position[0] - arms
    if model == "massless":
        size = np.linalg.norm(cable_force, axis=1, keepdims=True)
        np.testing.assert_allclose(cables, (system.cable_length[:, None] + size / 1e5) * cable_force / size, atol=1e-9)
    else:
        np.testing.assert_allclose(np.linalg.norm(cables, axis=1), system.cable_length, rtol=1e-3)


@pytest.mark.parametrize("num_drones", [1, 2])
def test_one_or_two_cables_cannot_hold_a_tilted_box(num_drones):
    system, held = make_system(num_drones), []
    placed(system, 0.0, 0.3, lambda goal, rig: held.append(place_balanced(0, goal, rig)))
    assert held == [False]


def energy(moved, system, goal, cable_force, stiffness) -> float:
    """Return the potential energy [J] of payload, cables and drones on springs, moved (6 + 3 N) from their goal."""
    angle = float(np.linalg.norm(moved[3:6]))
    turn = np.reshape(axis_angle(floats(moved[3:6] / (angle or 1.0)), angle), (3, 3))
    arms, drones = system.anchors @ goal.rotation[0].T, moved[6:].reshape(-1, 3)
    cables = goal.slots[0] + drones - (goal.position[0] + moved[:3] + arms @ turn.T)
    stretch = np.linalg.norm(cables, axis=1) - system.cable_length
    spring = 0.5 * stiffness @ (drones**2).sum(axis=1) - (cable_force * drones).sum()
    return float(9.81 * system.payload_mass * moved[2] + 0.5 * 1e3 * (stretch**2).sum() + spring)


def test_a_payload_settles_where_its_potential_energy_is_convex():
    system = load_config("pose_falcon3", {"cable.stiffness": 1e3}).system
    found = []
    for soft in (3.0, 6.0, 12.0):
        for roll, pitch in ((0.3, -0.2), (0.75, 0.6), (-0.78, 0.6), (0.7, -0.7), (-0.6, -0.5)):
            goal = placed(system, 0.4, roll, lambda goal, rig: place_balanced(0, goal, rig), pitch)
            stiffness, size, step = np.array([soft, 2 * soft, soft]), 6 + 9, 1e-4
            moves = step * np.eye(size)
            corners = np.array([[
                sum(p * q * energy(p * moves[i] + q * moves[j], system, goal, goal.cable_force[0], stiffness)
                    for p in (1, -1) for q in (1, -1))
                for j in range(size)] for i in range(size)])  # fmt: skip
            least = np.linalg.eigvalsh(corners / (4 * step**2)).min()
            found.append(is_stable(0, goal, make_rig(system), stiffness))
            assert found[-1] == (least > 0), (soft, roll, pitch, least)
    assert 0 < sum(found) < len(found)


def test_a_symmetric_matrix_is_positive_definite_if_all_its_eigenvalues_are():
    rng, found = np.random.default_rng(0), []
    for _ in range(400):
        half = rng.normal(size=(3, 3)) + rng.uniform(-1, 2) * np.eye(3)
        matrix = half + half.T
        found.append(is_positive(floats(matrix)))
        assert found[-1] == (np.linalg.eigvalsh(matrix).min() > 0), matrix
    assert 40 < sum(found) < 360


def test_a_level_payload_of_grams_settles_as_well_as_one_of_kilograms():
    small = {"vehicle.preset": "crazyflie", "payload.mass": 0.02, "payload.size": [0.08, 0.08, 0.01]}
    system = make_system(3, **small, **{"cable.length": 0.3, "randomization.payload_force": 0.0})
    goal = placed(system, 0.0, 0.0, lambda goal, rig: place_balanced(0, goal, rig))
    assert is_stable(0, goal, make_rig(system), np.full(3, 0.5))


def test_every_wrench_that_taut_cables_can_exert_is_found():
    """Wrenches by the conditions of Karush, Kuhn and Tucker, with given forces that differ, far from the optimum."""
    rng, left = np.random.default_rng(0), []
    for _ in range(12_000):
        n = rng.integers(3, 7)
        azimuth, lean = 2 * np.pi * np.arange(n) / n, np.deg2rad(rng.choice([0.0, 10.0, 30.0, 60.0]))
        away = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.ones(n)])
        anchors = away * [0.27, 0.22, 0.075] - rng.uniform(-0.2, 0.2, 3) * [1.0, 1.0, 0.2]
        given = away * [np.sin(lean), np.sin(lean), np.cos(lean)] * rng.uniform(0.2, 7.0, (n, 1))
        size = np.linalg.norm(given, axis=1)
        linear = rng.normal(size=3) * rng.choice([1, 3, 10, 30])
        angular = rng.normal(size=3) * rng.choice([1, 5, 20, 60])
        force = given + linear + np.cross(angular, anchors)
        short = np.maximum(0.0, 0.2 * size - (given * force).sum(axis=1) / size)
        force += (short / size)[:, None] * given
        wrench = force.sum(axis=0), np.cross(anchors, force).sum(axis=0)
        found = given.copy()
        missed = solve_cable_forces(*map(tuple, wrench), LEVEL, anchors, 0.2, found)
        left.append(missed / np.abs(wrench[0]).max())
        if left[-1] < 1e-9:
            assert np.abs(found - force).max() < 1e-5 * np.abs(force).max()
    assert np.sum(np.array(left) > 1e-6) <= 1
