"""What the APIs of the core share: fresh seeds, time limits, spaces, pictures, what one environment tells of itself."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from gymnasium.error import ClosedEnvironmentError as _ClosedError
from gymnasium.spaces import Box

from multilift_marl.config.config import Config
from multilift_marl.config.load import build_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.rendering import Renderer, Window

BATCH_RENDER_MODES = ("rgb_array",)  # of many environments


class ClosedEnvironmentError(_ClosedError, RuntimeError):
    """Environments that were closed are asked to go on."""


_FLAGS = ("success", "failure", "diverged")
RENDER_MODES = (*BATCH_RENDER_MODES, "human")


def seed_afresh(vec: MultiliftVec) -> None:
    """Let environments that were never reset start from fresh entropy, unless their configuration states a seed.

    So copies and workers fly episodes of their own. `vec.seeds` says which.
    """
    if "seed" not in vec.config.model_fields_set and (vec.episodes < 0).all():
        vec.seeds[:] = int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> np.uint64(1))


def check_open(closed: bool) -> None:
    """Refuse what is asked of environments after their `close()`, by a RuntimeError."""
    if closed:
        raise ClosedEnvironmentError("these environments are closed and cannot go on; make new ones")


def limit_steps(config: Config, steps: int | None, name: str, given: Iterable[str] = ()) -> Config:
    """Return a configuration whose episodes last a number of policy steps, as other libraries state their time limit.

    Args:
        config: of the environments.
        steps: policy steps; None or -1 leaves the configured `env.episode_seconds`.
        name: of that argument, for messages.
        given: keys that were overridden.

    Raises:
        ConfigError: no such number, or another length was given, too.
    """
    if steps is None or steps == -1:
        return config
    if isinstance(steps, bool) or not isinstance(steps, int | np.integer) or steps < 1:
        raise ConfigError(f"{name} must be a number of policy steps, 1 or more, but is {steps!r}")
    seconds, configured = steps / config.env.policy_hz, config.env.episode_seconds
    if "env.episode_seconds" in given and round(configured * config.env.policy_hz) != steps:
        raise ConfigError(
            f"{name}={steps} ({seconds:g} s) and env.episode_seconds={configured:g} were both given; leave out one"
        )
    return build_config(config.model_dump(include=config.model_fields_set), {"env.episode_seconds": seconds})


def possible_modes(render_mode: str | None) -> list[str]:
    """Return the render modes of an environment made with `render_mode`: no "human" where there is no display."""
    windows = sys.platform in ("win32", "darwin") or any(os.environ.get(key) for key in ("DISPLAY", "WAYLAND_DISPLAY"))
    return [mode for mode in RENDER_MODES if mode != "human" or windows or mode == render_mode]


class FrameRenderer:
    """Draws environments of `vec`, if `render_mode` asks for it; nothing is opened before the first picture.

    Args:
        vec: the environments.
        render_mode: None, "rgb_array" for pictures, or "human" for a window that shows every step.
        modes: those of the API.

    Raises:
        ValueError: an unknown render mode.
    """

    def __init__(self, vec: MultiliftVec, render_mode: str | None, modes: Sequence[str] = RENDER_MODES):
        if render_mode not in (None, *modes):
            raise ValueError(f"unknown render_mode '{render_mode}'{nearest(str(render_mode), modes)}")
        self._vec, self._mode = vec, render_mode
        self._renderer: Renderer | None = None
        self._window: Window | None = None

    def frame(self, env: int = 0) -> np.ndarray | None:
        """Return a picture (H, W, 3) uint8 of the team and its target; with "human", which shows it anyway, None.

        Raises:
            RuntimeError: there is no render mode, or no episode was ever started.
            RenderingError: there is no OpenGL that draws off-screen.
        """
        if self._mode is None:
            raise RuntimeError('render() needs an environment made with render_mode="rgb_array"')
        if self._vec.episodes[env] < 0:
            raise RuntimeError("there is nothing to draw yet: call reset() before render()")
        if self._mode == "human":
            return None
        if self._renderer is None:
            self._renderer = Renderer(self._vec)
        return self._renderer.frame(env)

    def show(self) -> None:
        """Show the step just made, if the render mode is "human".

        Raises:
            RenderingError: there is no display.
        """
        if self._mode == "human":
            if self._window is None:
                self._window = Window(self._vec)
            self._window.show()

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_renderer": None, "_window": None}  # a copy opens its own

    def close(self) -> None:
        """Free renderer and window; the next picture makes new ones."""
        for tool in (self._renderer, self._window):
            if tool is not None:
                tool.close()
        self._renderer = self._window = None


def row_spaces(vec: MultiliftVec, drones: int) -> tuple[Box, Box]:
    """Return the spaces of what `drones` drones in a row observe (drones·D,) and of their actions (drones·A,)."""
    observed, acted = drones * vec.observation_size, drones * vec.action_size
    return Box(-np.inf, np.inf, (observed,), np.float32), Box(-1.0, 1.0, (acted,), np.float32)


def mean_reward(reward: np.ndarray) -> np.ndarray:
    """Return the mean (E,) over the drones, in float64: that of equal float32 numbers is then exactly each of them."""
    return reward.mean(axis=1, dtype=np.float64)


def solo_info(vec: MultiliftVec) -> dict[str, Any]:
    """Return the info of the last step or reset of the only environment of `vec` in plain values.

    Returns:
        `success`, `failure`, `diverged` (bool), `failure_cause`, an index into `vec.failure_causes` (0: none),
        `reward_terms` {name: float} and `randomization` {name: array}.
    """
    outcome = vec.outcome
    values: dict[str, Any] = dict(zip(_FLAGS, outcome.flags[2:, 0].tolist(), strict=True))
    values["failure_cause"] = int(outcome.cause[0])
    values["reward_terms"] = dict(zip(vec.reward_terms, outcome.terms[0].tolist(), strict=True))
    values["randomization"] = {name: array[0].copy() for name, array in vec.drawn.items()}
    return values
