"""Every key of `randomization`, alone, with and without every other one, and in every task: episodes start and fly."""

from __future__ import annotations

from functools import cache
from itertools import combinations, product

import numpy as np
import pytest
from conftest import zeros

import multilift_marl as ml
from multilift_marl.config.load import list_configs
from multilift_marl.schema.sections import RandomizationConfig

WIDTHS = {key: 0.04 for key in RandomizationConfig.model_fields} | {
    "payload_center_of_mass": (0.004, 0.003, 0.002), "observation_noise": "standard", "observation_bias": 0.5,
    "observation_delay": (0, 2), "action_delay": (1, 2),
}  # fmt: skip
EXTENT = ("payload_inertia", "payload_center_of_mass")  # which a point has not
NOISE = ("observation_noise", "observation_bias")  # which sensors have of their own
OFF = {f"randomization.{key}": field.default for key, field in RandomizationConfig.model_fields.items()}
KINDS = {
    "massless": ("hover", {}),
    "chain": ("hover", {"cable.model": "chain", "cable.segments": 3}),
    "point": ("rigs/crazyflie2", {}),
}


@cache
def chosen() -> list[str]:
    """Return configurations in which each task and each action interface occurs."""
    tasks, actions, found = set(), set(), []
    for name in list_configs():
        config = ml.load_config(name)
        if config.task not in tasks or config.control.action not in actions:
            found.append(name)
            tasks.add(config.task)
            actions.add(config.control.action)
    return found


def keys(config: str) -> list[str]:
    """Return the keys that a configuration allows."""
    settings = ml.load_config(config)
    without = EXTENT if settings.payload.shape == "point" else ()
    without += NOISE if settings.env.sensing != "ideal" else ()
    return [key for key in WIDTHS if key not in without]


def sets(names: list[str]) -> list[tuple[str, ...]]:
    """Return eight sets of up to 35 names: of any two names, one set has both, one neither, and one each alone.

    Each name is in four sets, the first among them, and no two in the same four: any two share a set and leave one out.
    """
    members = combinations(range(8), 4)
    of = {name: next(members) for name in names}
    assert all(0 in each for each in of.values())
    return [tuple(name for name in names if number in of[name]) for number in range(8)]


def fly(config: str, varied: tuple[str, ...], **overrides) -> None:
    """Start two episodes with these keys alone, twice, and fly two steps of each."""
    if ml.load_config(config).wind.turbulence:  # which needs a mean wind
        overrides = {"wind.velocity": [1.0, 0.0, 0.0], **overrides}
    drawn = OFF | {f"randomization.{key}": WIDTHS[key] for key in varied}
    vec = ml.make_vec(config, num_envs=2, num_threads=1, **drawn, **overrides)
    for _ in range(2):
        vec.reset()
        for _ in range(2):
            observation, reward, *_, info = vec.step(zeros(vec))
        assert np.isfinite(observation).all() and np.isfinite(reward).all()
        assert not info["diverged"].any()


@pytest.mark.slow
@pytest.mark.parametrize("config", chosen())
def test_keys_in_every_task_and_with_every_action(config):
    """Each set is compiled anew, in half a minute: another one in each configuration."""
    fly(config, sets(keys(config))[chosen().index(config) % 8])


@pytest.mark.slow
def test_every_key_alone():
    config, overrides = KINDS["massless"]
    for key in keys(config):
        fly(config, (key,), **overrides)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_key_with_and_without_every_other(kind):
    config, overrides = KINDS[kind]
    names = keys(config)
    flown = sets(names)
    for one, other in combinations(names, 2):
        assert {(one in each, other in each) for each in flown} == set(product((False, True), repeat=2))
    for each in flown:
        fly(config, each, **overrides)
