"""Task track on a path from a file: the spline, the tables it is read from, what is refused, and flights."""

from math import pi
from pathlib import Path

import numpy as np
import pytest
from conftest import GRAVITY, JARGON, make, refusal, zeros

import multilift_marl as ml
from multilift_marl.config.load import build_config, dump_config
from multilift_marl.planning.path_file import _sample_all, read_rows, thin_rows
from multilift_marl.planning.spline import fit_spline, sample_spline, spline_place, spline_yaw
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.schema.files import pin_file

LENGTH = 8.0  # [s]


def loop(count: int = 161, turn: float = 0.0, radius: float = 1.0) -> np.ndarray:
    """Return rows (count, 5) of one round of a level circle, from rest to rest, which turns by `turn` [rad]."""
    s = np.linspace(0, 1, count)
    eased = s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)
    angle = 2 * pi * eased
    place = [radius * np.sin(angle), radius * (1 - np.cos(angle)), np.full(count, 2.0) + 0.3 * eased]
    return np.stack([LENGTH * s, *place, turn * eased], axis=1)


def save(folder: Path, rows: np.ndarray, name: str = "path.csv", header: str = "t,x,y,z,yaw") -> str:
    path = folder / name
    if name.endswith(".npy"):
        np.save(path, rows)
    elif name.endswith(".npz"):
        np.savez(path, **dict(zip(header.split(","), rows.T, strict=True)))
    else:
        np.savetxt(path, rows, fmt="%.17g", delimiter=",", header=header, comments="")
    return str(path)


def options(path: str, **more) -> dict:
    return {"task_options.path": "file", "task_options.file": path, **{f"task_options.{k}": v for k, v in more.items()}}


def fly(path: str, num_envs: int = 1, **keywords):
    vec = make("track", num_envs=num_envs, **options(path), **keywords)
    vec.reset(seed=0)
    return vec


def test_the_spline_of_a_sine_has_its_derivatives():
    t = np.arange(0, 12, 0.1)
    table = fit_spline(np.stack([t, *(np.sin(t + phase) for phase in range(4))], axis=1))
    inside = np.linspace(3, 9, 601)
    for value, expected, tolerance in zip(
        sample_spline(table, inside), (np.sin, np.cos, lambda x: -np.sin(x), lambda x: -np.cos(x)),
        (1e-8, 1e-7, 1e-5, 1e-3), strict=True,
    ):  # fmt: skip
        for phase in range(4):
            np.testing.assert_allclose(value[:, phase], expected(inside + phase), atol=tolerance)


def test_the_spline_passes_all_rows_and_is_smooth_there():
    rng = np.random.default_rng(0)
    t = np.append(0, np.cumsum(rng.uniform(0.3, 1.5, 11)))
    rows = np.column_stack([t, rng.uniform(-1, 1, (12, 4))])
    table, h = fit_spline(rows), 1e-3
    for i, at in enumerate(t):
        np.testing.assert_allclose(spline_place(table, at), rows[i, 1:4], atol=1e-12)
        assert spline_yaw(table, at)[0] == pytest.approx(rows[i, 4], abs=1e-12)
    speeds = np.linalg.norm(sample_spline(table, np.linspace(0, t[-1], 2000))[1:, :, :3], axis=2).max(axis=1)
    for at in t[1:-1]:  # one-sided finite differences of the position
        before, after = ([np.array(spline_place(table, at + side * k * h)) for k in range(4)] for side in (-1, 1))
        rate = [side * (p[1] * 4 - p[0] * 3 - p[2]) / (2 * h) for side, p in ((-1, before), (1, after))]
        bend = [(2 * p[0] - 5 * p[1] + 4 * p[2] - p[3]) / h**2 for p in (before, after)]
        np.testing.assert_allclose(rate[0], rate[1], atol=1e-4 * speeds[0])
        np.testing.assert_allclose(bend[0], bend[1], atol=1e-2 * speeds[1])
        left, right = (sample_spline(table, np.array([at + side * 1e-9]))[3] for side in (-1, 1))
        np.testing.assert_allclose(left, right, atol=1e-5 * speeds[2])  # the jerk, too
    lengths = np.diff(t)
    slopes = []  # of the jerk, a parabola in each piece, at its two ends
    for begin, length in zip(t, lengths, strict=False):
        first, middle, last = sample_spline(table, begin + length * np.array([1e-9, 0.5, 1 - 1e-9]))[3]
        slopes.append(np.array([4 * middle - 3 * first - last, first - 4 * middle + 3 * last]) / length)
    for before, after in zip(slopes, slopes[1:], strict=False):
        np.testing.assert_allclose(before[1], after[0], atol=1e-5 * np.abs(slopes).max())


