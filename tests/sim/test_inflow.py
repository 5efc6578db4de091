"""Rotors in air that moves along their axes, against blade elements and momentum theory, integrated along the blade."""

from __future__ import annotations

from math import pi, sqrt

import numpy as np
import pytest
from conftest import GRAVITY, free_world, load, make_system, refuse_system, steady, weightless

from multilift_marl.physical import AIR_DENSITY
from multilift_marl.rig.presets import PRESETS
from multilift_marl.sim import World
from multilift_marl.sim.air import axial_thrust, make_air
from multilift_marl.validation.air import blade_elements

INFLOW = {"wind.inflow": True}
LIFT_SLOPE = 5.73  # [1/rad]


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("climb", [-3.0, 0.0, 1.0, 7.0, 15.0])
def test_thrust_and_torque_in_a_climb_are_those_of_blade_elements_in_the_air_that_they_drive(preset, climb):
    vehicle = PRESETS[preset]
    c = make_air(make_system(1, **{"vehicle.preset": preset, **INFLOW}))
    speed = 0.7 * vehicle.rotor_speed_max
    still = vehicle.thrust_coefficient * speed**2
    thrust, torque = axial_thrust(still, climb, 0, c)
    expected, through = blade_elements(vehicle, speed, climb)
    expected = max(expected, 0.0)
    assert thrust == pytest.approx(expected, rel=1e-5, abs=1e-5 * still)
    induced = sqrt(still / (2 * AIR_DENSITY * pi * vehicle.rotor_radius**2))
    power = expected * through - still * induced  # that goes into the air, beyond that at rest
    assert torque * speed == pytest.approx(power, rel=1e-4, abs=1e-4 * still * induced)


def test_a_hovering_falcon_loses_three_and_a_half_per_cent_of_its_thrust_for_each_metre_a_second():
    vehicle = PRESETS["falcon"]
    c = make_air(make_system(1, **INFLOW))
    hover = vehicle.mass * GRAVITY / 4
    slope = (axial_thrust(hover, 1e-4, 0, c)[0] - axial_thrust(hover, -1e-4, 0, c)[0]) / 2e-4 / hover
    # linearised: -(1 / v_h) s / (4 λ + s) with s = σ a / 4, λ the inflow ratio of hover
    induced = sqrt(hover / (2 * AIR_DENSITY * pi * 0.0635**2))
    ratio = induced / (sqrt(hover / 1.562522e-6) * 0.0635)
    lift = 0.1 * LIFT_SLOPE / 4
    assert slope == pytest.approx(-lift / (4 * ratio + lift) / induced, rel=1e-6)
    assert slope == pytest.approx(-0.0348, abs=1e-4)


def test_a_rotor_at_rest_has_no_thrust_in_any_wind():
    c = make_air(make_system(1, **INFLOW))
    for climb in (-5.0, 0.0, 5.0):
        assert axial_thrust(0.0, climb, 0, c) == (0.0, 0.0)


@pytest.mark.parametrize("preset", PRESETS)
def test_a_climb_that_would_turn_the_thrust_around_leaves_none(preset):
    c = make_air(make_system(1, **{"vehicle.preset": preset, **INFLOW}))
    hover = PRESETS[preset].mass * GRAVITY / 4
    thrust, torque = axial_thrust(hover, 60.0, 0, c)
    assert thrust == 0.0 and PRESETS[preset].torque_ratio * hover + torque > 0.0  # power is not taken from the air


@pytest.mark.parametrize("cause", ["climb", "wind"])
def test_climbing_and_air_from_above_take_the_same_of_a_drones_thrust(cause):
    world = free_world(**INFLOW)
    vehicle, air = world.system.vehicle, 3.0
    if cause == "climb":
        world.state.drone_velocity[0, 0] = [0, 0, air]
    else:
        world.hidden_loads.wind[0] = [0, 0, -air]
    load(world)
    before = world.state.drone_velocity[0, 0, 2]
    world.step(weightless(world))
    thrust = 4 * blade_elements(vehicle, sqrt(vehicle.mass * GRAVITY / 4 / vehicle.thrust_coefficient), air)[0]
    assert thrust < 0.93 * vehicle.mass * GRAVITY
    gained = world.state.drone_velocity[0, 0, 2] - before
    assert gained == pytest.approx(0.004 * (thrust / vehicle.mass - GRAVITY), rel=1e-4)


