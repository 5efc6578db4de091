"""Cables that have broken: what a simulation's own model loses with one."""

from __future__ import annotations

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl.config.system import System

_FAR = 1e9  # [m] at which the limit of a broken cable's tendon begins


def cut_cables(batch: Batch, model: mujoco.MjModel, system: System, broken: np.ndarray) -> None:
    """Let the cables in `broken` (n, N) bool of a batch's n simulations pull no more, and all others be whole.

    A chain breaks in its segment next to the drone, where its tension is largest: the spring, damper and bending of
    that link go, and its ball and slide leave the drone free to move anywhere.
    """
    if system.cable_model == "massless":
        batch.expand("tendon_range")[..., 1] = np.where(broken, _FAR, system.cable_length)
        return
    stiffness, damping = batch.expand("jnt_stiffness"), batch.expand("dof_damping")
    for i, links in enumerate(system.cable_segments):
        slide = model.joint(f"cable_{i}/stretch_{links - 1}")
        whole = ~broken[:, i, None]
        joints = slice(slide.id - 1, slide.id + 1)  # the link's ball and slide
        dofs = slice(slide.dofadr[0] - 3, slide.dofadr[0] + 1)
        stiffness[:, joints] = whole * model.jnt_stiffness[joints]
        damping[:, dofs] = whole * model.dof_damping[dofs]
