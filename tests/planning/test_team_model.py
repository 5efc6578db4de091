"""The reduced model of a team: against laws in all bodies' own coordinates, its derivatives, its steps; flat states."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.errors import warn_once
from multilift_marl.planning.flatness import FlatMotion, FlatWork, make_flat_team, set_flat_state, steady_shape
from multilift_marl.planning.model_slopes import slopes
from multilift_marl.planning.team_model import (
    ModelWork,
    accelerations,
    euler_rates,
    make_model,
    state_size,
    step_state,
    warn_of_heavy_cables,
    warn_of_slow_motors,
)

GRAVITY = 9.81
LOADS = np.array([0.3, -0.5, 0.2, 0.01, -0.02, 0.015, 0.2])


def model_of(n, **overrides):
    return make_model(ml.load_config("hover", {"env.num_drones": n} | overrides).system)


def random_state(n, seed):
    """Return a state far from rest: tilted, turning, cables swinging, thrusts of any direction."""
    rng = np.random.default_rng(seed)
    q = 6 + 2 * n
    x = 0.3 * rng.normal(size=state_size(n))
    x[6:q] *= 0.5
    x[2 * q :] = 2.0 * rng.normal(size=3 * n)
    x[2 * q + 2 :: 3] += 12.0
    return x


def rotation_of(x):
    (sr, sp, sy), (cr, cp, cy) = np.sin(x[3:6]), np.cos(x[3:6])
    about_x = np.array([[1, 0, 0], [0, cr, -sr], [0, sr, cr]])
    about_y = np.array([[cp, 0, sp], [0, 1, 0], [-sp, 0, cp]])
    about_z = np.array([[cy, -sy, 0], [sy, cy, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


@pytest.mark.parametrize("n", [2, 3, 4, 6])
def test_accelerations_obey_the_laws_of_all_bodies(n):
    """Payload and drones by Newton and Euler, each cable a constraint with a multiplier: 6 + 4 N equations."""
    model, x, w = model_of(n), random_state(n, n), ModelWork.of(n)
    accelerations(x, model, LOADS, w)
    q = 6 + 2 * n
    rotation, velocity, rates = rotation_of(x), x[q : q + 3], x[q + 3 : q + 6]
    c, swing = x[6:q].reshape(n, 2), x[q + 6 : 2 * q].reshape(n, 2)
    direction = np.c_[c, np.sqrt(1 - (c**2).sum(1))]
    turning = np.c_[swing, -(c * swing).sum(1) / direction[:, 2]]
    mass, size = model.payload_mass + LOADS[6], 6 + 4 * n
    a, b = np.zeros((size, size)), np.zeros(size)
    a[:3, :3], a[3:6, 3:6] = mass * np.eye(3), model.inertia
    speed = np.sqrt(velocity @ velocity + 1e-6)
    b[:3] = LOADS[:3] - mass * GRAVITY * np.array([0, 0, 1]) - model.drag * speed * velocity
    b[3:6] = LOADS[3:6] - np.cross(rates, model.inertia @ rates)
    for i in range(n):
        drone, tension, d, arm = slice(6 + 3 * i, 9 + 3 * i), 6 + 3 * n + i, direction[i], model.anchors[i]
        a[:3, tension] -= d
        a[3:6, tension] -= np.cross(arm, rotation.T @ d)
        a[drone, drone] = model.drone_mass[i] * np.eye(3)
        a[drone, tension] = d
        b[drone] = x[2 * q + 3 * i : 2 * q + 3 * i + 3] - model.drone_mass[i] * GRAVITY * np.array([0, 0, 1])
        # the distance of drone and anchor is steady: d · (a_drone - a_anchor) = -L |d'|²
        a[tension, drone] = d
        a[tension, :3] = -d
        a[tension, 3:6] = -np.cross(arm, rotation.T @ d)
        centripetal = rotation @ np.cross(rates, np.cross(rates, arm))
        b[tension] = d @ centripetal - model.length[i] * turning[i] @ turning[i]
    solved = np.linalg.solve(a, b)
    assert w.acceleration[:6] == pytest.approx(solved[:6], rel=1e-9, abs=1e-9)
    assert w.tension == pytest.approx(solved[6 + 3 * n :], rel=1e-9, abs=1e-9)
    for i in range(n):
        anchor = solved[:3] + rotation @ (
            np.cross(solved[3:6], model.anchors[i]) + np.cross(rates, np.cross(rates, model.anchors[i]))
        )
        swung = (solved[6 + 3 * i : 9 + 3 * i] - anchor) / model.length[i]
        assert w.acceleration[6 + 2 * i : 8 + 2 * i] == pytest.approx(swung[:2], rel=1e-9, abs=1e-9)


@pytest.mark.parametrize("n", [2, 3, 4, 6])
def test_derivatives_are_those_of_differences(n):
    model, x, w = model_of(n), random_state(n, 10 + n), ModelWork.of(n)

    def values(at):
        accelerations(at, model, LOADS, w)
        return np.concatenate([w.acceleration, w.tension])

    accelerations(x, model, LOADS, w)
    slopes(x, model, w)
    found = np.concatenate([w.slope, w.tension_slope])
    h = 1e-3
    for k in range(len(x)):
        e = np.zeros(len(x))
        e[k] = h
        near, far = values(x + e) - values(x - e), values(x + 2 * e) - values(x - 2 * e)
        third = values(x + 3 * e) - values(x - 3 * e)
        expected = (45 * near - 9 * far + third) / (60 * h)  # of order h⁶
        assert found[:, k] == pytest.approx(expected, rel=1e-8, abs=1e-9 * max(1, abs(expected).max())), k


def test_steps_converge_to_the_motion_of_many_small_ones():
    n = 4
    model, start, w = model_of(n), random_state(n, 3), ModelWork.of(n)
    start[6 + 2 * n : 12 + 4 * n] *= 0.3
    u = np.linspace(-20, 20, 3 * n)

    def fly(steps, seconds=0.1):
        x, after = start.copy(), start.copy()
        for _ in range(steps):
            step_state(x, u, seconds / steps, model, LOADS, w, after)
            x, after = after.copy(), x
        return x

    true = fly(4096)
    errors = np.array([abs(fly(steps) - true) for steps in (16, 32, 64)])
    errors = errors.max(axis=1)
    assert errors[1:] / errors[:-1] == pytest.approx([0.5, 0.5], abs=0.03)  # what velocities change is of first order
    assert errors[0] < 2e-3


def circle(t):
    """Return place and attitude of a payload that goes around and sways as it does."""
    roll, yaw = 0.15 * np.sin(1.3 * t), 0.4 * t
    c, s = np.cos(yaw), np.sin(yaw)
    about_z = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = np.cos(roll), np.sin(roll)
    return np.array([np.cos(t), np.sin(t), 1.5 + 0.2 * np.sin(2 * t)]), about_z @ np.array(
        [[1, 0, 0], [0, c, -s], [0, s, c]]
    )


@pytest.mark.parametrize("change", [0.0, 0.3])
@pytest.mark.parametrize("n", [3, 4])
def test_flat_states_are_the_motion_of_the_model_under_their_thrusts(n, change):
    """Flown open loop for half a second by the thrusts alone, with Runge and Kutta's steps, a team is where they say.

    So it is while the formation's shape changes: it narrows across and grows longer, and a cable takes another's load.

    Flat states are extrapolated to poses that are infinitely near: what remains is the map itself.
    """
    system = ml.load_config("hover", {"env.num_drones": n}).system
    model, w, q, h = make_model(system), ModelWork.of(n), 6 + 2 * n, 2e-3
    loads = np.array([0.2, 0.1, -0.3, 0.0, 0.005, 0.0, 0.1])
    teams = [make_flat_team(model, system, step) for step in (0.04, 0.02, 0.01)]

    def state(t):
        found = np.zeros((3, state_size(n)))
        for x, team in zip(found, teams, strict=True):
            poses = [circle(t + team.step * k) for k in range(-2, 3)]
            positions, rotations = (np.array(part) for part in zip(*poses, strict=True))
            shape = steady_shape(team)
            for forces, at in zip(shape, (t - team.step, t, t + team.step), strict=True):
                forces *= 1 + change * np.sin(3 * at) * np.array([0.7, -1.0, 0.0])
                forces[:2, 2] += change * np.cos(2 * at) * np.array([0.8, -0.8])
            set_flat_state(FlatMotion(positions, rotations, shape), 0.4 * t, loads, team, FlatWork.of(n), x)
        near = (4 * found[1:] - found[:-1]) / 3
        return (16 * near[1] - near[0]) / 15

    def slope(x, thrusts):
        both = np.append(x, thrusts)
        accelerations(both, model, loads, w)
        t = euler_rates(x[3], x[4])
        p, r, s = x[q + 3 : q + 6]
        found = np.append(x[q:], w.acceleration)
        found[3:6] = p + t[0] * r + t[1] * s, t[2] * r + t[3] * s, t[4] * r + t[5] * s
        return found

    x = state(0.0)[: 2 * q]
    thrusts = [state(0.5 * h * k)[2 * q :] for k in range(501)]
    for k in range(250):
        first, middle, last = thrusts[2 * k : 2 * k + 3]
        a = slope(x, first)
        b = slope(x + 0.5 * h * a, middle)
        c = slope(x + 0.5 * h * b, middle)
        x += h / 6 * (a + 2 * b + 2 * c + slope(x + h * c, last))
    assert x == pytest.approx(state(0.5)[: 2 * q], rel=0, abs=1e-6)
    assert x[:3] == pytest.approx(circle(0.5)[0], rel=0, abs=1e-6)


def test_a_team_at_rest_is_its_own_flat_state():
    system = ml.load_config("hover").system
    model, n = make_model(system), 4
    x, w, still = np.zeros(state_size(n)), ModelWork.of(n), np.zeros(7)
    positions, rotations = np.tile([1.0, 2.0, 3.0], (5, 1)), np.tile(np.eye(3), (5, 1, 1))
    team = make_flat_team(model, system)
    motion = FlatMotion(positions, rotations, steady_shape(team))
    set_flat_state(motion, 0.0, still, team, FlatWork.of(n), x)
    accelerations(x, model, still, w)
    assert abs(w.acceleration).max() < 1e-9
    assert w.tension == pytest.approx(np.linalg.norm(system.formation_force, axis=1))


@pytest.mark.parametrize(("density", "said"), [(0.03, False), (0.05, True)])
def test_heavy_cables_are_warned_of(caplog, density, said):
    """Of 16 teams of policy=mpc in `track` none is lost with 0.03 kg/m, four are with 0.05: chains sag."""
    warn_once.cache_clear()
    chains = {"cable.model": "chain", "cable.density": density, "payload.mass": 1.0}
    warn_of_heavy_cables(ml.load_config("hover", chains).system, "policy=mpc")
    assert [f"weigh {4 * density:.0%} of the payload" in each.message for each in caplog.records] == [True] * said


@pytest.mark.parametrize(
    ("own", "said"),
    [
        ({}, []),
        ({"vehicle.preset": "crazyflie", "payload.mass": 0.02}, []),
        ({"vehicle.preset": "crazyflie_id", "payload.mass": 0.02}, ["crazyflie_id lag by 0.145 s"]),
        ({"vehicle.rotor_time_constant_down": 0.07}, ["falcon lag by 0.07 s"]),
        ({"vehicle.rotor_time_constant_up": [0.03, 0.03, 0.03, 0.1]}, ["falcon lag by 0.1 s"]),
    ],
)
def test_slow_motors_are_warned_of(caplog, own, said):
    """The slowest drone's count, up or down."""
    warn_once.cache_clear()
    warn_of_slow_motors(ml.load_config("hover", own).system, "control.action=planner_weights")
    messages = [each.message for each in caplog.records]
    assert len(messages) == len(said) and all(words in each for words, each in zip(said, messages, strict=True))
    assert all("teams of control.action=planner_weights" in each for each in messages)
