"""Signals to a training: lossless, in bounded time, whatever its main thread is doing; a second one ends it at once."""

import multiprocessing
import os
import signal
import subprocess
import sys
import tempfile
import time

import pytest
import torch
from conftest import make_trainer, slow

from multilift_marl._interrupt import Watch
from multilift_marl.agents import stopping
from multilift_marl.agents import trainer as trainers
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.stopping import Abandoned, Stopper
from multilift_marl.agents.trainer import resume_run
from multilift_marl.cli import evaluate
from multilift_marl.errors import CheckpointError

BUSY = """
import hashlib, sys
from pathlib import Path
from multilift_marl._interrupt import ending_at_once, last_acts
from multilift_marl.agents import stopping

def work():
    print("busy", flush=True)
    hashlib.pbkdf2_hmac("sha256", b"a", b"b", 2**31 - 1)  # an hour without a Python instruction

kind, stopping.PATIENCE = sys.argv[1], float(sys.argv[2])
stopping.LAST_PATIENCE = 0.3

def rescue():
    Path("saved").touch()
    if kind == "full":
        raise ValueError("no checkpoint")

def fail():
    raise ValueError("no cluster")

last_acts.update([lambda: Path("left").touch(), fail])
stopper = stopping.Stopper(rescue, lambda text: print(text, flush=True))
stopper.ends, stopper.worth = True, kind in ("training", "full")
with ending_at_once() if kind == "building" else stopper:
    work()
"""


