"""Friction and restitution of contact, by closed forms."""

from __future__ import annotations

import re
from math import acos, exp, sqrt

import numpy as np
import pytest
from conftest import GRAVITY, load, make_system, refuse_system, without_drag

from multilift_marl.math3d import axis_angle
from multilift_marl.rig.restitution import DAMPING, STIFFNESS, contact_law
from multilift_marl.sim import World
from multilift_marl.sim.contact import drone_half_size

FALL = {"payload.mass": 0.1, "cable.length": 20.0, "payload.size": [0.3, 0.3, 0.1]}


def loose(height: float, velocity: tuple[float, float, float], **overrides) -> World:
    """Return a payload with its lower side at a height [m], flat, moving [m/s]; its drone falls 10 m away."""
    world = World(without_drag(make_system(1, **FALL | overrides)), 1, 1)
    world.state.payload_position[:] = [0, 0, height + world.system.payload_size[2] / 2]
    world.state.payload_velocity[:] = velocity
    world.state.payload_rotation[:] = world.state.drone_rotation[:] = np.eye(3)
    world.state.drone_position[:] = [0, 10.0, 15.0]
    world.state.rotor_speed[:] = 0
    load(world)
    if world.system.cable_mass[0] == 0:  # chains are slack
        world.break_cables(np.ones((1, 1), bool))
    world.hidden_loads.motors_off[:] = True
    return world


@pytest.mark.parametrize("degrees", [0.0, 17.0, 45.0, 90.0])
@pytest.mark.parametrize("friction", [1.0, 0.3])
def test_a_payload_slides_as_far_in_every_direction(degrees, friction):
    """v²/(2 μ g), less the half step of v that a first-order integrator takes."""
    angle = np.deg2rad(degrees)
    along = np.array([np.cos(angle), np.sin(angle), 0.0])
    world = loose(-2e-4, 2.0 * along, **{"contact.friction": friction})
    for _ in range(250):
        world.step(np.zeros((1, 1, 4)))
    path = world.state.payload_position[0] - [0, 0, world.state.payload_position[0, 2]]
    assert path @ along == pytest.approx(2.0**2 / (2 * friction * GRAVITY) - 2.0 * 0.004 / 2, rel=0.01)
    assert np.linalg.norm(np.cross(path, along)) < 1e-3
    assert np.linalg.norm(world.state.payload_velocity) < 1e-3


@pytest.mark.parametrize("timestep", [0.004, 0.001])
@pytest.mark.parametrize("restitution", [0.0, 0.3, 0.5, 0.65])
def test_what_slides_is_neither_thrown_up_nor_without_friction(restitution, timestep):
    """Coulomb's deceleration from the first step on, whatever the restitution, and the payload stays on the ground."""
    overrides = {"contact.restitution": restitution, "sim.timestep": timestep, "cable.length": 30.0}
    world = loose(-2e-4, (2.0, 0.0, 0.0), **overrides)
    state, heights, start = world.state, [], None
    for step in range(round(1.0 / timestep)):
        world.step(np.zeros((1, 1, 4)))
        heights.append(state.payload_position[0, 2] - world.system.payload_size[2] / 2)
        if step == 0:
            start = state.payload_velocity[0].copy()
    assert 1.6 < start[0] < 2.0 and abs(start[2]) < 0.25
    assert max(heights) < 8e-3
    assert state.payload_position[0, 0] == pytest.approx(2.0**2 / (2 * GRAVITY), abs=8e-3)
    assert abs(state.payload_velocity[0, 0]) < 0.01


@pytest.mark.parametrize(("restitution", "creep"), [(0.0, 1e-4), (0.3, 5e-3), (0.5, 1.2e-2), (0.65, 1.2e-2)])
def test_what_is_pushed_less_than_friction_holds_stays(restitution, creep):
    """A third of the friction for two seconds; one and a half of it moves the payload as Coulomb says."""
    for share in (0.36, 1.5):
        world = loose(-2e-4, (0.0, 0.0, 0.0), **{"contact.restitution": restitution, "cable.length": 40.0})
        for _ in range(250):
            world.step(np.zeros((1, 1, 4)))
        begin = world.state.payload_position[0, 0]
        world.hidden_loads.payload_force[0] = [share * world.system.payload_mass * GRAVITY, 0.0, 0.0]
        for _ in range(250):
            world.step(np.zeros((1, 1, 4)))
        moved = world.state.payload_position[0, 0] - begin
        if share < 1:
            assert abs(moved) < creep
        else:
            assert moved == pytest.approx(0.5 * 0.5 * GRAVITY, rel=0.15)


