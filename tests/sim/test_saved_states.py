"""States of environments that were saved: what is none of theirs is refused, and nothing is changed then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import make, same, zeros

from multilift_marl.mdp.failures import FIRST_OWN
from multilift_marl.sim.saved import fingerprint
from multilift_marl.sim.world import World


@pytest.fixture(scope="module")
def vec():
    vec = make(num_envs=2)
    vec.reset(seed=0)
    vec.step(zeros(vec))
    return vec


def spoiled(array, value):
    array = array.copy()
    array.flat[-1] = value
    return array


@pytest.mark.parametrize(
    "key", ["world.rows", "reference.position", "task.observation", "task.time", "world.air.filter"]
)
@pytest.mark.parametrize(
    ("spoil", "complaint"),
    [
        (lambda array: spoiled(array, np.nan), "NaN or infinite"),
        (lambda array: spoiled(array, np.inf), "NaN or infinite"),
        (lambda array: array.astype(np.float16), "dtype float16, expected float"),
        (lambda array: array.tolist(), "is list, expected an array"),
        (lambda array: array[:1], "has shape"),
        (lambda array: None, "is NoneType"),
    ],
)
def test_arrays_that_are_none_of_theirs_are_refused(vec, key, spoil, complaint):
    before = vec.state_dict()
    with pytest.raises(ValueError, match=f"'{key}' .*{complaint}"):
        vec.load_state_dict(before | {key: spoil(before[key])})
    assert same(vec.state_dict(), before)


@pytest.mark.parametrize(
    ("key", "value"),
    [("steps", -1), ("seeds", -5), ("episodes", -2), ("task.cause", 99), ("task.cause", -1), ("task.cause", FIRST_OWN)],
)
def test_counts_that_there_cannot_be_are_refused(vec, key, value):
    before = vec.state_dict()
    with pytest.raises(
        ValueError, match=f"environments: '{key}' holds {value}, not from (0|-1) to .*; give what state_d"
    ):
        vec.load_state_dict(before | {key: spoiled(before[key], value)})
    assert same(vec.state_dict(), before)


@pytest.mark.parametrize(
    ("task", "key", "value"),
    [
        ("loss", "own.who", 4), ("loss", "own.known_who", -1), ("pose", "own.plan.stage", 9),
        ("track", "own.path.kind", 6), ("takeoff", "own.stage", 3), ("land", "own.touch", -1), ("pose", "time", -1e9),
    ],
)  # fmt: skip
def test_a_tasks_own_numbers_stay_within_what_is_indexed_by_them(task, key, value):
    vec = make(task)
    before = vec.state_dict()
    with pytest.raises(ValueError, match=f"'task.{key}' holds {value}, not from 0 to"):
        vec.load_state_dict(before | {f"task.{key}": spoiled(before[f"task.{key}"], value)})
    vec.load_state_dict(before)


@pytest.mark.parametrize(
    ("key", "value"), [("action_delay", 3), ("action_delay", -1), ("observation_delay", 2), ("sent", -1), ("seen", -1)]
)
def test_so_are_delays_longer_than_what_is_remembered(key, value):
    vec = make(num_drones=2, **{"randomization.action_delay": [0, 2], "randomization.observation_delay": [0, 1]})
    vec.reset(seed=0)
    before = vec.state_dict()
    with pytest.raises(ValueError, match=f"'sensing.{key}' holds {value}, not from 0 to"):
        vec.load_state_dict(before | {f"sensing.{key}": spoiled(before[f"sensing.{key}"], value)})


@pytest.mark.parametrize("key", ["more", "world.more", 3])
def test_unknown_and_missing_keys_are_refused(vec, key):
    before = vec.state_dict()
    with pytest.raises(ValueError, match=f"'{key}' is unknown"):
        vec.load_state_dict(before | {key: np.zeros(2)})
    with pytest.raises(ValueError, match="'steps' is missing"):
        vec.load_state_dict({name: array for name, array in before.items() if name != "steps"})


@pytest.mark.parametrize("other", [{"payload.mass": 1.5}, {"cable.stiffness": 2e5}, {"vehicle.drag": [0.1, 0.1, 0.2]}])
def test_the_state_of_another_system_is_refused(vec, other):
    other = make(num_envs=2, **other)
    for one, two in ((vec, other), (vec.world, other.world)):
        with pytest.raises(ValueError, match=r"system' is that of another; use the configuration it was saved with"):
            one.load_state_dict(two.state_dict())
    World(vec.config.system, 2, 1).load_state_dict(vec.world.state_dict())


@pytest.mark.parametrize(
    "other",
    [
        {"control.action": "ctbr"},
        {"control.action": "velocity"},
        {"control.position_frequency": 2.0},
        {"env.units": "cable"},
    ],
)
def test_the_state_under_another_controller_is_refused(vec, other):
    """Its last action and filters would mean something else."""
    saved = make(num_envs=2, **other).state_dict()
    before = vec.state_dict()
    with pytest.raises(ValueError, match=r"is that of another|has shape"):
        vec.load_state_dict(saved)
    assert same(vec.state_dict(), before)
    vec.load_state_dict({key: array for key, array in before.items() if key != "control"})  # of an older version


def test_a_state_kept_in_a_file_is_loaded_from_it(vec, tmp_path):
    """What NumPy reads of an archive is a mapping, and no dict."""
    before = vec.state_dict()
    np.savez(tmp_path / "state.npz", **before)
    other = make(num_envs=2)
    with np.load(tmp_path / "state.npz") as saved:
        other.load_state_dict(saved)
    assert same(other.state_dict(), before)
    with pytest.raises(ValueError, match="is missing"):
        vec.load_state_dict(["steps"])


def test_an_environment_that_diverged_may_hold_anything(vec):
    saved = vec.state_dict()
    saved["world.diverged"] = np.array([False, True])
    saved["world.rows"] = spoiled(saved["world.rows"], np.nan)
    other = make(num_envs=2)
    other.load_state_dict(saved)
    assert np.isnan(other.state_dict()["world.rows"][1, -1])


def test_a_state_fits_in_every_process():
    """The order of a set follows hashes, which differ between processes, and the order of what was added."""
    assert str(frozenset((0, 8))) != str(frozenset((8, 0)))
    system = make().config.system
    expected, found = (fingerprint(replace(system, varied=frozenset(order)), 1) for order in ((0, 8), (8, 0)))
    assert same(found, expected)
    assert not same(fingerprint(replace(system, varied=frozenset((0,))), 1), expected)
