"""A rig that is refused, as a still that can be drawn, what conflicts in red."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.math3d import mat_to_quat
from multilift_marl.rig.resolve import draft_system
from multilift_marl.rig.system import System

CONFLICT_COLOUR = (0.90, 0.0, 0.0, 1.0)
_OTHERS_COLOUR = (0.62, 0.62, 0.62)  # of drones beside those that conflict
_HEIGHT = 1.5  # [m] of the payload's centre of mass, more where something would be below the ground
_CLEARANCE = 0.3  # [m] of the lowest part above the ground
_MARK = 0.025  # [-] of an anchor that conflicts, over the largest edge of the team


class Draft:
    """One still environment of a rig that is refused: a `Renderer` or `Stage` draws it like others.

    Drones stand where they would at rest, on straight cables without mass. Where the forces would not balance, cables
    lean as the configuration asks. What conflicts is red: drones, and anchors.

    Args:
        config: of the rig.

    Attributes:
        conflict: why it is refused, one sentence, and the parts that conflict.

    Raises:
        ConfigError: not even a picture of it can be made.
        ValueError: the rig can be.
    """

    def __init__(self, config: Config):
        drafted, self.conflict = draft_system(config)
        system = replace(drafted, cable_model="massless")
        self.num_envs, self.num_drones = 1, system.num_drones
        self.steps, self.seeds, self.episodes = np.zeros(1, int), np.zeros(1, int), np.zeros(1, int)
        self.world: Any = place_at_rest(system)
        position = self.world.state.payload_position
        goal = SimpleNamespace(position=position, rotation=np.eye(3)[None], yaw=np.zeros(1))
        self.task: Any = SimpleNamespace(
            name=config.task, dt=1 / config.env.policy_hz, goal=goal,
            target_path=lambda env: np.zeros((0, 3)), scenery=lambda env: [],
        )  # fmt: skip

    def mark(self, model: mujoco.MjModel) -> None:
        """Colour what conflicts in a model with `visuals`, and hide the target: there is nothing to reach."""
        model.geom_rgba[model.geom_bodyid == model.body("target").id, 3] = 0.0
        conflict, system = self.conflict, self.world.system
        for i in range(self.num_drones if conflict.drones else 0):
            shown = (model.geom_bodyid == model.body(f"drone_{i}").id) & (model.geom_rgba[:, 3] > 0)
            model.geom_rgba[shown, :3] = CONFLICT_COLOUR[:3] if i in conflict.drones else _OTHERS_COLOUR
        edge = np.ptp(np.concatenate([system.slots, system.anchors, [system.payload_size]]), axis=0).max()
        for i in conflict.anchors:
            site = model.site(f"payload/anchor_{i}")
            site.rgba[:] = CONFLICT_COLOUR
            site.size[:] = _MARK * edge


def place_at_rest(system: System) -> SimpleNamespace:
    """Return the team at rest, level, above the ground, with what is drawn of a `World` of massless cables."""
    lowest = min(-system.payload_size.max(), system.anchors[:, 2].min(), system.slots[:, 2].min())
    position = np.array([0.0, 0.0, max(_HEIGHT, _CLEARANCE - lowest)])
    payload = position if system.payload_shape == "point" else [*position, 1.0, 0.0, 0.0, 0.0]
    drones = [
        [*(position + slot), *mat_to_quat(tuple(float(x) for x in rotation.ravel()))]
        for slot, rotation in zip(system.slots, system.resting_rotation, strict=True)
    ]
    qpos = np.concatenate([payload, *drones])
    state = SimpleNamespace(
        payload_position=position[None], drone_position=(position + system.slots)[None],
        cable_tension=system.resting_tension[None], cable_broken=np.zeros((1, system.num_drones), bool),
    )  # fmt: skip
    return SimpleNamespace(system=system, state=state, nodes=None, diverged=np.zeros(1, bool), qpos=lambda env: qpos)
