"""Sensors and places on Earth: closed forms, dead reckoning over a flight, statistics of errors, rates, delays."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, hover_thrust, load, make_system

from multilift_marl.errors import ConfigError
from multilift_marl.sensing import sensors, suite
from multilift_marl.sensing.sensors import SIZES, Sensors
from multilift_marl.sensing.suite import Sensor, SensorSuite, random_walk, white
from multilift_marl.sim import World
from multilift_marl.sim.earth import (
    Site,
    altitude_at,
    pressure_at,
    swap_attitude,
    swap_enu_ned,
    swap_flu_frd,
    swap_yaw,
)

DT = 0.004


def turn(vector: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3) by rotation vectors (..., 3), by Rodrigues's formula."""
    vector = np.asarray(vector, float)
    angle = np.linalg.norm(vector, axis=-1)[..., None, None]
    x, y, z = np.moveaxis(vector, -1, 0)
    zero = np.zeros_like(x)
    skew = np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=-1).reshape(*vector.shape, 3)
    return np.eye(3) + np.sinc(angle / np.pi) * skew + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * skew @ skew


def random_attitudes(count: int) -> np.ndarray:
    return turn(np.random.default_rng(0).normal(size=(count, 3)) * 2)


def make_sensors(suite: SensorSuite, world: World, dt: float = DT) -> Sensors:
    sensors = Sensors(suite, world.state, dt)
    for e in range(world.num_envs):
        sensors.reset(e, np.random.SeedSequence((7, e)))
    return sensors


def make_world(num_envs: int = 1, num_drones: int = 2) -> World:
    return World(make_system(num_drones), num_envs, 1)


# Frames and places


