"""Plans as actions of `full_state`: drones' motion from the plan, the controller's thrust that follows, and flights."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, make

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.planning.team_model import ModelWork, step_state
from multilift_marl.policies.baselines import make_scripted

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

RATES = {"control.action": "acc_rates", "control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0}
FULL = {
    "control.action": "full_state", "control.max_offset": 2.0, "control.max_velocity": 5.0,
    "control.max_acceleration": 25.0, "control.max_jerk": 300.0, "control.max_cable_force": 5.0,
}  # fmt: skip
FAST = {"task_options.speed": 5.0, "task_options.acceleration": 8.0, "task_options.rmse_from": 3.0}


def flying(steps: int = 60, **overrides):
    """Return environments and mpc in the middle of a figure-eight, what it measures, and its last action."""
    vec = make("track", num_envs=2, **FULL, **FAST, **overrides)
    observation, _ = vec.reset(seed=0)
    policy = make_scripted("mpc", vec)
    for _ in range(steps):
        observation, *_ = vec.step(policy.act(observation))
    return vec, policy, policy._measure()[0], policy.act(observation)


def test_motions_are_those_of_the_drones():
    vec, policy, states, _ = flying()
    position, velocity, _ = policy._full_state._drone_motion(states, np.zeros((2, 7)))
    state = vec.world.state
    np.testing.assert_allclose(position, state.drone_position, atol=1e-4)
    np.testing.assert_allclose(velocity, state.drone_velocity, atol=1e-2)


@pytest.mark.parametrize("feedback", [0.0, 1.0])
def test_hooks_are_not_taken_for_drones(feedback):
    """Set-points are of drones, 5 cm above where the model's cables end, and teams are as stable as without hooks."""
    own = {"planner.feedback": feedback, "planner.estimate": feedback == 1.0, "cable.hook": [0.0, 0.0, -0.05]}
    vec = make("track_circle", num_envs=2, **FULL, **own)
    policy = make_scripted("mpc", vec)
    observation, _ = vec.reset(seed=0)
    errors, off = [], []
    for _ in range(500):
        observation, *_ = vec.step(policy.act(observation))
        errors.append(vec.task.errors.distance.max())
        states = policy._measure()[0]
        off.append(policy._full_state._drone_motion(states, np.zeros((2, 7)))[0] - vec.world.state.drone_position)
    assert max(errors[100:]) < 0.01
    assert np.abs(off).max() < 0.01


def test_accelerations_are_those_of_the_model():
    """By differences of the velocities in three steps of 1 ms, whose thrusts do not change."""
    vec, policy, states, _ = flying()
    command, load, h = policy._full_state, np.zeros(7), 1e-3
    model, n = policy.planner.model, vec.num_drones
    ahead = np.zeros((3, *states.shape))
    ahead[0] = states
    for e in range(2):
        for k in range(2):
            step_state(ahead[k, e], np.zeros(3 * n), h, model, load, ModelWork.of(n), ahead[k + 1, e])
    velocities = [command._drone_motion(each, np.zeros((2, 7)))[1] for each in ahead]
    found = command._drone_motion(ahead[1], np.zeros((2, 7)))[2]
    np.testing.assert_allclose(found, (velocities[2] - velocities[0]) / (2 * h), atol=2e-2)
    assert np.linalg.norm(found, axis=-1).max() > 2


@pytest.mark.parametrize("feedforward", [True, False])
def test_the_controller_exerts_the_planned_thrust(feedforward):
    vec, policy, states, _ = flying(**{"control.drag_feedforward": feedforward})
    rng, command, goal, gains = np.random.default_rng(0), policy._full_state, vec.task.goal, vec.controller.gains
    thrust, rate, drag = states[:, -12:].reshape(2, 4, 3), rng.normal(size=(2, 4, 3)), 0.1 * rng.normal(size=(2, 4, 3))
    action = command.act(states, states, np.zeros((2, 7)), thrust, rate, drag) * command._scales
    c, s = goal.slot_frame[..., 0], goal.slot_frame[..., 1]
    zero, one = np.zeros_like(c), np.ones_like(c)
    turn = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(2, 4, 3, 3)
    *_, acceleration, jerk, force = (np.einsum("enij,enj->eni", turn, action[..., 3 * k : 3 * k + 3]) for k in range(5))
    t = vec.task.control_dt
    total = (gains.mass + gains.load_share)[:, None]
    acceleration = acceleration + goal.acceleration[:, None] + t * goal.jerk[:, None]
    cable = goal.cable_force + np.linalg.norm(goal.cable_force, axis=-1, keepdims=True) * force
    exerted = total * acceleration + cable + gains.mass[:, None] * [0, 0, GRAVITY]
    np.testing.assert_allclose(exerted, thrust if feedforward else thrust + drag, atol=1e-9)
    np.testing.assert_allclose(total * (jerk + goal.jerk[:, None]), rate, atol=1e-9)


def test_set_points_are_for_what_the_drones_know_of_themselves():
    """Hooks off the centres, and states of the team that are 3 cm off: positions are the drones' own."""
    vec, policy, states, _ = flying(20, **{"cable.hook": [0.02, 0.0, -0.03]})
    command, goal, t = policy._full_state, vec.task.goal, vec.task.control_dt
    states[:, :3] += 0.03
    thrust = states[:, -12:].reshape(2, 4, 3)
    action = command.act(states, states, np.zeros((2, 7)), thrust, 0 * thrust, 0 * thrust) * command._scales
    moved = goal.velocity[:, None] + t / 2 * goal.acceleration[:, None]
    height = goal.slots[..., 2] + t * moved[..., 2] + action[..., 2]
    np.testing.assert_allclose(height, vec.world.state.drone_position[..., 2], atol=1e-6)


def fly(interface, **overrides):
    loaded = load_config("track", interface | FAST | overrides | {"env.episode_seconds": 6.0, "env.num_threads": 1})
    return run_episodes(loaded, lambda vec: make_scripted("mpc", vec), 2, 77)["payload_rmse_m"]


def test_it_keeps_to_a_fast_figure_eight_within_millimetres():
    assert (fly(FULL) < 0.0035).all()


def test_actions_that_come_late_cost_nothing_and_by_rates_something():
    late = {"randomization.action_delay": 1, "planner.delay": 0.02}
    assert (fly(FULL, **late) < 1.1 * fly(FULL)).all()
    assert (fly(RATES, **late) > 1.3 * fly(RATES)).all()
