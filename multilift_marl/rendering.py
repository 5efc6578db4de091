"""Pictures and videos of a team, drawn off-screen: no display is needed, and none is opened."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import weakref
from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mujoco
import numpy as np

from multilift_marl.errors import RenderingError, nearest
from multilift_marl.math3d import mat_to_quat
from multilift_marl.sim.scene import build_model

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}  # in the order of preference: EGL can use a graphics card
_INSTALL = "apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libosmesa6"
_ROOM = 0.35  # [m] of the payload from its target that the picture holds; beyond it the camera goes along


class Renderer:
    """Draws environments of `vec` as they are now, with the target as a translucent green payload.

    The camera looks at the target from the direction of a camera of the scene, far enough to see a whole team there,
    and goes along with a payload that is farther away. What it shows depends on the current state alone.

    Args:
        vec: the environments; they are only read.
        width, height: size of a frame [pixels].
        camera: "side" or "top".

    Attributes:
        scene: what MuJoCo drew last, and from where.

    Raises:
        RenderingError: an unknown camera, or no OpenGL that draws off-screen.
    """

    def __init__(self, vec: MultiliftVec, width: int = 960, height: int = 540, camera: str = "side"):
        self._vec = vec
        self.model, _ = build_model(vec.world.system, visuals=True)
        self.data = mujoco.MjData(self.model)
        self._camera = _make_camera(self.model, self.data, camera)
        self._target = self.model.body("target").id
        self._frame_team(width / height)
        size = self.model.vis.global_
        size.offwidth, size.offheight = width, height
        self._rect = mujoco.MjrRect(0, 0, width, height)
        self.scene = mujoco.MjvScene(self.model, maxgeom=10_000)
        self.scene.flags[mujoco.mjtRndFlag.mjRND_FOG] = True
        self._option = mujoco.MjvOption()
        self._gl, self._context = _make_contexts(self.model)
        self._free = weakref.finalize(self, _free, self._gl, self._context)  # at the latest when Python exits

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
        self._pose(env)
        mujoco.mjv_updateScene(
            self.model, self.data, self._option, None, self._camera, mujoco.mjtCatBit.mjCAT_ALL, self.scene
        )
        for geom in self.scene.geoms[: self.scene.ngeom]:
            if geom.objtype == mujoco.mjtObj.mjOBJ_GEOM and self.model.geom_bodyid[geom.objid] in (0, self._target):
                geom.category = mujoco.mjtCatBit.mjCAT_DECOR  # casts no shadow
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

    def _frame_team(self, aspect: float) -> None:
        """Set the camera's distance and how far above the target it looks, so that a picture holds a team there."""
        system, tilt = self._vec.world.system, np.deg2rad(self._camera.elevation)
        drone = 2 * max(vehicle.arm for vehicle in system.vehicles)
        half_payload = system.payload_size / 2 + np.abs(system.payload_center)
        reach = max(np.hypot(*system.slots[:, :2].T).max() + drone, np.hypot(*half_payload[:2]))
        top, bottom = max(system.slots[:, 2].max() + drone, half_payload[2]), -half_payload[2]
        self._lift, height = (top + bottom) / 2, (top - bottom) / 2
        across, along = abs(np.cos(tilt)), abs(np.sin(tilt))  # how much of the height, of the floor a picture shows
        vertical, depth = height * across + reach * along, height * along + reach * across
        view = max(vertical + _ROOM, (reach + _ROOM) / aspect)
        self._camera.distance = depth + view / np.tan(np.deg2rad(self.model.vis.global_.fovy) / 2)

    def _pose(self, env: int) -> None:
        world, goal = self._vec.world, self._vec.task.goal
        if not world.diverged[env]:
            self.data.qpos[:] = world.qpos(env)
        if self.model.ntendon:
            self.model.tendon_rgba[:, 3] = ~world.state.cable_broken[env]
        self.data.mocap_pos[0] = target = goal.position[env]
        self.data.mocap_quat[0] = mat_to_quat(tuple(goal.rotation[env].ravel()))
        mujoco.mj_fwdPosition(self.model, self.data)
        away = world.state.payload_position[env] - target
        distance = np.linalg.norm(away)
        self._camera.lookat[:] = target + max(0.0, 1.0 - _ROOM / max(distance, _ROOM)) * away
        self._camera.lookat[2] += self._lift


