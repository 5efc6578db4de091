"""Drones that plan for themselves: their model, the mean of their plans, what they say and hear."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import make_system

import multilift_marl as ml
from multilift_marl.planning.distributed_planner import (
    MOMENTUM,
    SLOWEST,
    DistributedPlanner,
    set_others,
    sweep_shares,
    take_own,
)
from multilift_marl.planning.flatness import FlatMotion, FlatWork, make_flat_team, set_flat_state, steady_shape
from multilift_marl.planning.force_estimator import PAYLOAD, make_priors
from multilift_marl.planning.plan_messages import believe, hear, said_at
from multilift_marl.planning.team_model import ModelWork, accelerations, make_model, move_to_middle, state_size
from multilift_marl.planning.team_planner import TeamPlanner
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sensing.communication import Links
from multilift_marl.sim.obstacles import SPHERE, Obstacles, place_obstacle

sys.path.insert(0, str(Path(__file__).parents[2] / "results"))

import planner_consensus

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

N, STEP = 3, 0.05
Q = 6 + 2 * N
LOAD = np.array([0.5, -0.3, 0.2, 0.02, -0.01, 0.03, 0.2])


def links(delay=0, loss=0.0, partners=None):
    return Links(~np.eye(N, dtype=bool) if partners is None else partners, delay, loss, np.inf)


def planner(settings=None, num_envs=1, **kinds):
    return DistributedPlanner(make_system(N), settings or PlannerConfig(), num_envs, None, links(**kinds))


def at_rest(system):
    model = make_model(system)
    x, team = np.zeros(state_size(N)), make_flat_team(model, system)
    pose = np.tile([0.0, 0.0, 2.0], (5, 1)), np.tile(np.eye(3), (5, 1, 1))
    set_flat_state(FlatMotion(*pose, steady_shape(team)), 0.0, np.zeros(7), team, FlatWork.of(N), x)
    return model, x


def held(plans, size):
    """Return poses to hold, and offsets of none, of so many plans."""
    shape = size, *plans.times.shape
    positions = np.tile([0.0, 0.0, 2.0], (*shape, 1))
    return positions, np.tile(np.eye(3), (*shape, 1, 1)), np.zeros((*shape[:2], 12))


def cost(plans, states, inputs):
    """Return what the central planner minimises, without limits, of a plan that holds a pose."""
    o, off = plans.objective, states - plans.plans.targets[0]
    running = STEP * ((o.state * off[:-1] ** 2).sum() + (o.rate * inputs**2).sum())
    return 0.5 * (running + (o.end * off[-1] ** 2).sum())


@pytest.mark.parametrize("n", range(N))
def test_a_drone_alone_with_the_others_pulls_moves_as_in_the_team(n):
    system, rng = make_system(N), np.random.default_rng(n)
    model, rest = at_rest(system)
    apart = planner()._apart
    steps = len(apart.inputs)
    states = rest + 0.05 * rng.normal(size=(steps + 1, len(rest)))
    inputs = rng.normal(size=(steps, 3 * N))
    set_others(n, states, inputs, STEP, model, LOAD, apart)
    for k in (0, 7):
        middle, own, whole, alone = np.zeros(len(rest)), np.zeros(19), ModelWork.of(N), ModelWork.of(1)
        move_to_middle(states[k], inputs[k], STEP, model, middle)
        accelerations(middle, model, LOAD, whole)
        one = model._replace(
            anchors=model.anchors[n : n + 1], drone_mass=model.drone_mass[n : n + 1], length=model.length[n : n + 1]
        )
        take_own(n, middle, own)
        accelerations(own, one, apart.loads[k], alone)
        np.testing.assert_allclose(alone.acceleration[:6], whole.acceleration[:6], rtol=1e-10, atol=1e-11)
        np.testing.assert_allclose(alone.acceleration[6:8], whole.acceleration[6 + 2 * n : 8 + 2 * n], rtol=1e-10)
        assert alone.tension[0] == pytest.approx(whole.tension[n], rel=1e-10)


def test_plans_come_near_the_central_one_and_agree():
    """From a displaced and moving payload: the cost of each drone's plan, after 40 sweeps, and all of the payload."""
    system, settings = make_system(N), PlannerConfig(sweeps=40)
    central, apart = TeamPlanner(system, settings, 1), planner(settings)
    _, start = at_rest(system)
    start[[0, 1, Q]] += 0.08, -0.05, 0.1
    for _ in range(30):
        best = central.plan(start[None].copy(), *held(central, 1)[:2], 0.0, held(central, 1)[2])
    positions, rotations, offsets = held(apart, N)
    found = apart.plan(np.tile(start, (N, 1)), positions, rotations, 0.0, offsets)
    least = cost(central, best.states[0], best.inputs[0])
    nothing = cost(central, np.tile(start, (settings.steps + 1, 1)), np.zeros_like(best.inputs[0]))
    for n in range(N):
        assert least * 0.999 < cost(central, found.states[n], found.inputs[n]) < least + 0.05 * (nothing - least)
    np.testing.assert_allclose(found.states[1:], found.states[:1].repeat(N - 1, axis=0), atol=1e-6)


