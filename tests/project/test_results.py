"""What the documents say of teams is what the recorded results hold."""

import csv
import json
import re
import sys
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.rigs import evaluated_rigs
from multilift_marl.envs.core import TRAINING_EVALUATION
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import LINEAR, fitting_scripts
from multilift_marl.policies.formation import Formation
from multilift_marl.schema.training import check_base_policy

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "results"))
import reproduce  # noqa: E402
import search_gains  # noqa: E402
import searched  # noqa: E402
import shifts  # noqa: E402
import tables  # noqa: E402


@pytest.mark.slow
def test_tables_are_those_of_the_results(tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    for page in ("README.md", "docs/results.md"):
        text = re.sub(r"^\|.* cm .*\n", "", (ROOT / page).read_text(encoding="utf-8"), flags=re.MULTILINE)
        (tmp_path / page).write_text(text, encoding="utf-8")
    monkeypatch.setattr(tables, "ROOT", tmp_path)
    reproduce.main(["table"])
    for name in ("docs/results.md", "docs/data/results.csv", "docs/data/shifts.csv"):
        assert (tmp_path / name).read_text(encoding="utf-8") == (ROOT / name).read_text(encoding="utf-8"), name


def test_every_task_has_a_heading_and_every_flight_a_row():
    page = (ROOT / "docs" / "results.md").read_text(encoding="utf-8")
    parts = dict(re.findall(r"^## (\w+)$(.*?)^<!-- end of results -->$", page, re.MULTILINE | re.DOTALL))
    assert {name.lower() for name in parts} == {ml.load_config(each.config).task for each in tables.FLIGHTS.values()}
    verdicts = []
    for name, part in parts.items():
        rows = [line.strip("| ").split(" | ") for line in part.splitlines() if line.startswith("| ")][1:]
        titles = [tables.FLIGHTS[flight].title for flight in tables.flights_of(name.lower())]
        assert [row[0] for row in rows] == [title.removeprefix(f"{name.lower()}, ") for title in titles]
        verdicts += [row[4] for row in rows]
    assert len(verdicts) == len(tables.FLIGHTS)
    assert set(verdicts) <= {"better", "no significant difference", "worse", "-"}


@pytest.mark.slow
def test_flights_are_flown_a_thousand_times_by_shipped_teams_and_scripts():
    others = {"navigate"}  # which results/navigate.py flies
    assert {flight.config for flight in reproduce.FLIGHTS.values()} >= set(ml.list_tasks()) - others
    compared = 0
    for name, flight in reproduce.FLIGHTS.items():
        fitting = fitting_scripts(ml.make_vec(flight.config, num_envs=1, num_threads=1, **reproduce.SCRIPTED))
        evaluated, reported = (
            {path.stem for path in (ROOT / "results" / name).glob(kind)} for kind in ("*.npz", "*.json")
        )
        assert evaluated == reported - {"shifts"} >= set(flight.scripts or fitting)
        compared += "seed0" in evaluated and bool(evaluated & {*fitting, "searched"})
        for team in evaluated:
            reported = json.loads((ROOT / "results" / name / f"{team}.json").read_text(encoding="utf-8"))
            assert (reported["episodes"], reported["seed"]) == (reproduce.episodes_of(team), reproduce.SEED)
    learned = [flight for flight in reproduce.FLIGHTS.values() if (ROOT / "results" / flight.recipe / "seed0").is_dir()]
    assert compared == len(learned) > 20


@pytest.mark.parametrize("path", sorted((ROOT / "docs").glob("*/*.csv")), ids=lambda path: path.stem)
def test_tables_beside_pages_have_the_same_columns_in_every_row(path):
    with open(path, newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert rows and all(len(row) == len(head) for row in rows) and len(set(head)) == len(head)


def test_a_cell_holds_mean_and_range_of_what_is_there(tmp_path):
    paths = [tmp_path / f"seed{seed}.json" for seed in range(3)]
    assert tables._cell(paths, "payload_rmse_m") == "-"
    paths[0].write_text('{"metrics": {"success_rate": {"mean": 0.5}, "payload_rmse_m": {"mean": 0.01}}}')
    assert tables._cell(paths, "payload_rmse_m") == "50.0 %, 1.00 cm"
    paths[2].write_text('{"metrics": {"success_rate": {"mean": 0.6}, "payload_rmse_m": {"mean": 0.01}}}')
    assert tables._cell(paths, "payload_rmse_m") == "55.0 [50.0–60.0] %, 1.00 cm"


def test_episodes_are_kept_beside_their_mean():
    found = 0
    for name, flight in reproduce.FLIGHTS.items():
        for path in (ROOT / "results" / name).glob("*.npz"):
            reported = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
            episodes, metrics = np.load(path), reported["metrics"]
            assert len(episodes["success"]) == reported["episodes"]
            assert episodes["success"].mean() == pytest.approx(metrics["success_rate"]["mean"])
            error = metrics[reproduce.error_metric(flight)]["mean"]
            assert episodes["error"].mean(dtype=float) == pytest.approx(error, rel=1e-5)
            found += 1
    assert found


def write_episodes(folder, team, success, error):
    folder.mkdir(exist_ok=True)
    np.savez_compressed(folder / f"{team}.npz", success=np.array(success, bool), error=np.array(error, np.float32))


def test_the_gain_of_learning_is_paired_with_the_best_baseline(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "HERE", tmp_path)
    folder, error = tmp_path / "gate", np.linspace(0.01, 0.5, 100)
    assert tables.compare("gate") is None
    write_episodes(folder, "formation", [True] * 50 + [False] * 50, np.zeros(100))
    write_episodes(folder, "formation_lead", [True] * 100, error)
    write_episodes(folder, "seed0", [True] * 100, error - 0.01)
    write_episodes(folder, "seed1", [True] * 100, error - 0.003)
    assert tables.best_baseline("gate") == "formation_lead"
    assert tables.compare("gate") == ("0 points, −0.65 (−1.00, −0.30) cm", "better")
    write_episodes(folder, "seed0", [True] * 90 + [False] * 10, error - 0.01)
    gain, verdict = tables.compare("gate")
    assert gain.startswith("−5.0 (") and verdict == "no significant difference"
    write_episodes(folder, "seed1", [True] * 90 + [False] * 10, error - 0.01)
    gain, verdict = tables.compare("gate")
    assert gain.startswith("−10.0 (") and verdict == "worse"
    write_episodes(folder, "formation_lead", [False] * 100, error)
    for seed in ("seed0", "seed1"):
        write_episodes(folder, seed, [True] * 100, error + 1)
    gain, verdict = tables.compare("gate")
    assert gain.startswith("+50.0 (") and verdict == "better"


@pytest.mark.parametrize(
    ("points", "centimetres", "verdict"),
    [
        ([0] * 1000, [-0.2] * 1000, "better"),
        ([0] * 1000, [0.2] * 1000, "worse"),
        ([0] * 1000, [-0.09] * 1000, "no significant difference"),  # below a millimetre
        ([0] * 1000, [-9, 9] * 500, "no significant difference"),
        ([100] * 100 + [0] * 900, [9] * 900, "better"),  # success decides
        ([-100] * 100 + [0] * 900, [-9] * 900, "worse"),
        ([100, -100] * 20 + [0] * 960, [-0.2] * 960, "better"),  # success within noise
        ([-100] * 9 + [0] * 991, [-0.2] * 991, "no significant difference"),  # below a point, but significant
        ([-100] * 9 + [0] * 991, [0.2] * 991, "worse"),
        ([-100] * 1000, [], "worse"),
    ],
)
def test_a_verdict_is_one_of_three(points, centimetres, verdict):
    error = np.array([centimetres] if centimetres else [], float)
    assert tables.judge(np.array([points], float), error) == verdict


def test_a_gain_that_training_seeds_disagree_about_is_none():
    """Of one training seed alone each of these would be significant."""
    error = np.repeat([[-1.0], [0.9], [-0.8]], 1000, axis=1)
    assert tables.judge(np.zeros((3, 1000)), error) == "no significant difference"
    for one, verdict in zip(error, ("better", "worse", "better"), strict=True):
        assert tables.judge(np.zeros((1, 1000)), one[None]) == verdict


def test_the_best_baseline_is_the_most_exact_of_those_that_succeed_as_often_within_noise(tmp_path, monkeypatch):
    monkeypatch.setattr(tables, "HERE", tmp_path)
    assert tables.best_baseline("gate") == ""
    folder = tmp_path / "gate"
    write_episodes(folder, "formation", [True] * 1000, np.full(1000, 0.2))
    for failures, best in ((6, "formation"), (5, "formation_gusts")):  # p = 2 / 2**6 and 2 / 2**5
        write_episodes(folder, "formation_gusts", [True] * (1000 - failures) + [False] * failures, np.full(1000, 0.1))
        assert tables.best_baseline("gate") == best
    write_episodes(folder, "formation_lead", [True] * 980 + [False] * 20, np.full(1000, 0.01))
    assert tables.best_baseline("gate") == "formation_gusts"


def test_judging_can_be_stopped_and_started_again(tmp_path, monkeypatch):
    monkeypatch.setattr(reproduce, "HERE", tmp_path)
    monkeypatch.setattr(reproduce, "episodes_of", lambda team: 2)
    (job,) = reproduce.list_jobs("land", "formation")
    assert not job.done and len(reproduce.list_jobs("land")) > 4
    assert reproduce.fly(job).startswith("land, formation: success ")
    assert job.done and {path.name for path in (tmp_path / "land").iterdir()} == {"formation.json", "formation.npz"}
    monkeypatch.setattr(reproduce, "fly", None)  # would be called for what is left
    reproduce.evaluate(["land/formation"], 1)
    job.files[1].unlink()
    assert not job.done


def flat(section, prefix=""):
    """Return values by dotted name."""
    found = {}
    for key, value in section.items():
        found |= flat(value, f"{prefix}{key}.") if isinstance(value, dict) and value else {prefix + key: value}
    return found


@pytest.mark.parametrize(
    "weights", sorted((ROOT / "results").glob("*/seed*/policy.pt")), ids=lambda path: "-".join(path.parts[-3:-1])
)
def test_kept_weights_were_trained_by_the_recipe(weights):
    stored = flat(load_checkpoint(weights)["config"])
    recipe = flat(ml.load_config(weights.parts[-3]).model_dump(mode="json"))
    assert stored["seed"] == int(weights.parts[-2].removeprefix("seed"))
    own = {"seed", "env.num_threads", "train.threads", "train.logger", "train.workers", "train.ray"}
    later = recipe.keys() - stored.keys() - own  # keys that were added since
    assert {key for key in later if not key.startswith("planner.")} <= {
        "cable.azimuth",
        "train.critic_learning_rate",
        "train.init",
        "train.stages",
        "train.warmup",
        "vehicle.rotor_inertia",
        "import",
        "task_options.success_angle",
        "task_options.broadcast",
        "env.sensing",
        "env.units",
        "control.heading",
        "control.obstacle_margin",
        "control.payload_margin",
        "control.sector_margin",
        "train.rigs",
        "env.communication",
        "env.communication_delay",
        "env.communication_loss",
        "env.communication_range",
        "control.max_angular_acceleration",
        "control.max_jerk",
        "control.max_cable_force",
        "train.asinh",
        "train.gru",
        "train.sequence",
        "push.interval",
        "push.payload_velocity",
        "push.drone_velocity",
        "push.drone_rates",
        "contact.friction",
        "contact.restitution",
        "payload.origin",
        "vehicle.rotor_solidity",
        "wind.inflow",
        "task_options.file_ramp",
        "task_options.file_offset",
        "task_options.waypoints",
        "task_options.waypoint_times",
        "scene.obstacles",
        "scene.reserved",
        "env.obstacle_sensing",
        "control.max_weight",
        "train.observe",
        *(key for key in later if key.startswith(("train.diffmpc.", "train.dagger."))),
        *(key for key in later if key.startswith("env.obstacles.")),
    }
    stored["train.residual"] = check_base_policy(stored["train.residual"])  # tuned gains had no names once
    own |= {key for key in stored if stored[key] == {} and any(name.startswith(f"{key}.") for name in later)}
    for key in ("control.attitude_frequency", "control.position_frequency"):
        if recipe[key] is None and stored[key] is not None:
            # as fast as can be, which was stated by a number that was always limited
            assert stored[key] >= {"control.attitude_frequency": 30, "control.position_frequency": 6}[key]
            own |= {key}
    assert {key: stored[key] for key in stored.keys() - own} == {
        key: recipe[key] for key in recipe.keys() - own - later
    }


@pytest.mark.parametrize("weights", sorted((ROOT / "results").glob("*/seed0/policy.pt")), ids=lambda p: p.parts[-3])
def test_shipped_weights_are_those_of_the_results(weights):
    shipped = ROOT / "multilift_marl" / "policies" / f"{weights.parts[-3]}.pt"
    assert shipped.read_bytes() == weights.read_bytes()


@pytest.mark.parametrize(
    ("config", "script"), [("pose", "formation_gusts"), ("track", "formation_lead"), ("hover", "hold_ctbr")]
)
def test_the_search_changes_the_gains_of_its_script(config, script):
    vec = ml.make_vec(config, num_envs=1, num_threads=1, **{"control.action": LINEAR[script].INTERFACE})
    free = search_gains.SLOTS if script.startswith("formation") else search_gains.HELD
    free = tuple(each for each in free if f"{each[0]}_0" in vec.observation_names)
    begun = search_gains.make_script(script, free, np.zeros(len(free)))(vec).matrix()
    np.testing.assert_array_equal(begun, LINEAR[script](vec).matrix())
    changed = search_gains.make_script(script, free, np.eye(len(free))[0])(vec).matrix()
    assert (changed != begun).any(axis=0)[vec.observation_names.index(f"{free[0][0]}_0")]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "script"), [("hover_wind", "formation_integral"), ("gate_realistic", "formation_narrow")]
)
def test_the_search_measures_what_evaluations_do(name, script):
    config = ml.load_config(name, {"env.num_envs": 16})
    evaluated = search_gains.fly(config, LINEAR[script], seed=3)
    reported = run_episodes(config, LINEAR[script], 16, 3, TRAINING_EVALUATION)
    assert evaluated.success == reported["success_rate"].mean()
    assert evaluated.error == reported["payload_position_error_m"].mean()
    paid = search_gains.fly(config, LINEAR[script], seed=3, cost="return")
    assert paid.cost == -reported["return"].mean()
    assert paid[1:] == evaluated[1:]


