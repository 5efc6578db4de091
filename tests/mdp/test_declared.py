"""What a task of one's own declares, and its kernels: a mistake is refused in one sentence that says where it is."""

import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.kernels import inlined
from multilift_marl.mdp.initial_states import StartOptions
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import Term, distance
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.hover import Hover


@inlined
def nothing(e, n, v):
    """Nothing."""
    return 0.0


@inlined
def misspelt(e, v):
    """Nothing."""
    return v.resting_tensions


OWN = Component("mine", 1, "-", "-", "nothing", nothing)


@pytest.mark.parametrize(
    "declared, message",
    [
        ({"start": Task.start}, "it has no start(self, env, rng, mass)"),
        ({"Options": dict}, "Options is <class 'dict'>; derive"),
        ({"REWARD": (1.0,)}, "REWARD is (1.0,); give a dict"),
        ({"REWARD": {"near": 1.0}}, "REWARD['near'] is 1.0; give Term"),
        ({"REWARD": {"total": Term(1.0, nothing)}}, "REWARD holds 'total', the name of the sum of all terms"),
        ({"REWARD": {"a.b": Term(1.0, nothing)}}, "REWARD holds 'a.b'; give words of letters, digits and _"),
        ({"EXTRA": (OWN._replace(name="a b"),)}, "EXTRA has a component 'a b'; give words of letters, digits and _"),
        ({"REWARD": {"near": Term(1.0, "distance")}}, "REWARD['near'].value is 'distance'; give a function"),
        ({"REWARD": {"near": Term(1.0, lambda e, v: 1.0)}}, "a function of (e, v) with @inlined"),
        ({"REWARD": {"near": Term(1.0, distance)}}, "; give a function of (e, v) with @inlined"),
        ({"REWARD": {"near": Term(1.0, misspelt, 0.1)}}, "<function misspelt at 0x"),
        ({"EXTRA": (OWN._replace(value=misspelt),)}, "; give a function of (e, n, v) with @inlined"),
        ({"KERNELS": None}, "KERNELS is None; give"),
        ({"KERNELS": Kernels(plan="sway")}, "KERNELS.plan is 'sway'; give a function"),
        ({"KERNELS": Kernels(is_good=None)}, "KERNELS.is_good is None"),
        ({"EXTRA": OWN._replace(size=2)}, "EXTRA holds 'mine'"),
        ({"EXTRA": [OWN]}, "EXTRA is [Component("),
        ({"EXTRA": (OWN, OWN)}, "EXTRA has 2 components 'mine'"),
        ({"EXTRA": (OWN._replace(name="velocity"),)}, "component 'velocity', as observations of all tasks do"),
        ({"EXTRA": (OWN._replace(frame="slots"),)}, "unknown frame 'slots'; did you mean 'slot'?"),
        ({"EXTRA": (OWN._replace(size=3, frame="target"),)}, "of EXTRA is turned into the slot frame, not 'target'"),
        ({"EXTRA_STATE": (OWN._replace(size=3, frame="slot"),)}, "is turned into the target frame, not 'slot'; say"),
        ({"EXTRA_STATE": (OWN._replace(size=0),)}, "component 'mine' has size 0"),
        ({"EXTRA_STATE": (OWN._replace(size=True),)}, "component 'mine' has size True"),
        ({"EXTRA": (OWN._replace(value=None),)}, "component 'mine' has value None"),
    ],
)
def test_what_a_task_declares_is_checked_when_it_is_registered(registries, declared, message):
    message_given = refusal(ml.register_task, type("Odd", (Hover,), {"name": "odd", **declared}))
    assert message_given.startswith("task odd: ") and message in message_given
    assert "odd" not in ml.list_tasks()


@inlined
def mixed(e, v):
    """Nothing."""
    return v.time[e] + "s"


@inlined
def unknown(e, v):
    """Nothing."""
    return nowhere  # noqa: F821


@pytest.mark.parametrize(
    "declared, words",
    [
        ({"REWARD": {"odd": Term(1.0, misspelt)}}, "'resting_tensions' of type View (|test_declared.py|return v.rest"),
        ({"REWARD": {"odd": Term(1.0, mixed)}}, "add(float64, Literal[str](s)) (|test_declared.py|return v.time[e]"),
        ({"REWARD": {"odd": Term(1.0, unknown)}}, "'nowhere' is not defined"),
        ({"KERNELS": Kernels(update=misspelt)}, "'resting_tensions' of type View (|test_declared.py"),
        ({"EXTRA": (OWN._replace(size=2),)}, "<observe |own[at + 0], own[at + 1] = mine_"),
    ],
)
def test_kernels_that_cannot_be_compiled_are_refused_in_a_sentence(registries, declared, words):
    ml.register_task(type("Odd", (Hover,), {"name": "odd", **declared}))
    message = refusal(ml.make_vec, "odd", num_envs=1, num_threads=1)
    assert message.startswith("kernel ") and " cannot be compiled: " in message
    assert all(word in message for word in words.split("|")) and "\n" not in message and "\x1b" not in message


def test_a_task_needs_bounds_of_success(registries):
    ml.register_task(type("Boundless", (Hover,), {"name": "boundless", "Options": StartOptions}))
    message = "the task's Options have no success_distance; add the field, or override prepare() to set `settings`"
    assert refusal(ml.make_vec, "boundless", num_envs=1) == message
