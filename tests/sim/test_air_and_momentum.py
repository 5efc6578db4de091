"""Drag, wind, forces and the balance of momentum against closed forms."""

from __future__ import annotations

from math import exp, pi, sqrt, tanh

import numpy as np
import pytest
from conftest import GRAVITY, TIMESTEPS, free_world, hover_thrust, load, make_system, mask, weightless, without_drag

from multilift_marl.math3d import axis_angle, rot_z
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


OBLIQUE = 20.0 * np.array([0.6, 0.48, 0.64])  # [rad/s]


def tumbling(seconds: float, body: str, inertia) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rates and attitudes (T, 3), (T, 3, 3) of a free body that tumbles for a time, and its moments of inertia.

    The team's default time step of 4 ms is used.
    """
    values = {"payload.inertia": inertia} if inertia else {}
    world = free_world(vehicle={"inertia": inertia} if inertia else {}, **values)
    world.state.payload_position[:, 2] += 2000.0
    world.state.drone_position[..., 2] += 2000.0
    world.state.rotor_speed[:] = 0.0
    rates = world.state.drone_body_rates[0, 0] if body == "drone" else world.state.payload_body_rates[0]
    rotation = world.state.drone_rotation[0, 0] if body == "drone" else world.state.payload_rotation[0]
    rates[:] = OBLIQUE
    rotation[:] = np.eye(3)
    load(world)
    world.hidden_loads.motors_off[:] = True
    found = [(rates.copy(), rotation.copy())]
    for _ in range(round(seconds / 0.1)):
        world.step(np.zeros((1, 1, 4)), 25)
        found.append((rates.copy(), rotation.copy()))
    moments = world.system.vehicle.inertia if body == "drone" else world.system.payload_inertia
    return *map(np.array, zip(*found, strict=True)), np.array(moments)


@pytest.mark.parametrize("inertia", [None, INERTIA], ids=["preset", "asymmetric"])
@pytest.mark.parametrize("body", ["drone", "payload"])
def test_a_body_that_tumbles_at_20_rad_s_keeps_energy_and_angular_momentum(body, inertia):
    rates, rotation, moments = tumbling(10.0, body, inertia)
    own = moments * rates
    energy = (own * rates).sum(axis=1)
    size = np.linalg.norm(own, axis=1)
    np.testing.assert_allclose(energy[:11], energy[0], rtol=2e-4)  # 10 to 17 % were lost by backward Euler
    np.testing.assert_allclose(energy, energy[0], rtol=2e-3)
    np.testing.assert_allclose(size, size[0], rtol=1e-3)
    # attitudes follow the rates at the ends of steps: their momentum sways by h/2 of its change, and does not drift
    momentum = np.einsum("tij,tj->ti", rotation, own)
    sway = 0.5 * 0.004 * 2 * np.linalg.norm(OBLIQUE)
    assert (np.linalg.norm(momentum - momentum[0], axis=1) / size[0]).max() < sway


@pytest.mark.parametrize("body", ["drone", "payload"])
def test_a_tumbling_body_turns_as_eulers_equations_say(body):
    rates, rotation, moments = tumbling(1.0, body, INERTIA)

    def slope(w):
        return np.cross(moments * w, w) / moments

    # Runge and Kutta's rule for the rates, and the rotation by their mean in steps of 0.25 ms.
    w, attitude, h = OBLIQUE.copy(), np.eye(3), 2.5e-4
    for _ in range(4000):
        k1 = slope(w)
        k2 = slope(w + h / 2 * k1)
        k3 = slope(w + h / 2 * k2)
        change = h / 6 * (k1 + 2 * k2 + 2 * k3 + slope(w + h * k3))
        turned = h * (w + 0.5 * change)
        size = np.linalg.norm(turned)
        attitude = attitude @ np.reshape(axis_angle(tuple(turned / size), size), (3, 3))
        w = w + change
    np.testing.assert_allclose(rates[-1], w, atol=0.05)  # was up to 2.4 rad/s off
    off = np.arccos((np.trace(attitude.T @ rotation[-1]) - 1) / 2)
    assert np.rad2deg(off) < 3.0  # was 30 to 40 degrees


@pytest.mark.parametrize("force", [(0.0, 0.0, 0.0), (3.0, 0.0, 0.0), (0.0, -5.0, 0.0), (3.0, -5.0, 4.0)])
def test_a_payload_that_tumbles_about_a_shifted_centre_of_mass_keeps_its_energy(force):
    """Also where a force acts at the centre of mass, which turns nothing."""
    world = free_world(**{"randomization.payload_center_of_mass": [0.05, 0.05, 0.05]})
    center = np.array([0.03, -0.02, 0.01])
    world.set_parameters(np.ones(1, bool), payload_center_of_mass=center[None])
    state, moments = world.state, world.system.payload_inertia
    state.payload_position[:, 2] += 100.0
    state.drone_position[..., 2] += 100.0
    state.payload_body_rates[0] = OBLIQUE
    state.payload_velocity[0] = -np.cross(OBLIQUE, center)
    load(world)
    world.hidden_loads.payload_force[0] = force
    world.step(np.zeros((1, 1, 4)), 250)
    after = float(moments @ state.payload_body_rates[0] ** 2)
    assert after == pytest.approx(float(moments @ OBLIQUE**2), rel=2e-4)
