"""Task track: paths, their motion, and what a team is told and paid."""

from functools import partial
from math import sqrt

import numpy as np
import pytest
from conftest import bold_actions, make, refusal, zeros

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.planning.paths import PATHS, RAMP, motion, own_time
from multilift_marl.policies.baselines import make_scripted

KINDS = pytest.mark.parametrize("kind", [path for path in PATHS if path != "file"])  # that one: test_path_file.py


def track(kind: str | list[str] = "figure8", num_envs: int = 2, **keywords):
    """Return environments of one path, or of some forms, reset."""
    vec = make("track", num_envs=num_envs, **{"task_options.path": kind, **keywords})
    vec.reset(seed=0)
    return vec


def goals(vec, steps: int) -> dict[str, np.ndarray]:
    """Fly the formation and return what the goal was after each step (T, E, ...)."""
    names = ("position", "velocity", "acceleration", "jerk", "drone_yaw", "drone_yaw_rate")
    rows = {name: [] for name in names}
    for _ in range(steps):
        vec.step(zeros(vec))
        for name in names:
            rows[name].append(getattr(vec.task.goal, name).copy())
    return {name: np.array(values) for name, values in rows.items()}


def test_own_time_starts_at_rest_and_runs_at_full_rate_after_the_ramp():
    h = 1e-3
    assert own_time(0.0) == 0 and own_time(-1.0) == 0
    assert own_time(1e-2) < 1e-9
    for t in (RAMP, RAMP + 0.7, 9.0):
        assert (own_time(t + h) - own_time(t)) / h == pytest.approx(1, abs=1e-6)
    assert own_time(RAMP) == pytest.approx(RAMP / 2)


@KINDS
def test_paths_begin_above_the_origin_at_their_height(kind):
    begins = track(kind, 8, **{"task_options.height": 2.6}).task.goal.position
    assert begins == pytest.approx(np.tile([0.0, 0.0, 2.6], (8, 1)), abs=1e-12)


@KINDS
def test_velocity_acceleration_and_jerk_are_derivatives_of_the_position(kind):
    rows, dt = goals(track(kind), 300), 0.02
    for name, derivative, tolerance in (
        ("position", "velocity", 2e-3), ("velocity", "acceleration", 4e-3), ("acceleration", "jerk", 0.05)
    ):  # fmt: skip
        slope = (rows[name][2:] - rows[name][:-2]) / (2 * dt)
        scale = max(1.0, np.abs(rows[derivative]).max())
        gap = np.abs(slope - rows[derivative][1:-1])
        assert np.quantile(gap, 0.98) < tolerance * scale, derivative  # splines have corners in the jerk
    assert np.abs(rows["position"][0] - [0, 0, 2.0]).max() < 1e-6 and np.abs(rows["velocity"][0]).max() < 1e-4


@pytest.mark.parametrize("kind", ["figure8", "lemniscate", "random"])
@pytest.mark.parametrize("speed, acceleration", [(1.0, 0.5), (2.0, 4.0)])
def test_paths_keep_and_reach_their_limits(kind, speed, acceleration):
    options = {"task_options.speed": speed, "task_options.acceleration": acceleration}
    vec = make("track", num_envs=4, **{"task_options.path": kind, "env.episode_seconds": 60.0, **options})
    vec.reset(seed=0)
    t = np.arange(RAMP + 0.1, 40, 0.02)
    task = vec.task
    rows = [[] for _ in range(4)]
    for e in range(4):
        rows[e] = [motion(e, x, task.own.path, task.settings.table)[1:3] for x in t]
    speeds, pushes = (np.linalg.norm([[row[k] for row in each] for each in rows], axis=2) for k in (0, 1))
    assert speeds.max() <= speed * 1.01 and pushes.max() <= acceleration * 1.02
    reached = np.maximum(speeds.max(axis=1) / speed, pushes.max(axis=1) / acceleration)
    assert kind == "random" or (reached > 0.97).all()  # a random path may be fastest while it gathers speed


