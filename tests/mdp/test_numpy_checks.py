"""What is wrong with the NumPy functions of a task is one sentence, and their view cannot be written."""

import numpy as np
import pytest
from conftest import refusal
from test_numpy_tasks import build, extended, is_late, numpy_task, payload_height, seconds

from multilift_marl.mdp.rewards import Term
from multilift_marl.tasks.base import Kernels


def calls(value):
    """Return a function that returns a value for all environments of its view."""
    return lambda v, *margins: value(len(v.time), *margins)


@pytest.mark.parametrize(
    "declared, words",
    [
        (
            {"FAILURES": {"pole": calls(np.ones)}},
            "task by_numpy: failure 'pole', function <lambda>, returned shape (1,) of float64, expected (1,) of bool, "
            "environment first",
        ),
        ({"FAILURES": {"pole": lambda v: None}}, "returned shape () of object, expected (1,) of bool"),
        ({"REWARD": {"a": Term(1.0, lambda v: v.errors.position)}}, "reward term 'a', function <lambda>, returned"),
        ({"REWARD": {"a": Term(1.0, lambda v: 1.0)}}, "returned shape () of float64, expected (4,) of numbers"),
        ({"REWARD": {"a": Term(1.0, calls(lambda e: np.full(e, np.nan)))}}, "what is not finite in environment 0"),
        (
            {"REWARD": {"a": Term(1.0, lambda v: v.time - v.time.mean() + v.errors.distance.sum())}},
            "for it alone;",
        ),
        ({"REWARD": {"a": Term(1.0, calls(np.random.default_rng(0).random))}}, "among all, but"),
        (
            extended(lambda v: v.estimated.drone_position),
            "component 'odd', function <lambda>, returned shape (1, 4, 3) of",
        ),
        (extended(lambda v: v.action[..., 0]), "returned shape (1, 4) of float64, expected (1, 4, 1) of numbers"),
        (extended(seconds, 3, "slot"), "returned shape (1, 4, 1) of float64, expected (1, 4, 3) of numbers"),
        (extended(payload_height, 3, "target", True), "returned shape (1, 1) of float64, expected (1, 3) of numbers"),
        (
            {"KERNELS": Kernels(plan=lambda v: v.goal.position)},
            "KERNELS.plan, function <lambda>, returned ndarray,",
        ),
        (
            {"KERNELS": Kernels(plan=lambda v: {"place": v.goal.position})},
            "returned ['place'], expected a dict",
        ),
        (
            {"KERNELS": Kernels(plan=lambda v: {"position": v.goal.position, "velocity": v.time})},
            "returned velocity of shape (1,) of float64,",
        ),
    ],
)
def test_what_functions_return_is_checked(registries, declared, words):
    numpy_task(**declared)

    def run():
        vec = build()
        vec.reset(seed=0)
        vec.step(np.zeros((4, vec.num_drones, vec.action_size)))

    assert words in refusal(run)


@pytest.mark.parametrize(
    "declared, words",
    [
        ({"FAILURES": {"pole": lambda e, v: True}}, "FAILURES['pole'] is <function"),
        ({"FAILURES": {"pole": None}}, "FAILURES['pole'] is None; give a function of (e, v) with @inlined"),
        ({"FAILURES": {"wall": is_late}}, "FAILURES holds 'wall', a cause that all tasks have"),
        ({"REWARD": {"a": Term(1.0, is_late, 0.1)}}, "(e, v, margin 1) with @inlined, or a NumPy function "
                                                    "of (v, margin 1)"),
        (extended(lambda e, n, v: 1.0), "(e, n, v) with @inlined, or a NumPy function of (v)"),
        ({"KERNELS": Kernels(plan=lambda e, v: None)}, "KERNELS.plan is <function"),
        ({"KERNELS": Kernels(is_good=is_late)}, "KERNELS.is_good is <function"),
        ({"plan": lambda self, v: None}, "plan is no attribute of a task; give KERNELS = Kernels(plan=...)"),
    ],
)  # fmt: skip
def test_what_is_no_function_is_refused_when_it_is_registered(registries, declared, words):
    assert words in refusal(numpy_task, **declared)


@pytest.mark.parametrize(
    "write",
    [
        lambda v: v.state.payload_position.fill(0.0),
        lambda v: v.goal.position[:1].fill(0.0),
        lambda v: v.settings.__setattr__("bounds", 0.0),
        lambda v: setattr(v, "time", 0.0),
        lambda v: v.resting_tension.fill(0.0),
    ],
)
def test_the_view_is_read_only(registries, write):
    numpy_task(FAILURES={"odd": lambda v: write(v) or is_late(v)})
    with pytest.raises((ValueError, AttributeError), match="read-only"):
        build().reset(seed=0)


def test_the_view_has_the_fields_of_kernels(registries):
    views = []
    numpy_task(FAILURES={"odd": lambda v: views.append(v) or is_late(v)})
    vec = build(3)
    vec.reset(seed=0)
    vec.step(np.zeros((3, vec.num_drones, vec.action_size)))
    whole = next(view for view in views if len(view.time) == 3)
    assert set(dir(whole)) == set(vec.task.view._fields) and "payload_position" in repr(whole.state)
    for name in ("time", "action", "resting_tension", "integral_limit"):
        assert np.array_equal(getattr(whole, name), getattr(vec.task.view, name))
    assert whole.settings.bounds.distance == vec.task.settings.bounds.distance and whole.dt == vec.task.dt
    assert whole.rig.azimuth.shape == (vec.num_drones,) and whole.limits.separation.shape == 2 * (vec.num_drones,)
    assert np.shares_memory(whole.state.payload_position, vec.world.state.payload_position)
    with pytest.raises(AttributeError, match="payload_positions"):
        _ = whole.state.payload_positions
