"""A curriculum (`train.stages`): environments that a training goes through before its own."""

from __future__ import annotations

from typing import Any

from multilift_marl.agents.environments import check_environment, training_environment
from multilift_marl.agents.policy import first_difference
from multilift_marl.agents.rigs import divide_rigs
from multilift_marl.agents.rollouts import NOISE
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.config.precedence import leaves
from multilift_marl.envs.core import TRAINING, MultiliftVec
from multilift_marl.errors import CheckpointError, ConfigError
from multilift_marl.schema.training import Stage

_OWN = ("task", "seed", "train", "eval")


class Curriculum:
    """The stages of a training, and which one it is in.

    Args:
        config: of the training; without stages there is its own environment alone.
        content: of the checkpoint of a training that goes on, which holds what `state` returned.

    Attributes:
        number: of stages that are over; that of all where training is in its own environment.
        began: iteration at which the present one began.

    Raises:
        ConfigError: a stage that cannot be, or whose environment one network cannot act in with that of the others.
        CheckpointError: a checkpoint without such a stage.
    """

    def __init__(self, config: Config, content: dict[str, Any] | None = None):
        own, self.stages = training_environment(config), config.train.stages or ()
        self._environments = [*(_enter(own, k, stage) for k, stage in enumerate(self.stages, 1)), own]
        self.number = self.began = 0
        if self.stages and content is None:
            _check_alike(self._environments)
        elif self.stages and content is not None:
            self.number, self.began = self._read(content.get("stage"))

    def _read(self, saved: Any) -> tuple[int, int]:
        number, began = (saved.get("number"), saved.get("began")) if isinstance(saved, dict) else (None, None)
        if type(number) is int and type(began) is int and 0 <= number <= len(self.stages) and began >= 0:
            return number, began
        raise CheckpointError("the checkpoint cannot be resumed, 'stage' is none of train.stages; train anew")

    @property
    def environment(self) -> Config:
        """What is trained in now."""
        return self._environments[self.number]

    @property
    def purpose(self) -> int:
        """Of the seeds of its episodes: no stage repeats those of another."""
        # Purposes up to NOISE are taken; the first stage has those of TRAINING.
        return NOISE + self.number if self.number else TRAINING

    @property
    def needs_success(self) -> bool:
        """Whether the success in the present stage's environment may end it."""
        return self.number < len(self.stages) and self.stages[self.number].until.success is not None

    def is_over(self, frames: int, success: float | None) -> bool:
        """Return whether the present stage ends.

        Args:
            frames: environment steps of the training so far.
            success: evaluated just now in its environment; None: it was not.
        """
        if self.number == len(self.stages):
            return False
        until = self.stages[self.number].until
        enough = until.frames is not None and frames >= until.frames
        return enough or (until.success is not None and success is not None and success >= until.success)

    def advance(self, iteration: int) -> str:
        """Go on to the next stage; return how it is announced."""
        self.number, self.began = self.number + 1, iteration
        if self.number == len(self.stages):
            return "all stages are over: training goes on in its own environment"
        changes = ", ".join(f"{key}={value}" for key, value in self.stages[self.number].overrides.items())
        return f"stage {self.number + 1} of {len(self.stages)}: {changes or 'no overrides'}"

    def values(self) -> dict[str, float]:
        """Return what is logged: the number of the stage from 1 on, one more than there are after all of them."""
        return {"stage": float(self.number + 1)} if self.stages else {}

    def state(self) -> dict[str, Any]:
        """Return what a checkpoint holds of it, nothing without stages."""
        return {"stage": {"number": self.number, "began": self.began}} if self.stages else {}


def _enter(own: Config, k: int, stage: Stage) -> Config:
    """Return the environment of the k-th stage."""
    for key, _ in leaves(stage.overrides):
        if key.partition(".")[0] in _OWN or key == "env.num_envs":
            raise ConfigError(
                f"stage {k} of train.stages changes the environment and cannot hold '{key}'; set {key} itself"
            )
    try:
        environment = build_config(own.model_dump(), stage.overrides)
        _ = environment.system
        check_environment(environment)
    except ConfigError as error:
        raise ConfigError(f"stage {k} of train.stages: {error}") from error
    return environment


def _check_alike(environments: list[Config]) -> None:
    """Refuse stages in which observations, actions or the critic's state are others than in the training's own."""
    alone = {"env.num_envs": 1, "env.num_threads": 1}
    vecs = []
    for k, each in enumerate(environments, 1):
        try:
            vecs.append(MultiliftVec(build_config(divide_rigs(each)[0].model_dump(), alone)))
        except ConfigError as error:
            if k == len(environments):
                raise
            raise ConfigError(f"stage {k} of train.stages: {error}") from error
    own, train = vecs[-1], environments[-1].train
    for k, vec in enumerate(vecs[:-1], 1):
        difference = first_difference("actions", vec.action_names, own.action_names)
        difference = difference or first_difference("observations", vec.observation_names, own.observation_names)
        if difference:
            raise ConfigError(
                f"stage {k} of train.stages has other observations or actions than the training's own environment: "
                f"{difference}; leave control.action, env.history and the like to all stages in common"
            )
        if train.algorithm == "mappo" and vec.state_size != own.state_size:
            raise ConfigError(
                f"stage {k} of train.stages has a global state of {vec.state_size} numbers, the training's own "
                f"environment one of {own.state_size}, and mappo's critic takes one size; leave env.num_drones and "
                "which randomization there is to all stages in common, or set train.algorithm=ippo"
            )
