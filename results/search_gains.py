"""Search the gains of a script by the evolution strategy CMA-ES (Hansen, arXiv 1604.00772): `pip install cma`.

  python results/search_gains.py config=pose_wind [minutes=30] [script=formation_feedback] [spread=0.3] [key=value ...]

It starts from the gains of `script`, with candidates `spread` times the distances of `FREE` around them, simulates the
same `env.num_envs` episodes with all candidates of a generation, and prints the final gains and their results in
episodes that are not part of the search. Any configuration key changes the task.
"""

from __future__ import annotations

import sys
import time
from math import radians
from typing import Any, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.cli.common import run_command, split_options
from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config, load_config
from multilift_marl.config.values import Positive, Section
from multilift_marl.control.scripted import LINEAR, Formation, check_interface
from multilift_marl.envs.core import TRAINING_EVALUATION, MultiliftVec
from multilift_marl.errors import ConfigError, nearest

LEVEL = ((0, 0), (1, 1))
TANGENT = ((2, 1),)
RADIAL = ((1, 0),)
UP = ((2, 2),)
LIFT = ((1, 2),)  # what a drone does up and down turns the payload about the tangent at its slot
FREE: tuple[tuple[str, tuple[tuple[int, int], ...], float], ...] = (
    ("payload_error_integral", LEVEL, 0.2),
    ("payload_error_integral", UP, 0.2),
    ("payload_error", LEVEL, 0.2),
    ("payload_error", UP, 0.2),
    ("payload_velocity", LEVEL, 0.15),
    ("payload_velocity", UP, 0.1),
    ("tracking_error", LEVEL, 0.3),
    ("tracking_error", UP, 0.3),
    ("rotation_error_integral", LIFT, 0.2),
    ("payload_rotation_error", LIFT, 0.15),
    ("payload_angular_velocity", LIFT, 0.05),
    ("rotation_error_integral", TANGENT, 0.2),
    ("payload_rotation_error", TANGENT, 0.15),
    ("payload_angular_velocity", TANGENT, 0.05),
    ("payload_rotation_error", RADIAL, 0.15),
    ("payload_angular_velocity", RADIAL, 0.05),
)
"""Observation; axes in the slot frame, of it and of the slot's offset, that share a gain; scale of the search."""
TASKS = ("hover", "pose")  # their success depends on bounds of distance and angle alone
SCRIPTS = tuple(name for name in LINEAR if name != "formation_lead")  # those that consist of gains only
POPULATION, RENEWED = 12, 3  # candidates of a generation; generations with the same episodes
SOFT = 0.15  # width of the transition of the cost, relative to the bounds, at which it is 1/2


class Score(NamedTuple):
    """Results of a script."""

    cost: float
    """Share of the episodes that were lost, smoothed."""
    success: float
    """Share of the episodes that met the task's bounds throughout."""
    distance: float
    """Median of the largest distances [m]."""
    angle: float
    """Median of the largest angles [deg]."""


def make_script(gains: np.ndarray) -> type[Formation]:
    """Return the script with these gains of `FREE`."""
    rows = tuple(
        (name, axis, moved, float(gain))
        for (name, axes, _), gain in zip(FREE, gains, strict=True)
        for axis, moved in axes
    )
    return type("Searched", (Formation,), {"GAINS": rows})


def starting_gains(script: str) -> np.ndarray:
    """Return the gains of `FREE` that a script has."""
    known = {(name, axis, moved): gain for name, axis, moved, gain in LINEAR[script].GAINS}
    return np.array([known.get((name, *axes[0]), 0.0) for name, axes, _ in FREE])