def interrupt_busy(folder, kind, patience, signals):
    """Return exit status and output of a process whose main thread does not come back, and whether it was saved."""
    process = subprocess.Popen(
        [sys.executable, "-c", BUSY, kind, str(patience)], cwd=folder, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert process.stdout.readline() == "busy\n"
    said, (first, *rest) = "", signals
    process.send_signal(first)
    for number in rest:
        said += process.stdout.readline()  # it has heard of the one before
        process.send_signal(number)
    output, errors = process.communicate(timeout=120)
    assert (folder / "left").exists()
    return process.returncode, said + output, errors, (folder / "saved").exists()


def test_a_training_in_a_call_that_does_not_come_back_is_saved_and_ended(tmp_path):
    status, output, errors, saved = interrupt_busy(tmp_path, "training", 0.3, [signal.SIGTERM])
    assert status == 143 and saved and errors == "" and output.startswith("stopping after this iteration")


@pytest.mark.slow
def test_a_rescue_that_fails_does_not_keep_it_alive(tmp_path):
    status, _, _, saved = interrupt_busy(tmp_path, "full", 0.3, [signal.SIGTERM])
    assert status == 143 and saved


def test_a_second_signal_ends_it_at_once(tmp_path):
    status, _, errors, saved = interrupt_busy(tmp_path, "training", 600, [signal.SIGINT, signal.SIGINT])
    assert status == 130 and not saved and errors == "stopped\n"


@pytest.mark.parametrize("kind", ["building", "beginning"])
def test_before_there_is_anything_to_lose_one_signal_ends_it(tmp_path, kind):
    status, _, errors, _ = interrupt_busy(tmp_path, kind, 600, [signal.SIGINT])
    assert status == 130 and errors == "stopped\n"


@pytest.mark.slow
def test_an_iteration_that_takes_too_long_is_given_up_and_done_again(tmp_path, monkeypatch):
    monkeypatch.setattr(stopping, "PATIENCE", 0.2)
    monkeypatch.setattr(stopping, "LAST_PATIENCE", 600.0)
    settings = {"train.frames": 3 * 128, "eval.every": 1000, "train.checkpoint_every": 1000}
    whole = make_trainer(tmp_path / "whole", **settings)
    assert whole.run()
    trainer = make_trainer(tmp_path / "part", **settings)
    collect, before = trainer.rollouts.collect, signal.getsignal(signal.SIGTERM)

    def collect_for_ever(iteration):
        batches = collect(iteration)
        if iteration == 2:
            os.kill(os.getpid(), signal.SIGTERM)
            time.sleep(600)
        return batches

    monkeypatch.setattr(trainer.rollouts, "collect", collect_for_ever)
    assert not trainer.run() and trainer.status == 143
    assert signal.getsignal(signal.SIGTERM) == before
    assert load_checkpoint(trainer.folder / "checkpoints" / "last.pt")["iteration"] == 2
    resumed = resume_run(trainer.folder, {})
    assert resumed.run()
    for name, value in whole.learner.actor.state_dict().items():
        assert torch.equal(value, resumed.learner.actor.state_dict()[name]), name


def test_a_checkpoint_is_written_to_its_end(monkeypatch):
    monkeypatch.setattr(stopping, "PATIENCE", 0.1)
    monkeypatch.setattr(stopping, "LAST_PATIENCE", 600.0)
    said = []
    with Stopper(lambda: None, said.append) as stopper:
        with stopper.writing():
            os.kill(os.getpid(), signal.SIGTERM)
            wait_for(lambda: stopper._timers)
            stopper._timers[0].join(60)  # until it has nudged
        assert stopper.asked and stopper.status == 143 and len(said) == 1
    with pytest.raises(Abandoned), Stopper(lambda: None, said.append) as stopper:
        stopper.worth = True
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(60)


def wait_for(condition):
    """Wait until `condition` holds, within a minute."""
    deadline = time.monotonic() + 60
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_once_no_iteration_runs_the_main_thread_is_left_alone(monkeypatch):
    monkeypatch.setattr(stopping, "PATIENCE", 0.1)
    nudges = []
    with Stopper(lambda: None, lambda text: None) as stopper:
        stopper.worth = True
        os.kill(os.getpid(), signal.SIGTERM)
        wait_for(lambda: stopper._timers)
        stopper.end()
        monkeypatch.setattr(signal, "pthread_kill", lambda *arguments: nudges.append(arguments))
        stopper._timers[0].join(60)
    assert stopper.asked and nudges == []


def test_a_program_that_trains_gets_an_exception_from_a_second_signal():
    with pytest.raises(KeyboardInterrupt), Stopper(lambda: None, lambda text: None) as stopper:
        os.kill(os.getpid(), signal.SIGINT)  # nothing to save yet
        time.sleep(60)
    with Stopper(lambda: None, lambda text: None) as stopper:
        stopper.worth = True
        os.kill(os.getpid(), signal.SIGINT)
        wait_for(lambda: stopper._timers)
        with pytest.raises(KeyboardInterrupt) as caught:
            os.kill(os.getpid(), signal.SIGINT)
            time.sleep(60)
        assert caught.type is KeyboardInterrupt and len(stopper._timers) == 1  # a nudge, nothing that ends the process


@pytest.mark.slow
def test_the_first_signal_to_a_resumed_training_loses_nothing(tmp_path, monkeypatch):
    settings = {"train.frames": 100 * 128, "eval.every": 1000, "train.checkpoint_every": 1000}
    trainer = make_trainer(tmp_path, **settings)
    signal_in_iteration(trainer, 2, monkeypatch)
    assert not trainer.run()
    resumed = resume_run(trainer.folder, {})
    done = resumed.iteration
    signal_in_iteration(resumed, done + 2, monkeypatch)
    assert not resumed.run()
    assert load_checkpoint(trainer.folder / "checkpoints" / "last.pt")["iteration"] == done + 2


def signal_in_iteration(trainer, iteration, monkeypatch):
    """Have SIGTERM come at the end of this iteration, and be heard."""
    step = trainer.step

    def stop():
        values = step()
        if trainer.iteration == iteration:
            os.kill(os.getpid(), signal.SIGTERM)
            wait_for(lambda: trainer._stopper.asked)
        return values

    monkeypatch.setattr(stopping, "PATIENCE", 600.0)
    monkeypatch.setattr(trainer, "step", stop)


@pytest.mark.slow
def test_an_iteration_given_up_on_a_full_disk_is_saved_elsewhere(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path, **{"train.frames": 100 * 128, "eval.every": 1000})
    spares, save = tmp_path / "spares", trainers.save_checkpoint
    spares.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(spares))

    def save_elsewhere(path, content):
        if trainer.folder in path.parents:
            raise CheckpointError(f"cannot write {path}")
        save(path, content)

    step = trainer.step

    def give_up():
        if trainer.iteration == 2:
            raise Abandoned
        monkeypatch.setattr(trainers, "save_checkpoint", save_elsewhere)
        return step()

    monkeypatch.setattr(trainer, "step", give_up)
    with pytest.raises(CheckpointError, match=r"the run is saved as .*-last\.pt; make room"):
        trainer.run()
    assert load_checkpoint(spares / f"{trainer.folder.name}-last.pt")["iteration"] == 2


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_a_forked_child_is_not_the_parents(number):
    heard, context = [], multiprocessing.get_context("fork")
    with Watch(heard.append):
        child = context.Process(target=time.sleep, args=(60,))
        child.start()
        os.kill(child.pid, number)
        child.join(60)
        assert child.exitcode == -number
        os.kill(os.getpid(), signal.SIGINT)
        wait_for(lambda: heard)
    assert heard == [signal.SIGINT]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_evaluation_that_is_stopped_completes_its_bag(tmp_path, monkeypatch, capsys, number):
    pytest.importorskip("rosbags")
    from multilift_marl.deploy.ros.bag import BagWriter

    write = BagWriter.write

    def stop(self, moment):
        write(self, moment)
        if moment > 0:
            os.kill(os.getpid(), number)
            time.sleep(60)

    monkeypatch.setattr(BagWriter, "write", stop)
    arguments = ["policy=formation", "config=hover", "episodes=1", "baseline=none", "env.episode_seconds=0.5"]
    monkeypatch.setattr(sys, "argv", ["evaluate.py", *arguments, f"out={tmp_path / 'o'}", f"bag={tmp_path / 'bag'}"])
    assert evaluate.main() == 130 and capsys.readouterr().err.endswith("stopped\n")
    assert (tmp_path / "bag_partial" / "metadata.yaml").is_file() and not (tmp_path / "bag").exists()