@pytest.mark.slow
def test_the_search_prints_gains_that_a_script_can_have(capsys):
    keys = {"config": "hover", "minutes": 1e-3, "env.num_envs": 4, "env.episode_seconds": 2.0}
    assert search_gains.main(keys) == 0
    lines = capsys.readouterr().out.splitlines()
    rows = [eval(line.strip().rstrip(",")) for line in lines if line.startswith("        (")]
    vec = ml.make_vec("hover", num_envs=1, num_threads=1)
    known = [each for each in search_gains.SLOTS if f"{each[0]}_0" in vec.observation_names]
    assert {row[:3] for row in rows} == {(name, *axis) for name, axes, _ in known for axis in axes}
    assert lines[0].startswith("1: cost") and lines[-1].startswith("searched: ")
    script = type("Found", (Formation,), {"GAINS": tuple(rows)})
    assert np.abs(script(vec).matrix()).max() > 0


def test_the_search_finds_gains_that_cost_less(monkeypatch):
    start = {row[:3]: row[3] for row in LINEAR["formation_feedback"].GAINS}

    def bowl(config, script, seed, cost):
        gains = {}
        for name, axis, moved, gain in script.GAINS:
            gains[name, axis, moved] = gains.get((name, axis, moved), 0.0) + gain
        return search_gains.Score(sum((gain - 0.3) ** 2 for gain in gains.values()), 0.0, 0.0, 0.0, 0.0)

    clock = count()  # a second from one generation to the next
    monkeypatch.setattr(search_gains, "fly", bowl)
    monkeypatch.setattr(search_gains, "time", SimpleNamespace(monotonic=lambda: next(clock)))
    free = tuple(each for each in search_gains.SLOTS if each[0].startswith(("payload", "tracking", "rotation")))
    changes = search_gains.search(ml.load_config("pose"), "formation_feedback", free, spread=0.3, minutes=2.0)
    before = np.array([start.get((name, *axes[0]), 0.0) for name, axes, _ in free])
    assert np.abs(before + changes - 0.3).max() < 0.3 * np.abs(before - 0.3).max()


