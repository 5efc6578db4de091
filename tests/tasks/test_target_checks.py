"""Targets in the ground or beyond the team's thrust are refused; those that come too late in an episode are said."""

import logging

import numpy as np
import pytest
from conftest import make, refusal

from multilift_marl.errors import warn_once

STRAIGHT = {
    "task_options.level": "given", "task_options.start": [-3, 0, 1.5], "task_options.goal": [3, 0, 1.5],
    "scene.reserved": 0,
}  # fmt: skip
HELIX = {"path": "helix", "climb": 5.0, "rate": 0.5}


def options(**values):
    return {f"task_options.{name}": value for name, value in values.items()}


@pytest.mark.parametrize(
    ("task", "changes"),
    [
        *((task, options(target_height=[0.01, 0.02])) for task in ("hover", "loss", "pose", "recover", "regroup")),
        ("hover", options(target_height=[-1.0, 2.0])),
        ("gate", options(height=0.01)),
        ("land", options(start_height=0.01)),
        ("takeoff", options(target_height=0.01)),
        ("navigate", STRAIGHT | options(goal=[3, 0, -1.5])),
        ("navigate", STRAIGHT | options(goal=[3, 0, 0.01])),
        ("navigate", STRAIGHT | options(start=[-3, 0, -1.5])),
        ("track", options(height=0.01)),
        ("track", options(path="random", room=[3, 3, 5])),
        ("track", options(path=["circle", "random"], room=[3, 3, 5])),
        ("track", options(**HELIX) | {"env.episode_seconds": 100.0}),
    ],
)
def test_targets_in_the_ground_are_refused(task, changes):
    message = refusal(make, task, **changes)
    assert message.startswith("task_options.")
    assert "the payload would touch the ground; keep it above 0.08 m" in message  # half of 0.15 m, and 5 mm


def test_the_least_height_is_that_of_the_payloads_lowest_point():
    tall = {"payload.size": [0.4, 0.4, 1.0]}
    assert "above 0.505 m" in refusal(make, "hover", **tall, **options(target_height=[0.5, 1.0]))
    make("hover", **tall, **options(target_height=[0.51, 1.0]))


def test_a_helix_that_has_not_come_to_its_low_part_may_have_any():
    make("track", **options(**HELIX))  # 20 s: it only goes up


def test_random_paths_stay_above_the_ground_where_their_way_points_do():
    vec = make("track", num_envs=64, **options(path="random", room=[3, 3, 1.9], speed=4.0, acceleration=4.0))
    vec.reset(seed=0)
    lowest = min(vec.task.target_path(e)[:, 2].min() for e in range(64))
    assert 0.08 <= lowest < 0.2


