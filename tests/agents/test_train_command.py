"""The training command: interrupts, help, and errors of one sentence."""

import errno
import io
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from conftest import SMALL, make_trainer

from multilift_marl.agents import trainer
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.logging import RunLog, read_metrics
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.cli.train import main as train
from multilift_marl.command import spell_command
from multilift_marl.config.load import build_config, load_config
from multilift_marl.errors import ConfigError
from multilift_marl.viewer.__main__ import make_session

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_interrupt_saves_and_resume_finishes(tmp_path):
    arguments = [f"{key}={value}" for key, value in SMALL.items() if key != "train.frames"]
    command = [sys.executable, str(ROOT / "train.py"), "config=hover", "train.frames=1e8", *arguments]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    deadline = time.time() + 120
    while time.time() < deadline and not list(tmp_path.glob("runs/*/checkpoints/last.pt")):
        time.sleep(0.2)
    process.send_signal(signal.SIGINT)
    output, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "python train.py resume=" in output
    folder = next(tmp_path.glob("runs/*"))
    done = load_checkpoint(folder / "checkpoints" / "last.pt")["iteration"]
    assert len(read_metrics(folder)) == done + 1  # the untrained policy's, too
    frames = (done + 2) * 8 * 16
    again = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), "resume=latest", f"train.frames={frames}"],
        cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert again.returncode == 0, again.stderr
    assert "python evaluate.py run=" in again.stdout
    assert len(read_metrics(folder)) == done + 3


@pytest.mark.parametrize(
    "command",
    [
        [str(ROOT / "train.py")],
        [str(ROOT / "evaluate.py")],
        *(["-m", f"multilift_marl.{name}"] for name in ("view", "ros", "px4", "sitl", "validation")),
        [
            "-c",
            "import sys; sys.argv = ['multilift-train']; from multilift_marl.cli.train import main; sys.exit(main())",
        ],
    ],
    ids=["train.py", "evaluate.py", "view", "ros", "px4", "sitl", "validation", "multilift-train"],
)
def test_interrupt_while_importing_is_one_line(tmp_path, command):
    process = subprocess.Popen(
        [sys.executable, "-X", "importtime", *command], cwd=tmp_path, stderr=subprocess.PIPE, text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),  # shells start jobs behind them deaf to it
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    while "numpy" not in process.stderr.readline():
        pass
    process.send_signal(signal.SIGINT)
    said = [line for line in process.communicate(timeout=60)[1].splitlines() if not line.startswith("import time:")]
    assert process.returncode == 130 and said == ["stopped"]


def test_help_may_be_cut_short():
    command = f"{sys.executable} {ROOT / 'train.py'} --help | head -1"
    done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=60)
    assert (done.stdout, done.stderr) == ("Train a team.\n", "")


def test_help_on_terminals_of_any_kind(monkeypatch, capsys):
    ascii_only = io.TextIOWrapper(io.BytesIO(), encoding="ascii")
    monkeypatch.setattr(sys, "stdout", ascii_only)
    assert train(["--help"]) == 0 and b"[kg m\\xb2]" in ascii_only.buffer.getvalue()
    monkeypatch.setattr(sys, "stdout", None)  # closed, as by >&-
    assert train(["--help"]) == 0
    monkeypatch.setattr(sys, "stdout", open("/dev/full", "w"))
    assert train(["--help"]) == 2
    assert capsys.readouterr().err.startswith("error: cannot read or write the output (No space left on device); ")


def test_a_folder_that_cannot_hold_runs_is_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "runs").touch()
    monkeypatch.chdir(tmp_path)
    assert train([f"{key}={value}" for key, value in SMALL.items()]) == 2
    assert capsys.readouterr().err == "error: cannot make a run in runs/ (Not a directory); train in another folder\n"


@pytest.mark.parametrize("place", ["runs", "taken/below/runs"])
def test_a_folder_that_cannot_hold_runs_is_noticed_before_anything_is_built(tmp_path, monkeypatch, place):
    (tmp_path / Path(place).parts[0]).touch()
    monkeypatch.setattr(trainer, "Trainer", None)
    with pytest.raises(ConfigError, match=r"cannot make a run in .* \(Not a directory\); train in another folder"):
        trainer.new_run(load_config("hover"), "hover", tmp_path / place)


