"""Every key of `randomization`, alone, in pairs, and among others in every task: episodes start and fly."""

from __future__ import annotations

from functools import cache
from itertools import combinations

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
def one_of_each() -> list[str]:
    """Return a configuration of each task with each of its action interfaces."""
    loaded = {name: ml.load_config(name) for name in list_configs()}
    return list({(each.task, each.control.action): name for name, each in loaded.items()}.values())


def keys(config: str) -> list[str]:
    """Return the keys that a configuration allows."""
    settings = ml.load_config(config)
    without = EXTENT if settings.payload.shape == "point" else ()
    without += NOISE if settings.env.sensing != "ideal" else ()
    return [key for key in WIDTHS if key not in without]


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
@pytest.mark.parametrize("config", one_of_each())
def test_half_of_the_keys_in_every_task(config):
    """Each set is compiled anew, in half a minute: so half of the keys go together, others in each task."""
    order = np.random.default_rng(one_of_each().index(config)).permutation(keys(config))
    fly(config, tuple(map(str, order[: len(order) // 2])))


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_every_key_alone(kind):
    config, overrides = KINDS[kind]
    for key in keys(config):
        fly(config, (key,), **overrides)


@pytest.mark.slow
def test_every_pair_of_keys():
    config, overrides = KINDS["massless"]
    for pair in combinations(keys(config), 2):
        fly(config, pair, **overrides)
