"""What kernels of a task of one's own write counts: failures of their own, and all that they use by closure."""

import json
from types import ModuleType

import numpy as np
import pytest
from conftest import make, refusal

import multilift_marl as ml
from multilift_marl.evaluation.metrics import format_table, make_report
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.kernels import cache as _kernel_cache
from multilift_marl.kernels.jit import compose, inlined
from multilift_marl.math3d import put
from multilift_marl.mdp.env_data import reduce_view
from multilift_marl.mdp.failures import CAUSES, FIRST_OWN
from multilift_marl.mdp.rewards import Term, distance
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.tasks import TASKS
from multilift_marl.tasks import task_checks as declared_checks
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.hover import Hover

LATE = 0.31  # [s]


@inlined
def run_out(e, v):
    """Fail by the second cause of one's own after `LATE`."""
    if v.time[e] > LATE:
        v.cause[e] = FIRST_OWN + 1


@inlined
def beyond(e, v):
    """Write a cause that nobody has named."""
    if v.time[e] > LATE:
        v.cause[e] = FIRST_OWN + 2


@inlined
def negative(e, v):
    """Write a cause that there cannot be."""
    if v.time[e] > LATE:
        v.cause[e] = -1


@inlined
def begun(e, v):
    """Fail at every start."""
    v.cause[e] = FIRST_OWN


@inlined
def push(e, v):
    """Push the payload, by what is only a copy of the simulation's state."""
    state = v.state
    state.payload_velocity[e, 0] += 1.0


@inlined
def cut(e, v):
    """Take weight off."""
    put(v.parameters.payload_mass[e], (1.0, 0.0, 0.0))


@inlined
def pay(e, v):
    """Pay more."""
    v.terms[e, 0] = 1.0


@inlined
def cut_loose(e, v):
    """Lose a drone and blow on the payload, which physics follows."""
    v.state.cable_broken[e, 0] = v.disturbances.motors_off[e, 0] = True
    v.disturbances.payload_force[e, 0] = 1.0


@inlined
def near(e, v):
    """Come near."""
    errors = v.errors
    errors.distance[e] = 0.0


@inlined
def drop(e, v):
    """Do so."""
    cut(e, v)


class Obstacle(Hover):
    """Hover, with failures of its own."""

    name = "obstacle"
    FAILURES = ("obstacle", "too_late")
    KERNELS = Kernels(check=run_out)


def of(**declared):
    """Register the task with other attributes, and return two environments of it."""
    ml.register_task(type("Odd", (Obstacle,), declared))
    return make("obstacle", num_envs=2, **{"env.episode_seconds": 0.5})


def fly(vec, steps=50):
    """Step by zeros until an episode ends; return the last step and its number."""
    vec.reset(seed=0)
    for step in range(1, steps + 1):
        outcome = vec.step(np.zeros((vec.num_envs, vec.num_drones, vec.action_size)))
        if (outcome[2] | outcome[3]).any():
            return step, outcome
    raise AssertionError("no end")


@pytest.mark.parametrize("stage", ["check", "plan", "update", "preview"])
def test_a_failure_counts_whichever_kernel_finds_it(registries, stage):
    vec = of(KERNELS=Kernels(**{stage: run_out}))
    step, (_, _, terminated, truncated, info) = fly(vec)
    assert step == 16  # the first step that ends after `LATE`
    assert terminated.all() and not truncated.any() and info["failure"].all() and not info["success"].any()
    assert [vec.failure_causes[cause] for cause in info["failure_cause"]] == ["too_late", "too_late"]
    vec.reset(mask=np.array([True, False]))
    assert vec.task.cause.tolist() == [0, FIRST_OWN + 1]


def test_time_goes_on_in_tasks_without_a_plan(registries):
    vec = of(KERNELS=Kernels())
    step, (_, _, _, truncated, _) = fly(vec)
    assert truncated.all() and vec.task.time == pytest.approx(step / 50)


