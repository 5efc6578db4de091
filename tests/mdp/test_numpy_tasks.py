"""Tasks whose functions are plain NumPy of whole arrays: the same as by kernels, refused in one sentence."""

import json
import pickle
import threading

import numpy as np
import pytest
from conftest import SMALL, make, refusal

import multilift_marl as ml
from multilift_marl.agents.logging import read_metrics
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.cli.export import main as export
from multilift_marl.cli.train import main as train
from multilift_marl.evaluation.metrics import make_report
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.kernels import inlined
from multilift_marl.math3d import row, sub, vec
from multilift_marl.mdp.failures import CAUSES, FIRST_OWN
from multilift_marl.mdp.numpy_functions import ArrayView
from multilift_marl.mdp.observation_kernels import compose_observation
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import Term, compose_reward, tolerance
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.tasks.base import Kernels
from multilift_marl.tasks.hover import Hover

LATE = 0.31  # [s]
DISTURBED = {
    "env.history": 2, "randomization.observation_delay": (1, 2), "randomization.observation_noise": 1.0,
    "randomization.action_delay": (0, 2),
}  # fmt: skip
CELL = """
import numpy as np
import multilift_marl as ml
from multilift_marl.tasks.hover import Hover
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import Term

POLE = np.array([0.6, 0.0])  # [m] where it stands

def gap(v):
    return np.linalg.norm(v.state.payload_position[:, :2] - POLE, axis=1)

def touch(v):
    print("touch", v.time.shape)
    return gap(v) < 0.3

def clear(v, margin):
    return np.minimum(gap(v) / margin, 1.0)

def to_pole(v):
    return np.append(POLE, 1.0) - v.estimated.drone_position

@ml.register_task
class Pole(Hover):
    name = "pole"
    FAILURES = {"pole": touch}
    REWARD = Hover.REWARD | {"clear": Term(0.5, clear, margin=0.5, unit="m")}
    EXTRA = (Component("pole", 3, "slot", "m", "from the drone to the pole", to_pole),)
"""


def is_late(v):
    return v.time > LATE


def near(v, margin):
    return 1.0 / (1.0 + (v.errors.distance / margin) ** 2)


def to_target(v):
    return v.goal.position[:, None] - v.estimated.drone_position


def seconds(v):
    return np.repeat(v.time[:, None, None], v.action.shape[1], axis=1)


def payload_velocity(v):
    return v.estimated.payload_velocity


def payload_height(v):
    return v.state.payload_position[:, 2:]


@inlined
def is_late_kernel(e, v):
    return v.time[e] > LATE


@inlined
def near_kernel(e, v, margin):
    return tolerance(v.errors.distance[e], margin)


@inlined
def to_target_kernel(e, n, v):
    return sub(row(v.goal.position, e), vec(v.estimated.drone_position, e, n))


@inlined
def seconds_kernel(e, n, v):
    return v.time[e]


@inlined
def payload_velocity_kernel(e, n, v):
    return row(v.estimated.payload_velocity, e)


@inlined
def payload_height_kernel(e, n, v):
    return v.state.payload_position[e, 2]


def declare(name, late, near, to_target, seconds, velocity, height):
    """Return a task by functions of one kind."""
    declared = {
        "name": name,
        "FAILURES": {"late": late},
        "REWARD": Hover.REWARD | {"near": Term(0.3, near, 0.2, "m")},
        "EXTRA": (
            Component("to_target", 3, "slot", "m", "from the drone to the target", to_target),
            Component("level", 2, "slot", "m", "its level part", to_target, True),
            Component("seconds", 1, "-", "s", "time", seconds),
        ),
        "EXTRA_STATE": (
            Component("velocity", 3, "target", "m/s", "of the payload", velocity),
            Component("height", 1, "world", "m", "of the payload", height),
        ),
    }
    return ml.register_task(type("Own", (Hover,), declared))


def numpy_task(**declared):
    """Register the task by NumPy functions, some of them others, and return its name."""
    task = declare("by_numpy", is_late, near, to_target, seconds, payload_velocity, payload_height)
    ml.register_task(type("Own", (task,), declared))
    return "by_numpy"


