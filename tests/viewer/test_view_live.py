"""The browser view of a flight on ROS 2 topics: what is shown is what is published, and nobody waits for it."""

from __future__ import annotations

import os
import time

import numpy as np
import pytest

import multilift_marl as ml

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
pytest.importorskip("viser")

from page_peer import PagePeer
from ros_wire import Wire

from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.live import LivePublisher
from multilift_marl.deploy.ros.messages import CABLES, PATH, FlightMessages, path
from multilift_marl.deploy.ros.stages import Stage
from multilift_marl.math3d import quat_to_mat
from multilift_marl.rendering import Stage as Scene
from multilift_marl.viewer import live
from multilift_marl.viewer.live import LiveSession
from multilift_marl.viewer.page import Page

DOMAIN = 160 + int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
NAMES = ("multilift", "report", "crazyswarm2")


def make_flight(seed=3, **changes):
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, num_drones=2, **{"payload.mass": 0.7} | changes)
    vec.reset(seed=seed)
    return vec


def publish(wire, vec, names, time_ns, stage=Stage.TRAJECTORY):
    messages = FlightMessages(vec, wire.store, names)
    messages.stages = np.full(vec.num_drones, stage)
    for name, message in messages.messages(time_ns):
        if name in wire.topics:
            wire.queues[name].append(message)


def poses(qpos, first):
    """Return the positions and rotations of bodies of MuJoCo's coordinates; of a point its position alone."""
    bodies = [qpos[:first], *qpos[first:].reshape(-1, 7)]
    places = np.stack([body[:3] for body in bodies])
    return places, np.array([quat_to_mat(*body[3:]) for body in bodies if len(body) > 3])


@pytest.mark.parametrize("names", NAMES)
@pytest.mark.parametrize("shape", ["box", "point"])
def test_the_team_is_shown_where_it_is(names, shape):
    vec, wire = make_flight(**{"payload.shape": shape}), Wire()
    session = LiveSession(vec.config, wire, names)
    publish(wire, vec, names, 5_000_000_000)
    session.advance(0.0)
    shown = session.vec
    first = 7 if shape == "box" else 3
    for found, true in zip(poses(shown.world.qpos(0), first), poses(vec.world.qpos(0), first), strict=True):
        np.testing.assert_allclose(found, true, atol=1e-9)
    assert np.ptp(poses(vec.world.qpos(0), first)[0], axis=0).min() > 0.01  # and not all in one place
    state = shown.world.state
    np.testing.assert_array_equal(state.payload_position, vec.world.state.payload_position)
    np.testing.assert_array_equal(state.drone_position, vec.world.state.drone_position)
    np.testing.assert_array_equal(state.cable_tension, vec.world.state.cable_tension)
    np.testing.assert_array_equal(shown.task.goal.position, vec.task.goal.position)
    np.testing.assert_allclose(shown.task.goal.rotation, vec.task.goal.rotation, atol=1e-9)
    assert shown.steps[0] * shown.task.dt == pytest.approx(5.0)
    off = 100 * np.linalg.norm(vec.world.state.payload_position[0] - vec.task.goal.position[0])
    words = session.status()
    assert f"payload {off:.1f} cm off" in words and "5.0 s" in words and "nothing" not in words
    assert ("stage trajectory" in words) == (names == "report")


@pytest.mark.parametrize("names", NAMES)
def test_publishers_keep_nothing_for_a_view(names):
    wire = Wire()
    LiveSession(make_flight().config, wire, names)
    assert len(wire.topics) >= 6
    assert not any(topic.reliable or topic.latched for topic in wire.topics.values())


