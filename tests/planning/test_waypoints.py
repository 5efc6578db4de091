"""Task track through way-points: read, timed and passed; what is refused; files of planned paths; the command."""

from __future__ import annotations

import logging
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import largest_motion, make, make_system, refusal, zeros

import multilift_marl as ml
from multilift_marl.cli.plan import main as plan
from multilift_marl.config.load import build_config
from multilift_marl.errors import warn_once
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.planning.minimum_snap import fit_minimum_snap
from multilift_marl.planning.path_file import PathFile, load_path
from multilift_marl.planning.spline import sample_spline
from multilift_marl.planning.waypoints import plan_waypoints, sample_rows
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.schema.files import pin_file

PLACES = [[0, 0, 1.5], [3, 1, 2, 0.5], [4, -2, 1.2, 1.0], [0, 0, 1.5, 0.2]]
FAST = (3.0, 3.0), (4.0, 4.0)


def options(places=PLACES, **more) -> dict:
    given = {"path": "waypoints", "waypoints": places} | more
    return {f"task_options.{key}": value for key, value in given.items()}


def system():
    return ml.load_config("track").system


def save(folder: Path, text: str, name: str = "gates.csv") -> str:
    (folder / name).write_text(text, encoding="utf-8")
    return str(folder / name)


def test_way_points_are_passed_at_their_times_from_rest_to_rest():
    times = (1.0, 3.0, 5.5, 9.0)
    path = plan_waypoints(PLACES, times, *FAST, system())
    np.testing.assert_allclose(path.times, [0, 2, 4.5, 8])
    at = sample_spline(path.table, path.times)
    values = np.array([[0, 0, 1.5, 0], *PLACES[1:]])
    np.testing.assert_allclose(at[0], values, atol=1e-12)
    np.testing.assert_allclose(at[1:3, [0, -1]], 0.0, atol=1e-9)
    expected, t = fit_minimum_snap(path.times, values), np.linspace(0, 8, 801)
    for derivative, tolerance in enumerate((1e-8, 1e-6, 1e-5, 1e-3)):
        np.testing.assert_allclose(sample_spline(path.table, t)[derivative], expected(t, derivative), atol=tolerance)


@pytest.mark.parametrize("places", [PLACES, [[0, 0, 2, 0], [0, 0, 2, 1.5]], [[0, 0, 2, 0], [4, 0, 2, 3], [8, 0, 2, 6]]])
def test_without_times_payload_and_slots_just_keep_to_speed_and_acceleration(places):
    rig = system()
    path = plan_waypoints(places, None, *FAST, rig)
    t = np.linspace(0, path.times[-1], 20_000)
    fastest, hardest = largest_motion(sample_spline(path.table, t)[0], t, rig.slots[:, :2])
    assert max(fastest / FAST[0][0], hardest / FAST[1][0]) == pytest.approx(1.0, abs=2e-3)


def test_one_drone_above_its_payload_takes_time_to_turn():
    """Its slot does not move: it turns as a point 10 cm away would."""
    rig = make_system(1, **{"payload.shape": "point"})
    path = plan_waypoints([[0, 0, 2, 0], [0, 0, 2, 1.5]], None, (1.0, 1.0), (1.0, 1.0), rig)
    t = np.linspace(0, path.times[-1], 20_000)
    assert largest_motion(sample_spline(path.table, t)[0], t, np.array([[0.1, 0.0]]))[1] == pytest.approx(1, abs=2e-3)
    assert path.times[-1] > 1


def test_yaw_turns_the_short_way():
    path = plan_waypoints([[0, 0, 2, 3.0], [1, 0, 2, -3.0]], None, *FAST, system())
    assert path.table[-1, 4] == pytest.approx(2 * np.pi - 3.0)


def test_a_file_of_columns_is_the_same_as_a_list(tmp_path):
    rows = "x; y [m]; z_cm; yaw_deg\n0;0;150;0\n3;1;200;30\n0;0;150;0\n"
    found = plan_waypoints(pin_file(save(tmp_path, rows)), None, *FAST, system())
    listed = plan_waypoints([[0, 0, 1.5], [3, 1, 2, np.pi / 6], [0, 0, 1.5]], None, *FAST, system())
    np.testing.assert_allclose(found.table, listed.table, atol=1e-9)
    timed = save(tmp_path, "t,x,y,z\n0,0,0,1.5\n4,3,1,2\n", "timed.csv")
    np.testing.assert_allclose(plan_waypoints(pin_file(timed), None, *FAST, system()).times, [0, 4])
    given = plan_waypoints(pin_file(timed), (0.0, 5.0), *FAST, system())
    np.testing.assert_allclose(given.times, [0, 5])  # in place of those of the file
    make("track", num_envs=1, **options(timed, speed=[1, 2]))  # which its times make nothing of


