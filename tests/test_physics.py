"""The simulation against closed forms: cables, rotors, drag, momentum; and that it is the same for everyone."""

from __future__ import annotations

import logging
from dataclasses import replace
from math import cos, exp, pi, radians, sqrt, tanh
from pathlib import Path

import numpy as np
import pytest
from conftest import GRAVITY, hover_thrust, make_system, mask, same

from multilift_marl.config import System
from multilift_marl.math3d import rot_z
from multilift_marl.sim import World

OFF_CENTRE = [[0.25, 0.2, 0.08], [-0.3, 0.2, 0.08], [-0.3, -0.2, 0.08], [0.25, -0.2, 0.08]]
TIMESTEPS = (5e-4, 1e-3, 2e-3, 4e-3)


def without_drag(system: System, **vehicle) -> System:
    return replace(system, vehicle=replace(system.vehicle, drag=(0.0, 0.0, 0.0), **vehicle), payload_drag_area=0.0)


def free_world(num_envs: int = 1, drag: bool = False, vehicle: dict | None = None, **overrides) -> World:
    """Return one upright drone 2 m above its payload on a slack cable of 20 m, both at rest, rotors at hover speed."""
    system = make_system(1, **{"cable.length": 20.0, **overrides})
    system = system if drag else without_drag(system, **(vehicle or {}))
    world = World(system, num_envs, 1)
    world.state.payload_position[:] = [0, 0, 100]
    world.state.drone_position[:] = [0, 0, 102]
    world.state.rotor_speed[:] = sqrt(system.vehicle.mass * GRAVITY / 4 / system.vehicle.thrust_coefficient)
    load(world)
    return world


def load(world: World) -> None:
    world.load(np.ones(world.num_envs, bool))


def steady(world: World, thrust) -> np.ndarray:
    """Let the rotors turn at the speeds of `thrust` (4,) [N] already, and return it for every drone (E, N, 4)."""
    thrust = np.broadcast_to(np.asarray(thrust, float), (world.num_envs, world.num_drones, 4)).copy()
    world.state.rotor_speed[:] = np.sqrt(thrust / world.system.vehicle.thrust_coefficient)
    return thrust


def weightless(world: World) -> np.ndarray:
    """Return the thrust (E, N, 4) that holds a drone without a load."""
    return steady(world, world.system.vehicle.mass * GRAVITY / 4)


def stretch(world: World) -> np.ndarray:
    """Return length minus natural length of the cables (E, N) [m]."""
    state, system = world.state, world.system
    anchors = state.payload_position[:, None] + np.einsum("eij,nj->eni", state.payload_rotation, system.anchors)
    return np.linalg.norm(state.drone_position - anchors, axis=-1) - system.cable_length


