"""Plans of a team: a Gauss-Newton step against the whole problem solved at once; what is estimated; approaches."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.planning.approach import Approach, begin_approaches, write_approaches
from multilift_marl.planning.force_estimator import ForceEstimator
from multilift_marl.planning.riccati import IterationWork, Objective, Problem, find_gains, take_step
from multilift_marl.planning.soft_limits import CABLE_POINTS
from multilift_marl.planning.team_model import (
    ModelWork,
    accelerations,
    make_model,
    set_rotation,
    state_size,
    step_state,
)
from multilift_marl.planning.team_planner import TeamPlanner, make_objective, make_surroundings
from multilift_marl.schema.planner import PlannerConfig
from multilift_marl.sim.obstacles import BOX, CYLINDER, SPHERE, Obstacles, place_obstacle

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

N, STEPS, STEP = 3, 6, 0.05
SIZE, Q, NU = state_size(N), 6 + 2 * N, 3 * N


@pytest.fixture(scope="module")
def system():
    return ml.load_config("hover", {"env.num_drones": N}).system


def at_rest(system):
    model, x = make_model(system), np.zeros(SIZE)
    force = system.formation_force
    x[2] = 1.0
    x[6:Q] = (force / np.linalg.norm(force, axis=1, keepdims=True))[:, :2].ravel()
    x[2 * Q :] = (force + model.drone_mass[:, None] * [0, 0, 9.81]).ravel()
    return model, x


def derivative(function, at, h=1e-5):
    columns = [(function(at + e) - function(at - e)) / (2 * h) for e in h * np.eye(len(at))]
    return np.stack(columns, axis=1)


def drones(x, model):
    rotation, turning = np.zeros((3, 3)), np.zeros((3, 3, 3))
    set_rotation(x, rotation, turning)
    c = x[6:Q].reshape(N, 2)
    direction = np.c_[c, np.sqrt(1 - (c**2).sum(1))]
    return x[:3] + model.anchors @ rotation.T + model.length[:, None] * direction


def obstacles_about():
    """Return a box, a cylinder and a sphere, of which the last two move, near the team of environment 1."""
    found = Obstacles.zeros(2, 5)
    place_obstacle(1, 0, found, BOX, (0.3, 0.2, 0.4), (1.0, 0.3, 1.6), 0.6)
    place_obstacle(1, 2, found, CYLINDER, (0.2, 0.2, 2.0), (-0.9, 0.5, 1.4))
    place_obstacle(1, 3, found, SPHERE, (0.4, 0.4, 0.4), (0.1, -0.2, 0.4))
    place_obstacle(1, 4, found, SPHERE, (0.4, 0.4, 0.4), (9.0, 0.0, 1.0))
    found.velocity[1, 2], found.velocity[1, 3] = (0.5, -0.2, 0.0), (0.0, 0.0, -0.3)
    return found


def outside(point, m, obstacles):
    """Return how far a point is from an obstacle: closed forms outside of it."""
    local, size = obstacles.rotation[1, m].T @ (point - obstacles.position[1, m]), obstacles.size[1, m]
    if obstacles.kind[1, m] == SPHERE:
        return np.linalg.norm(local) - size[0]
    if obstacles.kind[1, m] == CYLINDER:
        return np.hypot(max(np.hypot(*local[:2]) - size[0], 0), max(abs(local[2]) - size[2], 0))
    return np.linalg.norm(np.maximum(np.abs(local) - size, 0))


def distances(x, after, model, around):
    """Return how far each point of a team is from each obstacle `after` [s] beyond the sphere about it."""
    rotation, turning = np.zeros((3, 3)), np.zeros((3, 3, 3))
    set_rotation(x, rotation, turning)
    anchors, corners = (x[:3] + points @ rotation.T for points in (model.anchors, around.points.corners))
    hooks = drones(x, model)
    points = [(point, 0.0) for point in corners]
    for n in range(N):
        points += [(anchors[n] + share * (hooks[n] - anchors[n]), 0.0) for share in CABLE_POINTS]
        points.append((hooks[n], around.points.radius[n]))
    moved, used = after * around.obstacles.velocity[1], (0, 2, 3, 4)
    return np.array([outside(p - moved[m], m, around.obstacles) - radius for m in used for p, radius in points])


def test_a_step_solves_the_linearised_problem_with_active_limits_of_every_kind(system):
    """Against one dense system: all states and inputs, gaps and limits, derivatives by differences."""
    model, rest = at_rest(system)
    rng = np.random.default_rng(1)
    states = rest + 0.03 * rng.normal(size=(STEPS + 1, SIZE))
    inputs, targets, asked = rng.normal(size=(STEPS, NU)), np.tile(rest, (STEPS + 1, 1)), np.zeros((STEPS, NU))
    start = rest + 0.05 * rng.normal(size=SIZE)
    objective = Objective(
        rng.uniform(1, 30, SIZE), rng.uniform(1, 9, SIZE), rng.uniform(1e-3, 1e-2, NU), np.full(N, 50.0),
        np.tile([0.0, 5.0], (N, 1)), np.full((N, N), 2.5), np.array([3.0, 2.0, 40.0]),
    )  # fmt: skip
    load = np.array([0.1, 0.2, -0.3, 0.01, 0.0, -0.01, 0.1])
    settings = PlannerConfig(clearance=0.3, clearance_tolerance=0.2, delay=0.1)
    around = make_surroundings(settings, system, model, obstacles_about())._replace(env=1)
    problem, w = Problem(targets, asked, STEP, model, load[None], objective, around), IterationWork.of(STEPS, N)
    scratch = ModelWork.of(N)

    def after(both):
        x = np.zeros(SIZE)
        step_state(both[:SIZE], both[SIZE:], STEP, model, load, scratch, x)
        return np.concatenate([x, scratch.tension])

    count = (STEPS + 1) * SIZE + STEPS * NU
    hessian, gradient = np.zeros((count, count)), np.zeros(count)
    rows, wanted = [], []
    excesses = [0, 0, 0, 0]

    def add(jacobian, value, weight):
        nonlocal hessian, gradient
        hessian += weight * np.outer(jacobian, jacobian)
        gradient += weight * value * jacobian

    first = np.zeros((SIZE, count))
    first[:, :SIZE] = np.eye(SIZE)
    rows.append(first)
    wanted.append(start - states[0])
    for k in range(STEPS + 1):
        x = slice(k * SIZE, (k + 1) * SIZE)
        weight = objective.end if k == STEPS else STEP * objective.state
        hessian[x, x] += np.diag(weight)
        gradient[x] += weight * (states[k] - targets[k])
        if k == STEPS:
            break
        u = slice((STEPS + 1) * SIZE + k * NU, (STEPS + 1) * SIZE + (k + 1) * NU)
        hessian[u, u] += np.diag(STEP * objective.rate)
        gradient[u] += STEP * objective.rate * inputs[k]
        both = np.concatenate([states[k], inputs[k]])
        value, slope = after(both), derivative(after, both)
        row = np.zeros((SIZE, count))
        row[:, x], row[:, u] = -slope[:SIZE, :SIZE], -slope[:SIZE, SIZE:]
        row[:, (k + 1) * SIZE : (k + 2) * SIZE] += np.eye(SIZE)
        rows.append(row)
        wanted.append(value[:SIZE] - states[k + 1])
        shorts = 0.3 - distances(states[k], 0.1 + k * STEP, model, around)
        slopes = derivative(lambda y, t=0.1 + k * STEP: -distances(y, t, model, around), states[k], 1e-6)
        for short, slope_of_short in zip(shorts, slopes, strict=True):
            if short > 0:
                jacobian = np.zeros(count)
                jacobian[x] = slope_of_short
                add(jacobian, short, STEP * 0.2**-2)
                excesses[3] += 1
        for n in range(N):
            short = objective.tension[n] - value[SIZE + n]
            if short > 0:
                jacobian = np.zeros(count)
                jacobian[x], jacobian[u] = -slope[SIZE + n, :SIZE], -slope[SIZE + n, SIZE:]
                add(jacobian, short, STEP * objective.weights[0])
                excesses[0] += 1
            force = states[k, 2 * Q + 3 * n : 2 * Q + 3 * n + 3]
            if (over := np.linalg.norm(force) - objective.thrust[n, 1]) > 0:
                jacobian = np.zeros(count)
                at = k * SIZE + 2 * Q + 3 * n
                jacobian[at : at + 3] = force / np.linalg.norm(force)
                add(jacobian, over, STEP * objective.weights[1])
                excesses[1] += 1
            for o in range(n):

                def gap(x, n=n, o=o):
                    place = drones(x, model)
                    return np.array([objective.separation[n, o] - np.linalg.norm(place[n] - place[o])])

                if (short := gap(states[k])[0]) > 0:
                    jacobian = np.zeros(count)
                    jacobian[x] = derivative(gap, states[k])[0]
                    add(jacobian, short, STEP * objective.weights[2])
                    excesses[2] += 1
    assert min(excesses) > STEPS
    constraints, right = np.concatenate(rows), np.concatenate(wanted)
    zero = np.zeros((len(right), len(right)))
    solved = np.linalg.solve(np.block([[hessian, constraints.T], [constraints, zero]]), np.r_[-gradient, right])
    new_states, new_inputs = states.copy(), inputs.copy()
    find_gains(new_states, new_inputs, problem, 0.0, w)
    take_step(start, new_states, new_inputs, problem, w)
    moved = (new_states - states).ravel(), (new_inputs - inputs).ravel()
    assert moved[0] == pytest.approx(solved[: (STEPS + 1) * SIZE], rel=1e-5, abs=1e-5 * abs(moved[0]).max())
    assert moved[1] == pytest.approx(solved[(STEPS + 1) * SIZE : count], rel=1e-5, abs=1e-5 * abs(moved[1]).max())


def test_iterations_end_at_a_trajectory_of_the_model_that_no_change_improves(system):
    model, rest = at_rest(system)
    objective = make_objective(PlannerConfig(), system, model)
    around = make_surroundings(PlannerConfig(), system, model)
    states, inputs = np.tile(rest, (STEPS + 1, 1)), np.zeros((STEPS, NU))
    problem = Problem(states.copy(), inputs.copy(), STEP, model, np.zeros((1, 7)), objective, around)
    start, w = rest.copy(), IterationWork.of(STEPS, N)
    start[:3] += [0.05, -0.03, 0.02]
    for _ in range(30):
        find_gains(states, inputs, problem, 0.0, w)
        take_step(start, states, inputs, problem, w)
    x, scratch = np.zeros(SIZE), ModelWork.of(N)
    for k in range(STEPS):
        step_state(states[k], inputs[k], STEP, model, np.zeros(7), scratch, x)
        assert x == pytest.approx(states[k + 1], abs=1e-9)

    def cost(change):
        total, here = 0.0, start.copy()
        for k in range(STEPS):
            off = here - problem.targets[k]
            total += 0.5 * STEP * (objective.state @ off**2 + objective.rate @ (inputs[k] + change[k]) ** 2)
            step_state(here, inputs[k] + change[k], STEP, model, np.zeros(7), scratch, x)
            here = x.copy()
        return total + 0.5 * objective.end @ (here - problem.targets[STEPS]) ** 2

    least, rng = cost(np.zeros_like(inputs)), np.random.default_rng(0)
    for _ in range(20):
        change = 0.2 * rng.normal(size=inputs.shape)
        assert cost(change) > least and cost(-change) > least
        assert cost(1e-3 * change) - cost(-1e-3 * change) == pytest.approx(0, abs=1e-5 * least)


def planned(system, states, **settings):
    """Return plans of teams at these states for a payload that stays at (0, 0, 1)."""
    planner = TeamPlanner(system, PlannerConfig(**settings), len(states))
    shape = (len(states), *planner.times.shape)
    positions, rotations = np.tile([0.0, 0.0, 1.0], (*shape, 1)), np.tile(np.eye(3), (*shape, 1, 1))
    offsets = np.zeros((*shape[:2], 12))
    return planner, planner.plan(states, positions, rotations, 0.02, offsets)


def test_targets_turn_on_beyond_half_a_turn(system):
    """A goal that turns through 6 rad within the horizon is planned as one turn: yaw does not leap back by 2 π."""
    _, rest = at_rest(system)
    rest[5] = 0.5
    planner = TeamPlanner(system, PlannerConfig(steps=60, step=0.1), 1)
    angles = 0.5 + planner.times
    c, s, zero = np.cos(angles), np.sin(angles), np.zeros_like(angles)
    rotations = np.moveaxis(np.array([[c, -s, zero], [s, c, zero], [zero, zero, zero + 1]]), (0, 1), (2, 3))
    positions = np.tile([0.0, 0.0, 1.0], (1, *angles.shape, 1))
    plans = planner.plan(rest[None], positions, rotations[None], 0.02, np.zeros((1, len(angles), 12)))
    np.testing.assert_allclose(plans.targets[0, :, 5], angles[:, 2], atol=1e-6)


def test_plans_of_teams_do_not_depend_on_their_neighbours(system):
    _, rest = at_rest(system)
    rng = np.random.default_rng(2)
    states = rest + 0.01 * rng.normal(size=(4, SIZE))
    _, together = planned(system, states)
    for e in range(4):
        _, alone = planned(system, states[e : e + 1].copy())
        assert np.array_equal(alone.inputs[0], together.inputs[e])


def test_a_plan_that_is_not_finite_begins_anew_and_says_so(system):
    _, rest = at_rest(system)
    states = np.tile(rest, (2, 1))
    states[1, 0] = np.nan
    planner, plans = planned(system, states)
    assert plans.failed.tolist() == [False, True] and np.isfinite(plans.inputs).all()
    shape = (2, *planner.times.shape)
    states[1] = rest
    poses = np.tile([0.0, 0.0, 1.0], (*shape, 1)), np.tile(np.eye(3), (*shape, 1, 1))
    again = planner.plan(states, *poses, 0.02, np.zeros((*shape[:2], 12)))
    assert not again.failed.any() and np.isfinite(again.states).all()


def test_estimates_do_not_feel_the_heading_pass_half_a_turn(system):
    """Two flights that differ by half a turn alone, seen with headings in (-π, π], of which one passes π."""
    found = []
    for begin in (-0.1, np.pi - 0.1):
        model, x = at_rest(system)
        turn = np.array([[np.cos(begin), -np.sin(begin)], [np.sin(begin), np.cos(begin)]])
        x[5], x[Q + 5], x[4] = begin, 1.0, 0.3
        for part in (x[6:Q].reshape(N, 2), x[2 * Q :].reshape(N, 3)[:, :2]):
            part[:] = part @ turn.T
        estimator, after, scratch, turned = ForceEstimator(model, 1, 0.2), np.zeros(SIZE), ModelWork.of(N), 0.0
        for _ in range(60):
            seen = x.copy()
            seen[5] = np.remainder(seen[5] + np.pi, 2 * np.pi) - np.pi
            turned = max(turned, x[5] - begin)
            estimator.update(seen[None], 0.02, np.ones(1, bool))
            for _ in range(20):
                step_state(x, np.zeros(NU), 1e-3, model, np.zeros(7), scratch, after)
                x, after = after.copy(), x
        assert turned > 0.15
        found.append(estimator.forces[0].reshape(N, 3).copy())
    np.testing.assert_allclose(found[1] * [-1, -1, 1], found[0], atol=1e-6)
    assert np.abs(found[0]).max() < 0.02


def estimate(system, load, forces, seconds=6.0):
    """Return what is estimated of a team that is shaken while unknown loads (7,) and forces (3 N,) act on it."""
    model, rest = at_rest(system)
    scratch, x, after = ModelWork.of(N), rest.copy(), np.zeros(SIZE)
    estimator, dt = ForceEstimator(model, 1, 0.2), 0.02
    held = x[2 * Q :] + np.repeat(np.eye(3)[2:], N, axis=0).ravel() * load[6] * 9.81 / N - forces
    for k in range(round(seconds / dt)):
        shaken = held + 1.5 * np.sin(0.2 * k + np.arange(NU))
        x[2 * Q :] = shaken + estimator.forces[0]
        estimator.update(x[None].copy(), dt, np.ones(1, bool))
        x[2 * Q :] = shaken + forces
        for _ in range(10):
            step_state(x, np.zeros(NU), dt / 10, model, load, scratch, after)
            x, after = after.copy(), x
    return model, estimator


def test_with_what_is_estimated_the_model_accelerates_as_the_team(system):
    """Forces of drones along their cables and on the payload are one where the team rests; what they do counts."""
    forces = np.array([0.5, -0.3, 0.2, 0.0, 0.4, -0.2, -0.4, 0.1, 0.0])
    load = np.array([0.4, -0.3, 0.0, 0.0, 0.0, 0.02, 0.1])
    model, estimator = estimate(system, load, forces)
    _, rest = at_rest(system)

    def accelerate(each, own):
        w, x = ModelWork.of(N), rest.copy()
        x[2 * Q :] += own
        accelerations(x, model, each, w)
        return w.acceleration.copy()

    true = accelerate(load, forces)
    unknown = np.abs(true - accelerate(np.zeros(7), np.zeros(NU)))
    missing = np.abs(true - accelerate(estimator.loads[0], estimator.forces[0]))
    assert unknown[:3].min() > 0.2 and unknown[6:].max() > 0.9
    assert missing[:3].max() < 0.06 and missing[6:].max() < 0.3


def test_a_hidden_mass_is_carried_whatever_it_is_taken_for(system):
    """Mass and a steady force downward are one while the payload hardly accelerates: their sum counts."""
    load = np.zeros(7)
    load[6] = 0.25 * at_rest(system)[0].payload_mass
    _, estimator = estimate(system, load, np.zeros(NU))
    found = 9.81 * estimator.loads[0, 6] - estimator.loads[0, 2] - estimator.forces[0, 2::3].sum()
    assert found == pytest.approx(9.81 * load[6], rel=0.05)
    assert estimator.loads[0, 6] > 0.4 * load[6]


def test_an_approach_begins_where_the_payload_is_and_ends_at_the_target():
    approach = Approach.zeros(1)
    approach.begin[0], approach.seconds[0] = 2.0, 1.5
    approach.position[0], approach.velocity[0], approach.angle[0] = (0.3, -0.2, 0.1), (0.5, 0.1, -0.2), (0.1, 0.05, 0.2)
    times = np.array([[2.0, 2.5, 3.5, 9.0]])
    rotation, offsets = np.tile(np.eye(3), (1, 4, 1, 1)), np.zeros((1, 4, 12))
    write_approaches(times, rotation, approach, offsets)
    assert offsets[0, 0, :3] == pytest.approx(approach.position[0])
    assert offsets[0, 0, 6:9] == pytest.approx(approach.velocity[0])
    assert not offsets[0, 2:].any()
    near = times + [[0, 1e-5, 0, 0]]
    later = np.zeros_like(offsets)
    write_approaches(near, rotation, approach, later)
    assert (later[0, 1, :3] - offsets[0, 1, :3]) / 1e-5 == pytest.approx(offsets[0, 1, 6:9], abs=1e-4)


def test_approaches_begin_with_fresh_teams_and_where_targets_leap_relative_to_their_motion():
    approach, dt = Approach.zeros(2), 0.02
    states = np.zeros((2, SIZE))
    states[:, :3], states[:, Q : Q + 3] = (0.5, 0.2, 1.0), (0.3, -0.1, 0.0)
    level = np.tile(np.eye(3), (2, 1, 1))

    def begin(time, place, was, fresh):
        moving = np.array([place, np.add(place, [dt * 0.2, 0.0, 0.0])])
        now = np.tile(moving, (2, 1, 1)), np.tile(np.eye(3), (2, 2, 1, 1))
        before = np.tile(np.array(was, float), (2, 1, 1)), level[:, None].copy()
        begin_approaches(np.full(2, time), dt, states, level, (now, before), np.array(fresh), approach)

    begin(0.0, [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], [True, True])
    assert approach.position[0] == pytest.approx([0.5, 0.2, 0.0])
    assert approach.velocity[0] == pytest.approx([0.1, -0.1, 0.0])  # of the payload beside a target at 0.2 m/s
    begin(1.0, [0.02, 0.0, 1.0], [0.0, 0.0, 1.0], [False, True])  # as was to be expected
    assert approach.begin.tolist() == [0.0, 1.0]
    begin(1.5, [0.5, 0.2, 2.0], [0.5, 0.2, 2.0], [False, False])  # put elsewhere: a preview says it has always been
    assert approach.begin.tolist() == [1.5, 1.5]
    assert approach.position[1] == pytest.approx([0.0, 0.0, -1.0])