def test_tilted_targets_keep_the_lowest_point_of_a_payload_hung_high_above_the_ground():
    hung = {
        "payload.size": [0.4, 0.4, 0.8],
        "payload.center_of_mass": [0, 0, 0.3],
        "payload.anchors": [[0.2, 0.2, 0.4], [-0.2, 0.2, 0.4], [-0.2, -0.2, 0.4], [0.2, -0.2, 0.4]],
    }
    vec = make("pose", num_envs=32, **hung, **options(target_height=[0.6, 1.5], target_tilt=20.0))
    vec.reset(seed=0)
    system, goal = vec.world.system, vec.task.goal
    corners = system.payload_center + system.payload_size / 2 * np.array(
        [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
    )
    heights = goal.position[:, 2:] + goal.rotation[:, 2] @ corners.T
    assert system.payload_center[2] < -0.2 and 0.0999 < heights.min() < 0.2


@pytest.mark.parametrize(
    ("task", "changes", "key"),
    [
        ("track", options(path="circle", radius=1000.0, rate=1.0), "task_options.rate=1 rad/s with radius=1000 m"),
        ("track", options(path="helix", radius=1.0, rate=[0.1, 6.0]), "task_options.rate=6 rad/s with radius=1 m"),
        *(
            ("track", options(path=form, speed=50.0, acceleration=30.0), "task_options.speed=50 m/s and acceleration")
            for form in ("figure8", "lemniscate", "random")
        ),
        ("track", options(speed=[1.0, 50.0]), "task_options.speed=50 m/s"),  # within the 2 s from rest
        ("navigate", STRAIGHT | options(speed=40.0), "task_options.speed=40 m/s"),
        ("navigate", options(speed=40.0), "task_options.speed=40 m/s"),
        ("gate", options(set_off=1.0, arrival=1.5), "task_options.arrival=1.5 s after set_off=1 s"),
        ("gate", options(gap_offset=500.0), "task_options.gap_offset=500 m"),
        ("pose", options(way_seconds=0.2), "task_options.way_seconds=0.2 for 1.22 m"),
        ("takeoff", options(target_height=50.0), "task_options.target_height=50 m"),
        ("land", options(start_height=50.0), "task_options.start_height=50 m"),
        ("land", options(pad_xy=50.0), "task_options.pad_xy=50 m"),
    ],
)  # fmt: skip
def test_targets_beyond_the_thrust_of_the_team_are_refused(task, changes, key):
    message = refusal(make, task, **changes)
    assert message.startswith(key) and " is too fast: at " in message
    assert " N of its 20 N" in message or "the cables would go slack" in message


def test_thrust_bounds_the_acceleration_of_a_target():
    """The falcons of `track` have 2.06 times their thrust at rest: g times the root of its square less 1."""
    make("track", **options(speed=1.0, acceleration=17.5))
    assert "17.9 m/s²" in refusal(make, "track", **options(speed=1.0, acceleration=17.9))


def test_a_random_path_that_its_speed_keeps_gentle_may_have_any_acceleration():
    make("track", **options(path="random", speed=1.0, acceleration=1000.0))


@pytest.mark.parametrize("width", [0.01, [0.01, 1.0], 0.45])
def test_gaps_that_a_payload_does_not_fit_through_are_refused(width):
    message = refusal(make, "gate", **options(gap_width=width))
    assert "is too narrow for payload and drones; raise it above 0.45 m" in message
    point = {"payload.shape": "point"}
    assert "is too narrow for payload and drones" in refusal(make, "gate", **point, **options(gap_width=0.01))
    assert "no higher than the top of the payload" in refusal(make, "gate", **options(gap_height=1.3))


@pytest.mark.parametrize(
    ("task", "changes", "said"),
    [
        ("loss", options(loss_time=[30.0, 40.0], broadcast=True), "task loss can succeed from 42.0 s"),
        ("loss", options(success_seconds=9.0), "task loss can succeed from 13.0 s"),
        ("loss", {"env.episode_seconds": 2.0}, "env.episode_seconds=2 ends before; raise it to 7"),
        ("regroup", options(events=[400.0, 800.0]), "task regroup can succeed from 801.5 s"),
        ("regroup", options(success_seconds=4.0, events=[4.0, 8.2]), "task regroup can succeed from 12.7 s"),
        ("gate", options(arrival=100.0), "with task_options.arrival=100 s, task gate can succeed from 101.0 s"),
        ("gate", options(success_seconds=5.0), "task gate can succeed from 16.0 s"),
        ("navigate", options(speed=0.5), "the target of task navigate arrives at 35.0 s"),
        ("navigate", STRAIGHT | options(speed=0.5), "the target of task navigate arrives at 26.2 s"),
        ("pose", {"env.episode_seconds": 9.0}, "the plan of task pose ends at 11.0 s"),
        ("takeoff", options(margin=0.15), "task takeoff can succeed from 58.6 s"),
        ("takeoff", options(success_seconds=50.0), "task takeoff can succeed from 56.6 s"),
        ("land", options(success_seconds=50.0), "task land can succeed from 60.0 s"),
    ],
)
def test_what_comes_too_late_in_an_episode_is_said_once(task, changes, said, caplog):
    warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            make(task, num_envs=1, **changes)
    spoken = [record.getMessage() for record in caplog.records if record.name == "multilift_marl.tasks"]
    assert len(spoken) == 1 and said in spoken[0] and "env.episode_seconds=" in spoken[0]


@pytest.mark.parametrize("task", ["gate", "loss", "navigate", "pose", "regroup"])
def test_usual_episodes_are_long_enough(task, caplog):
    warn_once.cache_clear()
    make(task, num_envs=1)
    assert not [record for record in caplog.records if record.name == "multilift_marl.tasks"]
