"""Tasks as tables: weights and margins are configuration, components are written, the order of a step can be read."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import load_script, make, refusal, same, zeros

from multilift_marl.agents.environments import training_environment
from multilift_marl.config.load import build_config, load_config
from multilift_marl.kernels import jit
from multilift_marl.kernels.jit import compose, inlined, kernel
from multilift_marl.mdp.observations import Component, own_velocity
from multilift_marl.mdp.rewards import Term
from multilift_marl.tasks import TASKS
from multilift_marl.tasks.hover import Hover


@inlined
def not_a_number(e, v):
    """Not a number in the last environment."""
    return np.nan if e == v.time.shape[0] - 1 else 0.0


def paid(vec, **errors):
    """Return the reward terms of one environment whose payload's errors are these."""
    for name, value in errors.items():
        getattr(vec.task.errors, name)[0] = value
    vec.task.stages["reward"](0, 1)
    return dict(zip(vec.reward_terms, vec.task.terms[0].tolist(), strict=True))


@pytest.fixture(scope="module")
def resting():
    vec = make("hover", num_envs=1, **{"task_options.start_speed": 0.0})
    vec.reset(seed=0)
    return vec


@pytest.mark.parametrize(
    ("term", "error", "margin", "weight"),
    [
        ("position", "distance", 0.25, 0.4),
        ("precision", "distance", 0.01, 0.25),
        ("attitude", "angle", np.radians(6.0), 0.15),
        ("level", "angle", np.radians(1.0), 0.1),
    ],
)
def test_a_term_is_its_weight_without_error_and_half_of_it_at_its_margin(resting, term, error, margin, weight):
    for size, share in ((0.0, 1.0), (margin, 0.5), (3 * margin, 0.1)):
        assert paid(resting, **{error: size})[term] == pytest.approx(share * weight)


def test_of_training_alone_too_a_bare_weight_leaves_the_margin():
    given = {"reward.attitude": {"weight": 1.0, "margin": 40.0}}
    config = load_config("hover", {"train.overrides": given})
    changed = build_config(config.model_dump(), {"train.overrides": {"reward.attitude": 2.0}})
    trained = training_environment(changed)
    assert trained.reward["attitude"].model_dump() == {"weight": 2.0, "margin": (40.0,)}


def test_weight_and_margins_are_configuration():
    bare = make("hover", num_envs=1, **{"reward.position": 0.7})
    long = make("hover", num_envs=1, **{"reward.position.weight": 0.7, "reward.position.margin": 0.5})
    both = make("hover", num_envs=1, **{"reward.stillness.margin": [1.0, 2.0], "reward.attitude.margin": [12.0]})
    for vec in (bare, long, both):
        vec.reset(seed=0)
    assert paid(bare, distance=0.25)["position"] == pytest.approx(0.35)
    assert paid(long, distance=0.5)["position"] == pytest.approx(0.35)
    assert paid(both, angle=np.radians(12.0))["attitude"] == pytest.approx(0.075)
    both.world.state.payload_velocity[0], both.world.state.payload_body_rates[0] = [0, 1.0, 0], [0, 0, 2.0]
    assert paid(both)["stillness"] == pytest.approx(0.1 / 4)
    mixed = load_config("hover", {"reward.position": 0.7, "reward.position.margin": 0.5, "reward.level": 0.3})
    assert mixed.reward["position"].model_dump() == {"weight": 0.7, "margin": (0.5,)}
    later = build_config(mixed.model_dump(), {"reward.position": 0.9})  # the weight alone
    assert later.reward["position"].model_dump() == {"weight": 0.9, "margin": (0.5,)}
    stored = load_config("hover", {"reward.position.margin": [0.5], "reward.level": 0.3}).model_dump()["reward"]
    assert stored == {
        "position": {"weight": None, "margin": (0.5,)}, "level": {"weight": 0.3, "margin": None},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("reward.positoin", 1.0, "unknown key 'reward.positoin' of task hover; did you mean 'reward.position'"),
        ("reward.position.wieght", 1.0, "unknown key 'reward.position.wieght'"),
        ("reward.position", "much", "reward.position"),
        ("reward.position.margin", [0.0], "reward.position.margin"),
        ("reward.position.margin", 0.0, "reward.position.margin"),
        ("reward.position.margin", "wide", "reward.position.margin must be a list, but is 'wide'"),
        ("reward.position.margin", [0.1, 0.2], "reward.position.margin lists 2 numbers, but the term has 1"),
        ("reward.action_rate.margin", [0.1], "reward.action_rate.margin lists 1 numbers, but the term has 0"),
    ],
)
def test_what_cannot_be_a_term_is_refused(key, value, complaint):
    assert re.search(complaint, refusal(make, "hover", num_envs=1, **{key: value}))