@pytest.mark.parametrize(
    ("places", "more", "said"),
    [
        ([[0, 0, 1.5], [0, 0, 1.5], [1, 1, 2]], {}, "way-points 1 and 2 are equal"),
        ([[0, 0, 1.5], [2, 1, 0.05]], {}, "at way-point 2 z is 0.05 m and the payload would touch the ground"),
        ([[0, 0, 0.6], [2, 0, 0.1], [3, 0, 0.1], [4, 0, 0.6]], {}, "between way-points 2 and 3"),
        ([[0, 0, 1.5], [2, 1, 2]], {"waypoint_times": [0, 1]}, "between way-points 1 and 2, at 0.00 s the thrust of"),
        ([[0, 0, 1.5], [2, 1, 2]], {"waypoint_times": [1, 1]}, "times of way-points 1 and 2, 1 and 1 s, do not incr"),
        ([[0, 0, 1.5], [2, 1, 2]], {"waypoint_times": [1]}, "1 times for 2 way-points"),
        ([[0, 0, 1.5], [2, 1, 2]], {"speed": [1, 2]}, "task_options.speed is a range"),
        ([[0, 0, 1.5], [2, 1, 2]], {"speed": 20, "acceleration": 30}, "cannot be flown: between way-points 1 and 2"),
        ([[0, 0, 1.5]], {}, "has 1 way-points"),
        ([[0, 0, 1.5], [2, 1]], {}, "list of places [x, y, z] or [x, y, z, yaw]"),
        ([0, 0, 1.5], {}, "list of places [x, y, z] or [x, y, z, yaw]"),
        ([[0, 0, "a"], [1, 1, 1]], {}, "must be a number"),
        (
            [[0, 0, 2], [1, 0, 3], [2, 1, 2], [1, 1, 3], [0, 0, 2]],
            {"waypoint_times": [0, 0.01, 100, 100.01, 400]},
            "round-off",
        ),
        (None, {}, "path=waypoints needs one; set task_options.waypoints=<list or CSV file>"),
        (PLACES, {"path": "circle"}, "task_options.path=circle does not fly it"),
        (PLACES, {"path": ["file", "waypoints"], "file": "a.csv"}, "has a file and way-points"),
        (None, {"path": "circle", "waypoint_times": [1, 2]}, "task_options.waypoint_times means nothing"),
    ],
)
def test_what_cannot_be_is_refused_in_a_sentence(places, more, said):
    assert said in refusal(make, "track", num_envs=1, **options(places, **more))


def test_teams_that_are_not_assessed_are_refused_what_is_too_fast_or_low():
    rig = {"num_drones": 1}
    fast = options([[0, 0, 2], [3, 0, 2]], waypoint_times=[0, 0.8])
    assert "task_options.waypoints is too fast: at " in refusal(make, "track", num_envs=1, **fast, **rig)
    low = options([[0, 0, 1], [2, 0, 0.1], [3, 0, 0.1], [4, 0, 1]])  # between the second and the third
    assert "the payload would touch the ground" in refusal(make, "track", num_envs=1, **low, **rig)
    make("track", num_envs=1, **options(speed=2.0, acceleration=2.0), **rig).reset(seed=0)


def test_damaged_files_are_refused(tmp_path):
    def complaint(text, name="gates.csv"):
        return refusal(make, "track", num_envs=1, **options(save(tmp_path, text, name)))

    assert "is missing" in refusal(make, "track", num_envs=1, **options(str(tmp_path / "none.csv")))
    assert "is no .csv file" in complaint("x,y,z\n0,0,1\n1,1,1\n", "gates.txt")
    assert "has no column z" in complaint("x,y\n0,0\n1,1\n")
    assert "needs a line of names" in complaint("0,0,2\n1,1,2\n")
    assert "needs a line of names" in complaint("x,y,z\n")
    assert "holds 'b' in row 2" in complaint("x,y,z\n0,0,2\n1,b,2\n")
    assert "give finite places" in complaint("x,y,z\n0,0,2\n1,nan,2\n")


def test_plans_do_not_ignore_obstacles(capsys):
    box = "scene.obstacles=[{shape: box, size: [1, 1, 4], position: [1.5, 0.5, 1]}]"
    assert plan(["waypoints=[[0, 0, 1.5], [3, 1, 2]]", box]) == 2
    assert "plans know no obstacles" in capsys.readouterr().err


