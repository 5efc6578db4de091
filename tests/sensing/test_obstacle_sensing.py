"""What drones observe of obstacles, against NumPy by hand; rate, delay, field of view, noise, and their streams."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make

from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.errors import ConfigError

SPHERES = [(2.0, 0.5, 1.6), (-1.8, 1.0, 2.2), (0.5, -3.0, 1.0), (4.5, 1.0, 2.0), (-2.5, -2.5, 2.5)]
RADIUS = 0.3


def among(sensing: str, num_envs: int = 2, spheres=SPHERES, num_threads: int = 1, radius: float = RADIUS, **given):
    """Return environments with spheres; `given` are keys of `env.obstacles`, or of other sections."""
    scene = [{"shape": "sphere", "size": [2 * radius], "position": list(place)} for place in spheres]
    keys = {key if "." in key else f"env.obstacles.{key}": value for key, value in given.items()}
    overrides = {"scene.obstacles": scene, "env.obstacle_sensing": sensing, "env.policy_hz": 50.0} | keys
    return make("hover", num_envs=num_envs, num_threads=num_threads, num_drones=3, **overrides)


def columns(vec, name: str) -> list[int]:
    return [i for i, each in enumerate(vec.observation_names) if each.rpartition("_")[0] == name]


def in_heading_frame(rotation: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Turn vectors (M, 3) by the yaw that R[1, 1] and R[0, 1] give."""
    yaw = np.arctan2(-rotation[0, 1], rotation[1, 1])
    c, s = np.cos(yaw), np.sin(yaw)
    return vectors @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])


def nearest_by_hand(vec, count: int, most: float = np.inf, view: float = 360.0) -> np.ndarray:
    """Return the nearest points of spheres (E, N, 3 count) as the drones are now."""
    state, found = vec.world.state, np.zeros((vec.num_envs, vec.num_drones, count, 3))
    found[..., 2] = min(most, 100.0)
    for e in range(vec.num_envs):
        for n in range(vec.num_drones):
            offset = np.array(SPHERES) - state.drone_position[e, n]
            length = np.linalg.norm(offset, axis=1, keepdims=True)
            points = in_heading_frame(state.drone_rotation[e, n], offset * (1 - RADIUS / length))
            azimuth = np.rad2deg(np.abs(np.arctan2(points[:, 1], points[:, 0])))
            seen = (length[:, 0] - RADIUS <= most) & (azimuth <= view / 2)
            order = np.flatnonzero(seen)[np.argsort(length[seen, 0])][:count]
            found[e, n, : len(order)] = points[order]
    return found.reshape(vec.num_envs, vec.num_drones, -1)


def in_world(vec, points: np.ndarray) -> np.ndarray:
    """Return points (E, N, 3 count) of the drones' heading frames where they are now, (E, N, count, 3)."""
    state, placed = vec.world.state, points.reshape(vec.num_envs, vec.num_drones, -1, 3).copy()
    for e, n in np.ndindex(placed.shape[:2]):
        yaw = np.arctan2(-state.drone_rotation[e, n, 0, 1], state.drone_rotation[e, n, 1, 1])
        turned = placed[e, n, :, 0] * np.cos(yaw) - placed[e, n, :, 1] * np.sin(yaw)
        placed[e, n, :, 1] = placed[e, n, :, 0] * np.sin(yaw) + placed[e, n, :, 1] * np.cos(yaw)
        placed[e, n, :, 0] = turned
        placed[e, n] += state.drone_position[e, n]
    return placed


def fly(vec, steps: int, seed: int = 3):
    """Yield the observations of a reset and of random actions that turn the drones, too."""
    yield vec.reset(seed=seed)[0]
    rng = np.random.default_rng(0)
    for _ in range(steps):
        action = np.broadcast_to(rng.uniform(-1, 1, (1, *vec.task.action.shape[1:])), vec.task.action.shape)
        yield vec.step(action)[0]


@pytest.mark.parametrize(
    "mode, given, limits",
    [
        ("map", {"points": 3}, {"count": 3}),
        ("map", {"points": 7, "range": 1.0}, {"count": 7}),
        ("local", {"points": 4, "range": 2.5}, {"count": 4, "most": 2.5}),
        ("local", {"points": 4, "range": 5.0, "field_of_view": 100.0}, {"count": 4, "most": 5.0, "view": 100.0}),
    ],
)
def test_points_are_those_of_the_nearest_spheres(mode, given, limits):
    vec = among(mode, **given)
    place, unseen = columns(vec, "obstacle_points"), 0
    assert len(place) == 3 * limits["count"]
    for observation in fly(vec, 25):
        expected = nearest_by_hand(vec, **limits)
        assert observation[:, :, place] == pytest.approx(expected, abs=1e-5)
        unseen += np.count_nonzero(expected[..., 2::3] == min(limits.get("most", 100.0), 100.0))
    assert (unseen > 0) == (mode == "local" or limits["count"] > len(SPHERES))


