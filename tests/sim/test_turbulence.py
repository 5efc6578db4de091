"""Turbulence and gusts: the military specification's statistics, exact in time, each episode's own."""

from __future__ import annotations

from math import cos, pi, sqrt

import numpy as np
import pytest
from conftest import free_world, hover_thrust, make, make_system, mask, refuse_system, same, weightless, zeros

from multilift_marl.sim import Air, World
from multilift_marl.sim.gusts import advance_turbulence, dryden, gust_factor, start_turbulence, turbulence
from multilift_marl.validation.air import COMPONENTS, correlation, sample_turbulence, spectrum

WINDY = {"wind.velocity": [4.0, -3.0, 0.0], "wind.turbulence": True}
FOOT = 0.3048

# Statistics


def test_intensities_and_scales_are_the_specifications():
    assert dryden(1000 * FOOT, 10.0) == pytest.approx((1.0, 1.0, 1000 * FOOT, 1000 * FOOT))
    shape = 0.177 + 0.000823 * 100
    expected = (1.0 / shape**0.4, 1.0, 100 / shape**1.2 * FOOT, 100 * FOOT)
    assert dryden(100 * FOOT, 10.0) == pytest.approx(expected)


def test_turbulence_near_the_ground_is_that_at_three_metres():
    assert dryden(0.0, 5.0) == dryden(3.0, 5.0) == dryden(-1.0, 5.0) != dryden(3.1, 5.0)


@pytest.mark.parametrize("component", COMPONENTS)
@pytest.mark.parametrize("height", [3.0, 30.0])
def test_spectrum_and_autocorrelation_are_each_others_transform(component, height):
    frequency = np.linspace(0, 400, 4_000_001)
    density = spectrum(component, height, frequency)
    for lag in (0.0, 0.3, 2.0):
        found = np.trapezoid(density * np.cos(2 * pi * frequency * lag), frequency)
        scale = correlation(component, height, 0.0)
        assert found == pytest.approx(correlation(component, height, lag), abs=2e-3 * scale)


@pytest.mark.slow
@pytest.mark.parametrize("height", [3.0, 30.0])
@pytest.mark.parametrize("timestep, every", [(5e-4, 400), (4e-3, 50), (0.2, 1)])
def test_variance_and_autocorrelation_do_not_depend_on_the_time_step(height, timestep, every):
    samples = sample_turbulence(height, timestep, 3, 10000, every)
    for i, name in enumerate(COMPONENTS):
        variance = correlation(name, height, 0.0)
        assert abs(samples[..., i].mean()) < 5 * sqrt(variance / 10000)
        for k in range(3):
            found = (samples[:, 2 - k, i] * samples[:, 2, i]).mean()
            assert found == pytest.approx(correlation(name, height, 0.2 * k), abs=0.07 * variance)


def test_components_do_not_depend_on_each_other_nor_on_other_series():
    samples = sample_turbulence(3.0, 0.2, 2, 20000)
    columns = np.concatenate([samples[:-1, 0], samples[1:, 0]], axis=1)
    assert np.abs(np.corrcoef(columns.T) - np.eye(6)).max() < 0.035


def test_turbulence_is_normally_distributed():
    samples = sample_turbulence(3.0, 0.2, 1, 100000)[:, 0]
    scaled = samples / samples.std(axis=0)
    np.testing.assert_allclose((scaled**4).mean(axis=0), 3.0, atol=0.12)
    np.testing.assert_allclose((np.abs(scaled) > 2).mean(axis=0), 0.0455, atol=0.004)


@pytest.mark.parametrize("wind, direction", [((5, 0, 1), (1, 0)), ((0, 5, 0), (0, 1)), ((-3, 4, 0), (-0.6, 0.8))])
def test_u_is_along_the_mean_wind_v_across_and_w_up(wind, direction):
    air, (c, s) = Air.zeros(1, 1), direction
    air.filter[0] = [1, 0, 0, 0, 0]
    assert turbulence(0, air, 0.7, 0.3, wind) == pytest.approx((0.7 * c, 0.7 * s, 0))
    air.filter[0] = [0, sqrt(2 / 3), 0, 0, 0]
    assert turbulence(0, air, 0.7, 0.3, wind) == pytest.approx((-0.7 * s, 0.7 * c, 0))
    air.filter[0] = [0, 0, 0, sqrt(2 / 3), 0]
    assert turbulence(0, air, 0.7, 0.3, wind) == pytest.approx((0, 0, 0.3))


