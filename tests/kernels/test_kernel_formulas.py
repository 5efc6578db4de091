"""Parts of kernels as Python, against closed forms: solvers of chains, noticing a loss, targets, paths, intervals."""

from __future__ import annotations

import numpy as np
import pytest
from plain_kernels import plain, record, turned

from multilift_marl.evaluation import metrics
from multilift_marl.planning import paths, targets, trajectory
from multilift_marl.sensing import loss_detection as loss_notice
from multilift_marl.sim.cables import chain_solver

G = 9.81

# Chains


def test_the_tension_of_a_link_grows_by_damping_and_by_the_stretch_of_a_substep():
    """The force counts between the middle and the end of the substep h: 0.5 k h to k h, and c."""
    gain = plain(chain_solver.stretch_gain)
    assert gain(2e4, 30.0, 0.0) == 30.0
    assert 0.5 * 2e4 * 1e-3 + 30.0 <= gain(2e4, 30.0, 1e-3) <= 2e4 * 1e-3 + 30.0
    assert gain(4e4, 30.0, 1e-3) - gain(2e4, 30.0, 1e-3) == pytest.approx(gain(2e4, 0.0, 1e-3))


def test_the_steepest_link_decides_how_steep_a_chain_is():
    chain = record(
        segments=np.array([2, 3]), node_mass=np.array([[0.01, 0.02]]), length=np.array([[0.1, 0.2]])
    )  # of links
    work = record(tension=np.array([[3.0, -5.0, 99.0], [2.0, -8.0, 6.0]]))
    assert plain(chain_solver.steepness)(0, 1e-3, chain, work) == pytest.approx(5.0 / (0.01 * 0.1) * 1e-6)


def test_the_factors_of_first_links_multiply_to_their_matrix():
    """Of n cables with one link: D + (d_n · d_m / m + (r_n × d_n) · J⁻¹ (r_m × d_m)), symmetric and positive."""
    rng, n, mass = np.random.default_rng(0), 4, 1.7
    inverse = np.linalg.inv(np.diag([0.02, 0.03, 0.04]))
    direction = rng.normal(size=(n, 1, 3))
    direction /= np.linalg.norm(direction, axis=2, keepdims=True)
    ends, diagonal = rng.normal(size=(n, 2, 3)) * 0.3, rng.uniform(0.1, 0.5, (n, 1))
    moments = np.cross(ends[:, 0], direction[:, 0])
    work = record(
        direction=direction, ends=ends, twist=moments @ inverse, diagonal=diagonal.copy(), coupling=np.zeros((n, 1)),
        matrix=np.zeros((n, n)),
    )  # fmt: skip
    chain = record(segments=np.ones(n, int), bodies=record(mass=np.array([[mass]])))
    state = record(cable_broken=np.zeros((1, n), bool))
    plain(chain_solver.factorize)(0, state, chain, work)
    expected = direction[:, 0] @ direction[:, 0].T / mass + moments @ inverse @ moments.T + np.diag(diagonal[:, 0])
    lower = np.tril(work.matrix)
    np.testing.assert_allclose(lower @ lower.T, expected, rtol=1e-12)


# Noticing a loss


@pytest.mark.parametrize("lost, change", [(1, (0.5, 0.2)), (2, (0.3, 0.3)), (3, (-0.3, 0.6))])
def test_the_loss_that_is_felt_is_the_one_whose_change_is_nearest(lost, change):
    """Changes of tension and climb of drone 0 for the loss of each other one; what is felt is 1.1 times one of them."""
    changes = np.zeros((4, 4, 2))
    changes[1, 0], changes[2, 0], changes[3, 0] = (0.5, 0.2), (0.3, 0.3), (-0.3, 0.6)
    own = record(
        past=np.zeros((1, 4, 3, 2)), known=np.zeros((1, 4), bool), known_who=np.zeros((1, 4), int),
        known_when=np.zeros((1, 4)), unsure=np.zeros((1, 4), bool), noticed_at=np.zeros((1, 4, 3)),
    )  # fmt: skip
    own.past[0, 0] = [[1.0, 0.3], [1.0, 0.3], [1.0, 0.3]]
    tension, velocity = np.full((1, 4), 8.0 * (1.0 + 1.1 * change[0])), np.zeros((1, 4, 3))
    velocity[0, 0, 2] = 0.3 + 1.1 * change[1]
    load = record(position=np.ones((1, 4, 3)), tension=tension, velocity=velocity)
    v = record(
        own=own, payload_estimate=load, resting_tension=np.full(4, 8.0), settings=record(changes=changes),
        time=np.array([loss_notice.SETTLED + 1.0]),
    )  # fmt: skip
    plain(loss_notice.detect_drone_loss)(0, 0, v)
    assert own.known[0, 0] and own.known_who[0, 0] == lost
    np.testing.assert_allclose(own.past[0, 0, -1], [tension[0, 0] / 8.0, velocity[0, 0, 2]])


