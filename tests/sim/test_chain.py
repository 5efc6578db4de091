"""Cables of masses, springs and dampers: closed forms at rest and along the cable, stability, exact replay."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, hover_thrust, load, make_system, same, steady, without_drag

from multilift_marl.math3d import axis_angle
from multilift_marl.sim import World
from multilift_marl.sim.cables.catenary import SLACK, hang
from multilift_marl.sim.cables.chain_dynamics import common_force
from multilift_marl.validation.chains import exponential, hanging_chain, straight_chain
from multilift_marl.validation.conservation import totals

CHAIN = {"cable.model": "chain"}
OPENING = (0.3, -0.7, 0.4)  # [m/s] rate of a chord
FORMATION = ("payload_position", "payload_rotation", "drone_position", "drone_rotation", "cable_tension")


def make_world(num_drones: int = 1, num_envs: int = 1, num_threads: int = 1, drag: bool = True, **overrides) -> World:
    """Return a world of teams on chains; overrides with __ for the dot."""
    overrides = {key.replace("__", "."): value for key, value in overrides.items()}
    system = make_system(num_drones, **{**CHAIN, **overrides})
    return World(system if drag else without_drag(system), num_envs, num_threads)


def chords(world: World) -> np.ndarray:
    """Return the distance of anchor and drone of each cable (E, N) [m]."""
    state, system = world.state, world.system
    anchors = state.payload_position[:, None] + np.einsum("eij,nj->eni", state.payload_rotation, system.anchors)
    return np.linalg.norm(state.drone_position - anchors, axis=-1)


def calm(world: World) -> bool:
    """Return whether nothing has diverged and MuJoCo has not warned of anything."""
    return not world.diverged.any() and not any(shard.batch.warning[:, :, 1].any() for shard in world.shards)


# At rest


@pytest.mark.parametrize("timestep", [5e-4, 1e-3, 4e-3])
@pytest.mark.parametrize("num_drones, shape", [(1, "box"), (2, "box"), (3, "point"), (4, "box"), (6, "box")])
def test_the_formation_hangs_as_statics_says(num_drones, shape, timestep):
    world = make_world(num_drones, payload__shape=shape, sim__timestep=timestep)
    before, system = world.state_dict(), world.system
    force = np.array(system.formation_force)
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, system.payload_mass * GRAVITY], atol=1e-9)
    node = 0.01 * system.cable_length / 9 * GRAVITY
    offset, tension = np.zeros((num_drones, 3)), 0.0
    for j in range(10):  # each segment carries the nodes below it
        cable_force = force + j * node[:, None] * [0, 0, 1]
        tension = np.linalg.norm(cable_force, axis=1)
        offset += cable_force / tension[:, None] * (system.cable_length / 10 + tension / 1e6)[:, None]
    world.step(hover_thrust(world), round(0.4 / timestep))
    for name in FORMATION:
        np.testing.assert_allclose(getattr(world.state, name), before[f"state.{name}"], rtol=1e-8, atol=1e-9)
    stretch, expected = chords(world)[0] - system.cable_length, np.linalg.norm(offset, axis=1) - system.cable_length
    np.testing.assert_allclose(stretch, expected, rtol=1e-4)
    np.testing.assert_allclose(world.state.cable_tension[0], tension, rtol=1e-6)
    assert calm(world)


@pytest.mark.parametrize("timestep", [5e-4, 1e-3, 4e-3])
def test_a_changed_payload_stretches_the_cable_by_its_weight_and_the_ropes(timestep):
    world = make_world(1, 5, drag=False, sim__timestep=timestep, cable__density=0.05, cable__segments=5)
    mass = np.array([0.1, 0.2, 0.35, 0.7, 1.0])
    world.set_parameters(np.ones(5, bool), payload_mass=mass)
    thrust = (mass[:, None, None] + world.system.vehicle.mass + 0.05) * GRAVITY / 4
    world.step(np.broadcast_to(thrust, (5, 1, 4)), round(1.0 / timestep))
    expected = (mass * GRAVITY + 2 * 0.0125 * GRAVITY) / 1e5  # on average a segment carries two of the four nodes
    np.testing.assert_allclose(chords(world)[:, 0] - 1, expected, rtol=1e-4)
    np.testing.assert_allclose(world.state.cable_tension[:, 0], (mass + 0.05) * GRAVITY, rtol=1e-4)
    assert world.stats.stretch_max[0] == pytest.approx(world.stats.tension_max[0] / 1e5)


@pytest.mark.parametrize("chord", [(0.3, 0.1, 0.9495), (0.9, 0, 0.4364), (0, 0, 1.00004), (1, 0, 0.001), (1, 0, -0.1)])
def test_a_hanging_chain_spans_its_chord_in_balance(chord):
    chord, links = np.array(chord) * 1.00003, np.zeros((10, 7))
    hang(tuple(chord), OPENING, 0.1, 1e6, 0.01, links)
    directions, stretch = links[:, :3], links[:, 3]
    np.testing.assert_allclose(directions.T @ (0.1 + stretch), chord, atol=1e-9)
    cable_forces = 1e6 * stretch[:, None] * directions
    np.testing.assert_allclose(np.diff(cable_forces, axis=0), np.tile([0, 0, 0.01], (9, 1)), atol=1e-6)
    np.testing.assert_allclose(links[:, 4:], np.tile(np.divide(OPENING, 10), (10, 1)))


@pytest.mark.parametrize("chord", [(0.5, 0, 0.865), (0.1, -0.3, 0.944), (0.98, 0, 0.05)])
def test_a_sagging_chain_may_span_less_than_its_length(chord):
    chord, links = np.array(chord), np.zeros((10, 7))
    assert np.linalg.norm(chord) < 1
    hang(tuple(chord), OPENING, 0.1, 1e6, 0.05, links)
    directions, stretch = links[:, :3], links[:, 3]
    np.testing.assert_allclose(directions.T @ (0.1 + stretch), chord, atol=1e-9)
    assert (stretch > 0).all()
    np.testing.assert_allclose(
        np.diff(1e6 * stretch[:, None] * directions, axis=0), np.tile([0, 0, 0.05], (9, 1)), atol=1e-6
    )


@pytest.mark.parametrize("chord", [(0, 0, 0.9999), (0.1, 0.2, 0.3), (0, 0, 0.0), (-0.8, 0, -0.2), (0, 0, -0.5)])
def test_a_slack_chain_spans_its_chord_unstretched(chord):
    links = np.zeros((10, 7))
    hang(chord, OPENING, 0.1, 1e6, 0.01, links)
    np.testing.assert_allclose(links[:, :3].sum(axis=0) * 0.1, chord, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(links[:, :3], axis=1), 1, atol=1e-12)
    assert (links[:, 3] == 0).all()
    np.testing.assert_allclose(links[:, 4:].sum(axis=0), OPENING, atol=1e-9)
    stretching = (links[:, :3] * links[:, 4:]).sum(axis=1)
    assert np.linalg.norm(chord) > SLACK or np.abs(stretching).max() < 1e-9


# In motion


@pytest.mark.parametrize(  # the integrator is of first order, and the fastest of these motions takes 0.1 ms
    "damping, timestep, tolerance", [(1000.0, 5e-4, 0.05), (1000.0, 1e-4, 0.02), (100.0, 5e-5, 0.02)]
)
def test_a_stretched_chain_moves_as_its_masses_springs_and_dampers(damping, timestep, tolerance):
    n, speed = 10, 0.2
    world = make_world(drag=False, sim__timestep=timestep, cable__damping=damping, sim__control_hz=200)
    system, rotors = world.system, world.system.vehicle
    world.state.payload_velocity[0, 2] = -speed  # thrown apart, in free fall but for the least thrust of the rotors
    load(world)
    idle = 4 * rotors.thrust_coefficient * rotors.rotor_speed_min**2
    thrust = steady(world, idle / 4)
    world.state.drone_rotation[:], world.state.drone_velocity[:] = np.eye(3), 0
    load(world)

    mass = np.full(n + 1, 0.01 / 9)
    mass[0], mass[-1] = system.payload_mass, rotors.mass
    springs = np.zeros((n + 1, n + 1))
    for j in range(n):
        springs[j : j + 2, j : j + 2] += [[1, -1], [-1, 1]]
    zero, one = np.zeros_like(springs), np.eye(n + 1)
    flow = np.block([[zero, one], [-1e6 * springs / mass[:, None], -n * damping * springs / mass[:, None]]])
    flow = np.block([[flow, np.zeros((2 * n + 2, 1))], [np.zeros((1, 2 * n + 3))]])
    flow[n + 1 : -1, -1] = -GRAVITY
    flow[2 * n + 1, -1] += idle / mass[-1]
    rest = (system.payload_mass + 0.01 / 9 * np.arange(n)) * GRAVITY / 1e6  # of the segments, at the start
    exact = np.zeros(2 * n + 3)
    exact[1 : n + 1], exact[-1] = np.cumsum(rest), 1
    exact[n + 1 : -1] = -speed * (1 - np.arange(n + 1) / n)
    propagator = exponential(flow * timestep)
    actual, expected = [], []
    for _ in range(200):
        world.step(thrust)
        exact = propagator @ exact
        actual.append(chords(world)[0, 0] - 1)
        expected.append(exact[n] - exact[0])
        if expected[-1] < 0:  # from here on it would buckle
            break
    error = np.sqrt(np.mean(np.subtract(actual, expected) ** 2) / np.mean(np.square(expected)))
    assert len(actual) > 5
    assert error < tolerance


@pytest.mark.parametrize("timestep", [4e-3, 1e-3])
@pytest.mark.parametrize("stiffness, seconds", [(1e3, 2.0), (1e4, 1.0), (1e5, 0.3)])
def test_a_load_goes_on_bouncing_on_a_lightly_damped_chain(stiffness, seconds, timestep):
    damping = 1e-3 * np.sqrt(stiffness)  # takes 0.05 % of a swing
    world, thrust = hanging_chain(1.0, timestep, cable__stiffness=stiffness, cable__damping=damping)
    start, depth = world.state.payload_position[0, 2], []
    for _ in range(round(seconds / timestep)):
        depth.append(start - world.step(thrust).payload_position[0, 2])
    exact = straight_chain(1.0, stiffness, damping, GRAVITY, timestep * np.arange(1, len(depth) + 1))
    late = len(depth) // 2
    kept = np.ptp(depth[late:]) / np.ptp(exact[late:])
    assert kept == pytest.approx(1.0, abs=0.05)  # 0.87, 0.52 and 0.13 by backward Euler


def test_a_slack_chain_holds_nothing():
    world = make_world(4)
    world.state.drone_position[..., 2] -= 0.5
    load(world)
    assert (world.state.cable_tension == 0).all()
    world.step(hover_thrust(world), 25)
    assert world.state.payload_velocity[0, 2] == pytest.approx(-0.981, rel=2e-3)
    assert world.state.cable_tension.max() < 0.2
    assert world.stats.slack_time[0] > 0.05
    assert calm(world)


@pytest.mark.parametrize("shape", ["box", "point"])
def test_momentum_changes_by_gravity_and_thrust_alone(shape):
    world = make_world(3, drag=False, payload__shape=shape, sim__timestep=1e-3)
    rng, vehicle = np.random.default_rng(0), world.system.vehicle
    world.state.drone_velocity[:] = rng.uniform(-0.5, 0.5, (1, 3, 3))
    world.state.payload_velocity[:] = rng.uniform(-0.5, 0.5, 3)
    world.state.drone_body_rates[:] = rng.uniform(-1, 1, (1, 3, 3))
    world.state.rotor_speed[:] = vehicle.rotor_speed_min
    load(world)
    thrust = np.full((1, 3, 4), vehicle.thrust_coefficient * vehicle.rotor_speed_min**2)
    before, impulse = totals(world).linear, np.zeros(3)
    for _ in range(200):
        impulse += 4e-3 * thrust[0, 0, 0] * world.state.drone_rotation[0, :, :, 2].sum(axis=0)
        world.step(thrust)
    total = world.system.weight / GRAVITY
    expected = before + impulse - [0, 0, 0.2 * GRAVITY * total]
    np.testing.assert_allclose(totals(world).linear, expected, atol=1e-9 * total)
    assert calm(world)


@pytest.mark.parametrize("shape", ["box", "point"])
def test_a_written_state_is_read_back(shape):
    world = make_world(3, payload__shape=shape)
    rng, state = np.random.default_rng(1), world.state
    if shape == "box":
        state.payload_body_rates[:] = rng.uniform(-1, 1, 3)
    for array in (state.payload_velocity, state.drone_velocity, state.drone_body_rates):
        array[:] = rng.uniform(-1, 1, array.shape)
    state.drone_position[:] += rng.uniform(-0.1, 0.1, state.drone_position.shape) - [0, 0, 0.15]
    before = {name: array.copy() for name, array in state._asdict().items()}
    load(world)
    rows = world.state_dict()["rows"].copy()
    world.load_state_dict(world.state_dict())
    assert same(world.state_dict()["rows"], rows)
    for name, array in state._asdict().items():
        if name != "cable_tension":
            np.testing.assert_allclose(array, before[name], atol=1e-9, err_msg=name)
    for n in range(3):
        points = world.cable_points(0, n)
        assert len(points) == 11
        assert (np.linalg.norm(np.diff(points, axis=0), axis=1) < 0.101).all()


@pytest.mark.parametrize("timestep", [5e-4, 1e-3, 2e-3, 5e-3])
def test_stiff_chains_are_stable_and_cause_no_warnings(timestep):
    stiff = {"cable__stiffness": 1e6, "cable__damping": 1e4}
    world = make_world(6, sim__timestep=timestep, sim__control_hz=100, payload__mass=3.0, **stiff)
    world.state.payload_velocity[0] = [0.5, 0, 0]
    load(world)
    for _ in range(10):
        world.step(hover_thrust(world), round(0.03 / timestep))
    assert calm(world)
    assert np.abs(world.state.payload_velocity).max() < 1.0
    assert world.state.cable_tension.max() < 20


@pytest.mark.parametrize("direction", [[1, 0, 0], [0, 1, 0], [0, -1, 0.001], [0, 0, -1], [0, 0, 1]], ids=str)
def test_a_cable_may_point_anywhere(direction):
    world = make_world(1, drag=False, payload__shape="point", sim__timestep=1e-3)
    world.state.payload_position[:] = [0, 0, 20]
    world.state.drone_position[:] = world.state.payload_position + 1.00001 * np.array(direction)
    world.state.drone_velocity[:] = world.state.payload_velocity[:] = [0.5, 0.2, -0.3]
    load(world)
    world.step(hover_thrust(world), 100)
    assert calm(world)
    assert chords(world)[0, 0] < 1.001


@pytest.mark.parametrize("density", [1e-4, 1e-3, 0.1])
@pytest.mark.parametrize("segments", [2, 10, 30])
def test_ropes_of_any_weight_stay_calm(density, segments):
    world = make_world(3, cable__density=density, cable__segments=segments)
    world.state.payload_velocity[0] = [0.1, 0, 0]
    load(world)
    world.step(hover_thrust(world), 100)
    assert calm(world)
    assert np.abs(world.state.cable_tension / world.system.resting_tension - 1).max() < 0.2
    assert np.abs(chords(world) - world.system.cable_length).max() < 0.005


def test_a_chain_drawn_short_moves_as_one_made_short():
    # Its light links bend 125 times as fast as those of the usual length, which substeps must follow.
    bending = {"payload__shape": "point", "cable__bending_damping": 5e-4, "cable__bending_stiffness": 1e-3}
    drawn, made = make_world(1, **bending), make_world(1, cable__length=0.2, **bending)
    drawn.set_parameters(np.ones(1, bool), cable_length=np.full((1, 1), 0.2))
    for name in ("payload_position", "drone_position", "rotor_speed"):
        getattr(drawn.state, name)[:] = getattr(made.state, name)
    for world in (drawn, made):
        world.state.payload_velocity[0] = [0.6, 0, 1.0]  # slack, and folding
        load(world)
        world.step(hover_thrust(made), 100)
        assert calm(world)
    np.testing.assert_allclose(drawn.nodes.position, made.nodes.position, atol=1e-9)
    np.testing.assert_allclose(drawn.state.payload_position, made.state.payload_position, atol=1e-9)


def test_a_light_chain_of_stiff_segments_moves_as_a_massless_cable():
    paths = []
    for overrides in ({}, {**CHAIN, "cable.density": 1e-4, "cable.segments": 20}):
        world = World(make_system(3, **{"sim.timestep": 1e-3, **overrides}), 1, 1)
        world.hidden_loads.payload_force[:] = [0.3, 0.1, 0]
        thrust, path = hover_thrust(world), []
        for _ in range(100):
            path.append(world.step(thrust, 10).payload_position[0].copy())
        paths.append(np.array(path))
    moved = np.linalg.norm(paths[0][-1] - paths[0][0])
    assert moved > 0.05
    assert np.abs(paths[1] - paths[0]).max() < 1e-3 * moved


def test_a_bent_chain_pushes_its_ends_apart():
    speeds = []
    for stiffness in (0.0, 0.5):
        world = make_world(1, cable__bending_stiffness=stiffness, sim__timestep=1e-3)
        world.state.drone_position[..., 2] -= 0.1
        load(world)
        world.step(hover_thrust(world), 50)
        speeds.append(world.state.payload_velocity[0, 2])
    assert speeds[1] < speeds[0] - 0.05  # the bent chain pushes payload and drone apart


def test_contact_that_lasts_is_what_two_steps_have_in_common():
    for before, last, expected in (
        (2.0, 3.0, 2.0),
        (3.0, 2.0, 2.0),
        (-3.0, -2.0, -2.0),
        (2.0, -3.0, 0.0),
        (0.0, 3.0, 0.0),
    ):
        assert common_force(np.array([[last], [before]]), 0) == expected


def test_the_payload_comes_to_rest_on_the_ground():
    world = make_world(4)
    world.state.payload_position[:, 2] = 0.1
    world.state.drone_position[..., 2] = 0.8
    world.state.drone_rotation[:] = np.eye(3)
    load(world)
    weight = (world.system.vehicle.mass + 0.01) * GRAVITY
    world.step(steady(world, weight / 4), 250)
    assert world.state.payload_position[0, 2] == pytest.approx(0.075, abs=2e-3)
    assert np.abs(world.state.payload_velocity).max() < 0.02
    assert calm(world)


@pytest.mark.parametrize("bending", [0.0, 1.0])
def test_a_tumbling_team_keeps_its_angular_momentum_whatever_its_bodies_are(bending):
    """Bodies of three different moments, hooks and a centre of mass off every axis, none of them level."""
    own = {"payload.center_of_mass": [0.05, -0.03, 0.04], "payload.inertia": [0.02, 0.035, 0.05]}
    hooks = {"cable.hook": [0.02, 0.03, -0.04], "vehicle.inertia": [2e-3, 3.5e-3, 5e-3]}
    settings = CHAIN | own | hooks | {"sim.timestep": 1e-3, "cable.bending_stiffness": bending}
    system = without_drag(make_system(3, **settings))
    world, rng = World(system, 1, 1), np.random.default_rng(0)
    state, turn = world.state, np.reshape(axis_angle((0.48, -0.6, 0.64), 1.2), (3, 3))
    state.drone_position[0] = state.payload_position[0] + (state.drone_position[0] - state.payload_position[0]) @ turn.T
    state.payload_rotation[0] = turn @ state.payload_rotation[0]
    state.drone_rotation[0] = turn @ state.drone_rotation[0]
    world.state.payload_body_rates[:] = rng.uniform(-4, 4, 3)
    world.state.drone_body_rates[:] = rng.uniform(-4, 4, (1, 3, 3))
    world.state.drone_velocity[:] = rng.uniform(-1, 1, (1, 3, 3))
    world.state.rotor_speed[:] = 0.0
    world.hidden_loads.motors_off[:] = True
    load(world)
    before, largest = totals(world), 0.0
    for _ in range(100):
        world.step(np.zeros((1, 3, 4)))
        largest = max(largest, float(world.state.cable_tension.max()))
        np.testing.assert_allclose(totals(world).angular, before.angular, atol=4e-3 * np.linalg.norm(before.angular))
        assert totals(world).energy < 1.001 * before.energy
    assert 10.0 < largest < 60.0 and calm(world)
