"""Workers of Ray: the weights of one process, whatever happens to the workers; no process stays behind."""

import contextlib
import os
import signal
import socket
import subprocess
import sys
import time
from functools import partial
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import psutil
import pytest
import torch
from conftest import SMALL, make_trainer

from multilift_marl import _ray
from multilift_marl._versions import find_versions
from multilift_marl.agents import workers
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.logging import read_metrics
from multilift_marl.agents.rollouts import exploration_noise
from multilift_marl.agents.trainer import resume_run
from multilift_marl.cli import benchmark
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation import parallel
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.evaluation.suites import load_suite
from multilift_marl.policies.baselines import make_scripted

ROOT = Path(__file__).parents[2]
GRU = {"train.gru": 8, "train.sequence": 8}
sys.path.insert(0, str(ROOT / "results"))


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


@pytest.mark.slow
def test_one_worker_learns_what_one_process_does(tmp_path, local_ray):
    """With memory, which goes to the workers and back, too."""
    alone, one = (learn(make_trainer(tmp_path, **GRU, **{"train.workers": k})) for k in (0, 1))
    assert_equal(alone, one)


@pytest.fixture(scope="module")
def whole(tmp_path_factory, local_ray):
    """What a training of two workers learns to which nothing happens."""
    return learn(make_trainer(tmp_path_factory.mktemp("whole"), **{"train.workers": 2}))


@pytest.mark.slow
def test_workers_replay_bit_for_bit_also_where_one_dies(tmp_path, whole):
    assert_equal(whole, learn(make_trainer(tmp_path, **{"train.workers": 2}), kill=True))


@pytest.mark.slow
def test_a_worker_that_is_stopped_is_replaced_bit_for_bit(tmp_path, whole, monkeypatch):
    import ray

    monkeypatch.setattr(_ray, "SILENCE", 3.0)
    wounded = make_trainer(tmp_path, **{"train.workers": 2})
    wounded.step()
    pid = ray.get(wounded.rollouts._workers[0].pulse.options(concurrency_group="pulse").remote())
    os.kill(pid, signal.SIGSTOP)
    assert_equal(whole, learn(wounded, 2))
    with contextlib.suppress(psutil.NoSuchProcess):
        psutil.Process(pid).wait(60)  # Ray may still be clearing it away


@pytest.mark.slow
def test_a_full_cluster_is_refused_in_a_sentence(tmp_path, local_ray, monkeypatch):
    import ray

    class Sleeper:
        def wake(self):
            """Another program's work."""

    def wait_for_free(cpus):  # what is killed, or begins, is counted a while later
        deadline = time.monotonic() + 120
        while int(ray.available_resources().get("CPU", 0)) != cpus and time.monotonic() < deadline:
            time.sleep(0.1)

    monkeypatch.setattr(_ray, "_ROOM", 1.0)
    wait_for_free(4)
    other = ray.remote(num_cpus=3)(Sleeper).remote()
    ray.get(other.wake.remote())
    wait_for_free(1)
    with pytest.raises(ConfigError, match="has 1 of its 4 CPUs free for 2 workers"):
        make_trainer(tmp_path, **{"train.workers": 2})
    ray.kill(other)
    monkeypatch.setattr(_ray, "_ROOM", 60.0)
    make_trainer(tmp_path, **{"train.workers": 1}).rollouts.close()


@pytest.mark.slow
def test_the_first_batch_of_workers_is_that_of_one_process(tmp_path, local_ray):
    alone, three = (make_trainer(tmp_path, **{"train.workers": k}) for k in (0, 3))
    batches = [trainer.rollouts.collect(0)[0] for trainer in (alone, three)]
    for key in (("agents", "observation"), ("agents", "action"), ("next", "agents", "reward"), "state"):
        torch.testing.assert_close(batches[0][key], batches[1][key], rtol=0, atol=1e-5)
    assert batches[1].batch_size == batches[0].batch_size
    three.rollouts.close()


@pytest.mark.slow
def test_workers_have_the_priority_of_their_caller(local_ray):
    """By Ray's own choice all other programs would come first: ten times slower on a busy machine."""
    import ray

    assert ray.get(ray.remote(lambda: os.nice(0)).remote()) == os.nice(0)


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


