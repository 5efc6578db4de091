"""Rotor wash, ground effect and the moments of wind on a drone; what is refused; what costs nothing when off."""

from __future__ import annotations

from math import log, pi, sqrt

import numpy as np
import pytest
from conftest import (
    GRAVITY,
    free_world,
    hover_thrust,
    load,
    make_system,
    refuse_system,
    same,
    steady,
    weightless,
    with_vehicle,
)

from multilift_marl.math3d import rot_z
from multilift_marl.rig.presets import PRESETS
from multilift_marl.sim import World
from multilift_marl.sim.air import AIR_DENSITY, SPREADING, ground_gain, make_air, wash_at

GROWTH = SPREADING / sqrt(2 * log(2))


def wash_world(num_drones: int = 1, **overrides) -> World:
    return World(make_system(num_drones, **{"cable.length": 20.0, "wind.wash": True, **overrides}), 1, 1)


def below(world: World, point, breadth: float = 0.0) -> np.ndarray:
    place = tuple(float(x) for x in point)
    return np.array(wash_at(0, place, breadth, world.state, make_air(world.system)))


def hover_at(world: World, *places) -> None:
    """Put upright drones at the places, each lifting itself."""
    world.state.drone_position[0] = places
    world.state.drone_rotation[:] = np.eye(3)
    steady(world, world.system.vehicle.mass * GRAVITY / 4)


# Wash


def test_wash_at_a_rotor_is_twice_the_induced_velocity_of_momentum_theory():
    world = wash_world()
    hover_at(world, (0, 0, 10))
    vehicle = world.system.vehicle
    induced = sqrt(vehicle.mass * GRAVITY / 4 / (2 * AIR_DENSITY * pi * vehicle.rotor_radius**2))
    x, y, _ = vehicle.rotor_positions[0]
    np.testing.assert_allclose(below(world, (x, y, 10 - 1e-9)), [0, 0, -2 * induced], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("breadth", [0.0, 0.2])
@pytest.mark.parametrize("depth", [0.05, 0.7, 3.0])
def test_the_jets_momentum_is_the_thrust_at_any_depth(depth, breadth):
    world = wash_world()
    hover_at(world, (0, 0, 10))
    half = world.system.vehicle.arm + 4 * sqrt(0.06**2 + (GROWTH * depth) ** 2 + breadth**2)
    grid = np.linspace(-half, half, 121)
    squares = sum(below(world, (x, y, 10 - depth), breadth=breadth)[2] ** 2 for x in grid for y in grid)
    thrust = world.system.vehicle.mass * GRAVITY
    assert AIR_DENSITY * squares * (grid[1] - grid[0]) ** 2 == pytest.approx(thrust, rel=1e-4)


def test_far_below_the_wash_falls_off_like_a_round_jet():
    world = wash_world()
    hover_at(world, (0, 0, 100))
    thrust = world.system.vehicle.mass * GRAVITY
    for depth in (20.0, 40.0):
        centre = sqrt(thrust / (pi * AIR_DENSITY)) / (GROWTH * depth)
        assert below(world, (0, 0, 100 - depth))[2] == pytest.approx(-centre, rel=4e-3)
        beside = below(world, (SPREADING * depth, 0, 100 - depth))[2]
        assert beside == pytest.approx(-0.5 * centre, rel=4e-3)


def test_there_is_no_wash_above_beside_and_from_oneself():
    world = wash_world()
    hover_at(world, (0, 0, 10))
    for point in ((0, 0, 10.5), (0, 0, 10), (0.5, 0, 9.9), (3, 0, 8)):
        assert not below(world, point).any(), point
    load(world)
    world.step(steady(world, 1.5))
    assert below(world, (0, 0, 9)).any() and not world.air.downwash[0, 0].any()


def test_wash_follows_a_tilted_drone():
    world = wash_world()
    hover_at(world, (0, 0, 10))
    c, s = np.cos(0.5), np.sin(0.5)
    world.state.drone_rotation[0, 0] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    axis = np.array([s, 0, c])
    found = below(world, (0, 0, 10) - 2 * axis)
    np.testing.assert_allclose(found / np.linalg.norm(found), -axis, atol=1e-12)


def test_momentum_fluxes_of_jets_add_up():
    world, flux, nowhere = wash_world(2), [], (1e3, 0, 0)
    for places in (((0, 0, 10), nowhere), (nowhere, (0, 0, 12)), ((0, 0, 10), (0, 0, 12))):
        hover_at(world, *places)
        flux.append(np.linalg.norm(below(world, (0.1, 0.2, 9))) ** 2)
    assert min(flux) > 1 and flux[2] == pytest.approx(flux[0] + flux[1], rel=1e-12)


def test_wash_drags_the_drones_and_the_payload_below():
    world = wash_world(2, **{"vehicle.drag": [0.3, 0.3, 0.2], "wind.inflow": False})
    hover_at(world, (0, 0, 12), (0.1, 0, 10.5))
    world.state.payload_position[0] = [0, 0.1, 9]
    load(world)
    system, vehicle = world.system, world.system.vehicle
    world.step(steady(world, vehicle.mass * GRAVITY / 4))
    drone, payload = world.air.downwash[0, 1], world.air.downwash[0, 2]
    world.state.drone_position[0, 1] = [1e3, 0, 0]
    np.testing.assert_allclose(drone, below(world, (0.1, 0, 10.5), vehicle.arm), atol=2e-2)
    assert drone[2] < -2 and payload[2] < drone[2] and not world.air.downwash[0, 0].any()
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], 0, atol=1e-12)
    expected = 0.004 * 0.2 * drone[2] / vehicle.mass
    assert world.state.drone_velocity[0, 1, 2] == pytest.approx(expected, rel=1e-6)
    drag = 0.5 * AIR_DENSITY * system.payload_drag_area * payload[2] ** 2 / system.payload_mass
    assert world.state.payload_velocity[0, 2] == pytest.approx(-0.004 * (GRAVITY + drag), rel=1e-3)


