"""Drag, wind, forces and the balance of momentum against closed forms."""

from __future__ import annotations

from math import exp, pi, sqrt, tanh

import numpy as np
import pytest
from conftest import GRAVITY, TIMESTEPS, free_world, hover_thrust, load, make_system, mask, weightless, without_drag

from multilift_marl.math3d import rot_z
from multilift_marl.sim import World


def momenta(world: World) -> tuple[np.ndarray, np.ndarray]:
    """Return the momentum (E, 3) and the angular momentum about the origin (E, 3) of payload, drones and rotors."""
    system, state, mass = world.system, world.state, world.hidden_loads.payload_mass[:, None]
    inertia = system.payload_inertia * mass / system.payload_mass
    spin = np.einsum("eij,ej->ei", state.payload_rotation, inertia * state.payload_body_rates)
    own = np.asarray(system.vehicle.inertia) * state.drone_body_rates
    own[..., 2] -= system.vehicle.rotor_inertia * state.rotor_speed @ np.array(system.vehicle.rotor_spin)
    spins = np.einsum("enij,enj->ei", state.drone_rotation, own)
    linear, linears = mass * state.payload_velocity, system.vehicle.mass * state.drone_velocity
    orbits = np.cross(state.payload_position, linear) + np.cross(state.drone_position, linears).sum(axis=1)
    return linear + linears.sum(axis=1), orbits + spin + spins


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
    world.hidden_loads.wind[:] = [3.0, -1.0, 0.0]
    world.step(weightless(world), 250)
    share = 1 - np.exp(-np.array(world.system.vehicle.drag) / world.system.vehicle.mass)
    np.testing.assert_allclose(world.state.drone_velocity[0, 0], share * [3.0, -1.0, 0.0], rtol=2e-3, atol=1e-9)


def test_configured_wind_is_the_wind():
    world = World(make_system(1, **{"wind.velocity": [1, 2, 3]}), 2, 1)
    assert world.hidden_loads.wind.tolist() == [[1, 2, 3]] * 2


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
    world.set_parameters(mask(2, 1), payload_mass=np.array([0, 0.7]))
    world.hidden_loads.payload_force[:] = force
    world.step(weightless(world), 25)
    expected = 0.1 * (np.array(force) / np.array([[0.35], [0.7]]) - [0, 0, GRAVITY])
    np.testing.assert_allclose(world.state.payload_velocity, expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("force", [[1.5, 0, 0], [0, 0, -2.0], [1e-4, 0, 0]])
def test_force_on_a_carried_payload_accelerates_the_whole_team(num_drones, force):
    world = World(without_drag(make_system(num_drones)), 1, 1)
    world.hidden_loads.payload_force[:] = force
    world.step(hover_thrust(world), 25)
    np.testing.assert_allclose(momenta(world)[0][0], 0.1 * np.array(force), rtol=1e-3, atol=1e-12)


@pytest.mark.parametrize("shape", ["box", "point"])
def test_momentum_changes_by_the_impulse_of_thrust_and_weight(num_drones, shape):
    world = World(without_drag(make_system(num_drones, **{"payload.shape": shape})), 2, 1)
    world.set_parameters(mask(2, 1), payload_mass=np.full(2, 1.2 * world.system.payload_mass))
    system, vehicle, rng = world.system, world.system.vehicle, np.random.default_rng(0)
    weight = (world.hidden_loads.payload_mass + num_drones * vehicle.mass)[:, None] * [0, 0, -GRAVITY]
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
        turning += np.cross(load_position, world.hidden_loads.payload_mass[:, None] * [0, 0, -GRAVITY])
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
