"""Carry the measured cable force: `policy=formation_adaptive`, for unknown payloads and teams that change.

A drone puts its slot to where it would exert the cable force that it measures, filtered, on an anchor that is in its
place: along the cable's direction, and farther out by what its position gain gives way under the force. What is left
of its anchor's error it takes out by proportional and integral feedback. Nothing is known of the payload's mass, of the
other drones and of whether they carry. Numbers: most successes on training episodes of `regroup_senses`
(`results/tune_rules.py`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.control.gains import make_gains
from multilift_marl.errors import ConfigError
from multilift_marl.tasks.regroup import TAKE_UP

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

NEEDED = ("anchor_error", "cable", "measured_tension")


class FormationAdaptive:
    """Acts by `reference`, each drone on its own observation alone.

    Args:
        vec: environments with `env.sensing=onboard`.

    Class attributes:
        GIVE: share of the measured force's change that the slot makes up for [-].
        LEAN: share of the cable's change of direction that the slot follows [-].
        FILTER: time constant of the measured force [s].
        LIFT: of the anchor's error in height [-].
        LIFT_RATE, SHIFT_RATE: of the integrals of its errors in height and level [1/s].
    """

    INTERFACE: ClassVar[str] = "reference"
    GIVE: float = 0.414
    LEAN: float = 0.362
    FILTER: float = 1.34
    LIFT: float = 0.9
    LIFT_RATE: float = 1.46
    SHIFT_RATE: float = 0.588

    def __init__(self, vec: MultiliftVec):
        if not self.sees(vec):
            raise ConfigError(
                "policy=formation_adaptive needs to measure cables; set env.sensing=onboard, env.units=si"
            )
        system, gains = vec.world.system, make_gains(vec.config.control, vec.world.system)
        shape = (vec.num_envs, vec.num_drones)
        self._dt, self._largest = 1.0 / vec.config.env.policy_hz, vec.config.control.max_offset
        names = vec.observation_names
        self._at = {name: names.index(f"{name}_0") for name in NEEDED}
        self._attached = names.index("attached_0") if "attached_0" in names else None
        self._resting, self._length = system.resting_tension, system.cable_length[:, None]
        self._stiffness = (gains.mass * gains.k_p)[:, None]
        # Nominal cable force in the slot frame: x outward through the slot.
        c, s = np.cos(system.slot_azimuth), np.sin(system.slot_azimuth)
        x, y, z = system.formation_force.T
        self._nominal = np.stack([c * x + s * y, c * y - s * x, z], -1)
        self._force = np.zeros((*shape, 3))
        self._sum = np.zeros((*shape, 3))
        self._share = np.zeros(shape)
        self._fresh = np.ones(vec.num_envs, bool)

    @staticmethod
    def sees(vec: MultiliftVec) -> bool:
        """Return whether drones measure the tension and direction of their cables, lengths in metres."""
        return vec.config.env.units == "si" and all(f"{name}_0" in vec.observation_names for name in NEEDED)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget what was measured in the environments of the mask (E,) (None: all)."""
        self._fresh[slice(None) if mask is None else mask] = True

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 4) in [-1, 1] for observations (E, N, D)."""
        error, cable = (self._read(observation, name, 3) for name in ("anchor_error", "cable"))
        tension = self._resting * (1.0 + self._read(observation, "measured_tension", 1)[..., 0])
        attached = np.ones(tension.shape, bool) if self._attached is None else observation[..., self._attached] > 0.5
        self._force[self._fresh], self._sum[self._fresh] = self._nominal, 0.0
        self._share[self._fresh] = attached[self._fresh]
        self._fresh[:] = False
        self._share = np.where(attached, np.minimum(self._share + self._dt / TAKE_UP, 1.0), 0.0)

        measured = cable / np.maximum(np.linalg.norm(cable, axis=-1, keepdims=True), 1e-6) * tension[..., None]
        holds = attached[..., None] * self._dt
        self._force += holds * min(1.0 / self.FILTER, 1.0 / self._dt) * (measured - self._force)
        self._sum = np.clip(self._sum + holds * error, -0.5, 0.5)

        change = self.GIVE * (self._force - self._nominal)
        force = self._nominal + change
        turned = _unit(force) - _unit(self._nominal)
        offset = self.LEAN * self._length * turned + change / self._stiffness
        offset -= self._sum * [self.SHIFT_RATE, self.SHIFT_RATE, self.LIFT_RATE]
        offset[..., 2] -= self.LIFT * error[..., 2]
        offset *= self._share[..., None]
        action = np.concatenate([offset / self._largest, np.zeros((*tension.shape, 1))], -1)
        return np.clip(action, -1.0, 1.0)

    def _read(self, observation: np.ndarray, name: str, size: int) -> np.ndarray:
        at = self._at[name]
        return np.asarray(observation[..., at : at + size], float)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6))
