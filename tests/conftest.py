"""What the tests share.

A test that takes `task` runs for every task, one that takes `num_drones` for every N, and one that takes `cables`, the
configuration of a cable model, for both models. Of these, tasks that are not in `COMMON`, and for tasks other than
`hover` all but two drones on massless cables, are marked `slow`; with the mark `few_tasks`, all but `hover`. Tests so
marked are left out unless asked for by `-m slow`; each task has default tests of its own in `tests/tasks`. Not all
combinations are flown, see `is_redundant`. Slow tests whose names begin as a line of `long.txt` are marked `long`, too.
"""

from __future__ import annotations

import os

if "PYTEST_XDIST_WORKER" in os.environ:  # before numpy and torch: threads would wait for cores that other workers have
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # of learning, which takes two: asleep, not spinning

import importlib.util
import signal
import sys
from dataclasses import replace
from math import sqrt
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl import plugins, tasks
from multilift_marl.config.load import CONFIGS
from multilift_marl.control.formation import place_formation
from multilift_marl.control.gains import DroneGains, Gains
from multilift_marl.control.gains import drone_gains as gains_of_a_drone
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.rig import presets
from multilift_marl.rig.system import System
from multilift_marl.sim import World
from multilift_marl.tasks import find_task
from multilift_marl.validation.cables import hover_thrust  # noqa: F401 (for the tests)

collect_ignore = [
    "project/test_model_cards.py",
    "project/test_results.py",
    "project/test_search_gains.py",
]  # of recorded results, which an sdist does not hold
if (Path(__file__).parents[1] / "results").is_dir():
    collect_ignore = []

sys.path += [str(folder) for folder in Path(__file__).parent.iterdir() if folder.is_dir()]  # test files share functions

# A run in the background, or below nohup, begins with these ignored, as do its children; tests send them.
for _number, _handler in (
    (signal.SIGINT, signal.default_int_handler),
    (getattr(signal, "SIGHUP", None), signal.SIG_DFL),
):
    if _number is not None and signal.getsignal(_number) is signal.SIG_IGN:
        signal.signal(_number, _handler)

TASKS = ml.list_tasks()
COMMON = ("hover", "track", "pose", "loss")  # a goal that rests, moves, is planned; a team that changes
NUM_DRONES = (1, 2, 6)
CABLES = {"massless": {"cable.model": "massless"}, "chain": {"cable.model": "chain", "cable.segments": 3}}  # few: fast
GRAVITY = 9.81
EXAMPLES = Path(__file__).parents[1] / "examples"
LONG = tuple(Path(__file__).with_name("long.txt").read_text(encoding="utf-8").splitlines())  # names begin so
TIMESTEPS = (5e-4, 1e-3, 2e-3, 4e-3)
OFF_CENTRE = [[0.25, 0.2, 0.08], [-0.3, 0.2, 0.08], [-0.3, -0.2, 0.08], [0.25, -0.2, 0.08]]
INFO = {"success", "failure", "diverged", "failure_cause", "reward_terms", "randomization"}
JARGON = ("Input ", "Value error", "Field required", "Tuple ", "instance of", "\n", ". ", "  ", "Errno")
SHARES = {  # key of `randomization`: width
    "payload_mass": 0.2, "payload_inertia": 0.3, "payload_drag": 0.5, "cable_length": 0.05, "cable_stiffness": 0.4,
    "vehicle_mass": 0.1, "vehicle_thrust_coefficient": 0.08, "vehicle_rotor_time_constant": 0.25, "vehicle_drag": 0.6,
    "rotor_thrust_coefficient": 0.04,
}  # fmt: skip
# all hidden parameters; one set for all tests, since what is hidden is compiled into the global state
ALL = {f"randomization.{key}": width for key, width in SHARES.items()} | {
    "randomization.payload_center_of_mass": (0.03, 0.02, 0.01), "randomization.wind": 4.0, "env.episode_seconds": 4.0,
}  # fmt: skip
SMALL = {
    "env.num_envs": 8, "env.num_threads": 1, "env.episode_seconds": 0.5, "train.horizon": 16, "train.frames": 1280,
    "train.minibatches": 4, "train.warmup": 0, "train.checkpoint_every": 5, "eval.every": 4, "eval.episodes": 3,
    "train.residual": "formation",
}  # fmt: skip


