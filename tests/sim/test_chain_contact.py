"""Bodies on chains that hit the ground or each other: no energy from nowhere, no momentum lost."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, load, make_system, without_drag

from multilift_marl.math3d import axis_angle
from multilift_marl.sim import World
from multilift_marl.validation.conservation import totals

STILL = {"vehicle.rotor_speed_min": 0.0}


def falling_team(height: float, timestep: float, num_drones: int = 4, **overrides) -> World:
    """Return a team on chains whose payload is `height` above the ground, rotors still."""
    values = {"cable.model": "chain", "sim.timestep": timestep, "sim.control_hz": 250, **STILL, **overrides}
    world = World(without_drag(make_system(num_drones, **values), rotor_speed_min=0.0), 1, 1)
    down = world.state.payload_position[0, 2] - world.system.payload_size[2] / 2 - height
    world.state.payload_position[0, 2] -= down
    world.state.drone_position[0, :, 2] -= down
    world.state.rotor_speed[:] = 0.0
    load(world)
    world.hidden_loads.motors_off[:] = True
    return world


def energies(world: World) -> tuple[float, float]:
    """Return the energy [J]: all of it, height above the ground included, and that of the stretched links."""
    sums = totals(world)
    moving = 0.5 * float(sums.linear @ sums.linear) / sums.mass
    links = np.concatenate([np.linalg.norm(np.diff(world.cable_points(0, n), axis=0), axis=1) for n in range(4)])
    stiffness = world.parameters.cable_stiffness[0, 0] * 10
    stretched = 0.5 * stiffness * float(((links - world.parameters.cable_length[0, 0] / 10) ** 2).sum())
    return sums.energy + moving + sums.mass * GRAVITY * float(sums.center[2]), stretched


@pytest.mark.parametrize("damping, limit", [(1000.0, 0.3), (100.0, 2.5)])  # 0.24 and 1.8 J at a step of 0.1 ms
@pytest.mark.parametrize("timestep", [4e-3, 1e-3])
@pytest.mark.parametrize("height", [0.2, 1.0])
def test_a_team_that_falls_to_the_ground_gains_no_energy(height, timestep, damping, limit):
    world = falling_team(height, timestep, **{"cable.damping": damping, "cable.bending_damping": 0.0})
    start, _ = energies(world)
    found = []
    for _ in range(round(1.0 / timestep)):
        world.step(np.zeros((1, 4, 4)))
        found.append(energies(world))
    total, stretched = np.array(found).T
    assert total[-1] < 0.2 * start  # it lies on the ground
    assert (total - np.minimum.accumulate(total)).max() < 0.01 * start
    assert stretched.max() < limit  # was 450 J, where there are 64 J in all
    assert not world.diverged[0]


@pytest.mark.parametrize("center", [[0.0, 0.0, 0.0], [0.06, -0.04, 0.03]])
def test_bodies_that_hit_each_other_keep_their_momentum(center):
    world = falling_team(50.0, 4e-3, **{"payload.center_of_mass": center})
    state = world.state
    state.payload_velocity[0] = [0, 0, 3.0]  # between the drones' chains, up against one drone
    state.drone_position[0, 0] = state.payload_position[0] + [0.02, 0.01, 0.35]
    load(world)
    before, hit = totals(world), False
    for step in range(1, 101):
        world.step(np.zeros((1, 4, 4)))
        hit = hit or bool(world.nodes.contact[0, 1].any())
        expected = before.linear - [0, 0, before.mass * GRAVITY * step * 0.004]
        np.testing.assert_allclose(totals(world).linear, expected, atol=1e-9)
        np.testing.assert_allclose(totals(world).angular, before.angular, atol=5e-4)
    assert hit


def test_a_cable_that_only_a_missed_impact_would_break_holds():
    world = falling_team(1.0, 4e-3, **{"cable.breaking_load": 60.0})
    world.state.drone_velocity[0, :, 2] = -1.0  # onto slack chains
    load(world)
    world.hidden_loads.motors_off[:] = True
    world.step(np.zeros((1, 4, 4)), 200)
    assert not world.state.cable_broken.any()


def test_an_impact_is_felt_in_a_saved_state_as_without_saving():
    first, second = falling_team(0.1, 4e-3), falling_team(0.3, 4e-3)
    first.step(np.zeros((1, 4, 4)), 30)
    second.load_state_dict(first.state_dict())
    for world in (first, second):
        world.step(np.zeros((1, 4, 4)), 60)
    assert first.nodes.position.tolist() == second.nodes.position.tolist()
    assert first.state.payload_position.tolist() == second.state.payload_position.tolist()


@pytest.mark.parametrize("model", ["chain", "massless"])
def test_a_drawn_centre_of_mass_lands_and_tumbles_as_one_that_is_configured(model):
    """The state of a team that draws one is that of the nominal centre; the other's is where the mass is."""
    center, worlds = np.array([0.05, -0.03, 0.02]), []
    for configured in (False, True):
        own = {"cable.model": model, "payload.inertia": [0.02, 0.035, 0.05], **STILL}
        key = "payload.center_of_mass" if configured else "randomization.payload_center_of_mass"
        own |= {key: list(center) if configured else [0.05, 0.05, 0.05]}
        world = World(without_drag(make_system(3, **own), rotor_speed_min=0.0), 1, 1)
        state, turn = world.state, np.reshape(axis_angle((0.48, -0.6, 0.64), 0.4), (3, 3))
        rates, velocity = np.array([2.0, -1.0, 0.5]), np.array([0.3, -0.2, -0.5])
        place = np.array([0.0, 0.0, 0.25])
        state.payload_rotation[0], state.payload_body_rates[0] = turn, rates
        state.payload_position[0] = place + configured * turn @ center
        state.payload_velocity[0] = velocity + configured * turn @ np.cross(rates, center)
        state.drone_position[0] = [[0.5, 0.0, 0.9], [-0.3, 0.4, 0.95], [-0.25, -0.4, 0.92]]
        state.drone_rotation[:], state.rotor_speed[:] = np.eye(3), 0.0
        if not configured:
            world.set_parameters(np.ones(1, bool), payload_center_of_mass=center[None])
        load(world)
        world.hidden_loads.motors_off[:] = True
        worlds.append(world)
    touched = 0
    for _ in range(125):
        for world in worlds:
            world.step(np.zeros((1, 3, 4)))
        drawn, made = (world.state for world in worlds)
        touched += drawn.payload_velocity[0, 2] > -0.1
        turn = drawn.payload_rotation[0]
        np.testing.assert_allclose(made.payload_rotation[0], turn, atol=1.2e-3)
        np.testing.assert_allclose(made.payload_position[0], drawn.payload_position[0] + turn @ center, atol=1.2e-3)
        np.testing.assert_allclose(made.drone_position, drawn.drone_position, atol=1.2e-3)
    assert 20 < touched < 125
