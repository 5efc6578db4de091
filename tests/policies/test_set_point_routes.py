"""Teams among obstacles by set-points of their slots: along a route, and pushed away by what each drone observes."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import slow

import multilift_marl as ml
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import fitting_scripts, make_scripted

ALONE = {
    "scene.reserved": 0, "task_options.level": "given", "task_options.start": [-4, 0, 1.5],
    "task_options.goal": [4, 0, 1.5],
    "task_options.start_radius": 0.0, "env.num_envs": 1, "env.num_threads": 1, "env.policy_hz": 50, "seed": 3,
    "control.obstacle_margin": 0, "control.payload_margin": 0, "control.sector_margin": 0,
    "env.obstacles.rate": None, "env.obstacles.delay": 0, "env.obstacles.noise": 0,
}  # fmt: skip


def make(pillars, **keys):
    obstacles = [{"shape": "cylinder", "size": [0.3, 4], "position": [*place, 2]} for place in pillars]
    return ml.make_vec("navigate_senses", **ALONE, **{"scene.obstacles": obstacles}, **keys)


def test_a_route_past_far_obstacles_keeps_the_formation():
    """The target moves as the route does not: by its own times. Slots are where the target is, all the same."""
    vec = make([(0, 2.9)])
    policy = make_scripted("formation_route", vec)
    observation, _ = vec.reset(seed=0)
    policy.reset()
    for _ in range(400):
        action = policy.act(observation)
        assert np.abs(action).max() * vec.config.control.max_offset < 0.1
        observation = vec.step(action)[0]
    assert vec.world.state.payload_position[0, 0] == pytest.approx(vec.task.goal.position[0, 0], abs=0.15)


def test_a_route_leads_round_what_is_in_the_way_once_it_is_seen():
    vec = make([(0, 0.02)])
    policy = make_scripted("formation_route", vec)
    observation, _ = vec.reset(seed=0)
    policy.reset()
    offsets, first = [], None
    for step in range(700):
        action = policy.act(observation)
        if first is None and policy.searches[0] == 2:
            first = np.linalg.norm(vec.world.state.drone_position[0, :, :2], axis=1).min()
        offsets.append(vec.world.state.payload_position[0, 1])
        observation, _, terminated, _, _ = vec.step(action)
        assert not terminated[0], f"step {step}"
    assert 2.5 < first < 2.7  # the sensor's range, and a radius
    assert np.abs(offsets).max() > 0.3


@pytest.mark.slow
def test_teams_pass_maps_by_set_points_of_a_route():
    config = ml.load_config("navigate_senses", {"env.num_threads": 1})
    flown = run_episodes(config, lambda vec: make_scripted("formation_route", vec), 24, 77)
    assert flown["success_rate"].mean() >= 0.85


def test_slots_are_pushed_away_from_what_their_own_drones_observe():
    """In proportion to how much nearer it is than the distance; the others' stay."""
    vec = make([(-4.0, 1.3)])
    policy = make_scripted("formation_repelled", vec)
    policy.DISTANCE, policy.GAIN, policy.SWAY = 1.0, 0.5, 0.0
    observation, _ = vec.reset(seed=0)
    moved = policy.act(observation)[0, :, :3] * vec.config.control.max_offset
    frame, drones = vec.task.goal.slot_frame[0], vec.world.state.drone_position[0]
    for n in range(4):
        away = drones[n, :2] - [-4.0, 1.3]
        gap = np.linalg.norm(away) - 0.15
        push = 0.5 * max(1.0 - gap, 0.0) * away / np.linalg.norm(away)
        (c, s), (x, y) = frame[n], push
        assert moved[n] == pytest.approx([c * x + s * y, c * y - s * x, 0.0], abs=2e-3)
    assert (np.linalg.norm(moved, axis=1) > 0.05).sum() == 2


def test_nothing_is_pushed_by_what_hangs_over_it_or_lies_below():
    """Noise alone says on which side a ceiling's nearest point is."""
    vec = make([])
    policy = make_scripted("formation_repelled", vec)
    observation, _ = vec.reset(seed=0)
    points = vec.task.view.obstacle_readings.reshape(1, vec.num_drones, -1, 3)
    points[0, :, 0] = [(0.02, -0.03, 0.9), (0.3, 0.2, -1.0), (0.1, 0.0, 0.1), (0.6, 0.0, 0.9)]
    moved = np.linalg.norm(policy.act(observation)[0, :, :3], axis=-1) * vec.config.control.max_offset
    assert moved == pytest.approx([0.0, 0.0, policy.GAIN * (policy.DISTANCE - 0.1), policy.GAIN * 0.7], abs=1e-6)


def test_without_nearest_points_nothing_is_pushed():
    with pytest.raises(ConfigError, match="needs the nearest points"):
        make_scripted("formation_repelled", make([], **{"env.obstacle_sensing": "ranges", "train.observe": None}))


@pytest.mark.parametrize(
    ("sensing", "fits"), [("local", True), slow("map", True), slow("ranges", False), ("none", False)]
)
def test_it_is_offered_where_drones_observe_points(sensing, fits):
    vec = make([], **{"env.obstacle_sensing": sensing, "train.observe": None})
    assert ("formation_repelled" in fitting_scripts(vec)) == fits
    assert "formation_route" not in fitting_scripts(vec)  # it plans
