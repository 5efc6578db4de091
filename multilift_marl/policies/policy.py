"""What a policy is, and policies of one's own, named by module:Class."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.plugins import describe_error, find_callable

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


class Policy(Protocol):
    """What can fly a team: learned, a baseline or one's own.

    A policy may also have `metrics()`, numbers (E,) of the episodes so far by name, which evaluation reports.
    """

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (..., N, A) in [-1, 1] for observations (..., N, D)."""

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Begin new episodes in the environments of the mask (E,) bool (None: all)."""


class OwnPolicy:
    """A policy of one's own, of a class that module:Class names, whose mistakes are refused in one sentence.

    Args:
        name: module:Class, of an installed module, one in the current folder, or the path of a .py file. What it names
            is called with the environments and returns an object with `act(observation)` and `reset(mask)`, the mask
            (E,) bool.
        vec: the environments, with any action interface.
        key: that names it, for messages.

    Attributes:
        policy: that object.

    Raises:
        ConfigError: there is no such class, it fails, or has no `act` and `reset`; so does `act` where that fails or
            returns anything but finite floating point numbers (E, N, A).
    """

    def __init__(self, name: str, vec: MultiliftVec, key: str = "policy"):
        self._name, self._shape = f"{key} {name}", (vec.num_envs, vec.num_drones, vec.action_size)
        self.policy = self._call("", find_callable(name, key), vec)
        for method in ("act", "reset"):
            if not callable(getattr(self.policy, method, None)):
                raise ConfigError(f"{self._name} has no method '{method}': it needs act(observation) and reset(mask)")

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, A) for observations (E, N, D)."""
        action = np.asarray(self._call(".act", self.policy.act, observation))
        fits = action.shape == self._shape and action.dtype.kind == "f"
        if not fits or not np.isfinite(action).all():
            found = "some that are not finite" if fits else f"{action.dtype} {action.shape}"
            raise ConfigError(
                f"{self._name}.act must return finite floating point numbers {self._shape} (environments, drones, "
                f"numbers), but returned {found}"
            )
        return action

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Begin new episodes in the environments of the mask (E,) bool (None: all)."""
        self._call(".reset", self.policy.reset, np.ones(self._shape[0], bool) if mask is None else mask)

    def metrics(self) -> dict[str, np.ndarray]:
        """Return what the policy says of the episodes so far, numbers (E,) by name."""
        if not callable(function := getattr(self.policy, "metrics", None)):
            return {}
        found = self._call(".metrics", function)
        try:
            numbers = {str(name): np.asarray(values, float) for name, values in found.items()}
            fits = all(each.shape == self._shape[:1] for each in numbers.values())
        except (AttributeError, TypeError, ValueError):
            fits = False
        if not fits:
            raise ConfigError(
                f"{self._name}.metrics must return {{name: numbers ({self._shape[0]},)}}, not {found!r:.200}"
            )
        return numbers

    def _call(self, method: str, function: Any, *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except Exception as error:  # a user's code may raise anything
            raise ConfigError(f"{self._name}{method} failed: {describe_error(error)}") from error