@pytest.mark.parametrize("exact", [False, True])
def test_sweeps_improve_plans(exact):
    costs = []
    for sweeps in (1, 3, 10):
        settings = PlannerConfig(sweeps=sweeps)
        apart = DistributedPlanner(make_system(N), settings, 1, None, links(), exact)
        _, start = at_rest(make_system(N))
        start[0] += 0.1
        positions, rotations, offsets = held(apart, N)
        found = apart.plan(np.tile(start, (N, 1)), positions, rotations, 0.0, offsets)
        costs.append(cost(apart, found.states[0], found.inputs[0]))
    assert costs[0] > costs[1] > costs[2]


@pytest.mark.parametrize("drones", [2, 3, 8])
@pytest.mark.parametrize("sweeps", [2, 3, 5, 12])
def test_shares_of_sweeps_leave_what_chebyshevs_polynomial_does(sweeps, drones):
    """Of an error that a whole step of all would undo `factor` times, from 1; of no fast one more than there was."""
    shares = sweep_shares(sweeps, drones, exact=True)
    assert shares.shape == (sweeps, 2) and shares[0, 1] == 0.0
    middle, half = (drones + SLOWEST) / 2, (drones - SLOWEST) / 2
    for factor in (0.0, 0.1, SLOWEST, 1.0, 0.7 * drones, drones):
        left, change = 1.0, 0.0
        for share, momentum in shares:
            change = momentum * change - share * factor * left
            left += change
        of = np.polynomial.Chebyshev.basis(sweeps)
        assert left == pytest.approx(of((middle - factor) / half) / of(middle / half), abs=1e-12)
        assert abs(left) <= 1.0


def test_from_noisy_states_and_in_a_single_sweep_drones_go_to_the_mean():
    np.testing.assert_array_equal(sweep_shares(1, 4, exact=True), [[0.25, 0.0]])
    np.testing.assert_array_equal(sweep_shares(3, 4, exact=False), [[0.25, 0.0], [0.25, MOMENTUM], [0.25, MOMENTUM]])


def test_a_plan_that_is_not_finite_is_not_believed():
    """Nor is one that was sound before forgotten for it."""
    apart = planner(delay=1)
    _, start = at_rest(make_system(N))
    positions, rotations, offsets = held(apart, N)
    states = np.tile(start, (N, 1))
    for step in range(6):
        if step == 2:
            apart.plans.states[0, :, 6] = np.nan  # the own cable of the first drone
        failed = apart.plan(states, positions, rotations, 0.02, offsets).failed
        assert failed.tolist() == [step == 2, False, False]


def test_what_is_heard_late_is_moved_on():
    steps = 10
    times = STEP * np.arange(steps + 1)
    said = np.stack([np.full(steps + 1, 0.1 * i) + times for i in range(7)], axis=1)
    states, inputs = np.zeros((steps + 1, state_size(N))), np.zeros((steps, 3 * N))
    believe(1, said, 0.4, states, inputs, STEP)
    columns = [said_at(i, 1, Q) for i in range(7)]
    late = np.minimum(times + 0.4 * STEP, times[-1])
    np.testing.assert_allclose(states[:, columns], 0.1 * np.arange(7) + late[:, None], atol=1e-12)
    np.testing.assert_allclose(inputs[:-1, 3:6], 1.0)
    others = np.delete(np.arange(states.shape[1]), columns)
    assert (states[:, others] == 0).all() and (inputs[:, [0, 1, 2, 6, 7, 8]] == 0).all()


@pytest.mark.parametrize("loss", [0.0, 0.3, 1.0])
def test_so_many_messages_are_lost(loss):
    apart = planner(loss=loss)
    post, plans = apart.post, apart.plans
    heard = np.zeros((N, N))
    for _ in range(400):
        plans.states[:], post.sent[:] = 0.0, 1.0
        hear(0, 0, 0.0, apart.links, post, plans, STEP)
        heard += [[plans.states[n, 0, said_at(0, m, Q)] for m in range(N)] for n in range(N)]
    expected = 400 * (1 - loss) * ~np.eye(N, dtype=bool)
    assert (abs(heard - expected) <= 4 * np.sqrt(400 * loss * (1 - loss))).all()


def test_those_out_of_reach_are_not_heard():
    partners = np.zeros((N, N), bool)
    partners[0, 1] = True
    apart = planner(partners=partners)
    apart.post.sent[:] = 1.0
    hear(0, 0, 0.0, apart.links, apart.post, apart.plans, STEP)
    heard = [[apart.plans.states[n, 0, said_at(0, m, Q)] for m in range(N)] for n in range(N)]
    assert (np.array(heard) == partners).all()


def test_a_team_plans_the_same_in_any_batch():
    _, rest = at_rest(make_system(N))
    found = []
    for envs in (1, 3):
        apart = planner(num_envs=envs, delay=1, loss=0.4)
        starts = np.tile(rest, (envs * N, 1))
        starts[-N:, 0] += 0.1
        starts[: -N or None, 1] -= 0.2
        starts[-N:, 1] = 0.0
        for _ in range(4):
            positions, rotations, offsets = held(apart, envs * N)
            plans = apart.plan(starts.copy(), positions, rotations, 0.02, offsets)
        found.append(plans.states[-N:].copy())
    np.testing.assert_array_equal(*found)


