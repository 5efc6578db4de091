"""Pictures of a team, drawn off-screen without a display, and videos of them."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import sys
import weakref
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from multilift_marl._files import name_aside
from multilift_marl.errors import RenderingError, pip_install
from multilift_marl.rendering.cameras import Environments
from multilift_marl.rendering.scene import Stage

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}  # in the order of preference: EGL can use a graphics card
_OTHERS = {"darwin": "cgl", "win32": "glfw"}  # MuJoCo's context on systems that bring OpenGL with them
_INSTALL = "apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libosmesa6"


class Renderer:
    """Draws environments of `vec` as they are now, with the target as a translucent green payload.

    Cables are grey when slack, blue at rest and red at twice the resting tension; the path of a target that moves is
    a dashed green line. The camera is far enough away to see a whole team.

    Args:
        vec: the environments; they are only read.
        width, height: size of a frame [pixels].
        camera: "side", "top" or "chase"; see `cameras.Camera`.
        trail: seconds of flight that payload and drones draw behind them, as far as frames were drawn of it; 0 for
            none. Without trails, "side" and "top" depend on the current state alone.

    Attributes:
        scene: what MuJoCo drew last, and from where.

    Raises:
        RenderingError: an unknown camera, or no OpenGL that draws off-screen.
    """

    def __init__(
        self, vec: Environments, width: int = 960, height: int = 540, camera: str = "side", trail: float = 0.0
    ):
        self._vec = vec
        self._stage = Stage(vec, camera, width / height, trail)
        self.scene = self._stage.scene
        size = self._stage.model.vis.global_
        size.offwidth = width
        size.offheight = height
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
        pixels = np.empty((self._rect.height, self._rect.width, 3), np.uint8)
        with self._gl.as_current():  # and no longer: a window, of another library, could not draw in this thread
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


def make_contexts(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    """Return an OpenGL context, of the kind named by MUJOCO_GL or else the first one installed, and MuJoCo's in it."""
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in ("disable", "disabled", "off", "false", "0"):
        raise RenderingError(f"MUJOCO_GL={asked} forbids drawing; unset it")
    installed = [kind for kind, library in _LIBRARIES.items() if ctypes.util.find_library(library)]
    if sys.platform in _OTHERS:
        installed = [_OTHERS[sys.platform]]
    kind = asked if asked in (*_LIBRARIES, *_OTHERS.values()) else next(iter(installed), None)
    if kind is None:
        raise RenderingError(f"drawing needs OpenGL libraries that are not installed; run '{_INSTALL}'")
    size = model.vis.global_
    try:
        gl = importlib.import_module(f"mujoco.{kind}").GLContext(size.offwidth, size.offheight)
        with gl.as_current():
            context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    except Exception as error:  # the kinds raise different errors: import, attribute, OpenGL and runtime errors
        cure = f"unset MUJOCO_GL={asked}" if asked else f"run '{_INSTALL}'"
        raise RenderingError(f"drawing by {kind} does not work ({' '.join(str(error).split())}); {cure}") from error
    return gl, context


def free_contexts(gl: Any, context: mujoco.MjrContext) -> None:
    """Free what `make_contexts` returned."""
    with gl.as_current():
        context.free()
    gl.free()


class VideoWriter:
    """Writes an mp4 (H.264, yuv420p) that browsers and slides play, frame by frame; a context.

    The file is there when it is whole: written aside, renamed by `close`, deleted where its context ends by an error.

    Args:
        path: of the file; its folder is made.
        fps: pictures each second.

    Raises:
        RenderingError: imageio or av is not installed.
    """

    def __init__(self, path: str | Path, fps: float):
        try:
            import av  # noqa: F401  (imageio's plugin needs it; its own message is less clear)
            import imageio.v3 as iio
        except ImportError as error:
            raise RenderingError(f"writing {path} needs {error.name}: {pip_install('train')}") from error
        self._path = Path(path)
        self._path.parent.mkdir(parents=True, exist_ok=True)
        self._aside = name_aside(self._path, f".tmp{self._path.suffix}")
        self._file = iio.imopen(self._aside, "w", plugin="pyav")
        self._file.init_video_stream("libx264", fps=float(fps), pixel_format="yuv420p")

    def append(self, frame: np.ndarray) -> None:
        """Add a picture (H, W, 3) uint8, the same size every time; an odd last row or column is cut off."""
        self._file.write_frame(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])

    def close(self) -> None:
        """Finish the file."""
        try:
            self._file.close()
            if self._aside.exists():  # not yet renamed
                self._aside.replace(self._path)
        finally:
            self._aside.unlink(missing_ok=True)

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: Any) -> None:
        if kind is None:
            self.close()
            return
        with suppress(Exception):  # the error that has come is the one to hear of
            self._file.close()
        self._aside.unlink(missing_ok=True)


def write_video(path: str | Path, frames: Iterable[np.ndarray], fps: float) -> None:
    """Write pictures (H, W, 3) uint8, taken one at a time, as an mp4; see VideoWriter.

    Raises:
        RenderingError: imageio or av is not installed, or there are no frames.
    """
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise RenderingError(f"there are no frames to write to {path}")
    with VideoWriter(path, fps) as video:
        video.append(first)
        for frame in frames:
            video.append(frame)
