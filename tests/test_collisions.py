"""Bodies that meet fast: none passes through another, and momentum stays."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import load, make_system, without_drag

from multilift_marl.config.vehicles import PRESETS
from multilift_marl.sim import World
from multilift_marl.sim.contact import drone_half_size


def collide(preset: str, axis: int, speed: float, phase: float, model: str = "massless") -> tuple[float, np.ndarray]:
    """Let two loose drones meet face to face; return their depth in each other [m] and the change of momentum over m v.

    Args:
        preset: of both.
        axis: of the body frame along which they meet.
        speed: at which they close [m/s].
        phase: where in a step they meet.
        model: of the cables, which are broken.
    """
    values = {"vehicle.preset": preset, "payload.mass": 0.01, "cable.model": model, "cable.length": 3.0}
    system = without_drag(make_system(2, **values))
    world = World(system, 1, 1)
    state, edge = world.state, drone_half_size(system.vehicle)[axis]
    gap = 0.05 + phase * speed * system.timestep
    state.payload_position[:], state.drone_rotation[:] = [0, 0, 98.5], np.eye(3)
    state.drone_position[0], state.drone_velocity[:], state.rotor_speed[:] = [0, 0, 100], 0.0, 0.0
    state.drone_position[0, :, axis] += [-edge - gap / 2, edge + gap / 2]
    state.drone_velocity[0, :, axis] = [speed / 2, -speed / 2]
    load(world)
    world.break_cables(np.ones((1, 2), bool))
    world.plant.motors_off[:] = True
    before, nearest = state.drone_velocity[0].sum(axis=0), np.inf
    steps = round((0.05 / speed + 0.1) / system.timestep)
    for _ in range(steps):
        world.step(np.zeros((1, 2, 4)))
        nearest = min(nearest, np.subtract(*state.drone_position[0, ::-1, axis]) - 2 * edge)
    assert not world.diverged.any()
    gained = state.drone_velocity[0].sum(axis=0) - before + [0, 0, 2 * 9.81 * steps * system.timestep]
    return -nearest, gained / speed


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("axis", [0, 2])
@pytest.mark.parametrize("speed", [2.0, 5.0, 10.0, 20.0])
def test_drones_do_not_pass_through_each_other(name, axis, speed):
    thickness = 2 * drone_half_size(PRESETS[name])[axis]
    for phase in (0.0, 0.25, 0.5, 0.75):
        depth, gained = collide(name, axis, speed, phase)
        assert depth < thickness and depth < 0.004 * speed + 0.005  # what they travel in a step
        assert np.abs(gained).max() < 1e-6


def test_drones_on_broken_chains_collide_alike():
    for phase in (0.0, 0.5):
        depth, gained = collide("falcon", 0, 10.0, phase, "chain")
        assert depth < 0.045
        assert np.abs(gained).max() < 1e-6


def test_nothing_bounces():
    world = World(without_drag(make_system(1, **{"cable.length": 20.0})), 1, 1)
    world.state.payload_position[:], world.state.drone_position[:] = [0, 30, 0.1], [0, 0, 2.0]
    world.state.drone_rotation[:] = np.eye(3)
    world.state.rotor_speed[:] = 0
    load(world)
    world.break_cables(np.ones((1, 1), bool))
    world.plant.motors_off[:] = True
    highest, landed = 0.0, False
    for _ in range(500):
        world.step(np.zeros((1, 1, 4)))
        landed = landed or (
            world.state.drone_velocity[0, 0, 2] > -0.5 * 6.2 and world.state.drone_position[0, 0, 2] < 0.1
        )
        highest = max(highest, world.state.drone_velocity[0, 0, 2] if landed else 0.0)
    assert landed and highest < 0.7  # from 6.2 m/s
    assert world.state.drone_position[0, 0, 2] == pytest.approx(drone_half_size(world.system.vehicle)[2], abs=2e-3)