class VideoWriter:
    """Writes an mp4 (H.264, yuv420p) that browsers and slides play, frame by frame.

    Args:
        path: of the file; its folder is made.
        fps: pictures each second.

    Raises:
        RenderingError: imageio or av is not installed.
    """

    def __init__(self, path: str | Path, fps: float):
        try:
            import av  # noqa: F401  (imageio's plugin needs it and says so less clearly)
            import imageio.v3 as iio
        except ImportError as error:
            raise RenderingError(f"writing {path} needs {error.name}: pip install 'multilift_marl[train]'") from error
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        self._file = iio.imopen(path, "w", plugin="pyav")
        self._file.init_video_stream("libx264", fps=float(fps), pixel_format="yuv420p")

    def append(self, frame: np.ndarray) -> None:
        """Add a picture (H, W, 3) uint8, the same size every time; an odd last row or column is cut off."""
        self._file.write_frame(frame[: frame.shape[0] // 2 * 2, : frame.shape[1] // 2 * 2])

    def close(self) -> None:
        """Finish the file."""
        self._file.close()

    def __enter__(self) -> VideoWriter:
        return self

    def __exit__(self, *_: Any) -> None:
        self.close()


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


def _make_camera(model: mujoco.MjModel, data: mujoco.MjData, name: str) -> mujoco.MjvCamera:
    """Return a free camera that looks the way a camera of the scene does."""
    names = [model.camera(i).name for i in range(model.ncam)]
    if name not in names:
        raise RenderingError(f"unknown camera '{name}'{nearest(name, names)}")
    mujoco.mj_kinematics(model, data)
    mujoco.mj_camlight(model, data)
    forward = -data.camera(name).xmat.reshape(3, 3)[:, 2]
    camera = mujoco.MjvCamera()
    camera.type = mujoco.mjtCamera.mjCAMERA_FREE
    camera.azimuth = np.rad2deg(np.arctan2(forward[1], forward[0]))
    camera.elevation = np.rad2deg(np.arcsin(forward[2]))
    return camera


def _make_contexts(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
    """Return an OpenGL context, of the kind MUJOCO_GL asks for or else the first one installed, and MuJoCo's in it."""
    asked = os.environ.get("MUJOCO_GL", "").lower().strip()
    if asked in ("disable", "disabled", "off", "false", "0"):
        raise RenderingError(f"MUJOCO_GL={asked} forbids drawing; unset it")
    installed = [kind for kind, library in _LIBRARIES.items() if ctypes.util.find_library(library)]
    kind = asked if asked in (*_LIBRARIES, "glfw") else next(iter(installed), None)
    if kind is None:
        raise RenderingError(f"drawing needs OpenGL libraries that are not installed; run '{_INSTALL}'")
    size = model.vis.global_
    try:
        gl = importlib.import_module(f"mujoco.{kind}").GLContext(size.offwidth, size.offheight)
        gl.make_current()
        context = mujoco.MjrContext(model, mujoco.mjtFontScale.mjFONTSCALE_100)
    except Exception as error:  # each kind fails in its own ways: import, attribute, OpenGL and runtime errors
        cure = f"unset MUJOCO_GL={asked}" if asked else f"run '{_INSTALL}'"
        raise RenderingError(f"drawing by {kind} does not work ({' '.join(str(error).split())}); {cure}") from error
    mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, context)
    return gl, context


def _free(gl: Any, context: mujoco.MjrContext) -> None:
    with gl.as_current():
        context.free()
    gl.free()
