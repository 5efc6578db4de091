"""What the faces of the core share: pictures, and what one environment tells of itself."""

from __future__ import annotations

from typing import Any

import numpy as np

from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import nearest
from multilift_marl.rendering import Renderer

RENDER_MODES = ("rgb_array",)


class Pictures:
    """Draws environments of `vec`, if `render_mode` asks for it; the renderer is made for the first picture.

    Args:
        vec: the environments.
        render_mode: None or one of RENDER_MODES.

    Raises:
        ValueError: an unknown render mode.
    """

    def __init__(self, vec: MultiliftVec, render_mode: str | None):
        if render_mode not in (None, *RENDER_MODES):
            raise ValueError(f"unknown render_mode '{render_mode}'{nearest(str(render_mode), RENDER_MODES)}")
        self._vec, self._mode = vec, render_mode
        self._renderer: Renderer | None = None

    def frame(self, env: int = 0) -> np.ndarray:
        """Return a picture (H, W, 3) uint8 of the team and its target.

        Raises:
            RuntimeError: there is no render mode, or no episode was ever started.
            RenderingError: there is no OpenGL that draws off-screen.
        """
        if self._mode is None:
            raise RuntimeError('render() needs an environment made with render_mode="rgb_array"')
        if self._vec.episodes[env] < 0:
            raise RuntimeError("there is nothing to draw yet: call reset() before render()")
        if self._renderer is None:
            self._renderer = Renderer(self._vec)
        return self._renderer.frame(env)

    def close(self) -> None:
        """Free the renderer; the next picture makes a new one."""
        if self._renderer is not None:
            self._renderer.close()
            self._renderer = None


def solo_info(vec: MultiliftVec, info: dict[str, Any]) -> dict[str, Any]:
    """Return the info of the only environment of `vec` in plain values.

    Returns:
        `success`, `failure`, `diverged` (bool), `failure_cause` (its name, "none" without one), `reward_terms`
        {name: float} and `randomization` {name: array}.
    """
    told: dict[str, Any] = {key: bool(info[key][0]) for key in ("success", "failure", "diverged")}
    told["failure_cause"] = vec.failure_causes[info["failure_cause"][0]]
    told["reward_terms"] = dict(zip(vec.reward_terms, vec.task.terms[0].tolist(), strict=True))
    told["randomization"] = {name: array[0].copy() for name, array in info["randomization"].items()}
    return told
