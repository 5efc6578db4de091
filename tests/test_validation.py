"""The validation module: it runs, its rows say what they must, and it notices wrong physics."""

import json

import numpy as np
import pytest

from multilift_marl.config import load_config
from multilift_marl.validation import cables, flight
from multilift_marl.validation.__main__ import EXPERIMENTS, main


@pytest.fixture(scope="module")
def rows(tmp_path_factory):
    out = tmp_path_factory.mktemp("validation")
    main(["--fast", "--out", str(out)])
    return json.loads((out / "validation.json").read_text()), out


def test_every_row_has_the_keys_and_all_but_speed_pass(rows):
    found, _ = rows
    for row in found:
        assert {"experiment", "theory", "simulated", "error", "limit", "pass"} <= set(row)
        if "real-time" not in row["quantity"]:  # which depends on what else the machine does
            assert row["pass"] is True and (row["limit"] is None or row["error"] <= row["limit"]), row


def test_the_reports_figures_are_within_its_limits(rows):
    found, _ = rows
    static = [row for row in found if row["quantity"].startswith("static stiffness")]
    assert len(static) == 14 and max(row["error"] for row in static) < 1e-4
    flown = {row["experiment"]: row["error"] for row in found if row["quantity"].startswith("mean position error")}
    assert flown["circle, report4, 0.2 rad/s"] <= 0.005 and flown["circle, report4, 0.4 rad/s"] <= 0.010
    assert flown["circle, falcon4, 0.2 rad/s"] <= 0.005 and flown["circle, falcon4, 0.4 rad/s"] <= 0.015


def test_plots_are_written(rows):
    _, out = rows
    names = {path.name for path in out.glob("*.png")}
    assert {"single_cable_1_kg.png", "six_cables_60_kg.png", "swing.png", "circle_error.png"} <= names


def test_wrong_physics_is_noticed(tmp_path, monkeypatch, capsys):
    right = cables.limit_solref
    monkeypatch.setattr(cables, "limit_solref", lambda *arguments: 1.001 * right(*arguments))
    assert main(["--fast", "--only", "single_cable", "--out", str(tmp_path)]) == 1
    assert "| NO |" in capsys.readouterr().out


def test_unknown_experiment_names_the_nearest(capsys):
    assert main(["--only", "swng"]) == 2
    assert "unknown experiment 'swng'; did you mean 'swing'?" in capsys.readouterr().err


def test_document_takes_the_table(tmp_path):
    document = tmp_path / "validation.md"
    document.write_text("# Head\n<!-- results -->\nold\n")
    main(["--fast", "--only", "motor_lag", "--out", str(tmp_path), "--document", str(document)])
    text = document.read_text()
    assert text.startswith("# Head\n") and "motor lag, 4 ms" in text and "old" not in text


def test_second_order_system_solves_its_equation():
    t = np.linspace(0, 0.05, 20001)
    for mass, stiffness, damping in ((1.0, 1e5, 1e3), (10.0, 1e5, 1e3), (0.1, 1e5, 1e3)):
        x = cables.second_order(mass, stiffness, damping, t)
        v = np.gradient(x, t)
        residual = mass * np.gradient(v, t) + damping * v + stiffness * x - mass * 9.81
        assert np.abs(residual[5:-5]).max() < 0.02 * mass * 9.81
        assert abs(x[0]) < 1e-15


def test_path_of_the_circle_is_consistent():
    h = 1e-4
    for t in (0.5, 3.0, 5.0, 7.9, 12.0):
        p, a, _, rate = flight._along_circle(t, 0.4)
        before, after = flight._along_circle(t - h, 0.4), flight._along_circle(t + h, 0.4)
        np.testing.assert_allclose((after[0] - 2 * p + before[0]) / h**2, a, atol=1e-5)
        np.testing.assert_allclose((after[2] - before[2]) / (2 * h), rate, atol=1e-6)
        assert np.linalg.norm(p) == pytest.approx(flight.RADIUS)


def test_accelerating_forces_push_and_do_not_turn():
    system = load_config("hover").system
    force = flight.accelerating_forces(system, np.array([0.5, -0.2, 0.1]))
    np.testing.assert_allclose(force.sum(axis=0), system.payload_mass * np.array([0.5, -0.2, 0.1]), atol=1e-12)
    np.testing.assert_allclose(np.cross(system.anchors, force).sum(axis=0), 0, atol=1e-12)


def test_all_experiments_are_named_in_help(capsys):
    with pytest.raises(SystemExit):
        main(["--help"])
    shown = capsys.readouterr().out.replace("\n", " ")
    for name in EXPERIMENTS:
        assert name in shown
