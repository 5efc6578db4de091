"""Bodies that meet fast: none passes through another, and momentum stays."""

from __future__ import annotations

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from conftest import load, make_system, without_drag

from multilift_marl.math3d import axis_angle
from multilift_marl.rig.presets import PRESETS
from multilift_marl.sim import World, contact
from multilift_marl.sim.contact import APART, drone_half_size


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
    world.hidden_loads.motors_off[:] = True
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


def strike(preset: str, pair: str, speed: float, phase: float) -> tuple[float, float]:
    """Let a loose drone fall on the payload, or either on the ground; return depth [m] and speed of return [m/s]."""
    mass = 0.1 * PRESETS[preset].mass
    values = {"vehicle.preset": preset, "payload.mass": mass, "cable.length": 30.0}
    system = without_drag(make_system(1, **values))
    world = World(system, 1, 1)
    state, halves = world.state, (system.payload_size[2] / 2, drone_half_size(system.vehicle)[2])
    gap = 0.05 + phase * speed * system.timestep
    payload, drone = {
        "drone on payload": (50.0, 50.0 + sum(halves) + gap),
        "drone on ground": (50.0, halves[1] + gap),
        "payload on ground": (halves[0] + gap, 50.0),
    }[pair]
    falling = (0.0, -speed) if pair.startswith("drone") else (-speed, 0.0)
    state.payload_position[:], state.drone_position[:] = [0, 0, payload], [0, 0, drone]
    state.drone_position[0, :, 0] = 0.0 if "drone on" in pair else 20.0
    state.payload_rotation[:] = state.drone_rotation[:] = np.eye(3)
    state.payload_velocity[:], state.drone_velocity[:] = [0, 0, falling[0]], [0, 0, falling[1]]
    state.rotor_speed[:] = 0.0
    load(world)
    world.break_cables(np.ones((1, 1), bool))
    world.hidden_loads.motors_off[:] = True
    nearest, back = np.inf, 0.0
    for _ in range(round((0.05 / speed + 0.1) / system.timestep)):
        world.step(np.zeros((1, 1, 4)))
        heights = state.payload_position[0, 2] - halves[0], state.drone_position[0, 0, 2] - halves[1]
        pace = state.payload_velocity[0, 2], state.drone_velocity[0, 0, 2]
        apart, opening = {
            "drone on payload": (heights[1] - heights[0] - 2 * halves[0], pace[1] - pace[0]),
            "drone on ground": (heights[1], pace[1]),
            "payload on ground": (heights[0], pace[0]),
        }[pair]
        nearest, back = min(nearest, apart), max(back, opening)
    assert not world.diverged.any()
    return -nearest, back


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("pair", ["drone on payload", "drone on ground", "payload on ground"])
@pytest.mark.parametrize("speed", [5.0, 20.0])
def test_payload_and_ground_stop_what_falls_on_them(name, pair, speed):
    for phase in (0.0, 0.5):
        depth, back = strike(name, pair, speed, phase)
        assert depth < 0.004 * speed + 0.005 and back < 0.06 * speed


def test_nothing_bounces():
    world = World(without_drag(make_system(1, **{"cable.length": 20.0})), 1, 1)
    world.state.payload_position[:], world.state.drone_position[:] = [0, 30, 0.1], [0, 0, 2.0]
    world.state.drone_rotation[:] = np.eye(3)
    world.state.rotor_speed[:] = 0
    load(world)
    world.break_cables(np.ones((1, 1), bool))
    world.hidden_loads.motors_off[:] = True
    highest, landed = 0.0, False
    for _ in range(500):
        world.step(np.zeros((1, 1, 4)))
        landed = landed or (
            world.state.drone_velocity[0, 0, 2] > -0.5 * 6.2 and world.state.drone_position[0, 0, 2] < 0.1
        )
        highest = max(highest, world.state.drone_velocity[0, 0, 2] if landed else 0.0)
    assert landed and highest < 0.7  # from 6.2 m/s
    assert world.state.drone_position[0, 0, 2] == pytest.approx(drone_half_size(world.system.vehicle)[2], abs=2e-3)


LEVER = "v 0 0 0\nv 0.5 0 0\nv 0 0.3 0\nv 0 0 0.2\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


@pytest.mark.parametrize("shape", ["box", "cylinder", "point", "mesh"])
@pytest.mark.parametrize("preset", ["x500", "crazyflie"])
def test_no_contact_is_where_none_is_searched(shape, preset, write):
    values = {"payload.shape": shape, "vehicle.preset": preset, "payload.mass": 0.02}
    if shape == "mesh":
        anchors = [[0.0, -0.05, 0.1], [-0.2, -0.05, 0.1], [0.0, -0.2, 0.1]]
        values |= {"payload.mesh": str(write(LEVER, "lever.obj")), "payload.anchors": anchors}
    world, rng = World(make_system(3, **values), 400, 1), np.random.default_rng(4)
    state, reach = world.state, 2 * world.system.payload_size.max() + 2 * drone_half_size(world.system.vehicle).max()
    state.payload_position[:] = rng.uniform(0, reach, (400, 3))
    state.drone_position[:] = state.payload_position[:, None] + rng.uniform(-reach, reach, (400, 3, 3))
    for rotation in (*state.payload_rotation, *state.drone_rotation.reshape(-1, 3, 3)):
        axis = rng.standard_normal(3)
        rotation[:] = np.reshape(axis_angle(axis / np.linalg.norm(axis), rng.uniform(0, np.pi)), (3, 3))
    state.payload_velocity[:], state.drone_velocity[:] = rng.uniform(-1, 1, (400, 3)), 0.0
    load(world)
    (shard,), data, touching = world.shards, mujoco.MjData(world.model), np.zeros(400, bool)
    shard.find_close()
    for e in range(400):
        data.qpos[:] = world.qpos(e)
        mujoco.mj_fwdPosition(world.model, data)
        touching[e] = data.ncon > 0
    assert 20 < touching.sum() and 20 < (shard.proximity == APART).sum()
    assert not touching[shard.proximity == APART].any()


def test_searching_everywhere_changes_no_bit(monkeypatch):
    newton, states = mujoco.mjtSolver.mjSOL_NEWTON, []
    monkeypatch.setattr(contact, "_SOLVER", SimpleNamespace(mjSOL_CG=newton, mjSOL_NEWTON=newton))
    for everywhere in (False, True):
        world, rng = World(make_system(3, **{"payload.mass": 0.3}), 8, 2), np.random.default_rng(5)
        world.state.payload_position[:, 2] -= 1.2
        slack = rng.uniform(0.6, 1.0, (8, 3, 1))
        world.state.drone_position[:] = world.state.payload_position[:, None] + slack * world.system.slots
        load(world)
        for shard in world.shards if everywhere else ():
            shard.find_close = lambda: False  # MuJoCo searches from the start
        hover, landed, apart = 9.81 * (world.system.vehicle.mass + 0.1) / 4, np.zeros(8, bool), np.zeros(8, bool)
        for step in range(400):
            world.step(np.full((8, 3, 4), (0.95 if step < 200 else 1.1) * hover))
            close = np.concatenate([shard.proximity for shard in world.shards])
            landed, apart = landed | (close != APART), apart | (close == APART)
        assert everywhere or (landed.any() and apart.any())
        states.append(np.concatenate([shard.batch.state for shard in world.shards]))
    assert not world.diverged.any() and np.array_equal(*states)
