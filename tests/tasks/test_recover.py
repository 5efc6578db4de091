"""Task recover: harsh starts, grace, and what counts as recovered."""

import numpy as np
import pytest
from conftest import GRAVITY, make, zeros

from multilift_marl.mdp.failures import CABLE, TILT, ignore


def starts(config: str, count: int = 200):
    """Return environments of `config` at their starts."""
    vec = make(config, num_envs=count, **({"num_drones": 2} if "crazymarl" in config else {}))
    vec.reset(seed=0)
    return vec


def test_default_starts_are_as_documented():
    vec = starts("recover")
    state, goal, system = vec.world.state, vec.task.goal, vec.world.system
    assert (np.abs(goal.position[:, :2]) <= 1).all() and goal.position[:, 2].min() >= 1.5 > goal.position[
        :, 2
    ].max() - 1
    assert 0.48 < vec.task.errors.distance.max() <= 0.5
    tilt = np.rad2deg(np.arccos(np.clip(state.drone_rotation[..., 2, 2], -1, 1)))
    assert tilt.max() <= 90 + 1e-9 and tilt.max() > 80
    assert np.rad2deg(vec.task.errors.angle).max() <= 90
    # The payload is tilted half as far, about an axis of its own.
    payload = np.rad2deg(np.arccos(np.clip(state.payload_rotation[:, 2, 2], -1, 1)))
    assert 40 < payload.max() <= 45 + 1e-9
    for speed in (np.linalg.norm(state.drone_velocity, axis=-1), np.linalg.norm(state.payload_velocity, axis=-1)):
        assert 0.9 < speed.max() <= 1
    anchors = state.payload_position[:, None] + np.einsum("eij,nj->eni", state.payload_rotation, system.anchors)
    span = np.linalg.norm(state.drone_position - anchors, axis=-1)
    assert span.min() >= 0.6 - 1e-9 and span.max() <= 1.0
    assert (state.cable_tension == 0).all()


def test_crazymarl_starts_are_its_samplers():
    vec = starts("recover_crazymarl", 1000)
    state = vec.world.state
    load, drones = state.payload_position, state.drone_position
    assert np.abs(load[:, :2]).max() <= 1.5 and load[:, 2].max() <= 3 and load[:, 2].min() == 0.0055
    assert (load[:, 2] == 0.0055).mean() == pytest.approx(0.25, abs=0.05)
    apart = np.linalg.norm(drones[:, 0] - drones[:, 1], axis=-1)
    assert apart.min() >= 0.19
    distance = np.linalg.norm(drones - load[:, None], axis=-1)
    assert distance.max() <= 0.3 + 1e-9
    expected = np.random.default_rng(0).normal(0.3, 0.1, 100_000).clip(0.05, 0.3)
    high = load[:, 2] > 0.5  # else the ground lifts drones
    assert distance[high & (load[:, 2] < 2.7)].min() == pytest.approx(0.05, abs=1e-9)  # nor the ceiling
    for quantile in (0.1, 0.25, 0.4):
        assert np.quantile(distance[high], quantile) == pytest.approx(np.quantile(expected, quantile), abs=0.01)
    # Polar angles are normal, 45 and 22.5 degrees, of teams whose drones are 19 cm apart.
    rng = np.random.default_rng(0)
    span, angle = rng.normal(0.3, 0.1, (100_000, 2)).clip(0.05, 0.3), np.deg2rad(rng.normal(45, 22.5, (100_000, 2)))
    azimuth = [0, np.pi] + rng.normal(0, np.pi / 3, (100_000, 2))
    flat = span * np.sin(angle)
    places = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), span * np.cos(angle)], axis=-1)
    drawn = np.abs(angle[np.linalg.norm(places[:, 0] - places[:, 1], axis=-1) >= 0.19])
    polar = np.arccos(((drones - load[:, None])[..., 2] / distance)[high & (load[:, 2] < 2.6)])
    for quantile in (0.1, 0.5, 0.9):
        assert np.quantile(polar, quantile) == pytest.approx(np.quantile(drawn, quantile), abs=0.04)
    assert state.drone_velocity.std() == pytest.approx(0.2, rel=0.05)
    assert state.drone_body_rates.std() == pytest.approx(np.deg2rad(20), rel=0.05)
    assert (vec.task.goal.position == [0, 0, 1.5]).all()


def test_crazymarl_drones_stand_about_the_load_in_their_order():
    vec = make("recover_crazymarl", num_envs=1000, num_drones=4)
    vec.reset(seed=0)
    beside = vec.world.state.drone_position[..., :2] - vec.world.state.payload_position[:, None, :2]
    azimuth = np.arctan2(beside[..., 1], beside[..., 0])
    step = np.exp(1j * (np.roll(azimuth, -1, axis=1) - azimuth)).mean(axis=0)  # from each to the next
    assert np.angle(step) == pytest.approx(np.full(4, np.pi / 2), abs=0.3)


