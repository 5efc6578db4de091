"""The policy mpc with a payload on one point: it has no attitude, and its formation's heading is the target's."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.mpc import ENOUGH, TeamMpc

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

WIDE = {f"control.{key}": wide for scales in ENOUGH.values() for key, (_, wide) in scales.items()}
BASE = {"payload.shape": "point", "control.action": "acc_rates"} | WIDE


KNOWN = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}


@pytest.mark.parametrize(
    ("overrides", "most"),
    [
        ({"env.num_drones": 1}, 0.003),
        ({"env.num_drones": 3}, 0.002),
        ({"env.num_drones": 3, "planner.limits": "hard"}, 0.002),
        ({"env.num_drones": 4, "control.action": "full_state"}, 0.002),
        ({"env.num_drones": 3, "env.sensing": "mocap"}, 0.02),
    ],
)
def test_it_holds_a_point_of_unknown_mass_under_an_unknown_force(overrides, most):
    config = load_config("hover", BASE | {"env.num_threads": 1} | overrides)
    result = run_episodes(config, lambda vec: make_scripted("mpc", vec), 3, 77)
    assert result["success_rate"].all() and (result["payload_position_error_m"] < most).all()


def test_the_formation_turns_with_its_target():
    vec = ml.make_vec("hover", num_envs=2, **(BASE | KNOWN | {"env.num_drones": 3}))
    observation, _ = vec.reset(seed=5)

    def ahead(times):
        yaw = 0.5 * np.maximum(times - 0.5, 0.0)
        c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
        rotation = np.stack([c, -s, zero, s, c, zero, zero, zero, one], axis=-1).reshape(*times.shape, 3, 3)
        return np.repeat(vec.task.goal.position[:, None], times.shape[1], axis=1), rotation, None

    policy = TeamMpc(vec, ahead)
    for _ in range(200):
        observation, _, ended, *_ = vec.step(policy.act(observation))
        assert not ended.any()
    yaw = 0.5 * (vec.task.time - 0.5)
    out = vec.world.state.drone_position[:, 0] - vec.world.state.payload_position
    rest = np.arctan2(vec.world.system.slots[0, 1], vec.world.system.slots[0, 0])
    turned = np.arctan2(out[:, 1], out[:, 0]) - rest - yaw
    assert abs((turned + np.pi) % (2 * np.pi) - np.pi).max() < 0.03
    assert np.linalg.norm(vec.world.state.payload_position - vec.task.goal.position, axis=1).max() < 0.003


def test_what_moments_of_inertia_its_model_has_makes_no_difference():
    found = []
    for factor in (1.0, 100.0):
        vec = ml.make_vec("hover", num_envs=2, **(BASE | {"env.num_drones": 3, "planner.estimate": False}))
        observation, _ = vec.reset(seed=5)
        policy = TeamMpc(vec)
        policy.planner.model.inertia[:] *= factor
        found.append([policy.act(observation)])
        for _ in range(20):
            observation = vec.step(found[-1][-1])[0]
            found[-1].append(policy.act(observation))
    np.testing.assert_allclose(found[0], found[1], atol=1e-7)