def test_common_failures_are_found_beside_ones_own(registries):
    vec = of(KERNELS=Kernels(check=run_out))
    vec.reset(seed=0)
    vec.world.state.payload_position[0, 2] -= 10.0
    vec.task.begin(0)
    assert vec.failure_causes[vec.task.cause[0]] == "out_of_range"


def test_a_start_that_fails_by_ones_own_cause_is_drawn_again(registries):
    vec = of(KERNELS=Kernels(check=begun))
    assert "is free of failure (obstacle)" in refusal(vec.reset, seed=0)


@pytest.mark.parametrize("kernel, cause", [(beyond, FIRST_OWN + 2), (negative, -1)])
def test_a_cause_that_is_not_declared_is_refused(registries, kernel, cause):
    vec = of(KERNELS=Kernels(check=kernel))
    message = refusal(fly, vec)
    assert message == (
        f"task obstacle wrote {cause} as the cause of a failure in environment 1; causes are 1 to {FIRST_OWN + 1}: "
        f"those of failures.CAUSES, then its own FAILURES from failures.FIRST_OWN = {FIRST_OWN} on"
    )


def test_ones_own_causes_have_rates_and_rows(registries):
    vec = of(KERNELS=Kernels(check=run_out))
    assert vec.failure_causes == (*CAUSES, "obstacle", "too_late")
    flown = run_episodes(vec.config, lambda vec: make_scripted("formation", vec), 3, seed=0)
    report = make_report(vec.config, 0, flown, {"formation": flown})
    for summary in (report["policy"], report["baselines"]["formation"]):
        assert summary["failure_too_late_rate"]["mean"] == 1.0 and summary["failure_obstacle_rate"]["mean"] == 0.0
        assert summary["success_rate"]["mean"] == 0.0
    assert "| too late [%] " in format_table(report)
    json.dumps(report)


@pytest.mark.parametrize(
    "declared, words",
    [
        ({"FAILURES": "obstacle"}, "FAILURES is 'obstacle'; give a tuple of names, ('hit_wall',) for one"),
        ({"FAILURES": ("hit it",)}, "FAILURES holds 'hit it'; give words of letters, digits and _"),
        ({"FAILURES": ("wall",)}, "FAILURES holds 'wall', a cause that all tasks have"),
        ({"FAILURES": ("a", "a")}, "FAILURES holds 'a' twice"),
        ({"check": run_out}, "check is no attribute of a task; give KERNELS = Kernels(check=...)"),
        ({"plan": lambda self, e, v: None}, "plan is no attribute of a task; give KERNELS = Kernels(plan=...)"),
        ({"update": staticmethod(run_out)}, "update is no attribute of a task; give KERNELS = Kernels(update=...)"),
        ({"KERNEL": Kernels(check=run_out)}, "KERNEL is no attribute of a task; did you mean 'KERNELS'?"),
        ({"REWARDS": {}}, "REWARDS is no attribute of a task; did you mean 'REWARD'?"),
        ({"EXTRAS": ()}, "EXTRAS is no attribute of a task; did you mean 'EXTRA'?"),
        ({"suceeded": lambda self: True}, "suceeded is no attribute of a task; did you mean 'succeeded'?"),
        ({"KERNELS": Kernels(check=push)}, "push writes v.state.payload_velocity, which is overwritten or never"),
        ({"KERNELS": Kernels(plan=drop)}, "cut writes v.parameters.payload_mass, which"),
        ({"KERNELS": Kernels(check=pay)}, "pay writes v.terms, which is overwritten"),
        ({"KERNELS": Kernels(plan=near)}, "near writes v.errors.distance, which is overwritten"),
        ({"KERNELS": Kernels(update=pay, check=near, plan=cut_loose)}, ""),  # which count
        ({"reach": 3.0, "LIMIT": 2, "widen": lambda self: None}, ""),
        ({"REWARD": {"a": Term(1.0, distance, 5.0, "degrees")}}, "unit 'degrees'"),
        ({"REWARD": {"a": Term(1.0, distance, 5.0, "deg/s")}}, "unit 'deg/s'"),
    ],
)
def test_what_would_be_ignored_is_refused_when_it_is_registered(registries, declared, words):
    kind = type("Odd", (Obstacle,), declared)
    if words:
        assert words in refusal(ml.register_task, kind)
    else:
        ml.register_task(kind)