def asked_of(item: pytest.Item) -> dict:
    """Return the parameters of a test."""
    return item.callspec.params if hasattr(item, "callspec") else {}


def own_parameters(item: pytest.Item) -> set[str]:
    """Return the names of the parameters whose values the test gives itself."""
    return {name for mark in item.iter_markers("parametrize") for name in _names(mark.args[0])}


def is_redundant(item: pytest.Item) -> bool:
    """Return whether others stand for a test: each task goes with each N and each cable model, not with each of both.

    With `hover` all are combined. A test without N takes one cable model for each task that is not in `COMMON`, another
    one for the next task and in the next test.
    """
    own = own_parameters(item)
    asked = {name: value for name, value in asked_of(item).items() if name not in own}
    if not {"task", "cables"} <= asked.keys() or asked["task"] == "hover":
        return False
    if not find_task(asked["task"]).CHAINS:
        return asked["cables"] == CABLES["chain"]
    chosen = TASKS.index(asked["task"]) + list(CABLES.values()).index(asked["cables"])
    if "num_drones" in asked:
        if (asked["num_drones"], asked["cables"]) == (2, CABLES["massless"]):  # what default tests fly
            return False
        return (chosen + NUM_DRONES.index(asked["num_drones"])) % 2 == 1
    return asked["task"] not in COMMON and (chosen + len(item.originalname)) % 2 == 1


def pytest_generate_tests(metafunc):
    own = own_parameters(metafunc.definition)
    for name, values, ids in (
        ("task", TASKS, None),
        ("num_drones", NUM_DRONES, None),
        ("cables", CABLES.values(), CABLES),
    ):
        if name in metafunc.fixturenames and name not in own:
            metafunc.parametrize(name, values, ids=ids)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config, items):
    redundant = {item for item in items if is_redundant(item)}
    config.hook.pytest_deselected(items=list(redundant))
    items[:] = [item for item in items if item not in redundant]
    for item in items:
        if item.nodeid.removeprefix("tests/").startswith(LONG):
            item.add_marker(pytest.mark.long)
            item.add_marker(pytest.mark.slow)
        asked = asked_of(item)
        if "planner_weights" in [value for value in asked.values() if isinstance(value, str)]:
            # Its planner takes a minute to compile.
            item.add_marker(pytest.mark.slow)
        task = asked.get("task", "hover")
        if task == "hover":
            continue
        own = own_parameters(item)
        if "task" not in own and (task not in COMMON or item.get_closest_marker("few_tasks")):
            item.add_marker(pytest.mark.slow)
        if not {"num_drones", "cables"} & asked.keys():
            continue
        if asked.get("num_drones", 2) != 2 or asked.get("cables", CABLES["massless"]) != CABLES["massless"]:
            item.add_marker(pytest.mark.slow)


@pytest.fixture
def registries(tmp_path):
    """Forget what a test registers, and imports from its folder or from the examples."""
    known = [tasks.TASKS, presets.PRESETS, CONFIGS, plugins._imported, plugins.refused]
    before, modules, path = [dict(registry) for registry in known], set(sys.modules), list(sys.path)
    named = set(plugins.named)
    yield
    plugins.named.intersection_update(named)
    for registry, content in zip(known, before, strict=True):
        registry.clear()
        registry.update(content)
    for name in set(sys.modules) - modules:
        file = str(getattr(sys.modules[name], "__file__", ""))
        if file.startswith((str(tmp_path), str(EXAMPLES))):
            del sys.modules[name]
    sys.path[:] = path


@pytest.fixture(autouse=True)
def _enough_drones(request):
    """Skip a task's tests with fewer drones than it makes sense with."""
    asked = asked_of(request.node)
    if {"task", "num_drones"} <= asked.keys():
        least = find_task(asked["task"]).MIN_DRONES
        if asked["num_drones"] < least:
            pytest.skip(f"{asked['task']} needs {least} drones")


