"""Weights of plans that are not the same for all teams."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.riccati import Objective


class TeamWeights(NamedTuple):
    """Weights of E teams, see `riccati.Objective`."""

    state: np.ndarray
    """(E, 12 + 7 N)."""
    end: np.ndarray
    """(E, 12 + 7 N)."""
    rate: np.ndarray
    """(E, 3 N)."""

    @classmethod
    def of(cls, objective: Objective, num_envs: int) -> TeamWeights:
        """Return those of an objective, for each team."""
        return cls(*(np.tile(each, (num_envs, 1)) for each in (objective.state, objective.end, objective.rate)))


@kernel
def weigh(e, weights, objective):
    """Return an objective with the weights of team e."""
    return Objective(
        weights.state[e], weights.end[e], weights.rate[e], objective.tension, objective.thrust, objective.separation,
        objective.weights,
    )  # fmt: skip
