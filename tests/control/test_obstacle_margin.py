"""Set-points that keep clear of what a drone sees: where they are put, and what that spares a team."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.control.formation import Goal, Reference, Smoothing
from multilift_marl.control.obstacle_margin import BESIDE, LAG, Margins, Surroundings, keep_clear, sector_planes
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError

SMOOTHING = Smoothing(6.0, 1.0, 0.004)
ALONE = {
    "scene.reserved": 0, "task_options.level": "given", "task_options.start": [-4, 0, 1.5],
    "task_options.goal": [4, 0, 1.5], "task_options.start_radius": 0.0, "env.num_envs": 1, "env.num_threads": 1,
}  # fmt: skip
AZIMUTHS = np.radians([40.0, 140.0, 220.0, 320.0])
AHEAD = 0.56  # [m] beside the line: about where the front left drone flies


def make(**keys) -> MultiliftVec:
    pillar = {"shape": "cylinder", "size": [0.3, 6], "position": [0, AHEAD, 3]}
    return ml.make_vec("navigate_senses", **ALONE, **{"scene.obstacles": [pillar]}, **keys)


def keep(place, command, points=(), margin=0.0, velocity=(0.0, 0.0, 0.0), payload=((0.0, 0.0, -1.0), 0.0), **margins):
    """Return where the command (3,) of the first drone is put; `payload`: position and heading."""
    goal, reference, (position, yaw) = Goal.zeros(1, 1), Reference.zeros(1, 1), payload
    goal.velocity[0], reference.command[0, 0] = velocity, command
    state = SimpleNamespace(drone_position=np.array(place, float).reshape(1, 1, 3))
    c, s = np.cos(yaw), np.sin(yaw)
    around = Surroundings(
        np.array(points, float).reshape(1, 1, -1, 3), np.array(position, float).reshape(1, 1, 3),
        np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]]).reshape(1, 1, 3, 3),
        sector_planes(margins.get("azimuths", AZIMUTHS)), np.zeros(3),
    )  # fmt: skip
    team = SimpleNamespace(goal=goal, reference=reference, state=state, around=around)
    kept = Margins(margin, margins.get("load", 0.0), margins.get("sector", 0.0))
    keep_clear.py_func(0, 1, team, kept, SMOOTHING)
    return reference.command[0, 0].copy()


def test_a_set_point_within_the_margin_is_put_on_its_edge():
    assert keep((0, 0, 0), (2, 0.5, 0.1), [(1, 0, 0)], 0.4) == pytest.approx((0.6, 0.5, 0.1))


def test_a_drone_within_the_margin_is_sent_out_of_it():
    assert keep((0, 0, 0), (0, 0, 0), [(0.25, 0, 0)], 0.4) == pytest.approx((-0.15, 0, 0))


def test_set_points_beyond_the_margin_stay():
    for command in ((0.5, 3, 1), (-7, 0, 0)):
        assert keep((0, 0, 0), command, [(1, 0, 0)], 0.4) == pytest.approx(command, abs=0)


def test_where_the_goal_moves_the_reference_comes_to_rest_in_the_world_at_the_edge():
    """A command that stays in the world retreats beside a goal that moves: its filter lags by that times LAG/ω."""
    speed = 0.8
    kept = keep((0, 0, 0), (2, 0, 0), [(1, 0, 0)], 0.4, (speed, 0, 0))
    assert kept == pytest.approx((0.6 - LAG / SMOOTHING.frequency * speed, 0, 0))


@pytest.mark.parametrize("seed", range(40))
def test_among_several_obstacles_it_is_in_no_margin(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (4, 3))
    points *= rng.uniform(0.55, 2.0, (4, 1)) / np.linalg.norm(points, axis=1, keepdims=True)
    kept = keep((0, 0, 0), rng.uniform(-4, 4, 3), points, 0.5)
    beside = np.abs(points[:, 2]) < BESIDE * np.linalg.norm(points, axis=1)
    lines = points * np.where(beside[:, None], [1, 1, 0], 1)
    far = np.linalg.norm(lines, axis=1)
    assert (((points - kept) * lines).sum(axis=1) / far > 0.4).all()


def test_a_point_beside_the_drone_moves_it_horizontally_one_above_it_down():
    tilt = np.arcsin(BESIDE)
    for elevation, height in ((tilt - 0.01, 0.0), (0.01 - tilt, 0.0), (tilt + 0.01, -0.1), (-tilt - 0.01, 0.1)):
        way = keep((0, 0, 0), (0, 0, 0), [(0.3 * np.cos(elevation), 0, 0.3 * np.sin(elevation))], 0.5)
        assert way[0] < -0.1
        assert abs(way[2]) < 1e-12 if height == 0.0 else way[2] / height > 0.9


def test_the_payload_is_kept_from_what_the_drone_sees_as_it_moves_along():
    payload = (0.2, 0.1, -1.0), 0.0
    point = np.array([1.2, 0.1, 0.3])  # 1 m before the payload
    kept = keep((0.5, 0.5, 0), (2.0, 0.7, 0.2), [point], load=0.4, payload=payload)
    assert kept == pytest.approx((0.5 + 0.6, 0.7, 0.2))


def test_what_is_not_seen_is_over_the_drone_and_moves_no_payload():
    kept = keep((0.3, 0, 0), (0.1, 0, 0), [(0.3, 0, 2.5)], load=0.4)
    assert kept == pytest.approx((0.1, 0, 0), abs=0)


@pytest.mark.parametrize("yaw", [0.0, 0.5, -2.0])
def test_a_drone_stays_in_its_sector_beside_the_payload(yaw):
    """Slots at 40 and 140 degrees are divided at 90, those at 40 and 320 at 0: the first drone has a quadrant."""
    c, s = np.cos(yaw), np.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    center = np.array([3.0, -2.0, 1.0])
    for command, expected in (((-0.4, -0.3), (0.1, 0.1)), ((0.7, -0.3), (0.7, 0.1)), ((0.05, 0.5), (0.1, 0.5))):
        asked, wanted = (center + turn @ [*each, 1.0] for each in (command, expected))
        place = center + turn @ [0.5, 0.5, 1.0]
        assert keep(place, asked, sector=0.1, payload=(center, yaw)) == pytest.approx(wanted)


@pytest.mark.parametrize("yaw", [0.3, -2.0])
def test_an_oblique_sector_ends_where_it_is_as_far_to_the_next_slot(yaw):
    """Slots at 20, 80 and 240 degrees: the first drone's sector is from 310 to 50."""
    edge, center = np.deg2rad(50) + yaw, np.array([3.0, -2.0, 1.0])
    along, across = np.array([np.cos(edge), np.sin(edge), 0]), np.array([np.sin(edge), -np.cos(edge), 0])
    place = center + [np.cos(0.35 + yaw), np.sin(0.35 + yaw), 1.0]
    asked = center + 0.7 * along - 0.2 * across + [0, 0, 1.0]  # 20 cm beyond the edge
    kept = keep(place, asked, sector=0.1, payload=(center, yaw), azimuths=np.radians([20.0, 80.0, 240.0]))
    assert kept == pytest.approx(center + 0.7 * along + 0.1 * across + [0, 0, 1.0])


