"""Parameters of training and of evaluations during training; those of the simulation are in `sections.py`."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from multilift_marl.errors import nearest
from multilift_marl.schema.files import pin_overrides, pin_policy
from multilift_marl.schema.values import Float, Int, Section

BASE_POLICIES = (
    "formation", "formation_integral", "formation_feedback", "formation_gusts", "formation_lead", "formation_narrow",
    "formation_redistributed", "hold_velocity", "hold_acceleration", "hold_acc_rates", "hold_full_state",
    "hold_ctbr", "hold_ctbm", "hold_rotor",
)  # fmt: skip

GAINS = Path(__file__).resolve().parents[1] / "policies" / "gains"
TUNED = tuple(sorted(path.stem for path in GAINS.glob("*.yaml")))
"""Linear policies by tuned gains, a file each."""
_Weight = Annotated[Float, Field(ge=0, le=1e6)]  # of a loss in single precision
_RESULTS = Path(__file__).resolve().parents[2] / "results"
_FORMER = re.compile(r"(?:.*/)?searched\w*\.py:(\w+)")  # where those were, beside the package


def check_base_policy(name: str) -> str:
    """Return the name of a linear policy; refuse another by a ValueError.

    Tuned gains were once named by a file beside the package; unless a user has such a file, they are the package's.
    """
    file = Path(name.rpartition(":")[0])
    if (former := _FORMER.fullmatch(name)) and (not file.is_file() or file.resolve().parent == _RESULTS):
        tuned = re.sub(r"(?<!^)(?=[A-Z])", "_", former[1]).lower()
        return tuned if tuned in TUNED else name
    if name not in (*BASE_POLICIES, *TUNED) and ":" not in name:
        near = nearest(name, (*BASE_POLICIES, *TUNED))
        raise ValueError(
            f"must be {', '.join((*BASE_POLICIES, *TUNED))}, or one's own module:Class with matrix(){near}"
        )
    return name


def check_asinh(k: float) -> float:
    """Return K of the networks' fine scale; refuse, by a ValueError, what is none or beyond single precision."""
    if k != 0 and not 1e-3 <= k <= 1e6:
        raise ValueError("must be 0, for no fine scale, or 0.001 to 1e6")
    return k


class Until(Section):
    """When a stage ends: where both are given, by whatever comes first."""

    frames: Int | None = Field(None, ge=1, description="environment steps of the whole training so far")
    success: Float | None = Field(None, gt=0, le=1, description="[-] evaluated success in the stage's environment")


class Stage(Section):
    """An environment that training goes through before its own."""

    overrides: Annotated[dict[str, Any], AfterValidator(pin_overrides)] = Field(
        {}, description="of the environment that it trains in, over train.overrides, by dotted name"
    )
    until: Until = Until()


def check_stages(stages: tuple[Stage, ...]) -> tuple[Stage, ...]:
    """Return stages that can follow each other; refuse others by a ValueError."""
    for k, stage in enumerate(stages, 1):
        if k < len(stages) and stage.until == Until():
            raise ValueError(f"must say in stage {k} of {len(stages)} until when it lasts, until: {{frames: 1e6}} say")
    frames = [stage.until.frames for stage in stages if stage.until.frames is not None]
    for before, after in zip(frames, frames[1:], strict=False):
        if after <= before:
            raise ValueError(f"must have until.frames that increase from stage to stage, not {after} after {before}")
    return stages


class DiffMpcConfig(Section):
    """Training through the planner, `train.algorithm=diffmpc`."""

    window: Int = Field(20, ge=1, le=10_000, description="policy steps that gradients go back")
    every: Int | None = Field(None, ge=1, le=10_000, description="policy steps between updates; None: a window")
    fresh_adam: bool = Field(
        False, description="whether Adam begins anew at each update, so that it follows signs alone (Auto-Multilift)"
    )
    loss: tuple[_Weight, _Weight, _Weight, _Weight, _Weight, _Weight] = Field(
        (1.0, 0.1, 0.0, 0.05, 0.01, 0.0),
        description="weights of squared deviations: the payload's position [1/m²] and attitude [1/rad²], cables' "
        "direction, velocity [s²/m²], body rates [s²/rad²], cables' rates [s²]",
    )


class DaggerConfig(Section):
    """Imitation of a teacher on the states that the learner comes to, `train.algorithm=dagger`."""

    teacher: str = Field("formation_route", description="scripted policy whose commands are learned")
    truth: bool = Field(True, description="whether it knows the true states of team and payload")
    capacity: Int = Field(500_000, ge=1, description="environment steps that are kept, the latest")
    handover: Int = Field(200_000, ge=0, description="environment steps within which the learner takes over from it")
    teacher_share: Float = Field(0.1, ge=0, le=1, description="[-] of episodes that it flies itself, at least")