def _names(argument: str | tuple[str, ...]) -> list[str]:
    return [part.strip() for part in argument.split(",")] if isinstance(argument, str) else list(argument)


def slow(*values: object) -> object:
    """Return a parameter whose tests are slow."""
    return pytest.param(*values, marks=pytest.mark.slow)


def load_script(name: str) -> ModuleType:
    """Return a script beside the package, such as "bench/training", as a module."""
    spec = importlib.util.spec_from_file_location(name.replace("/", "_"), Path(__file__).parents[1] / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def make(task: str = "hover", num_envs: int = 4, num_drones: int = 4, num_threads: int = 1, **keywords) -> MultiliftVec:
    """Return a small batch on one thread; overrides by dotted name."""
    return ml.make_vec(task, num_envs=num_envs, num_drones=num_drones, num_threads=num_threads, **keywords)


def wide(task: str) -> dict[str, float]:
    """Return offsets with which drones of any task can fail: those of `takeoff` and `land` are small."""
    return {"control.max_offset": 0.5} if task in ("takeoff", "land") else {}


def drone_gains(gains: Gains, n: int) -> DroneGains:
    """Return the gains of drone n; compiled, kernels hand no arrays to Python."""
    return getattr(gains_of_a_drone, "py_func", gains_of_a_drone)(gains, n)


def make_system(num_drones: int = 1, **overrides) -> System:
    """Return the hover team's system; overrides by dotted name."""
    return ml.load_config("hover", {"env.num_drones": num_drones, **overrides}).system


def mask(num_envs: int, *chosen: int) -> np.ndarray:
    """Return the mask (E,) of the chosen environments."""
    return np.isin(np.arange(num_envs), chosen)


def bold_actions(vec: MultiliftVec, step: int, first_env: int = 0, hold: int = 25) -> np.ndarray:
    """Return full actions (E, N, A), held for `hold` steps, which make teams fail; those of e depend on e alone."""
    shape = (vec.num_drones, vec.action_size)
    return np.stack(
        [np.random.default_rng((first_env + e, step // hold)).choice([-1.0, 1.0], shape) for e in range(vec.num_envs)]
    )


def mixed_actions(vec: MultiliftVec, step: int, hold: int = 25) -> np.ndarray:
    """Return bold actions (E, N, A), timid ones in every other environment, so that some episodes reach their end."""
    return bold_actions(vec, step, hold=hold) * np.where(np.arange(vec.num_envs) % 2, 0.1, 1.0)[:, None, None]


def same(first, second) -> bool:
    """Return whether two nested structures hold the same bits."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(same(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(same(a, b) for a, b in zip(first, second, strict=True))
    first, second = np.asarray(first), np.asarray(second)
    return first.dtype == second.dtype and first.shape == second.shape and first.tobytes() == second.tobytes()


def floats(array) -> tuple[float, ...]:
    """Return the numbers of an array, flattened, as kernels take them."""
    return tuple(float(x) for x in np.ravel(array))


def zeros(vec: MultiliftVec) -> np.ndarray:
    """Return actions (E, N, A) of zero."""
    return np.zeros((vec.num_envs, vec.num_drones, vec.action_size))


def largest_motion(poses: np.ndarray, t: np.ndarray, slots: np.ndarray) -> list[float]:
    """Return largest speed and acceleration, by differences, of a payload at poses (T, 4) and of its slots (N, 2)."""
    c, s = np.cos(poses[:, 3:]), np.sin(poses[:, 3:])
    x, y = np.vstack([np.zeros(2), slots]).T
    way, found = (
        np.stack([poses[:, :1] + c * x - s * y, poses[:, 1:2] + s * x + c * y, poses[:, 2:3] + 0 * c * x], -1),
        [],
    )
    for _ in range(2):
        way = np.gradient(way, t, axis=0)
        found.append(float(np.linalg.norm(way[2:-2], axis=2).max()))
    return found


def level(vec: MultiliftVec) -> None:
    """Put the first environment's team at rest in its formation at the target."""
    world, goal = vec.world, vec.task.goal
    goal.position[0], goal.rotation[0] = [0, 0, 1.5], np.eye(3)
    place_formation(0, goal, vec.task.rig)
    world.reset(mask(vec.num_envs, 0))


def with_vehicle(system: System, **fields) -> System:
    """Return the system with other numbers of all its vehicles."""
    return replace(system, vehicles=tuple(replace(vehicle, **fields) for vehicle in system.vehicles))


def without_drag(system: System, **vehicle) -> System:
    """Return the system without any drag; other properties of the vehicle by name."""
    return replace(with_vehicle(system, drag=(0.0, 0.0, 0.0), **vehicle), payload_drag_area=0.0)


def free_world(num_envs: int = 1, drag: bool = False, vehicle: dict | None = None, **overrides) -> World:
    """Return one upright drone 2 m above its payload on a slack cable of 20 m, both at rest, rotors at hover speed."""
    system = make_system(1, **{"cable.length": 20.0, **overrides})
    system = system if drag else without_drag(system, **(vehicle or {}))
    world = World(system, num_envs, 1)
    world.state.payload_position[:] = [0, 0, 100]
    world.state.drone_position[:] = [0, 0, 102]
    world.state.rotor_speed[:] = sqrt(system.vehicle.mass * GRAVITY / 4 / system.vehicle.thrust_coefficient)
    load(world)
    return world


def load(world: World) -> None:
    """Have the simulation take over a state that was written by hand."""
    world.load(np.ones(world.num_envs, bool))


def steady(world: World, thrust) -> np.ndarray:
    """Let the rotors turn at the speeds of `thrust` (4,) [N] already, and return it for every drone (E, N, 4)."""
    thrust = np.broadcast_to(np.asarray(thrust, float), (world.num_envs, world.num_drones, 4)).copy()
    world.state.rotor_speed[:] = np.sqrt(thrust / world.system.vehicle.thrust_coefficient)
    return thrust


def weightless(world: World) -> np.ndarray:
    """Return the thrust (E, N, 4) that holds a drone without a load."""
    return steady(world, world.system.vehicle.mass * GRAVITY / 4)


def refusal(build, *arguments, **keywords) -> str:
    """Return the message of the ConfigError, checked to be one sentence in plain words."""
    with pytest.raises(ConfigError) as caught:
        build(*arguments, **keywords)
    message = str(caught.value)
    assert message == message.strip()
    assert not [word for word in JARGON if word in message], message
    return message


def refuse_system(num_drones: int = 4, **overrides) -> str:
    """Return the complaint about a system; overrides with __ for the dot."""
    return refusal(make_system, num_drones, **{key.replace("__", "."): value for key, value in overrides.items()})


def refuse_task(**overrides) -> str:
    """Return the complaint about a hover task; overrides with __ for the dot."""
    overrides = {key.replace("__", "."): value for key, value in overrides.items()}
    return refusal(ml.make_vec, "hover", num_envs=1, num_threads=1, **overrides)


@pytest.fixture
def write(tmp_path):
    """Return a writer of YAML files."""

    def write(text: str, name: str = "mine.yaml"):
        path = tmp_path / name
        path.write_text(text, encoding="utf-8")
        return path

    return write


def make_trainer(tmp_path, **overrides):
    """Return the trainer of a new, small run; torch is imported here, since most tests do without it."""
    from multilift_marl.agents.trainer import new_run

    return new_run(ml.load_config("hover", SMALL | overrides), "test", tmp_path)


def turned_from_rest(torque: np.ndarray, inertia: np.ndarray, timestep: float) -> np.ndarray:
    """Return the body rates (3,) [rad/s] that a step of the midpoint rule gives a free body at rest.

    Args:
        torque: (3,) in the body's frame [N m].
        inertia: (3,) principal moments [kg m²].
        timestep: [s].
    """
    rates = np.zeros(3)
    for _ in range(20):
        rates = timestep * (torque - np.cross(rates / 2, inertia * rates / 2)) / inertia
    return rates