def test_sectors_of_two_are_halves_and_of_one_all():
    assert sector_planes(np.array([0.3, 0.3 + np.pi])) == pytest.approx(
        np.array([[[np.cos(0.3), np.sin(0.3)]] * 2, [[-np.cos(0.3), -np.sin(0.3)]] * 2])
    )
    assert (sector_planes(np.array([0.3])) == 0).all() and (sector_planes(np.array([0.3, 0.3])) == 0).all()


def test_a_drone_that_touches_a_point_is_not_sent_to_nan():
    assert np.isfinite(keep((0, 0, 0), (1, 0, 0), [(0, 0, 0)], 0.4)).all()


@pytest.mark.parametrize(("margin", "touches"), [(0.0, True), (0.35, False)])
def test_a_drone_that_is_led_into_a_pillar_stops_before_it(margin, touches):
    alone = {"control.payload_margin": 0.0, "control.sector_margin": 0.0}
    vec = make(**alone, **{"control.obstacle_margin": margin, "control.max_offset": 4.0})
    vec.reset(seed=0)
    front = int(np.argmax(vec.task.goal.slots[0] @ [1, 1, 0]))
    least, ended = np.inf, False
    while not ended and vec.task.time[0] < 8.3:
        _, _, terminated, _, _ = vec.step(np.zeros((1, 4, 4)))
        ended = bool(terminated[0])
        least = min(least, np.linalg.norm(vec.world.state.drone_position[0, front, :2] - [0, AHEAD]) - 0.15)
    assert ended == touches
    if not touches:
        assert least > 0.2


def turned(rotation, points):
    """Return points (N, k, 3) of heading frames in the world's axes."""
    yaw = np.arctan2(-rotation[:, 0, 1], rotation[:, 1, 1])
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    return np.stack(
        [c * points[..., 0] - s * points[..., 1], s * points[..., 0] + c * points[..., 1], points[..., 2]], -1
    )


@pytest.mark.slow
def test_it_knows_what_drones_observe_from_where_they_took_themselves_to_be_when_they_measured():
    """Two steps and more ago, at a rate."""
    vec = make(**{
        "control.obstacle_margin": 0.35, "env.sensing": "onboard", "env.obstacles.noise": 0.05,
        "env.obstacles.delay": 2, "env.obstacles.rate": 12.5, "train.observe": None,
    })  # fmt: skip
    vec.reset(seed=0)
    own, were = vec.task.view.estimated, []
    for _ in range(150):
        were.append((own.drone_position[0].copy(), own.drone_rotation[0].copy()))
        vec.step(np.zeros((1, 4, 4)))
    readings, (position, rotation) = vec._sensing.obstacles.readings, were[148]
    measured = readings.held[0, 148 % 3].reshape(4, -1, 3)  # at the step before the last but one
    placed, observed = readings.placed[0], vec.task.view.obstacle_readings[0].reshape(4, -1, 3)
    assert placed == pytest.approx(position[:, None] + turned(rotation, measured))
    seen = (observed != [0.0, 0.0, vec.config.env.obstacles.range]).any(axis=2)
    assert 0 < seen.sum() < seen.size
    now = own.drone_position[0][:, None] + turned(own.drone_rotation[0], observed)
    assert placed[seen] == pytest.approx(now[seen])
    assert np.abs(own.drone_position[0] - position).max() > 0.05
    assert np.abs(own.drone_position[0] - vec.world.state.drone_position[0]).max() > 1e-4


@pytest.mark.parametrize("key", ["obstacle_margin", "payload_margin", "sector_margin", "swing_shift"])
def test_margins_that_keep_nothing_are_refused(key):
    given = {f"control.{key}": 0.3}
    if key in ("obstacle_margin", "payload_margin"):
        for seen in ("none", "ranges"):
            with pytest.raises(ConfigError, match=rf"{key}=0\.3 needs .*not env\.obstacle_sensing={seen}"):
                ml.make_vec("navigate", **given, **{"env.obstacle_sensing": seen})
    with pytest.raises(ConfigError, match=rf"{key}=0\.3 .*control\.action=reference, not those of velocity"):
        ml.make_vec("navigate", **given, **{"control.action": "velocity"})