def test_tilt_and_cable_angle_count_after_the_grace_alone():
    vec = make("recover", num_envs=2)
    vec.reset(seed=0)
    assert (vec.task.mask.ignored == ignore(TILT, CABLE)).all()
    for step in range(101):
        assert (vec.task.mask.ignored != 0).all() == (step <= 100 and vec.task.time[0] <= 2.0)
        vec.step(zeros(vec))
    assert (vec.task.mask.ignored == 0).all()


def test_success_is_within_a_centimetre_at_the_end():
    vec = make("recover", num_envs=2, **{"env.episode_seconds": 1.0})
    vec.reset(seed=0)
    for _ in range(vec.max_steps):
        info = vec.step(zeros(vec))[4]
    assert not info["success"].any()
    vec.task.good_time[:], vec.task.own.peak_tension[:] = [0.5, 0.48], 1.0
    assert vec.task.succeeded().tolist() == [True, False]


def test_rotors_carry_drone_and_share_of_the_payload_at_the_start():
    vec = make("recover", num_envs=4, **{"randomization.payload_mass": 0.2})
    _, info = vec.reset(seed=0)
    system, vehicle = vec.world.system, vec.world.system.vehicles[0]
    thrust = vehicle.thrust_coefficient * (vec.world.state.rotor_speed**2).sum(axis=2)
    carried = vehicle.mass + info["randomization"]["payload_mass"] / system.num_drones
    np.testing.assert_allclose(thrust, np.tile((carried * GRAVITY)[:, None], system.num_drones), rtol=1e-9)


def test_weak_rotors_turn_faster_at_the_start():
    vec = make("recover", num_envs=4, **{"randomization.rotor_thrust_coefficient": 0.2})
    _, info = vec.reset(seed=0)
    squares = info["randomization"]["rotor_thrust_coefficient"] * vec.world.state.rotor_speed**2
    np.testing.assert_allclose(squares, squares[..., :1].repeat(4, 2), rtol=1e-12)
    assert np.ptp(vec.world.state.rotor_speed, axis=2).min() > 0


def test_without_a_limit_any_tension_will_do():
    vec = make("recover", num_envs=2, **{"task_options.success_tension": None, "reward.snatch": -2.0})
    vec.reset(seed=0)
    for _ in range(40):
        vec.step(zeros(vec))
    assert vec.task.own.peak_tension.min() > 10 and not vec.task.terms[:, vec.reward_terms.index("snatch")].any()
    vec.task.good_time[:] = 1.0
    assert vec.task.succeeded().all() and "tension" not in [each.name for each in vec.task.criteria()]


def test_success_limits_the_tension_of_the_whole_episode():
    vec = make("recover", num_envs=8, **{"reward.snatch": -2.0})
    vec.reset(seed=0)
    limit, column, peak, paid = vec.task.options.success_tension, vec.reward_terms.index("snatch"), np.zeros(8), 0.0
    for _ in range(50):
        before = (vec.world.state.cable_tension / vec.world.system.resting_tension).max(axis=1)
        vec.step(zeros(vec))
        assert (vec.task.own.peak_tension >= before - 1e-12).all()
        assert (vec.task.own.peak_tension >= peak).all()
        peak, paid = vec.task.own.peak_tension.copy(), paid + vec.task.terms[:, column]
    assert peak.min() > 10
    np.testing.assert_allclose(paid, -2.0 * np.maximum(peak - 0.75 * limit, 0.0) / limit, atol=1e-12)
    vec.task.good_time[:], vec.task.own.peak_tension[:] = 1.0, [limit - 1, limit, limit + 1, 1, 1, 1, 1, 500]
    assert vec.task.succeeded().tolist() == [True, True, False, True, True, True, True, False]
    vec.reset()
    assert not vec.task.own.peak_tension.any() and not vec.task.own.counted_tension.any()


@pytest.mark.slow
def test_peaks_of_a_cord_are_those_of_a_finer_time_step():
    means = []
    for timestep in (0.004, 0.001):
        vec = make("recover", num_envs=32, **{"sim.timestep": timestep})
        vec.reset(seed=0)
        for _ in range(30):
            vec.step(zeros(vec))
        means.append(vec.task.own.peak_tension.mean())
    assert means[0] == pytest.approx(means[1], rel=0.08)  # rigid cables: in proportion to the step
    assert 25 < means[1] < vec.task.options.success_tension


@pytest.mark.slow
@pytest.mark.parametrize("config", ["recover", "recover_crazymarl"])
def test_the_formation_recovers_from_most_starts(config):
    vec = starts(config, 32)
    success, over = np.zeros((2, 32), bool)
    for _ in range(vec.max_steps):
        _, _, terminated, truncated, info = vec.step(zeros(vec))
        new = (terminated | truncated) & ~over
        success[new], over = info["success"][new], over | terminated | truncated
        if (terminated | truncated).any() and not over.all():
            vec.reset(mask=terminated | truncated)
    assert success.mean() > 0.8
