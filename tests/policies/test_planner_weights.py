"""`control.action=planner_weights`: actions that are the weights of a planner, and derivatives of flights by them."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.diffmpc.weighted_planner import FlightGradient
from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.rollout import measure_episodes
from multilift_marl.planning.team_weights import TeamWeights
from multilift_marl.policies.baselines import make_base_policy, make_scripted
from multilift_marl.policies.planner_weights import weight_map

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

WIDE = {"control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0, "env.num_threads": 1, "env.num_drones": 3}
RATES = WIDE | {"control.action": "acc_rates"}
WEIGHTS = WIDE | {"control.action": "planner_weights"}


@pytest.mark.parametrize("name, limits", [("mpc", "soft"), ("mpc", "hard"), ("mpc_distributed", "soft")])
def test_zero_actions_fly_as_the_planner_bit_for_bit(name, limits):
    own = {
        "planner.limits": limits,
        "planner.distributed": name == "mpc_distributed",
        "task_options.speed": 2.0,
        "task_options.acceleration": 4.0,
        "num_envs": 2,
    }
    ours, theirs = (ml.make_vec("track", seed=3, **keys, **own) for keys in (WEIGHTS, RATES))
    policy = make_scripted(name, theirs)
    observation, _ = theirs.reset(seed=3)
    ours.reset(seed=3)
    for _ in range(15):
        ours.step(np.zeros((2, 3, ours.action_size)))
        observation = theirs.step(policy.act(observation))[0]
    assert (ours.world.state.payload_position == theirs.world.state.payload_position).all()
    assert (ours.world.state.drone_rotation == theirs.world.state.drone_rotation).all()


@pytest.mark.parametrize(
    "name, own", [("mpc", {}), ("mpc", {"env.history": [0, 2], "env.sensing": "mocap"}), ("mpc_distributed", {})]
)
def test_without_a_plan_the_linear_baseline_of_acc_rates_flies(name, own):
    """As by mpc, bit for bit; and evaluation reports that plans were late."""
    late = own | {"planner.deadline": 1e-4, "planner.steps": 200, "env.episode_seconds": 0.6, "num_envs": 2}
    late["planner.distributed"] = name == "mpc_distributed"
    ours, theirs = (ml.make_vec("track", seed=3, **keys, **late) for keys in (WEIGHTS, RATES))
    policy, ended = make_scripted(name, theirs), []
    for vec, each in ((ours, make_base_policy("formation", ours)), (theirs, policy)):
        found = measure_episodes(vec, each, vec.reset(seed=3)[0])
        assert (found["planner_late"] == 1.0).all() and "planner_failed" in found
        ended.append(vec.world.state)
    assert (ended[0].payload_position == ended[1].payload_position).all()
    assert (ended[0].drone_rotation == ended[1].drone_rotation).all()


@pytest.mark.parametrize(
    "apart", [{}, {"planner.distributed": True, "env.communication": "neighbours", "env.sensing": "onboard"}]
)
def test_a_saved_flight_goes_on_bit_for_bit(apart):
    keys = WEIGHTS | {"randomization.payload_mass": 0.2, "randomization.action_delay": [0, 2], "env.sensing": "mocap"}
    keys |= apart
    first, second = (ml.make_vec("track", num_envs=2, **keys) for _ in range(2))
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (20, 2, 3, first.action_size))
    first.reset(seed=1)
    for action in actions[:10]:
        first.step(action)
    second.reset(seed=7)
    second.load_state_dict(first.state_dict())
    for action in actions[10:]:
        assert (first.step(action)[0] == second.step(action)[0]).all()


@pytest.mark.parametrize("apart, limits", [(False, "soft"), (False, "hard"), (True, "soft")])
def test_a_state_saved_after_a_reset_is_loaded(apart, limits):
    """Of all environments and of one of them; arrays have a row for each environment."""
    keys = WEIGHTS | {"planner.distributed": apart, "planner.limits": limits, "env.sensing": "mocap"}
    vec = ml.make_vec("track", num_envs=2, **keys)
    actions = np.random.default_rng(0).uniform(-0.3, 0.3, (8, 2, 3, vec.action_size))
    for mask in (None, np.array([True, False])):
        vec.reset(mask=mask)
        saved = vec.state_dict()
        assert {len(array) for array in saved.values()} == {2}
        assert all(np.isfinite(array).all() for name, array in saved.items() if name.startswith("commander."))
        first = [vec.step(action)[0] for action in actions]
        vec.load_state_dict(saved)
        assert all((vec.step(action)[0] == there).all() for action, there in zip(actions, first, strict=True))


def test_a_state_of_another_planner_is_refused():
    own, other = (ml.make_vec("track", num_envs=2, **WEIGHTS, **{"planner.position": at}) for at in (0.1, 0.2))
    own.reset(seed=0)
    with pytest.raises(ValueError, match=r"'commander\.planner' is that of another"):
        other.load_state_dict(own.state_dict())


def test_an_environment_is_the_same_in_any_batch():
    alone, batch = (ml.make_vec("track", num_envs=e, first_env=f, **WEIGHTS) for e, f in ((1, 2), (4, 0)))
    action = np.random.default_rng(0).uniform(-0.5, 0.5, (4, 3, alone.action_size))
    alone.reset(seed=1)
    batch.reset(seed=1)
    for _ in range(10):
        one, many = alone.step(action[2:3])[0], batch.step(action)[0]
    assert (one[0] == many[2]).all()


def test_drones_that_plan_for_themselves_weigh_as_they_say():
    """Also the payload: two drones' weights, said by one of them, do not count for the other."""
    vec = ml.make_vec("track", num_envs=1, **WEIGHTS, **{"planner.distributed": True})
    commander, planner = vec.commander, vec.commander.planner
    vec.reset(seed=0)
    action = np.zeros((1, 3, vec.action_size))
    position, cable = (vec.action_names.index(f"{name}_weight") for name in ("position", "cable"))
    action[0, 1, [position, cable]] = 1.0
    commander.command(action)
    most, rest = vec.config.control.max_weight, planner.objective.state
    assert (planner.weights.state[[0, 2]] == rest).all()
    assert planner.weights.state[1, :2] == pytest.approx(most * rest[:2], rel=1e-12)
    assert planner.weights.state[1, 8:10] == pytest.approx(most * rest[8:10], rel=1e-12)
    assert planner.weights.state[1, 2] == rest[2]
    plans = planner.plans.inputs.copy()
    vec.reset(seed=0)
    commander.command(np.zeros_like(action))
    moved = np.abs(plans - planner.plans.inputs).reshape(3, -1, 3, 3).max(axis=(1, 3))
    assert moved[1, 1] > 1e-3  # its own part of its own plan