def test_every_task_states_unit_and_margin_of_its_terms(task):
    for name, term in TASKS[task].REWARD.items():
        assert bool(term.unit) == bool(term.margins), name
        assert all(margin > 0 for margin in term.margins)


@pytest.mark.parametrize("where", ["EXTRA", "EXTRA_STATE"])
def test_a_component_that_is_not_written_is_refused_by_name(where, registries):
    class Broken(Hover):
        name = "broken"

    setattr(Broken, where, (Component("missing", 3, "slot", "m", "never a number", own_velocity),))
    TASKS["broken"] = Broken
    vec = make(load_config("hover", {"task": "broken"}), num_envs=1)
    vec.reset(seed=0)
    vec.world.state.drone_velocity[:] = np.nan
    vec._checked = False
    said = refusal(lambda: vec._observe(0) or vec.task.check_written(0))
    assert "is not finite; mend what computes it" in said


def test_a_reward_that_is_not_finite_is_refused_by_name(registries):
    class Broken(Hover):
        name = "broken"
        REWARD = Hover.REWARD | {"broken": Term(1.0, not_a_number)}

    TASKS["broken"] = Broken
    vec = make(load_config("hover", {"task": "broken"}), num_envs=3)
    vec.reset(seed=0)
    said = refusal(vec.step, zeros(vec))
    assert "reward term broken is not finite in environment 2; mend what computes it" in said


@pytest.mark.slow
def test_the_stages_of_a_step_can_be_read_and_reading_changes_nothing():
    vec = make("pose", num_envs=2, **{"randomization.action_delay": 1, "randomization.observation_noise": "standard",
                                      "control.disturbance": "indi", "env.history": 2})  # fmt: skip
    vec.reset(seed=0)
    vec.step(zeros(vec))
    before = vec.state_dict()
    lines = vec.describe(steps=2).splitlines()[1:]
    names = [line[:24].strip() for line in lines]
    assert names == [
        "delay action", "set action", "to goal frame", "advance plan", "set action", "smooth moving", "estimate force",
        "fly", "physics", "errors and failures", "reward", "observe state", "sense", "observe", "stack",
    ]  # fmt: skip
    assert all(float(line.split()[-2]) > 0 for line in lines)
    assert same(vec.state_dict(), before)


def test_the_reference_of_the_tasks_is_what_the_code_says():
    """A default, a weight, a component does not change unnoticed."""
    tables = load_script("docs/task_tables")
    page = tables.PAGE.read_text(encoding="utf-8")
    assert tables.fill(page) == page, "docs/tasks.md is not up to date: python docs/task_tables.py"
    assert len(re.findall(r"<!-- table of \w+ -->", page)) == len(tables.contents())


@inlined
def doubled_sum(values):
    return (values + values).sum()


@kernel
def doubled(values):
    return values + values


@pytest.mark.few_tasks
def test_kernels_composed_of_the_package_s_own_count_no_references(task, monkeypatch):
    """Where they do, each call that is handed a view counts those of all of its arrays: three times the compilation."""
    counted, compile_one = {}, jit._compile

    def note(function, makes_arrays=None, **options):
        counted[function.__name__] = makes_arrays
        return compile_one(function, makes_arrays, **options)

    monkeypatch.setattr(jit, "_compile", note)
    jit._compose.cache_clear()
    make(task, num_envs=1)
    assert {"observe", "observe_state", "reward"} <= counted.keys()
    assert [name for name, counts in counted.items() if counts] == []


def test_kernels_from_outside_the_package_may_make_arrays():
    source = "def total(values):\n    return doubled_sum(values)\n"
    assert compose("total", source, {"doubled_sum": doubled_sum})(np.ones(3)) == 6.0
    assert doubled(np.ones(3)).tolist() == [2.0, 2.0, 2.0]
