"""What drones know of themselves: filters over simulated sensors, and controllers that fly by them."""

from dataclasses import replace

import numpy as np
import pytest
from conftest import make

from multilift_marl.policies.baselines import make_scripted
from multilift_marl.sensing import estimator
from multilift_marl.sensing.estimator import StateEstimator, make_gains, steady_gain
from multilift_marl.sensing.suite import Sensor, SensorSuite

DT = 0.004


def angles(estimated, true):
    """Return the angle between attitudes (..., 3, 3) [deg]."""
    turned = np.swapaxes(true, -1, -2) @ estimated
    return np.degrees(np.arccos(np.clip((np.trace(turned, axis1=-2, axis2=-1) - 1) / 2, -1, 1)))


def fly(level, script="formation_integral", **settings):
    """Return a batch, and the errors of its drones' estimates at every policy step: position, velocity, angle."""
    vec = make(num_envs=24, **{"env.sensing": level, **settings})
    policy = make_scripted(script, vec)
    seen, errors = vec.reset(seed=3)[0], []
    for _ in range(vec.max_steps):
        seen, _, terminated, _, _ = vec.step(policy.act(seen))
        assert not terminated.any()
        own, true = vec.controller.state, vec.world.state
        errors.append(
            (
                np.linalg.norm(own.drone_position - true.drone_position, axis=-1),
                np.linalg.norm(own.drone_velocity - true.drone_velocity, axis=-1),
                angles(own.drone_rotation, true.drone_rotation),
            )
        )
    return vec, tuple(np.array(each) for each in zip(*errors, strict=True))


@pytest.mark.parametrize(
    ("level", "position", "velocity", "angle"),
    [("mocap", 0.001, 0.008, 0.6), ("rtk", 0.03, 0.03, 1.2), ("onboard", 0.03, 0.03, 1.2), ("blind", 0.03, 0.03, 1.2)],
)
def test_filters_stay_as_close_as_their_sensors(level, position, velocity, angle):
    _, errors = fly(level)
    rms = [float(np.sqrt((each**2).mean())) for each in errors]
    assert rms[0] < position and rms[1] < velocity and rms[2] < angle, rms
    late = [float(np.sqrt((each[-100:] ** 2).mean())) for each in errors]
    early = [float(np.sqrt((each[100:200] ** 2).mean())) for each in errors]
    assert all(after < 1.5 * before + 1e-3 for after, before in zip(late, early, strict=True)), (early, late)


@pytest.mark.slow
@pytest.mark.parametrize("level", [pytest.param("mocap", marks=pytest.mark.slow), "onboard"])
def test_filters_follow_a_fast_path(level):
    _, (position, velocity, angle) = fly(level, "formation_lead", **TRACK)
    assert np.sqrt((position**2).mean()) < (0.002 if level == "mocap" else 0.04)
    assert np.sqrt((velocity**2).mean()) < 0.06
    assert np.sqrt((angle**2).mean()) < 2.0


TRACK = {"task": "track", "env.episode_seconds": 12.0, "task_options.speed": 2.0, "task_options.acceleration": 4.0}


def test_sensors_without_errors_leave_nothing_but_the_steps_of_integration(monkeypatch):
    monkeypatch.setattr("multilift_marl.sensing.estimator._make_suite", lambda level, rate: SensorSuite.ideal(rate))
    monkeypatch.setattr("multilift_marl.sensing.estimator.make_gains", lambda suite, field: GAINS)
    _, (position, velocity, angle) = fly("onboard")
    assert position.max() < 3e-3  # p advances by the mean velocity of a tick, MuJoCo's by the last one: DT/2 of it
    assert velocity.max() < 1e-3
    assert angle.max() < 0.05


GAINS = make_gains(
    SensorSuite(*(Sensor(250.0, noise=0.01) for _ in range(3)), Sensor(50.0), *(Sensor(10.0, 0.1, 0.01),) * 2), 20.0
)


def riccati(a, c, q, r):
    """Return the solution of P = A P Aᵀ + Q - A P Cᵀ (C P Cᵀ + R)⁻¹ C P Aᵀ, by the stable part of its pencil."""
    size, back = len(a), np.linalg.inv(a)
    noise = c.T @ np.linalg.inv(r) @ c
    pencil = np.block([[a.T + noise @ back @ q, -noise @ back], [-back @ q, back]])
    values, vectors = np.linalg.eig(pencil)
    stable = vectors[:, np.abs(values) < 1]
    return np.real(stable[size:] @ np.linalg.inv(stable[:size]))