# In the world


@pytest.mark.parametrize("wind, airspeed", [((5.0, 0, 0), 5.0), ((0.5, 0, 0), 1.0)])
def test_the_world_goes_by_the_payloads_height_and_airspeed_at_least_one_metre_a_second(wind, airspeed):
    world = free_world(**{"wind.velocity": wind, "wind.turbulence": True})
    expected = Air(*(array.copy() for array in world.air))
    across, upward, long, high = dryden(100.0, wind[0])
    gust = turbulence(0, expected, across, upward, wind)
    world.step(weightless(world))
    advance_turbulence(0, expected, 0.004 * airspeed / long, 0.004 * airspeed / high)
    np.testing.assert_array_equal(world.air.filter, expected.filter)
    np.testing.assert_array_equal(world.air.gust[0], gust)


def test_turbulence_starts_stationary_and_stays_so_in_flight():
    world = World(make_system(1, **WINDY), 3000, 2)
    thrust = hover_thrust(world)
    for steps in (1, 50):
        world.step(thrust, steps)
        across, upward, _, _ = dryden(1.5, 5.0)
        found = world.air.gust.std(axis=0)
        np.testing.assert_allclose(found, [across, across, upward], rtol=0.06)


def test_turbulence_may_be_as_strong_as_another_wind_than_there_is():
    world = World(make_system(1, **{"wind.turbulence": True, "wind.turbulence_speed": 5.0}), 3000, 2)
    world.step(hover_thrust(world))
    across, upward, _, _ = dryden(1.5, 5.0)
    np.testing.assert_allclose(world.air.gust.std(axis=0), [across, across, upward], rtol=0.06)
    none = World(make_system(1, **WINDY, **{"wind.turbulence_speed": 0.0}), 2, 1)
    none.step(hover_thrust(none), 10)
    assert not none.air.gust.any()
    assert "means nothing with wind.turbulence=false" in refuse_system(wind__turbulence_speed=3.0)


def test_without_wind_there_is_no_turbulence():
    world = World(make_system(1, **{"wind.turbulence": True, "randomization.wind": 1.0}), 2, 1)
    world.step(hover_thrust(world), 10)
    assert not world.air.gust.any()


def test_all_bodies_are_blown_alike():
    world = free_world(drag=True, **WINDY)
    world.step(weightless(world))
    wind, system = np.array([4.0, -3.0, 0.0]) + world.air.gust[0], world.system
    drone = np.array(system.vehicle.drag) * wind / system.vehicle.mass
    payload = 0.5 * 1.225 * system.payload_drag_area * np.linalg.norm(wind) * wind / system.payload_mass
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], 0.004 * drone, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(world.state.payload_velocity[0] + [0, 0, 0.004 * 9.81], 0.004 * payload, rtol=1e-9)


def test_a_reset_world_starts_its_turbulence_anew_and_a_seed_changes_it():
    system = make_system(2, **WINDY)
    world, fresh, other = World(system, 3, 1), World(system, 3, 2), World(system, 3, 1, seed=1)
    world.step(hover_thrust(world), 30)
    world.reset(mask(3, 1))
    for each in (world, fresh, other):
        each.step(hover_thrust(each), 20)
    assert same(world.air.gust[1], fresh.air.gust[1]) and not same(world.air.gust[0], fresh.air.gust[0])
    assert len({tuple(gust) for gust in (*fresh.air.gust, *other.air.gust)}) == 6
    other.reset()
    other.seed_turbulence(1, np.random.SeedSequence(7))
    assert not same(other.air.filter[1], World(system, 3, 1, seed=1).air.filter[1])


def test_a_negative_seed_is_refused():
    with pytest.raises(ValueError, match="seed=-1 must be at least 0"):
        World(make_system(1), 1, 1, seed=-1)


# Episodes


