"""Training with several rigs at once (`train.rigs`): one network for teams that differ."""

from __future__ import annotations

from typing import Any

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.schema.training import TrainConfig

_COMMON = ("task", "seed", "train", "eval", "env.num_envs", "env.policy_hz")


def divide_rigs(environment: Config) -> list[Config]:
    """Return the environments that this process steps: one of each rig, with an equal share of all.

    With workers one environment, for sizes and names.

    Raises:
        ConfigError: shares that are not whole; keys that rigs must have in common; rigs together with workers.
    """
    train, total = environment.train, environment.env.num_envs
    if not train.rigs:
        return [build_config(environment.model_dump(), {"env.num_envs": 1})] if train.workers else [environment]
    if train.workers:
        raise ConfigError("train.rigs and train.workers do not go together; set train.workers=0")
    if total % len(train.rigs):
        raise ConfigError(
            f"env.num_envs={total} environments cannot be shared by the {len(train.rigs)} of train.rigs; make it a "
            "multiple of that"
        )
    share = {"env.num_envs": total // len(train.rigs)}
    return [_build(environment, k, rig | share) for k, rig in enumerate(_checked(train.rigs), 1)]


def evaluated_rigs(config: Config) -> list[Config]:
    """Return what a policy is evaluated with: the rigs, in the task's own environment."""
    return [_build(config, k, rig) for k, rig in enumerate(_checked(config.train.rigs), 1)] or [config]


def _build(config: Config, k: int, rig: dict[str, Any]) -> Config:
    try:
        return build_config(config.model_dump(), rig)
    except ConfigError as error:
        raise ConfigError(f"rig {k} of train.rigs: {error}") from error


def _checked(rigs: tuple[dict[str, Any], ...]) -> tuple[dict[str, Any], ...]:
    for rig in rigs:
        for key in rig:
            if key in _COMMON or key.partition(".")[0] in _COMMON:
                raise ConfigError(f"train.rigs cannot hold '{key}', which they have in common; set {key} itself")
    return rigs


def check_rigs(train: TrainConfig, vecs: list[MultiliftVec]) -> None:
    """Refuse, by a ConfigError, rigs whose observations or states one network cannot take."""
    first = vecs[0]
    for vec in vecs[1:]:
        if (vec.observation_names, vec.action_names) != (first.observation_names, first.action_names):
            raise ConfigError(
                "train.rigs differ in what drones observe or act by; leave control.action and env.sensing alike"
            )
        if train.algorithm == "mappo" and vec.state_size != first.state_size:
            raise ConfigError(
                "the critic of mappo sees the global state, whose size depends on the number of drones and on what is "
                "hidden; these train.rigs need train.algorithm=ippo"
            )