def test_the_spline_begins_and_ends_at_rest_and_stays():
    table = fit_spline(np.column_stack([[0, 1, 2, 4, 5], [0, 1, 3, 3, 2], [0, 1, 0, 1, 0], np.full((5, 2), 2.0)]))
    ends = sample_spline(table, np.array([0.0, 5.0]))
    np.testing.assert_allclose(ends[1:3], 0, atol=1e-9)
    assert spline_place(table, -1.0) == spline_place(table, 0.0)
    np.testing.assert_allclose(spline_place(table, 9.0), [2, 0, 2], atol=1e-12)


@pytest.mark.parametrize("name", ["path.csv", "path.npy", "path.npz"])
@pytest.mark.parametrize("columns", [4, 5])
def test_all_kinds_of_file_hold_the_same_path(tmp_path, name, columns):
    rows = loop(turn=4.0)[:, :columns]
    path = save(tmp_path, rows, name, header=",".join(("t", "x", "y", "z", "yaw")[:columns]))
    expected = np.hstack([rows, np.zeros((len(rows), 5 - columns))])
    assert (read_rows(pin_file(path)) == expected).all()


@pytest.mark.parametrize("mark", ["# ", "#", "% ", "#\t"])
@pytest.mark.parametrize("delimiter", [" ", ",", "\t"])
def test_names_may_be_a_comment_as_numpy_writes_it(tmp_path, mark, delimiter):
    rows, file = loop()[:, :4], tmp_path / "path.csv"
    np.savetxt(file, rows, delimiter=delimiter, header=delimiter.join("txyz"), comments=mark)
    np.testing.assert_allclose(read_rows(pin_file(str(file)))[:, :4], rows, atol=1e-12)


def test_columns_are_found_by_name_and_others_ignored(tmp_path):
    rows = loop()
    extra = np.column_stack([rows[:, 3], rows[:, 0] + 5.0, np.full(len(rows), 7.0), rows[:, 1:3]])
    path = save(tmp_path, extra, header="# Z, t, battery, x, y")
    read = read_rows(pin_file(path))
    np.testing.assert_allclose(read[:, :4], rows[:, :4], atol=1e-12)  # t begins at 0
    bare = save(tmp_path, rows[:, :4], "bare.csv", header="")
    Path(bare).write_text(Path(bare).read_text().lstrip())
    assert (read_rows(pin_file(bare))[:, :4] == rows[:, :4]).all()


def test_yaw_is_unwrapped(tmp_path):
    rows = loop(turn=3 * pi)
    wrapped = rows.copy()
    wrapped[:, 4] = np.angle(np.exp(1j * rows[:, 4]))
    np.testing.assert_allclose(read_rows(pin_file(save(tmp_path, wrapped)))[:, 4], rows[:, 4], atol=1e-9)