def test_weights_are_the_drones_own_and_means_of_what_they_say():
    vec = ml.make_vec("track", num_envs=1, **WEIGHTS)
    commander, objective = vec.commander, vec.commander.planner.objective
    names = [name.removesuffix("_weight") for name in vec.action_names]
    action = np.zeros((1, 3, len(names)))
    action[0, :, names.index("position")] = 1.0, -1.0, 0.5
    action[0, 1, names.index("thrust")] = 0.5
    action[0, 2, names.index("thrust_rate")] = -1.0
    action[0, :, names.index("end")] = 0.3
    weights = commander.weigh(action)
    factor = weights.state[0] / objective.state
    assert factor[:2] == pytest.approx(100 ** (0.5 / 3))
    assert factor[24:33] == pytest.approx([1, 1, 1, 10, 10, 10, 1, 1, 1])
    assert factor[2:24] == pytest.approx(1)
    assert weights.rate[0] / objective.rate == pytest.approx([1] * 6 + [0.01] * 3)
    assert weights.end[0] / objective.end == pytest.approx(factor * 100**0.3)
    assert all((part != 0).any(axis=1).sum() for part in weight_map(3))
    # Each number of an action moves some weight.
    assert (np.hstack(weight_map(3)) != 0).any(axis=1).all()