def test_arrays_that_are_replaced_after_they_were_handed_to_kernels_are_refused(registries):
    def start(self, env, rng, mass):
        self.settings = ()
        Hover.start(self, env, rng, mass)

    vec = of(KERNELS=Kernels(), start=start)
    assert refusal(vec.reset, seed=0) == (
        "task obstacle replaced `settings` after prepare(), which its kernels never see; write into its arrays in place"
    )


def make_check(radius):
    """Return kernels of one source and different closures."""

    @inlined
    def near(e, v):
        return v.errors.distance[e] < radius

    @inlined
    def check(e, v):
        if not near(e, v):
            v.cause[e] = FIRST_OWN

    return check


def test_fields_that_are_used_by_closure_are_kept(registries):
    vec = make("hover", num_envs=2)
    view = reduce_view(vec.task.view, make_check(0.5))
    assert view.errors.distance is vec.task.errors.distance and view.cause is vec.task.cause and view.reference is None


@pytest.mark.slow
def test_kernels_of_a_factory_act_by_their_own_numbers(registries):
    ends = []
    for radius in (1e-6, 2.9):
        vec = of(KERNELS=Kernels(check=make_check(radius)))
        try:
            vec.reset(seed=0)
        except ml.errors.ConfigError as error:
            ends.append("(obstacle)" in str(error))
        else:
            ends.append("flies")
    assert ends == [True, "flies"]


def test_names_of_compiled_code_hold_all_that_it_is_made_of():
    def digest(check):
        composed = compose("check", "def check(e, v):\n    own(e, v)\n", {"own": check})
        return _kernel_cache.foreign_digest(composed.py_func)

    def typed(text):
        scope = {"__name__": "__main__", "inlined": inlined}
        exec(compile(text, "<stdin>", "exec"), scope)
        return scope["check"]

    assert digest(make_check(0.5)) == digest(make_check(0.5)) != digest(make_check(0.6))
    bodies = [f"@inlined\ndef check(e, v):\n    v.cause[e] = {number}\n" for number in (1000, 2000)]
    assert digest(typed(bodies[0])) == digest(typed(bodies[0])) != digest(typed(bodies[1]))


def test_values_of_modules_within_modules_are_found():
    package, part = ModuleType("package"), ModuleType("package.part")
    package.part, part.reach, part.other = part, 0.5, 0.7

    def inner():
        return package.part.reach + radii[0]

    radii = (0.25,)
    found = dict(_kernel_cache.used_values(inner))
    assert found["package.part.reach"] == 0.5 and found["radii[0]"] == 0.25 and 0.7 not in found.values()


@pytest.mark.parametrize("name", sorted(TASKS))
def test_no_shipped_task_writes_or_declares_in_vain(monkeypatch, name):
    monkeypatch.setattr(declared_checks, "_is_ours", lambda function: False)
    found = []
    for kernel, lost in declared_checks._kernels(TASKS[name]):
        for function in declared_checks._own_functions(kernel):
            found += declared_checks._find_lost_writes(function, lost)
    assert found == [] and list(declared_checks._find_strays(TASKS[name])) == []


def test_helpers_of_ones_own_may_have_the_names_of_kernels():
    def update(self):
        """Note something."""

    def check(self, value):
        """Look at something."""

    own = type("Own", (Task,), {"update": update, "check": check, "plan": list})
    assert list(declared_checks._find_strays(own)) == []