def extended(value, size=1, frame="-", state=False):
    """Return what a task declares that has one more component."""
    return {"EXTRA_STATE" if state else "EXTRA": (Component("odd", size, frame, "-", "odd", value),)}


def build(num_envs=4, threads=1, **values):
    return make("by_numpy", num_envs=num_envs, num_threads=threads, **{"env.episode_seconds": 0.5} | values)


def fly(vec, steps=24, seed=3, resets=True):
    """Step by drawn actions, resetting what ends, and return all that comes out for each environment."""
    kept, first = [], vec.first_env
    vec.reset(seed=seed)
    for step in range(steps):
        actions = [
            np.random.default_rng((step, first + e)).uniform(-0.3, 0.3, (vec.num_drones, vec.action_size))
            for e in range(vec.num_envs)
        ]
        observation, reward, terminated, truncated, info = vec.step(np.array(actions))
        over = terminated | truncated
        kept.append((observation, reward, vec.state(), info["failure_cause"], *info["reward_terms"].values()))
        if resets and over.any():
            kept.append((vec.reset(mask=over)[0], vec.state()))
    return kept


def in_order(numbers):
    """Return numbers (E, ...) of each environment in ascending order; in global states, functions come last."""
    return np.sort(numbers, axis=-1) if numbers.ndim == 2 else numbers


def equal(some, others, rows=slice(None)):
    return len(some) == len(others) and all(
        np.array_equal(a[rows], b) for x, y in zip(some, others, strict=True) for a, b in zip(x, y, strict=True)
    )


@pytest.mark.parametrize(
    "values",
    [{}, *(pytest.param(each, marks=pytest.mark.slow) for each in (DISTURBED, {"env.units": "cable"}))],
    ids=["ideal", "disturbed", "cable"],
)
def test_functions_and_kernels_are_the_same_task(registries, values):
    numpy_task()
    kernels = (is_late_kernel, near_kernel, to_target_kernel, seconds_kernel, payload_velocity_kernel)
    declare("by_kernels", *kernels, payload_height_kernel)
    values = {"env.episode_seconds": 0.5} | values
    found, compiled = (make(name, num_envs=3, **values) for name in ("by_numpy", "by_kernels"))
    assert found.failure_causes == compiled.failure_causes == (*CAUSES, "late")
    assert found.reward_terms == compiled.reward_terms
    seen, wanted = fly(found), fly(compiled)
    assert any((step[3] == FIRST_OWN).all() for step in wanted if len(step) > 2)
    names, order = list(found.observation_names), [found.observation_names.index(n) for n in compiled.observation_names]
    assert sorted(names) == sorted(compiled.observation_names)
    assert (names == list(compiled.observation_names)) == (values.get("env.units") != "cable")  # functions come last
    for own, its in zip(seen, wanted, strict=True):
        assert np.array_equal(own[0][..., order], its[0])
        assert all(np.array_equal(in_order(a), in_order(b)) for a, b in zip(own[1:], its[1:], strict=True))


def test_an_environment_does_not_depend_on_batch_threads_or_others(registries):
    numpy_task()
    whole = fly(build(5, **DISTURBED))
    assert equal(whole, fly(build(5, 3, **DISTURBED)))
    for e in (0, 3):
        config = build(1, **DISTURBED).config
        assert equal(whole, fly(ml.make_vec(config, first_env=e)), slice(e, e + 1))


def test_functions_get_all_environments_on_the_thread_that_steps(registries):
    calls = []

    def late(v):
        calls.append((threading.current_thread(), v.time.shape, v.state.drone_position.shape[0]))
        return v.time > LATE

    numpy_task(FAILURES={"late": late})
    vec = build(6, 3)
    vec.reset(seed=0)
    starts = len(calls)
    vec.step(np.zeros((6, vec.num_drones, vec.action_size)))
    calls_of_step = len(calls) - starts
    vec.step(np.zeros((6, vec.num_drones, vec.action_size)))
    assert {thread for thread, *_ in calls} == {threading.current_thread()}
    assert all(call[1:] == ((1,), 1) for call in calls[:starts])
    assert calls[starts][1:] == ((6,), 6) and calls_of_step == 2  # the first time, one is compared with it alone
    assert len(calls) == starts + calls_of_step + 1