def test_figure_eight_is_the_published_one():
    task = track("figure8", **{"task_options.speed": 2.0, "task_options.acceleration": 4.0}).task
    assert task.own.path.size[0] == pytest.approx(1.0625 * 2**2 / 4)
    assert task.own.path.rate[0] == pytest.approx(0.6655 * 4 / 2)
    assert task.own.path.size[0] * task.own.path.rate[0] * sqrt(2) == pytest.approx(2.0, rel=1e-3)


def test_each_episode_draws_from_ranges_and_forms():
    ranges = {"speed": [1.0, 2.0], "acceleration": [2.0, 4.0], "rate": [0.1, 0.4], "radius": [3.0, 5.0]}
    vec = track(["figure8", "circle"], num_envs=64, **{f"task_options.{key}": value for key, value in ranges.items()})
    path = vec.task.own.path
    eights, circles = path.kind == PATHS.index("figure8"), path.kind == PATHS.index("circle")
    assert (eights | circles).all() and 16 < eights.sum() < 48
    v, a = path.size * path.rate * sqrt(2), path.size * path.rate**2 / (1.0625 * 0.6655**2)
    for drawn, low, high in (
        (v[eights], 1.0, 2.0), (a[eights], 2.0, 4.0), (path.rate[circles], 0.1, 0.4), (path.size[circles], 3.0, 5.0)
    ):  # fmt: skip
        span = high - low
        assert low * 0.999 <= drawn.min() < low + 0.2 * span and high - 0.2 * span < drawn.max() <= high * 1.001


def test_a_path_forgets_the_form_of_the_last_episode():
    vec = track(["figure8", "circle"], num_envs=8)
    for _ in range(20):
        for _ in range(150):
            vec.step(zeros(vec))
        vec.reset()
        eights = vec.task.own.path.kind == PATHS.index("figure8")
        assert (vec.task.goal.drone_yaw_rate[eights] == 0).all()
        if eights.any() and not eights.all():
            return
    raise AssertionError("no episode changed its form")


def test_rmse_counts_from_a_chosen_time():
    flown = {}
    for begin in (0.0, 2.0, 3.0):
        options = {"env.num_threads": 1, "env.episode_seconds": 3.0, "task_options.rmse_from": begin}
        config = load_config("track", options)
        flown[begin] = run_episodes(config, partial(make_scripted, "formation_lead"), 2, seed=0)["payload_rmse_m"]
    assert (flown[0.0] > 1.5 * flown[2.0]).all()  # teams start up to 10 cm off
    assert (flown[0.0] == flown[3.0]).all()  # an episode that is no longer counts as a whole


def test_a_range_that_falls_is_refused():
    message = refusal(track, **{"task_options.speed": [2.0, 1.0]})
    assert message == "task_options.speed must not end at 1 before it begins at 2, but is [2.0, 1.0]"
    for room in ([0, 0, 0], [3, 3, 0], [-3, 3, 0.5]):
        assert "from 0.01 to" in refusal(track, kind="random", **{"task_options.room": room})
    assert refusal(track, kind=[]) == "task_options.path must not be empty"


def test_on_the_circle_drones_face_along_the_path():
    rows = goals(track("circle"), 400)
    along = np.arctan2(rows["velocity"][..., 1], rows["velocity"][..., 0])[50:]
    turned = rows["drone_yaw"][50:] - along
    np.testing.assert_allclose(np.arctan2(np.sin(turned), np.cos(turned)), 0, atol=1e-3)
    np.testing.assert_allclose(rows["drone_yaw_rate"][150:], 0.2, atol=1e-6)


@KINDS
def test_references_ride_along_without_lag(kind):
    vec = track(kind)
    for _ in range(200):
        vec.step(zeros(vec))
    task, reference = vec.task, vec.reference
    np.testing.assert_allclose(reference.position, task.goal.slots, atol=1e-5)
    for name in ("velocity", "acceleration", "jerk"):
        asked = getattr(task.goal, name)[:, None]
        np.testing.assert_allclose(getattr(reference, name), np.broadcast_to(asked, (2, 4, 3)), atol=2e-3, err_msg=name)


