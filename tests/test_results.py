"""What the documents say of teams is what the recorded results hold."""

import json
import sys
from pathlib import Path

import pytest

import multilift_marl as ml
from multilift_marl.control.scripted import fitting_scripts

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "results"))
import reproduce  # noqa: E402


@pytest.mark.parametrize("document", ["README.md", "docs/tasks.md"])
def test_tables_are_those_of_the_results(document):
    assert reproduce.table() in (ROOT / document).read_text(encoding="utf-8")


def test_tables_are_written_between_their_marks(tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    whole = {}
    for document in ("README.md", "docs/tasks.md"):
        whole[document] = (ROOT / document).read_text(encoding="utf-8")
        (tmp_path / document).write_text(whole[document].replace(reproduce.table(), "old"), encoding="utf-8")
    monkeypatch.setattr(reproduce, "ROOT", tmp_path)
    reproduce.main(["table"])
    for document, text in whole.items():
        assert (tmp_path / document).read_text(encoding="utf-8") == text


def test_every_task_and_preset_is_flown_by_every_script():
    assert {flight.config for flight in reproduce.FLIGHTS.values()} >= set(ml.list_tasks())
    for name, flight in reproduce.FLIGHTS.items():
        for script in fitting_scripts(ml.make_vec(flight.config, num_envs=1, num_threads=1)):
            told = json.loads((ROOT / "results" / name / f"{script}.json").read_text(encoding="utf-8"))
            assert (told["episodes"], told["seed"]) == (reproduce.EPISODES["script"], reproduce.SEED)


def test_every_learned_team_is_flown_a_thousand_times():
    flown = 0
    for name, flight in reproduce.FLIGHTS.items():
        for weights in (ROOT / "results" / flight.recipe).glob("seed*/policy.pt"):
            path = ROOT / "results" / name / f"{weights.parent.name}.json"
            told = json.loads(path.read_text(encoding="utf-8"))
            assert (told["episodes"], told["seed"]) == (1000, reproduce.SEED)
            flown += 1
    assert flown > len(reproduce.FLIGHTS)


@pytest.mark.parametrize("weights", sorted((ROOT / "results").glob("*/seed0/policy.pt")), ids=lambda p: p.parts[-3])
def test_shipped_weights_are_those_of_the_results(weights):
    shipped = ROOT / "multilift_marl" / "policies" / f"{weights.parts[-3]}.pt"
    assert shipped.read_bytes() == weights.read_bytes()
