"""What the tests share. A test that takes `task` runs for every task, one that takes `num_drones` for every N."""

from __future__ import annotations

import numpy as np

import multilift_marl as ml
from multilift_marl.config import System
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.sim import World

TASKS = ml.list_tasks()
NUM_DRONES = (1, 2, 3, 6)
GRAVITY = 9.81


def pytest_generate_tests(metafunc):
    own = {name for mark in metafunc.definition.iter_markers("parametrize") for name in _names(mark.args[0])}
    for name, values in (("task", TASKS), ("num_drones", NUM_DRONES)):
        if name in metafunc.fixturenames and name not in own:
            metafunc.parametrize(name, values)


def _names(argument: str | tuple[str, ...]) -> list[str]:
    return [part.strip() for part in argument.split(",")] if isinstance(argument, str) else list(argument)


def make(task: str = "hover", num_envs: int = 4, num_drones: int = 4, num_threads: int = 1, **keywords) -> MultiliftVec:
    """Return a small batch on one thread; overrides by dotted name."""
    return ml.make_vec(task, num_envs=num_envs, num_drones=num_drones, num_threads=num_threads, **keywords)


def make_system(num_drones: int = 1, **overrides) -> System:
    """Return the hover team's system; overrides by dotted name."""
    return ml.load_config("hover", {"env.num_drones": num_drones, **overrides}).system


def mask(num_envs: int, *chosen: int) -> np.ndarray:
    """Return the mask (E,) of the chosen environments."""
    return np.isin(np.arange(num_envs), chosen)


def hover_thrust(world: World) -> np.ndarray:
    """Return rotor thrusts (E, N, 4) that hold drones and nominal cable pulls in equilibrium."""
    system = world.system
    force = np.linalg.norm(system.formation_force + [0, 0, system.vehicle.mass * GRAVITY], axis=1)
    return np.broadcast_to(force[:, None] / 4, (world.num_envs, world.num_drones, 4)).copy()


def bold_actions(vec: MultiliftVec, step: int, first_env: int = 0, hold: int = 25) -> np.ndarray:
    """Return full actions (E, N, A), held for `hold` steps, which make teams fail; those of e depend on e alone."""
    shape = (vec.num_drones, vec.action_size)
    return np.stack(
        [np.random.default_rng((first_env + e, step // hold)).choice([-1.0, 1.0], shape) for e in range(vec.num_envs)]
    )


def same(first, second) -> bool:
    """Return whether two nested structures hold the same bits."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(same(a, b) for a, b in zip(first, second, strict=True))
    first, second = np.asarray(first), np.asarray(second)
    return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()
