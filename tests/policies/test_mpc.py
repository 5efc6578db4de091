"""The policy mpc: it flies paths, poses and hidden loads; what it sees ahead is what comes; what it refuses."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.config.load import load_config
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.mpc import ENOUGH, TeamMpc

pytestmark = pytest.mark.slow  # its planner takes a minute to compile

BY_RATES = {"control.action": "acc_rates", "control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0}
FAST = {"task_options.speed": 2.0, "task_options.acceleration": 4.0, "task_options.rmse_from": 3.0}


def fly(config, overrides, episodes=2, seconds=6.0):
    loaded = load_config(config, BY_RATES | overrides | {"env.episode_seconds": seconds, "env.num_threads": 1})
    return run_episodes(loaded, lambda vec: make_scripted("mpc", vec), episodes, 77)


@pytest.mark.parametrize("overrides", [{}, {"env.num_drones": 3}, {"env.num_drones": 6}])
def test_it_keeps_to_a_figure_eight_within_millimetres(overrides):
    result = fly("track", FAST | overrides)
    assert (result["payload_rmse_m"] < 0.0025).all()


def test_chains_and_a_hidden_mass_cost_little():
    assert (fly("track", FAST | {"cable.model": "chain"}, 1)["payload_rmse_m"] < 0.004).all()
    assert (fly("track", FAST | {"randomization.payload_mass": 0.2})["payload_rmse_m"] < 0.009).all()
    late = {"randomization.action_delay": 1, "planner.delay": 0.02}
    assert (fly("track", FAST | late)["payload_rmse_m"] < 0.006).all()


def test_it_holds_what_it_does_not_know():
    """Hidden mass ± 20 % and a force up to 1.5 N, from starts up to half a metre away."""
    result = fly("hover", {}, episodes=4, seconds=8.0)
    assert result["success_rate"].all() and (result["payload_position_error_m"] < 0.001).all()
    without = fly("hover", {"planner.estimate": False}, episodes=4, seconds=8.0)
    assert (without["payload_position_error_m"] > 0.01).all()


def test_noise_costs_a_centimetre():
    noisy = fly("hover", {"randomization.observation_noise": 1.0}, episodes=6, seconds=8.0)
    assert noisy["success_rate"].all() and (noisy["payload_position_error_m"] < 0.02).all()


def test_late_cameras_cost_a_centimetre():
    assert (fly("track", FAST | {"env.sensing": "mocap"})["payload_rmse_m"] < 0.02).all()


@pytest.mark.parametrize(("sensing", "path", "most"), [("onboard", FAST, 0.03), ("blind", {}, 0.08)])
def test_sensors_on_board_cost_centimetres(sensing, path, most):
    result = fly("track", path | {"env.sensing": sensing}, episodes=6)
    assert not result["failure_cause"].any() and (result["payload_rmse_m"] < most).all()


def test_it_flies_tilted_poses():
    result = fly("pose", {}, episodes=2, seconds=8.0)
    assert result["success_rate"].all() and (result["payload_position_error_m"] < 0.01).all()
    assert (result["payload_attitude_error_deg"] < 0.5).all()


def test_a_target_that_leaps_is_approached():
    vec = ml.make_vec("hover", num_envs=2, num_threads=1, **BY_RATES)
    observation, _ = vec.reset(seed=3)
    policy = make_scripted("mpc", vec)
    for k in range(250):
        if k == 100:
            for e in range(2):
                vec.task.place_goal(e, vec.task.goal.position[e] + [0.8, -0.6, 0.3])
            assert (np.linalg.norm(vec.world.state.payload_position - vec.task.goal.position, axis=1) > 1).all()
        observation, _, ended, *_ = vec.step(policy.act(observation))
        assert not ended.any()
    assert (np.linalg.norm(vec.world.state.payload_position - vec.task.goal.position, axis=1) < 2e-3).all()


KNOWN = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}


@pytest.mark.parametrize("n", [4, 8])
def test_drones_keep_to_a_shape_that_is_drawn_in(n):
    """Within 2 s on 1 m the formation narrows to 0.55 of its width and turns by 40°; drones are within a centimetre."""
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, **BY_RATES, **KNOWN, **{"env.num_drones": n})
    observation, _ = vec.reset(seed=3)
    system, state = vec.world.system, vec.world.state
    rest = system.formation_force / np.linalg.norm(system.formation_force, axis=1, keepdims=True)
    across = system.anchors[:, 1] + system.cable_length * rest[:, 1]

    def preview(times):
        s = np.clip((times - 2.0) / 2.0, 0.0, 1.0)
        share = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
        position, rotation = np.zeros((*times.shape, 3)), np.zeros((*times.shape, 3, 3))
        position[..., 0], position[..., 2] = share, 1.0
        rotation[..., 0, 0] = rotation[..., 1, 1] = np.cos(0.7 * share)
        rotation[..., 1, 0], rotation[..., 2, 2] = np.sin(0.7 * share), 1.0
        rotation[..., 0, 1] = -rotation[..., 1, 0]
        d = np.tile(rest, (*times.shape, 1, 1))
        d[..., 1] = ((1.0 - 0.45 * share[..., None]) * across - system.anchors[:, 1]) / system.cable_length
        d[..., 2] = np.sqrt(1.0 - d[..., 0] ** 2 - d[..., 1] ** 2)
        return position, rotation, d * (system.formation_force[:, 2] / d[..., 2])[..., None]

    policy = TeamMpc(vec, preview)
    for _ in range(250):
        observation, _, ended, *_ = vec.step(policy.act(observation))
        assert not ended.any()
        target = policy.planner.plans.targets[0, 0]
        if vec.task.time[0] < 1.9:
            continue
        arms = state.payload_position[0] + system.anchors @ state.payload_rotation[0].T
        hooks = state.drone_position[0] + np.einsum("nij,nj->ni", state.drone_rotation[0], system.hooks)
        off = (hooks - arms)[:, :2] - policy.planner.model.length[:, None] * target[6 : 6 + 2 * n].reshape(n, 2)
        assert np.abs(off).max() < 0.03  # a policy step's change included
    (place,), _, (shape,) = (part[:, 0] for part in preview(vec.task.time[:, None]))
    arms = place + system.anchors @ state.payload_rotation[0].T
    turned = shape @ state.payload_rotation[0].T
    planned = arms + policy.planner.model.length[:, None] * turned / np.linalg.norm(turned, axis=1, keepdims=True)
    assert np.linalg.norm(hooks - planned, axis=1).max() < 0.01
    assert np.ptp((hooks - place) @ state.payload_rotation[0][:, 1]) == pytest.approx(0.55 * np.ptp(across), rel=0.03)


def test_drones_keep_clear_of_what_stands_where_they_would_be():
    """A pillar where a drone's body would be, 5 cm deep: it stays 9 cm away, the payload where it is to be."""
    system = ml.load_config("hover").system
    slot = system.anchors[0] + system.cable_length[0] * system.formation_force[0] / np.linalg.norm(
        system.formation_force[0]
    )
    out = np.append(slot[:2] / np.linalg.norm(slot[:2]), 0.0)
    goal = np.array([1.2, 0.9, 1.0])
    pillar = goal + slot + (0.15 + system.vehicles[0].half_size[0] - 0.05) * out
    scene = {"scene.obstacles": [{"shape": "cylinder", "size": [0.3, 6.0], "position": [*pillar[:2].tolist(), 3.0]}]}
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, **BY_RATES, **KNOWN, **scene)
    observation, _ = vec.reset(seed=3)
    policy = make_scripted("mpc", vec)
    vec.task.place_goal(0, goal)
    for _ in range(250):
        observation, _, ended, *_ = vec.step(policy.act(observation))
        assert not ended.any()
        assert vec.task.view.clearance[0] > 0.05
    assert vec.task.view.clearance[0] > 0.09
    assert np.linalg.norm(vec.world.state.payload_position[0] - goal) < 0.01


