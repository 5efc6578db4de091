"""Slots that hold the true payload by the drones that carry it: `policy=formation_balanced`, a bound, no baseline.

It knows what the drones do not: mass and centre of mass of the payload, whose cables are attached, and where the
payload is. Cable forces are those nearest to the formation's that balance the payload level; slots are where drones
exert them. What is left of the anchors' errors is taken out by proportional and integral feedback.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.control.cable_forces import solve_cable_forces
from multilift_marl.control.gains import make_gains
from multilift_marl.errors import ConfigError
from multilift_marl.physical import GRAVITY
from multilift_marl.policies.slot_offsets import offset_actions
from multilift_marl.tasks.regroup import TAKE_UP, Regroup

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

LEAST = 0.3  # tension of every cable, over that of the formation with this payload
LIFT = 1.0  # [-] of an anchor's error in height
RATES = np.array([0.3, 0.3, 0.6])  # [1/s] of the integrals of its errors
LEVEL = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


class FormationBalanced:
    """Acts by `reference`.

    Args:
        vec: environments of `regroup`; what is true of them is read at `act`.
    """

    INTERFACE: ClassVar[str] = "reference"

    def __init__(self, vec: MultiliftVec):
        if not isinstance(vec.task, Regroup):
            raise ConfigError("policy=formation_balanced is for task regroup; take formation_integral")
        self._vec, self._gains = vec, make_gains(vec.config.control, vec.world.system)
        shape = (vec.num_envs, vec.num_drones)
        self._carried = np.zeros(shape, bool)
        self._fresh = np.ones(vec.num_envs, bool)
        self._held, self._former, self._sum = np.zeros((3, *shape, 3))
        self._share = np.ones(shape)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget what was in the environments of the mask (E,) (None: all)."""
        self._fresh[slice(None) if mask is None else mask] = True

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 4) in [-1, 1] for the present state of the environments."""
        vec, view, goal = self._vec, self._vec.task.view, self._vec.task.goal
        attached = vec.task.own.attached
        # 1. Slots of the present team, and of the one before; one that has joined takes its share little by little.
        self._share[self._fresh] = attached[self._fresh]
        for e in np.flatnonzero(self._fresh | (attached != self._carried).any(axis=1)):
            held = self._balance(int(e))
            self._former[e] = held if self._fresh[e] else self._held[e]
            self._held[e] = held
            if self._fresh[e]:
                self._sum[e] = 0.0
        self._carried[:], self._fresh[:] = attached, False
        self._share = np.where(attached, np.minimum(self._share + vec.task.dt / TAKE_UP, 1.0), 0.0)
        left = 1.0 - np.where(attached, self._share, 1.0).min(axis=1)[:, None, None]
        offset = _turn(goal.yaw, self._held + left * (self._former - self._held))
        # 2. Feedback of the anchors' true errors.
        arms = _turn(goal.yaw, np.broadcast_to(vec.world.system.anchors, self._held.shape))
        error = view.true_errors.position + np.cross(view.true_errors.rotation, arms)
        self._sum = np.where(attached[..., None], np.clip(self._sum + vec.task.dt * error, -0.5, 0.5), 0.0)
        feedback = RATES * self._sum
        feedback[..., 2] += LIFT * error[..., 2]
        return offset_actions(offset - attached[..., None] * feedback, goal, vec.config.control.max_offset)

    def _balance(self, e: int) -> np.ndarray:
        """Return by how much slots move for the true payload and those that carry it (N, 3), payload frame [m]."""
        system, true = self._vec.world.system, self._vec.task.view.parameters
        keep = np.flatnonzero(self._vec.task.own.attached[e])
        offset = np.zeros((system.num_drones, 3))
        if not len(keep):
            return offset
        weight = GRAVITY * float(true.payload_mass[e])
        nominal = system.formation_force[keep]
        force = nominal * weight / nominal[:, 2].sum()
        arms = np.ascontiguousarray(system.anchors[keep] - true.payload_center_of_mass[e])
        solve_cable_forces((0.0, 0.0, weight), (0.0, 0.0, 0.0), LEVEL, arms, LEAST, force)
        size = np.linalg.norm(force, axis=1, keepdims=True)
        length = true.cable_length[e][keep, None] + size / true.cable_stiffness[e][keep, None]
        moved = system.anchors[keep] + length * force / size - system.cable_ends[keep]
        # A drone that is pulled by more than its formation's force hangs back by what its position gain gives way.
        stiffness = (self._gains.mass * self._gains.k_p)[keep, None]
        offset[keep] = moved + (force - nominal) / stiffness
        return offset


def _turn(yaw: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """Return vectors (E, N, 3) turned about z by yaw (E,)."""
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.stack([c * x - s * y, s * x + c * y, z], -1)