def test_frames_of_flight_software():
    east, north, up = np.eye(3)
    np.testing.assert_array_equal(swap_enu_ned([east, north, up]), [[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    np.testing.assert_array_equal(swap_flu_frd([[1, 2, 3]]), [[1, -2, -3]])
    level = swap_attitude(np.eye(3))  # facing east, right is south
    np.testing.assert_allclose(level @ [1, 0, 0], [0, 1, 0])
    np.testing.assert_allclose(level @ [0, 1, 0], [-1, 0, 0])
    attitudes = random_attitudes(20)
    np.testing.assert_allclose(swap_attitude(swap_attitude(attitudes)), attitudes, atol=1e-15)
    vector = np.random.default_rng(0).normal(size=(20, 3))  # of a body, in the world either way
    turned = np.einsum("kij,kj->ki", attitudes, vector)
    other = np.einsum("kij,kj->ki", swap_attitude(attitudes), swap_flu_frd(vector))
    np.testing.assert_allclose(other, swap_enu_ned(turned), atol=1e-14)


@pytest.mark.parametrize("enu, ned", [(0, 90), (90, 0), (180, -90), (-90, -180), (30, 60), (-170, -100), (725, 85)])
def test_headings_are_from_north_clockwise(enu, ned):
    assert np.degrees(swap_yaw(np.radians(enu))) == pytest.approx(ned)
    assert np.remainder(swap_yaw(swap_yaw(np.radians(enu))) - np.radians(enu) + 1, 2 * np.pi) == pytest.approx(1)
    forward = turn([0, 0, np.radians(enu)])
    north, east, _ = swap_attitude(forward)[:, 0]
    assert np.arctan2(east, north) == pytest.approx(np.radians(ned), abs=1e-9) or ned == -180


@pytest.mark.parametrize("latitude", [-89.0, -33.0, 0.0, 47.397742, 85.0])
def test_metres_are_arcs_of_the_ellipsoid(latitude):
    site = Site(latitude=latitude, longitude=8.5, altitude=488.0)
    e2 = 0.00669437999014
    curved = 1 - e2 * np.sin(np.radians(latitude)) ** 2
    meridian, normal = 6378137 * (1 - e2) / curved**1.5, 6378137 / np.sqrt(curved)
    east, north, up = site.to_geodetic(np.eye(3)) - [latitude, 8.5, 488.0]
    assert np.radians(east[1]) * (normal + 488) * np.cos(np.radians(latitude)) == pytest.approx(1, rel=1e-6)
    assert np.radians(north[0]) * (meridian + 488) == pytest.approx(1, rel=1e-6)
    assert up == pytest.approx([0, 0, 1], abs=1e-8)
    assert east[2] == pytest.approx(0.5 / normal, abs=1e-8)  # the ground falls away
    places = np.random.default_rng(0).uniform(-1e4, 1e4, (50, 3))
    np.testing.assert_allclose(site.to_world(site.to_geodetic(places)), places, atol=2e-8)


def test_the_atmosphere_is_that_of_the_standard():
    np.testing.assert_allclose(pressure_at([0, 500, 1000, 5000]), [101325, 95460.8, 89874.6, 54019.9], rtol=2e-5)
    np.testing.assert_allclose(altitude_at(pressure_at([0, 123.4, 9000])), [0, 123.4, 9000], atol=1e-8)


# What sensors measure


def test_at_rest_they_say_where_down_and_north_are():
    world = make_world()
    attitude = turn([0.3, -0.2, 0.8])
    world.state.drone_rotation[:] = attitude
    world.state.drone_position[:] = [[[1, 2, 3], [-4, 5, 6]]]
    sensors = make_sensors(SensorSuite.ideal(), world)
    for _ in range(3):
        sensors.read()
        np.testing.assert_allclose(sensors.specific_force[0, 0], attitude.T @ [0, 0, GRAVITY], atol=1e-12)
        np.testing.assert_allclose(sensors.body_rates, 0, atol=1e-12)
        north_east = attitude @ sensors.magnetic_field[0, 0]
        assert np.degrees(np.arctan2(north_east[0], north_east[1])) == pytest.approx(3.3)
        assert np.degrees(np.arcsin(-north_east[2] / 48.4)) == pytest.approx(63.4)
        np.testing.assert_allclose(altitude_at(sensors.pressure[0]), [491, 494], atol=1e-6)
        np.testing.assert_array_equal(sensors.position, world.state.drone_position)
        np.testing.assert_array_equal(sensors.velocity, world.state.drone_velocity)


@pytest.mark.parametrize("rate", [250.0, 62.5])
def test_dead_reckoning_finds_the_end_of_a_flight(rate):
    world = make_world(2, 2)
    suite = SensorSuite.ideal()
    imu = Sensor(rate)
    suite = SensorSuite(imu, imu, suite.magnetometer, suite.barometer, suite.position, suite.velocity)
    sensors = make_sensors(suite, world)
    rng = np.random.default_rng(0)
    attitude = world.state.drone_rotation.copy()
    velocity, place = world.state.drone_velocity.copy(), world.state.drone_position.copy()
    substeps, step = round(DT / world.system.timestep), 1 / rate
    for _ in range(500):
        world.step(hover_thrust(world) * rng.uniform(0.9, 1.1, (2, 2, 4)), substeps)
        sensors.read()
        if sensors.is_fresh("gyroscope")[0]:
            middle = attitude @ turn(0.5 * step * sensors.body_rates)
            attitude = attitude @ turn(step * sensors.body_rates)
            acceleration = np.einsum("enij,enj->eni", middle, sensors.specific_force) - [0, 0, GRAVITY]
            place += step * (velocity + 0.5 * step * acceleration)
            velocity += step * acceleration
    assert np.linalg.norm(world.state.drone_velocity, axis=-1).max() > 1
    fine = rate == 250
    np.testing.assert_allclose(attitude, world.state.drone_rotation, atol=1e-9 if fine else 0.01)
    np.testing.assert_allclose(velocity, world.state.drone_velocity, atol=1e-9 if fine else 0.1)
    np.testing.assert_allclose(place, world.state.drone_position, atol=0.01 if fine else 0.1)


def test_sensors_deliver_at_their_rates_and_late():
    world = make_world()
    suite = SensorSuite(Sensor(250), Sensor(125), Sensor(50), Sensor(25), Sensor(10, delay=0.12), Sensor(5, delay=0.02))
    sensors = make_sensors(suite, world)
    places, delivered = [world.state.drone_position.copy()], {name: [] for name in SIZES}
    for tick in range(1, 201):
        world.state.drone_position[:] += 0.01
        places.append(world.state.drone_position.copy())
        sensors.read()
        for name in SIZES:
            if sensors.is_fresh(name)[0]:
                delivered[name].append(tick)
        taken = max(0, (tick - 30) // 25 * 25)
        np.testing.assert_array_equal(sensors.position, places[taken])
    assert delivered["accelerometer"] == list(range(1, 201))
    assert delivered["gyroscope"] == list(range(2, 201, 2))
    assert delivered["magnetometer"] == list(range(5, 201, 5))
    assert delivered["barometer"] == list(range(10, 201, 10))
    assert delivered["position"] == list(range(30, 201, 25))
    assert delivered["velocity"] == list(range(5, 201, 50))


# Their errors


def test_errors_have_the_statistics_that_are_asked_for():
    noisy = Sensor(250, noise=(0.1, 0.2, 0.3), offset=(1.0, 2.0, 3.0), drift=(0.5, 0.5, 2.0), drift_time=0.2)
    ideal = SensorSuite.ideal()
    world = make_world(1000, 1)
    suite = SensorSuite(ideal.accelerometer, ideal.gyroscope, noisy, ideal.barometer, ideal.position, ideal.velocity)
    sensors = make_sensors(suite, world)
    readings = []
    for _ in range(200):
        sensors.read()
        readings.append(sensors.magnetic_field[:, 0].copy())
    error = np.stack(readings) - np.einsum(
        "eij,i->ej", world.state.drone_rotation[:, 0], Site().magnetic_field()
    )  # (200, 1000, 3)
    offset = sensors.readings.offset[:, 0, 6:9]
    np.testing.assert_allclose(offset.std(axis=0), [1, 2, 3], rtol=0.1)
    np.testing.assert_allclose(error.mean(axis=(0, 1)), 0, atol=0.4)
    rest = error - offset
    np.testing.assert_allclose(rest.var(axis=(0, 1)), [0.26, 0.29, 4.09], rtol=0.05)
    for lag in (1, 10, 50):  # white noise is gone, the drift is what exp(-t/τ) leaves of it
        both = (rest[lag:] * rest[:-lag]).mean(axis=(0, 1))
        np.testing.assert_allclose(both, np.array([0.25, 0.25, 4.0]) * np.exp(-lag * DT / 0.2), rtol=0.15)
    np.testing.assert_array_equal(sensors.position, world.state.drone_position)


def test_noise_densities_are_one_sided():
    assert white(70e-6 * GRAVITY, 250) == pytest.approx(7.7e-3, rel=0.01)  # the accelerometer at 250 Hz
    suite = SensorSuite()
    assert suite.gyroscope.noise == pytest.approx(5.5e-4, rel=0.01)


def test_a_drone_measures_the_same_in_any_batch():
    suite = SensorSuite()
    many, one = make_world(3), make_world(1)
    crowd, alone = make_sensors(suite, many), Sensors(suite, one.state, DT)
    alone.reset(0, np.random.SeedSequence((7, 2)))
    for _ in range(60):
        crowd.read()
        alone.read()
        np.testing.assert_array_equal(crowd.readings.values[2], alone.readings.values[0])
    assert not np.array_equal(crowd.readings.values[1], crowd.readings.values[2])
    assert not np.array_equal(crowd.readings.values[2, 0, :3], crowd.readings.values[2, 1, :3])


def test_readings_stay_finite_in_any_state():
    world = make_world(2, 2)
    sensors = make_sensors(SensorSuite(), world)
    rng = np.random.default_rng(0)
    for _ in range(100):
        world.state.drone_rotation[:] = turn(rng.normal(size=(2, 2, 3)) * 3)
        world.state.drone_velocity[:] = rng.uniform(-100, 100, (2, 2, 3))
        world.state.drone_position[:] = rng.uniform(-1000, 1000, (2, 2, 3))
        load(world)
        sensors.read()
        assert np.isfinite(sensors.readings.values).all()


@pytest.mark.parametrize(
    "change, words",
    [
        ({"rate": 300.0}, "accelerometer.rate=300 Hz must be above 0, and at most 1/0.004 s"),
        ({"rate": 100.0}, "accelerometer.rate makes 0.01 s, which is no whole number of steps of 0.004 s"),
        ({"rate": 0.0}, "accelerometer.rate=0 Hz must be above 0"),
        ({"rate": 250.0, "delay": 0.005}, "accelerometer.delay makes 0.005 s"),
    ],
)
def test_what_does_not_fit_the_steps_is_refused(change, words):
    ideal = SensorSuite.ideal()
    rest = ideal.gyroscope, ideal.magnetometer, ideal.barometer, ideal.position, ideal.velocity
    with pytest.raises(ConfigError) as error:
        Sensors(SensorSuite(Sensor(**change), *rest), make_world().state, DT)
    assert words in str(error.value)


def drifts(sensor: Sensor, ticks: int, num_envs: int = 300) -> np.ndarray:
    """Return the drift of a sensor's three axes at every tick from the reset on (ticks + 1, samples)."""
    ideal = Sensor(250.0)
    suite = SensorSuite(ideal, ideal, ideal, ideal, ideal, sensor)
    world = make_world(num_envs)
    sensors, read = make_sensors(suite, world), []
    for _ in range(ticks + 1):
        read.append((sensors.velocity - world.state.drone_velocity).ravel())
        sensors.read()
    return np.array(read)


def test_drift_of_the_imu_is_that_of_the_random_walks_of_its_source():
    """RotorS, gazebo_imu_plugin.h: 2 · 3e-3 m/s³/√Hz with 300 s; 2 · 4/3600 · π/180 rad/s²/√Hz with 1000 s."""
    suite = SensorSuite()
    assert suite.accelerometer.drift == pytest.approx(6e-3 * np.sqrt(300 / 2), rel=1e-12)  # 0.0735 m/s²
    assert suite.gyroscope.drift == pytest.approx(3.8785e-5 * np.sqrt(1000 / 2), rel=1e-4)  # 8.67e-4 rad/s
    assert (suite.accelerometer.drift_time, suite.gyroscope.drift_time) == (300, 1000)


@pytest.mark.parametrize("time", [0.2, 300.0])
def test_a_drift_that_begins_at_zero_grows_as_its_differential_equation_says(time):
    """Variance σ² τ/2 (1 - exp(-2 t/τ)): σ² t of a random walk while t << τ, σ² τ/2 in the end."""
    density, every = 6e-3, 25
    read = drifts(Sensor(250.0, drift=random_walk(density, time), drift_time=time, drifting=False), 250)
    t = DT * np.arange(len(read))  # the sample at the reset has made one step already
    expected = density * np.sqrt(time / 2 * -np.expm1(-2 * (t + DT) / time))
    np.testing.assert_allclose(read.std(axis=1)[::every], expected[::every], rtol=0.1)
    if time > 1:  # Allan's deviation of a random walk, averaged over T: σ √(T/3)
        parts = read[:250].reshape(5, 50, -1).mean(axis=1)
        allan = np.sqrt(0.5 * (np.diff(parts, axis=0) ** 2).mean())
        assert allan == pytest.approx(density * np.sqrt(50 * DT / 3), rel=0.1)


def test_a_drift_that_has_gone_on_for_long_keeps_its_deviation():
    read = drifts(Sensor(250.0, drift=0.05, drift_time=0.5), 250)
    np.testing.assert_allclose(read.std(axis=1)[::25], 0.05, rtol=0.1)
    together = (read[0] * read[125]).mean() / 0.05**2
    assert together == pytest.approx(np.exp(-1.0), abs=0.1)


def test_a_scaled_sensor_has_as_many_times_the_errors():
    usual = SensorSuite().position
    twice = usual.scaled(2.0)
    for part in ("noise", "offset", "drift"):
        np.testing.assert_allclose(
            np.broadcast_to(getattr(twice, part), 3), 2 * np.broadcast_to(getattr(usual, part), 3)
        )
    assert (twice.rate, twice.delay, twice.drift_time) == (usual.rate, usual.delay, usual.drift_time)
    assert not np.any(usual.scaled(0.0).noise)


@pytest.mark.parametrize("name", ["Sensor", "SensorSuite", "random_walk", "white"])
def test_what_sensors_are_made_of_is_found_where_it_was(name):
    assert getattr(sensors, name) is getattr(suite, name)