@pytest.mark.slow
def test_a_full_disk_in_tensorboards_thread_is_no_traceback(tmp_path, monkeypatch, capsys):
    from tensorboard.summary.writer.record_writer import RecordWriter

    def full(*arguments):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    others = []
    monkeypatch.setattr(threading, "excepthook", others.append)
    trainer = make_trainer(tmp_path, **{"train.frames": 3 * 128, "eval.every": 1000})
    with monkeypatch.context() as patched:
        patched.setattr(RecordWriter, "write", full)
        assert trainer.run()
    said = capsys.readouterr().err
    assert "Traceback" not in said and not others
    assert len(read_metrics(trainer.folder)) == 4
    assert threading.excepthook == others.append


def test_a_table_of_metrics_survives_a_full_disk(tmp_path, monkeypatch):
    log = RunLog(tmp_path)
    log.write({"iteration": 1, "frames": 8}, {"a": 1.0})
    for column in ("a", "b"):  # a row is added, or the table written anew
        with monkeypatch.context() as full:
            full.setattr("builtins.open", raise_full)
            with pytest.raises(OSError, match="No space"):
                log.write({"iteration": 2, "frames": 16}, {column: 2.0})
        assert [row["iteration"] for row in read_metrics(tmp_path)][:1] == ["1"]
    log.write({"iteration": 4, "frames": 32}, {"a": 4.0})
    log.close()
    assert [row["iteration"] for row in read_metrics(tmp_path)] == ["1", "2", "2", "4"]


def raise_full(*arguments, **keywords):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_help_explains_every_key(capsys):
    assert train(["--help"]) == 0
    text = capsys.readouterr().out
    for key in ("train.frames", "payload.mass", "cable.stiffness", "randomization.payload_force", "resume"):
        assert key in text


@pytest.mark.parametrize(
    ("arguments", "starts", "end", "absent"),
    [
        (["config=hover"], "env.num_envs 160", "(default 128)", "Task track"),
        (["config=hover"], "train.overrides.<name> {'reward.precision': 1.0,", "name (default -)", "Task track"),
        (["config=hover"], "payload.drag_area 0.09", "smaller faces)", "reward.alignment"),
        (["config=pose", "wind.wash=true"], "wind.wash True", "(default False)", "Task hover"),
        (["config=pose", "reward.position=7"], "reward.position.weight 7", "its target", "Task hover"),
        (["config=track_circle"], "task_options.path ['circle']", "(default ['figure8'])", "Task hover"),
        (["train.warmup=0"], "train.warmup 0", "(default 12)", "Task pose"),
        ([], "env.num_envs 128", "stepped together", "(default 128)"),
    ],
)
def test_help_shows_the_values_of_what_is_asked_for(capsys, arguments, starts, end, absent):
    assert train([*arguments, "--help"]) == 0
    text = capsys.readouterr().out
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert [line for line in lines if line.startswith(starts) and line.endswith(end)], text
    assert absent not in text


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["config=hovr", "--help"], "no configuration named 'hovr'; did you mean 'hover'?"),
        (["config=hovr"], "no configuration named 'hovr'; did you mean 'hover'?"),
        (["train.frmes=10"], "unknown key 'train.frmes'; did you mean 'train.frames'?"),
        (["confg=hover"], "unknown key 'confg'; did you mean 'config'?"),
        (["rseume=latest"], "unknown key 'rseume'; did you mean 'resume'?"),
        (["reward.postion=1"], "did you mean 'reward.position'?"),
        (["train.minibatches=1e9"], "train.minibatches=1000000000 exceeds"),
        (["control.action=ctbr", "train.residual=formation_integral"], "cannot fly control.action=ctbr"),
        (["train.frames=ten"], "train.frames must be a whole number, but is 'ten'"),
        (["payload.mass=30"], "lower payload.mass"),
        (["frames"], "'frames' is not of the form key=value"),
        (["resume=nowhere"], "no run folder nowhere"),
        (["resume="], "resume= is empty; give a name behind it"),
        (["resume=3"], "no run folder 3: give the path"),
        (["resume=\0"], r"no run folder \x00: give the path"),
        (["resume=" + "x" * 300], "File name too long"),
        (["config=[1]"], "no configuration named '[1]'"),
        (["seed=1", "seed=2"], "seed is given twice"),
        (["train.horizon=1e5", "env.num_envs=1e4"], "takes"),
    ],
)
def test_command_line_errors_are_one_sentence(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert train(arguments) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.startswith("error: ") and shown.count("\n") == 1
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "called, command", [("train.py", "python train.py"), ("bin/multilift-train", "multilift-train")]
)
def test_a_finished_run_says_so_and_how_to_go_on(tmp_path, capsys, monkeypatch, called, command):
    trainer = make_trainer(tmp_path, **{"train.frames": 128})
    trainer.step()
    trainer.save("last")
    monkeypatch.setattr("sys.argv", [called])
    assert train([f"resume={trainer.folder}"]) == 0
    shown = capsys.readouterr().out
    assert f"{trainer.folder} is finished, with 128 steps" in shown
    assert f"{command} resume={trainer.folder} train.frames=256" in shown