# Targets


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.0])
def test_without_a_plan_cable_forces_turn_with_the_team_and_bear_the_cables(yaw):
    force = np.array([1.0, -2.0, 5.0])
    plan = record(cable_force=np.zeros((1, 3, 2, 3)), stage=np.array([1]))
    plan.cable_force[0, 2, 1] = force
    goal = record(cable_force=np.zeros((1, 2, 3)), slot_frame=np.zeros((1, 2, 3, 3)))
    rig = record(heading=np.zeros(2), cable_weight=np.array([0.4, 0.6]))
    v = record(own=record(plan=plan), goal=goal, rig=rig)
    turn_team = plain(trajectory.turn_team)
    turn_team.__globals__["turn_slot_frame"] = lambda *arguments: None
    turn_team(0, 1, yaw, v)
    np.testing.assert_allclose(goal.cable_force[0, 1], turned([0, 0, 1], yaw) @ force + [0.0, 0.0, 0.6])


@pytest.mark.parametrize("spare, within", [(1.001, True), (0.999, False)])
def test_a_target_is_within_bounds_if_the_heaviest_drones_carry_their_cables_and_the_heaviest_payload(spare, within):
    weight, mass, pull, load = np.array([0.4, 0.6]), np.array([0.5, 0.7]), np.array([2.0, 3.0]), 1.2
    slots, anchors = np.array([[0.5, 0.0, 3.0], [-0.5, 0.0, 3.0]]), np.array([[0.2, 0.0, 0.1], [-0.2, 0.0, 0.1]])
    goal = record(
        rotation=np.eye(3)[None], position=np.array([[0.0, 0.0, 2.0]]), slots=slots[None],
        cable_force=np.stack([0 * pull, 0 * pull, pull + weight], axis=-1)[None],
    )  # fmt: skip
    thrust = load * pull + weight + 1.3 * mass * G
    thrust[1] *= spare
    rig = record(slots=slots, anchors=anchors, mass=mass, cable_weight=weight, cable_length=np.ones(2))
    bounds = record(half=(0.3, 0.2, 0.1), load=load, thrust=thrust + [1.0, 0.0], separation=np.full((2, 2), 0.3))
    bounds.drone = 1.3
    bounds.center = (0.0, 0.0, 0.0)
    bounds.cables, is_within = np.full((2, 2), 0.1), plain(targets._within)
    is_within.__globals__["goal_hook"] = lambda e, n, goal, rig: tuple(goal.slots[e, n])
    assert is_within(0, goal, rig, bounds) == within


# Paths


def test_a_drawn_curve_is_smooth_and_rests_at_both_ends():
    """Of a cubic with values p and second derivatives m at 0 and 1 the slopes are p₁ - p₀ - (2 m₀ + m₁)/6, + ..."""
    points, bend = np.moveaxis(paths.draw_curve(np.random.default_rng(0), np.array([1.0, 2.0, 0.5])), 1, 0)
    left = np.diff(points, axis=0) - (2 * bend[:-1] + bend[1:]) / 6  # slope of each piece at its beginning
    right = np.diff(points, axis=0) + (bend[:-1] + 2 * bend[1:]) / 6
    np.testing.assert_allclose(left[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(right[-1], 0.0, atol=1e-12)
    np.testing.assert_allclose(left[1:], right[:-1], atol=1e-12)
    assert (points[0] == 0).all() and np.ptp(points, axis=0).min() > 0.5


# Intervals


def test_an_interval_leaves_out_as_many_of_the_resampled_means_below_as_above():
    below, above = [], []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        values = rng.exponential(size=40)
        means = values[rng.integers(0, 40, (10_000, 40))].mean(axis=1)
        low, high = metrics.bootstrap(values, seed=100 + seed)
        below.append(np.mean(means < low))
        above.append(np.mean(means > high))
    assert np.mean(below) == pytest.approx(0.025, abs=0.0025) == np.mean(above)