def test_who_is_silent_is_named_and_a_flight_that_begins_again_is_shown(monkeypatch):
    monkeypatch.setattr(live, "_SILENT", 0.05)
    vec, wire = make_flight(), Wire()
    session = LiveSession(vec.config, wire, "report")
    session.advance(0.0)
    assert "**no flight is heard** yet" in session.status() and "no /target is heard" in session.status()
    publish(wire, vec, "report", 9_000_000_000, Stage.TAKE_OFF)
    wire.queues["/simulation/position_drone_2"].clear()
    session.advance(0.0)
    assert "nothing is heard of drone 1" in session.status() and "stage take-off" in session.status()
    publish(wire, vec, "report", 9_020_000_000)
    session.advance(0.0)
    assert "heard" not in session.status()
    time.sleep(0.06)
    assert "**no flight is heard** for 0 s" in session.status()
    vec.reset(seed=4)
    for time_ns in range(0, 120_000_000, 20_000_000):  # the clock begins anew
        publish(wire, vec, "report", time_ns)
        session.advance(0.0)
    assert "heard" not in session.status() and session.vec.steps[0] == 100_000_000
    np.testing.assert_array_equal(session.vec.world.state.drone_position, vec.world.state.drone_position)


def test_who_is_put_elsewhere_begins_a_new_trail():
    vec, wire = make_flight(), Wire()
    session = LiveSession(vec.config, wire)
    for time_ns, moved, episodes in ((0, 0.0, 0), (1, 0.9, 0), (2, 1.1, 1)):
        vec.world.state.payload_position[0, 0] += moved
        publish(wire, vec, "multilift", time_ns)
        if not time_ns:
            session.advance(0.0)  # from where it is at rest
            session.vec.episodes[:] = 0
        session.advance(0.0)
        assert session.vec.episodes[0] == episodes


def test_the_planned_path_is_shown_and_what_cannot_be_is_left_out():
    vec, wire = make_flight(), Wire()
    session = LiveSession(vec.config, wire)
    assert session.vec.task.target_path(0).shape == (0, 3)
    points = np.arange(12.0).reshape(4, 3)
    wire.queues["/path"] = [path(wire.store, 0, points)]
    session.advance(0.0)
    np.testing.assert_array_equal(session.vec.task.target_path(0), points)
    wire.queues["/path"] = [path(wire.store, 0, points + [0, np.nan, 0])]
    publish(wire, vec, "multilift", 0)
    wire.queues["/cables"][0].effort = np.ones(3)
    session.advance(0.0)
    np.testing.assert_array_equal(session.vec.task.target_path(0), points)
    assert session.vec.heard.tension is None
    assert wire.reader.left_out == {"/path": 1, "/cables": 1}
    assert wire.topics["/path"].kind == PATH and wire.topics["/cables"].kind == CABLES


def test_the_page_says_that_no_flight_is_there_and_then_shows_the_positions_published():
    vec, here, there = make_flight(), Node(domain=DOMAIN), Node(domain=DOMAIN)
    session = LiveSession(vec.config, there, "report")
    page = Page(session, port=0)
    peer, publisher, times = PagePeer(page.address), LivePublisher(here, "report"), iter(range(0, 10**12, 10**7))

    def show(condition):
        def shown():
            session.advance(0.0)
            page.draw()
            return condition()

        return shown

    scene = Scene(vec)
    scene.update(0)
    visible = (scene.model.geom_rgba[:, 3] > 0) & (scene.model.geom_bodyid > 0)
    true = scene.data.geom_xpos[visible]
    assert len(true) > 10

    def error():
        shown = peer.positions()
        return np.linalg.norm(true[:, None] - shown[None], axis=2).min(axis=1).max() if len(shown) else np.inf

    def is_there():
        publisher.send(vec, next(times), np.full(2, Stage.TRAJECTORY))
        return error() < 1e-5 and "stage trajectory" in peer.text()

    try:
        assert peer.until(show(lambda: "no flight is heard" in peer.text()))
        assert error() > 0.1
        assert peer.until(show(is_there)), (error(), peer.text())
        assert "no flight" not in peer.text()
        assert set(page.controls) == {"status", "follow"}
        page.controls["follow"].value = False
        page.press("follow")
        assert not page._follow
    finally:
        peer.close()
        page.close()