@pytest.mark.slow
def test_evaluation_by_workers_measures_the_same(tmp_path, local_ray, monkeypatch):
    import ray

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ray, "cancel", None)  # of what has ended, it may abort this process
    common = ["policy=formation_feedback", "config=hover", "env.episode_seconds=1", "episodes=7", "baseline=none"]
    for k in (0, 2):
        assert evaluate([*common, f"workers={k}", f"out=w{k}"]) == 0
    alone, apart = ((tmp_path / f"w{k}" / "metrics.json").read_text() for k in (0, 2))
    assert alone == apart and '"median_excess"' in alone


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGSTOP, signal.SIGKILL])
def test_an_evaluation_does_a_part_again_where_a_process_is_stopped_or_dies(local_ray, monkeypatch, number):
    monkeypatch.setattr(_ray, "SILENCE", 3.0)
    monkeypatch.setattr(parallel, "_PART", 2)
    config, make, hurt = load_config("hover", {"env.episode_seconds": 0.4}), partial(make_scripted, "formation"), []

    def hurt_one(done):
        if not hurt:
            crew = [each for each in psutil.Process().children(recursive=True) if "_Flyer" in " ".join(each.cmdline())]
            hurt.append(crew[0])
            crew[0].send_signal(number)

    with parallel.cluster("local", 2):
        evaluation = parallel.Evaluation(12, 5, workers=2)
        flown = parallel.evaluate_parallel(config, make, evaluation, hurt_one)
        again = parallel.evaluate_parallel(config, make, evaluation)  # by the same processes
    whole = run_episodes(config, make, 12, 5)
    for name, values in whole.items():
        np.testing.assert_array_equal(flown[name], values, err_msg=name)
        np.testing.assert_array_equal(again[name], values, err_msg=name)
    psutil.wait_procs(hurt, timeout=30)
    assert hurt and not hurt[0].is_running()


@pytest.mark.slow
def test_a_part_that_ends_every_process_is_refused_in_a_sentence(local_ray):
    def make(vec):
        os.kill(os.getpid(), signal.SIGKILL)

    with pytest.raises(ConfigError, match=r"the worker of episodes 0 to 1 died 3 times in a row; .*workers=0"):
        parallel.evaluate_parallel(load_config("hover"), make, parallel.Evaluation(2, 5, workers=1))


@pytest.mark.slow
def test_a_benchmark_by_workers_has_the_same_card(tmp_path, local_ray, monkeypatch):
    whole, short = load_suite("shifts"), {"env.episode_seconds": 0.4}
    shifts = [task for task in whole.tasks if task.factors][:2]
    tasks = tuple(task._replace(config=load_config("hover", short), shipped=None) for task in shifts)
    monkeypatch.setattr(benchmark, "load_suite", lambda name: whole._replace(tasks=tasks, episodes=3))
    for k in (0, 2):
        assert benchmark.main(["policy=formation", "suite=shifts", f"workers={k}", f"out={tmp_path / str(k)}"]) == 0
    alone, apart = ((tmp_path / str(k) / "card.json").read_text(encoding="utf-8") for k in (0, 2))
    assert alone == apart and [task.factors for task in tasks] == [{"payload_mass": 1.35}, {"cable_length": 1.2}]


def build(versions):
    workers._Worker.__new__(workers._Worker).build({}, 0, 1, 0, versions)


def fly(versions):
    parallel._Flyer.__new__(parallel._Flyer).fly(versions, b"", 0, 1)


def call(versions):
    reproduce = pytest.importorskip("reproduce")
    reproduce._call_here(b"", os.getcwd(), str(ROOT / "results"), versions)


@pytest.mark.parametrize("work", [build, fly, call])
@pytest.mark.parametrize("other", ["multilift_marl", "sources", "mujoco"])
def test_a_node_with_other_versions_refuses_to_work(work, other):
    with pytest.raises(ConfigError) as caught:
        work(find_versions() | {other: "0.0.1"})
    message = str(caught.value)
    assert message.startswith(f"the node {socket.gethostname()} of the cluster of Ray has multilift_marl ")
    assert f"{other} {find_versions()[other]}" in message.partition("its caller")[0]
    assert f"{other} 0.0.1" in message.partition("its caller")[2] and message.endswith("every node (docs/ray.md)")


@pytest.mark.slow
@pytest.mark.parametrize("work", ["training", "evaluation", "results"])
def test_versions_of_the_caller_go_with_the_work(tmp_path, local_ray, monkeypatch, work):
    reproduce = pytest.importorskip("reproduce")
    for module in (workers, parallel, reproduce):
        monkeypatch.setattr(module, "find_versions", lambda: find_versions() | {"multilift_marl": "0.0.1"})
    with pytest.raises(
        ConfigError, match=r"^the node .* of the cluster of Ray has .*its caller has multilift_marl 0.0.1"
    ):
        if work == "training":
            make_trainer(tmp_path, **{"train.workers": 1}).step()
        elif work == "evaluation":
            make = partial(make_scripted, "formation")
            parallel.evaluate_parallel(load_config("hover"), make, parallel.Evaluation(2, 5, workers=1))
        else:
            list(reproduce.spread_by_ray(str, ["gate"], 1, "local"))