def test_the_file_is_pinned(tmp_path):
    path = save(tmp_path, "x,y,z\n0,0,1.5\n3,1,2\n")
    config = ml.load_config("track", options(path))
    assert config.task_options["waypoints"].startswith(f"{path}#sha256=")
    assert build_config(config.model_dump()) == config
    save(tmp_path, "x,y,z\n0,0,1.5\n3,2,2\n")
    assert "has changed" in refusal(ml.make_vec, config, num_envs=1)


def test_a_file_beside_a_yaml_file_is_found(tmp_path):
    save(tmp_path, "x,y,z\n0,0,1.5\n3,1,2\n")
    own = save(tmp_path, "base: track\ntask_options: {path: waypoints, waypoints: gates.csv}\n", "mine.yaml")
    assert ml.load_config(own).task_options["waypoints"].startswith(f"{tmp_path / 'gates.csv'}#sha256=")


def test_without_scipy_the_extra_is_named(monkeypatch):
    for module in ("scipy.interpolate", "scipy.optimize"):
        monkeypatch.setitem(sys.modules, module, None)
    assert '".[plan]"' in refusal(plan_waypoints, PLACES, (0, 2, 4, 6), *FAST, system())
    assert '".[plan]"' in refusal(plan_waypoints, PLACES, None, *FAST, system())


def test_the_target_moves_through_them():
    vec = make("track", num_envs=2, **options(waypoint_times=[0, 2, 4, 6]))
    vec.reset(seed=0)
    places = []
    for _ in range(350):
        vec.step(zeros(vec))
        places.append((vec.task.time[0], *vec.task.goal.position[0], vec.task.goal.yaw[0]))
    t, *values = np.array(places).T
    for time, place in zip((2, 4, 6, 7), [*PLACES[1:], PLACES[-1]], strict=True):
        at = int(np.argmin(np.abs(t - time)))
        np.testing.assert_allclose([value[at] for value in values], place, atol=1e-8)


@pytest.mark.parametrize("limits", [((1.0, 1.0), (0.5, 0.5)), FAST, ((5.0, 5.0), (8.0, 8.0))])
def test_a_path_written_to_a_file_is_flown_as_it_was_planned(tmp_path, limits):
    """By less than 0.1 mm, 1 cm/s and 0.2 m/s² at 5 m/s and 8 m/s²: rows 0.1 s apart, and a spline of least jerk."""
    path = plan_waypoints(PLACES, None, *limits, system())
    rows = sample_rows(path.table)
    assert np.diff(rows[:, 0]).min() >= 0.1
    file = tmp_path / "path.csv"
    np.savetxt(file, rows, delimiter=",", header="t,x,y,z,yaw", comments="", fmt="%.9g")
    config = ml.load_config("track")
    table = load_path(PathFile(pin_file(str(file)), 0.1, 0.0, (0, 0, 0)), 60.0, config.system, config.randomization)
    t = np.linspace(0, path.times[-1], 3000)
    read, planned = sample_spline(table, t), sample_spline(path.table, t)
    for derivative, tolerance in enumerate((1e-4, 1e-2, 0.2)):
        np.testing.assert_allclose(read[derivative], planned[derivative], atol=tolerance)


def test_a_file_that_leads_the_team_beyond_its_limits_is_warned_of(tmp_path, caplog):
    """Down by 2.5 m: in 1.6 s drones would have to turn faster than their rotors can, in 1.8 s they need not."""
    config = ml.load_config("track")
    for seconds, limit in ((1.8, False), (1.6, True)):
        rows = sample_rows(plan_waypoints([[0, 0, 4], [0, 0, 1.5]], (0.0, seconds), *FAST, config.system).table)
        file = tmp_path / f"{seconds}.csv"
        np.savetxt(file, rows, delimiter=",", header="t,x,y,z,yaw", comments="")
        warn_once.cache_clear()
        with caplog.at_level(logging.WARNING):
            load_path(PathFile(pin_file(str(file)), 0.1, 0.0, (0, 0, 0)), 60.0, config.system, config.randomization)
        said = "leads the team beyond its limits: at " in caplog.text and "the turning of drone" in caplog.text
        assert said == limit