def test_inflow_follows_the_rotors_axes():
    world = free_world(**INFLOW)
    world.state.drone_rotation[0, 0] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # thrust along -y
    world.hidden_loads.wind[0] = [2.0, 3.0, 1.0]
    load(world)
    world.step(weightless(world))
    vehicle = world.system.vehicle
    thrust = 4 * blade_elements(vehicle, sqrt(vehicle.mass * GRAVITY / 4 / vehicle.thrust_coefficient), 3.0)[0]
    assert world.state.drone_velocity[0, 0, 1] == pytest.approx(-0.004 * thrust / vehicle.mass, rel=1e-4)


def test_rotors_damp_roll_and_pitch_as_each_meets_the_air_by_itself():
    world = free_world(**INFLOW)
    vehicle, rates = world.system.vehicle, np.array([2.0, 0.0, 0.0])
    thrust = np.array([1.0, 2.0, 1.6, 1.2])
    world.state.drone_body_rates[0, 0] = rates
    load(world)
    world.step(steady(world, thrust))
    torque = np.zeros(3)
    for place, still, sign in zip(vehicle.rotor_positions, thrust, vehicle.rotor_spin, strict=True):
        climb = rates[0] * place[1] - rates[1] * place[0]
        speed = sqrt(still / vehicle.thrust_coefficient)
        force, through = blade_elements(vehicle, speed, climb)
        induced = sqrt(still / (2 * AIR_DENSITY * pi * vehicle.rotor_radius**2))
        reaction = vehicle.torque_ratio * still + (force * through - still * induced) / speed
        torque += [place[1] * force, -place[0] * force, sign * reaction]
    still_world = free_world(**{"wind.inflow": False, "wind.ground_effect": True})
    still_world.state.drone_body_rates[0, 0] = rates
    load(still_world)
    still_world.step(steady(still_world, thrust))
    still_torque = vehicle.allocation[1:] @ thrust
    found = (world.state.drone_body_rates - still_world.state.drone_body_rates)[0, 0] / 0.004 * vehicle.inertia
    np.testing.assert_allclose(found, torque - still_torque, rtol=2e-3, atol=1e-6)
    assert found[0] < 0  # against the rate


def test_a_drone_below_another_loses_thrust_in_its_wash():
    vehicle = PRESETS["falcon"]
    fallen = {}
    for name, values in (("off", {"wind.inflow": False}), ("as wash", {}), ("on", INFLOW)):
        world = World(make_system(2, **{"cable.length": 20.0, "wind.wash": True, **values}), 1, 1)
        world.state.drone_position[0] = [(0, 0, 60.3), (0, 0, 60)]
        world.state.drone_rotation[:] = np.eye(3)
        world.state.payload_position[0] = [5, 0, 50]
        load(world)
        world.step(weightless(world))
        fallen[name] = world.state.drone_velocity[0, :, 2].copy()
    wash = -world.air.downwash[0, 1, 2]
    assert wash == pytest.approx(7.0, abs=1.0)
    assert fallen["off"] == pytest.approx([0, 0], abs=1e-12)  # a falcon has no drag along its axis
    thrust = 4 * blade_elements(vehicle, sqrt(vehicle.mass * GRAVITY / 4 / vehicle.thrust_coefficient), wash)[0]
    expected = 0.004 * (thrust / vehicle.mass - GRAVITY)
    assert fallen["on"] == pytest.approx([0, expected], rel=1e-4, abs=1e-12)
    assert fallen["as wash"].tolist() == fallen["on"].tolist()
    assert thrust < 0.75 * vehicle.mass * GRAVITY


def test_inflow_that_a_time_step_cannot_follow_is_refused():
    wide = {"vehicle.rotor_radius": 1.0, "vehicle.rotor_solidity": 1.0}
    message = refuse_system(1, **{"wind.inflow": True, **wide})
    assert "vehicle.rotor_radius=1 m" in message and "wind.inflow=false" in message
    make_system(1, **wide)
