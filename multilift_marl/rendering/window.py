"""A window that shows the simulation in step with the clock; it needs a display."""

from __future__ import annotations

import time
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import mujoco

from multilift_marl.errors import RenderingError
from multilift_marl.rendering.cameras import Environments
from multilift_marl.rendering.scene import Stage

_WIDTH = 1280
_HEIGHT = 720
_TRAIL = 2.0  # [s]
_CURE = (
    "use render_mode=\"rgb_array\" for pictures, or watch in a browser by 'python -m multilift_marl.view', both of "
    "which need none"
)


class Window:
    """Shows one environment in a window, in step with the clock. Drag to turn it, scroll to zoom.

    Closing the window does not end the simulation; after it nothing is drawn or waited for.

    Args:
        vec: the environments; they are only read.
        camera: one of `cameras.CAMERAS`.

    Attributes:
        stage: what is shown.

    Raises:
        RenderingError: there is no display to open a window on, or none that has OpenGL.
    """

    def __init__(self, vec: Environments, camera: str = "side"):
        self._vec = vec
        self.stage = Stage(vec, camera, _WIDTH / _HEIGHT, _TRAIL)
        self._glfw, self._window = _open(vec.task.name)
        try:
            with self._current():
                self._context = mujoco.MjrContext(self.stage.model, mujoco.mjtFontScale.mjFONTSCALE_100)
        except mujoco.FatalError as error:
            self._glfw.destroy_window(self._window)
            raise RenderingError(f"OpenGL cannot draw on this display ({error}); {_CURE}") from error
        self._due = time.perf_counter()
        self._turned = [0.0, 0.0]
        self._zoom = 1.0
        self._cursor = (0.0, 0.0)
        self._glfw.set_cursor_pos_callback(self._window, self._drag)
        self._glfw.set_scroll_callback(self._window, self._scroll)

    @property
    def is_open(self) -> bool:
        """Whether there still is a window."""
        return self._window is not None

    def show(self, env: int = 0) -> None:
        """Show environment `env` as it is now, and wait until the clock has caught up with one policy step."""
        if self._window is None:
            return
        if self._glfw.window_should_close(self._window):
            return self.close()
        self.stage.update(env, self._move_camera)
        width, height = self._glfw.get_framebuffer_size(self._window)
        with self._current():
            mujoco.mjr_render(mujoco.MjrRect(0, 0, width, height), self.stage.scene, self._context)
            self._glfw.swap_buffers(self._window)
        self._glfw.poll_events()
        self._due = max(self._due + self._vec.task.dt, time.perf_counter() - self._vec.task.dt)
        time.sleep(max(0.0, self._due - time.perf_counter()))

    def close(self) -> None:
        """Close the window."""
        if self._window is not None:
            with self._current():
                self._context.free()
            self._glfw.destroy_window(self._window)
            self._window = None

    @contextmanager
    def _current(self) -> Iterator[None]:
        """Let this thread draw in the window; afterwards others, of other libraries too, can draw in it again."""
        self._glfw.make_context_current(self._window)
        try:
            yield
        finally:
            self._glfw.make_context_current(None)

    def _move_camera(self, camera: mujoco.MjvCamera) -> None:
        """Turn and zoom by what the mouse has done."""
        camera.azimuth += self._turned[0]
        camera.elevation = min(max(camera.elevation + self._turned[1], -90.0), 20.0)
        camera.distance *= self._zoom

    def _drag(self, window: Any, x: float, y: float) -> None:
        if self._glfw.get_mouse_button(window, self._glfw.MOUSE_BUTTON_LEFT) == self._glfw.PRESS:
            self._turned[0] -= 0.3 * (x - self._cursor[0])
            self._turned[1] -= 0.3 * (y - self._cursor[1])
        self._cursor = (x, y)

    def _scroll(self, window: Any, sideways: float, up: float) -> None:
        self._zoom = min(max(self._zoom * 0.9**up, 0.2), 5.0)


def _open(title: str) -> tuple[Any, Any]:
    """Return GLFW and a window of it."""
    try:
        import glfw
    except ImportError as error:
        raise RenderingError(f"a window needs glfw, which comes with mujoco: pip install glfw ({error})") from error
    with warnings.catch_warnings():  # GLFW warns of what it also returns
        warnings.simplefilter("ignore")
        window = glfw.create_window(_WIDTH, _HEIGHT, f"multilift_marl {title}", None, None) if glfw.init() else None
    if window is None:
        raise RenderingError(f"there is no display to open a window on; {_CURE}")
    return glfw, window