def test_gains_are_those_of_the_riccati_equation():
    a = np.array([[1.0, DT], [0.0, 1.0]])
    q, c, noise = np.diag([0.0, (0.1 * DT) ** 2]), np.array([[1.0, 0.0]]), np.array([0.02])
    p = riccati(a, c, q, np.diag(noise**2))  # before a correction
    expected = p @ c.T / (c @ p @ c.T + noise**2)
    np.testing.assert_allclose(steady_gain(a, q, c, noise, 1), expected, rtol=1e-5)
    five = steady_gain(a, q, c, noise, 5)  # rarer corrections count more
    assert (five > expected).all()


@pytest.mark.parametrize("noise", [1e-4, 0.05])
def test_filters_are_stable_with_fixes_that_come_late_however_exact_they_are(noise, monkeypatch):
    usual = estimator._make_suite("onboard", 250.0)
    fixes = {"delay": 0.1, "noise": noise, "drift": 0.0}
    suite = replace(usual, position=replace(usual.position, **fixes), velocity=replace(usual.velocity, **fixes))
    monkeypatch.setattr(estimator, "_make_suite", lambda level, rate: suite)
    _, (position, velocity, angle) = fly("onboard")
    assert np.sqrt((position**2).mean()) < max(0.01, noise)
    assert np.sqrt((velocity**2).mean()) < 0.05 and angle.max() < 4


def test_a_correction_moves_on_as_the_state_does():
    gains = make_gains(estimator._make_suite("onboard", 250.0), 20.0)
    late, now = gains.level[25], gains.level[0]
    assert gains.level.shape == (26, 4, 2) and gains.vertical.shape == (26, 3, 2)
    np.testing.assert_allclose(late[0] - now[0], 0.1 * now[1], rtol=0.2)  # position by velocity times 0.1 s
    np.testing.assert_allclose(late[1] - now[1], 0.1 * 9.81 * now[2], rtol=0.05)  # velocity by g times tilt


def test_a_team_flies_by_what_it_knows_not_by_the_truth(monkeypatch):
    monkeypatch.setattr("multilift_marl.sensing.estimator._make_suite", lambda level, rate: SensorSuite.ideal(rate))
    monkeypatch.setattr("multilift_marl.sensing.estimator.make_gains", lambda suite, field: GAINS)
    settings = {"env.sensing": "onboard", "randomization.payload_force": 0.0, "randomization.payload_mass": 0.0}
    vec = make(num_envs=2, **settings)
    vec.reset(seed=3)
    vec._estimator._sensors.readings.offset[:, :, 10:13] = (0.3, 0.0, 0.0)  # all positioning is off to the east
    for _ in range(vec.max_steps):
        vec.step(np.zeros((2, 4, 4)))
    np.testing.assert_allclose(vec.task.errors.position[:, :2], [[-0.3, 0.0]] * 2, atol=0.02)
    known = vec.task.view.estimated_errors.position
    assert np.abs(known[..., :2]).max() < 0.03  # so far as the drones know, the payload is where it should be


def test_ideal_sensing_is_the_truth_itself():
    vec = make(num_envs=2)
    assert vec.controller.state is vec.world.state and vec.task.view.estimated is vec.world.state


def test_rates_that_do_not_divide_the_control_rate_are_rounded():
    for hz in (100.0, 125.0, 200.0, 500.0):
        settings = {"sim.control_hz": hz, "sim.timestep": 1 / hz, "env.policy_hz": 25.0, "env.sensing": "mocap"}
        vec = make(num_envs=2, **settings)
        vec.reset(seed=0)
        for _ in range(25):
            vec.step(np.zeros((2, 4, 4)))
        own, true = vec.controller.state, vec.world.state
        assert np.abs(own.drone_position - true.drone_position).max() < 5e-3


def test_an_estimator_begins_anew_with_each_episode():
    vec = make(num_envs=3, **{"env.sensing": "onboard"})
    first = vec.reset(seed=4)[0]
    for _ in range(20):
        vec.step(np.zeros((3, 4, 4)))
    np.testing.assert_array_equal(vec.reset(seed=4)[0], first)
    assert isinstance(vec._estimator, StateEstimator)
