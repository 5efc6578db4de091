"""OpenGL that draws off-screen."""

from __future__ import annotations

import ctypes.util
import importlib
import os
from typing import Any

import mujoco

from multilift_marl.errors import RenderingError

_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa"}  # in the order of preference: EGL can use a graphics card
_INSTALL = "apt-get install libegl1 libegl-mesa0 libgl1 libgl1-mesa-dri libosmesa6"


def make_contexts(model: mujoco.MjModel) -> tuple[Any, mujoco.MjrContext]:
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


def free_contexts(gl: Any, context: mujoco.MjrContext) -> None:
    """Free what `make_contexts` returned."""
    with gl.as_current():
        context.free()
    gl.free()