@pytest.mark.parametrize("config", ["track", "pose"])
def test_what_it_sees_ahead_is_what_comes(config):
    vec = ml.make_vec(config, num_envs=2, num_threads=1)
    vec.reset(seed=5)
    times = vec.task.time[:, None] + np.arange(1, 60) * vec.task.dt
    position, rotation = vec.task.preview_targets(times)
    for k in range(59):
        vec.step(np.zeros((2, vec.num_drones, vec.action_size)), restart=True)
        assert vec.task.planned.position == pytest.approx(position[:, k], abs=1e-9)
        assert vec.task.planned.rotation == pytest.approx(rotation[:, k], abs=1e-9)


def test_its_flight_is_the_same_alone_and_again():
    def actions(num_envs, first):
        vec = ml.make_vec("track", num_envs=num_envs, first_env=first, num_threads=1, **BY_RATES)
        observation, _ = vec.reset(seed=3)
        policy, taken = make_scripted("mpc", vec), []
        for _ in range(5):
            taken.append(policy.act(observation))
            observation, *_ = vec.step(taken[-1])
        return np.array(taken)

    together = actions(3, 0)
    assert np.array_equal(actions(3, 0), together)
    assert np.array_equal(actions(1, 2)[:, 0], together[:, 2])


@pytest.mark.parametrize(
    ("config", "overrides", "said"),
    [
        ("takeoff", {}, "policy=mpc cannot fly task takeoff"),
        ("gate", {}, "policy=mpc cannot fly task gate"),
        ("loss", {}, "policy=mpc cannot fly task loss"),
        ("recover", {}, "policy=mpc cannot fly task recover"),
        ("hover", {"env.num_drones": 1}, "two anchors or more"),
        ("hover", {"control.disturbance": "indi"}, "set control.disturbance=none"),
        ("hover", {"control.action": "reference"}, "acts by control.action=acc_rates"),
    ],
)
def test_what_it_cannot_fly_is_refused(config, overrides, said):
    vec = ml.make_vec(config, num_envs=1, num_threads=1, **(BY_RATES | overrides))
    assert said in refusal(make_scripted, "mpc", vec)


