"""Scripted teams, with the interface of learned policies: the yardsticks."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from multilift_marl.errors import ConfigError, nearest

INTEGRAL_GAIN = 0.5  # [1/s]


class Formation:
    """Every drone holds its slot about the target payload pose: the zero action of the `reference` interface."""

    def __init__(self, observation_names: Sequence[str], max_offset: float):
        self.observation_names, self.max_offset = tuple(observation_names), max_offset

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., N, 4) for observations (..., N, D)."""
        return np.zeros((*np.shape(observation)[:-1], 4), np.float32)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Forget nothing: the integral is part of the observation."""


class FormationIntegral(Formation):
    """The formation with its slots moved against the clipped integral of the payload's position error."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., N, 4) for observations (..., N, D)."""
        action = super().act(observation)
        first = self.observation_names.index("payload_error_integral_0")
        action[..., :3] = -INTEGRAL_GAIN / self.max_offset * np.asarray(observation)[..., first : first + 3]
        return np.clip(action, -1, 1)


SCRIPTED: dict[str, type[Formation]] = {"formation": Formation, "formation_integral": FormationIntegral}


def make_scripted(name: str, vec) -> Formation:
    """Return the scripted policy `name` for the environments `vec`.

    Raises:
        ConfigError: there is no such script.
    """
    if name not in SCRIPTED:
        raise ConfigError(f"unknown scripted policy '{name}'{nearest(name, SCRIPTED)}")
    return SCRIPTED[name](vec.observation_names, vec.config.control.max_offset)
