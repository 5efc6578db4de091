"""Tune the gains of a linear policy by CMA-ES (Hansen, arXiv 1604.00772): `pip install cma`.

  python results/search_gains.py config=pose_wind [minutes=30] [script=formation_feedback] [spread=0.3] [cost=errors]
                                 [rigs=6] [key=value ...]

It starts from the gains of `script`, with candidates `spread` times the scales of `SLOTS` or `HELD` around them,
simulates the same `env.num_envs` episodes with all candidates of a generation, and prints the final gains and their
results in episodes that are not part of the search. `cost=errors` are lost episodes and errors at the end,
`cost=success` lost episodes, failures and errors above all, where payloads cannot be level, and `cost=return` is the
return. Any configuration key changes the task; where it has `train.rigs`, one policy is tuned for all of them, `rigs`
of them in each generation, in turn (by default all).
"""

from __future__ import annotations

import sys
import time
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.agents.rigs import evaluated_rigs
from multilift_marl.command import run_command, split_options
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import TRAINING_EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.evaluation.metrics import join_episodes
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.plugins import find_callable
from multilift_marl.policies.baselines import LINEAR
from multilift_marl.policies.formation import Formation
from multilift_marl.policies.hold import STIFFNESS
from multilift_marl.schema.values import Positive, Section
from multilift_marl.tasks import find_task

LEVEL = ((0, 0), (1, 1))
TANGENT = ((2, 1),)
RADIAL = ((1, 0),)
UP = ((2, 2),)
LIFT = ((1, 2),)  # what a drone does up and down turns the payload about the tangent at its slot
Free = tuple[tuple[str, tuple[tuple[int, int], ...], float], ...]
SLOTS: Free = (
    ("payload_error_integral", LEVEL, 0.2),
    ("payload_error_integral", UP, 0.2),
    ("payload_error", LEVEL, 0.2),
    ("payload_error", UP, 0.2),
    ("payload_velocity", LEVEL, 0.15),
    ("payload_velocity", UP, 0.1),
    ("tracking_error", LEVEL, 0.3),
    ("tracking_error", UP, 0.3),
    ("velocity", LEVEL, 0.1),
    ("rotation_error_integral", LIFT, 0.2),
    ("payload_rotation_error", LIFT, 0.15),
    ("payload_angular_velocity", LIFT, 0.05),
    ("rotation_error_integral", TANGENT, 0.2),
    ("payload_rotation_error", TANGENT, 0.15),
    ("payload_angular_velocity", TANGENT, 0.05),
    ("payload_rotation_error", RADIAL, 0.15),
    ("payload_angular_velocity", RADIAL, 0.05),
    ("target_velocity", LEVEL, 0.05),
    ("target_acceleration", LEVEL, 0.05),
    ("target_ahead_200ms", LEVEL, 0.5),
    ("target_ahead_400ms", LEVEL, 0.25),
    ("gap", LEVEL, 0.2),
    ("planned_offset", LEVEL, 0.3),
    ("planned_offset", UP, 0.3),
    ("lost_direction", LEVEL, 0.1),
    ("team_lost", ((0, 2),), 0.1),
    ("heading", ((0, 0),), 0.1),
)
"""Observation; axes in the slot frame, of it and of the slot's offset, that share a gain; scale of the search. Of these
a task has those that it observes."""
OWN: Free = (("slot_error", LEVEL, 5.0), ("slot_error", UP, 5.0), ("velocity", LEVEL, 2.5), ("velocity", UP, 2.5))
HELD: Free = (
    *OWN,
    *((name, axes, STIFFNESS * width) for name, axes, width in SLOTS if name not in ("tracking_error", "velocity")),
)
"""The same of scripts that hold their slots by accelerations."""
POPULATION, RENEWED = 12, 3  # candidates of a generation; generations with the same episodes
ERROR, ANGLE = 0.05, 5.0  # [m], [deg] as bad as a quarter of the episodes lost; no error as bad as more than one
Cost = Literal["errors", "success", "return"]


class Score(NamedTuple):
    """Results of a policy, means over episodes."""

    cost: float
    success: float
    error: float
    """[m], of failed episodes 3 m."""
    angle: float
    """[deg]"""
    paid: float
    """[-] Return of an episode."""


def find_script(name: str) -> type[Formation]:
    """Return the class of a linear script, or one's own that module:Class names.

    Raises:
        ConfigError: there is none.
    """
    if name in LINEAR:
        return LINEAR[name]
    if ":" not in name:
        raise ConfigError(f"the search cannot begin with script '{name}'{nearest(name, LINEAR)}")
    found = find_callable(name, "script")
    if not (isinstance(found, type) and issubclass(found, Formation)):
        raise ConfigError(f"the search cannot begin with script '{name}': it has no GAINS; base it on Formation")
    return found


def make_script(script: str, free: Free, changes: np.ndarray) -> type[Formation]:
    """Return a policy with `changes` of the gains `free`."""
    base = find_script(script)
    rows = tuple(
        (name, axis, moved, float(gain))
        for (name, axes, _), gain in zip(free, changes, strict=True)
        for axis, moved in axes
    )
    return type("Searched", (base,), {"GAINS": (*base.GAINS, *rows)})