@pytest.mark.parametrize(
    "own, most",
    [
        ({"planner.limits": "soft"}, 0.08),
        ({"planner.limits": "hard"}, 0.08),
        ({"randomization.action_delay": [2, 2], "planner.delay": 0.04}, 0.24),
        ({"randomization.action_delay": [2, 2]}, 0.24),
    ],
    ids=["soft", "hard", "late as expected", "late"],
)
def test_derivatives_by_actions_are_differences_of_simulated_flights(own, most):
    """The flights are MuJoCo's, with motor lag and controllers; the derivatives those of the planner's model."""
    keys = own | {"planner.steps": 10, "planner.position": 0.3, "task_options.speed": 2.0}
    vec = ml.make_vec("track", num_envs=1, **WEIGHTS, **keys, **{"task_options.acceleration": 4.0})
    commander, steps = vec.commander, 20
    vec.reset(seed=1)
    still = np.zeros((1, 3, vec.action_size))
    for _ in range(100):
        vec.step(still)
    response = 1.0 - np.exp(-vec.task.dt / vec.world.system.vehicles[0].rotor_time_constant)  # as in training
    saved, flight = vec.state_dict(), FlightGradient(commander.planner, steps, vec.task.dt, response)
    loss = np.concatenate([np.ones(3), np.full(3, 0.1), np.zeros(27)])
    expected_late = round(vec.config.planner.delay / vec.task.dt)

    def fly(action):
        vec.load_state_dict(saved)
        for t in range(steps + 1):
            for kept, weights in zip(flight.weights, commander.weigh(action), strict=True):
                kept[t] = weights
            commander.planner.slot = t
            vec.step(action)
            flight.tape.late[t] = np.maximum(vec.task.view.action_delay - expected_late, 0)
        off = np.moveaxis(flight.tape.off[:, :, 0], 0, 1).copy()
        off[:, 0] = 0.0
        return 0.5 * (off**2 * loss).sum(), off * loss

    slopes = fly(still)[1]
    gradient = flight.find(slopes)
    weights = TeamWeights(*(each[:-1] for each in flight.weights))
    found = commander.pull_back(gradient, weights).sum(axis=(0, 1))
    expected = np.zeros_like(found)
    for n, k in [(0, k) for k in range(vec.action_size)] + [(2, 8), (2, 10), (2, 11)]:
        change = still.copy()
        change[0, n, k] = 0.05
        expected[n, k] = (fly(change)[0] - fly(-change)[0]) / 0.1
    counted = expected != 0
    assert counted.sum() == vec.action_size + 3
    found, expected = found[counted], expected[counted]
    assert found == pytest.approx(expected, abs=most * abs(expected).max())
    assert found @ expected > (0.998 if most < 0.1 else 0.97) * np.linalg.norm(found) * np.linalg.norm(expected)


def test_what_cannot_be_planned_is_refused():
    own = {"control.action": "planner_weights"}
    said = refusal(ml.make_vec, "recover", **own)
    assert said.startswith("control.action=planner_weights cannot fly task recover: ")
    assert said.endswith("; take another control.action")
    apart = WEIGHTS | {"planner.distributed": True}
    for more in ({"planner.limits": "hard"}, {"env.num_drones": 1, "payload.shape": "point"}):
        said = refusal(ml.make_vec, "track", **apart | more)
        assert said.startswith("planner.distributed=true has soft limits, and two drones or more; ")
        assert said.endswith("set planner.limits=soft, or planner.distributed=false")
    with pytest.raises(ConfigError, match=r"planner\.feedback=1"):
        ml.make_vec("track", **WEIGHTS, **{"planner.feedback": 0.5})
    with pytest.raises(ConfigError, match=r"control\.max_weight"):
        ml.load_config("track", {"control.max_weight": 1.0})


def test_a_team_that_is_measured_is_not_planned_for():
    said = refusal(MeasuredTeam, ml.load_config("track", WEIGHTS))
    assert said.startswith("control.action=planner_weights commands simulated teams alone, ")
