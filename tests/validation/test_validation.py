"""The validation module: its experiments pass, its command writes what it promises, and it notices wrong physics."""

import errno
import functools
import json
import os
import re
from pathlib import Path

import mujoco
import pytest

from multilift_marl.sim import world
from multilift_marl.sim.cables import massless
from multilift_marl.validation import __main__ as command
from multilift_marl.validation import bodies, cables, conservation, flight
from multilift_marl.validation.__main__ import EXPERIMENTS, main
from multilift_marl.validation.document import MARKER, SUMMARIES, format_summary, measure, read_csv, write_document
from multilift_marl.validation.experiment import Result, Row

KEYS = {"experiment", "quantity", "theory", "simulated", "error", "limit", "pass"}
DOCUMENT = Path(__file__).parents[2] / "docs" / "validation.md"
DATA = DOCUMENT.parent / "data"


@functools.cache
def fast(name):
    return EXPERIMENTS[name](True)


@pytest.mark.slow
@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_agrees_with_theory(name):
    rows = fast(name).rows
    assert rows
    for row in rows:
        if "real-time" not in row.quantity:  # which depends on what else the machine does
            assert row.passed, row


@pytest.mark.slow
def test_static_stiffness_is_within_the_reports_limit():
    rows = fast("single_cable").rows + fast("six_cables").rows
    static = [row for row in rows if row.quantity.startswith("static stiffness")]
    assert len(static) == 14 and max(row.error for row in static) < 1e-4


def test_flights_are_within_the_reports_limits():
    for rig, (slow, quick) in {"report4": (0.005, 0.010), "falcon4": (0.005, 0.015)}.items():
        rows = {(row.experiment, row.quantity[:10]): row for row in fast("flight").rows}
        assert rows[f"circle, {rig}, 0.2 rad/s", "mean posit"].error <= slow
        assert rows[f"circle, {rig}, 0.4 rad/s", "mean posit"].error <= quick
        for rate in ("0.2", "0.4"):
            assert rows[f"circle, {rig}, {rate} rad/s", "mean yaw e"].error <= 0.1
            assert rows[f"circle, {rig}, {rate} rad/s", "largest ya"].error <= 0.3
            payload = rows[f"circle, {rig}, {rate} rad/s", "mean paylo"]
            assert payload.error <= payload.limit < 0.05


def change_model(monkeypatch, change):
    """Let every World simulate a model that `change` has spoilt."""
    right = world.build_model

    def spoilt(system):
        model, layout = right(system)
        change(model)
        return model, layout

    monkeypatch.setattr(world, "build_model", spoilt)


def drag_bodies(model, dofs=slice(None)):
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_DAMPER)
    model.dof_damping[dofs] = 1e-3


def favour_an_axis(model):
    drag_bodies(model, 6)  # of the first drone, along x


def add_weight(model):
    model.body_mass[1] *= 1.3


def soften_the_ground(model):
    model.pair_solref[:] = [0.2, 1.0]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change", "complaint"),
    [
        ("momentum", drag_bodies, "linear momentum"),
        ("symmetry", favour_an_axis, "largest difference"),
        ("spin", drag_bodies, "energy after 1 s"),
        ("free_fall", drag_bodies, "speed without drag"),
        ("static_teams", add_weight, "tension"),
        ("ground", soften_the_ground, "height"),
    ],
)
def test_a_wrong_model_is_noticed(name, change, complaint, monkeypatch):
    change_model(monkeypatch, change)
    failed = [row.quantity for row in EXPERIMENTS[name](True).rows if not row.passed]
    assert any(quantity.startswith(complaint) for quantity in failed)


@pytest.mark.slow
def test_wrong_stiffness_is_noticed(tmp_path, monkeypatch, capsys):
    right = cables.limit_solref
    monkeypatch.setattr(cables, "limit_solref", lambda *arguments: 1.001 * right(*arguments))
    assert main(["--only", "single_cable", "--fast", "--out", str(tmp_path)]) == 1
    assert "| NO |" in capsys.readouterr().out


def test_wrong_damping_is_noticed(monkeypatch):
    right = massless.limit_solref
    monkeypatch.setattr(massless, "limit_solref", lambda k, c, weight: right(k, 0.5 * c, weight))
    assert any("parting" in row.quantity for row in EXPERIMENTS["slack_taut"](True).rows if not row.passed)


def test_wrong_gravity_is_noticed(monkeypatch):
    monkeypatch.setattr(bodies, "GRAVITY", 9.80)
    assert any("without drag" in row.quantity for row in EXPERIMENTS["free_fall"](True).rows if not row.passed)


