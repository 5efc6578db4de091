"""Training: it learns, resumes bit for bit, survives kills, and says clearly what is wrong."""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from multilift_marl.agents.checkpoint import find_run, load_checkpoint, save_checkpoint
from multilift_marl.agents.logging import RunLog, read_metrics
from multilift_marl.agents.networks import Normalizer
from multilift_marl.agents.policy import load_policy, strip_checkpoint
from multilift_marl.agents.trainer import Trainer, new_run, resume_run
from multilift_marl.cli.train import main as train
from multilift_marl.config import build_config, load_config
from multilift_marl.errors import CheckpointError, ConfigError

ROOT = Path(__file__).parents[1]
SMALL = {
    "env.num_envs": 8, "env.num_threads": 1, "env.episode_seconds": 0.5, "train.horizon": 16, "train.frames": 1280,
    "train.minibatches": 4, "train.checkpoint_every": 5, "eval.every": 4, "eval.episodes": 3,
}  # fmt: skip


def make_trainer(tmp_path, **overrides):
    config = load_config("hover", SMALL | overrides)
    return Trainer(config, new_run(config, "test", tmp_path))


@pytest.mark.parametrize("algorithm", ["mappo", "ippo"])
def test_ten_iterations_equal_five_a_stop_and_five_more(tmp_path, algorithm):
    whole = make_trainer(tmp_path, **{"train.algorithm": algorithm})
    assert whole.run()
    half = make_trainer(tmp_path, **{"train.algorithm": algorithm})
    step = half.step

    def stop_after_five():
        values = step()
        half._stop = half.iteration == 5  # as Ctrl-C does
        return values

    half.step = stop_after_five
    assert not half.run()
    torch.manual_seed(12345)
    resumed = resume_run(half.folder, {"env.num_threads": 2})
    assert (resumed.iteration, resumed.iterations) == (5, 10)
    assert resumed.run()
    for (name, one), two in zip(
        whole.learner.loss.state_dict().items(), resumed.learner.loss.state_dict().values(), strict=True
    ):
        assert torch.equal(one, two), name
    columns = ("frames", "return", "reward/total", "approx_kl", "eval/return")
    rows, again = read_metrics(whole.folder), read_metrics(half.folder)
    assert [[row[c] for c in columns] for row in rows] == [[row[c] for c in columns] for row in again]


def test_same_seed_same_weights_other_seed_others(tmp_path):
    one, two, other = (make_trainer(tmp_path, seed=seed) for seed in (1, 1, 2))
    weights = []
    for trainer in (one, two, other):
        torch.manual_seed(trainer.config.seed)
        trainer.step()
        weights.append(trainer.learner.actor.net[0].weight.detach().clone())
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


def test_a_few_iterations_improve_the_return(tmp_path):
    trainer = make_trainer(
        tmp_path,
        **{
            "env.num_envs": 64, "env.num_threads": 0, "env.episode_seconds": 4.0, "train.horizon": 32,
            "train.frames": 64 * 32 * 40, "eval.episodes": 64, "train.residual": "formation",
        },
    )  # fmt: skip
    rewards, values = [], {}
    for _ in range(40):
        values = trainer.step()
        rewards.append(values["reward/total"])
    print(rewards)
    assert np.mean(rewards[-10:]) > 1.1 * np.mean(rewards[:10])
    assert values["explained_variance"] > 0.2


