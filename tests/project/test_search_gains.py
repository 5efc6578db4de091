"""The search for gains of linear policies, and the policies that it found."""

import sys
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import refusal, slow

import multilift_marl as ml
from multilift_marl.agents.rigs import evaluated_rigs
from multilift_marl.envs.core import TRAINING_EVALUATION
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import LINEAR
from multilift_marl.policies.formation import Formation

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "results"))
import reproduce  # noqa: E402
import search_gains  # noqa: E402
import searched  # noqa: E402


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
    config = ml.load_config(name, {"env.num_envs": 16, "train.rigs": []})
    evaluated = search_gains.fly(config, LINEAR[script], seed=3)
    reported = run_episodes(config, LINEAR[script], 16, 3, TRAINING_EVALUATION)
    assert evaluated.success == reported["success_rate"].mean()
    assert evaluated.error == reported["payload_position_error_m"].mean()
    paid = search_gains.fly(config, LINEAR[script], seed=3, cost="return")
    assert paid.cost == -reported["return"].mean()
    assert paid[1:] == evaluated[1:]


def test_rigs_of_a_search_fly_different_episodes(monkeypatch):
    flown, run = [], search_gains.run_episodes
    monkeypatch.setattr(
        search_gains, "run_episodes", lambda *args, first: flown.append(first) or run(*args, first=first)
    )
    keys = {"env.num_envs": 6, "env.episode_seconds": 0.1, "train.rigs": [{}, {}, {}], "env.num_threads": 1}
    search_gains.fly(ml.load_config("hover", keys), LINEAR["formation"], seed=3)
    assert flown == [0, 2, 4]


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
    ("script", "drones"), [slow(searched.GateTeams, 3), (searched.GateTeams, 6), slow(searched.GateTeamsLarge, 8)]
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
