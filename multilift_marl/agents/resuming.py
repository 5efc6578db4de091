"""What a checkpoint must hold for a training to go on from it."""

from __future__ import annotations

from typing import Any

import torch

from multilift_marl.agents.checkpoint import check_like
from multilift_marl.agents.mappo import Learner
from multilift_marl.agents.policy import check_policy
from multilift_marl.errors import CheckpointError
from multilift_marl.schema.training import TrainConfig

_NEEDED = ("critic", "optimizer", "rng", "env", "returns", "iteration", "seconds", "best_policy")


def check_needed(content: dict[str, Any], train: TrainConfig) -> None:
    """Refuse, by a CheckpointError, what is no training run's."""
    needed = _NEEDED if train.init is None else (*_NEEDED, "initial_policy")
    if missing := [key for key in needed if key not in content]:
        raise CheckpointError(
            f"the checkpoint cannot be resumed, '{missing[0]}' is missing; give a training run's, of this version"
        )


def check_content(content: dict[str, Any], own: dict[str, Any], learner: Learner) -> None:
    """Refuse what is not built as a training's `own` content and learning state are.

    Raises:
        Exception: of many kinds, saying what does not fit.
    """
    for key in ("critic", "rng", "returns", "iteration", "seconds"):
        check_like(content[key], own[key], key)
    for key in ("best_policy", "initial_policy"):
        if content.get(key) is not None:
            check_policy(content[key], f"'{key}'")
            check_like(content[key]["actor"], learner.actor.state_dict(), f"{key}.actor")
    check_like(content["actor"], learner.actor.state_dict(), "actor")
    torch.Generator().set_state(content["rng"])  # refuses what is no state
    if content["iteration"] < 0:
        raise ValueError("'iteration' is negative")


def load_networks(content: dict[str, Any], learner: Learner) -> None:
    """Give a learner the networks and the optimiser of a checkpoint, see `check_content`."""
    optimizer = learner.optimizer
    groups = optimizer.state_dict()["param_groups"]
    learner.actor.load_state_dict(content["actor"])
    learner.critic.load_state_dict(content["critic"])
    optimizer.load_state_dict(content["optimizer"])
    for group, expected in zip(optimizer.param_groups, groups, strict=True):
        for key in expected.keys() - {"params"}:
            check_like(group[key], expected[key], f"optimizer.{key}")
    for parameter, moments in optimizer.state.items():
        like = {"step": torch.zeros(()), "exp_avg": parameter.data, "exp_avg_sq": parameter.data}
        check_like(moments, like, "optimizer.state")
