"""Hover: its starts, its reward, its success and what it observes."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import bold_actions, level, make, same, zeros

from multilift_marl.control.formation import place_formation
from multilift_marl.math3d import rot_z


def test_hover_starts_are_as_documented():
    vec = make("hover", num_envs=4000)
    vec.reset(seed=0)
    goal, state, errors, system = vec.task.goal, vec.world.state, vec.task.errors, vec.world.system
    assert np.abs(goal.position[:, :2]).max() <= 1 and np.ptp(goal.position[:, :2]) > 1.99
    assert goal.position[:, 2].min() >= 1 and goal.position[:, 2].max() <= 2
    assert np.degrees(np.abs(goal.yaw).max()) <= 45 and np.degrees(np.ptp(goal.yaw)) > 89
    np.testing.assert_allclose(goal.rotation[:, 2], np.broadcast_to([0, 0, 1], (4000, 3)), atol=1e-12)
    np.testing.assert_allclose(np.quantile(errors.distance, [0.25, 0.5]), 0.5 * np.cbrt([0.25, 0.5]), rtol=0.03)
    assert errors.distance.max() <= 0.5
    assert np.degrees(errors.angle.max()) <= 10 + 1e-6 and np.degrees(errors.angle.max()) > 9.9
    speed = np.linalg.norm(state.payload_velocity, axis=1)
    assert 0.29 < speed.max() <= 0.3
    np.testing.assert_array_equal(state.drone_velocity, np.repeat(state.payload_velocity[:, None], 4, axis=1))
    expected = (
        np.linalg.norm(system.formation_force, axis=1)
        * (vec.world.hidden_loads.payload_mass / system.payload_mass)[:, None]
    )
    np.testing.assert_allclose(state.cable_tension, expected, rtol=1e-6)


def hover_terms(displace) -> dict[str, float]:
    """Return the reward terms of a team at rest at its target after displace(state)."""
    vec = make("hover", num_envs=1)
    vec.reset(seed=0)
    level(vec)
    displace(vec.world.state)
    vec.task.stages["measure"](0, 1)
    vec.task.stages["reward"](0, 1)
    return dict(zip(vec.reward_terms, vec.task.terms[0], strict=True))


def test_hover_pays_every_positive_weight_in_full_at_rest_at_the_goal():
    weights = make("hover", num_envs=1).task.REWARD
    paid = hover_terms(lambda state: None)
    assert paid == pytest.approx({name: max(term.weight, 0.0) for name, term in weights.items()})


@pytest.mark.parametrize("distance, share", [(0.25, 0.5), (0.75, 0.1)])
def test_hover_pays_half_at_the_margin_and_a_tenth_at_three_margins(distance, share):
    def move(state):
        state.payload_position[0, 1] += distance

    assert hover_terms(move)["position"] == pytest.approx(share * hover_terms(lambda state: None)["position"])


def test_hover_charges_the_mean_squared_change_of_action():
    vec = make("hover")
    vec.reset(seed=0)
    last = zeros(vec)
    for step in range(5):
        action = np.random.default_rng(step).uniform(-1, 1, last.shape)
        *_, info = vec.step(action)
        expected = -0.05 * ((action - last) ** 2).mean(axis=(1, 2))
        np.testing.assert_allclose(info["reward_terms"]["action_rate"], expected, rtol=1e-9)
        last = action


def test_hover_succeeds_within_5_cm_and_5_degrees_throughout_the_last_2_s():
    vec = make("hover", num_envs=48, **{"randomization.payload_force": 0.5})
    vec.reset(seed=0)
    good = []
    for step in range(vec.max_steps):
        *_, info = vec.step(zeros(vec))
        assert step + 1 == vec.max_steps or not info["success"].any()
        good.append((vec.task.errors.distance <= 0.05) & (vec.task.errors.angle <= np.radians(5)))
    expected = np.all(good[-100:], axis=0)
    assert 0 < expected.sum() < 48
    assert same(info["success"], expected)


def test_hover_remembers_how_long_it_has_been_good_when_saved_and_not_when_reset():
    calm = {"randomization.payload_force": 0, "randomization.payload_mass": 0, "task_options.start_radius": 0.05}
    first, second = (make("hover", **calm) for _ in range(2))
    first.reset(seed=0)
    for _ in range(first.max_steps - 20):
        first.step(zeros(first))
    second.load_state_dict(first.state_dict())
    for _ in range(20):
        expected, told = (vec.step(zeros(vec))[-1]["success"] for vec in (first, second))
    assert expected.all() and told.all()
    second.reset()
    assert (second.task.good_time == 0).all()


def test_error_integrals_are_sums_over_time_within_their_limit():
    vec = make("hover", num_envs=16)
    vec.reset(seed=0)
    total = np.zeros((16, 3))
    for _ in range(300):
        vec.step(zeros(vec))
        total = np.clip(total + 0.02 * vec.task.errors.position, -0.5, 0.5)
    np.testing.assert_allclose(vec.task.errors.position_integral, total, atol=1e-12)
    assert np.abs(total).max() > 0.2


def test_observations_do_not_depend_on_place_and_heading():
    vec = make("hover", num_envs=1)
    vec.reset(seed=0)
    for step in range(30):
        vec.step(0.5 * bold_actions(vec, step, hold=7))
    task, state, reference = vec.task, vec.world.state, vec.reference
    before, hidden = vec.task.observation.copy(), vec.task.critic.copy()
    turn, shift = np.reshape(rot_z(1.1), (3, 3)), np.array([5.0, -3.0, 0.0])
    for array in (task.goal.position, state.payload_position, state.drone_position, reference.position):
        array[:] = array @ turn.T + shift
    for array in (
        state.payload_velocity, state.drone_velocity, reference.velocity, vec.world.hidden_loads.payload_force,
        task.errors.position_integral, task.errors.rotation_integral,
    ):  # fmt: skip
        array[:] = array @ turn.T
    for array in (task.goal.rotation, state.payload_rotation, state.drone_rotation):
        array[:] = turn @ array
    place_formation(0, task.goal, task.rig)
    task.stages["measure"](0, 1)
    task.stages["observe state"](0, 1)
    task.stages["observe"](0, 1)
    np.testing.assert_allclose(vec.task.observation, before, atol=2e-6)
    np.testing.assert_allclose(vec.task.critic, hidden, atol=2e-6)