@pytest.mark.parametrize("ask", ["collect", "get_state", "set_state"])
@pytest.mark.parametrize("built", [False, True])
def test_what_a_worker_raises_is_raised_as_here(monkeypatch, ask, built):
    import ray

    def fail(result):
        cause = ConfigError("reward term bad is not finite")
        raise ray.exceptions.RayTaskError("f", "Traceback", cause, "p", 1, "127.0.0.1").as_instanceof_cause()

    monkeypatch.setattr(ray, "wait", lambda results, **_: (results, []))
    monkeypatch.setattr(ray, "get", fail)
    monkeypatch.setattr(ray, "put", lambda value: value)
    few = workers.Workers.__new__(workers.Workers)
    few._ray, few._actor, few._bounds, few._states = ray, torch.nn.Linear(1, 1), [0, 2], [None]
    few._workers, few._built = [MagicMock()], [None if built else 0]
    with pytest.raises(ConfigError) as caught:
        getattr(few, ask)(*{"collect": (0,), "get_state": (), "set_state": ({"state": torch.zeros(2)},)}[ask])
    assert type(caught.value) is ConfigError and str(caught.value) == "reward term bad is not finite"


BAD = """
import numpy as np
import multilift_marl as ml
from multilift_marl.mdp.rewards import Term
from multilift_marl.tasks.hover import Hover

def bad(view, margin):
    return np.where(view.time > 0.1, np.nan, 1.0)

@ml.register_task
class Bad(Hover):
    name = "bad_reward"
    REWARD = {**Hover.REWARD, "bad": Term(0.1, bad, margin=0.1, unit="m")}
"""


@pytest.mark.slow
def test_a_reward_that_is_not_finite_is_refused_alike_by_a_worker(tmp_path, local_ray, registries):
    (tmp_path / "bad_reward.py").write_text(BAD)
    task = {"import": str(tmp_path / "bad_reward.py"), "task": "bad_reward"}
    said = []
    for k in (0, 1):
        trainer = make_trainer(tmp_path, **task, **{"train.workers": k})
        with pytest.raises(ConfigError) as caught:
            learn(trainer)
        said.append(str(caught.value))
        trainer.rollouts.close()
    assert said[0] == said[1] and said[0].startswith(
        "task bad_reward: reward term 'bad', function bad, returned what is not finite"
    )


@pytest.mark.slow
def test_results_of_flights_are_spread_and_yielded_as_they_come(local_ray):
    from reproduce import spread_by_ray

    def measure(job):
        return f"{job} by {'its own process' if os.getpid() != here else 'this one'} in {os.getcwd()}"

    here = os.getpid()
    lines = list(spread_by_ray(measure, ["gate", "hover", "land"], 2, "local"))
    assert sorted(lines) == [f"{job} by its own process in {ROOT}" for job in ("gate", "hover", "land")]

    def fail(job):
        raise ConfigError(f"{job} cannot be")

    with pytest.raises(ConfigError, match=r"^(gate|hover) cannot be$"):
        list(spread_by_ray(fail, ["gate", "hover"], 2, "local"))


@pytest.mark.slow
def test_a_lost_head_ends_training_with_a_sentence_and_a_checkpoint(tmp_path):
    kept = SMALL.keys() - {"train.frames", "train.checkpoint_every"}
    arguments = [f"{key}={SMALL[key]}" for key in kept]
    command = [sys.executable, str(ROOT / "train.py"), "config=hover", "train.frames=1e8", *arguments]
    command += ["train.workers=1", "train.ray=local", "train.checkpoint_every=100000"]
    said = tmp_path / "said"  # no pipe, which processes of Ray could hold open
    with open(said, "w") as file:
        process = subprocess.Popen(command, cwd=tmp_path, stdout=file, stderr=file)
    deadline = time.time() + 300
    while time.time() < deadline and not any(len(read_metrics(run)) > 3 for run in tmp_path.glob("runs/*")):
        assert process.poll() is None, said.read_text()
        time.sleep(0.5)
    started = psutil.Process(process.pid).children(recursive=True)
    next(each for each in started if is_worker(each)).suspend()  # so that the learner waits
    next(each for each in started if "gcs_server" in each.name()).kill()
    try:
        status = process.wait(240)
    finally:
        for each in started:
            with contextlib.suppress(psutil.NoSuchProcess):
                each.kill()
    last = said.read_text().replace("\r", "\n").splitlines()[-1]
    assert status == 2 and last.startswith("error: the head node 127.0.0.1:"), said.read_text()
    saved = load_checkpoint(next(tmp_path.glob("runs/*")) / "checkpoints" / "last.pt")
    assert saved["iteration"] >= 3


def is_worker(process):
    return "_Worker" in " ".join(process.cmdline())


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