ALONE = """
import sys, time
from multilift_marl.cli import train

seconds = float(sys.argv.pop())

def stopped(values, alone):
    assert alone
    print("stopped training", flush=True)
    time.sleep(seconds)  # as Ray ends, say, or the last words are printed
    return 143

train._train = stopped
sys.exit(train.main())
"""


@pytest.mark.parametrize(("seconds", "number"), [(600, signal.SIGTERM), slow(600, signal.SIGHUP), (0, None)])
def test_after_a_training_a_further_signal_still_ends_with_the_documented_status(tmp_path, seconds, number):
    command = [sys.executable, "-c", ALONE, str(seconds)]
    process = subprocess.Popen(command, cwd=tmp_path, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    assert process.stdout.readline() == "stopped training\n"
    if number is not None:
        process.send_signal(number)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == (143 if number is None else 128 + number)
    assert errors == ("" if number is None else "stopped\n")


def test_handlers_that_the_core_of_ray_takes_away_are_put_back(monkeypatch):
    """Ray's core does so in C, so that Python still names its own handler."""
    import ray

    from multilift_marl import _ray

    put_back = {}
    with Watch(lambda number: None):
        monkeypatch.setattr(ray, "shutdown", lambda: None)
        monkeypatch.setattr(signal, "signal", lambda number, handler: put_back.update({number: handler}))
        _ray.disconnect()
        assert put_back.keys() >= {signal.SIGINT, signal.SIGTERM}
        assert all(put_back[number] is signal.getsignal(number) for number in put_back)
        monkeypatch.undo()