def test_rounded_rows_do_not_become_jerk():
    exact, rounded = loop(401), loop(401)
    rounded[:, 1:] = np.round(rounded[:, 1:], 4)
    at = np.linspace(0, LENGTH, 500)
    smooth = sample_spline(fit_spline(exact), at)
    spread = {
        spacing: np.abs(sample_spline(fit_spline(thin_rows(rounded, spacing)), at) - smooth).max(axis=(1, 2))
        for spacing in (0.0, 0.1)
    }
    assert spread[0.1][0] < 1e-4 and spread[0.1][2] < 0.05 and spread[0.1][3] < 1.0
    assert spread[0.0][3] > 10 * spread[0.1][3]
    assert (thin_rows(exact, 0.0) == exact).all()
    lone = exact[::50]  # 1 s apart
    assert (thin_rows(lone, 0.1) == lone).all()
    assert (thin_rows(lone, 3.0)[:, 0] == [0, 3, 8]).all()  # the last two as far apart, too


@pytest.mark.parametrize("change, words", [
    (lambda rows: rows[:, :3], ("3 columns", "x, y, z")),
    (lambda rows: rows[:3], ("3 rows", "4 or more")),
    (lambda rows: rows[::-1], ("t does not increase from row 1",)),
    (lambda rows: np.vstack([rows[:9], rows[8:]]), ("t does not increase from row 9",)),
    (lambda rows: np.where(np.arange(5) == 2, np.nan, rows), ("nan as y in row 1",)),
    (lambda rows: rows * [0.1, 1, 1, 0, 1] + [0, 0, 0, 2, 0], ("too fast", "m/s²", "drone", "N of its", "slower")),
    (lambda rows: rows * [1, 1000, 1000, 1, 1], ("too fast", "in m")),
    (lambda rows: rows - [0, 0, 0, 2, 0], ("touch the ground", "above")),
    (lambda rows: rows + [0, 0, 0, 20, 0] * (1 - np.cos(4 * rows[:, :1])), ("too fast", "falls", "slack")),
])  # fmt: skip
def test_what_cannot_be_flown_is_refused_in_one_sentence(tmp_path, change, words):
    path = save(tmp_path, change(loop()), "path.npy")
    message = refusal(make, "track", **options(path))
    assert message.startswith(f"task_options.file={path}")
    assert all(word in message for word in words), message
    assert not any(word in message for word in JARGON), message


@pytest.mark.parametrize("share", [0.8, 0.95])
def test_a_path_may_fall_at_most_at_nine_tenths_of_gravity(tmp_path, share):
    rows = loop(401)
    wave = 2 * np.pi / 2.0  # [rad/s]
    rows[:, 3] = 4.0 + share * GRAVITY / wave**2 * (1 - np.cos(wave * rows[:, 0]))
    path, strong = save(tmp_path, rows, "path.npy"), {"vehicle.rotor_thrust_max": 20.0}
    if share < 0.9:
        make("track", **options(path), **strong)
    else:
        assert "the cables would go slack" in refusal(make, "track", **options(path), **strong)


@pytest.mark.parametrize("text, words", [
    ("t,x,y\n0,0,0\n", ("no column z", "t, x, y")),
    ("t,x,y,z\n0,0,0,2\n1,a,0,2\n", ("'a' in row 2",)),
    ("t,x,y,z\n0,0,0,2\n1,0,2\n", ("3 columns in row 2",)),
    ("t;x;y;z\n0;0;0;2\n", ("has 1 rows",)),
    ("t,x,y,z\n0\n1\n", ("names 4 columns or more, but has 1",)),
    ("", ("0 rows",)),
    ("\xff\xfe", ("no text",)),
])  # fmt: skip
def test_a_csv_file_that_is_no_table_is_refused(tmp_path, text, words):
    (tmp_path / "path.csv").write_bytes(text.encode("latin-1"))
    message = refusal(make, "track", **options(str(tmp_path / "path.csv")))
    assert all(word in message for word in words) and not any(word in message for word in JARGON), message


