"""Hidden parameters of teams of different vehicles whose cables are tied off their centres: each drone has its own."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import GRAVITY, load, make, make_system, refuse_system

from multilift_marl.rig.presets import PRESETS
from multilift_marl.sim import World

MIX = ["falcon", "hummingbird", "iris"]
HOOKS = [[0.01, 0.0, -0.05], [0.0, 0.02, 0.03], [0.0, 0.0, -0.04]]
TEAM = {"vehicle.preset": MIX, "cable.hook": HOOKS}
MODELS = pytest.mark.parametrize("model", ["massless", "chain"])
BOTH = np.ones(2, bool)
FACTORS = np.array([[1.0, 0.9, 1.2], [0.8, 1.1, 1.0]])  # (E, N)
POINT = {"payload.shape": "point", "payload.mass": 0.005, "cable.length": 90.0}


def of_each(name: str) -> np.ndarray:
    """Return a number of each drone's vehicle (N, ...)."""
    return np.array([getattr(PRESETS[preset], name) for preset in MIX], float)


def apart(**overrides) -> World:
    """Return two teams whose cables hang slack, high up and far from each other, rotors at hover speed."""
    world = World(make_system(3, **{"vehicle.preset": MIX, **POINT, **overrides}), 2, 1)
    state = world.state
    state.payload_position[:] = [0, 0, 100]
    state.drone_position[:] = np.array([[9, 0, 102], [0, 9, 102], [-9, 0, 102]])
    state.drone_rotation[:] = np.eye(3)
    steady_each(world, of_each("mass") * GRAVITY / 4)
    load(world)
    return world


def steady_each(world: World, thrust: np.ndarray) -> np.ndarray:
    """Let the rotors turn at the speeds of `thrust` (N,) [N] of each drone, and return it (E, N, 4)."""
    thrust = np.broadcast_to(thrust[:, None], (world.num_envs, 3, 4)).copy()
    world.state.rotor_speed[:] = np.sqrt(thrust / of_each("thrust_coefficient")[:, None])
    return thrust


@MODELS
def test_a_team_hangs_by_its_hooks_with_its_own_masses_cables_and_thrust(model):
    shares = {"payload_mass": 0.2, "cable_length": 0.05, "cable_stiffness": 0.4, "vehicle_mass": 0.1,
              "vehicle_thrust_coefficient": 0.08}  # fmt: skip
    settings = {f"randomization.{key}": share for key, share in shares.items()} | {"randomization.payload_force": 0.0}
    still = {"task_options.start_tilt": 0.0, "task_options.start_speed": 0.0}
    vec = make(num_envs=6, num_drones=3, **TEAM, **settings, **still, **{"cable.model": model})
    vec.reset(seed=0)
    world, p, state = vec.world, vec.world.parameters, vec.world.state
    before = state.drone_position.copy(), state.payload_position.copy()
    commanded = of_each("thrust_coefficient")[:, None] * state.rotor_speed**2
    thrust = p.vehicle_thrust_coefficient[..., None] * commanded
    lift = (thrust.sum(axis=2) * state.drone_rotation[..., 2, 2]).sum(axis=1)
    cable_mass = (world.system.cable_mass * p.cable_length / world.system.cable_length).sum(axis=1)
    weight = GRAVITY * (p.payload_mass + p.vehicle_mass.sum(axis=1) + cable_mass)
    np.testing.assert_allclose(lift, weight, rtol=1e-9 if model == "massless" else 2e-3)
    world.step(commanded, 10)
    assert np.abs(state.payload_position - before[1]).max() < 2e-4
    assert np.abs(state.drone_position - before[0]).max() < 2e-4
    assert np.abs(state.drone_body_rates).max() < 1e-2


def test_a_longer_chain_ends_at_the_hook():
    world = World(make_system(3, **TEAM, **{"cable.model": "chain"}), 2, 1)
    length = world.system.cable_length * FACTORS
    world.set_parameters(BOTH, cable_length=length)
    anchors = world.state.payload_position[:, None] + world.system.anchors
    towards = np.array([[0.6, 0.0, 0.8], [-0.6, 0.0, 0.8], [0.0, 0.6, 0.8]])
    arms = np.einsum("enij,nj->eni", world.state.drone_rotation, world.system.hooks)
    world.state.drone_position[:] = anchors + length[..., None] * towards - arms
    load(world)
    written = world.state.drone_position.copy()
    world.step(np.zeros((2, 3, 4)))
    np.testing.assert_allclose(world.state.drone_position, written, atol=2e-3)  # one step of falling