def test_drones_are_told_where_the_target_will_be():
    vec = track("figure8", num_envs=1)
    for _ in range(150):
        vec.step(zeros(vec))
    observation, _ = vec.current()
    names, goal, now = vec.observation_names, vec.task.goal, vec.task.goal.position[0].copy()
    asked = ("target_ahead_400ms", "target_velocity")
    told = {name: observation[0, :, names.index(f"{name}_0") :][:, :3] for name in asked}
    frame = goal.slot_frame[0].copy()
    velocity = goal.velocity[0].copy()
    for _ in range(20):
        vec.step(zeros(vec))

    def turned(v):
        c, s = frame[:, 0], frame[:, 1]
        return np.stack([c * v[0] + s * v[1], c * v[1] - s * v[0], np.full(4, v[2])], axis=1)

    np.testing.assert_allclose(told["target_ahead_400ms"], turned(vec.task.goal.position[0] - now), atol=1e-6)
    np.testing.assert_allclose(told["target_velocity"], turned(velocity), atol=1e-6)


def test_without_a_preview_nothing_of_the_future_is_observed():
    known, unknown = (track(num_envs=1, **{"task_options.preview": preview}) for preview in (True, False))
    names = [name for name in known.observation_names if not name.startswith("target_ahead")]
    assert unknown.observation_names == tuple(names) and len(known.observation_names) == len(names) + 12
    for _ in range(60):
        rows = [vec.step(zeros(vec))[0][0, 0] for vec in (known, unknown)]
    pick = [known.observation_names.index(name) for name in names]
    np.testing.assert_array_equal(rows[0][pick], rows[1])
    np.testing.assert_array_equal(known.state(), unknown.state())  # the critic knows
    assert refusal(make_scripted, "formation_lead", unknown).startswith("formation_lead needs to observe")


def test_success_is_never_to_be_far():
    vec = track(num_envs=2, **{"env.episode_seconds": 1.0})
    vec.step(zeros(vec))
    vec.task.own.worst[1] = 0.51
    for _ in range(vec.max_steps - 1):
        info = vec.step(zeros(vec))[4]
    assert info["success"].tolist() == [True, False]


def test_heading_pays_for_the_rotation_about_the_vertical_alone():
    vec = track(num_envs=8, **{"reward.heading": 0.2})
    for step in range(40):
        *_, info = vec.step(0.4 * bold_actions(vec, step))
    roll, _, yaw = np.rad2deg(vec.task.errors.rotation.T)
    np.testing.assert_allclose(info["reward_terms"]["heading"], 0.2 / (1 + (yaw / 0.5) ** 2), rtol=1e-12)
    assert np.ptp(np.abs(yaw)) > 0.5 and np.ptp(np.abs(roll)) > 0.5


@pytest.mark.parametrize("kind", ["circle", "figure8"])
def test_the_formation_follows(kind):
    vec = track(kind, num_envs=4)
    script, distances = make_scripted("formation_integral", vec), []
    observation, _ = vec.current()
    for _ in range(500):
        observation, _, terminated, _, _ = vec.step(script.act(observation))
        assert not terminated.any()
        distances.append(vec.task.errors.distance.copy())
    assert np.sqrt(np.mean(np.square(distances[250:]))) < 0.03


def test_leading_scripts_follow_agile_paths_several_times_closer():
    options = {"task_options.speed": 2.0, "task_options.acceleration": 4.0}
    config = load_config("track", {"env.num_threads": 1, "env.episode_seconds": 12.0, **options})
    rmse = {
        name: run_episodes(config, partial(make_scripted, name), 4, seed=1000)["payload_rmse_m"].mean()
        for name in ("formation", "formation_lead")
    }
    assert rmse["formation_lead"] < 0.1 < 0.25 < rmse["formation"]
