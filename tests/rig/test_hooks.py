"""Cables tied off the drones' centres of mass: equilibrium, the moment they exert, observations of them."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import floats, level, load, make, make_system, mask, refuse_system, zeros

import multilift_marl as ml
from multilift_marl.control.actions import ACTIONS
from multilift_marl.control.formation import Goal, goal_hook, place_formation, set_heading
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly_rates, hook_moment
from multilift_marl.control.setpoints import Setpoint
from multilift_marl.math3d import axis_angle, rot_z
from multilift_marl.rig.constants import make_rig
from multilift_marl.schema.control import ControlConfig
from multilift_marl.sim import World
from multilift_marl.sim.state import hook_position

BELOW = [0.0, 0.0, -0.05]
ASIDE = [[0.03, 0.02, -0.05], [0.0, 0.03, 0.02], [-0.02, 0.0, -0.04], [0.0, 0.0, 0.0]]
MODELS = ("massless", "chain")
STILL = {"randomization.payload_mass": 0, "randomization.payload_force": 0}


def hooks_of(world: World) -> np.ndarray:
    """Return where the hooks are (E, N, 3) [m]."""
    return world.state.drone_position + np.einsum("enij,nj->eni", world.state.drone_rotation, world.system.hooks)


def anchors_of(world: World) -> np.ndarray:
    """Return where the anchors are (E, N, 3) [m]."""
    anchors = np.einsum("eij,nj->eni", world.state.payload_rotation, world.system.anchors)
    return world.state.payload_position[:, None] + anchors


# Rest


@pytest.mark.parametrize("hook", [BELOW, ASIDE], ids=["below", "aside"])
@pytest.mark.parametrize("model", MODELS)
def test_a_team_rests_in_its_slots_under_rotor_thrusts_that_hold_the_moments(hook, model):
    world = World(make_system(4, **{"cable.hook": hook, "cable.model": model}), 1, 1)
    system, start = world.system, world.state.drone_position.copy()
    np.testing.assert_allclose(hooks_of(world)[0], system.cable_ends + [0, 0, 1.5], atol=1e-12)
    np.testing.assert_allclose(world.state.cable_tension[0], system.resting_tension, rtol=1e-6)
    b = np.array([vehicle.thrust_coefficient for vehicle in system.vehicles])
    thrust = b[None, :, None] * world.state.rotor_speed**2
    moments = np.einsum("nij,nj->ni", np.stack([v.allocation for v in system.vehicles]), thrust[0])[:, 1:]
    cable_forces = np.einsum("nji,nj->ni", system.resting_rotation, system.hook_force)
    np.testing.assert_allclose(moments, np.cross(system.hooks, cable_forces), atol=1e-12)
    assert np.abs(moments).max() > 0.02
    world.step(thrust, 250)
    assert np.abs(world.state.drone_position - start).max() < 1e-5
    assert np.abs(world.state.drone_body_rates).max() < 1e-4


@pytest.mark.slow
@pytest.mark.parametrize("model", MODELS)
def test_the_controller_holds_a_resting_team(model):
    vec = make("hover", num_envs=1, **STILL, **{"cable.hook": ASIDE, "cable.model": model})
    vec.reset(seed=0)
    level(vec)
    vec.controller.start(0)
    start = vec.world.state.drone_position.copy()
    np.testing.assert_allclose(start, vec.task.goal.slots, atol=1e-9)
    for _ in range(50):
        vec.step(zeros(vec))
        assert np.abs(vec.world.state.drone_position - start).max() < 1e-4


@pytest.mark.parametrize("heading", ["target", "outward"])
@pytest.mark.parametrize("action", ACTIONS)
def test_an_action_of_zero_hovers_with_every_interface(action, heading):
    hooks = {"cable.hook": ASIDE, "control.action": action, "control.heading": heading}
    vec = make("hover", num_envs=1, **STILL, **hooks)
    vec.reset(seed=0)
    level(vec)
    vec.controller.start(0)
    start = vec.world.state.drone_position.copy()
    np.testing.assert_allclose(start, vec.task.goal.slots, atol=1e-9)
    for _ in range(15):
        vec.step(zeros(vec))
    assert np.abs(vec.world.state.drone_position - start).max() < 1e-4
    assert np.abs(vec.world.state.drone_body_rates).max() < 1e-2


# Motion


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("axis, depth", [(0, 0.05), (1, 0.05), (1, 0.1)])
def test_a_drone_on_a_taut_cable_swings_about_its_hook_as_theory_says(model, axis, depth):
    """Under a constant thrust T along its own axis, cable length L, payload so heavy that it hardly moves: the angle δ
    between drone and cable obeys δ'' = -T (h/I + (1/m + h²/I)/L) δ."""
    overrides = {"cable.hook": [0, 0, -depth], "cable.length": 2.0, "sim.timestep": 1e-3, "sim.control_hz": 1000.0}
    if model == "chain":
        overrides |= {"cable.model": "chain", "cable.segments": 2, "cable.density": 1e-5}
    system = make_system(1, **overrides, **{"payload.drag_area": 0.0, "vehicle.drag": [0.0, 0.0, 0.0]})
    world, vehicle, thrust = World(system, 1, 1), system.vehicle, 8.0
    world.set_parameters(mask(1, 0), payload_mass=np.array([1e4]))
    state, tilt = world.state, 0.02
    state.payload_position[0], state.payload_rotation[0] = [0, 0, 100.0], np.eye(3)
    state.drone_rotation[0, 0] = np.reshape(axis_angle(floats(np.eye(3)[axis]), tilt), (3, 3))
    top = anchors_of(world)[0, 0] + [0, 0, 2.0 + thrust / system.cable_stiffness[0]]
    state.drone_position[0, 0] = top - state.drone_rotation[0, 0] @ system.hooks[0]
    state.rotor_speed[:] = np.sqrt(thrust / 4 / vehicle.thrust_coefficient)
    load(world)
    seen = []
    for _ in range(1000):
        world.step(np.full((1, 1, 4), thrust / 4))
        cable = (hooks_of(world) - anchors_of(world))[0, 0]
        up = state.drone_rotation[0, 0, :, 2]
        seen.append(np.cross(cable / np.linalg.norm(cable), up)[axis])
    inertia, t = vehicle.inertia[axis], 1e-3 * np.arange(1, 1001)
    frequency = np.sqrt(thrust * (depth / inertia + (1 / vehicle.mass + depth**2 / inertia) / 2.0))
    np.testing.assert_allclose(seen, tilt * np.cos(frequency * t), atol=0.02 * tilt)


def test_the_controller_feeds_the_moment_of_the_pull_forward():
    rng, system = np.random.default_rng(0), make_system(4, **{"cable.hook": ASIDE})
    gains = make_gains(ControlConfig(), system)
    for n in range(4):
        rotation = np.reshape(axis_angle(floats([0.6, 0.0, 0.8]), 0.7), (3, 3))
        cable_force, acceleration = rng.normal(size=(2, 3))
        expected = np.cross(system.hooks[n], rotation.T @ (cable_force + gains.load_share[n] * acceleration))
        found = hook_moment(n, floats(rotation), floats(cable_force), floats(acceleration), gains)
        np.testing.assert_allclose(found, expected, atol=1e-15)


@pytest.mark.parametrize("hook", [BELOW, ASIDE], ids=["below", "aside"])
def test_rates_of_zero_ask_for_no_more_than_the_moment_of_the_pull(hook):
    config = ml.load_config("hover", {"env.num_drones": 4, "cable.hook": hook})
    world = World(config.system, 1, 1)
    gains, thrust = make_gains(config.control, config.system), np.zeros((1, 4, 4))
    setpoint = Setpoint.zeros(1, 4)
    setpoint.thrust[:] = 12.0
    cable_force = config.system.hook_force[None]
    world.state.drone_body_rates[:] = 0
    fly_rates(0, 1, world.state, setpoint, cable_force, thrust, gains)
    for n, vehicle in enumerate(config.system.vehicles):
        expected = np.cross(config.system.hooks[n], world.state.drone_rotation[0, n].T @ cable_force[0, n])
        np.testing.assert_allclose(vehicle.allocation @ thrust[0, n], [12.0, *expected], atol=1e-9)


# Observations


@pytest.mark.parametrize("model", MODELS)
def test_starts_and_observations_are_of_the_hooks(model):
    vec = make("hover", num_envs=8, **{"cable.hook": ASIDE, "cable.model": model})
    observation, _ = vec.reset(seed=0)
    world, at = vec.world, vec.observation_names.index("cable_0")
    span = np.linalg.norm(hooks_of(world) - anchors_of(world), axis=-1)
    observed = np.linalg.norm(observation[..., at : at + 3], axis=-1)
    np.testing.assert_allclose(observed, span / world.system.cable_length, rtol=1e-6)
    stretch = 1 + world.state.cable_tension / world.system.cable_stiffness
    np.testing.assert_allclose(span, stretch, rtol=1e-9 if model == "massless" else 1e-4)
    place = hook_position(3, 1, world.state, world.system.hooks)
    np.testing.assert_allclose(place, hooks_of(world)[3, 1], atol=1e-12)


def test_drones_that_face_elsewhere_keep_their_hooks_where_they_were():
    system, goal = make_system(4, **{"cable.hook": ASIDE}), Goal.zeros(1, 4)
    rig = make_rig(system)
    goal.position[0], goal.rotation[0] = [1, 2, 3], np.reshape(rot_z(0.4), (3, 3))
    place_formation(0, goal, rig)
    turned = np.reshape(rot_z(0.4), (3, 3)) @ system.cable_ends.T
    hooks, slots = np.array([goal_hook(0, n, goal, rig) for n in range(4)]), goal.slots.copy()
    np.testing.assert_allclose(hooks, turned.T + [1, 2, 3], atol=1e-12)
    set_heading(0, 2.0, goal, rig)
    assert goal.drone_yaw[0] == 2.0
    np.testing.assert_allclose([goal_hook(0, n, goal, rig) for n in range(4)], hooks, atol=1e-12)
    assert np.abs(goal.slots - slots)[0, 0].max() > 0.01 and np.abs(goal.slots - slots)[0, 3].max() < 1e-12


@pytest.mark.parametrize(
    "overrides, complaint",
    [
        ({"cable.hook": [0, 0]}, r"cable\.hook must be a list of 3 numbers"),
        ({"cable.hook": [[0, 0, 0]] * 3}, r"cable\.hook lists 3 vectors for env\.num_drones=4: give one vector or one"),
        (
            {"cable.hook": [[0, 0, 0]] * 3 + [[0.3, 0, 0]]},
            r"drone 3 would need -.* of its rotors .*; move the hook nearer",
        ),
    ],
)
def test_an_impossible_hook_is_refused(overrides, complaint):
    message = refuse_system(4, **overrides)
    assert re.match(complaint, message), message


@pytest.mark.parametrize("heading", ["target", "outward"])
def test_the_rotors_that_hold_a_hook_are_those_of_the_drone_as_it_faces(heading):
    hook = np.array([0.15, 0.04, 0.0])
    message = refuse_system(4, **STILL, **{"cable.hook": hook.tolist(), "control.heading": heading})
    drone = int(re.match(r"drone (\d)", message)[1])
    low, high = (float(x) for x in re.search(r"need (\S+) to (\S+) N", message).groups())
    system = make_system(4, **STILL)
    pull, vehicle = system.formation_force[drone], system.vehicles[drone]
    force = pull + [0, 0, vehicle.mass * 9.81]
    yaw = np.arctan2(pull[1], pull[0]) if heading == "outward" else 0.0
    up = force / np.linalg.norm(force)
    left = np.cross(up, [np.cos(yaw), np.sin(yaw), 0])
    left /= np.linalg.norm(left)
    moment = np.cross(hook, np.stack([np.cross(left, up), left, up]) @ pull)
    rotors = np.linalg.solve(vehicle.allocation, [np.linalg.norm(force), *moment])
    assert (rotors.min(), rotors.max()) == pytest.approx((low, high), abs=0.006)