def test_masses_and_moments_of_inertia_scale_from_each_drones_own():
    world = World(make_system(3, **TEAM), 2, 1)
    world.set_parameters(BOTH, vehicle_mass=of_each("mass") * FACTORS)
    batch, bodies = world.shards[0].batch, list(world.layout.drone_bodies)
    np.testing.assert_allclose(batch.expanded("body_mass")[:, bodies], of_each("mass") * FACTORS, rtol=1e-12)
    expected = of_each("inertia") * FACTORS[..., None]
    np.testing.assert_allclose(batch.expanded("body_inertia")[:, bodies], expected, rtol=1e-12)


def test_rotors_lag_and_push_by_each_drones_own_numbers():
    world = apart(**{"randomization.vehicle_rotor_time_constant": 0.5, "randomization.vehicle_thrust_coefficient": 0.3})
    world.set_parameters(BOTH, vehicle_rotor_time_constant=FACTORS, vehicle_thrust_coefficient=FACTORS[::-1])
    weight = of_each("mass") * GRAVITY
    thrust = steady_each(world, weight / 4)
    world.step(thrust, 5)
    expected = 0.02 * GRAVITY * (FACTORS[::-1] - 1)
    np.testing.assert_allclose(world.state.drone_velocity[..., 2], expected, atol=1e-4)  # drag of so little speed
    first = np.sqrt(weight / 4 / of_each("thrust_coefficient"))
    for share, name in ((1.2, "rotor_time_constant_up"), (0.8, "rotor_time_constant_down")):
        goal = np.sqrt(share * weight / 4 / of_each("thrust_coefficient"))
        steady_each(world, weight / 4)
        world.step(share * thrust, 5)
        lag = np.exp(-0.02 / (FACTORS * of_each(name)))
        np.testing.assert_allclose(world.state.rotor_speed[..., 0], goal + (first - goal) * lag, rtol=1e-9)


def test_drag_scales_from_each_drones_own():
    drag = [[0.1, 0.1, 0.0], [0.2, 0.2, 0.0], [0.4, 0.4, 0.0]]
    world = apart(**{"randomization.vehicle_drag": 0.5, "vehicle.drag": drag})
    world.set_parameters(BOTH, vehicle_drag=FACTORS)
    world.state.drone_velocity[:] = [1.0, 0.0, 0.0]
    load(world)
    world.step(steady_each(world, of_each("mass") * GRAVITY / 4))
    lost = 1.0 - world.state.drone_velocity[..., 0]
    expected = FACTORS * [0.1, 0.2, 0.4] / of_each("mass") * world.system.timestep
    np.testing.assert_allclose(lost, expected, rtol=2e-2)  # the speed falls within the step


def test_the_drone_that_could_not_hover_is_named():
    team = {"vehicle.mass": [0.6168, 0.6168, 1.2], "payload.mass": 1.2}
    make_system(3, **team, **{"randomization.vehicle_mass": 0.2})
    for name in ("vehicle_mass", "vehicle_thrust_coefficient"):
        message = refuse_system(3, **team, **{f"randomization.{name}": 0.4})
        assert "drone 2 would need" in message and f"randomization.{name}" in message


def test_hooks_are_refused_that_only_nominal_rotors_could_hold():
    hooked = {"cable.hook": [0.05, 0.0, -0.05], "payload.mass": 1.05}
    make_system(3, **hooked, **{"randomization.vehicle_thrust_coefficient": 0.1})
    message = refuse_system(3, **hooked, **{"randomization.vehicle_thrust_coefficient": 0.3})
    most = float(re.search(r"they give [\d.]+ to ([\d.]+) N", message)[1])
    assert "hold the pull at cable.hook" in message and most == 0.7 * PRESETS["falcon"].rotor_thrust_max


def test_given_states_stretch_cables_from_the_hooks():
    vec = make(num_envs=1, num_drones=3, **{"cable.hook": [0.0, 0.0, -0.1]})
    vec.reset(seed=0)
    given = {"payload_velocity": np.zeros(3), "payload_position": [0.0, 0.0, 1.5], "payload_rotation": np.eye(3),
             "drone_rotation": np.tile(np.eye(3), (3, 1, 1)), "drone_velocity": np.zeros((3, 3))}  # fmt: skip
    ends = vec.world.system.anchors + [0, 0, 1.5] + 0.99 * (vec.world.system.cable_ends - vec.world.system.anchors)
    hooked = ends + [0.0, 0.0, 0.1]
    vec.reset(options={"state": {**given, "drone_position": hooked}})
    with pytest.raises(ValueError, match="stretches cable 0"):
        vec.reset(options={"state": {**given, "drone_position": hooked + [0.0, 0.0, 0.1]}})
