"""Checkpoints and policy files: they survive kills, act like what was saved, and bad ones are named."""

import copy
import errno
import os
import random
import signal
import subprocess
import threading
import time
from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_trainer, refusal, same

from multilift_marl._platform import STOPPING, lock_file
from multilift_marl.agents import checkpoint, policy, stopping
from multilift_marl.agents.checkpoint import find_run, load_checkpoint, save_checkpoint
from multilift_marl.agents.policy import find_checkpoint, load_policy, strip_checkpoint
from multilift_marl.agents.trainer import resume_run
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.cli.train import main as train
from multilift_marl.config.load import build_config
from multilift_marl.errors import CheckpointError

SHIPPED = Path(policy.__file__).parents[1] / "policies"


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="kills a fork")
def test_killed_while_saving_it_can_always_be_resumed(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.step()
    trainer.save("last")
    rng = random.Random(0)
    for _ in range(8):
        child = os.fork()
        if child == 0:  # save without end until killed
            while True:
                trainer.iteration = 1 + trainer.iteration % 9
                trainer.save("last")
        time.sleep(rng.uniform(0.0, 0.15))
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
        resumed = resume_run(trainer.folder, {})
        assert 1 <= resumed.iteration <= 9
    assert np.isfinite(resumed.step()["loss_critic"])


@pytest.mark.slow
def test_configuration_of_a_checkpoint_is_complete(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    content = load_checkpoint(trainer.folder / "checkpoints" / "last.pt")
    assert build_config(content["config"]) == trainer.config


def test_policy_file_acts_like_the_trained_network(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.step()
    trainer.save("last")
    file = trainer.folder / "checkpoints" / "last.pt"
    strip_checkpoint(file, tmp_path / "policy.pt")
    observation = np.random.default_rng(0).normal(size=(5, 4, trainer.env.vec.observation_size)).astype(np.float32)
    with torch.no_grad():
        expected = trainer.learner.actor(torch.from_numpy(observation))[0].clamp(-1, 1).numpy()
    for source in (trainer.folder, file, tmp_path / "policy.pt"):
        np.testing.assert_array_equal(load_policy(source).act(observation), expected)
    assert load_policy(file).act(observation[0]).shape == (4, 4)
    assert (tmp_path / "policy.pt").stat().st_size < file.stat().st_size / 2


def test_loading_a_policy_costs_no_random_numbers(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    torch.manual_seed(0)
    before = torch.get_rng_state()
    load_policy(trainer.folder)
    assert torch.equal(before, torch.get_rng_state())


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda path: path.unlink(), r"no checkpoint .*last\.pt: give a run folder"),
        (
            lambda path: path.write_bytes(path.read_bytes()[:2000]),
            r"last\.pt is truncated or no checkpoint at all; use",
        ),
        (lambda path: path.write_bytes(b"something else"), r"is truncated or no checkpoint at all; use another"),
        (lambda path: torch.save({"weights": torch.zeros(3)}, path), r"was not written by multilift_marl"),
        (lambda path: torch.save({"code": subprocess.run}, path), r"holds more than tensors and numbers; use another"),
    ],
)
def test_bad_checkpoints_are_named(tmp_path, damage, message):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    damage(trainer.folder / "checkpoints" / "last.pt")
    with pytest.raises(CheckpointError, match=message):
        resume_run(trainer.folder, {})


def test_checkpoint_without_policy_is_named(tmp_path):
    save_checkpoint(tmp_path / "x.pt", {"iteration": 1})
    with pytest.raises(CheckpointError, match="holds no policy"):
        load_policy(tmp_path / "x.pt")


@pytest.mark.parametrize("damage", [lambda path: path.write_bytes(b"torn"), lambda path: path.unlink()])
def test_a_best_policy_that_cannot_be_read_is_written_again(tmp_path, damage, capsys):
    trainer = make_trainer(tmp_path, **{"train.frames": 256, "eval.every": 100})
    trainer.step()
    trainer.evaluate()
    trainer.save("last")
    best = trainer.folder / "checkpoints" / "best.pt"
    damage(best)
    assert resume_run(trainer.folder, {}).run()
    assert load_checkpoint(best)["iteration"] in (1, 2) and "warning" not in capsys.readouterr().out


@pytest.mark.parametrize("name", ["latest", "runs/none"])
def test_missing_run_is_named(tmp_path, name):
    with pytest.raises(CheckpointError, match="no run"):
        find_run(name, tmp_path)


@pytest.mark.parametrize("name", ["hover", "x.onnx", "best.pt", "other"])
@pytest.mark.parametrize("checkpoint", ["last", "some.pt"])
def test_a_checkpoint_beside_what_is_no_run_is_refused(tmp_path, monkeypatch, name, checkpoint):
    trainer = make_trainer(tmp_path)
    monkeypatch.chdir(tmp_path)
    for each in ("best", "last", "other"):
        trainer.save(each, tmp_path / f"{each}.pt")
    (tmp_path / "other.pt").rename("other")
    said = refusal(load_policy, name, checkpoint)
    assert f"checkpoint={checkpoint} means nothing to " in said and f"'{name}'; leave it out" in said
    assert load_policy("best.pt").frames == 0


def test_no_other_checkpoint_of_a_file_is_spoken_of(tmp_path, capsys):
    trainer = make_trainer(tmp_path)
    trainer.save("best")
    short = ["episodes=1", "env.episode_seconds=0.1", "baseline=none"]
    for run, spoken in ((trainer.folder, True), (trainer.folder / "checkpoints" / "best.pt", False)):
        assert evaluate([f"run={run}", f"out={tmp_path / 'flown'}", *short]) == 0
        assert ("checkpoint=last" in capsys.readouterr().out) == spoken


def test_observations_of_another_environment_are_refused(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    with pytest.raises(ValueError, match=r"observation has 7 numbers, the policy of .* was trained with"):
        load_policy(trainer.folder).act(np.zeros((1, 4, 7), np.float32))


# Damage


@pytest.fixture(scope="module")
def shipped(tmp_path_factory):
    """A policy file, small and whole."""
    strip_checkpoint(SHIPPED / "hover.pt", path := tmp_path_factory.mktemp("policy") / "hover.pt")
    return path


def test_a_flipped_bit_is_found_or_changes_nothing(shipped, tmp_path):
    whole, data, rng, refused = load_checkpoint(shipped), shipped.read_bytes(), random.Random(0), 0
    for i in range(60):
        place = rng.randrange(len(data) - 8000 * (i % 2), len(data)) if i % 2 else rng.randrange(len(data))
        damaged = bytearray(data)
        damaged[place] ^= 1 << rng.randrange(8)
        (tmp_path / "x.pt").write_bytes(damaged)
        try:
            assert same(load_checkpoint(tmp_path / "x.pt"), whole)
        except CheckpointError as error:
            assert "use another checkpoint" in str(error) or "not written by" in str(error)
            refused += 1
    assert refused > 40


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("config", 3), ("actor", []), ("actor", {}), ("observation_names", "abc"), ("observation_names", [1]),
        ("frames", None), ("frames", True), ("actor.log_std", torch.full((4,), torch.nan)), ("actor.log_std", 3),
        ("actor.log_std", torch.zeros(4, dtype=torch.float64)), ("actor.log_std", torch.zeros(5)),
        ("actor.more", torch.zeros(4)),
    ],
)  # fmt: skip
def test_a_policy_with_a_part_of_another_kind_is_refused(shipped, tmp_path, key, value):
    content = load_checkpoint(shipped)
    part, _, name = key.partition(".")
    content |= {part: {**content[part], name: value} if name else value}
    save_checkpoint(tmp_path / "x.pt", content)
    with pytest.raises(CheckpointError, match=f"'{key}"[:6]) as caught:
        load_policy(tmp_path / "x.pt")
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_a_run_with_a_part_of_another_kind_is_not_resumed(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.step()
    trainer.save("last")
    file = trainer.folder / "checkpoints" / "last.pt"
    whole = load_checkpoint(file)
    moment = ("optimizer", "state", 0, "exp_avg")
    for path, value in (
        (("iteration",), "3"), (("iteration",), -1), (("best_policy",), [0.5]),
        (("seconds",), float("nan")), (("rng",), None),
        (("rng",), torch.zeros_like(whole["rng"])), (("returns",), torch.zeros(7)), (("critic",), []), (("env",), 3),
        (("env", "steps"), [1]), (("env", "more"), torch.zeros(8)), (("optimizer",), {}), (moment, 3),
        (moment, torch.full((64, 52), torch.nan)), (("optimizer", "param_groups", 0, "lr"), "fast"),
    ):  # fmt: skip
        content = copy.deepcopy(whole)
        node = content
        for key in path[:-1]:
            node = node[key]
        node[path[-1]] = value
        save_checkpoint(file, content)
        with pytest.raises(CheckpointError) as caught:
            resume_run(trainer.folder, {})
        assert "\n" not in str(caught.value)
    del whole["env"]["world.system"], whole["env"]["task_name"]  # as in the first checkpoints
    save_checkpoint(file, whole)
    assert resume_run(trainer.folder, {}).iteration == 1


# Several writers, signals and full disks


def test_two_savers_of_one_file_lose_nothing(tmp_path):
    failed = []

    def save(number):
        try:
            for _ in range(30):
                save_checkpoint(tmp_path / "last.pt", {"number": number})
                load_checkpoint(tmp_path / "last.pt")
        except Exception as error:
            failed.append(error)

    savers = [threading.Thread(target=save, args=(number,)) for number in range(3)]
    for saver in savers:
        saver.start()
    for saver in savers:
        saver.join()
    assert not failed and [path.name for path in tmp_path.iterdir()] == ["last.pt"]


def test_a_run_that_another_process_trains_is_not_resumed(tmp_path, capsys):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    for leftover in ("checkpoints/last-1-2.tmp", "metrics-1-2.tmp"):  # of a process that was killed
        (trainer.folder / leftover).touch()
    before = (trainer.folder / "config.yaml").stat().st_mtime_ns
    with open(trainer.folder / "lock", "w+") as lock:
        lock_file(lock.fileno())
        assert train([f"resume={trainer.folder}", "train.frames=1e6"]) == 2
        with pytest.raises(CheckpointError, match="trained by another process"):
            trainer.run()
    assert capsys.readouterr().err.count("is being trained by another process") == 1
    assert (trainer.folder / "config.yaml").stat().st_mtime_ns == before
    trainer.iteration = trainer.iterations
    assert trainer.run() and not list(trainer.folder.rglob("*.tmp"))
    with open(trainer.folder / "lock", "r+") as lock:
        lock_file(lock.fileno())  # free again


def test_latest_is_the_newest_by_name_whatever_the_clocks_of_files_say(tmp_path):
    names = ("zebra-20260101-120000-s0", "hover-20260101-120001-s0", "hover-20260101-120001-s0-10", "mine")
    for age, name in enumerate(names):
        (tmp_path / name / "checkpoints").mkdir(parents=True)
        (tmp_path / name / "checkpoints" / "last.pt").touch()
        os.utime(tmp_path / name / "checkpoints" / "last.pt", (1e9 - 100 * age,) * 2)
    (tmp_path / "hover-20270101-120001-s0").mkdir()  # without a checkpoint
    (tmp_path / "hover-20260101-120001-s0-2" / "checkpoints").mkdir(parents=True)
    (tmp_path / "hover-20260101-120001-s0-2" / "checkpoints" / "last.pt").touch()
    assert find_run("latest", tmp_path).name == names[2]


@pytest.mark.parametrize("name", ["", "\0", "x" * 5000])
def test_names_that_no_run_has_are_refused(tmp_path, name):
    with pytest.raises(CheckpointError, match="run"):
        find_run(name, tmp_path)


@pytest.mark.parametrize("number", STOPPING)
def test_signals_save_and_stop(tmp_path, monkeypatch, number):
    trainer = make_trainer(tmp_path, **{"eval.every": 1000})
    step, before = trainer.step, signal.getsignal(number)
    monkeypatch.setattr(stopping, "PATIENCE", 600.0)

    def interrupted():
        os.kill(os.getpid(), number)
        return step()

    monkeypatch.setattr(trainer, "step", interrupted)
    assert not trainer.run() and trainer.status == 128 + number
    assert load_checkpoint(trainer.folder / "checkpoints" / "last.pt")["iteration"] == 1
    assert signal.getsignal(number) == before


@pytest.mark.slow
@pytest.mark.parametrize("lasts", [False, True])
def test_a_full_disk_costs_nothing(tmp_path, monkeypatch, capsys, lasts):
    frames = 128 * (1 if lasts else 3)
    trainer = make_trainer(tmp_path, **{"train.checkpoint_every": 1, "train.frames": frames, "eval.episodes": 1})
    trainer.save("last")
    step, replace = trainer.step, os.replace

    def full(source, target):
        if lasts or trainer.iteration < 2:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        replace(source, target)

    def stepped():
        values = step()
        last = load_checkpoint(trainer.folder / "checkpoints" / "last.pt")  # whole all the time
        assert last["iteration"] == (2 if trainer.iteration == 3 and not lasts else 0)
        return values

    monkeypatch.setattr(trainer, "step", stepped)
    monkeypatch.setattr(checkpoint.os, "replace", full)
    if lasts:
        with pytest.raises(CheckpointError, match=r"cannot write .*\(No space left on device\); make room"):
            trainer.run()
    else:
        assert trainer.run()
        assert load_checkpoint(trainer.folder / "checkpoints" / "last.pt")["iteration"] == 3
    assert capsys.readouterr().out.count("No space left on device") == 1
    assert not list(trainer.folder.glob("checkpoints/*.tmp"))


def test_a_folder_that_is_no_run_hides_neither_a_shipped_policy_nor_a_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for folder in ("hover", "mine", "runs/mine/checkpoints"):
        (tmp_path / folder).mkdir(parents=True)
    assert find_checkpoint("hover")[0].name == "hover.pt" and find_checkpoint("hover")[0].is_file()
    assert find_run("mine") == Path("runs/mine")
    (tmp_path / "hover" / "checkpoints").mkdir()
    assert find_checkpoint("hover")[1] == Path("hover")  # a run does