def test_resume_refuses_what_cannot_change(tmp_path, capsys):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    assert train([f"resume={trainer.folder}", "env.num_drones=3"]) == 2
    assert "'env.num_drones' cannot change when a run is resumed" in capsys.readouterr().err


def test_impossible_system_makes_no_run_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError):
        _ = load_config("hover", {"payload.mass": 50}).system
    assert train(["payload.mass=50"]) == 2
    assert not (tmp_path / "runs").exists()


def test_a_script_of_another_interface_is_refused_before_anything_is_built(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    for module in ("agents.rollouts", "envs.torchrl_env", "view.session", "cli.evaluate"):
        name = f"multilift_marl.{module}.MultiliftVec"
        monkeypatch.setattr(name, lambda *arguments, **keywords: pytest.fail("built"), raising=False)
    assert train(["config=hover", "control.action=velocity"]) == 2
    said = "the baseline 'formation_feedback' acts by control.action=reference and cannot fly"
    cure = "take {}=hold_velocity, set control.action=reference, or "
    message = capsys.readouterr().err
    assert f"{said} control.action=velocity; {cure.format('train.residual')}take train.residual=formation," in message
    for arguments, words in (
        (["policy=formation_feedback"], f"{said} control.action=velocity; {cure.format('policy')}take another policy"),
        (
            ["policy=hold_velocity", "baseline=formation_feedback"],
            f"{cure.format('baseline')}leave it out by baseline=",
        ),
        (["run=hover"], "was trained with control.action=reference and cannot fly velocity; set control.action=ref"),
    ):
        assert evaluate([*arguments, "control.action=velocity"]) == 2
        assert words in capsys.readouterr().err
    with pytest.raises(ConfigError, match=r"cannot fly control\.action=velocity; take policy=hold_velocity"):
        make_session({"policy": "formation_feedback", "control.action": "velocity"})


@pytest.mark.skipif(sys.platform == "win32", reason="another shell")
def test_printed_commands_are_quoted_for_the_shell(monkeypatch):
    arguments = ["resume=/home/me/my runs/it's; rm -rf", "train.frames=2"]
    monkeypatch.setattr(sys, "argv", ["train.py"])
    for installed, words in (("train.py", ["python", "train.py"]), ("/usr/bin/multilift-train", ["multilift-train"])):
        monkeypatch.setattr(sys, "argv", [installed])
        text = spell_command("train", *arguments)
        done = subprocess.run(["sh", "-c", f"printf '%s\\n' {text}"], capture_output=True, text=True)
        assert done.stdout.splitlines() == [*words, *arguments]


def test_what_is_typed_goes_before_what_a_recipe_overrides_in_training(monkeypatch, capsys, tmp_path):
    monkeypatch.chdir(tmp_path)
    made = []
    monkeypatch.setattr("multilift_marl.agents.trainer.new_run", lambda config, name: made.append(config) or 1 / 0)
    for more, length in (([], 0.3), (["train.overrides={randomization.cable_length: 0.2}"], 0.2)):
        with pytest.raises(ZeroDivisionError):
            train(["config=hover", "randomization.cable_length=0.3", *more])
        environment = build_config(made[-1].model_dump(), made[-1].train.overrides)
        assert environment.randomization.cable_length == length
        assert environment.reward["precision"].weight == 1.0 and made[-1].randomization.cable_length == 0.3
    assert capsys.readouterr().out == ""
