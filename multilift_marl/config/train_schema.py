"""Parameters of training and of evaluations during training; those of the simulation are in `schema.py`."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from multilift_marl.config.files import pin_files
from multilift_marl.config.values import Float, Int, Section

RESIDUALS = (
    "formation", "formation_integral", "formation_feedback", "formation_gusts", "formation_lead", "formation_narrow",
    "formation_redistributed", "hold_velocity", "hold_acceleration", "hold_acc_rates", "hold_ctbr", "hold_ctbm",
    "hold_rotor",
)  # fmt: skip


def check_residual(name: str) -> str:
    """Return the name of a linear script; refuse another by a ValueError."""
    if name not in RESIDUALS and ":" not in name:
        raise ValueError(f"must be {', '.join(RESIDUALS)}, or one's own module:Class with matrix()")
    return name


def check_asinh(k: float) -> float:
    """Return K of the networks' fine scale; refuse, by a ValueError, what is none or beyond single precision."""
    if k != 0 and not 1e-3 <= k <= 1e6:
        raise ValueError("must be 0, for no fine scale, or 0.001 to 1e6")
    return k


class TrainConfig(Section):
    """PPO for a team with shared parameters."""

    algorithm: Literal["mappo", "ippo"] = Field("mappo", description="mappo: central critic; ippo: local critic")
    actor: Literal["local", "set", "attention"] = Field(
        "local", description="local: own observation; set, attention: what the other drones' networks hold, too"
    )
    gru: Int = Field(
        0, ge=0, le=8192, description="units of each drone's memory of earlier observations, a GRU; 0: no memory"
    )
    sequence: Int = Field(
        32, ge=1, le=100_000, description="steps that gradients of a GRU go back: train.horizon, or a part of it"
    )
    critic: Literal["flat", "set", "attention"] = Field(
        "flat", description="of mappo; set, attention: the same value in whatever order the drones stand"
    )
    residual: Annotated[str, AfterValidator(check_residual)] = Field(
        "formation", description="linear script that an untrained policy flies and the learned one corrects"
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
    entropy: Float = Field(0.0, ge=0, description="[-] weight of the entropy bonus")
    value_weight: Float = Field(1.0, ge=0, description="[-] weight of the critic's loss")
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
    overrides: Annotated[dict[str, Any], AfterValidator(pin_files)] = Field(
        {}, description="of the environment that it trains in, by dotted name"
    )
    rigs: tuple[Annotated[dict[str, Any], AfterValidator(pin_files)], ...] = Field(
        (), description="rigs that it trains with together, each by what differs in its environment, by dotted name"
    )
    threads: Int = Field(
        2, ge=1, le=1024, description="threads of the update; weights are bit-equal for the same number"
    )
    checkpoint_every: Int = Field(25, ge=1, description="iterations between checkpoints")
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
