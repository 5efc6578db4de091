"""A rule that turns aside before a wall and files through its gap, by what each drone observes."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted

GIVEN = {
    "scene.reserved": 0, "task_options.level": "given", "task_options.start": [-4, 0, 1.5],
    "task_options.goal": [4, 0, 1.5], "task_options.start_radius": 0.0, "env.num_envs": 1, "env.num_threads": 1,
    "seed": 3,
}  # fmt: skip


def make(gap: float, width: float, **keys) -> ml.MultiliftVec:
    """Return a team before a wall across its line at x = 0 with a gap of a width [m], its middle at y = gap."""
    sides = [(gap + width / 2, 6.0), (-6.0, gap - width / 2)]
    walls = [{"shape": "box", "size": [0.2, b - a, 6], "position": [0, (a + b) / 2, 3]} for a, b in sides]
    return ml.make_vec("navigate_slots", **(GIVEN | {"scene.obstacles": walls} | keys))


def fly(vec, policy) -> tuple[bool, np.ndarray]:
    """Return whether a flight succeeds, and the payload's way (T, 3)."""
    observation, _ = vec.reset(seed=0)
    policy.reset()
    way = []
    while True:
        way.append(vec.world.state.payload_position[0].copy())
        observation, _, terminated, truncated, info = vec.step(policy.act(observation))
        if terminated[0] or truncated[0]:
            return bool(info["success"][0]), np.array(way)


@pytest.mark.parametrize("gap", [0.5, 1.0])
def test_it_passes_a_gap_beside_the_line_where_the_formation_flies_into_the_wall(gap):
    vec = make(gap, 1.6)
    assert not fly(vec, make_scripted("formation", vec))[0]
    success, way = fly(vec, make_scripted("formation_filed", vec))
    assert success
    assert abs(way[np.argmin(np.abs(way[:, 0])), 1] - gap) < 0.4


def test_the_first_side_is_left_and_it_turns_back_far_off_the_line():
    vec = make(-2.4, 1.2)
    policy = make_scripted("formation_filed", vec)
    policy.TURN = 0.2
    observation, _ = vec.reset(seed=0)
    policy.reset()
    beside = [0.0]
    while (policy._side == 1).all() and beside[-1] < 0.5:
        beside.append(vec.world.state.payload_position[0, 1])
        observation = vec.step(policy.act(observation))[0]
    assert max(beside[:-1]) <= 0.2 < beside[-1] < 0.3
    assert (policy._side == -1).all()


def test_flights_of_a_batch_are_those_alone():
    """Sides and gaps are remembered for each environment, and forgotten when it begins anew."""
    keys = {"env.num_threads": 1, "seed": 3, "env.episode_seconds": 12}
    vec, alone = (ml.make_vec("navigate_slots", num_envs=n, first_env=f, **keys) for n, f in ((3, 0), (1, 2)))
    ways = []
    for each in (vec, alone):
        policy = make_scripted("formation_filed", each)
        observation, _ = each.reset(seed=9)
        policy.reset()
        for _ in range(450):
            ended = each.ended
            observation = each.step(policy.act(observation), restart=True)[0]
            if ended.any():
                policy.reset(ended)
        ways.append(each.world.state.payload_position[-1])
    assert ways[0] == pytest.approx(ways[1], abs=0)


def test_it_refuses_other_tasks_and_beams():
    beams = {"env.obstacle_sensing": "ranges", "control.obstacle_margin": 0, "train.observe": None}
    for name, keys in (("hover", {}), ("navigate_slots", beams)):
        vec = ml.make_vec(name, num_envs=1, **keys)
        with pytest.raises(ConfigError, match="formation_filed is for task navigate"):
            make_scripted("formation_filed", vec)


@pytest.mark.parametrize(
    "keys",
    [{"env.num_drones": 2}, {"env.num_drones": 1, "payload.shape": "point"}, {"task_options.goal": [-4, 0, 2.5]},
     {"env.obstacles.points": 1}],
    ids=["two", "one", "upward", "one point"],
)  # fmt: skip
@pytest.mark.filterwarnings("error")
def test_actions_are_finite_for_small_teams_vertical_lines_and_a_single_point(keys):
    vec = make(0.5, 1.6, **keys)
    policy = make_scripted("formation_filed", vec)
    observation, _ = vec.reset(seed=0)
    for _ in range(60):
        action = policy.act(observation)
        assert np.isfinite(action).all() and np.abs(action).max() <= 1
        observation = vec.step(action, restart=True)[0]
