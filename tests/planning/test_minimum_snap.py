"""Minimum-snap polynomials: through way-points, at rest at the ends, of least snap; and their times."""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest
from conftest import largest_motion

from multilift_marl.math3d import ease
from multilift_marl.planning import minimum_snap
from multilift_marl.planning.minimum_snap import allocate_times, fit_minimum_snap

RNG = np.random.default_rng(0)
TIMES = np.array([0.0, 0.7, 2.0, 2.4, 4.1])
VALUES = RNG.uniform(-2, 2, (5, 4))


def powers(t: float, derivative: int) -> np.ndarray:
    """Return (8,) by which coefficients, constant first, give a derivative at t."""
    k = np.arange(8)
    factors = [factorial(i) / factorial(i - derivative) if i >= derivative else 0.0 for i in k]
    return np.array(factors) * t ** np.maximum(k - derivative, 0)


def solve_quadratic_programme(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return coefficients (P, 8, D) of least ∫ |snap|², by the conditions of optimality in one system."""
    steps = np.diff(times)
    count = len(steps)
    cost, rows, right = np.zeros((8 * count, 8 * count)), [], []

    def demand(terms: list[tuple[int, np.ndarray]], value: np.ndarray) -> None:
        row = np.zeros(8 * count)
        for piece, part in terms:
            row[8 * piece : 8 * piece + 8] = part
        rows.append(row)
        right.append(value)

    for i, h in enumerate(steps):
        for j in range(4, 8):
            for k in range(4, 8):
                both = factorial(j) / factorial(j - 4) * factorial(k) / factorial(k - 4)
                cost[8 * i + j, 8 * i + k] = both * h ** (j + k - 7) / (j + k - 7)
        demand([(i, powers(0.0, 0))], values[i])
        demand([(i, powers(h, 0))], values[i + 1])
        if i + 1 < count:
            for derivative in (1, 2, 3):  # what rigid bodies need; more is the optimum's own
                after = -powers(0.0, derivative)
                demand([(i, powers(h, derivative)), (i + 1, after)], np.zeros(values.shape[1]))
    for derivative in (1, 2, 3):
        demand([(0, powers(0.0, derivative))], np.zeros(values.shape[1]))
        demand([(count - 1, powers(steps[-1], derivative))], np.zeros(values.shape[1]))
    a = np.array(rows)
    system = np.block([[cost, a.T], [a, np.zeros((len(a), len(a)))]])
    known = np.vstack([np.zeros((8 * count, values.shape[1])), np.array(right)])
    return np.linalg.solve(system, known)[: 8 * count].reshape(count, 8, -1)


def test_it_is_the_solution_of_the_quadratic_programme():
    coefficients = solve_quadratic_programme(TIMES, VALUES)
    spline = fit_minimum_snap(TIMES, VALUES)
    for i, (begin, end) in enumerate(zip(TIMES[:-1], TIMES[1:], strict=True)):
        for t in np.linspace(0, end - begin, 7):
            for derivative in range(4):
                expected = powers(t, derivative) @ coefficients[i]
                scale = np.abs(coefficients[i]).max()
                np.testing.assert_allclose(spline(begin + t, derivative), expected, atol=1e-9 * scale)


def test_it_passes_way_points_and_rests_at_both_ends():
    spline = fit_minimum_snap(TIMES, VALUES)
    np.testing.assert_allclose(spline(TIMES), VALUES, atol=1e-12)
    for derivative in (1, 2, 3):
        np.testing.assert_allclose(spline(TIMES[[0, -1]], derivative), 0.0, atol=1e-9)
    assert np.linalg.norm(spline(TIMES[1:-1], 1), axis=1).min() > 1.0  # in between it does not stop


def test_a_single_piece_is_the_polynomial_of_textbooks():
    spline = fit_minimum_snap(np.array([0.0, 2.0]), np.array([[0.0], [3.0]]))
    s = np.linspace(0, 1, 11)
    expected = 3 * s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
    np.testing.assert_allclose(spline(2 * s)[:, 0], expected, atol=1e-12)


def test_the_slope_of_the_cost_is_that_of_differences():
    logs = RNG.normal(size=4) * 0.4
    cost, slope = minimum_snap._relative_cost(logs, VALUES)
    for k in range(4):
        step = 1e-5 * np.eye(4)[k]
        ahead, behind = (minimum_snap._relative_cost(logs + sign * step, VALUES)[0] for sign in (1, -1))
        assert slope[k] == pytest.approx((ahead - behind) / 2e-5, rel=1e-5, abs=1e-6)
    steps = np.exp(logs)
    spline = fit_minimum_snap(np.append(0, np.cumsum(steps)), VALUES)
    t = np.linspace(0, steps.sum(), 200_001)
    integral = np.trapezoid((spline(t, 4) ** 2).sum(axis=1), t)
    assert cost == pytest.approx(np.log(integral) + 7 * np.log(steps.sum()), abs=1e-4)


@pytest.mark.parametrize("count", [2, 3, 12])
@pytest.mark.parametrize(("speed", "acceleration"), [(1.0, 50.0), (50.0, 2.0), (2.0, 2.0)])
def test_allocated_times_just_keep_to_the_limits(count, speed, acceleration):
    values = np.cumsum(np.random.default_rng(count).normal(size=(count, 4)), axis=0)
    slots = np.array([[0.7, 0.1], [-0.5, 0.9]])
    times = allocate_times(values, slots, speed, acceleration)
    t = np.linspace(0, times[-1], 20_000)
    fastest, hardest = largest_motion(fit_minimum_snap(times, values)(t), t, slots)
    assert max(fastest / speed, hardest / acceleration) == pytest.approx(1.0, abs=2e-3)


def test_allocated_times_are_nearly_the_shortest():
    """Beside random changes of the shares of the pieces: none is shorter by more than 10 %."""
    values = np.cumsum(np.random.default_rng(5).normal(size=(6, 3)), axis=0)
    times = allocate_times(np.column_stack([values, np.zeros(6)]), np.ones((1, 2)), 2.0, 2.0)
    rng, lengths = np.random.default_rng(0), []
    for _ in range(300):
        steps = np.diff(times) * np.exp(0.3 * rng.normal(size=5))
        changed = np.append(0.0, np.cumsum(steps))
        spline, t = fit_minimum_snap(changed, values), np.linspace(0, changed[-1], 400)
        speed, hard = (np.linalg.norm(spline(t, derivative), axis=1).max() for derivative in (1, 2))
        lengths.append(changed[-1] * max(speed / 2, np.sqrt(hard / 2)))
    assert times[-1] < 1.1 * min(lengths) and times[-1] < np.median(lengths)


def test_a_move_from_rest_to_rest_is_that_through_its_two_ends():
    """`math3d.ease` moves goals of tasks, poses and drones of PX4: the law of way-points for two of them."""
    times, t = np.array([0.5, 2.0]), np.linspace(0.5, 2.0, 31)
    spline = fit_minimum_snap(times, np.array([[0.0], [1.0]]))
    moved = np.array([ease(each, 0.5, 1.5) for each in t])
    for derivative in range(4):
        np.testing.assert_allclose(moved[:, derivative], spline(t, derivative)[:, 0], atol=1e-9)