def test_beams_are_as_long_as_the_way_to_the_spheres():
    """A ray at offset o with length of approach b meets a sphere at b - √(r² - o² + b²)."""
    vec = among("ranges", beams=24, range=4.0, spheres=[(2.0, 0.0, 2.3), (0.0, -3.0, 2.3), (6.0, 0.0, 2.3)])
    centres = np.array([(2.0, 0.0, 2.3), (0.0, -3.0, 2.3), (6.0, 0.0, 2.3)])
    place, met = columns(vec, "obstacle_ranges"), 0
    assert len(place) == 24
    for observation in fly(vec, 15):
        for n in range(3):
            state = vec.world.state
            offsets = in_heading_frame(state.drone_rotation[0, n], centres - state.drone_position[0, n])
            for b, length in enumerate(observation[0, n, place]):
                direction = np.array([np.cos(2 * np.pi * b / 24), np.sin(2 * np.pi * b / 24), 0.0])
                approach = offsets @ direction
                inside = RADIUS**2 - (offsets**2).sum(axis=1) + approach**2
                hits = np.where((inside >= 0) & (approach > 0), approach - np.sqrt(np.maximum(inside, 0)), np.inf)
                assert length == pytest.approx(min(hits.min(), 4.0), abs=1e-5)
                met += length < 4.0
    assert met > 20


