"""Systems that lack what Linux has: fakes of them, each in a Python of its own."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from conftest import make_trainer

from multilift_marl import _platform
from multilift_marl.deploy.px4.launch import find_px4

ROOT = Path(__file__).parents[2]
MACOS = "del os.sched_getaffinity\n"
WINDOWS = """
for module, names in {
    os: ("sched_getaffinity", "fork", "killpg", "uname", "getuid", "O_CLOEXEC", "register_at_fork"),
    signal: ("SIGHUP", "SIGKILL", "pthread_sigmask"),
}.items():
    for name in names:
        delattr(module, name)
for name in ("fcntl", "resource", "pwd", "grp", "termios"):
    sys.modules[name] = None
locked = []
msvcrt = types.ModuleType("msvcrt")
msvcrt.LK_NBLCK, msvcrt.locking = 2, lambda *arguments: locked.append(arguments)
sys.modules["msvcrt"] = msvcrt
"""
FAKES = {"darwin": MACOS, "win32": WINDOWS, "win32 without SIGTERM": WINDOWS + "del signal.SIGTERM\n"}
USE = """
import os, signal, sys, types
import av, imageio, matplotlib.pyplot, mujoco, numba, numpy, torch, torchrl, tqdm  # know their real system
import tensordict, torchrl.collectors
{fake}
sys.platform = {platform!r}
import multilift_marl as ml
from multilift_marl.envs import multilift_v0
from multilift_marl.cli.evaluate import main

vec = ml.make_vec("hover", num_envs=2)
vec.reset(seed=0)
assert len(vec.world.shards) <= 2
assert numpy.isfinite(vec.step(numpy.zeros((2, 4, 4), numpy.float32)[:, :, : vec.task.action.shape[2]])[0]).all()
env = multilift_v0.parallel_env("hover")
env.reset(seed=0)
env.step({{agent: env.action_space(agent).sample() for agent in env.agents}})
keys = ["policy=formation", "config=hover", "episodes=2", "env.episode_seconds=0.4", "out=evaluation"]
assert main(keys) == 0
from multilift_marl.agents.checkpoint import lock_run, unlock_run
from pathlib import Path
lock_run(Path("."))
unlock_run(Path("."))
import multilift_marl.deploy.px4.launch, multilift_marl.agents.trainer, multilift_marl.viewer.session
print("works", len(globals().get("locked", ())))
"""


@pytest.mark.slow
@pytest.mark.parametrize("fake", FAKES)
def test_package_works_on(fake, tmp_path):
    code = USE.format(fake=FAKES[fake], platform=fake.split()[0])
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True,
        env=os.environ | {"PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert done.stdout.splitlines()[-1:] == [f"works {int('win32' in fake)}"], done.stderr
    assert (tmp_path / "evaluation" / "metrics.json").is_file()


def test_cpus_are_those_of_the_machine_where_no_others_are_known(monkeypatch):
    monkeypatch.setattr(os, "cpu_count", lambda: 5)
    assert _platform.cpu_count() == len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else 5
    monkeypatch.delattr(os, "sched_getaffinity", raising=False)
    assert _platform.cpu_count() == 5
    monkeypatch.setattr(os, "cpu_count", lambda: None)
    assert _platform.cpu_count() == 1


def test_a_locked_file_is_locked_for_others(tmp_path):
    files = [os.open(tmp_path / "lock", os.O_RDWR | os.O_CREAT) for _ in range(2)]
    _platform.lock_file(files[0])
    with pytest.raises(OSError):
        _platform.lock_file(files[1])
    os.close(files[0])
    _platform.lock_file(files[1])
    os.close(files[1])


def test_training_in_another_thread_leaves_signals_alone(tmp_path):
    before = [signal.getsignal(number) for number in _platform.STOPPING]
    trainer, results = make_trainer(tmp_path), []
    trainer.iteration = trainer.iterations
    thread = threading.Thread(target=lambda: results.append(trainer.run()))
    thread.start()
    thread.join()
    assert results == [True]
    assert [signal.getsignal(number) for number in _platform.STOPPING] == before


def test_px4_says_where_it_runs(monkeypatch, tmp_path):
    monkeypatch.delattr(os, "killpg", raising=False)
    with pytest.raises(Exception, match="Linux and macOS alone"):
        find_px4(tmp_path)
