"""The policy mpc_distributed: flights beside the central one's, late and lossy messages, own sensing, refusals."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make, refusal

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.mpc_distributed import others_of

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

BY_RATES = {"control.action": "acc_rates", "control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0}
LOSSY = {"env.sensing": "onboard", "env.communication": "all", "env.communication_loss": 0.1}


def fly(policy, config, overrides, episodes=3, seconds=6.0):
    loaded = load_config(config, BY_RATES | overrides | {"env.episode_seconds": seconds, "env.num_threads": 1})
    return run_episodes(loaded, lambda vec: make_scripted(policy, vec), episodes, 77)


@pytest.mark.parametrize("drones", [2, 3, 4, 6, 8])
def test_paths_are_kept_to_within_half_a_millimetre(drones):
    """Of two drones 2 mm: they do not hold the payload's angle about the line between them."""
    result = fly("mpc_distributed", "track", {"env.num_drones": drones})
    most = 2e-3 if drones == 2 else 5e-4
    assert not result["failure_cause"].any() and (result["payload_rmse_m"] < most).all()
    assert not result["planner_failed"].any()


@pytest.mark.parametrize("drones", [3, 6, 8])
def test_fast_paths_are_kept_nearly_as_by_one_planner_of_all(drones):
    fast = {"env.num_drones": drones, "task_options.speed": 5.0, "task_options.acceleration": 8.0, "planner.sweeps": 5}
    apart, central = (fly(policy, "track", fast, 2, 8.0) for policy in ("mpc_distributed", "mpc"))
    assert not apart["failure_cause"].any()
    assert apart["payload_rmse_m"].mean() < 1.3 * central["payload_rmse_m"].mean() < 4e-3


def test_forces_are_estimated_by_where_all_drones_were():
    """By the others' plans alone, what they fail to do would pass for a force on the payload."""
    vec = make("track", 2, 3, **BY_RATES)
    observation, _ = vec.reset(seed=1)
    policy, central = (make_scripted(name, vec) for name in ("mpc_distributed", "mpc"))
    update, given, true = policy._estimator.update, [], []
    policy._estimator.update = lambda *seen: given.append([each.copy() for each in (seen[0], seen[2])]) or update(*seen)
    for _ in range(6):
        true.append(central._measure()[0])
        observation, *_ = vec.step(policy.act(observation))
    assert not given[0][1].any()
    cables = np.r_[6:12, 18:24]
    for (states, known), before in zip(given[1:], true, strict=False):
        assert known.all()
        np.testing.assert_array_equal(states[:, cables], before.repeat(3, axis=0)[:, cables])
    assert np.ptp([each[0, cables] for each in true], axis=0).min() > 0


@pytest.mark.parametrize("told", [{}, {"env.communication": "all", "env.communication_delay": 0}])
def test_drones_with_senses_of_their_own_hold_the_payload_by_what_is_said_at_once(told):
    result = fly("mpc_distributed", "hover", {"env.sensing": "onboard"} | told, seconds=8.0)
    assert not result["failure_cause"].any() and (result["payload_position_error_m"] < 0.15).all()


def test_where_the_others_are_is_not_where_their_plans_begin():
    """With actions that come late plans begin later."""
    late = {"randomization.action_delay": 4, "planner.delay": 0.08, "task_options.acceleration": 6.0}
    result = fly("mpc_distributed", "track", late | {"task_options.speed": 3.0})
    assert not result["failure_cause"].any() and (result["payload_rmse_m"] < 0.04).all()


def test_unknown_masses_and_forces_are_held():
    result = fly("mpc_distributed", "hover", {}, seconds=8.0)
    assert result["success_rate"].all() and (result["payload_position_error_m"] < 0.003).all()


def test_sensors_on_board_and_lossy_late_messages_cost_little():
    apart, central = (fly(policy, "track", LOSSY, 8, 8.0) for policy in ("mpc_distributed", "mpc"))
    assert not apart["failure_cause"].any()
    assert apart["payload_rmse_m"].mean() < 1.3 * central["payload_rmse_m"].mean()


def test_without_any_message_it_is_worse():
    """The messages matter: lost altogether, drones take the others to fly as at first, and the payload is far off."""
    heard, lost = (
        fly("mpc_distributed", "track", LOSSY | {"env.communication_loss": loss}, 6, 8.0) for loss in (0.1, 1.0)
    )
    assert lost["payload_rmse_m"].mean() > 1.2 * heard["payload_rmse_m"].mean()


@pytest.mark.parametrize("reach, heard", [(0.05, 0), (1.5, 8), (None, 12)])
def test_who_hears_whose_plan_is_by_the_radios_range(reach, heard):
    """Four drones rest in a square: each has two neighbours within 1.5 m."""
    overrides = BY_RATES | LOSSY | {"env.communication_loss": 0.0, "env.communication_range": reach}
    vec = make("hover", 1, 4, **overrides)
    observation, _ = vec.reset(seed=1)
    policy = make_scripted("mpc_distributed", vec)
    for _ in range(3):
        observation, *_ = vec.step(policy.act(observation))
    assert policy.planner.post.has_loads.sum() == heard


@pytest.mark.parametrize("overrides", [{}, LOSSY])
def test_forests_are_passed(overrides):
    result = fly("mpc_route_distributed", "navigate_dense", overrides, episodes=4, seconds=24.0)
    assert result["success_rate"].all()


def test_points_are_carried():
    result = fly("mpc_distributed", "hover", {"payload.shape": "point", "env.num_drones": 3}, seconds=8.0)
    assert result["success_rate"].all()


def test_an_episode_is_the_same_in_any_batch():
    one, three = (fly("mpc_distributed", "hover", LOSSY, count, 1.0) for count in (1, 3))
    assert one["payload_rmse_m"][0] == three["payload_rmse_m"][0]


def test_what_others_say_is_all_but_the_payload_and_oneself():
    found = others_of(3)
    assert found.shape == (3, 14)
    assert sorted(found[1]) == [6, 7, 10, 11, 18, 19, 22, 23, 24, 25, 26, 30, 31, 32]


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"planner.limits": "hard"}, "set planner.limits=soft"),
        ({"num_drones": 1, "payload.shape": "point"}, "two drones or more"),
        ({"control.action": "full_state"}, "acts by control.action=acc_rates"),
    ],
)
def test_what_it_cannot_do_is_refused(overrides, said):
    assert said in refusal(make_scripted, "mpc_distributed", make("hover", **(BY_RATES | overrides)))