def test_killed_while_saving_it_can_always_be_resumed(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.step()
    trainer.save("last")
    rng = random.Random(0)
    for _ in range(20):
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
    assert len(read_metrics(folder)) == done
    frames = (done + 2) * 8 * 16
    again = subprocess.run(
        [sys.executable, str(ROOT / "train.py"), "resume=latest", f"train.frames={frames}"],
        cwd=tmp_path, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert again.returncode == 0, again.stderr
    assert "python evaluate.py run=" in again.stdout
    assert len(read_metrics(folder)) == done + 2


def test_run_folder_holds_what_a_reader_needs(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.run()
    folder = trainer.folder
    assert load_config(folder / "config.yaml") == trainer.config
    versions = json.loads((folder / "versions.json").read_text())
    assert {"git_commit", "cpu", "packages"} <= set(versions)
    assert list(folder.glob("events.out.tfevents.*"))
    row = read_metrics(folder)[-1]
    for column in ("return", "success", "reward/position", "approx_kl", "clip_fraction", "explained_variance",
                   "entropy", "fps", "share_sampling", "share_learning", "eval/success_rate"):  # fmt: skip
        assert row[column] != "", column
    assert {path.name for path in (folder / "checkpoints").iterdir()} == {"best.pt", "last.pt"}


def test_time_outs_are_bootstrapped_and_failures_are_not(tmp_path):
    trainer = make_trainer(tmp_path)
    batch = next(iter(trainer.collector))
    while not batch["next", "truncated"].any():
        batch = next(iter(trainer.collector))
    gamma = trainer.config.train.gamma
    with torch.no_grad():
        trainer.learner.advantage(batch)
        value = trainer.learner.critic(batch["state"])
        following = trainer.learner.critic(batch["next", "state"])
    reward, done = batch["next", "agents", "reward"], batch["next", "truncated"].squeeze(-1)
    expected = reward + gamma * following - value  # nothing follows the last step of an episode
    torch.testing.assert_close(batch["advantage"][done], expected[done], rtol=1e-4, atol=1e-4)
    batch["next", "terminated"] = batch["next", "truncated"].clone()
    with torch.no_grad():
        trainer.learner.advantage(batch)
    torch.testing.assert_close(batch["advantage"][done], (reward - value)[done], rtol=1e-4, atol=1e-4)


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


def test_normalizer_equals_the_statistics_of_all_batches():
    generator = torch.Generator().manual_seed(0)
    batches = [3 + 2 * torch.randn(n, 6, generator=generator) for n in (5, 100, 17)]
    normalizer = Normalizer(6)
    for batch in batches:
        normalizer.update(batch)
    everything = torch.cat(batches)
    torch.testing.assert_close(normalizer.shift, everything.mean(0))
    torch.testing.assert_close(1 / normalizer.scale, everything.std(0, correction=0))


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


@pytest.mark.parametrize("name", ["latest", "runs/none"])
def test_missing_run_is_named(tmp_path, name):
    with pytest.raises(CheckpointError, match="no run"):
        find_run(name, tmp_path)


def test_observations_of_another_environment_are_refused(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    with pytest.raises(ValueError, match=r"observation has 7 numbers, the policy of .* was trained with"):
        load_policy(trainer.folder).act(np.zeros((1, 4, 7), np.float32))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["config=hovr"], "no configuration named 'hovr'; did you mean 'hover'?"),
        (["train.frmes=10"], "unknown key 'train.frmes'; did you mean 'frames'?"),
        (["train.frames=ten"], "train.frames must be a whole number, but is 'ten'"),
        (["payload.mass=30"], "lower payload.mass"),
        (["frames"], "'frames' is not of the form key=value"),
        (["resume=nowhere"], "no run folder nowhere"),
    ],
)
def test_command_line_errors_are_one_sentence(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    assert train(arguments) == 2
    shown = capsys.readouterr().err
    assert message in shown
    assert shown.startswith("error: ") and shown.count("\n") == 1
    assert not (tmp_path / "runs").exists()


def test_resume_refuses_what_cannot_change(tmp_path, capsys):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    assert train([f"resume={trainer.folder}", "env.num_drones=3"]) == 2
    assert "'env.num_drones' cannot change when a run is resumed" in capsys.readouterr().err


def test_help_explains_every_key(capsys):
    assert train(["--help"]) == 0
    text = capsys.readouterr().out
    for key in ("train.frames", "payload.mass", "cable.stiffness", "randomization.payload_force", "resume"):
        assert key in text


def test_log_drops_rows_after_the_checkpoint(tmp_path):
    log = RunLog(tmp_path)
    for iteration in range(1, 6):
        log.write(
            {"iteration": iteration, "frames": 10 * iteration}, {"a": 1.0} | ({"b": 2.0} if iteration == 3 else {})
        )
    log.close()
    log = RunLog(tmp_path, iteration=3)
    log.write({"iteration": 4, "frames": 40}, {"a": 9.0})
    log.close()
    rows = read_metrics(tmp_path)
    assert [row["iteration"] for row in rows] == ["1", "2", "3", "4"]
    assert [row["b"] for row in rows] == ["", "", "2.0", ""]
    assert rows[-1]["a"] == "9.0"


def test_configuration_of_a_checkpoint_is_complete(tmp_path):
    trainer = make_trainer(tmp_path)
    trainer.save("last")
    content = load_checkpoint(trainer.folder / "checkpoints" / "last.pt")
    assert build_config(content["config"]) == trainer.config


def test_impossible_system_makes_no_run_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError):
        _ = load_config("hover", {"payload.mass": 50}).system
    assert train(["payload.mass=50"]) == 2
    assert not (tmp_path / "runs").exists()
