"""Rigs, cables at rest, hidden parameters and pushes: what is computed once, worked out again."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from conftest import GRAVITY, make_system, refusal
from plain_kernels import plain, record

from multilift_marl.config.load import load_config
from multilift_marl.rig import payload as bodies
from multilift_marl.rig.balance import formation_forces
from multilift_marl.sim import World, pushes
from multilift_marl.sim.cables import catenary, massless
from multilift_marl.sim.cables.chain_arrays import UNITS, largest_substep
from multilift_marl.sim.contact import APART, FAST, NEAR, body_radii, find_close
from multilift_marl.sim.obstacles import BOX, Obstacles
from multilift_marl.sim.parameters import MASSES, make_inertias, nominal_parameters, update_inertias
from multilift_marl.sim.randomization import Draw
from multilift_marl.sim.state import SystemState

G = 9.81

# Bodies


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_moments_of_uniform_bodies_are_those_of_a_cloud_of_points(shape):
    size = np.array([0.6, 0.6, 0.3]) if shape == "cylinder" else np.array([0.6, 0.4, 0.3])
    axes = [(np.arange(60) + 0.5) / 60 - 0.5] * 3
    points = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3) * size
    if shape == "cylinder":
        points = points[np.hypot(points[:, 0], points[:, 1]) < 0.3]
    squares = (points**2).mean(axis=0)
    expected = 1.7 * (squares.sum() - squares)
    np.testing.assert_allclose(bodies.uniform_inertia(shape, 1.7, size), expected, rtol=4e-3)


def test_points_outside_bodies_are_as_far_as_they_are():
    size = np.array([0.6, 0.6, 0.3])
    points = np.array([[0.4, 0.5, 0.25], [0.2, 0.1, 0.1], [-0.4, 0.0, 0.0], [0.24, 0.32, -0.25]])
    box = [np.sqrt(0.1**2 + 0.2**2 + 0.1**2), 0.0, 0.1, np.hypot(0.02, 0.1)]
    np.testing.assert_allclose(bodies._outside("box", size, points), box, atol=1e-12)
    rim = np.hypot(0.4, 0.5) - 0.3
    round_ = [np.hypot(rim, 0.1), 0.0, 0.1, np.hypot(0.1, 0.1)]
    np.testing.assert_allclose(bodies._outside("cylinder", size, points), round_, atol=1e-12)


def test_formation_forces_are_the_nearest_by_each_drones_strength_that_balance():
    anchors = np.array([[0.3, 0.1, 0.08], [-0.25, 0.2, 0.05], [0.05, -0.3, 0.1]])
    strength, weight, angle = np.array([0.8, 1.0, 1.2]), 12.0, np.radians(20)
    force = formation_forces(anchors, weight, angle, False, strength)
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, weight], atol=1e-9)
    np.testing.assert_allclose(np.cross(anchors, force).sum(axis=0), 0, atol=1e-9)
    outward = anchors[:, :2] - anchors[:, :2].mean(axis=0)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    nominal = weight / 3 * strength[:, None] * np.column_stack([np.tan(angle) * outward, np.ones(3)])
    rng, least = np.random.default_rng(0), (((force - nominal) / strength[:, None]) ** 2).sum()
    balance = np.concatenate(
        [np.concatenate([np.eye(3), np.cross(np.eye(3), arm) @ np.diag([-1, -1, -1])]) for arm in anchors], axis=1
    )
    free = np.linalg.svd(balance)[2][np.linalg.matrix_rank(balance) :]
    for change in rng.normal(size=(50, len(free))) @ free:
        moved = force + 0.01 * change.reshape(3, 3)
        np.testing.assert_allclose(np.cross(anchors, moved).sum(axis=0), 0, atol=1e-9)
        assert (((moved - nominal) / strength[:, None]) ** 2).sum() >= least
    alone = formation_forces(np.zeros((3, 3)), weight, angle, True, np.ones(3))
    around = 2 * pi * np.arange(3) / 3
    rings = np.column_stack([np.tan(angle) * np.cos(around), np.tan(angle) * np.sin(around), np.ones(3)])
    np.testing.assert_allclose(alone, weight / 3 * rings, atol=1e-9)


def test_standard_rigs_keep_their_distances():
    ring = load_config("hover", {"env.num_drones": 6, "payload.shape": "point"}).system
    apart = np.linalg.norm(ring.slots - np.roll(ring.slots, 1, axis=0), axis=1)
    assert apart.min() == pytest.approx(0.6, rel=2e-3)  # metres between falcons at rest, stretch aside
    four = load_config("hover").system
    np.testing.assert_allclose(four.payload_size, [0.55, 0.45, 0.15])
    corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]) * [0.27, 0.22]
    np.testing.assert_allclose(four.anchors, np.column_stack([corners, np.full(4, 0.08)]))
    assert four.payload_mass == pytest.approx(1.4) and four.cable_length.tolist() == [1.0] * 4
    assert four.min_separation[0, 1] == pytest.approx(0.35)
    mixed = load_config(
        "hover", {"env.num_drones": 2, "vehicle.preset": ["falcon", "iris"], "payload.mass": 1.0}
    ).system
    spans = [2 * vehicle.arm for vehicle in mixed.vehicles]
    assert mixed.min_separation[0, 1] == pytest.approx(0.35 * (sum(spans) / 2) / 0.212)


@pytest.mark.parametrize("shape", ["box", "point"])
def test_inertias_follow_mass_and_shape(shape):
    system = make_system(2, **{"payload.shape": shape})
    parameters = nominal_parameters(system, 2)
    parameters.payload_mass[:] *= [1.5, 0.8]
    parameters.payload_inertia[:] *= [1.2, 0.9]
    parameters.payload_center_of_mass[:] = [[0.01, 0.02, 0.03], [-0.02, 0.01, 0.0]]
    parameters.vehicle_mass[:] *= [[1.1, 0.9], [1.3, 0.7]]
    inertias = make_inertias(system, nominal_parameters(system, 2))
    update_inertias(inertias, system, parameters, np.ones(2, bool), MASSES)
    own = system.inertia_matrix
    for e in range(2):
        scale = [1.5 * 1.2, 0.8 * 0.9][e]
        matrix = scale * np.reshape(own, (3, 3))
        np.testing.assert_allclose(inertias.inertia[e, 0], matrix, rtol=1e-12)
        if shape == "box":
            np.testing.assert_allclose(inertias.inverse[e, 0] @ matrix, np.eye(3), atol=1e-12)
        else:
            assert not inertias.inverse[e, 0].any()
        np.testing.assert_array_equal(inertias.center[e], [parameters.payload_center_of_mass[e], [0] * 3, [0] * 3])
        for n in range(2):
            share = [[1.1, 0.9], [1.3, 0.7]][e][n]
            vehicle = system.vehicles[n]
            np.testing.assert_allclose(inertias.inertia[e, 1 + n], share * np.diag(vehicle.inertia), rtol=1e-12)
            np.testing.assert_allclose(inertias.inverse[e, 1 + n], np.diag(1 / (share * np.array(vehicle.inertia))))
            assert inertias.mass[e, 1 + n] == pytest.approx(share * vehicle.mass)


# Cables at rest


def test_a_heavy_cable_ends_where_its_links_lead():
    direction, tension, length, stiffness, weight, links = np.array([0.3, -0.2, 0.8]), 5.0, 1.2, 900.0, 0.6, 4
    direction = direction / np.linalg.norm(direction)
    found = plain(catenary.cable_end)(tuple(direction), tension, length, stiffness, links, weight)
    # The force grows by a node's weight from link to link; each link is a fourth of the whole, and stretches so.
    forces = tension * direction + weight * np.outer(np.arange(links) / 3 - 0.5, [0, 0, 1])
    sizes = np.linalg.norm(forces, axis=1, keepdims=True)
    ends = (length / links + sizes / (links * stiffness)) * forces / sizes
    np.testing.assert_allclose(found, ends.sum(axis=0), rtol=1e-12)
    straight = plain(catenary.cable_end)(tuple(direction), tension, length, stiffness, links, 0.0)
    np.testing.assert_allclose(straight, (length + tension / stiffness) * direction, rtol=1e-12)


@pytest.mark.parametrize("chord", [(0.5, 0.3, 0.9), (0.9, 0.0, 0.55), (0.0, 0.0, 1.1)])
def test_a_hanging_chain_is_in_balance_and_reaches_its_end(chord):
    n, length, stiffness, weight = 4, 0.25, 4000.0, 0.05
    links, opening = np.zeros((n, 7)), (0.1, -0.2, 0.3)
    plain(catenary.hang)(chord, opening, length, stiffness, weight, links)
    np.testing.assert_allclose(((length + links[:, 3:4]) * links[:, :3]).sum(axis=0), chord, atol=1e-8)
    force = stiffness * links[:, 3:4] * links[:, :3]
    np.testing.assert_allclose(np.diff(force, axis=0), np.tile([0, 0, weight], (n - 1, 1)), atol=1e-6)
    np.testing.assert_allclose(links[:, 4:], np.tile(np.array(opening) / n, (n, 1)))
    np.testing.assert_allclose(np.linalg.norm(links[:, :3], axis=1), 1.0, atol=1e-12)


@pytest.mark.parametrize("chord", [(0.5, 0.3, 0.4), (0.2, 0.0, 0.1), (0.0, 0.0, 0.6)])
def test_a_slack_chain_is_an_even_arc_below_its_chord(chord):
    n, length = 5, 0.25
    links = np.zeros((n, 7))
    plain(catenary.hang)(chord, (0.0, 0.0, 0.0), length, 1000.0, 0.05, links)
    assert (links[:, 3] == 0).all()
    np.testing.assert_allclose(length * links[:, :3].sum(axis=0), chord, atol=1e-9)
    bends = np.einsum("ij,ij->i", links[1:, :3], links[:-1, :3])
    np.testing.assert_allclose(bends, bends[0], atol=1e-12)
    places = length * np.cumsum(links[:, :3], axis=0)
    line = np.arange(1, n)[:, None] / n * np.array(chord)
    sag = (places[:-1] - line)[:, 2]
    assert np.allclose(chord[:2], 0) or (sag < 0).all()


def test_a_tendons_limit_has_the_cables_law():
    stiffness, damping, inverse = np.array([1e5, 2e4]), np.array([1e3, 50.0]), np.array([1.3, 0.7])
    solref = massless.limit_solref(stiffness, damping, inverse)
    # MuJoCo: force (A r + B v)/(I R) with R = (1 - I)/I · inverse weight
    for n in range(2):
        regulariser = (1 - 0.01) / 0.01 * inverse[n]
        np.testing.assert_allclose(-solref[n] / (0.01 * regulariser), [stiffness[n], damping[n]], rtol=1e-12)


# Contact


def test_bodies_are_near_where_their_spheres_meet_and_fast_where_they_would_pass():
    system = make_system(2)
    radii, step = body_radii(system), 0.004
    arm = system.vehicle.arm
    np.testing.assert_allclose(radii[1:], arm * np.sqrt(0.7**2 + 0.7**2 + 0.3**2))
    assert radii[0] == pytest.approx(np.linalg.norm(system.payload_size) / 2 + np.linalg.norm(system.payload_center))
    state, seen, search = SystemState.zeros(1, 2), np.full(1, 9, np.int8), plain(find_close)
    obstacles = Obstacles.zeros(1, 1)

    def find(payload, first, second, speed=0.0):
        state.payload_position[0], state.drone_position[0] = payload, [first, second]
        state.drone_velocity[0, 1] = [-speed, 0.0, 0.0]
        search(0, state, seen, radii, step, obstacles)
        return seen[0]

    far = [[0, 0, 5.0], [0, 3.0, 5.0], [3.0, 3.0, 5.0]]
    assert find(*far) == APART and not search(0, state, seen, radii, step, obstacles)
    for gap, expected in ((1.001, APART), (0.999, NEAR)):
        assert find([0, 0, gap * radii[0]], [0, 3, 5], [3, 3, 5]) == expected
        assert find([0, 0, 5], [0, 3, gap * radii[1]], [3, 3, 5]) == expected
        assert find([0, 0, 5], [0, gap * (radii[0] + radii[1]), 5], [3, 3, 5]) == expected
        assert find([0, 0, 5], [0, 3, 5], [gap * (radii[1] + radii[2]), 3, 5]) == expected
    for speed in (10.0, 30.0):
        reach = radii[1] + radii[2] + 2 * step * speed
        assert find([0, 0, 5], [0, 3, 5], [1.001 * reach, 3, 5], speed) == APART
        assert find([0, 0, 5], [0, 3, 5], [0.999 * reach, 3, 5], speed) == FAST
        assert find([0, 0, 5], [0, 3, 5], [-0.999 * reach, 3, 5], speed) == APART  # apart ever more
    close = radii[1] + radii[2]
    for speed, expected in ((1.99, NEAR), (2.01, FAST)):
        assert find([0, 0, 5], [0, 3, 5], [0.9 * close, 3, 5], speed) == expected

    obstacles.kind[0, 0], obstacles.size[0, 0], obstacles.position[0, 0] = BOX, [0.5, 0.5, 0.5], [8.0, 3.0, 5.0]
    near = 7.5 - radii[2]  # of the second drone's middle to touch the box
    for place, speed, expected in (
        (near - 0.001, 0.0, APART),
        (near + 0.001, 0.0, NEAR),
        (near - 2 * step * 10 - 0.001, 10.0, APART),
        (near - 2 * step * 10 + 0.001, 10.0, FAST),
    ):
        assert find([0, 0, 5], [0, 3, 5], [place, 3, 5], speed) == expected
    obstacles.velocity[0, 0] = [-10.0, 0.0, 0.0]  # as the drone: neither comes nearer
    assert find([0, 0, 5], [0, 3, 5], [near - 0.05, 3, 5], 10.0) == APART
    assert find([near + 0.6, 3, 5], [0, 9, 5], [near + 0.6, 9, 5]) == FAST  # it comes upon the payload


# What is drawn


def test_hidden_parameters_are_uniform_about_their_nominal_values():
    keys = {"payload_mass": 0.2, "payload_force": 1.5, "vehicle_mass": 0.1, "wind": 3.0, "cable_length": 0.05}
    config = load_config(
        "hover", {f"randomization.{key}": value for key, value in keys.items()} | {"env.num_drones": 2}
    )
    world = World(config.system, 1500, 1)
    draw = Draw(world, config.randomization, {})
    for e in range(1500):
        draw.draw(e, np.random.default_rng((7, e)), 7, (0, e, 0))
    force, wind = draw.values["payload_force"], draw.values["wind"]
    for values, middle, width in (
        (draw.parameters.payload_mass, config.system.payload_mass, 0.2 * config.system.payload_mass),
        (draw.parameters.vehicle_mass[:, 0], 0.6168, 0.06168),
        (draw.parameters.cable_length[:, 1], config.system.cable_length[1], 0.05 * config.system.cable_length[1]),
        (np.linalg.norm(force, axis=1), 0.75, 0.75),
        (np.linalg.norm(wind, axis=1), 1.5, 1.5),
        (np.arctan2(force[:, 1], force[:, 0]), 0.0, pi),
        (np.arctan2(wind[:, 1], wind[:, 0]), 0.0, pi),
    ):
        share = (values - middle) / width
        assert -1 <= share.min() < -0.99 and 0.99 < share.max() <= 1
        np.testing.assert_allclose(np.quantile(share, [0.25, 0.5, 0.75]), [-0.5, 0.0, 0.5], atol=0.08)
    assert not force[:, 2].any() and not wind[:, 2].any()


def test_pushes_come_as_a_poisson_process_and_no_harder_than_asked_for():
    keys = {"push.payload_velocity": 0.5, "push.drone_velocity": 0.8, "push.drone_rates": 2.0, "push.interval": 0.4}
    system = make_system(2, **keys)
    state, constants = pushes.make_pushes(system, 1)
    h, interval = system.timestep, 0.4 / system.timestep
    assert constants.interval == pytest.approx(interval)
    np.testing.assert_allclose(constants.force * h, [0.5 * system.payload_mass, *[0.8 * system.vehicle.mass] * 2])
    np.testing.assert_allclose(constants.torque[1:] * h, [2.0 * np.array(system.vehicle.inertia)] * 2)
    assert not constants.torque[0].any()
    state.generator[:] = 12345
    with np.errstate(over="ignore"):
        plain(pushes.start_pushes)(0, state, interval)
        rows = record(state=np.zeros((1, 30)), first=0, force=5, payload_nq=7, payload_nv=6)
        times, strengths, turns = [[], [], []], [], []
        for step in range(20_000):
            rows.state[:] = 0.0
            plain(pushes.apply_pushes)(rows, state, constants)
            for b in range(3):
                load = rows.state[0, 5 + 6 * b : 11 + 6 * b]
                if load.any():
                    times[b].append(step)
                    strengths.append(load[:3] / constants.force[b])
                    if b:
                        turns.append(load[3:] / constants.torque[b])
                    assert b or not load[3:].any()
    waits = np.concatenate([np.diff(each) for each in times])
    assert waits.mean() == pytest.approx(interval + 0.5, rel=0.15)  # rounded up
    assert waits.std() == pytest.approx(waits.mean(), rel=0.2)
    for vectors in (np.array(strengths), np.array(turns)):
        sizes = np.linalg.norm(vectors, axis=1)
        assert sizes.max() <= 1 and sizes.mean() == pytest.approx(0.5, abs=0.05)
        assert np.abs((vectors / sizes[:, None]).mean(axis=0)).max() < 0.12


def test_the_resting_rig_hangs_in_balance():
    overrides = {"cable.angle": 25, "cable.hook": (0.01, -0.02, -0.05), "payload.center_of_mass": (0.02, 0.01, -0.01)}
    system = make_system(4, **overrides)
    force, drone_weight = system.formation_force, system.vehicle.mass * G
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, system.payload_mass * G], atol=1e-9)
    np.testing.assert_allclose(np.cross(system.anchors, force).sum(axis=0), 0, atol=1e-9)
    size = np.linalg.norm(force, axis=1)
    for n in range(4):
        cable = system.cable_ends[n] - system.anchors[n]
        np.testing.assert_allclose(cable / np.linalg.norm(cable), force[n] / size[n], atol=1e-12)
        stretched = system.cable_length[n] * 1.0 + size[n] / system.cable_stiffness[n]
        assert np.linalg.norm(cable) == pytest.approx(stretched, rel=1e-12)
        lifted = force[n] + [0, 0, drone_weight]
        up = lifted / np.linalg.norm(lifted)
        hook = system.cable_ends[n] - system.slots[n]
        assert hook @ up == pytest.approx(-0.05, abs=1e-9) and np.linalg.norm(hook) == pytest.approx(np.sqrt(0.003))
        azimuth = np.arctan2(system.slots[n, 1], system.slots[n, 0])
        assert system.slot_azimuth[n] == pytest.approx(azimuth)


def test_bends_of_a_chain_fade_at_ninety_a_second_unless_it_is_said_otherwise():
    chain = {"cable.model": "chain", "cable.segments": 4, "cable.density": 0.05, "cable.length": 1.2}
    system = make_system(2, **chain)
    node, link = 0.05 * 1.2 / 3, 1.2 / 4
    np.testing.assert_allclose(system.bending_damping, 90.0 * node * link**2)
    assert make_system(2, **chain, **{"cable.bending_damping": 0.0}).bending_damping.tolist() == [0.0, 0.0]


def test_cables_may_stretch_by_a_tenth_under_the_heaviest_payload_that_is_drawn():
    """At rest each of four cables pulls a quarter of the weight over the cosine of its angle."""
    drawn = {"payload.mass": 1.0, "randomization.payload_mass": 0.5, "randomization.cable_stiffness": 0.2}
    system = make_system(4, **drawn)
    tension = 1.5 * np.linalg.norm(system.formation_force[0])
    assert 4 * system.formation_force[0, 2] == pytest.approx(GRAVITY)
    softest = tension / (0.1 * 0.8 * system.cable_length[0])
    make_system(4, **drawn, **{"cable.stiffness": 1.01 * softest})
    assert "would stretch by 10.1 %" in refusal(make_system, 4, **drawn, **{"cable.stiffness": 0.99 * softest})


@pytest.mark.parametrize("timestep", [4e-3, 1e-3])
def test_substeps_of_chains_are_the_longest_halves_of_a_step_that_bending_allows(timestep):
    bending = {"cable.bending_damping": 2e-3, "cable.bending_stiffness": 1e-3, "payload.shape": "point"}
    system = make_system(1, **{"cable.model": "chain", "sim.timestep": timestep, "sim.control_hz": 250, **bending})
    lengths = np.array([[1.0], [0.6], [0.4], [0.3]])
    mass = system.cable_mass[0] / system.cable_length[0] * lengths[:, 0] / (system.cable_segments[0] - 1)
    link = lengths[:, 0] / system.cable_segments[0]
    rate = np.maximum(16 * 2e-3 / (mass * link**2), 2 * np.sqrt(16 * 1e-3 / (mass * link**2)))
    substep = largest_substep(system, lengths) / UNITS * timestep
    limit = np.minimum(1 / rate, min(2.5e-4, timestep))
    assert (substep <= limit).all() and (2 * substep > limit).all()
    assert len(set(substep)) > 1
