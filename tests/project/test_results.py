"""What the documents say of teams is what the recorded results hold."""

import csv
import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.policies.baselines import fitting_scripts
from multilift_marl.schema.training import check_base_policy

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "results"))
import reproduce  # noqa: E402
import shifts  # noqa: E402
import tables  # noqa: E402
import twin  # noqa: E402


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
    tasks = {ml.load_config(flight.config).task for flight in reproduce.FLIGHTS.values()}
    assert tasks == set(ml.list_tasks())
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


def test_a_table_of_twins_keeps_rows_of_other_changes_and_of_other_columns(tmp_path):
    table, keep = tmp_path / "twins.csv", twin.keep
    keep(table, "", [{"team": "learned", "success": "90"}, {"team": "twin", "success": "20", "minus": "60 to 80"}])
    keep(table, "late", [{"team": "learned", "success": "80"}])
    keep(table, "late", [{"team": "learned", "success": "81"}])
    assert table.read_text() == ("changes,team,success,minus\n,learned,90,\n,twin,20,60 to 80\nlate,learned,81,\n")


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
    write_episodes(folder, "seed0", [True] * 100, error + 1)
    write_episodes(folder, "seed1", [True] * 100, error + 1)
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
    error = [centimetres] if centimetres else []
    assert tables.judge(np.array([points], float), np.array(error, float)) == verdict


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


@pytest.mark.slow
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
        "payload.anchor_radius",
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
        "control.swing_shift",
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
        "eval.keep",
        "train.changes",
        "randomization.rotor_thrust_coefficient",
        "wind.turbulence_speed",
        "task_options.success_tension",
        *(key for key in later if key.startswith(("train.diffmpc.", "train.dagger."))),
        *(key for key in later if key.startswith("env.obstacles.")),
        # overrides that take back those of the recipe that it is based on
        *(key for key in later if key.startswith("train.overrides.") and recipe[key] == recipe[key[16:]]),
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
