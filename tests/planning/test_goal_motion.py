"""Targets and slots that move: velocities, accelerations and jerks are the derivatives of their places."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from conftest import make

TASKS = {  # task and options: times [s] at which its goal is looked at, away from where pieces join
    "takeoff": ({}, (0.5, 1.2, 2.2, 3.4, 5.0, 6.2)),
    "land": ({}, (0.5, 1.5, 2.5, 3.9, 5.5, 7.2, 9.3)),
    "gate": ({}, (2.0, 4.0, 6.0, 7.7, 9.0)),
    "track": ({"task_options.path": "lemniscate"}, (0.7, 1.5, 3.0, 6.1)),
    "track circle": ({"task_options.path": "circle"}, (0.7, 1.5, 3.0, 6.1)),
    "track helix": ({"task_options.path": "helix"}, (0.7, 1.5, 3.0)),
}
STEP = 2e-3  # [s]


@cache
def moments(name: str, time: float) -> list:
    """Return the goal at seven moments about a time."""
    vec = make(name.split()[0], num_envs=1, **TASKS[name][0])
    vec.reset(seed=4)
    goal, seen = vec.task.goal, []
    for k in range(-3, 4):
        vec.task.time[0] = time + k * STEP
        vec.task.stages["plan"](0, 1)
        seen.append({field: getattr(goal, field)[0].copy() for field in goal._fields})
    return seen


def slope(seen: list, value) -> np.ndarray:
    """Return the derivative at the middle moment, to sixth order."""
    weights = np.array([-1, 9, -45, 0, 45, -9, 1]) / 60
    return np.tensordot(weights, np.array([value(each) for each in seen]), axes=1) / STEP


def marked(name: str, *values):
    """Return parameters; those of a task other than `track`, each compiled for itself, are left to `-m slow`."""
    marks = () if name.startswith("track") else (pytest.mark.slow,)
    return pytest.param(name, *values, marks=marks)


@pytest.mark.parametrize("name, time", [marked(name, time) for name, (_, times) in TASKS.items() for time in times])
def test_goals_state_the_derivatives_of_their_places(name, time):
    seen = moments(name, time)
    now = seen[3]
    for lower, higher, tolerance in (
        ("position", "velocity", 1e-5), ("velocity", "acceleration", 1e-4), ("acceleration", "jerk", 5e-2),
    ):  # fmt: skip
        change = slope(seen, lambda each, lower=lower: each[lower])
        np.testing.assert_allclose(change, now[higher], atol=tolerance, err_msg=higher)
    heading = slope(seen, lambda each: np.unwrap([0.0, each["drone_yaw"]])[1:])
    np.testing.assert_allclose(heading, now["drone_yaw_rate"], atol=2e-4)
    own = slope(seen, lambda each: each["slots"] - each["position"])
    loose = 0.02 if name in ("takeoff", "land") else 1e-4  # cables that close are not told
    np.testing.assert_allclose(own, now["slot_velocity"], atol=loose)
    change = slope(seen, lambda each: each["slot_velocity"])
    np.testing.assert_allclose(change, now["slot_acceleration"], atol=1e-3)


@pytest.mark.parametrize("name", [marked(name) for name in ("takeoff", "land", "gate", "track circle")])
def test_goals_do_move_in_these_moments(name):
    middle = [moments(name, time)[3] for time in TASKS[name][1]]
    assert max(np.linalg.norm(each["velocity"]) for each in middle) > 0.2
    assert name in ("gate", "track circle") or max(np.abs(each["slot_velocity"]).max() for each in middle) > 0.2


@pytest.mark.parametrize("kind", ["circle", "figure8", "lemniscate", "helix", "random"])
def test_every_path_starts_above_the_origin_at_rest(kind):
    vec = make("track", num_envs=6, **{"task_options.path": kind, "task_options.height": 1.7})
    vec.reset(seed=5)
    goal, path = vec.task.goal, vec.task.own.path
    np.testing.assert_allclose(goal.position, np.tile([0.0, 0.0, 1.7], (6, 1)), atol=1e-9)
    assert np.ptp(path.heading) > 0.5 and np.abs(goal.velocity).max() < 1e-3


def test_planned_slots_are_at_the_end_of_cables_that_exert_the_planned_forces():
    vec = make("pose", num_envs=1)
    vec.reset(seed=3)
    task, planned, system = vec.task, vec.task.planned, vec.world.system
    share = system.hook_force[:, 2] / 9.81
    for step in range(1, 260):
        task.time[0] = step * task.control_dt
        task.stages["plan"](0, 1)
        if step % 50:
            continue
        inertial = planned.acceleration[0] + planned.slot_acceleration[0]
        force = planned.cable_force[0] + share[:, None] * inertial  # on the payload
        size = np.linalg.norm(force, axis=1, keepdims=True)
        reach = system.cable_length[:, None] + size / system.cable_stiffness[:, None]
        anchors = planned.position[0] + system.anchors @ planned.rotation[0].T
        np.testing.assert_allclose(planned.slots[0] - anchors, reach * force / size, atol=1e-9)
        total = force.sum(axis=0) - system.payload_mass * (planned.acceleration[0] + [0, 0, 9.81])
        np.testing.assert_allclose(total, 0.0, atol=1e-7)