@pytest.mark.parametrize("rate, delay", [(None, 3), (10.0, 0), (10.0, 2), (25.0, 5)])
def test_measurements_come_at_the_rate_and_after_the_delay(rate, delay):
    """At step s, the points measured at the last multiple of the period up to s - delay; at first the first.

    They are observed where they are from the drone as it is now.
    """
    vec = among("local", points=2, range=20.0, rate=rate, delay=delay)
    place, period, seen = columns(vec, "obstacle_points"), 1 if rate is None else round(50 / rate), []
    places = []
    for step, observation in enumerate(fly(vec, 20)):
        seen.append(nearest_by_hand(vec, 2, 20.0))
        places.append(in_world(vec, seen[-1]))
        taken = places[max(step - delay, 0) // period * period]
        state = vec.world.state
        for e, n in np.ndindex(2, 3):
            expected = in_heading_frame(state.drone_rotation[e, n], taken[e, n] - state.drone_position[e, n])
            assert observation[e, n, place] == pytest.approx(expected.ravel(), abs=1e-5)
    assert np.abs(seen[0] - seen[-1]).max() > 0.01


def test_what_is_seen_late_is_observed_where_it_is_if_it_is_small():
    """The nearest point of a ball of 1 mm stays where it is however the drone moves: late or not, it looks the same."""
    given = {"points": 5, "range": 20.0, "radius": 1e-3}
    late, exact = among("local", rate=12.5, delay=6, **given), among("local", **given)
    place, moved = columns(late, "obstacle_points"), []
    for one, other in zip(fly(late, 60), fly(exact, 60), strict=True):
        # Their order is that of the measurement.
        one, other = (np.sort(each[:, :, place].reshape(2, 3, 5, 3), axis=2) for each in (one, other))
        assert one == pytest.approx(other, abs=3e-3)
        moved.append(other)
    assert np.abs(moved[10] - moved[0]).max() > 0.1


@pytest.mark.parametrize(
    "more", [{}, {"randomization.observation_noise": 0.01, "randomization.observation_bias": 0.01}]
)
def test_first_points_are_those_about_the_start_whatever_was_flown_before(more):
    """Drones place them by where they know themselves to be: at the start that has to be the start."""
    vec = among("local", delay=2, points=5, range=20.0, **more)
    place, flown = columns(vec, "obstacle_points"), []
    for _ in range(2):
        flown.append([])
        for observation in fly(vec, 6):
            flown[-1].append(observation)
            # Their order is that of the measurement.
            seen, there = (
                np.sort(each.reshape(2, 3, 5, 3), axis=2)
                for each in (observation[:, :, place], nearest_by_hand(vec, 5))
            )
            assert seen == pytest.approx(there, abs=0.3)
    np.testing.assert_array_equal(*flown)


def test_a_measured_team_first_observes_obstacles_from_where_it_is():
    team = MeasuredTeam(among("local", num_envs=1, delay=2, points=3, range=20.0).config)
    team.reset(seed=1)
    state = team.world.state
    measured = {name: getattr(state, name)[0].copy() for name in state._fields if name.startswith(("payload", "drone"))}
    for name in ("payload_position", "drone_position"):
        measured[name] += [0.0, 1.0, 0.0]
    for observation in (team.begin(measured, seed=1), team.observe(measured)):
        assert observation[:, :, columns(team, "obstacle_points")] == pytest.approx(nearest_by_hand(team, 3), abs=1e-6)


@pytest.mark.parametrize("mode, name", [("local", "obstacle_points"), ("ranges", "obstacle_ranges")])
def test_noise_is_as_large_as_stated_and_only_of_what_is_seen(mode, name):
    spheres = [(1.6, 0.0, 2.4), (9.0, 0.0, 2.4)]
    given = {"points": 2, "beams": 24, "range": 3.0, "spheres": spheres, "num_envs": 40}
    exact, noisy = among(mode, **given), among(mode, noise=0.05, **given)
    true, measured = (
        np.concatenate([v.reset(seed=k)[0][:, :, columns(v, name)] for k in range(8)]) for v in (exact, noisy)
    )
    # Within a range they are clipped, so of those well within.
    seen = np.abs(true - 3.0) > 0.2
    if mode == "local":
        seen[..., 3:] = False
        assert (measured[..., 3:] == [0.0, 0.0, 3.0]).all()
    assert (measured[true == 3.0] == 3.0).all()
    error = (measured - true)[seen]
    assert len(error) > 400 and error.std() == pytest.approx(0.05, rel=0.1) and abs(error.mean()) < 0.01


@pytest.mark.parametrize("mode", ["local", "ranges"])
def test_measurements_do_not_depend_on_batch_threads_or_a_restart(mode):
    given = {"noise": 0.05, "rate": 25.0, "delay": 2, "points": 3, "randomization.observation_delay": 1}
    one, many = among(mode, num_envs=1, **given), among(mode, num_envs=8, **given)
    threads = among(mode, num_envs=8, num_threads=3, **given)
    for alone, together, shared in zip(fly(one, 12), fly(many, 12), fly(threads, 12), strict=True):
        np.testing.assert_array_equal(alone[0], together[0])
        np.testing.assert_array_equal(together, shared)
    assert not np.array_equal(together[0], together[1])
    saved = many.state_dict()
    action = np.full(many.task.action.shape, 0.3)
    first = [many.step(action)[0] for _ in range(6)]
    many.load_state_dict(saved)
    for observation in first:
        np.testing.assert_array_equal(many.step(action)[0], observation)


def test_the_critic_sees_the_nearest_points_exactly():
    vec = among("local", range=0.5, noise=0.05)
    vec.reset(seed=1)
    state, (first, rows, size) = vec.world.state, vec.task.drone_numbers
    yaw = vec.task.goal.yaw
    assert size == among("none").task.drone_numbers.size + 3
    drones = vec.state()[:, first : first + rows * size].reshape(2, rows, size)
    turned = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    for e in range(2):
        for places, found in (
            (state.drone_position[e], drones[e, :, -vec.action_size - 3 : -vec.action_size]),
            (state.payload_position[e][None], vec.state()[e, None, first + rows * size :][:, -3:]),
        ):
            for place, seen in zip(places, found, strict=True):
                offset = np.array(SPHERES) - place
                length = np.linalg.norm(offset, axis=1)
                nearest = (offset * (1 - RADIUS / length[:, None]))[length.argmin()]
                expected = [*(nearest[:2] @ turned[:, :, e]), nearest[2]]
                assert seen == pytest.approx(expected, abs=1e-5)


def test_without_sensing_nothing_is_added_and_without_obstacles_nothing_is_seen():
    plain = among("none")
    assert not [name for name in plain.observation_names if name.startswith("obstacle")]
    empty = among("map", spheres=[], points=2)
    observation, _ = empty.reset(seed=0)
    assert (observation[:, :, columns(empty, "obstacle_points")] == [0, 0, 100.0, 0, 0, 100.0]).all()


def test_in_units_of_the_cables_points_are_scaled():
    si, cable = among("map", **{"cable.length": 2.0}), among("map", **{"cable.length": 2.0, "env.units": "cable"})
    one, two = (v.reset(seed=2)[0][:, :, columns(v, "obstacle_points")] for v in (si, cable))
    assert two == pytest.approx(one / 2.0, rel=1e-5)


def test_a_rate_that_does_not_divide_the_policys_is_refused():
    with pytest.raises(ConfigError, match=r"env\.obstacles\.rate=30 must divide env\.policy_hz=50 into whole steps"):
        among("local", rate=30.0)