@pytest.mark.parametrize("delay", [0.01, 0.03])
def test_a_delay_between_policy_steps_is_refused(delay):
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, **BY_RATES, **{"planner.delay": delay})
    message = refusal(make_scripted, "mpc", vec)
    assert message.startswith(f"planner.delay={delay:g} is no whole number of policy steps of 0.02 s")
    assert f"set planner.delay={delay - 0.01:g} or {delay + 0.01:g}" in message


def test_thrusts_lead_by_the_lag_of_each_drones_own_motors():
    lags = [0.02, 0.1, 0.02, 0.05]
    own = {"vehicle.rotor_time_constant_up": lags, "vehicle.rotor_time_constant_down": lags}
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=4, **BY_RATES, **own)
    policy, (observation, _) = make_scripted("mpc", vec), vec.reset(seed=0)
    policy.act(observation)
    plans = policy.planner.plans
    ahead = policy._sent[-1, 0] - plans.states[0, 0, -12:]
    np.testing.assert_allclose(ahead, (np.repeat(lags, 3) + 0.01) * plans.inputs[0, 0], atol=1e-9)
    assert np.abs(plans.inputs[0, 0]).min() > 1e-3


WIDE = {f"control.{key}": wide for key, (_, wide) in ENOUGH["full_state"].items()}
FULL_STATE = {"control.action": "full_state"} | WIDE
PARTS = ("position", "rotation", "velocity", "body_rates")
MEASURED = [f"{body}_{name}" for body in ("payload", "drone") for name in PARTS]


@pytest.mark.parametrize(("feedback", "delay", "most"), [(1.0, 0.0, 0.005), (0.0, 0.0, 0.02), (0.2, 0.04, 0.02)])
def test_a_team_whose_rotors_are_not_measured_is_flown_as_well(feedback, delay, most):
    """Measurements of a simulated team, whose rotor speeds stay hidden, to the actions that it then flies by."""
    own = {"env.num_envs": 1, "env.num_threads": 1, "planner.feedback": feedback, "planner.estimate": feedback == 1.0}
    own |= {"planner.delay": delay, "randomization.action_delay": round(delay / 0.02)}
    config = load_config("track_circle", FULL_STATE | own)
    vec, team = MultiliftVec(config, EVALUATION), MeasuredTeam(config)
    vec.reset(seed=3)
    measured = lambda: {name: getattr(vec.world.state, name)[0].copy() for name in MEASURED}  # noqa: E731
    observation, policy, errors, rotors = team.begin(measured(), 3), make_scripted("mpc", team), [], []
    for _ in range(250):
        action = policy.act(observation)
        team.command(action)
        vec.step(action)
        observation = team.observe(measured())
        errors.append(vec.task.errors.distance[0])
        rotors.append(np.abs(team.world.state.rotor_speed / vec.world.state.rotor_speed - 1).max())
    assert max(errors[50:]) < most, max(errors[50:])
    assert delay or np.median(rotors) < 0.02


def test_plans_are_followed_only_as_whole_motions():
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, **BY_RATES, **{"planner.feedback": 0.5})
    assert "set control.action=full_state" in refusal(make_scripted, "mpc", vec)


def test_observations_of_other_environments_are_refused():
    vec = ml.make_vec("hover", num_envs=2, num_threads=1, **BY_RATES)
    observation, _ = vec.reset(seed=0)
    with pytest.raises(ValueError, match="give the observations of all of them"):
        make_scripted("mpc", vec).act(observation[:1])