class TrainConfig(Section):
    """PPO for a team with shared parameters, the gradient of a planner, or imitation of one."""

    algorithm: Literal["mappo", "ippo", "diffmpc", "dagger"] = Field(
        "mappo",
        description="mappo: central critic; ippo: local critic; diffmpc: gradient through a planner; dagger: imitation",
    )
    diffmpc: DiffMpcConfig = DiffMpcConfig()
    dagger: DaggerConfig = DaggerConfig()
    actor: Literal["local", "set", "attention"] = Field(
        "local", description="local: own observation; set, attention: what the other drones' networks hold, too"
    )
    gru: Int = Field(
        0, ge=0, le=8192, description="units of each drone's memory of earlier observations, a GRU; 0: no memory"
    )
    observe: tuple[str, ...] | None = Field(
        None, min_length=1, description="components of the observation that the network takes, by name; None: all"
    )
    changes: bool = Field(
        False, description="whether the network takes of env.history by how much earlier steps differ from the newest"
    )
    sequence: Int = Field(
        32, ge=1, le=100_000, description="steps that gradients of a GRU go back: train.horizon, or a part of it"
    )
    critic: Literal["flat", "set", "attention"] = Field(
        "flat", description="of mappo; set, attention: the same value in whatever order the drones stand"
    )
    residual: Annotated[str, AfterValidator(check_base_policy)] = Field(
        "formation",
        description="linear base policy: untrained policies act as it, learned ones correct it; also train.base_policy",
    )
    init: Annotated[str | None, AfterValidator(pin_policy)] = Field(
        None, description="policy to start from: a run, a shipped policy or a checkpoint file; None: an untrained one"
    )
    frames: Int = Field(5_000_000, ge=1, description="environment steps in all")
    horizon: Int = Field(128, ge=1, le=100_000, description="steps of each environment between updates")
    epochs: Int = Field(4, ge=1, description="passes over each batch")
    minibatches: Int = Field(4, ge=1, description="minibatches of each pass")
    learning_rate: Float = Field(6e-4, gt=0, description="[-] of Adam, at the start")
    final_learning_rate: Float = Field(0.1, ge=0, le=1, description="[-] fraction of it left at the end (linear)")
    desired_kl: Float = Field(
        0.0,
        ge=0,
        description="[-] approximate KL of an update that the learning rate is set for; 0: it falls linearly",
    )
    critic_learning_rate: Float | None = Field(2e-3, gt=0, description="[-] of the critic; None: as the actor's")
    warmup: Int = Field(12, ge=0, description="iterations in which the critic alone learns")
    gamma: Float = Field(0.99, ge=0, le=1, description="[-] discount of one policy step")
    gae_lambda: Float = Field(0.985, ge=0, le=1, description="[-] of generalised advantage estimation")
    clip: Float = Field(0.2, gt=0, description="[-] PPO's clipping range")
    entropy: _Weight = Field(0.0, description="[-] weight of the entropy bonus")
    value_weight: _Weight = Field(1.0, description="[-] weight of the critic's loss")
    max_grad_norm: Float = Field(1.0, gt=0, description="[-] gradient clipping")
    target_kl: Float = Field(0.03, gt=0, description="[-] approximate KL that ends an update early")
    hidden: tuple[Annotated[Int, Field(ge=1, le=8192)], ...] = Field(
        (64, 64), min_length=1, description="[-] widths of the hidden layers"
    )
    asinh: Annotated[Float, AfterValidator(check_asinh)] = Field(
        0.0,
        description="[-] K: networks take asinh(K x / deviation) of each number x, too, fine near 0; 0: they do not",
    )
    initial_std: Float = Field(0.12, gt=0, description="[-] of the action distribution at the start")
    overrides: Annotated[dict[str, Any], AfterValidator(pin_overrides)] = Field(
        {}, description="of the environment that it trains in, by dotted name"
    )
    rigs: tuple[Annotated[dict[str, Any], AfterValidator(pin_overrides)], ...] = Field(
        (), description="rigs that it trains with together, each by what differs in its environment, by dotted name"
    )
    stages: Annotated[tuple[Stage, ...], Field(min_length=1), AfterValidator(check_stages)] | None = Field(
        None,
        description="environments to train in first, each {overrides, until: {frames, success}}; None: its own alone",
    )
    threads: Int = Field(
        2,
        ge=1,
        le=1024,
        description="threads of the update, 1 beside other work; weights are bit-equal for the same number",
    )
    checkpoint_every: Int = Field(25, ge=1, description="iterations between checkpoints")
    logger: Literal["tensorboard", "wandb", "csv"] = Field(
        "tensorboard", description="what shows the numbers: TensorBoard, Weights & Biases, or files; beside metrics.csv"
    )
    workers: Int = Field(
        0, ge=0, le=1024, description="processes of Ray that simulate env.num_envs / workers environments each; 0: none"
    )
    ray: str = Field(
        "auto", description="cluster of these workers: local, host:port of its head node, auto: a running one or local"
    )


class EvalConfig(Section):
    """Evaluation during training, on seeds of its own."""

    every: Int = Field(25, ge=1, description="iterations between evaluations")
    episodes: Int = Field(128, ge=1, le=1_000_000, description="episodes of each")
    keep: Literal["best", "last"] = Field(
        "best", description="policy to keep: the one that flew best, or the one evaluated last"
    )