def test_loads_left_out_of_the_balance_are_noticed(monkeypatch):
    right = conservation.loads
    monkeypatch.setattr(conservation, "loads", lambda world: tuple(1.0001 * part for part in right(world)))
    team = conservation.make_team("massless")
    assert min(conservation.massless_balance(team, 0.1)) > 1e-9
    assert conservation.momentum_drift(conservation.make_team("chain"), 0.1)[0] > 1e-9


@pytest.mark.slow
def test_a_flight_without_feed_forward_is_not_good_enough(monkeypatch):
    monkeypatch.setattr(flight, "carrying_forces", lambda system, acceleration, velocity: 0.0)
    assert any(row.quantity.startswith("mean payload") for row in EXPERIMENTS["flight"](True).rows if not row.passed)


def test_command_writes_rows_and_plots(tmp_path, capsys):
    assert main(["--only", "motor_lag", "--out", str(tmp_path)]) == 0
    rows = json.loads((tmp_path / "validation.json").read_text())
    assert len(rows) == 3 and all(set(row) == KEYS and row["pass"] is True for row in rows)
    assert (tmp_path / "motor_lag.png").read_bytes().startswith(b"\x89PNG")
    shown = capsys.readouterr()
    assert "| experiment | quantity | theory | simulated | error | limit | pass |" in shown.out
    assert "3 of 3 passed" in shown.out and "motor_lag" in shown.err


def test_a_folder_that_cannot_be_written_is_noticed_before_the_work(tmp_path, monkeypatch, capsys):
    (tmp_path / "file").touch()
    monkeypatch.setattr(command, "EXPERIMENTS", {"spin": None})
    monkeypatch.chdir(tmp_path)
    assert main(["--out", "file/below"]) == 2
    told = "error: cannot write into file/below (Not a directory); give another folder by --out <folder>\n"
    assert capsys.readouterr().err == told


def test_interrupted_run_keeps_what_was_computed(tmp_path, monkeypatch, capsys):
    def interrupt(fast):
        raise KeyboardInterrupt

    few = {"motor_lag": EXPERIMENTS["motor_lag"], "spin": interrupt, "swing": EXPERIMENTS["swing"]}
    monkeypatch.setattr(command, "EXPERIMENTS", few)
    assert main(["--fast", "--out", str(tmp_path)]) == 130
    assert len(json.loads((tmp_path / "validation.json").read_text())) == 3
    assert "interrupted: 1 experiments were complete" in capsys.readouterr().err