def fly(config: Config, script: type[Formation], seed: int) -> Score:
    """Simulate one episode in every environment of `config`; return the scores of its worst moment that counts."""
    vec = MultiliftVec(config, TRAINING_EVALUATION)
    bound = np.array([[vec.task.options.success_distance], [radians(vec.task.options.success_angle)]])
    policy = script(vec)
    worst = np.zeros((2, vec.num_envs))
    observation, _ = vec.reset(seed=seed)
    failed = np.zeros(vec.num_envs, bool)
    for step in range(vec.max_steps):
        observation, _, terminated, _, _ = vec.step(policy.act(observation))
        failed |= terminated
        if vec.task.in_error_window((step + 1) * vec.task.dt, vec.max_steps * vec.task.dt):
            errors = np.stack([vec.task.errors.distance, vec.task.errors.angle])
            worst = np.maximum(worst, errors)
        if terminated.any() and step + 1 < vec.max_steps:
            observation, _ = vec.reset(mask=terminated)  # the next episode does not count: this one is lost
    excess = np.where(failed, 10.0, (worst / bound).max(axis=0)) - 1
    cost = (1 / (1 + np.exp(-np.clip(excess / SOFT, -30, 30)))).mean()
    distance, angle = np.median(worst, axis=1)
    return Score(float(cost), float((excess <= 0).mean()), float(distance), float(np.rad2deg(angle)))


def search(config: Config, start: np.ndarray, spread: float, minutes: float) -> np.ndarray:
    """Return the mean of the last generation; Ctrl-C ends the search early.

    Raises:
        ConfigError: the package `cma` is missing.
    """
    try:
        import cma
    except ModuleNotFoundError:
        raise ConfigError("the search needs the package cma; install it with: pip install cma") from None
    scale = np.array([width for _, _, width in FREE])
    options = {"popsize": POPULATION, "seed": config.seed % (2**32 - 1) + 1, "verbose": -9}
    strategy = cma.CMAEvolutionStrategy(np.zeros(len(FREE)), spread, options)
    end = 60 * minutes
    generation = 0
    begun = time.monotonic()
    try:
        while time.monotonic() - begun < end:
            candidates = strategy.ask()
            seed = config.seed + generation // RENEWED
            scores = [fly(config, make_script(start + scale * np.array(each)), seed) for each in candidates]
            strategy.tell(candidates, [each.cost for each in scores])
            generation += 1
            best = min(each.cost for each in scores)
            middle = np.median([each.cost for each in scores])
            success = max(each.success for each in scores)
            print(
                f"{generation}: cost {best:.3f} at best, {middle:.3f} in the middle; success up to {success:.0%}; "
                f"spread {strategy.sigma:.2f}",
                flush=True,
            )
    except KeyboardInterrupt:
        print("stopping", flush=True)
    return start + scale * np.array(strategy.mean)


class Options(Section):
    """Keys of the search beside those of the configuration."""

    config: str = Field("pose_wind", description="the task, a configuration's name or path")
    minutes: Positive = Field(30.0, description="[min] that the search takes")
    script: str = Field("formation_feedback", description="whose gains it begins with")
    spread: Positive = Field(0.3, description="[-] of the first candidates, over the distances of `FREE`")


def main(values: dict[str, Any]) -> int:
    """Search, print and test."""
    options, overrides = split_options(Options, values)
    script = options.script
    if script not in SCRIPTS:
        raise ConfigError(f"the search cannot begin with script '{script}'{nearest(script, SCRIPTS)}")
    config = load_config(options.config, {"env.num_envs": 48, **overrides})
    check_interface(script, config.control.action)
    if config.task not in TASKS:
        raise ConfigError(f"task {config.task} cannot be searched; take hover or pose")
    start, fresh = starting_gains(script), build_config(config.model_dump(), {"env.num_envs": 256})
    gains = search(config, start, options.spread, options.minutes)
    for (name, axes, _), gain in zip(FREE, gains, strict=True):
        for axis, moved in axes:
            print(f'        ("{name}", {axis}, {moved}, {gain:.3f}),')
    for title, each in ((script, start), ("searched", gains)):
        _, success, distance, angle = fly(fresh, make_script(each), config.seed + 10**6)
        print(f"{title}: {success:.1%} of 256 new episodes; median of the worst {100 * distance:.1f} cm, {angle:.1f}°")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main, __doc__ or "", Options, None))