def fly(vec, steps: int, first: int = 0):
    """Fly environments by actions of their own; return observations and gusts of each step."""
    seen = []
    for step in range(first, first + steps):
        actions = [
            np.random.default_rng((vec.first_env + e, step)).uniform(-0.3, 0.3, (vec.num_drones, vec.action_size))
            for e in range(vec.num_envs)
        ]
        seen.append((vec.step(np.stack(actions))[:2], vec.world.air.gust.copy()))
    return seen


def test_an_episode_is_the_same_alone_in_a_batch_and_on_any_number_of_threads():
    alone = make(num_envs=1, first_env=5, **WINDY)
    batches = [make(num_envs=8, num_threads=threads, **WINDY) for threads in (1, 2)]
    for vec in (alone, *batches):
        vec.reset(seed=3)
    flights = [fly(vec, 20) for vec in (alone, *batches)]
    assert same(flights[1], flights[2])
    for ((obs, reward), gust), ((obs_8, reward_8), gust_8) in zip(flights[0], flights[1], strict=True):
        assert same(obs[0], obs_8[5]) and same(reward[0], reward_8[5]) and same(gust[0], gust_8[5])
    assert flights[0][0][1].any()


def test_turbulence_changes_no_other_draw_of_an_episode():
    windy, calm = make(num_drones=2, **WINDY), make(num_drones=2, **(WINDY | {"wind.turbulence": False}))
    observations = [vec.reset(seed=4)[0] for vec in (windy, calm)]
    assert same(*observations) and same(windy.state()[:, :-3], calm.state())  # the state ends with the gust
    first, second = fly(windy, 3), fly(calm, 3)
    assert not same(first[-1][0], second[-1][0]) and windy.state()[:, -3:].any(axis=1).all()


def test_each_episode_has_turbulence_of_its_own_and_a_seed_rewinds_it():
    vec = make(num_drones=1, num_envs=2, **WINDY)
    starts = []
    for seed in (0, None, 0):
        vec.reset(seed=seed)
        starts.append(vec.world.air.filter.copy())
    assert same(starts[0], starts[2]) and len({tuple(row) for row in (*starts[0], *starts[1])}) == 4


def test_a_saved_episode_goes_on_bit_for_bit():
    first = make(num_drones=2, **WINDY)
    first.reset(seed=1)
    fly(first, 7)
    saved = first.state_dict()
    second = make(num_drones=2, num_threads=2, **WINDY)
    second.reset(seed=9)
    second.load_state_dict(saved)
    assert same(fly(first, 7, first=7), fly(second, 7, first=7))
    assert same(first.state_dict(), second.state_dict())


# Gusts


def test_a_gust_rises_holds_and_falls_as_one_minus_cosine():
    for t, share in ((0, 0), (1, 0), (1.25, 0.5 - 0.5 * cos(pi / 4)), (1.5, 0.5), (2, 1), (4, 1), (4.5, 0.5), (5, 0)):
        assert gust_factor(float(t), 1.0, 1.0, 2.0) == pytest.approx(share, abs=1e-15)
    assert gust_factor(1e9, 1.0, 1.0, float("inf")) == 1.0 and gust_factor(6.0, 1.0, 1.0, 2.0) == 0.0


def test_a_gust_begins_anew_with_each_episode():
    vec = make(num_drones=1, num_envs=2, **{"wind.gust": [1, 0, 0], "wind.gust_start": 0.1, "wind.gust_rise": 0.1})
    vec.reset(seed=0)
    rounds = []
    for _ in range(2):
        speeds = []
        for _ in range(10):
            vec.step(zeros(vec))
            speeds.append(vec.world.air.gust[0, 0])
        rounds.append(speeds)
        vec.reset(mask=mask(2, 0))
    assert rounds[0] == rounds[1] and max(rounds[0][:4]) == 0 and rounds[0][-1] == pytest.approx(0.99, abs=0.011)


def test_start_is_drawn_from_the_stationary_distribution():
    air = Air.zeros(20000, 0)
    air.generator[:] = np.random.SeedSequence(0).generate_state(20000, np.uint64)
    for e in range(20000):
        start_turbulence(e, air)
    stationary = np.eye(5)
    stationary[1:3, 1:3] = stationary[3:5, 3:5] = [[1, 0.5], [0.5, 0.5]]
    np.testing.assert_allclose(np.cov(air.filter.T), stationary, atol=0.04)