def test_results_that_cannot_be_written_are_printed_all_the_same(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(os, "replace", fail)
    assert main(["--fast", "--only", "motor_lag", "--out", str(tmp_path)]) == 2
    shown = capsys.readouterr()
    assert "| motor lag, 4 ms |" in shown.out and "3 of 3 passed" in shown.out and "wrote" not in shown.out
    told = f"error: cannot write {tmp_path} (No space left on device); make room, or use another folder\n"
    assert shown.err.endswith(told) and not list(tmp_path.iterdir())


def fail(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


@pytest.mark.parametrize("partly", ["only", "interrupted"])
def test_partial_results_leave_complete_ones(tmp_path, monkeypatch, capsys, partly):
    def interrupt(fast):
        raise KeyboardInterrupt

    few = {"motor_lag": EXPERIMENTS["motor_lag"], "spin": EXPERIMENTS["motor_lag"]}
    monkeypatch.setattr(command, "EXPERIMENTS", few)
    main(["--fast", "--out", str(tmp_path)])
    whole = (tmp_path / "validation.json").read_bytes()
    if partly == "interrupted":
        monkeypatch.setitem(few, "spin", interrupt)
    main(["--fast", "--out", str(tmp_path), *(["--only", "motor_lag"] if partly == "only" else [])])
    assert (tmp_path / "validation.json").read_bytes() == whole
    partial = tmp_path / "validation_partial.json"
    assert len(json.loads(partial.read_text())) == 3 and f"wrote {partial} and plots" in capsys.readouterr().out
    if partly == "only":
        main(["--fast", "--out", str(tmp_path)])
        assert len(json.loads((tmp_path / "validation.json").read_text())) == 6


def test_unknown_experiment_names_the_nearest(capsys):
    assert main(["--only", "swng"]) == 2
    assert "unknown experiment 'swng'; did you mean 'swing'?" in capsys.readouterr().err


def test_missing_document_is_named_before_the_work(capsys):
    assert main(["--only", "swing", "--document", "nowhere.md"]) == 2
    assert "there is no nowhere.md" in capsys.readouterr().err


def test_document_takes_its_table_and_records_rows_and_pictures(tmp_path):
    document = tmp_path / "results.md"
    document.write_text("# Head\n<!-- results -->\nold\n")
    main(["--fast", "--only", "motor_lag", "--out", str(tmp_path / "out"), "--document", str(document)])
    text = document.read_text()
    assert text.startswith("# Head\n") and "| `motor_lag` |" in text and "old" not in text
    assert "](images/results/motor_lag.png)" in text and (tmp_path / "images" / "results" / "motor_lag.png").is_file()
    rows = read_csv(tmp_path / "data" / "results.csv")
    assert [row["experiment"] for row in rows] == ["motor lag, 4 ms", "motor lag, 2 ms", "motor lag, 1 ms"]
    assert read_csv(tmp_path / "data" / "results_plots.csv")[0]["file"] == "motor_lag.png"


def test_document_keeps_the_rows_of_other_experiments(tmp_path):
    document = tmp_path / "results.md"
    document.write_text("<!-- results -->\n")
    for name, value in (("spin", 0.1), ("swing", 0.2), ("spin", 0.3)):
        result = Result()
        result.check(name, "energy", value, 1.0)
        write_document(document, {name: result}, tmp_path)
    rows = read_csv(tmp_path / "data" / "results.csv")
    assert [(row["only"], row["error"]) for row in rows] == [("swing", "0.2"), ("spin", "0.3")]


def test_shipped_document_is_the_table_of_the_recorded_rows():
    rows, plots = read_csv(DATA / "validation.csv"), read_csv(DATA / "validation_plots.csv")
    table = DOCUMENT.read_text(encoding="utf-8").partition(MARKER)[2]
    assert table == "\n" + format_summary(rows, plots, "validation")
    assert list(dict.fromkeys(row["only"] for row in rows)) == list(EXPERIMENTS)
    assert all(
        row["pass"] == "yes" and (not row["limit"] or float(row["error"]) <= float(row["limit"])) for row in rows
    )


def test_each_recorded_row_with_a_limit_is_in_the_table_once():
    assert SUMMARIES.keys() == EXPERIMENTS.keys()
    for row in read_csv(DATA / "validation.csv"):
        if row["limit"]:
            patterns = SUMMARIES[row["only"]].measures.values()
            assert sum(re.match(pattern, row["quantity"]) is not None for pattern in patterns) == 1, row


@pytest.mark.parametrize(
    ("quantity", "rows", "shown"),
    [
        ("speed", [(1.0, 0.5, 0.5, 1.0), (1.0, 0.02, 0.02, 0.03)], "0.02 (0.03)"),
        ("order, shortfall of 0.9", [(1.0, 0.95, 0.0, 0.0), (1.0, 2.0, 0.0, 0.0)], "0.95 (≥ 0.9)"),
        ("peak, excess over 2", [(1.0, 1.5, 0.0, 0.0), (1.0, 1.7, 0.0, 0.0)], "1.7 (≤ 2)"),
        ("how far its error stays below 5 %", [(2.0, 1.0, 0.0, 0.0), (2.0, 5.0, 0.0, 0.0)], "50 % (≥ 5 %)"),
        ("speed", [(0.0, 0.1, 0.1, float("inf"))], "not measured"),
    ],
)
def test_the_table_shows_what_is_nearest_to_its_limit(quantity, rows, shown):
    recorded = []
    for theory, simulated, error, limit in rows:
        finite = "" if limit == float("inf") else str(limit)
        numbers = {"theory": str(theory), "simulated": str(simulated), "error": str(error), "limit": finite}
        recorded.append({"quantity": quantity, **numbers})
    assert measure(recorded, ".*") == shown


def test_shipped_pictures_are_those_of_the_experiments_and_small():
    files = {plot["file"] for plot in read_csv(DATA / "validation_plots.csv")}
    pictures = DOCUMENT.parent / "images" / "validation"
    assert len(files) > 20 and {path.name for path in pictures.iterdir()} == files
    assert all((pictures / file).stat().st_size <= 60_000 for file in files)


def test_all_experiments_are_named_in_help(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out.replace("\n", " ")
    for name in EXPERIMENTS:
        assert name in shown


@pytest.mark.parametrize("error", [float("nan"), float("inf"), 1.1])
def test_rows_beyond_their_limit_fail(error):
    row = Row("a", "b", 0.0, error, error, 1.0)
    assert not row.passed
    json.dumps(row.as_dict(), allow_nan=False)


def test_order_of_convergence_is_measured():
    steps = [4e-3, 2e-3, 1e-3]
    result = Result()
    for errors in ([3 * step for step in steps], [step**2 for step in steps], [0.1, 0.1, 0.1]):
        result.order("a", "b", errors, steps)
    assert result.rows[0].simulated == pytest.approx(1.0)
    assert [row.passed for row in result.rows] == [True, True, False]
