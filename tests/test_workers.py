"""Workers of Ray: the weights of one process, whatever happens to the workers; no process stays behind."""

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import psutil
import pytest
import torch
from conftest import SMALL, make_trainer

from multilift_marl import _ray
from multilift_marl.agents.rollouts import exploration_noise
from multilift_marl.agents.trainer import resume_run
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.errors import ConfigError

ROOT = Path(__file__).parents[1]
GRU = {"train.gru": 8, "train.sequence": 8}


@pytest.fixture(scope="module")
def local_ray():
    """One cluster for the tests of this module, which workers find running and leave so."""
    assert _ray.connect("local", 4, "train.ray")
    yield
    _ray.disconnect()


def learn(trainer, iterations=3, kill=False):
    """Return weights, and states of the environments, after some iterations; one worker dies before the second."""
    for i in range(iterations):
        if kill and i == 1:
            import ray

            ray.kill(trainer.rollouts._workers[0])
        trainer.step()
    networks = {"actor": trainer.learner.actor, "critic": trainer.learner.critic}
    found = {f"{name}.{key}": value for name, net in networks.items() for key, value in net.state_dict().items()}
    found |= trainer.rollouts.get_state()
    found = {key: value.clone() for key, value in found.items()}
    trainer.rollouts.close()
    return found


def assert_equal(one, other):
    assert one.keys() == other.keys()
    assert [key for key in one if not torch.equal(one[key], other[key])] == []


@pytest.mark.parametrize("overrides", [{}, pytest.param(GRU, marks=pytest.mark.slow)], ids=["mlp", "gru"])
def test_one_worker_learns_what_one_process_does(tmp_path, local_ray, overrides):
    alone, one = (learn(make_trainer(tmp_path, **overrides, **{"train.workers": k})) for k in (0, 1))
    assert_equal(alone, one)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [2, 4])
def test_workers_replay_bit_for_bit_also_where_one_dies(tmp_path, local_ray, workers):
    whole, wounded = (learn(make_trainer(tmp_path, **{"train.workers": workers}), kill=kill) for kill in (False, True))
    assert_equal(whole, wounded)


@pytest.mark.slow
def test_the_first_batch_of_workers_is_that_of_one_process(tmp_path, local_ray):
    alone, three = (make_trainer(tmp_path, **{"train.workers": k}) for k in (0, 3))
    batches = [trainer.rollouts.collect(0)[0] for trainer in (alone, three)]
    for key in (("agents", "observation"), ("agents", "action"), ("next", "agents", "reward"), "state"):
        torch.testing.assert_close(batches[0][key], batches[1][key], rtol=0, atol=1e-5)
    assert batches[1].batch_size == batches[0].batch_size
    three.rollouts.close()


def test_noise_is_of_environment_and_iteration_alone():
    whole, part = (exploration_noise(5, envs, 3, (7, 2, 4)) for envs in (range(6), range(2, 4)))
    assert whole.shape == (7, 6, 2, 4) and torch.equal(whole[:, 2:4], part)
    others = [exploration_noise(seed, range(6), i, (7, 2, 4)) for seed, i in ((5, 4), (6, 3))]
    assert all(not torch.equal(whole, other) for other in others)
    many = exploration_noise(0, range(64), 0, (50, 4, 4)).numpy()
    assert abs(many.mean()) < 0.01 and abs(many.std() - 1) < 0.01
    assert np.abs(np.corrcoef(many.transpose(1, 0, 2, 3).reshape(64, -1)) - np.eye(64)).max() < 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("before", "after"), [(2, 0), (0, 2)])
def test_a_run_goes_on_with_other_workers(tmp_path, local_ray, before, after):
    trainer = make_trainer(tmp_path, **{"train.workers": before})
    for _ in range(2):
        trainer.step()
    trainer.save("last")
    trainer.rollouts.close()
    resumed = learn(resume_run(trainer.folder, {"train.workers": after}), 1)
    whole = learn(make_trainer(tmp_path, **{"train.workers": 0}), 3)
    for key, value in whole.items():  # round-off of the network's batch size alone
        if key.startswith(("actor", "critic")):
            torch.testing.assert_close(resumed[key].double(), value.double(), rtol=1e-3, atol=1e-4)


def test_evaluation_by_workers_measures_the_same(tmp_path, local_ray, monkeypatch):
    import ray

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ray, "cancel", None)  # of what has ended, it may abort this process
    common = ["policy=formation_feedback", "config=hover", "env.episode_seconds=1", "episodes=7", "baseline=none"]
    for k in (0, 2):
        assert evaluate([*common, f"workers={k}", f"out=w{k}"]) == 0
    alone, apart = ((tmp_path / f"w{k}" / "metrics.json").read_text() for k in (0, 2))
    assert alone == apart


def test_results_of_flights_are_spread_and_yielded_as_they_come(local_ray):
    sys.path.insert(0, str(ROOT / "results"))
    from reproduce import spread_by_ray

    def measure(job):
        return f"{job} by {'its own process' if os.getpid() != here else 'this one'} in {os.getcwd()}"

    here = os.getpid()
    lines = list(spread_by_ray(measure, ["gate", "hover", "land"], 2, "local"))
    assert sorted(lines) == [f"{job} by its own process in {ROOT}" for job in ("gate", "hover", "land")]

    def fail(job):
        raise ConfigError(f"{job} cannot be")

    with pytest.raises(ConfigError, match="cannot be"):
        list(spread_by_ray(fail, ["gate", "hover"], 2, "local"))


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"train.ray": "127.0.0.1:1"}, "does not answer"),
        ({"train.ray": "nowhere"}, "host:port"),
        ({"train.workers": 9}, "env.num_envs=8"),
    ],
)
def test_what_cannot_be_joined_is_refused_in_a_sentence(tmp_path, settings, word):
    import ray

    if ray.is_initialized():
        ray.shutdown()
    start = time.perf_counter()
    with pytest.raises(ConfigError, match=word):
        make_trainer(tmp_path, **{"train.workers": 2} | settings)
    assert time.perf_counter() - start < 60 and not list(tmp_path.iterdir())


def test_without_ray_one_sentence_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(ConfigError, match=r"pip install .*ray"):
        make_trainer(tmp_path, **{"train.workers": 2})


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_stopped_training_leaves_no_process(tmp_path, number):
    arguments = [f"{key}={value}" for key, value in SMALL.items() if key != "train.frames"]
    command = [sys.executable, str(ROOT / "train.py"), "config=hover", "train.frames=1e8", *arguments]
    command += ["train.workers=2", "train.ray=local"]
    process = subprocess.Popen(
        command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, start_new_session=True
    )
    deadline = time.time() + 300
    while time.time() < deadline and process.poll() is None and not list(tmp_path.glob("runs/*/checkpoints/last.pt")):
        time.sleep(0.5)
    started = psutil.Process(process.pid).children(recursive=True)
    os.killpg(process.pid, number) if number == signal.SIGINT else process.send_signal(number)
    output, _ = process.communicate(timeout=120)
    assert process.returncode == 128 + number and "python train.py resume=" in output, output
    assert len(started) > 2  # raylet, workers
    _, alive = psutil.wait_procs(started, timeout=30)
    assert alive == []
