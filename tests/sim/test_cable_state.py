"""What is read back after a physics step: states, tensions, slack, broken cables, and what counts as diverged."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import load, make_system, without_drag
from plain_kernels import plain, record, turned

from multilift_marl.math3d import mat_to_quat
from multilift_marl.sim import World
from multilift_marl.sim.cables import chain, chain_contact, chain_dynamics, massless
from multilift_marl.sim.cables.chain_solver import _turning
from multilift_marl.sim.cables.common import Cables
from multilift_marl.sim.parameters import Inertias
from multilift_marl.sim.state import EpisodeStats, SimData, SystemState

H, NATURAL = 1e-3, 1.0


def quaternion(rotation: np.ndarray) -> np.ndarray:
    return np.array(mat_to_quat(tuple(rotation.ravel())))


def row_of(state: SystemState, point: bool) -> tuple[np.ndarray, int, int]:
    """Return the row that MuJoCo would have for a state, and where velocities begin."""
    parts = [state.payload_position[0], *([] if point else [quaternion(state.payload_rotation[0])])]
    rates = [state.payload_velocity[0], *([] if point else [state.payload_body_rates[0]])]
    for n in range(state.drone_position.shape[1]):
        parts += [state.drone_position[0, n], quaternion(state.drone_rotation[0, n])]
        rates += [state.drone_velocity[0, n], state.drone_body_rates[0, n]]
    places, speeds = np.concatenate(parts), np.concatenate(rates)
    return np.concatenate([[7.0], places, speeds]), 1, 1 + len(places)


def flown(seed: int = 2) -> SystemState:
    rng, state = np.random.default_rng(seed), SystemState.zeros(1, 2)
    for array in state[:8]:
        array[:] = rng.normal(size=array.shape)
    state.payload_rotation[0] = turned(rng.normal(size=3), 0.8)
    for n in range(2):
        state.drone_rotation[0, n] = turned(rng.normal(size=3), 0.5)
    return state


def read(after: SystemState, before: SystemState, tension, length=(1.0, 1.0), point: bool = False, breaking=(1e9, 1e9)):
    """Return state, statistics and whether the simulation counts as diverged, read after a step of massless cables."""
    line, qpos, qvel = row_of(after, point)
    rows = record(
        state=line[None], first=0, qpos=qpos, qvel=qvel, payload_nq=3 if point else 7, payload_nv=3 if point else 6
    )
    data = SimData(before, EpisodeStats.zeros(1), np.zeros(1, bool))
    data.stats.tension_min[:] = 1e9
    cables = Cables(
        H, np.array([[0.1, 0.2, 0.05], [-0.2, 0.1, 0.04]]), np.array([[0.01, 0.02, -0.05]] * 2),
        np.full((1, 2), NATURAL), np.full((1, 2), 2e4), np.full(2, 50.0), np.array(breaking),
    )  # fmt: skip
    inertia = np.tile(np.diag([0.02, 0.03, 0.04]), (1, 3, 1, 1))
    bodies = Inertias(np.array([[1.4, 0.6, 0.7]]), inertia, np.linalg.inv(inertia), np.zeros((1, 3, 3)))
    view = massless.MasslessCables(cables, bodies, np.zeros((1, 3, 3)), np.zeros(3))
    plain(massless.read_state)(rows, np.array([tension]), np.array([length]), data, view)
    return data


@pytest.mark.parametrize("point", [False, True])
def test_a_state_is_read_back_as_it_was(point):
    after, before = flown(), flown(5)
    before.cable_tension[:] = 1.0
    data = read(after, before, [3.0, 4.0], point=point)
    assert not data.diverged[0]
    for name in SystemState._fields[:8]:
        if not (point and name in ("payload_rotation", "payload_body_rates")):
            np.testing.assert_allclose(getattr(data.state, name), getattr(after, name), atol=1e-12, err_msg=name)
    assert data.state.cable_tension[0].tolist() == [3.0, 4.0]
    stats = data.stats
    assert (stats.tension_min[0], stats.tension_max[0], stats.tension_peak[0], stats.slack_time[0]) == (
        3.0,
        4.0,
        4.0,
        0.0,
    )
    assert stats.stretch_max[0] == pytest.approx(4.0 / 2e4)


def test_time_with_any_cable_slack_adds_up_and_loads_break_their_cable():
    before = flown(5)
    before.cable_tension[:] = 1.0
    data = read(flown(), before, [0.0, 9.0], breaking=(8.0, 8.5))
    assert data.stats.slack_time[0] == H and data.state.cable_broken[0].tolist() == [False, True]


def test_a_cable_that_goes_taut_has_the_peak_of_its_snatch_and_may_break_by_it():
    before, along = SystemState.zeros(1, 2), np.array([0.48, 0.36, 0.8])
    anchor, hook = np.array([0.1, 0.2, 0.05]), np.array([0.01, 0.02, -0.05])
    before.drone_position[0] = anchor - hook + 0.999 * along
    before.drone_velocity[0, 0] = 2.0 * along
    before.cable_tension[0] = [0.0, 5.0]
    for limit, broken in ((130.0, False), (90.0, True)):  # c v is 100 N, and the spring adds to it
        state, after = (SystemState(*(array.copy() for array in before)) for _ in range(2))
        data = read(after, state, [6.0, 6.0], breaking=(limit, limit))
        assert 100.0 < data.stats.tension_peak[0] < 130.0 and data.stats.tension_max[0] == 6.0
        assert data.state.cable_broken[0].tolist() == [broken, False]


@pytest.mark.parametrize("name, bound", [("payload_velocity", 100.0), ("payload_body_rates", 500.0),
                                         ("drone_velocity", 100.0), ("drone_body_rates", 500.0)])  # fmt: skip
@pytest.mark.parametrize("axis", range(3))
def test_a_simulation_beyond_its_bounds_has_diverged_and_keeps_its_last_state(name, bound, axis):
    for factor, expected in ((0.999, False), (1.001, True), (np.nan, True)):
        after, before = flown(), flown(5)
        before.cable_tension[:] = 1.0
        getattr(after, name)[0].reshape(-1, 3)[-1, axis] = -factor * bound
        old = before.payload_position.copy()
        data = read(after, before, [3.0, 4.0])
        assert data.diverged[0] == expected
        assert np.array_equal(data.state.payload_position, old) == expected


@pytest.mark.parametrize("tension, length, expected", [
    ([3.0, 4.0], [1.0, 1.199], False), ([3.0, 4.0], [1.0, 1.201], True), ([3.0, 0.0], [1.0, 9.0], False),
    ([3.0, np.nan], [1.0, 1.0], True), ([np.inf, 1.0], [1.0, 1.0], True),
])  # fmt: skip
def test_a_cable_that_is_stretched_by_a_fifth_has_diverged(tension, length, expected):
    before = flown(5)
    before.cable_tension[:] = 1.0
    assert read(flown(), before, tension, length).diverged[0] == expected


@pytest.mark.parametrize("place", [0, 2, 5, 9, 15, 20])
def test_no_number_of_a_place_may_be_infinite(place):
    after, before = flown(), flown(5)
    before.cable_tension[:] = 1.0
    flat = [after.payload_position[0], after.drone_position[0, 0], after.drone_position[0, 1]]
    flat[place % 3][place % 2] = np.inf
    assert read(after, before, [3.0, 4.0]).diverged[0]


# Chains


def test_lasting_contact_is_what_two_steps_have_in_common():
    common = plain(chain_dynamics.common_force)
    for last, before, expected in ((3, 2, 2), (2, 3, 2), (-3, -2, -2), (-1, -2, -1), (3, -2, 0), (0, 2, 0), (2, 0, 0)):
        assert common(np.array([[float(last)], [float(before)]]), 0) == expected


def test_a_link_that_turns_is_longer_than_its_projection_by_what_it_states():
    d, opening, size, h = np.array([0.6, 0.0, 0.8]), np.array([1.0, -2.0, 0.5]), 0.3, 0.05
    after = np.linalg.norm(size * d + h * opening)
    expected = (after - size) / h - d @ opening
    assert plain(_turning)(tuple(d), size, tuple(opening), h) == pytest.approx(expected, rel=1e-9)


def chain_motion():
    """Return chains of two cables of two and three links in motion."""
    rng = np.random.default_rng(1)
    motion = record(
        velocity=rng.normal(size=(1, 3, 3)), rates=rng.normal(size=(1, 3, 3)), position=rng.normal(size=(1, 3, 3)),
        stretch=0.01 * rng.random((1, 2, 3)), rotation=np.stack([[turned(rng.normal(size=3), 0.6) for _ in range(3)]]),
    )  # fmt: skip
    nodes = record(position=rng.normal(size=(1, 2, 2, 3)), velocity=rng.normal(size=(1, 2, 2, 3)))
    return record(motion=motion, nodes=nodes, segments=np.array([2, 3]), length=np.array([[0.5, 0.4]]))


def test_chains_diverge_by_speed_rates_stretch_and_what_is_not_finite():
    sound = plain(chain._is_sound)
    assert sound(0, [False, False], chain_motion())
    for name, bound in (("velocity", 100.0), ("rates", 500.0)):
        for factor in (0.999, 1.001):
            own = chain_motion()
            getattr(own.motion, name)[0, 2, 1] = -factor * bound
            assert sound(0, [False, False], own) == (factor < 1)
    for stretch, expected in ((0.0799, True), (0.0801, False)):
        own = chain_motion()
        own.motion.stretch[0, 1, 2] = stretch  # a fifth of 0.4 m
        assert sound(0, [False, False], own) == expected and sound(0, [False, True], own)
    for array, place in (("position", (0, 1, 1, 2)), ("velocity", (0, 0, 0, 0))):
        own = chain_motion()
        getattr(own.nodes, array)[place] = np.nan
        assert not sound(0, [False, False], own)
    own = chain_motion()
    own.motion.position[0, 0, 1] = np.inf
    assert not sound(0, [False, False], own)


@pytest.mark.parametrize("touched", [False, True])
def test_bodies_go_from_their_centres_of_mass_to_their_origins_and_by_mujocos_velocities_in_contact(touched):
    own, h = chain_motion(), 0.004
    center, rng = np.array([[[0.02, -0.03, 0.01], [0, 0, 0], [0, 0, 0]]]), np.random.default_rng(6)
    heavy = record(center=center, mass=np.full((1, 3), 1e9), inverse=np.zeros((1, 3, 3, 3)))  # contact is no impact
    own.bodies, own.cables = heavy, record(timestep=h)
    own.nodes.contact = rng.normal(size=(1, 3, 2, 6))
    before, line = own.nodes.contact.copy(), rng.normal(size=60)
    motion = own.motion
    old = {name: getattr(motion, name)[0].copy() for name in ("position", "velocity", "rates", "rotation")}
    contact = rng.normal(size=18) if touched else np.zeros(18)
    rows = record(qpos=0, qvel=30, payload_nq=7, payload_nv=6)
    plain(chain_contact.add_contact)(0, line, contact, None, own, rows, None)
    for b in range(3):
        rotation = old["rotation"][b]
        place = old["position"][b] - rotation @ center[0, b]
        velocity = old["velocity"][b] - rotation @ np.cross(old["rates"][b], center[0, b])
        rates = old["rates"][b]
        if touched:
            new, faster = line[30 + 6 * b : 33 + 6 * b], line[33 + 6 * b : 36 + 6 * b]
            place, velocity = place + h * (new - velocity), new
            change = h * (faster - rates)
            rotation, rates = rotation @ turned(change, np.linalg.norm(change)), faster
        for name, expected in (("position", place), ("velocity", velocity), ("rates", rates), ("rotation", rotation)):
            np.testing.assert_allclose(getattr(motion, name)[0, b], expected, atol=1e-12, err_msg=name)
        np.testing.assert_array_equal(own.nodes.contact[0, b, 1], before[0, b, 0])
        np.testing.assert_array_equal(own.nodes.contact[0, b, 0], contact[6 * b : 6 * b + 6])
    line = np.full(60, 77.0)
    plain(chain._write_motion)(0, line, motion, rows)
    for b in range(3):
        np.testing.assert_array_equal(line[7 * b : 7 * b + 3], motion.position[0, b])
        np.testing.assert_allclose(line[7 * b + 3 : 7 * b + 7], quaternion(motion.rotation[0, b]))
        expected = [*motion.velocity[0, b], *motion.rates[0, b]]
        np.testing.assert_array_equal(line[30 + 6 * b : 36 + 6 * b], expected)


def test_dampers_take_the_energy_that_a_stretched_chain_loses():
    values = {"cable.model": "chain", "cable.segments": 3, "payload.shape": "point", "cable.damping": 300.0}
    world = World(without_drag(make_system(1, **values, **{"sim.timestep": 1e-4, "sim.control_hz": 1000})), 1, 1)
    state, own = world.state, world.cables
    state.payload_position[:], state.drone_rotation[:] = [0, 0, 50], np.eye(3)
    state.drone_position[:] = [0, 0, 50 + 1.002 * world.system.cable_length[0]]
    state.rotor_speed[:] = 0.0
    load(world)
    world.hidden_loads.motors_off[:] = True
    masses = np.array([world.system.payload_mass, *[own.node_mass[0, 0]] * 2, world.system.vehicle.mass])

    def energy() -> float:
        nodes = own.nodes
        places = np.array([state.payload_position[0], *nodes.position[0, 0], state.drone_position[0, 0]])
        speeds = np.array([state.payload_velocity[0], *nodes.velocity[0, 0], state.drone_velocity[0, 0]])
        stretch = np.linalg.norm(np.diff(places, axis=0), axis=1) - own.length[0, 0]
        kinetic = 0.5 * (masses * (speeds**2).sum(axis=1)).sum()
        return kinetic + 9.81 * (masses * places[:, 2]).sum() + 0.5 * own.stiffness[0, 0] * (stretch**2).sum()

    begin, taken = energy(), 0.0
    for _ in range(200):
        world.step(np.zeros((1, 1, 4)))
        taken += own.motion.dissipated[0]
    assert begin - energy() > 0.01
    assert taken == pytest.approx(begin - energy(), rel=0.05)  # what the implicit law itself damps is beside it


@pytest.mark.parametrize("across", [0.0, 4.0])
def test_a_links_tension_is_its_law_in_a_substep_however_it_turns(across):
    values = {"cable.model": "chain", "cable.segments": 3, "payload.shape": "point", "cable.damping": 20.0}
    world = World(without_drag(make_system(1, **values, **{"sim.timestep": 5e-5, "sim.control_hz": 1000})), 1, 1)
    state, own = world.state, world.cables
    state.payload_position[:], state.drone_rotation[:] = [0, 0, 50], np.eye(3)
    state.drone_position[:] = [0, 0, 50 + 1.0005 * world.system.cable_length[0]]
    state.drone_velocity[0, 0] = [across, 0.0, 0.1]
    state.rotor_speed[:] = 0.0
    load(world)
    world.hidden_loads.motors_off[:] = True

    def stretch() -> float:
        top = state.drone_position[0, 0] - own.nodes.position[0, 0, 1]
        return float(np.linalg.norm(top)) - own.length[0, 0]

    k, c, calming, past = own.stiffness[0, 0], own.damping[0], 0.01, [stretch()]
    for _ in range(5):
        world.step(np.zeros((1, 1, 4)))
        past.append(stretch())
        if len(past) < 3:
            continue
        earlier, before, after = past[-3:]
        mean = before + 0.5 * (1 + calming) * (after - before) - 0.5 * (1 - calming) * (before - earlier)
        expected = k * mean + c * (after - before) / world.system.timestep
        assert state.cable_tension[0, 0] == pytest.approx(max(expected, 0.0), rel=2e-4, abs=0.005)
    assert state.cable_tension[0, 0] > 5.0


def test_a_taut_chain_starts_with_the_velocities_of_its_ends_evenly_spread():
    values = {"cable.model": "chain", "cable.segments": 3, "cable.hook": (0.03, -0.02, -0.06)}
    world = World(make_system(1, **values), 1, 1)
    state, system, own = world.state, world.system, world.cables
    state.drone_rotation[0, 0], state.payload_rotation[0] = turned([1, 2, 3], 0.3), turned([2, -1, 1], 0.2)
    state.payload_velocity[0], state.payload_body_rates[0] = [0.4, -0.3, 0.2], [0.5, 0.6, -0.7]
    state.drone_velocity[0, 0], state.drone_body_rates[0, 0] = [0.1, 0.5, 0.3], [2.0, -3.0, 1.5]
    anchor = state.payload_position[0] + state.payload_rotation[0] @ system.anchors[0]
    hook = state.drone_rotation[0, 0] @ system.hooks[0]
    state.drone_position[0, 0] = anchor + [0, 0, 1.001 * system.cable_length[0]] - hook
    load(world)
    low = state.payload_velocity[0] + state.payload_rotation[0] @ np.cross([0.5, 0.6, -0.7], system.anchors[0])
    high = state.drone_velocity[0, 0] + state.drone_rotation[0, 0] @ np.cross([2.0, -3.0, 1.5], system.hooks[0])
    for j in range(2):
        expected = low + (j + 1) / 3 * (high - low)
        np.testing.assert_allclose(own.nodes.velocity[0, 0, j], expected, atol=1e-12)