@pytest.mark.parametrize("timestep", [0.004, 0.001])
@pytest.mark.parametrize("restitution", [0.0, 0.5, 0.65])
def test_boxes_that_tumble_on_the_ground_gain_no_energy(restitution, timestep):
    """Forty at random attitudes and speeds, with friction."""
    rng = np.random.default_rng(3)
    overrides = {"contact.restitution": restitution, "sim.timestep": timestep, "cable.length": 20.0}
    world = World(without_drag(make_system(1, **FALL | overrides)), 40, 1)
    state, system = world.state, world.system
    state.payload_position[:] = [0, 0, 0.3]
    state.payload_velocity[:] = rng.uniform(-2, 2, (40, 3))
    state.payload_body_rates[:] = rng.uniform(-8, 8, (40, 3))
    for turn in state.payload_rotation:
        turn[:] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        turn[:, 0] *= np.linalg.det(turn)
    state.drone_position[:] = [0, 10.0, 15.0]
    state.rotor_speed[:] = 0
    load(world)
    world.break_cables(np.ones((40, 1), bool))
    world.hidden_loads.motors_off[:] = True

    def energy() -> np.ndarray:
        spin = (state.payload_body_rates**2 * system.payload_inertia).sum(axis=1) / 2
        moving = (state.payload_velocity**2).sum(axis=1) / 2
        return system.payload_mass * (moving + GRAVITY * state.payload_position[:, 2]) + spin

    before, most = energy(), np.zeros(40)
    for _ in range(round(1.2 / timestep)):
        world.step(np.zeros((40, 1, 4)))
        most = np.maximum(most, energy() / before)
    assert most.max() < 1.01
    assert energy().max() < 0.9 * before.max()  # they have landed


@pytest.mark.parametrize(
    ("restitution", "timestep", "model"),
    [(e, h, "massless") for e in (0.3, 0.5, 0.65) for h in (0.004, 0.001)] + [(e, 0.004, "chain") for e in (0.3, 0.6)],
)
def test_a_payload_bounces_to_the_square_of_its_restitution(restitution, timestep, model):
    """From 2 m, wherever in a step it lands; the height of the bounce over that of the fall is e²."""
    for phase in (0.0, 0.3, 0.6, 0.9):
        overrides = {"contact.restitution": restitution, "sim.timestep": timestep, "cable.model": model}
        overrides |= {"payload.mass": 0.7, "cable.density": 0.002} if model == "chain" else {}
        world = loose(2.0 + phase * 6.3 * timestep, (0.0, 0.0, 0.0), **overrides)
        highest, landed, half = 0.0, False, world.system.payload_size[2] / 2
        for _ in range(round(1.3 / timestep)):
            world.step(np.zeros((1, 1, 4)))
            height = world.state.payload_position[0, 2] - half
            landed = landed or height < 0
            highest = max(highest, height if landed else 0.0)
        assert sqrt(highest / 2.0) == pytest.approx(restitution, abs=0.06)


def test_a_disc_that_wobbles_on_the_ground_gains_no_energy():
    disc = {"payload.shape": "cylinder", "payload.size": [0.4, 0.4, 0.02], "payload.mass": 0.7, "contact.friction": 0.1}
    world, tilt = loose(0.0, (0.0, 0.0, 0.0), **disc), 0.35
    state, system = world.state, world.system
    state.payload_rotation[0] = np.reshape(axis_angle((1.0, 0.0, 0.0), tilt), (3, 3))
    state.payload_position[0] = [0, 0, 0.2 * np.sin(tilt) + 0.01 * np.cos(tilt)]
    state.payload_body_rates[0] = [3.0, 20.0, 25.0]
    load(world)
    world.break_cables(np.ones((1, 1), bool))

    def energy() -> float:
        rates, velocity = state.payload_body_rates[0], state.payload_velocity[0]
        turning = 0.5 * rates @ (system.payload_inertia * rates)
        height = state.payload_position[0, 2]
        return float(turning + system.payload_mass * (0.5 * velocity @ velocity + GRAVITY * height))

    before, energies = energy(), []
    for _ in range(125):
        world.step(np.zeros((1, 1, 4)))
        energies.append(energy())
    assert max(energies) <= before and energies[-1] < 0.9 * before