def test_drag_in_a_wash_does_not_exceed_its_momentum():
    world = wash_world()
    hover_at(world, (0, 0, 10))
    system, thrust = world.system, world.system.vehicle.mass * GRAVITY
    breadth = make_air(system).payload_breadth
    for depth in (0.01, 0.3, 1.0, 3.0):
        speed = below(world, (0, 0, 10 - depth), breadth=breadth)[2]
        assert 0.5 * AIR_DENSITY * system.payload_drag_area * speed**2 < thrust


def test_permuting_the_drones_permutes_the_wash():
    world, places = wash_world(3), np.array([(0, 0, 12), (0.1, 0, 10.5), (-0.1, 0.1, 11)])
    found = []
    for order in ([0, 1, 2], [2, 0, 1]):
        hover_at(world, *places[order])
        world.state.payload_position[0] = [0, 0, 9]
        load(world)
        world.step(steady(world, 1.5))
        found.append(world.air.downwash[0, np.argsort([*order, 3])])
    np.testing.assert_allclose(found[0], found[1], rtol=1e-12)


def test_a_team_in_formation_hardly_blows_on_its_payload():
    world = World(make_system(4, **{"wind.wash": True}), 1, 1)
    world.step(hover_thrust(world), 5)
    assert np.abs(world.air.downwash[0, :4]).max() == 0 and -0.3 < world.air.downwash[0, 4, 2] < 0


# Ground effect


@pytest.mark.parametrize("ratio", [0.6, 1.0, 3.0])
def test_one_rotor_feels_the_ground_as_cheeseman_and_bennett_say(ratio):
    system = make_system(1)
    c = make_air(with_vehicle(system, arm=1e4))
    assert ground_gain(ratio * c.rotor_radius[0], 0, c) == pytest.approx(1 / (1 - (1 / (4 * ratio)) ** 2), rel=1e-9)


@pytest.mark.parametrize("preset", ["falcon", "hummingbird"])
def test_four_rotors_in_a_square_feel_the_ground_as_sanchez_cuevas_says(preset):
    c = make_air(make_system(1, **{"vehicle.preset": preset}))
    r, d = c.rotor_radius[0], sqrt(2) * c.arm[0]
    for z in (r, 2 * r, 5 * r):
        images = (r / (4 * z)) ** 2 + r**2 * z / (d**2 + 4 * z**2) ** 1.5 + r**2 / 2 * z / (2 * d**2 + 4 * z**2) ** 1.5
        assert ground_gain(z, 0, c) == pytest.approx(1 / (1 - images), rel=1e-12)


def test_ground_effect_vanishes_with_height_and_is_bounded_below():
    for preset in PRESETS:
        c = make_air(make_system(1, **{"vehicle.preset": preset}))
        gains = [ground_gain(z * c.rotor_radius[0], 0, c) for z in (0.5, 1, 2, 4, 8, 16, 1000)]
        assert gains == sorted(gains, reverse=True) and 1 < gains[-2] < 1.002 and abs(gains[-1] - 1) < 1e-6
        assert gains[0] < 1.5 and ground_gain(-1.0, 0, c) == ground_gain(0.0, 0, c) == gains[0]


