"""The rule `formation_adaptive`: what it makes of a measured force, and that it needs to measure one."""

import numpy as np
import pytest
from conftest import make

from multilift_marl.errors import ConfigError
from multilift_marl.policies.adaptive import FormationAdaptive
from multilift_marl.policies.baselines import fitting_scripts, make_scripted

ONBOARD = {"env.sensing": "onboard"}


def observe(vec, tension=0.0, error=(0.0, 0.0, 0.0)):
    """Return what drones observe on cables at rest, but for tension and the anchors' errors."""
    names, system = vec.observation_names, vec.world.system
    observation = np.zeros((vec.num_envs, vec.num_drones, len(names)), np.float32)
    force = system.formation_force
    lean = np.hypot(force[:, 0], force[:, 1]) / np.linalg.norm(force, axis=1)
    at = names.index("cable_0")
    observation[..., at], observation[..., at + 2] = lean, np.sqrt(1 - lean**2)
    observation[..., names.index("measured_tension_0")] = tension
    at = names.index("anchor_error_0")
    observation[..., at : at + 3] = error
    return observation


def settle(policy, observation, seconds, hz):
    for _ in range(round(seconds * hz)):
        action = policy.act(observation)
    return action


def test_at_rest_it_asks_for_the_formation():
    vec = make("hover", **ONBOARD)
    assert np.abs(settle(FormationAdaptive(vec), observe(vec), 5, 50)).max() < 1e-6


def test_a_stronger_pull_is_made_up_for_by_what_the_position_gain_gives_way():
    vec = make("hover", **ONBOARD)
    policy, system = FormationAdaptive(vec), vec.world.system
    action = settle(policy, observe(vec, tension=0.3), 20, 50) * vec.config.control.max_offset
    gives = 0.3 * policy.GIVE * np.linalg.norm(system.formation_force, axis=1)
    stiffness = system.vehicles[0].mass * 4.0**2  # position gain of the falcon, 4 rad/s
    lifted, outward = gives * np.cos(np.pi / 6), gives * np.sin(np.pi / 6)
    np.testing.assert_allclose(action[0, :, 2], lifted / stiffness, rtol=1e-3)
    np.testing.assert_allclose(action[0, :, 0], outward / stiffness, rtol=1e-3)
    np.testing.assert_allclose(action[..., [1, 3]], 0, atol=1e-6)


def test_an_anchor_that_stays_off_its_place_is_integrated():
    vec = make("hover", **ONBOARD)
    policy = FormationAdaptive(vec)
    once = policy.act(observe(vec, error=(0.01, -0.02, 0.03)))[0, 0] * vec.config.control.max_offset
    np.testing.assert_allclose(once[2], -0.03 * (policy.LIFT + policy.LIFT_RATE / 50), rtol=1e-4)
    action = settle(policy, observe(vec, error=(0.01, -0.02, 0.03)), 0.98, 50)[0, 0] * vec.config.control.max_offset
    np.testing.assert_allclose(action[:2], [-0.01 * policy.SHIFT_RATE, 0.02 * policy.SHIFT_RATE], rtol=1e-4)
    np.testing.assert_allclose(action[2], -0.03 * (policy.LIFT + policy.LIFT_RATE), rtol=1e-4)
    policy.reset(np.array([True, False, False, False]))
    again = policy.act(observe(vec))
    assert np.abs(again[0]).max() < 1e-6 and np.abs(again[1]).max() > 1e-3


@pytest.mark.slow
def test_a_drone_takes_its_share_within_two_seconds_of_joining():
    vec = make("regroup_senses", num_drones=6, **{"task_options.absent": 1.0})
    policy, at = FormationAdaptive(vec), vec.observation_names.index("attached_0")
    observation = observe(vec, error=(0, 0, 0.05))
    assert not policy.act(observation).any()  # without a cable
    observation[..., at] = 1
    rising = [float(policy.act(observation)[0, 0, 2]) for _ in range(50)]
    assert rising[0] < 0 and abs(rising[0]) < 0.03 * abs(rising[-1])
    integral = np.arange(1, 51) * 0.05 / 25
    np.testing.assert_allclose(
        rising, -(0.05 * policy.LIFT + policy.LIFT_RATE * integral) * np.arange(1, 51) / 50, rtol=1e-4
    )


def test_flights_of_a_batch_are_those_alone():
    together, alone = (make("regroup_senses", num_envs=count, num_drones=6) for count in (3, 1))
    states = []
    for vec in (together, alone):
        observation, _ = vec.reset(seed=1)
        policy = make_scripted("formation_adaptive", vec)
        for _ in range(40):
            observation, *_ = vec.step(policy.act(observation))
        states.append(vec.world.state.payload_position[0].copy())
    assert (states[0] == states[1]).all()


def test_it_needs_to_feel_its_cable():
    vec = make("hover")
    assert "formation_adaptive" not in fitting_scripts(vec)
    assert "formation_adaptive" in fitting_scripts(make("hover", **ONBOARD))
    assert "formation_adaptive" not in fitting_scripts(make("hover", **ONBOARD, **{"env.units": "cable"}))
    with pytest.raises(ConfigError, match="needs to measure cables"):
        make_scripted("formation_adaptive", vec)


def test_who_knows_the_truth_flies_regroup_alone():
    with pytest.raises(ConfigError, match="formation_balanced is for task regroup"):
        make_scripted("formation_balanced", make("hover"))
    assert "formation_balanced" not in fitting_scripts(make("regroup_senses", num_drones=6))


def test_hooks_off_the_centre_do_not_move_the_slots_of_a_balanced_team():
    still = {f"task_options.start_{key}": 0.0 for key in ("radius", "tilt", "speed")}
    known = {"randomization.payload_mass": 0.0, "randomization.payload_center_of_mass": [0, 0, 0]}
    vec = make("regroup", num_drones=6, **still, **known, **{"task_options.absent": 0.0, "cable.hook": [0, 0, -0.1]})
    observation, _ = vec.reset(seed=0)
    assert np.abs(make_scripted("formation_balanced", vec).act(observation)).max() < 1e-3