def fly(config: Config, script: type[Formation], seed: int, cost: Cost = "errors") -> Score:
    """Simulate one episode in every environment of `config`, an equal share of them with each of `train.rigs`."""
    rigs = evaluated_rigs(config)
    each = max(1, config.env.num_envs // len(rigs))
    flown = join_episodes([
        run_episodes(rig, script, each, seed, TRAINING_EVALUATION, first=k * each) for k, rig in enumerate(rigs)
    ])  # fmt: skip
    tracks = config.task == "track"
    error, success = flown[find_task(config.task).ERROR], flown["success_rate"].mean()
    turned = np.zeros_like(error) if tracks else flown["payload_attitude_error_deg"]
    lost = 1 - success + np.mean(np.minimum(0.25 * error / ERROR, 1) + np.minimum(0.25 * turned / ANGLE, 1))
    failed = (flown["failure_cause"] > 0).mean()
    paid = float(flown["return"].mean())
    costs = {"errors": lost, "success": 1 - success + 0.5 * failed + 0.3 * np.minimum(error, 1).mean(), "return": -paid}
    return Score(float(costs[cost]), float(success), float(error.mean()), float(turned.mean()), paid)


def some_rigs(config: Config, most: int | None, generation: int) -> Config:
    """Return `config` with the `most` of its `train.rigs` that are a generation's turn."""
    rigs = config.train.rigs
    if most is None or most >= len(rigs):
        return config
    turn = [rigs[(generation * most + i) % len(rigs)] for i in range(most)]
    return build_config(config.model_dump(), {"train.rigs": turn})


def search(
    config: Config,
    script: str,
    free: Free,
    spread: float,
    minutes: float,
    cost: Cost = "errors",
    rigs: int | None = None,
) -> np.ndarray:
    """Return the changes of the gains `free` in the mean of the last generation; Ctrl-C ends the search early.

    With `rigs`, each generation flies as many of `train.rigs`, in turn.

    Raises:
        ConfigError: the package `cma` is missing.
    """
    try:
        import cma
    except ModuleNotFoundError:
        raise ConfigError("the search needs the package cma; install it with: pip install cma") from None
    scale = np.array([width for _, _, width in free])
    options = {"popsize": POPULATION, "seed": config.seed % (2**32 - 1) + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.zeros(len(free)), spread, options)
    end = 60 * minutes
    generation = 0
    begun = time.monotonic()
    try:
        while time.monotonic() - begun < end:
            candidates = strategy.ask()
            seed = config.seed + generation // RENEWED
            flown = some_rigs(config, rigs, generation)
            scores = [fly(flown, make_script(script, free, scale * np.array(each)), seed, cost) for each in candidates]
            strategy.tell(candidates, [each.cost for each in scores])
            generation += 1
            best = min(scores)
            middle = np.median([each.cost for each in scores])
            print(
                f"{generation}: cost {best.cost:.3f} at best ({best.success:.0%}, {100 * best.error:.2f} cm), "
                f"{middle:.3f} in the middle; spread {strategy.sigma:.2f}",
                flush=True,
            )
    except KeyboardInterrupt:
        print("stopping", flush=True)
    return scale * np.array(strategy.mean)


class Options(Section):
    """Keys of the search beside those of the configuration."""

    config: str = Field("pose_wind", description="the task, a configuration's name or path")
    minutes: Positive = Field(30.0, description="[min] that the search takes")
    script: str = Field("formation_feedback", description="whose gains it begins with, a name or module:Class")
    spread: Positive = Field(0.3, description="[-] of the first candidates, over the scales of `SLOTS` or `HELD`")
    cost: Cost = Field("errors", description="what gains are tuned for, see above")
    rigs: Annotated[int, Field(ge=1)] | None = Field(
        None, description="of `train.rigs` that a generation flies, in turn"
    )


def main(values: dict[str, Any]) -> int:
    """Search, print and test."""
    options, overrides = split_options(Options, values)
    script = options.script
    begun = find_script(script)
    config = load_config(options.config, {"env.num_envs": 48, **overrides})
    if begun.INTERFACE != config.control.action:
        raise ConfigError(
            f"the baseline '{script}' acts by control.action={begun.INTERFACE} and cannot fly "
            f"control.action={config.control.action}; set control.action={begun.INTERFACE}"
        )
    if options.rigs and not config.train.rigs:
        raise ConfigError(f"rigs={options.rigs} of train.rigs, but config={options.config} has none; leave rigs out")
    known = MultiliftVec(build_config(config.model_dump(), {"env.num_envs": 1})).observation_names
    every = SLOTS if config.control.action == "reference" else HELD
    free = tuple(each for each in every if f"{each[0]}_0" in known)
    changes = search(config, script, free, options.spread, options.minutes, options.cost, options.rigs)
    found = make_script(script, free, changes)
    gains: dict[tuple[str, int, int], float] = {}
    for name, axis, moved, gain in found.GAINS:
        gains[name, axis, moved] = gains.get((name, axis, moved), 0.0) + gain
    for (name, axis, moved), gain in gains.items():
        print(f'        ("{name}", {axis}, {moved}, {gain:.3f}),')
    for title, each in ((script, begun), ("searched", found)):
        config = build_config(config.model_dump(), {"env.num_envs": 256})
        _, success, error, angle, paid = fly(config, each, config.seed + 10**6)
        print(f"{title}: {success:.1%} of 256 new episodes; {100 * error:.2f} cm, {angle:.2f}°, return {paid:.1f}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__ or "", Options, None))