def test_ground_effect_lifts_and_strengthens_roll_but_not_yaw():
    world = free_world(**{"wind.ground_effect": True})
    vehicle, height = world.system.vehicle, 0.1
    world.state.drone_position[0, 0], world.state.payload_position[0] = [0, 0, height], [3, 0, 0.5]
    load(world)
    thrust = np.array([1.4, 1.6, 1.5, 1.3])
    world.step(steady(world, thrust))
    gain = ground_gain(height, 0, make_air(world.system))
    rise = gain * thrust.sum() / vehicle.mass - GRAVITY
    assert world.state.drone_velocity[0, 0, 2] == pytest.approx(0.004 * rise, rel=1e-6)
    lever = vehicle.arm / sqrt(2)
    roll, pitch = lever * thrust @ [1, 1, -1, -1], lever * thrust @ [-1, 1, 1, -1]
    yaw = vehicle.torque_ratio * thrust @ vehicle.rotor_spin
    expected = 0.004 * np.array([gain * roll, gain * pitch, yaw]) / vehicle.inertia
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], expected, rtol=1e-3, atol=1e-6)


# Moments


@pytest.mark.parametrize("yaw", [0.0, pi / 2])
def test_the_reports_moment_is_about_the_roll_axis_and_linear_in_the_air_across(yaw):
    world = free_world(**{"wind.roll_moment": 0.02, "wind.velocity": [1.0, 3.0, 0.0]})
    world.state.drone_rotation[:] = np.reshape(rot_z(yaw), (3, 3))
    world.state.drone_velocity[:] = [0.5, 0.0, 0.0]
    load(world)
    world.step(weightless(world))
    across = -3.0 if yaw == 0 else 1.0 - 0.5  # of the drone through the air, along body y
    expected = [0.004 * 0.02 * across / world.system.vehicle.inertia[0], 0, 0]
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], expected, rtol=1e-6, atol=1e-12)


def test_rolling_moments_of_rotors_follow_their_turning_and_cancel_at_equal_speeds():
    world = free_world(vehicle={"rolling_moment": 1e-6}, **{"wind.velocity": [-4.0, 2.0, 0.0]})
    world.step(weightless(world))
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], 0, atol=1e-12)
    vehicle, speed = world.system.vehicle, np.array([1100.0, 900.0, 1100.0, 900.0])
    load(world)
    world.state.drone_velocity[:] = 0
    load(world)
    world.step(steady(world, vehicle.thrust_coefficient * speed**2))
    turning = 1e-6 * speed @ vehicle.rotor_spin
    expected = 0.004 * turning * np.array([4.0, -2.0]) / np.array(vehicle.inertia[:2])
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0, :2], expected, rtol=1e-3)


# Off, and refused


def test_what_is_off_leaves_no_trace():
    world = World(make_system(2, **{"wind.velocity": [2, 0, 0]}), 2, 1)
    world.step(hover_thrust(world), 20)
    assert not any(array.any() for array in world.air)


def test_overlapping_rotors_are_refused_only_where_it_matters():
    message = refuse_system(wind__wash=True, vehicle__rotor_radius=0.09)
    assert "vehicle.rotor_radius=0.09 m" in message and "0.15 m" in message
    assert "wind.ground_effect" in refuse_system(wind__ground_effect=True, vehicle__arm=0.08)
    make_system(4, **{"vehicle.rotor_radius": 0.09})


@pytest.mark.parametrize(
    "key, value",
    [
        ("wind__gust_rise", 0.0), ("wind__gust_start", -1.0), ("wind__gust_hold", -0.1), ("wind__gust", [1.0, 2.0]),
        ("wind__turbulence", "strong"), ("wind__wash", 2.5), ("wind__roll_moment", float("nan")),
        ("vehicle__rotor_radius", 0.0), ("vehicle__rotor_solidity", 0.0), ("wind__inflow", 2.5),
        ("vehicle__rolling_moment", -1e-6),
    ],
)  # fmt: skip
def test_impossible_air_is_refused_by_name(key, value):
    assert key.replace("__", ".") in refuse_system(**{key: value})


def test_a_saved_world_with_all_of_the_air_goes_on_bit_for_bit():
    everything = {
        "wind.velocity": [5.0, 1.0, 0.0], "wind.turbulence": True, "wind.gust": [2.0, 0, 0], "wind.wash": True,
        "wind.gust_start": 0.01, "wind.ground_effect": True, "wind.roll_moment": 0.01, "vehicle.rolling_moment": 1e-6,
    }  # fmt: skip
    system = make_system(3, **everything)
    first, second = World(system, 5, 1), World(system, 5, 3, seed=8)
    first.step(hover_thrust(first), 40)
    second.load_state_dict(first.state_dict())
    for world in (first, second):
        world.step(hover_thrust(world), 40)
    assert same(first.state_dict(), second.state_dict()) and first.air.steps[0] == 80
