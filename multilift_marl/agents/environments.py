"""The environments that a training steps: those of its rigs, in this process or in workers, and rollouts in them."""

from __future__ import annotations

from multilift_marl.agents.dagger import DaggerRollouts, check_dagger
from multilift_marl.agents.diffmpc import DiffMpcRollouts, check_diffmpc
from multilift_marl.agents.learning_rollouts import LearningRollouts
from multilift_marl.agents.mappo import Learner, StochasticPolicy, check_communication
from multilift_marl.agents.rigs import check_rigs, divide_rigs
from multilift_marl.agents.rollouts import RigRollouts, Rollouts
from multilift_marl.agents.workers import Workers
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import TRAINING
from multilift_marl.envs.torchrl_env import MultiliftEnv
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import check_interface


def training_environment(config: Config) -> Config:
    """Return the configuration that a policy is trained in: with `train.overrides`.

    Raises:
        ConfigError: they change what is not of the environment; or it is none in which this policy can be.
    """
    for key in config.train.overrides:
        if key.partition(".")[0] in ("task", "seed", "train", "eval"):
            raise ConfigError(f"train.overrides changes the environment and cannot hold '{key}'; set {key} itself")
    try:
        environment = build_config(config.model_dump(), config.train.overrides)
    except ConfigError as error:
        raise ConfigError(f"train.overrides: {error}") from error
    check_communication(config.train, config.env)
    check_environment(environment)
    if config.train.algorithm == "dagger":
        check_dagger(config.train)
    return environment


def check_environment(environment: Config) -> None:
    """Refuse, by a ConfigError, an environment in which no policy can be trained as `train` says."""
    train, action = environment.train, environment.control.action
    check_interface(train.residual, action, "train.residual")
    check_communication(train, environment.env)
    if train.algorithm == "diffmpc":
        check_diffmpc(train, action, environment.planner)


def make_envs(environment: Config, purpose: int = TRAINING) -> list[MultiliftEnv]:
    """Return the environments of each rig; with workers one of each, for sizes and names.

    Args:
        environment: see `training_environment`.
        purpose: of the seeds.

    Raises:
        ConfigError: see `divide_rigs`, `check_rigs` and `MultiliftVec`.
    """
    rigs, memory = divide_rigs(environment), environment.train.gru
    envs = [MultiliftEnv(rig, purpose, k * rig.env.num_envs, memory) for k, rig in enumerate(rigs)]
    check_rigs(environment.train, [env.vec for env in envs])
    return envs


def make_rollouts(
    environment: Config, envs: list[MultiliftEnv], learner: Learner
) -> Rollouts | RigRollouts | Workers | LearningRollouts:
    """Return the rollouts of a learner's policy in what `make_envs` returned."""
    train, total = environment.train, environment.env.num_envs
    if train.algorithm == "diffmpc":
        return DiffMpcRollouts(envs[0], learner, total)
    if train.algorithm == "dagger":
        return DaggerRollouts(envs, learner, total)
    if train.workers:
        return Workers(environment, learner.actor, envs[0].vec.purpose)
    policies = [learner.policy, *(StochasticPolicy(learner.actor) for _ in envs[1:])]
    parts = [Rollouts(env, own, train.horizon, total, len(envs)) for env, own in zip(envs, policies, strict=True)]
    return RigRollouts(parts) if train.rigs else parts[0]
