"""What drones measure of their payload and tell each other: filters, cables, anchors and losses, worked out again."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_system
from plain_kernels import plain, record, turned
from test_estimator import riccati

from multilift_marl.control.formation import Goal
from multilift_marl.mdp.env_data import Load
from multilift_marl.sensing import communication, load_filter, load_sensing
from multilift_marl.sensing import loss_detection as loss_notice
from multilift_marl.sensing.load_sensing import LoadMemory, LoadSensor
from multilift_marl.sim.state import SystemState

DT = 0.02
ANCHORS = np.array([[0.3, 0.1, 0.08], [-0.25, 0.15, 0.05], [0.05, -0.3, 0.1]])
HOOKS = np.array([[0.03, -0.05, -0.07], [-0.04, 0.02, -0.06], [0.01, 0.02, -0.05]])
POSE = np.array([0.4, -0.3, 2.0]), turned([0.3, -0.5, 0.8], 0.3)


def team(quiet: bool = True):
    """Return a scene of three drones in which nothing is alike, sensors without noise, and the load they know."""
    rng, true, planned = np.random.default_rng(3), SystemState.zeros(1, 3), Goal.zeros(1, 3)
    true.payload_position[0], true.payload_rotation[0] = POSE
    true.payload_velocity[0], true.payload_body_rates[0] = [0.5, -0.2, 0.3], [0.4, 0.7, -0.6]
    true.drone_position[0] = true.payload_position[0] + ANCHORS * [3, 3, 0] + [0, 0, 1.0]
    for n in range(3):
        true.drone_rotation[0, n] = turned(rng.normal(size=3), 0.3)
    true.drone_velocity[0], true.cable_tension[0] = rng.normal(size=(3, 3)), [3.0, 4.0, 5.0]
    planned.position[0], planned.rotation[0] = [0.3, -0.2, 1.9], turned([0.1, 0.2, 0.9], 0.25)
    planned.slots[0] = planned.position[0] + ANCHORS * [3, 3, 0] + [0, 0, 1.05]
    planned.cable_force[0], planned.drone_yaw[0] = [[0.5, 0.2, 3.0], [-0.4, 0.3, 3.1], [0.1, -0.6, 2.9]], 0.25
    rig = record(
        anchors=ANCHORS, hooks=HOOKS, hooked=True, heading=np.array([0.2, -0.3, 0.5]), mass=np.array([0.6, 0.7, 0.8]),
        cable_length=np.array([0.8, 0.9, 0.7]),
    )  # fmt: skip
    sensor = LoadSensor(DT, follow=(0.4, 0.1), turn=(0.3, 0.2))
    memory = LoadMemory(np.full(1, 77, np.uint64), np.zeros((1, 3, 3)), np.zeros((1, 3)), np.ones((1, 3), bool))
    scene = load_sensing.Scene(
        true, true, planned, rig, np.array([2.0, 3.0, 4.0]), np.zeros((1, 3, 3)), np.ones((1, 3), bool), memory, sensor
    )
    load = Load(np.zeros((1, 3, 3)), np.tile(np.eye(3), (1, 3, 1, 1)), *np.zeros((2, 1, 3, 3)), np.zeros((1, 3)))
    return scene, load


def place(n: int, position=None, rotation=None) -> np.ndarray:
    return (POSE[0] if position is None else position) + (POSE[1] if rotation is None else rotation) @ ANCHORS[n]


def planned_cable(scene, n: int) -> np.ndarray:
    """Return the cable from anchor to hook at rest at the planned pose."""
    planned, rig = scene.planned, scene.rig
    up = planned.cable_force[0, n] + [0, 0, 9.81 * rig.mass[n]]
    z, yaw = up / np.linalg.norm(up), planned.drone_yaw[0] + scene.rig.heading[n]
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0])
    y /= np.linalg.norm(y)
    hook = planned.slots[0, n] + np.stack([np.cross(y, z), y, z], axis=1) @ HOOKS[n]
    return hook - place(n, planned.position[0], planned.rotation[0])


# Filters


@pytest.mark.parametrize("maneuver, noise, dt", [(2.0, 1e-3, 0.02), (2.0, 5e-3, 0.02), (10.0, 0.02, 0.05)])
def test_gains_of_position_and_velocity_are_those_of_the_riccati_equation(maneuver, noise, dt):
    alpha, beta = load_filter.alpha_beta(maneuver, noise, dt)
    push = maneuver * np.array([dt**2 / 2, dt])
    a, c = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[1.0, 0.0]])
    p = riccati(a, c, np.outer(push, push) + 1e-18 * np.eye(2), np.array([[noise**2]]))
    gain = (p @ c.T / (c @ p @ c.T + noise**2)).ravel()
    np.testing.assert_allclose([alpha, beta / dt], gain, rtol=1e-3)


def test_a_filtered_position_moves_by_alpha_of_the_gap_and_its_velocity_by_beta():
    scene, load = team()
    load.position[0, 1], load.velocity[0, 1] = [1, 2, 3], [0.5, -0.4, 0.3]
    plain(load_filter.follow_position)(0, 1, (1.2, 1.9, 3.3), (9.0, 9.0, 9.0), load, scene.sensor, False)
    expected = np.array([1, 2, 3]) + DT * np.array([0.5, -0.4, 0.3])
    gap = np.array([1.2, 1.9, 3.3]) - expected
    np.testing.assert_allclose(load.position[0, 1], expected + 0.4 * gap)
    np.testing.assert_allclose(load.velocity[0, 1], [0.5, -0.4, 0.3] + 0.1 / DT * gap)
    before = load.position[0, 1].copy()
    plain(load_filter.predict_position)(0, 1, load, scene.sensor)
    np.testing.assert_allclose(load.position[0, 1], before + DT * load.velocity[0, 1])
    plain(load_filter.follow_position)(0, 1, (1.2, 1.9, 3.3), (9.0, 8.0, 7.0), load, scene.sensor, True)
    assert load.position[0, 1].tolist() == [1.2, 1.9, 3.3] and load.velocity[0, 1].tolist() == [9.0, 8.0, 7.0]


def test_a_filtered_attitude_turns_by_alpha_of_the_gap_in_the_world_frame():
    scene, load = team()
    start, rates = turned([0.2, 0.5, -0.3], 0.8), np.array([0.9, -0.6, 0.4])
    load.rotation[0, 1], load.body_rates[0, 1] = start, rates
    spin = start @ rates
    expected = turned(spin, DT * np.linalg.norm(spin)) @ start
    gap = np.array([0.03, -0.02, 0.05])
    measured = turned(gap, np.linalg.norm(gap)) @ expected
    plain(load_filter.follow_attitude)(0, 1, tuple(measured.ravel()), (0.0, 0.0, 0.0), load, scene.sensor, False)
    after = turned(gap, 0.3 * np.linalg.norm(gap)) @ expected
    np.testing.assert_allclose(load.rotation[0, 1], after, atol=1e-12)
    np.testing.assert_allclose(load.body_rates[0, 1], after.T @ (spin + 0.2 / DT * gap), rtol=1e-9)


# What is measured


def test_cameras_see_the_pose_of_a_moment_ago():
    scene, load = team()
    scene = scene._replace(sensor=scene.sensor._replace(delay=0.008))
    with np.errstate(over="ignore"):
        plain(load_sensing.measure_payload)(0, 1, scene, load, True)
    np.testing.assert_allclose(load.position[0, 0], POSE[0] - 0.008 * scene.true.payload_velocity[0])
    spin = POSE[1] @ scene.true.payload_body_rates[0]
    np.testing.assert_allclose(load.rotation[0, 0], turned(-spin, 0.008 * np.linalg.norm(spin)) @ POSE[1], atol=1e-12)
    assert load.tension[0].tolist() == [2.0, 3.0, 4.0]
    np.testing.assert_array_equal(load.velocity[0, 0], scene.true.payload_velocity[0])


def test_an_encoder_sees_the_direction_of_the_cable_from_the_hook():
    scene, load = team()
    scene.memory.tension_offset[0], scene.true.cable_tension[0, 2] = [0.1, -0.2, -0.9], 0.0
    with np.errstate(over="ignore"):
        plain(load_sensing.measure_cable)(0, 1, scene, load, False)
    np.testing.assert_allclose(load.tension[0], [3.0 + 0.1 * 2.0, 4.0 - 0.2 * 3.0, 0.0])
    assert scene.knows_anchor[0].tolist() == [True, True, False]
    for n in range(3):
        hook = scene.true.drone_position[0, n] + scene.true.drone_rotation[0, n] @ HOOKS[n]
        along = place(n) - hook
        reach = np.linalg.norm(planned_cable(scene, n))
        np.testing.assert_allclose(scene.anchor[0, n], hook + reach * along / np.linalg.norm(along), atol=1e-12)


def test_a_drone_whose_slot_is_lowered_takes_its_cable_to_have_its_length():
    scene, load = team()
    scene.planned.slots[0, 1, 2] -= 0.3
    assert np.linalg.norm(planned_cable(scene, 1)) < 0.9
    with np.errstate(over="ignore"):
        plain(load_sensing.measure_cable)(0, 1, scene, load, False)
    hook = scene.true.drone_position[0, 1] + scene.true.drone_rotation[0, 1] @ HOOKS[1]
    along = place(1) - hook
    np.testing.assert_allclose(scene.anchor[0, 1], hook + 0.9 * along / np.linalg.norm(along), atol=1e-12)


def test_a_slack_or_broken_cable_tells_nothing_at_a_start_either():
    scene, load = team()
    scene.true.cable_broken[0, 2], scene.true.cable_tension[0] = True, [1.0, 0.0, 1.0]
    for first in (True, False):
        with np.errstate(over="ignore"):
            plain(load_sensing.measure_cable)(0, 1, scene, load, first)
        assert scene.knows_anchor[0].tolist() == [True, False, False]


def test_an_offset_of_the_encoder_turns_the_direction_in_the_body_frame():
    scene, load = team()
    scene.memory.offset[0, 1] = [0.02, -0.03, 0.01]
    with np.errstate(over="ignore"):
        plain(load_sensing.measure_cable)(0, 1, scene, load, True)
    rotation = scene.true.drone_rotation[0, 1]
    hook = scene.true.drone_position[0, 1] + rotation @ HOOKS[1]
    along = rotation.T @ (place(1) - hook)
    along = along / np.linalg.norm(along) + [0.02, -0.03, 0.01]
    reach = np.linalg.norm(planned_cable(scene, 1)) / np.linalg.norm(along)
    np.testing.assert_allclose(scene.anchor[0, 1], hook + reach * rotation @ along, atol=1e-12)


def test_a_cable_that_is_not_seen_is_supposed_as_it_is_planned():
    scene, load = team()
    plain(load_sensing.assume_nominal_cable)(0, 1, scene, load, True)
    for n in range(3):
        hook = scene.true.drone_position[0, n] + scene.true.drone_rotation[0, n] @ HOOKS[n]
        np.testing.assert_allclose(scene.anchor[0, n], hook - planned_cable(scene, n), atol=1e-12)
        assert load.tension[0, n] == scene.resting_tension[n]


def test_an_own_anchor_gives_the_payload_in_the_planned_attitude():
    scene, load = team()
    scene.anchor[0], scene.knows_anchor[0, 2] = [place(n) for n in range(3)], False
    scene.memory.known[0, :2] = False  # no past to filter
    load.position[0, 2], load.velocity[0, 2] = [1, 2, 3], [0.1, 0.2, 0.3]
    plain(load_sensing.update_own_estimate)(0, 1, scene, load, False)
    for n in range(2):
        expected = place(n) - scene.planned.rotation[0] @ ANCHORS[n]
        np.testing.assert_allclose(load.position[0, n], expected, atol=1e-12)
        np.testing.assert_allclose(load.velocity[0, n], scene.true.drone_velocity[0, n])
        np.testing.assert_allclose(load.rotation[0, n], scene.planned.rotation[0], atol=1e-12)
    np.testing.assert_allclose(load.position[0, 2], np.array([1, 2, 3]) + DT * np.array([0.1, 0.2, 0.3]))
    plain(load_sensing.update_own_estimate)(0, 1, scene, load, True)  # an episode begins: it has not been taut
    np.testing.assert_array_equal(load.position[0, 2], scene.planned.position[0])
    np.testing.assert_array_equal(load.velocity[0, 2], scene.planned.velocity[0])


def test_levels_of_sensing_have_the_numbers_that_they_state():
    cameras = load_sensing.make_sensor("mocap", DT, 1.0)
    assert (cameras.delay, cameras.position) == (0.008, 1e-3)
    assert cameras.rotation == pytest.approx(np.radians(0.2))
    assert cameras.follow == load_filter.alpha_beta(2.0, 1e-3, DT)
    assert cameras.turn == load_filter.alpha_beta(10.0, np.radians(0.2), DT)
    encoder = load_sensing.make_sensor("onboard", DT, 1.3)
    assert (encoder.direction, encoder.tension) == (5e-3, 0.01)
    assert encoder.follow == load_filter.alpha_beta(2.0, 5e-3 * 1.3, DT)
    assert encoder.turn == load_filter.alpha_beta(10.0, 0.02, DT)
    memory = LoadMemory(np.full(1, 5, np.uint64), np.zeros((1, 4000, 3)), np.zeros((1, 4000)), np.ones((1, 4000), bool))
    with np.errstate(over="ignore"):
        plain(load_sensing.draw_offsets)(0, memory, encoder)
    np.testing.assert_allclose(memory.offset.std(axis=(0, 1)), 5e-3, rtol=0.05)
    assert memory.tension_offset.std() == pytest.approx(0.02, rel=0.05)


# What is told


@pytest.mark.parametrize("known", [(0, 1, 2), (0, 2)])
def test_anchors_that_are_known_give_the_pose_that_fits_them_and_the_planned_attitude(known):
    scene, _ = team()
    messages = communication.make_messages(1, 3, 0)
    scene.anchor[0] = [place(n) for n in range(3)]
    for m in known:
        messages.heard[0, 0, m], messages.age[0, 0, m] = place(m), 0
    position, attitude, count = plain(communication._fit)(0, 0, scene, messages)
    assert count == len(known)
    found = np.reshape(attitude, (3, 3))
    planned, prior = scene.planned.rotation[0], communication.ATTITUDE_PRIOR
    arms, places = ANCHORS[list(known)], np.array([place(m) for m in known])

    def cost(rotation):
        spread = places - places.mean(axis=0) - (arms - arms.mean(axis=0)) @ rotation.T
        away = rotation @ planned.T
        angle = np.arccos(np.clip((np.trace(away) - 1) / 2, -1, 1))
        return (spread**2).sum() + (prior * angle) ** 2

    least, rng = cost(found), np.random.default_rng(0)
    for _ in range(60):
        assert cost(turned(rng.normal(size=3), 0.01) @ found) > least - 1e-7
    np.testing.assert_allclose(position, places.mean(axis=0) - found @ arms.mean(axis=0), atol=1e-12)


def test_what_was_heard_moves_on_with_the_own_velocity_until_it_is_too_old():
    scene, _ = team()
    messages = communication.make_messages(1, 3, 0)
    messages.heard[0, 0, 2], messages.age[0, 0, 2] = [1, 2, 3], 4
    known, there = plain(communication._known_anchor)(0, 0, 2, scene, messages)
    assert known
    np.testing.assert_allclose(there, np.array([1, 2, 3]) + 4 * DT * scene.true.drone_velocity[0, 0])
    oldest = int(communication.MAX_AGE / DT + 1e-9)
    for age, expected in ((oldest, True), (oldest + 1, False)):
        messages.age[0, 0, 2] = age
        assert plain(communication._known_anchor)(0, 0, 2, scene, messages)[0] == expected
    scene.knows_anchor[0, 0] = False
    assert not plain(communication._known_anchor)(0, 0, 0, scene, messages)[0]


@pytest.mark.parametrize("delay", [0, 2])
def test_messages_arrive_late_from_partners_in_range(delay):
    position = np.array([[[0.0, 0, 0], [1.0, 0, 0], [2.5, 0, 0]]])
    partners = np.array([[0, 1, 1], [1, 0, 0], [1, 1, 0]], bool)
    links = communication.Links(partners, delay, 0.0, 1.5)
    messages = communication.make_messages(1, 3, delay)
    for step in range(5):
        content = 10.0 * step + np.arange(9.0).reshape(1, 3, 3)
        has = np.array([[True, step != 1, True]])
        with np.errstate(over="ignore"):
            sent = communication.Broadcast(position, content, has)
            plain(communication.exchange_messages)(0, 1, sent, links, messages, step == 0)
    then = 4 - delay
    for n, m in ((0, 1), (1, 0), (2, 1)):
        np.testing.assert_array_equal(messages.heard[0, n, m], 10.0 * then + np.arange(9.0).reshape(3, 3)[m])
        assert messages.age[0, n, m] == delay
    assert messages.age[0, 0, 2] == messages.age[0, 1, 2] == communication.NEVER  # too far; no partner


# Losses


def test_a_loss_changes_tensions_as_two_bodies_at_each_cable_accelerate_alike():
    system = make_system(4, **{"payload.center_of_mass": (0.02, -0.03, 0.01)})
    mass = np.array([0.6, 0.7, 0.8, 0.65])
    found, force = loss_notice.expect_changes(system, mass), system.formation_force
    size, inertia = np.linalg.norm(force, axis=1), np.reshape(system.inertia_matrix, (3, 3))
    for lost in range(4):
        keep = [n for n in range(4) if n != lost]
        tension = found[lost, keep, 0] * size[keep]
        along = force / size[:, None]
        total = (tension[:, None] * along[keep]).sum(axis=0) - force[lost]
        moment = np.cross(system.anchors[keep], tension[:, None] * along[keep]).sum(axis=0)
        moment -= np.cross(system.anchors[lost], force[lost])
        acceleration, turning = total / system.payload_mass, np.linalg.solve(inertia, moment)
        ends = acceleration + np.cross(turning, system.anchors[keep])
        np.testing.assert_allclose((ends * along[keep]).sum(axis=1), -tension / mass[keep], rtol=1e-9)
        np.testing.assert_allclose(found[lost, keep, 1], 0.5 * 0.1 * ends[:, 2], rtol=1e-9)
        assert not found[lost, lost].any()


def test_the_corner_that_sinks_most_is_that_of_the_drone_that_is_lost():
    azimuth = np.array([0.3, 1.9, -2.6, -1.2])
    view = record(goal=record(yaw=np.array([0.4])), rig=record(azimuth=azimuth))
    for tilt in ((0.1, 0.0), (0.0, 0.2), (-0.3, 0.1), (0.05, -0.2)):
        corners = np.column_stack([np.cos(0.4 + azimuth), np.sin(0.4 + azimuth), np.zeros(4)])
        sinking = np.cross([*tilt, 0.0], corners)[:, 2]
        assert plain(loss_notice.lowest_corner)(0, tilt, view) == sinking.argmin()


def feeling(time: float, tension: float, climb: float, position=(0.0, 0.0, 0.0)):
    """Return the view of four drones of which drone 0 feels its cable; losses of 1 and 3 bring alike changes."""
    changes = np.zeros((4, 4, 2))
    changes[1, 0], changes[2, 0], changes[3, 0] = [0.4, 0.1], [-0.3, -0.2], [0.41, 0.1]
    own = record(
        past=np.zeros((1, 4, 5, 2)), known=np.zeros((1, 4), bool), known_who=np.zeros((1, 4), int),
        known_when=np.zeros((1, 4)), unsure=np.zeros((1, 4), bool), noticed_at=np.zeros((1, 4, 3)),
    )  # fmt: skip
    own.past[0, 0, 0] = [1.0, 0.05]
    load = record(
        position=np.tile(position, (1, 4, 1)),
        tension=np.full((1, 4), 2.0 * tension),
        velocity=np.full((1, 4, 3), climb),
    )
    return record(
        own=own, payload_estimate=load, settings=record(changes=changes), time=np.array([time]),
        resting_tension=np.full(4, 2.0),
        goal=record(yaw=np.array([0.4])), rig=record(azimuth=np.array([0.3, 1.9, -2.6, -1.2])),
    )  # fmt: skip


@pytest.mark.parametrize(
    "time, more_tension, more_climb, who",
    [(2.1, 0.4, 0.1, 1), (2.1, -0.3, -0.2, 2), (2.1, 0.2, 0.05, None), (2.1, 0.25, 0.07, 1), (1.9, 0.4, 0.1, None)],
)
def test_a_loss_is_felt_as_the_change_that_is_nearest_to_what_it_brings(time, more_tension, more_climb, who):
    view = feeling(time, 1.0 + more_tension, 0.05 + more_climb, (0.3, 0.2, 0.1))
    plain(loss_notice.detect_drone_loss)(0, 0, view)
    assert view.own.known[0, 0] == (who is not None)
    if who is not None:
        assert view.own.known_who[0, 0] == who and view.own.known_when[0, 0] == time and view.own.unsure[0, 0]
        assert view.own.noticed_at[0, 0].tolist() == [0.3, 0.2, 0.1]
    np.testing.assert_allclose(view.own.past[0, 0, -1], [1.0 + more_tension, 0.05 + more_climb])


@pytest.mark.parametrize("lost", [1, 3])
def test_of_drones_whose_losses_feel_alike_it_is_the_one_from_which_the_payload_swings_away(lost):
    angle = 0.4 + (1.9 if lost == 1 else -1.2)
    for time, expected in ((3.39, 1), (3.41, lost)):
        view = feeling(time, 1.0, 0.05, tuple(-0.1 * np.array([np.cos(angle), np.sin(angle), 0.3])))
        view.own.known[0, 0], view.own.known_who[0, 0], view.own.known_when[0, 0] = True, 1, 3.0
        view.own.unsure[0, 0] = True
        plain(loss_notice.detect_drone_loss)(0, 0, view)
        assert view.own.known_who[0, 0] == expected and view.own.unsure[0, 0] == (time < 3.4)


def test_neighbours_are_next_to_each_other_around_the_ring():
    azimuth = np.array([0.3, 2.5, -2.0, 1.4, -0.5])
    env = record(communication="neighbours", communication_delay=1, communication_loss=0.0, communication_range=None)
    partners = communication.make_links(env, azimuth).partners
    around = np.argsort(azimuth)
    for place, n in enumerate(around):
        expected = {around[(place + 1) % 5], around[(place - 1) % 5]}
        assert set(np.flatnonzero(partners[n])) == expected
    env.communication = "all"
    assert communication.make_links(env, azimuth).partners.sum() == 20