def test_a_search_flies_some_of_the_rigs_in_turn():
    config = ml.load_config("pose_generalist")
    turns = [search_gains.some_rigs(config, 5, generation).train.rigs for generation in range(12)]
    assert all(len(turn) == 5 for turn in turns)
    assert [rig for turn in turns for rig in turn] == list(config.train.rigs) * 5
    assert search_gains.some_rigs(config, None, 3) is config


@pytest.mark.parametrize(
    ("script", "drones"), [(searched.GateTeams, 3), (searched.GateTeams, 6), (searched.GateTeamsLarge, 8)]
)
def test_rings_of_many_drones_become_ellipses_in_a_gate(script, drones):
    config = ml.load_config("gate", {"env.num_envs": 4, "env.num_drones": drones})
    assert run_episodes(config, script, 4, 3, TRAINING_EVALUATION)["success_rate"].all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pose_generalist", "track_generalist"])
def test_scripts_for_several_rigs_fly_each_of_them(name):
    script = {"pose_generalist": searched.PoseRigs, "track_generalist": searched.TrackRigs}[name]
    config = ml.load_config(name, {"env.num_envs": 1, "env.episode_seconds": 5.0})
    for rig in evaluated_rigs(config):
        assert (run_episodes(rig, script, 1, 3, TRAINING_EVALUATION)["failure_cause"] == 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("flight", sorted(searched.SEARCHED))
def test_searched_scripts_fit_their_flights(flight):
    script = searched.SEARCHED[flight]
    config = reproduce.load_config(reproduce.FLIGHTS[flight].config, searched.settings_of(flight))
    vec = ml.make_vec(config, num_envs=1, num_threads=1)
    assert not script.refusal(vec) and np.abs(script(vec).matrix()).max() > 0


@pytest.mark.parametrize(
    ("keys", "reason"),
    [
        ({"script": "formation_gust"}, "did you mean 'formation_gusts'"),
        ({"script": None}, "script must be a valid string, but is None"),
        ({"control.action": "velocity"}, "cannot fly control.action=velocity"),
        ({"minutes": "abc"}, "minutes must be a number, but is 'abc'"),
        ({"minutes": 0}, "minutes must be greater than 0"),
        ({"rigs": 2}, "config=pose_wind has none"),
        ({"rigs": 0}, "rigs must be greater than or equal to 1"),
        ({"spread": float("nan")}, "spread must be a finite number"),
    ],
)
def test_what_cannot_be_searched_is_refused(keys, reason):
    assert reason in refusal(search_gains.main, dict(keys))


def test_a_search_without_its_package_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "cma", None)
    assert "pip install cma" in refusal(
        search_gains.search, ml.load_config("pose"), "formation", search_gains.SLOTS, 0.3, 1.0
    )


def test_changes_of_a_flight_are_of_its_own_number_of_drones(monkeypatch):
    flown = {}

    def fly(flight, shift, own, maker, episodes):
        flown[shift.title] = shift
        return {}

    monkeypatch.setattr(shifts, "fly", fly)
    monkeypatch.setattr(shifts, "write_whole", lambda path, content: None)
    shifts.main(["track_generalist"])  # five drones, by keys of the flight
    numbers = [flown[f"one drone {which}"].overrides["env.num_drones"] for which in ("less", "more")]
    weaker = flown["one drone 15 % weaker"].factors["vehicle_thrust_coefficient"]
    assert numbers == [4, 6] and len(weaker) == 5
