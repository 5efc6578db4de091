"""The examples of training by others: what needs no other environment is trained, all is short, listed and compiles."""

import csv
import re
import sys
from pathlib import Path

import pytest
from conftest import load_script

FOLDER = Path(__file__).parents[2] / "examples"
HERE = ("cleanrl_ppo", "torchrl_wrapper")  # need no more than the package's own `train` extra
check = load_script("examples/check")


@pytest.mark.slow
@pytest.mark.parametrize("name", HERE)
def test_example_trains(name, tmp_path):
    result = check.try_out(sys.executable, name, tmp_path, num_envs=2)
    assert result["weights"] > 1000 and result["moved"] > 0


@pytest.mark.slow
@pytest.mark.parametrize(
    "after, complaint",
    [
        ("before", r"moved by 0\.0"),
        ("before + torch.tensor([[1.0], [0.0]])", r"moved by 0\.0"),  # one policy of two
        ("before * float('nan')", "moved by nan"),
        ("1 / 0", "Zero"),
    ],
)
def test_a_training_that_does_nothing_or_breaks_is_noticed(after, complaint, tmp_path, monkeypatch):
    (tmp_path / "idle.py").write_text(
        f"import torch\ndef train(**_):\n    before = torch.ones(2, 3)\n    return before, {after}"
    )
    monkeypatch.setattr(check, "HERE", tmp_path)
    with pytest.raises(RuntimeError, match=complaint):
        check.try_out(sys.executable, "idle", tmp_path)


def test_unknown_examples_are_named(capsys):
    assert check.main(["sb4"]) == 2
    assert "no example 'sb4'; known: benchmarl_task, " in capsys.readouterr().err


@pytest.mark.parametrize("name", check.NAMES)
def test_example_is_one_short_file_with_pins_and_listed(name):
    text = (FOLDER / f"{name}.py").read_text()
    compile(text, name, "exec")
    assert len(text.splitlines()) <= 120
    assert f"examples/requirements/{name}.txt" in text and f"Run: python examples/{name}.py" in text
    pins = (FOLDER / "requirements" / f"{name}.txt").read_text().splitlines()
    assert pins and all(re.fullmatch(r"[\w\-\[\]]+==[\d.]+", pin) for pin in pins)
    assert f"[{name}.py]({name}.py)" in (FOLDER / "README.md").read_text()
    with (FOLDER / "checked.csv").open(newline="") as file:
        checked = {row["example"]: row["versions"] for row in csv.DictReader(file)}
    for pin in pins:
        package, version = pin.split("==")
        package = package.split("[")[0].replace("-", "_")
        assert re.search(rf"\b{package} {re.escape(version)}", checked[name]), pin


def test_every_requirements_file_belongs_to_an_example():
    assert sorted(path.stem for path in (FOLDER / "requirements").iterdir()) == check.NAMES
