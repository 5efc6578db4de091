"""Cables against closed forms: tension and stretch at rest, Kelvin-Voigt damping, slack."""

from __future__ import annotations

from math import cos, exp, radians

import numpy as np
import pytest
from conftest import (
    GRAVITY,
    OFF_CENTRE,
    TIMESTEPS,
    free_world,
    hover_thrust,
    load,
    make_system,
    same,
    steady,
    weightless,
    without_drag,
)

from multilift_marl.sim import World


def stretch(world: World) -> np.ndarray:
    """Return length minus natural length of the cables (E, N) [m]."""
    state, system = world.state, world.system
    anchors = state.payload_position[:, None] + np.einsum("eij,nj->eni", state.payload_rotation, system.anchors)
    return np.linalg.norm(state.drone_position - anchors, axis=-1) - system.cable_length


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
    world.set_parameters(np.ones(5, bool), payload_mass=mass)
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
        changed.set_parameters(everyone, payload_mass=np.full(2, factor * system.payload_mass))
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


def test_a_slack_cable_has_no_tension_at_all():
    world = World(make_system(4), 1, 1)
    world.state.drone_position[..., 2] -= 0.5
    load(world)
    world.step(hover_thrust(world), 25)
    assert (world.state.cable_tension == 0).all()
    assert world.stats.tension_max[0] == 0
    assert world.stats.slack_time[0] == pytest.approx(0.1)
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