def momenta(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return the momentum (E, 3) and the angular momentum about the origin (E, 3) of payload and drones."""
    system, state, mass = world.system, world.state, world.plant.payload_mass[:, None]
    inertia = system.payload_inertia * mass / system.payload_mass
    spin = np.einsum("eij,ej->ei", state.payload_rotation, inertia * state.payload_body_rates)
    spins = np.einsum("enij,enj->ei", state.drone_rotation, np.asarray(system.vehicle.inertia) * state.drone_body_rates)
    linear, linears = mass * state.payload_velocity, system.vehicle.mass * state.drone_velocity
    orbits = np.cross(state.payload_position, linear) + np.cross(state.drone_position, linears).sum(axis=1)
    return linear + linears.sum(axis=1), orbits + spin + spins


# Cables


@pytest.mark.parametrize("num_drones", [1, 2, 3, 4, 6])
def test_static_tension_is_the_shared_weight_over_the_cosine(num_drones):
    world = World(make_system(num_drones, **{"cable.angle": 25}), 2, 1)
    angle = radians(25) if num_drones > 1 else 0.0
    expected = world.system.payload_mass * GRAVITY / num_drones / cos(angle)
    np.testing.assert_allclose(world.state.cable_tension, expected, rtol=1e-9)
    world.step(hover_thrust(world), 50)
    np.testing.assert_allclose(world.state.cable_tension, expected, rtol=1e-8)


RIGS = [(n, {"payload.shape": shape}) for n in (1, 2, 3, 4, 6) for shape in ("box", "point")]


@pytest.mark.parametrize("num_drones, overrides", [*RIGS, (4, {"payload.anchors": OFF_CENTRE})], ids=str)
def test_the_formation_stays_at_rest_under_equilibrium_thrust(num_drones, overrides):
    world = World(make_system(num_drones, **overrides), 1, 1)
    before = world.state_dict()
    world.step(hover_thrust(world), 250)
    for name in ("payload_position", "payload_rotation", "drone_position", "drone_rotation"):
        np.testing.assert_allclose(getattr(world.state, name), before[f"state.{name}"], atol=1e-7)
    np.testing.assert_allclose(world.state.cable_tension, before["state.cable_tension"], rtol=1e-6)


@pytest.mark.parametrize("timestep", TIMESTEPS)
def test_static_stretch_is_the_load_over_the_stiffness_for_any_mass(timestep):
    world = World(without_drag(make_system(1, **{"sim.timestep": timestep})), 5, 1)
    mass = np.array([0.1, 0.2, 0.35, 0.7, 1.0])
    world.set_payload_mass(np.ones(5, bool), mass)
    thrust = np.broadcast_to((mass[:, None, None] + world.system.vehicle.mass) * GRAVITY / 4, (5, 1, 4))
    world.step(thrust, round(1.0 / timestep))
    np.testing.assert_allclose(stretch(world)[:, 0], mass * GRAVITY / 1e5, rtol=1e-4)
    np.testing.assert_allclose(world.state.cable_tension[:, 0], mass * GRAVITY, rtol=1e-4)


def test_each_cable_has_its_own_stiffness_and_length():
    stiffness, length = [5e4, 1e5, 2e5, 4e5], [0.9, 1.0, 1.1, 1.2]
    world = World(make_system(4, **{"cable.stiffness": stiffness, "cable.length": length}), 1, 1)
    world.step(hover_thrust(world), 250)
    np.testing.assert_allclose(stretch(world)[0] * stiffness, world.state.cable_tension[0], rtol=1e-4)


def test_changing_the_mass_and_back_leaves_no_trace():
    system, everyone = make_system(4), np.ones(2, bool)
    changed, untouched = World(system, 2, 1), World(system, 2, 1)
    for factor in (1.2, 0.8, 1.0):
        changed.set_payload_mass(everyone, np.full(2, factor * system.payload_mass))
    for world in (changed, untouched):
        world.step(1.02 * hover_thrust(world), 100)
    assert same(changed.state_dict(), untouched.state_dict())


@pytest.mark.parametrize("damping, tolerance", [(1000.0, 0.005), (300.0, 0.02)], ids=["overdamped", "ringing"])
def test_a_cable_is_a_kelvin_voigt_element(damping, tolerance):
    overrides = {"sim.timestep": 1e-4, "sim.control_hz": 1e4, "cable.damping": damping}
    system = without_drag(make_system(1, **overrides))
    world, load_mass, drone_mass = World(system, 1, 1), system.payload_mass, system.vehicle.mass
    reduced, stiffness = load_mass * drone_mass / (load_mass + drone_mass), 1e5
    start = -0.5 * load_mass * GRAVITY / stiffness
    world.state.payload_position[:, 2] -= start
    load(world)
    thrust = steady(world, (load_mass + drone_mass) * GRAVITY / 4)
    decay = damping / (2 * reduced)
    ringing = np.sqrt(complex(stiffness / reduced - decay**2))
    for step in range(1, 201):
        world.step(thrust)
        t = step * 1e-4
        expected = start * exp(-decay * t) * (np.cos(ringing * t) + decay / ringing * np.sin(ringing * t)).real
        actual = stretch(world)[0, 0] - load_mass * GRAVITY / stiffness
        assert actual == pytest.approx(expected, abs=tolerance * abs(start)), t


def test_a_slack_cable_pulls_with_exactly_nothing():
    world = World(make_system(4), 1, 1)
    world.state.drone_position[..., 2] -= 0.5
    load(world)
    world.step(hover_thrust(world), 25)
    assert (world.state.cable_tension == 0).all()
    assert world.record.tension_max[0] == 0
    assert world.record.slack_time[0] == pytest.approx(0.1)
    assert world.state.payload_velocity[0, 2] == pytest.approx(-0.98, rel=0.01)


def test_a_slack_cable_does_not_damp():
    world = free_world()
    world.step(weightless(world), 25)
    np.testing.assert_allclose(world.state.payload_velocity[0], [0, 0, -0.1 * GRAVITY], atol=1e-12)
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], 0, atol=1e-12)


def test_the_payload_comes_to_rest_on_the_ground():
    world = World(make_system(4), 1, 1)
    world.state.payload_position[:, 2] = 0.1
    world.state.drone_position[..., 2] = 0.8
    world.state.drone_rotation[:] = np.eye(3)
    load(world)
    world.step(weightless(world), 250)
    assert world.state.payload_position[0, 2] == pytest.approx(0.075, abs=2e-3)
    assert np.abs(world.state.payload_velocity).max() < 1e-3


# Rotors


@pytest.mark.parametrize("timestep", TIMESTEPS)
@pytest.mark.parametrize("start, thrust", [(1000.0, 3.0), (1500.0, 0.5)], ids=["faster", "slower"])
def test_rotor_speed_follows_its_command_exponentially(start, thrust, timestep):
    world = free_world(**{"sim.timestep": timestep})
    vehicle, steps = world.system.vehicle, round(0.04 / timestep)
    world.state.rotor_speed[:] = start
    world.step(np.full((1, 1, 4), thrust), steps)
    target = sqrt(thrust / vehicle.thrust_coefficient)
    expected = start + (target - start) * (1 - exp(-steps * timestep / vehicle.rotor_time_constant))
    np.testing.assert_allclose(world.state.rotor_speed, expected, rtol=1e-12)


@pytest.mark.parametrize("timestep", TIMESTEPS)
def test_impulse_of_the_thrust_is_exact_while_rotors_change_speed(timestep):
    world = free_world(**{"sim.timestep": timestep})
    vehicle, t, start, thrust = world.system.vehicle, 0.04, 1000.0, 3.0
    world.state.rotor_speed[:] = start
    world.step(np.full((1, 1, 4), thrust), round(t / timestep))
    target, tau = sqrt(thrust / vehicle.thrust_coefficient), vehicle.rotor_time_constant
    gap = start - target
    square = target**2 * t + 2 * target * gap * tau * (1 - exp(-t / tau)) + gap**2 * tau / 2 * (1 - exp(-2 * t / tau))
    expected = 4 * vehicle.thrust_coefficient * square / vehicle.mass - GRAVITY * t
    assert world.state.drone_velocity[0, 0, 2] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize("command, limit", [(1e6, "max"), (5.001, "max"), (0.0, "min"), (-3.0, "min")])
def test_rotors_keep_their_limits(command, limit):
    world = free_world()
    vehicle = world.system.vehicle
    world.step(np.full((1, 1, 4), command), 250)
    np.testing.assert_allclose(world.state.rotor_speed, getattr(vehicle, f"rotor_speed_{limit}"), rtol=1e-9)


def test_rotor_speed_limit_is_that_of_the_largest_thrust():
    vehicle = make_system(1).vehicle
    assert vehicle.thrust_coefficient * vehicle.rotor_speed_max**2 == pytest.approx(vehicle.rotor_thrust_max)


@pytest.mark.parametrize("rotor_speed", [500.0, 983.9, 1500.0])
def test_thrust_is_b_times_speed_squared_along_body_z(rotor_speed):
    world, tilt = free_world(), 0.4
    vehicle = world.system.vehicle
    world.state.drone_rotation[:] = [[cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, cos(tilt)]]
    load(world)
    world.step(steady(world, vehicle.thrust_coefficient * rotor_speed**2), 10)
    thrust = 4 * vehicle.thrust_coefficient * rotor_speed**2
    expected = 0.04 * (thrust / vehicle.mass * np.array([np.sin(tilt), 0, cos(tilt)]) - [0, 0, GRAVITY])
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], expected, atol=1e-12)


def test_hover_speed_of_the_falcon_is_the_published_one():
    vehicle = make_system(1).vehicle
    assert sqrt(vehicle.mass * GRAVITY / 4 / vehicle.thrust_coefficient) == pytest.approx(983.9, abs=0.1)


PLUS = (0.0, pi / 2, pi, 3 * pi / 2)


@pytest.mark.parametrize(
    "rotor, torque",
    [(0, (0, -1, 1)), (1, (1, 0, -1)), (2, (0, 1, 1)), (3, (-1, 0, -1))],
)
def test_a_faster_rotor_turns_a_plus_quadrotor_as_equation_8_says(rotor, torque):
    world = free_world(vehicle={"rotor_azimuth": PLUS})
    vehicle, more = world.system.vehicle, 0.01
    thrust = weightless(world)[0, 0]
    thrust[rotor] += more
    world.step(steady(world, thrust))
    expected = more * np.array(torque) * [vehicle.arm, vehicle.arm, vehicle.torque_ratio] / vehicle.inertia
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], 0.004 * expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("rotor, torque", [(0, (1, -1, 1)), (1, (1, 1, -1)), (2, (-1, 1, 1)), (3, (-1, -1, -1))])
def test_a_faster_rotor_turns_an_x_quadrotor_about_its_diagonal(rotor, torque):
    world = free_world()
    vehicle, more = world.system.vehicle, 0.01
    thrust = weightless(world)[0, 0]
    thrust[rotor] += more
    world.step(steady(world, thrust))
    lever = vehicle.arm / sqrt(2)
    expected = more * np.array(torque) * [lever, lever, vehicle.torque_ratio] / vehicle.inertia
    np.testing.assert_allclose(world.state.drone_body_rates[0, 0], 0.004 * expected, rtol=1e-9, atol=1e-12)


def test_energy_is_the_integral_of_rotor_torque_times_speed():
    world = World(make_system(4), 1, 1)
    vehicle, speed = world.system.vehicle, world.state.rotor_speed.copy()
    world.step(hover_thrust(world), 100)
    power = (vehicle.torque_ratio * vehicle.thrust_coefficient * speed**3).sum()
    assert world.record.energy[0] == pytest.approx(0.4 * power, rel=1e-9)


# Air


@pytest.mark.parametrize("timestep", TIMESTEPS)
@pytest.mark.parametrize("yaw", [0.0, pi / 2])
def test_drag_slows_a_drone_exponentially_along_its_body_axes(yaw, timestep):
    world = free_world(drag=True, **{"sim.timestep": timestep})
    vehicle = world.system.vehicle
    world.state.drone_rotation[:] = np.reshape(rot_z(yaw), (3, 3))
    world.state.drone_velocity[:] = [2.0, 1.0, 0.0]
    load(world)
    world.step(weightless(world), round(1 / timestep))
    along_x, along_y = vehicle.drag[:2] if yaw == 0 else vehicle.drag[1::-1]
    expected = [2.0 * exp(-along_x / vehicle.mass), 1.0 * exp(-along_y / vehicle.mass), 0.0]
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], expected, rtol=0.5 * timestep, atol=1e-9)


def test_wind_carries_a_drone_with_it_exponentially():
    world = free_world(drag=True)
    world.plant.wind[:] = [3.0, -1.0, 0.0]
    world.step(weightless(world), 250)
    share = 1 - np.exp(-np.array(world.system.vehicle.drag) / world.system.vehicle.mass)
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], share * [3.0, -1.0, 0.0], rtol=2e-3, atol=1e-9)


def test_configured_wind_is_the_wind():
    world = World(make_system(1, **{"wind.velocity": [1, 2, 3]}), 2, 1)
    assert world.plant.wind.tolist() == [[1, 2, 3]] * 2


def test_a_falling_payload_approaches_its_terminal_speed():
    world = free_world(drag=True)
    world.step(weightless(world), 250)
    system = world.system
    terminal = sqrt(2 * system.payload_mass * GRAVITY / (1.225 * system.payload_drag_area))
    expected = -terminal * tanh(GRAVITY / terminal)
    assert world.state.payload_velocity[0, 2] == pytest.approx(expected, rel=2e-3)


# Momentum


@pytest.mark.parametrize("force", [[1.5, 0, 0], [0, -1, 2.0], [1e-3, 0, 0]])
def test_force_on_a_free_payload_accelerates_it(force):
    world = free_world(num_envs=2)
    world.set_payload_mass(mask(2, 1), np.array([0, 0.7]))
    world.plant.payload_force[:] = force
    world.step(weightless(world), 25)
    expected = 0.1 * (np.array(force) / np.array([[0.35], [0.7]]) - [0, 0, GRAVITY])
    np.testing.assert_allclose(world.state.payload_velocity, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("force", [[1.5, 0, 0], [0, 0, -2.0], [1e-4, 0, 0]])
def test_force_on_a_carried_payload_accelerates_the_whole_team(num_drones, force):
    world = World(without_drag(make_system(num_drones)), 1, 1)
    world.plant.payload_force[:] = force
    world.step(hover_thrust(world), 25)
    np.testing.assert_allclose(momenta(world)[0][0], 0.1 * np.array(force), rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("shape", ["box", "point"])
def test_momentum_changes_by_the_impulse_of_thrust_and_weight(num_drones, shape):
    world = World(without_drag(make_system(num_drones, **{"payload.shape": shape})), 2, 1)
    world.set_payload_mass(mask(2, 1), np.full(2, 1.2 * world.system.payload_mass))
    system, vehicle, rng = world.system, world.system.vehicle, np.random.default_rng(0)
    weight = (world.plant.payload_mass + num_drones * vehicle.mass)[:, None] * [0, 0, -GRAVITY]
    linear, angular = (momentum.copy() for momentum in momenta(world))
    lag = system.timestep / vehicle.rotor_time_constant
    for step in range(100):
        if step % 10 == 0:
            thrust = hover_thrust(world) * rng.uniform(0.97, 1.03, (2, num_drones, 4))
        rotation, position = world.state.drone_rotation.copy(), world.state.drone_position.copy()
        load_position, target = world.state.payload_position.copy(), np.sqrt(thrust / vehicle.thrust_coefficient)
        gap = world.state.rotor_speed - target
        square = target**2 + 2 * target * gap * (1 - exp(-lag)) / lag + gap**2 * (1 - exp(-2 * lag)) / (2 * lag)
        rotors = vehicle.thrust_coefficient * square
        moments = [rotors @ vehicle.rotor_positions[:, 1], -rotors @ vehicle.rotor_positions[:, 0]]
        torque = np.stack([*moments, vehicle.torque_ratio * rotors @ vehicle.rotor_spin], axis=-1)
        force = rotation[..., 2] * rotors.sum(axis=-1, keepdims=True)
        linear += system.timestep * (force.sum(axis=1) + weight)
        turning = np.cross(position, force - [0, 0, vehicle.mass * GRAVITY]).sum(axis=1)
        turning += np.einsum("enij,enj->ei", rotation, torque)
        turning += np.cross(load_position, world.plant.payload_mass[:, None] * [0, 0, -GRAVITY])
        angular += system.timestep * turning
        world.step(thrust)
    np.testing.assert_allclose(momenta(world)[0], linear, atol=1e-12)
    np.testing.assert_allclose(momenta(world)[1], angular, atol=1e-5)


INERTIA = (0.006, 0.018, 0.022)


@pytest.mark.parametrize("body", ["drone", "payload"])
def test_a_torque_free_spin_conserves_angular_momentum_and_energy(body):
    world = free_world(vehicle={"inertia": INERTIA}, **{"payload.inertia": INERTIA, "sim.timestep": 1e-3})
    rates = world.state.drone_body_rates if body == "drone" else world.state.payload_body_rates
    rotation = world.state.drone_rotation if body == "drone" else world.state.payload_rotation
    rates.reshape(3)[:] = [0.3, 5.0, 0.3]
    load(world)

    def spin():
        own = INERTIA * rates.reshape(3)
        return rotation.reshape(3, 3) @ own, 0.5 * own @ rates.reshape(3)

    (momentum, energy), tumbled = spin(), False
    for _ in range(30):
        world.step(np.zeros((1, 1, 4)), 100)
        tumbled = tumbled or rates.reshape(3)[1] < -4
        np.testing.assert_allclose(spin()[0], momentum, atol=5e-3 * np.linalg.norm(momentum))
        assert spin()[1] == pytest.approx(energy, rel=1e-2)
    assert tumbled, "a spin about the middle axis is unstable"


# Many at once


def fly(world: World, steps: int = 60, seed: int = 0, first: int = 0) -> dict[str, np.ndarray]:
    """Fly every environment by thrusts of its own and return all there is to know afterwards."""
    for step in range(first, first + steps):
        shares = [
            np.random.default_rng((seed, e, step)).uniform(0.9, 1.1, (world.num_drones, 4))
            for e in range(world.num_envs)
        ]
        world.step(hover_thrust(world) * shares)
    return world.state_dict()


def disturb(world: World) -> None:
    everyone = np.arange(world.num_envs)
    world.set_payload_mass(everyone > 0, world.system.payload_mass * (1 + 0.05 * everyone))
    world.plant.payload_force[:, 0] = 0.3 * everyone


def rows(saved: dict[str, np.ndarray], chosen) -> dict[str, np.ndarray]:
    return {key: array[chosen] for key, array in saved.items()}


@pytest.mark.parametrize("num_threads", [2, 3, 8])
def test_the_number_of_threads_changes_no_bit(num_drones, num_threads):
    system = make_system(num_drones)
    one, many = World(system, 5, 1), World(system, 5, num_threads)
    for world in (one, many):
        disturb(world)
    assert same(fly(one), fly(many))


def test_an_environment_does_not_feel_its_neighbours():
    system = make_system(4)
    alone, crowd = World(system, 1, 1), World(system, 5, 2)
    crowd.set_payload_mass(mask(5, 2, 3), np.full(5, 1.6))
    crowd.plant.payload_force[4] = [0, 1, 0]
    assert same(rows(fly(crowd), [0]), fly(alone))


def test_a_masked_reset_leaves_the_other_rows_alone():
    world = World(make_system(3), 5, 2)
    disturb(world)
    before = fly(world)
    world.reset(mask(5, 1, 3))
    after = world.state_dict()
    assert same(rows(after, [0, 2, 4]), rows(before, [0, 2, 4]))
    assert not same(rows(after, [1]), rows(before, [1]))


def test_a_masked_reset_is_a_fresh_start():
    system = make_system(3)
    world, fresh = World(system, 5, 2), World(system, 5, 2)
    disturb(world)
    fly(world)
    world.reset(mask(5, 1, 3))
    assert same(rows(fly(world, seed=1), [1, 3]), rows(fly(fresh, seed=1), [1, 3]))


def test_a_reset_restores_the_nominal_plant():
    world = World(make_system(2, **{"wind.velocity": [1, 0, 0]}), 3, 1)
    disturb(world)
    world.plant.wind[:] = [0, 5, 0]
    world.reset(mask(3, 2))
    assert world.plant.payload_mass[2] == world.system.payload_mass != world.plant.payload_mass[1]
    assert world.plant.payload_force[:, 0].tolist() == pytest.approx([0, 0.3, 0])
    assert world.plant.wind.tolist() == [[0, 5, 0], [0, 5, 0], [1, 0, 0]]


@pytest.mark.parametrize("threads", [(1, 1), (1, 2), (2, 1)], ids=str)
def test_a_saved_world_continues_bit_for_bit(threads):
    system = make_system(4)
    world, other = World(system, 5, threads[0]), World(system, 5, threads[1])
    disturb(world)
    saved = fly(world)
    expected = fly(world, first=60)
    other.load_state_dict(saved)
    assert same(fly(other, first=60), expected)


def test_the_record_keeps_the_extremes_of_tension():
    world = World(make_system(4), 1, 1)
    rest = world.state.cable_tension[0, 0]
    assert world.record.tension_min[0] == world.record.tension_max[0] == pytest.approx(rest)
    seen = [rest]
    for _ in range(50):
        seen += world.step(1.2 * hover_thrust(world)).cable_tension[0].tolist()
    assert (world.record.tension_min[0], world.record.tension_max[0]) == (min(seen), max(seen))
    assert world.record.stretch_max[0] == pytest.approx(max(seen) / 1e5)


# What is refused, and what goes wrong


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_thrust_that_is_not_finite_is_refused(wrong):
    world = World(make_system(2), 3, 1)
    thrust = hover_thrust(world)
    thrust[1, 0, 2] = wrong
    with pytest.raises(ValueError, match="thrust holds NaN or infinite values; give"):
        world.step(thrust)


@pytest.mark.parametrize("shape", [(3, 2), (2, 2, 4), (3, 2, 3), (1, 2, 4)])
def test_thrust_of_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"thrust has shape .*, expected \(3, 2, 4\)"):
        World(make_system(2), 3, 1).step(np.ones(shape))


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_impossible_payload_mass_is_refused(mass):
    world = World(make_system(2), 2, 1)
    with pytest.raises(ValueError, match="mass"):
        world.set_payload_mass(mask(2, 1), np.array([1.0, mass]))


@pytest.mark.parametrize("force", [1e5, 1e30, np.nan])
def test_a_diverged_simulation_keeps_sound_numbers_and_spares_the_others(force):
    system = make_system(4)
    world, calm = World(system, 5, 2), World(system, 5, 2)
    world.plant.payload_force[2] = force
    saved, expected = fly(world), fly(calm)
    others = [0, 1, 3, 4]
    assert world.diverged.tolist() == [False, False, True, False, False]
    assert same(rows(saved, others), rows(expected, others))
    assert all(np.isfinite(saved[key]).all() for key in saved if key.startswith("state."))


def test_reset_heals_a_diverged_simulation():
    system = make_system(4)
    world, fresh = World(system, 3, 1), World(system, 3, 1)
    world.plant.payload_force[1] = np.nan
    fly(world)
    world.reset(mask(3, 1))
    assert not world.diverged.any()
    assert same(rows(fly(world, seed=1), [1]), rows(fly(fresh, seed=1), [1]))
    world.check_warnings()
    assert not world.diverged.any()


@pytest.mark.parametrize("num_threads", [1, 2])
def test_divergence_writes_no_file_and_nothing_to_the_screen(tmp_path, monkeypatch, capfd, caplog, num_threads):
    monkeypatch.chdir(tmp_path)
    caplog.set_level(logging.DEBUG, "multilift_marl.mujoco")
    world = World(make_system(4), 4, num_threads)
    world.plant.payload_force[[0, 3]] = np.nan
    world.step(hover_thrust(world), 5)
    assert world.diverged.tolist() == [True, False, False, True]
    assert "simulation is unstable" in caplog.text
    assert capfd.readouterr() == ("", "")
    assert list(Path.cwd().iterdir()) == []
