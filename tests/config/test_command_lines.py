"""Command lines that nobody meant: whatever stands there, the answer is one sentence or the flight that was asked for.

`COMMAND_LINES=2000 pytest tests/config/test_command_lines.py` tries more of them than the suite does.
"""

from __future__ import annotations

import os
import random
from pathlib import Path

import pytest

from multilift_marl import command
from multilift_marl.agents import export as exporting
from multilift_marl.agents import trainer
from multilift_marl.cli import benchmark, evaluate, export, train
from multilift_marl.config.config import Config
from multilift_marl.deploy.px4 import __main__ as px4
from multilift_marl.errors import ConfigError
from multilift_marl.viewer import __main__ as view

COUNT = int(os.environ.get("COMMAND_LINES", "100"))
ACCEPTED = "accepted"
COMMANDS = {
    "train": (train.main, ["config", "task", "import", "resume"], "config=hover"),
    "evaluate": (evaluate.main, [*evaluate.Options.model_fields, "task", "import"], "policy=formation"),
    "export": (export.main, ["run", "out", "import"], "run=hover"),
    "view": (view.main, [*view.Options.model_fields, "import"], "task=hover"),
}
VALUES = [
    "", "0", "1", "-1", "1e400", "-1e-400", "nan", "inf", ".inf", "null", "~", "true", "yes", "0x", "1_0", "007",
    "1:30", "[]", "[1", "[1,2,3]", "[nan,1,2]", "{}", "{a: 1}", "{", "'", '"', "&a", "*a", "!!python/object:os.system",
    "\0", "\x1b[2J", "é", "\ud800", "x" * 3000, "9" * 400, "../..", "/", "/dev/null", ".", "hover", "hover.yaml",
    "pose_easy", "formation", "formation_led", "module:Class", "os:getcwd", ":", "a.py:B", "policy.onnx", "weights.pt",
    "latest", "best", "top", "none", "crazyflie", "point", "chain", "<<", "%s", "{}%n", "a b", "=", "==1", "- 1",
]  # fmt: skip
WHOLE = [
    "", "=", "==", "=1", "x", "-", "--", "--help=1", "--config=hover", "config hover", "\0", "é=1", "env", "env.=1",
    ".num_envs=1", "env..num_envs=1", "env.num_envs.x=1", "__class__=1", "task_options.=1", "reward.x=y",
]  # fmt: skip


def keys_of(model, prefix=""):
    for name, field in model.model_fields.items():
        kind = field.annotation
        yield from keys_of(kind, f"{prefix}{name}.") if hasattr(kind, "model_fields") else (f"{prefix}{name}",)


KEYS = [*keys_of(Config), "task_options.target_xy", "task_options.speed", "reward.position", "train.overrides.wind"]


def random_line(rng, own):
    """Return arguments, most of them of known keys with values that are not theirs."""
    line = []
    for _ in range(rng.choice([1, 1, 2, 3])):
        if rng.random() < 0.15:
            line.append(rng.choice(WHOLE))
            continue
        key = rng.choice(own if rng.random() < 0.25 else KEYS)
        if rng.random() < 0.1:  # misspelt
            at = rng.randrange(len(key))
            key = key[:at] + rng.choice(["", "x", ".", "A"]) + key[at + 1 :]
        line.append(f"{key}={rng.choice(VALUES)}")
    return line


@pytest.fixture
def nothing_flies(monkeypatch, tmp_path, registries):
    """Stop each command where its flight, training or page would begin."""

    def refuse(*arguments, **keywords):
        raise ConfigError(ACCEPTED)

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(trainer, "new_run", refuse)
    monkeypatch.setattr(evaluate, "run_episodes", refuse)
    monkeypatch.setattr(view, "Page", refuse)
    monkeypatch.setattr(exporting, "export_policy", refuse)


# those of the viewer make many environments, most of which must be compiled
@pytest.mark.parametrize("name", [pytest.param(name, marks=[pytest.mark.slow] * (name == "view")) for name in COMMANDS])
def test_any_command_line_is_answered_in_one_sentence(name, nothing_flies, capsys):
    main, own, sane = COMMANDS[name]
    rng, accepted = random.Random(name), []
    for line in ([sane], *(random_line(rng, own) for _ in range(COUNT))):
        status = main(line)
        told = capsys.readouterr().err.strip().splitlines()
        assert status == 2 and told, line
        assert told[-1].startswith("error: ") and len(told[-1]) < 2100, (line, told)
        assert not any("Traceback" in each for each in told), line
        assert sum(each.startswith("error: ") for each in told) == 1, (line, told)
        accepted += [line] if ACCEPTED in told[-1] else []
    assert accepted[0] == [sane]


@pytest.mark.parametrize(
    ("main", "line", "key", "need"),
    [
        (evaluate.main, ["policy=formation", "camera=top"], "camera", "video=true"),
        (evaluate.main, ["policy=formation", "trail=1"], "trail", "video=true"),
        (evaluate.main, ["policy=formation", "names=report"], "names", "bag=<folder>"),
        (evaluate.main, ["policy=formation", "ros=humble"], "ros", "bag=<folder>"),
        (evaluate.main, ["policy=formation", "ray=auto"], "ray", "workers=<number>"),
        (benchmark.main, ["policy=formation", "ray=auto"], "ray", "workers=<number>"),
        (px4.main, ["domain=7"], "domain", "live=true"),
        (px4.main, ["sync=false"], "sync", "live=true"),
        (px4.main, ["allow_network=true"], "allow_network", "live=true"),
        (px4.main, ["live=true", "patience=0.2"], "patience", "policy=none"),
        (px4.main, ["names=report"], "names", "live=true or bag=<folder>"),
        (view.main, ["domain=7"], "domain", "live=true"),
        (view.main, ["names=report"], "names", "live=true"),
        (view.main, ["ros=humble"], "ros", "live=true"),
        (view.main, ["allow_network=true"], "allow_network", "live=true"),
    ],
)
def test_keys_that_mean_nothing_are_refused(main, line, key, need, nothing_flies, capsys):
    assert main(line) == 2
    words = f"error: {key} means nothing without {need}; leave {key} out, or add that\n"
    assert capsys.readouterr().err.endswith(words)


def test_processes_of_one_second_have_folders_of_their_own(monkeypatch, tmp_path):
    monkeypatch.setattr(command.time, "strftime", lambda form: "20261201-120000")
    found = [command.make_out(None, tmp_path / "eval", "hover-") for _ in range(3)]
    assert [folder.name for folder in found] == [f"hover-20261201-120000{end}" for end in ("", "-2", "-3")]
    assert all(folder.is_dir() for folder in found)
    assert command.make_out(str(tmp_path / "own"), tmp_path) == command.make_out(str(tmp_path / "own"), tmp_path)


@pytest.mark.parametrize(
    "file", ["cli/evaluate.py", "cli/benchmark.py", "deploy/px4/__main__.py", "deploy/sitl/pipeline.py"]
)
def test_commands_name_no_folder_by_the_time_themselves(file):
    text = (Path(command.__file__).parent / file).read_text()
    assert "make_out(" in text and "strftime" not in text
