"""Scripted teams, with the interface of learned policies: the yardsticks, and what learned ones start from."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.control.payload_geometric import PayloadGeometric
from multilift_marl.errors import ConfigError, nearest

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec

INTEGRAL_GAIN = 0.5  # [1/s]


class Formation:
    """Every drone holds its slot about the target payload pose: the zero action of the `reference` interface.

    Args:
        vec: environments with the interface `reference`.
    """

    def __init__(self, vec: MultiliftVec):
        self._names, self._actions = vec.observation_names, vec.action_names
        self._max_offset = vec.config.control.max_offset
        self._matrix = self.matrix()

    def matrix(self) -> np.ndarray:
        """Return M (A, D) float32 with which the action is M times the observation, clipped to [-1, 1]."""
        return np.zeros((len(self._actions), len(self._names)), np.float32)

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., N, A) float32 in [-1, 1] for observations (..., N, D)."""
        return np.clip(np.einsum("...d,ad->...a", np.asarray(observation, np.float32), self._matrix), -1, 1)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget nothing: the integral is part of the observation."""


class FormationIntegral(Formation):
    """The formation with its slots moved against the clipped integral of the payload's position error.

    By -k ∫ e dt [m], k = 0.5 1/s, along each axis of a drone's slot frame; a full action is `control.max_offset`.
    """

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        matrix = super().matrix()
        for axis in range(3):
            matrix[axis, self._names.index(f"payload_error_integral_{axis}")] = -INTEGRAL_GAIN / self._max_offset
        return matrix


LINEAR: dict[str, type[Formation]] = {"formation": Formation, "formation_integral": FormationIntegral}
"""Scripts that are maps of the observation."""
SCRIPTED: dict[str, type[Formation] | type[PayloadGeometric]] = {**LINEAR, "payload_geometric": PayloadGeometric}


def make_scripted(name: str, vec: MultiliftVec) -> Formation | PayloadGeometric:
    """Return the scripted policy `name` for the environments `vec`.

    Raises:
        ConfigError: there is no such script, or the environments have another action interface than scripts have.
    """
    if name not in SCRIPTED:
        raise ConfigError(f"unknown scripted policy '{name}'{nearest(name, SCRIPTED)}")
    check_interface(name, vec.config.control.action)
    return SCRIPTED[name](vec)


def check_interface(name: str, action: str) -> None:
    """Refuse the script `name` with an action interface that it does not know, by a ConfigError."""
    if action != "reference":
        raise ConfigError(
            f"the scripted policy '{name}' acts by control.action=reference and cannot fly control.action={action}; "
            "set control.action=reference, or leave the script out (baseline=none, train.residual=formation)"
        )


def residual_matrix(name: str, vec: MultiliftVec) -> np.ndarray:
    """Return M (A, D) of the script that a learned policy corrects; `formation` is zero with every interface.

    Raises:
        ConfigError: see `make_scripted`.
    """
    if name == "formation":
        return np.zeros((vec.action_size, vec.observation_size), np.float32)
    check_interface(name, vec.config.control.action)
    return LINEAR[name](vec).matrix()