def test_masked_resets_and_saved_states_go_on_bit_for_bit(registries):
    numpy_task()
    vec, copied = build(4, **DISTURBED), None
    vec.reset(seed=1)
    action = np.full((4, vec.num_drones, vec.action_size), 0.1)
    for _ in range(3):
        vec.step(action)
    before = vec.current()[0]
    after = vec.reset(mask=np.array([True, False, False, False]))[0]
    assert np.array_equal(before[1:], after[1:]) and not np.array_equal(before[0], after[0])
    copied, loaded = pickle.loads(pickle.dumps(vec)), build(4, 2, **DISTURBED)
    loaded.reset(seed=9)
    loaded.load_state_dict(vec.state_dict())
    for _ in range(3):
        steps = [each.step(action) for each in (vec, copied, loaded)]
        for other in steps[1:]:
            assert all(np.array_equal(a, b) for a, b in zip(steps[0][:4], other[:4], strict=True))


def test_a_task_may_be_typed_into_a_notebook(registries, capsys):
    exec(compile(CELL, "<ipython-input-1>", "exec"), {"__name__": "__main__"})
    vec = make("pole", num_envs=2, **{"env.episode_seconds": 0.5})
    assert vec.observation_names[-3:] == ("pole_0", "pole_1", "pole_2") and vec.reward_terms[-1] == "clear"
    assert vec.failure_causes[-1] == "pole"
    vec.reset(seed=0)
    vec.world.state.payload_position[0, :2] = 0.6, 0.2
    vec.task.begin(0)
    assert vec.failure_causes[vec.task.cause[0]] == "pole"
    *_, info = vec.step(np.zeros((2, vec.num_drones, vec.action_size)))
    gap = np.linalg.norm(vec.world.state.payload_position[:, :2] - [0.6, 0.0], axis=1)
    assert info["reward_terms"]["clear"] == pytest.approx(0.5 * np.minimum(gap / 0.5, 1.0))
    assert "touch (2,)" in capsys.readouterr().out


@pytest.fixture
def folder(tmp_path, monkeypatch, registries):
    """Enter a folder with a user's module `pole`."""
    (tmp_path / "pole.py").write_text(CELL)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def train_pole(folder, **values):
    """Train for an iteration from the command line, and return the run."""
    small = SMALL | {"train.frames": 128, "eval.episodes": 1} | values
    assert train(["import=pole.py", "config=pole", *(f"{key}={value}" for key, value in small.items())]) == 0
    return next((folder / "runs").glob("pole-*"))


@pytest.mark.slow
def test_such_a_task_is_trained_evaluated_and_exported_from_the_command_line(folder):
    pytest.importorskip("onnxruntime")
    run = train_pole(folder)
    rows = read_metrics(run)
    assert any("clear" in name for name in rows[0])
    short = ["episodes=2", "env.episode_seconds=0.2", "env.num_threads=1"]
    assert evaluate([f"run={run}", "import=pole.py", *short]) == 0
    report = json.loads(next(run.glob("eval/*/metrics.json")).read_text())
    assert report["policy"]["failure_pole_rate"]["mean"] == 0.0
    assert export([f"run={run}", "import=pole.py", f"out={folder / 'out'}"]) == 0
    contract = json.loads((folder / "out" / "policy.json").read_text())
    assert "from the drone to the pole" in json.dumps(contract)
    policy = ml.load_policy(folder / "out" / "policy.onnx")
    assert policy.observation_names[-3:] == ("pole_0", "pole_1", "pole_2")
    flown = run_episodes(ml.load_config("pole", {"env.episode_seconds": 0.2}), policy.bind, 2, seed=0)
    assert len(flown["return"]) == 2


@pytest.mark.slow
def test_workers_collect_from_such_a_task(folder):
    pytest.importorskip("ray")
    assert (train_pole(folder, **{"train.workers": 1}) / "checkpoints" / "last.pt").exists()