def test_other_files_are_refused(tmp_path):
    missing = tmp_path / "none.csv"
    assert f"{missing} is missing" in refusal(make, "track", **options(str(missing)))
    (tmp_path / "path.txt").write_text("0,0,0,2\n")
    assert "no .csv, .npy or .npz" in refusal(make, "track", **options(str(tmp_path / "path.txt")))
    (tmp_path / "path.npy").write_bytes(b"nothing")
    assert "damaged" in refusal(make, "track", **options(str(tmp_path / "path.npy")))
    np.save(tmp_path / "path.npy", np.array([{}]), allow_pickle=True)
    assert "damaged or no array" in refusal(make, "track", **options(str(tmp_path / "path.npy")))
    np.savez(tmp_path / "path.npz", t=np.arange(5), x=np.arange(5))
    assert "no array y" in refusal(make, "track", **options(str(tmp_path / "path.npz")))


def test_form_and_file_go_together(tmp_path):
    path = save(tmp_path, loop())
    assert "set task_options.file" in refusal(make, "track", **{"task_options.path": "file"})
    assert "set task_options.path=file" in refusal(make, "track", **{"task_options.file": path})
    make("track", **{**options(path), "task_options.path": ["figure8", "file"]}).reset(seed=0)


def test_a_configuration_names_the_file_wherever_it_is_read(tmp_path, monkeypatch):
    path = save(tmp_path, loop())
    monkeypatch.chdir(tmp_path)
    more = {"train.overrides": {"task_options.file": "path.csv"}}
    config = ml.load_config("track", options("path.csv") | more)
    monkeypatch.chdir("/")
    file = config.task_options["file"]
    assert file.startswith(f"{path}#sha256=") and config.train.overrides["task_options.file"] == file
    assert build_config(config.model_dump()) == config and file in dump_config(config)
    ml.make_vec(config, num_envs=1, num_threads=1)
    save(tmp_path, loop(radius=1.1))
    assert "has changed" in refusal(ml.make_vec, config, num_envs=1)
    ml.make_vec(config, num_envs=1, num_threads=1, **{"task_options.file": path})  # given anew
    Path(path).unlink()
    assert refusal(ml.make_vec, config, num_envs=1).startswith(f"task_options.file={path} is missing")


def test_the_goal_moves_and_turns_as_the_file_says(tmp_path):
    rows = loop(turn=2.0)
    vec = fly(save(tmp_path, rows), num_envs=2)
    goal, dt, times, seen = vec.task.goal, vec.task.dt, [], []
    np.testing.assert_allclose(goal.position, np.tile([0, 0, 2.0], (2, 1)), atol=1e-12)  # as written, not turned
    names = ("position", "velocity", "acceleration", "jerk", "slots", "slot_velocity", "slot_acceleration", "slot_jerk")
    for _ in range(450):
        vec.step(zeros(vec))
        times.append(vec.task.time[0])
        row = {name: getattr(goal, name)[0].copy() for name in names}
        seen.append(row | {"yaw": goal.yaw[0], "rate": goal.drone_yaw_rate[0], "spin": goal.angular_velocity[0, 2]})
    held = {name: np.array([row[name] for row in seen]) for name in seen[0]}
    times = np.array(times)
    expected = np.stack([np.interp(times, rows[:, 0], rows[:, k]) for k in (1, 2, 3)], axis=1)
    np.testing.assert_allclose(held["position"], expected, atol=1e-3)
    np.testing.assert_allclose(held["yaw"], np.interp(times, rows[:, 0], rows[:, 4]), atol=1e-3)
    np.testing.assert_allclose(held["position"][-20:], np.tile(rows[-1, 1:4], (20, 1)), atol=1e-9)
    np.testing.assert_allclose(held["velocity"][-20:], 0, atol=1e-9)
    assert (held["rate"] == held["spin"]).all()
    held["arm"] = held["slots"] - held["position"][:, None]
    for name, derivative in (
        ("position", "velocity"), ("velocity", "acceleration"), ("acceleration", "jerk"), ("yaw", "rate"),
        ("arm", "slot_velocity"), ("slot_velocity", "slot_acceleration"), ("slot_acceleration", "slot_jerk"),
    ):  # fmt: skip
        slope = (held[name][2:] - held[name][:-2]) / (2 * dt)
        gap = np.abs(slope - held[derivative][1:-1]).reshape(len(slope), -1).max(axis=1)
        assert np.quantile(gap, 0.98) < 0.01 * max(1.0, np.abs(held[derivative]).max()), derivative


