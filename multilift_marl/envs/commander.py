"""Action interfaces whose actions are no commands: a planner makes commands of them, once in a policy step."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any, Protocol

import numpy as np

COMMANDERS = {"planner_weights": "multilift_marl.policies.planner_weights:PlannerWeights"}
"""What makes commands, by `control.action`, as an entry point: it reads environments, which know nothing of it."""


class Commander(Protocol):
    """Makes commands of the actions of E teams."""

    def command(self, action: np.ndarray) -> np.ndarray:
        """Return what the controller takes (E, N, commands) for actions (E, N, A) in [-1, 1]."""

    def reset(self, mask: np.ndarray) -> None:
        """Begin anew in the environments of the mask (E,)."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Return live arrays of all that later commands depend on, environment first, by name."""

    def metrics(self) -> dict[str, np.ndarray]:
        """Return numbers (E,) of the episodes so far by name, which evaluation reports."""


def find_commander(action: str) -> Callable[[Any], Commander]:
    """Return what makes the commander of environments (MultiliftVec) with this `control.action`."""
    module, _, name = COMMANDERS[action].partition(":")
    found: Callable[[Any], Commander] = getattr(import_module(module), name)
    return found