def test_torchrl_and_pettingzoo_step_such_a_task(registries):
    numpy_task()
    env = ml.torchrl_env("by_numpy", num_envs=3, num_threads=1, **{"env.episode_seconds": 0.2})
    rolled = env.rollout(12, break_when_any_done=False)
    assert rolled["next", "agents", "observation"].isfinite().all() and rolled["next", "truncated"].any()
    single = ml.parallel_env("by_numpy", **{"env.episode_seconds": 0.2})
    observation, _ = single.reset(seed=0)
    while single.agents:
        observation, *_ = single.step({agent: single.action_space(agent).sample() for agent in single.agents})
    assert observation["drone_0"].shape == single.observation_space("drone_0").shape


def test_failures_have_names_and_rates_in_reports(registries):
    numpy_task()
    config = build(3).config
    report = make_report(config, 0, run_episodes(config, lambda vec: make_scripted("formation", vec), 3, seed=0), {})
    assert report["policy"]["failure_late_rate"]["mean"] == 1.0 and report["policy"]["success_rate"]["mean"] == 0.0


def test_a_start_that_fails_by_a_function_is_drawn_again(registries):
    numpy_task(FAILURES={"low": lambda v: v.state.payload_position[:, 2] < 1.5})
    vec = build(8)
    vec.reset(seed=0)
    assert (vec.world.state.payload_position[:, 2] >= 1.5).all()
    numpy_task(FAILURES={"always": lambda v: v.time > -1.0})
    assert "is free of failure (always)" in refusal(build(2).reset, seed=0)


def test_common_failures_come_first(registries):
    numpy_task(FAILURES={"always": lambda v: v.state.payload_position[:, 2] < 0.5})
    vec = build(2)
    vec.reset(seed=0)
    vec.world.state.payload_position[0, 2] -= 10.0
    vec.task.begin(0)
    assert vec.failure_causes[vec.task.cause[0]] == "out_of_range"


def test_kernels_are_those_of_the_task_without_its_functions(registries):
    numpy_task()
    task = ml.tasks.TASKS["by_numpy"]
    assert compose_observation(task.EXTRA, "reference") is compose_observation((), "reference")
    kernels = compose_reward(task.REWARD, Kernels().is_good, None)
    assert kernels is compose_reward(Hover.REWARD, Kernels().is_good, None)


def test_steps_of_tasks_by_kernels_alone_are_not_divided():
    vec = make("hover", num_envs=4, num_threads=2)
    assert [len(pipeline.parts) for pipeline in vec._pipelines.values()] == [1, 1]
    assert not (vec.task.numpy.plans or vec.task.numpy.judges or vec.task.numpy.observes)


TETRAHEDRON = "v 0 0 0\nv 0.3 0 0\nv 0 0.3 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_what_belongs_to_no_environment_is_whole_and_all_else_is_of_the_rows_asked_for(tmp_path):
    """Seven teams of three: no other array is of seven rows."""
    (tmp_path / "rock.obj").write_text(TETRAHEDRON, encoding="utf-8")
    rocks = [{"shape": "mesh", "mesh": str(tmp_path / "rock.obj"), "position": [x, 3.0, 1.0]} for x in (-2.0, 2.0)]
    given = {"task_options.level": "given", "task_options.start": [-2, 0, 2], "task_options.goal": [2, 0, 2]}
    vec = make("navigate", 7, 3, **given, **{"scene.obstacles": rocks, "scene.reserved": 0, "env.episode_seconds": 14})
    vec.reset(seed=0)

    def compare(record, part):
        for name, value in record._asdict().items():
            seen = getattr(part, name)
            if hasattr(value, "_fields"):
                compare(value, seen)
            elif isinstance(value, np.ndarray):
                expected = value[2:4] if len(value) == 7 else value
                np.testing.assert_array_equal(seen, expected, err_msg=name)
                found.add((name, len(value) == 7))

    found = set()
    compare(vec.task.view, ArrayView(vec.task.view, slice(2, 4)))
    assert {("vertices", False), ("resting_tension", False), ("kind", True), ("start", True)} <= found