def test_drones_bounce_off_the_ground_too():
    world = loose(100.0, (0.0, 0.0, 0.0), **{"contact.restitution": 0.5})
    world.state.drone_position[:] = [0, 0, drone_half_size(world.system.vehicle)[2] + 0.5]
    load(world)
    world.break_cables(np.ones((1, 1), bool))
    velocity = world.state.drone_velocity[0, 0]
    fastest = rebound = 0.0
    for _ in range(150):
        world.step(np.zeros((1, 1, 4)))
        fastest, rebound = min(fastest, velocity[2]), max(rebound, velocity[2])
    assert rebound == pytest.approx(0.5 * -fastest, abs=0.05 * -fastest)


def test_the_law_of_contact_is_that_of_a_spring_and_damper_that_cannot_pull():
    """Its largest rebound by integration at 1e-5 of its period, and MuJoCo's own numbers by default."""
    assert contact_law(0.0, 0.004) == (STIFFNESS, DAMPING)
    for restitution in (0.1, 0.3, 0.6, 0.8):
        stiffness, damping = contact_law(restitution, 0.004)
        frequency = sqrt(stiffness)
        damping += stiffness * 0.004  # which implicit steps add
        depth, speed, step = 0.0, 1.0, 1e-5 / frequency
        while stiffness * depth + damping * speed > 0:
            speed -= step * (stiffness * depth + damping * speed)
            depth += step * speed
        assert -speed == pytest.approx(restitution, abs=2e-3)
        ratio = damping / (2 * frequency)
        if ratio < 1:
            assert restitution == pytest.approx(exp(-2 * ratio * acos(ratio) / sqrt(1 - ratio**2)), rel=1e-6)


def test_contact_that_would_let_bodies_through_is_refused():
    """Half of a falcon is 0.3 · 0.106 m = 31.8 mm thick."""
    message = refuse_system(contact__restitution=0.8)
    assert re.match(r"contact\.restitution=0\.8 with sim\.timestep=0\.004 s makes contact so soft that bodies", message)
    assert message.endswith(
        "sink in by 53.8 mm, more than half the thickness of the thinnest, 31.8 mm; lower one of them"
    )
    make_system(4, **{"contact.restitution": 0.8, "sim.timestep": 0.002})


@pytest.mark.parametrize("axis", [0, 2])
def test_drones_that_meet_part_at_the_restitution_and_do_not_pass(axis):
    system = without_drag(make_system(2, **{"payload.mass": 0.01, "cable.length": 3.0, "contact.restitution": 0.6}))
    for phase in (0.0, 0.5):
        world, edge = World(system, 1, 1), drone_half_size(system.vehicle)[axis]
        world.state.payload_position[:], world.state.drone_rotation[:] = [0, 0, 98.5], np.eye(3)
        world.state.drone_position[:], world.state.drone_velocity[:], world.state.rotor_speed[:] = [0, 0, 100], 0, 0
        apart = edge + 0.02 + phase * 0.004
        world.state.drone_position[0, :, axis] += [-apart, apart]
        world.state.drone_velocity[0, :, axis] = [1.0, -1.0]
        load(world)
        world.break_cables(np.ones((1, 2), bool))
        world.hidden_loads.motors_off[:] = True
        for _ in range(60):
            world.step(np.zeros((1, 2, 4)))
        assert np.subtract(*world.state.drone_velocity[0, ::-1, axis]) == pytest.approx(0.6 * 2.0, abs=0.06 * 2.0)


@pytest.mark.parametrize("key, values", [("friction", (-0.1, 11.0)), ("restitution", (-0.1, 1.0))])
def test_impossible_contact_is_named(key, values):
    for value in values:
        assert refuse_system(**{f"contact__{key}": value}).startswith(f"contact.{key} must be ")