def test_drones_take_the_mean_of_the_loads_that_they_know_of():
    partners = np.array([[0, 1, 1], [1, 0, 0], [0, 0, 0]], bool)
    apart = planner(partners=partners)
    _, rest = at_rest(make_system(N))
    loads = np.arange(N)[:, None] * np.full(7, 0.1)
    positions, rotations, offsets = held(apart, N)
    for _ in range(2):  # what was heard in a step counts in the next one
        apart.plan(np.tile(rest, (N, 1)), positions, rotations, 0.02, offsets, loads)
    np.testing.assert_allclose(apart._agree(loads)[:, 0], [0.1, 0.05, 0.2])
    apart.plans.fresh[:] = True
    np.testing.assert_allclose(apart._agree(loads)[:, 0], [0.0, 0.1, 0.2])


def test_drones_keep_away_from_where_others_say_they_are():
    """With a large least distance, drones at rest plan to be farther apart."""
    gaps = []
    for factor in (0.5, 4.0):
        settings = PlannerConfig(separation=factor, sweeps=10)
        apart = planner(settings)
        _, rest = at_rest(make_system(N))
        positions, rotations, offsets = held(apart, N)
        found = apart.plan(np.tile(rest, (N, 1)), positions, rotations, 0.0, offsets).states[0, -1]
        c = found[6 : 6 + 2 * N].reshape(N, 2)
        gaps.append(np.linalg.norm(c - c.mean(axis=0), axis=1).mean())
    assert gaps[1] > gaps[0] + 0.01


@pytest.mark.parametrize("preset", [["iris", "iris", "iris"], ["falcon", "iris", "iris"]])
def test_each_drone_keeps_clear_of_obstacles_by_its_own_size(preset):
    """A sphere 0.27 m from an iris, whose own one has 0.255 m, repels it whoever else is in the team."""
    system = ml.load_config("hover", {"env.num_drones": N, "vehicle.preset": preset}).system
    model, rest, moves = make_model(system), np.zeros(state_size(N)), []
    pose = np.tile([0.0, 0.0, 2.0], (5, 1)), np.tile(np.eye(3), (5, 1, 1))
    team = make_flat_team(model, system)
    set_flat_state(FlatMotion(*pose, steady_shape(team)), 0.0, np.zeros(7), team, FlatWork.of(N), rest)
    c = rest[8:10]
    drone = rest[:3] + model.anchors[1] + model.length[1] * np.array([*c, np.sqrt(1 - c @ c)])
    for gap in (9.0, 0.27):
        obstacles = Obstacles.zeros(1, 1)
        place_obstacle(0, 0, obstacles, SPHERE, (0.2, 0.2, 0.2), tuple(drone + [0.0, 0.0, 0.2 + gap]))
        apart = DistributedPlanner(system, PlannerConfig(clearance=0.1), 1, obstacles, links())
        plans = apart.plan(np.tile(rest, (N, 1)), *held(apart, N)[:2], 0.0, held(apart, N)[2])
        moves.append(plans.inputs[1, :, 3:6].copy())
    assert np.abs(moves[1] - moves[0]).max() > 1.0


def test_a_message_holds_seven_numbers_of_each_step_and_seven_of_the_load():
    assert planner().message_bytes == 4 * (7 * 21 + 7) == 616


def test_each_drone_estimates_but_the_payload_and_itself():
    model, _ = at_rest(make_system(N))
    one, each = make_priors(model, 1.0), make_priors(model, 1.0, apart=True)
    assert len(one.first) == 1 and len(each.first) == N
    for n in range(N):
        own = [*range(PAYLOAD), *range(PAYLOAD + 3 * n, PAYLOAD + 3 * n + 3)]
        np.testing.assert_array_equal(each.first[n, own], one.first[0, own])
        assert not np.delete(each.first[n], own).any() and not np.delete(each.drift[n], own).any()
        assert (each.noise[n, :6] == one.noise[0, :6]).all() and each.noise[n, 6 + 2 * n] == one.noise[0, 6 + 2 * n]


def test_the_other_coupling_that_was_tried_comes_to_the_central_optimum():
    """ADMM's problems of drones and payload are those of the team, or 40 exchanges would not end at its optimum."""
    team = planner_consensus.Team(ml.load_config("hover", {"env.num_drones": N}))
    start = np.zeros(state_size(N))
    start[[0, 3, 6, Q]] = 0.01, 0.005, 0.003, -0.02
    found = planner_consensus.admm(team, start[None], (0.1, 0.1), 40)[:, 0]
    assert team.excess(start, found[0]) > 0.5 and team.excess(start, found[-1]) < 1e-3
    assert team.excess(start, np.zeros_like(found[0])) == pytest.approx(1.0)
    assert 0.0 < team.excess(start, planner_consensus.jacobi(team, start, 10)) < 0.03