@pytest.mark.slow
@pytest.mark.parametrize(("policy", "most"), [("formation_lead", 0.15), ("mpc", 0.003)])
def test_teams_fly_through_them(policy, most):
    by_rates = {"control.action": "acc_rates", "control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0}
    overrides = options(speed=3.0, acceleration=4.0, rmse_from=2.0) | {"env.episode_seconds": 8.0}
    config = ml.load_config("track", overrides | (by_rates if policy == "mpc" else {}) | {"env.num_threads": 1})
    found = run_episodes(config, lambda vec: make_scripted(policy, vec), 2, 77)
    assert (found["payload_rmse_m"] < most).all() and found["success_rate"].all()


def test_the_command_writes_what_is_flown_and_says_what_is_left(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    arguments = ["waypoints=[[0, 0, 1.5], [3, 1, 2, 0.5]]", "speed=2", "acceleration=2", "out=to/path.csv"]
    assert plan([*arguments, "plot=path.png"]) == 0
    said = capsys.readouterr().out
    assert "way-points at 0.00, " in said and "4 drones" in said
    assert all(name in said for name in ("thrust", "tilt", "turning", "cable lift", "distance", "height"))
    assert Path("path.png").read_bytes().startswith(b"\x89PNG")
    rows = np.loadtxt("to/path.csv", delimiter=",", skiprows=1)
    np.testing.assert_allclose(rows[[0, -1], 1:], [[0, 0, 1.5, 0], [3, 1, 2, 0.5]], atol=1e-8)
    make("track", num_envs=1, **{"task_options.path": "file", "task_options.file": "to/path.csv"}).reset(seed=0)
    assert plan(["file=to/path.csv", "env.num_drones=6"]) == 0
    assert "6 drones" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "give either waypoints=<list or CSV file> or file=<path>"),
        (["waypoints=[[0,0,2],[1,1,2]]", "file=a.csv"], "give either waypoints"),
        (["waypoints=[[0,0,2],[1,1,2]]", "times=[0,0.2]", "out=none.csv"], "cannot be flown: between way-points 1 and"),
        (["waypoints=[[0,0,2],[1,1,2]]", "config=hover"], "is of task hover"),
        (["waypoints=[[0,0,2],[1,1,2]]", "env.num_drones=1"], "two anchors or more"),
        (["waypoints=[[0,0,2],[1,1,2]]", "speed=0"], "speed must be from"),
        (["waypoints=[[0,0,2],[9,1,2]]", "speed=40", "acceleration=90"], "; lower speed or acceleration"),
        (["waypoints=[[0,0,2],[9,1,2]]", "times=[0,0.5]"], "; give it more time"),
        (["waypoints=[[0,0,2],[1,1,2]]", "task_options.speed=1"], "means nothing to this command; set speed"),
        (["waypoints=[[0,0,2],[1,1,2]]", "task_options.waypoint_times=[0,9]"], "this command; set times"),
        (["waypoints=[[0,0,2],[1,1,2]]", "times=[0,9]", "speed=2"], "speed means nothing beside times"),
        (["file=a.csv", "acceleration=3"], "acceleration means nothing beside file"),
        (["waypoints=[[0,0,2],[1,1,2]]", "out=a.npz"], "out=a.npz is written as CSV; give a name that ends in .csv"),
        (["waypoints=[[0,0,2],[1,1,2]]", "plot=a.foo"], "plot=a.foo is written as PNG"),
        (["waypoints=[[0,0,2],[1,1,2]]", "times=[0]"], "error: times has 1 times for 2 way-points"),
        (["waypoints=[[0,0,2]]"], "error: waypoints has 1 way-points"),
        (["waypoints=none.csv"], "error: waypoints=/"),
        (["file=none.csv"], "none.csv is missing; put the file back, or give the path of another\n"),
        ([f"file={'x' * 300}.csv"], "error: file must name a file that can be read"),
        ([f"waypoints={'x' * 300}.csv"], "error: waypoints must name a file that can be read"),
        (["waypoints=[[0,0,2],[1,1,2]]", "out=/proc/to/a.csv"], "give another folder by out=<path>"),
    ],
)
def test_the_command_refuses_in_a_sentence(arguments, said, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert plan(arguments) == 2
    assert said in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("file", "a,b\n1,2\n", " has no column t "),
        ("file", "t,x,y,z\n0,0,0,2\n1,0,0,2\n1,0,0,2\n2,0,0,2\n", ": t does not increase from row 2 "),
        ("file", "t,x,y,z,yaw\n0,0,0,2,0\n1,0,0,2,90\n2,0,0,2,0\n3,0,0,2,0\n", ": yaw goes from 0 to 90 rad "),
        ("file", "t,x,y,z\n0,0,0,2\n1,0,0,1\n2,0,0,0\n3,0,0,0\n", " and the payload would touch the ground"),
        ("waypoints", "a,b\n1,2\n", " has no column x "),
        ("waypoints", "x,y,z,t\n0,0,2,1\n1,0,2,0\n", ": the times of way-points 1 and 2, 1 and 0 s, do not increase"),
    ],
)
def test_the_command_blames_a_table_on_its_own_key(key, text, said, capsys, tmp_path):
    path = save(tmp_path, text)
    assert plan([f"{key}={path}"]) == 2
    message = capsys.readouterr().err
    assert f"error: {key}={path}" in message and said in message
