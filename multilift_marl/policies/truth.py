"""Environments as one sees them who knows the true states."""

from __future__ import annotations

from copy import copy
from typing import TYPE_CHECKING, Any

from multilift_marl.config.load import build_config

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec


def with_truth(vec: MultiliftVec) -> Any:
    """Return environments as a policy sees them that knows the true states of team and payload; arrays are live."""
    task = copy(vec.task)
    view = task.view
    task.view = view._replace(estimated=view.state, payload_estimate=view.payload, estimated_errors=view.true_errors)
    truth = {"env.sensing": "ideal", "env.communication": "none", "randomization.observation_noise": 0.0}
    return _Environments(vec, task, build_config(vec.config.model_dump(), truth))


class _Environments:
    """Environments of which some attributes are others."""

    def __init__(self, vec: MultiliftVec, task: Any, config: Any):
        self._vec, self.task, self.config = vec, task, config

    def __getattr__(self, name: str) -> Any:
        return getattr(self._vec, name)
