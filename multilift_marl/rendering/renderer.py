"""Pictures of a team, drawn off-screen."""

from __future__ import annotations

import weakref
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from multilift_marl.errors import RenderingError
from multilift_marl.rendering.opengl import free_contexts, make_contexts
from multilift_marl.rendering.scene import Stage

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


class Renderer:
    """Draws environments of `vec` as they are now, with the target as a translucent green payload.

    Cables are grey when slack, blue at rest and red at twice the resting tension; the path of a target that moves is
    a dashed green line. The camera is far enough away to see a whole team.

    Args:
        vec: the environments; they are only read.
        width, height: size of a frame [pixels].
        camera: "side", "top" or "chase"; see `cameras.Camera`.
        trail: seconds of flight that payload and drones draw behind them, as far as frames were drawn of it; 0 for
            none. Without trails, what side and top show depends on the current state alone.

    Attributes:
        scene: what MuJoCo drew last, and from where.

    Raises:
        RenderingError: an unknown camera, or no OpenGL that draws off-screen.
    """

    def __init__(
        self, vec: MultiliftVec, width: int = 960, height: int = 540, camera: str = "side", trail: float = 0.0
    ):
        self._vec, self._stage = vec, Stage(vec, camera, width / height, trail)
        self.scene, size = self._stage.scene, self._stage.model.vis.global_
        size.offwidth, size.offheight = width, height
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self._gl, self._context = make_contexts(self._stage.model)
        self._free = weakref.finalize(self, free_contexts, self._gl, self._context)  # at the latest when Python exits

    def frame(self, env: int = 0) -> np.ndarray:
        """Return a picture (height, width, 3) uint8 of environment `env`; one that has diverged stays as last drawn.

        Raises:
            RenderingError: the renderer is closed.
            IndexError: there is no such environment.
        """
        if not self._free.alive:
            raise RenderingError("this renderer is closed; make a new one")
        if not 0 <= env < self._vec.num_envs:
            raise IndexError(f"there is no environment {env}, only 0 to {self._vec.num_envs - 1}")
        self._stage.update(env)
        self._gl.make_current()
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        mujoco.mjr_render(self._rect, self.scene, self._context)
        mujoco.mjr_readPixels(pixels, None, self._rect, self._context)
        return np.ascontiguousarray(pixels[::-1])  # OpenGL's first row is the lowest

    def close(self) -> None:
        """Free the OpenGL context; frames already drawn stay valid."""
        self._free()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()
