"""The package's types as mypy sees them: its own code, and a user's script, for which they must not be Any."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
SCRIPT = """
from collections.abc import Callable
from typing import Any, assert_type

import numpy as np

import multilift_marl as ml
from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.agents.policy import TrainedPolicy
from multilift_marl.control.formation import Goal
from multilift_marl.envs import multilift_v0
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.envs.multilift_v0 import MultiliftParallelEnv
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.tasks.hover import Hover

Info = dict[str, Any]
overrides: dict[str, Any] = {"payload.mass": 2.0}

vec = assert_type(ml.make_vec("hover", num_envs=2, **overrides), MultiliftVec)
assert_type(vec.reset(seed=0), tuple[np.ndarray, Info])
assert_type(vec.step(np.zeros((2, 4, 4))), tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, Info])
assert_type(vec.task.goal, Goal)
ml.make_vec(num_envs="two")  # type: ignore[arg-type]
ml.make_vecs()  # type: ignore[attr-defined]

env = assert_type(multilift_v0.parallel_env("hover"), MultiliftParallelEnv)
observation, _ = assert_type(env.reset(), tuple[dict[str, np.ndarray], dict[str, Info]])
assert_type(env.step({agent: env.action_space(agent).sample() for agent in env.agents})[1], dict[str, float])
assert_type(ml.parallel_env("hover").agents, list[str])
assert_type(ml.torchrl_env("hover"), MultiliftEnv)

config = ml.load_config("hover")
assert_type(config.env.num_drones, int)
world = ml.sim.World(config.system, 2)
assert_type(world.step(np.zeros((2, 4, 4))).payload_position, np.ndarray)
policy = assert_type(ml.load_policy("hover"), TrainedPolicy)
assert_type(policy.act(np.zeros((4, 37))), np.ndarray)
assert_type(ml.list_tasks(), list[str])


@kernel
def count(lo: int, hi: int, out: np.ndarray) -> None:
    out[lo:hi] += 1


class Mine(Hover):
    def observer(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None]:
        assert_type(self.options.success_distance, float)
        bind(count, lo, hi)  # type: ignore[arg-type]
        return bind(count, lo, hi, observation)
"""


def mypy(cwd, *files):
    config, cache = ROOT / "pyproject.toml", ROOT / ".mypy_cache"
    command = [sys.executable, "-m", "mypy", "--config-file", config, "--cache-dir", cache, *files]
    found = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(command, cwd=cwd, capture_output=True, text=True, env=found)
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
def test_the_package_is_sound():
    mypy(ROOT)


@pytest.mark.slow
def test_scripts_see_real_types(tmp_path):
    (tmp_path / "fly.py").write_text(SCRIPT)
    mypy(tmp_path, "fly.py")


def test_only_compiled_functions_go_without_annotations():
    for path in sorted((ROOT / "multilift_marl").rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and not any(
                ast.unparse(d) in ("kernel", "drawing", "inlined") for d in node.decorator_list
            ):
                asked = [a for a in (*node.args.args, *node.args.kwonlyargs) if a.arg not in ("self", "cls")]
                assert all(a.annotation for a in asked), f"{path}:{node.lineno}"
                assert node.returns or node.name == "__init__", f"{path}:{node.lineno}"