def test_references_ride_along_without_lag(tmp_path):
    vec = fly(save(tmp_path, loop(turn=2.0)), num_envs=2)
    for _ in range(200):
        vec.step(zeros(vec))
    goal, reference = vec.task.goal, vec.reference
    np.testing.assert_allclose(reference.position, goal.slots, atol=1e-4)
    np.testing.assert_allclose(reference.velocity, goal.velocity[:, None] + goal.slot_velocity, atol=2e-3)
    np.testing.assert_allclose(reference.yaw_rate, goal.drone_yaw_rate[:, None].repeat(4, axis=1), atol=1e-3)


@pytest.mark.parametrize("turn", [0.0, 2.0])
def test_a_team_follows_the_path_and_rests_at_its_end(tmp_path, turn):
    vec = fly(save(tmp_path, loop(turn=turn)), num_envs=2, **{"env.episode_seconds": 12.0})
    assert vec.observation_size == make("track", num_envs=1).observation_size
    script, distances, angles = make_scripted("formation_lead", vec), [], []
    observation, _ = vec.current()
    for _ in range(vec.max_steps):
        observation, _, terminated, _, info = vec.step(script.act(observation))
        assert not terminated.any()
        distances.append(vec.task.errors.distance.copy())
        angles.append(vec.task.errors.angle.copy())
    assert info["success"].all()
    assert np.sqrt(np.mean(np.square(distances[100:400]))) < 0.05
    assert np.max(distances[-25:]) < 0.03 and np.max(angles[100:]) < 0.15


def test_drones_see_where_the_path_goes_on(tmp_path):
    vec = fly(save(tmp_path, loop()))
    for _ in range(150):
        vec.step(zeros(vec))
    observation, _ = vec.current()
    k, goal = vec.observation_names.index("target_ahead_400ms_0"), vec.task.goal
    c, s = goal.slot_frame[0, :, 0], goal.slot_frame[0, :, 1]
    ahead, now = observation[0, :, k : k + 3], goal.position[0].copy()
    for _ in range(20):
        vec.step(zeros(vec))
    moved = goal.position[0] - now
    expected = np.stack([c * moved[0] + s * moved[1], c * moved[1] - s * moved[0], np.full(4, moved[2])], axis=1)
    np.testing.assert_allclose(ahead, expected, atol=1e-6)


def test_what_is_drawn_is_the_path(tmp_path):
    rows = loop()
    target_path = fly(save(tmp_path, rows), **{"env.episode_seconds": 20.0}).task.target_path(0)
    np.testing.assert_allclose(target_path[[0, -1]], rows[[0, -1], 1:4], atol=1e-9)
    assert np.abs(np.hypot(target_path[:, 0], target_path[:, 1] - 1) - 1).max() < 1e-3


def test_an_episode_goes_on_from_saved_state(tmp_path):
    path = save(tmp_path, loop(turn=1.0))
    first, second = fly(path), fly(path)
    for _ in range(60):
        first.step(zeros(first))
    second.load_state_dict(first.state_dict())
    for _ in range(30):
        one, two = first.step(zeros(first))[0], second.step(zeros(second))[0]
    assert (one == two).all()


def test_a_path_is_checked_all_along():
    rows = np.array([[0.0, 0, 0, 1, 0], [1.0, 1, 0, 1, 0], [3.0, 2, 0, 1, 0], [3.5, 2, 1, 1, 0]])
    t, motion = _sample_all(fit_spline(rows))
    assert (np.diff(t) > 0).all() and t[0] == 0.0 and t[-1] == 3.5 and motion.shape[1] == len(t)
    assert np.diff(t).max() <= 2.0 / 8
