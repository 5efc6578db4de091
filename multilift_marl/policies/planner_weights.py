"""What flies teams by `control.action=planner_weights`: a planner whose weights are the drones' actions.

Each drone says what weighs how much in the plan of the team (`control.actions.PLANNER_WEIGHTS`); the plan is that of
`policy=mpc`, whose commands are those of `acc_rates`. With `planner.distributed` plans are those of `mpc_distributed`:
each drone weighs its own.
"""

from __future__ import annotations

from math import log
from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.control.actions import PLANNER_WEIGHTS, AccRatesAction
from multilift_marl.diffmpc.sensitivity import Gradient
from multilift_marl.diffmpc.weighted_planner import WeightedHardPlanner, WeightedPlanner
from multilift_marl.errors import ConfigError
from multilift_marl.mdp.observations import observation_names
from multilift_marl.planning.distributed_planner import DistributedPlanner
from multilift_marl.planning.team_weights import TeamWeights
from multilift_marl.policies.hold import HoldAccRates
from multilift_marl.policies.last_plan import LastPlan
from multilift_marl.policies.mpc import TeamMpc
from multilift_marl.policies.mpc_distributed import DistributedMpc
from multilift_marl.sim.saved import fingerprint

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec
    from multilift_marl.policies.policy import Policy

_NAMES = tuple(PLANNER_WEIGHTS)
_PAYLOAD = [("position", (0, 1)), ("height", (2,)), ("tilt", (3, 4)), ("yaw", (5,))]
_MOVING = [("velocity", (0, 1)), ("climb", (2,)), ("tilt_rate", (3, 4)), ("yaw_rate", (5,))]


class PlannerWeights:
    """Commands of E teams, see `envs/commander.py`.

    Args:
        vec: the environments.

    Attributes:
        mpc: that plans.

    Raises:
        ConfigError: see `TeamMpc`.
    """

    def __init__(self, vec: MultiliftVec):
        if vec.config.planner.feedback < 1.0:
            raise ConfigError("control.action=planner_weights commands acc_rates; set planner.feedback=1")
        self._apart = vec.config.planner.distributed
        if self._apart and (vec.config.planner.limits == "hard" or vec.num_drones < 2):
            raise ConfigError(
                "planner.distributed=true has soft limits, and two drones or more; set planner.limits=soft, or "
                "planner.distributed=false"
            )
        self._vec, self.mpc = vec, _DistributedWeightedMpc(vec) if self._apart else _WeightedMpc(vec)
        n = vec.num_drones
        self._scale = log(vec.config.control.max_weight)
        self._by_drone, self._rate_by_drone, self._by_end = weight_map(n)
        self._settings = fingerprint(str(vec.config.planner.model_dump(exclude_defaults=True)), vec.num_envs)

    @property
    def follows(self) -> np.ndarray:
        """Whether teams fly by the plans made last (E,) bool: none came late or failed, nor was a state unknown."""
        return self.mpc.follows

    @property
    def planner(self) -> WeightedPlanner | DistributedPlanner:
        """That which plans."""
        return self.mpc.planner

    def command(self, action: np.ndarray) -> np.ndarray:
        """See `Commander.command`."""
        # Of drones that plan for themselves each takes what it says for what all say.
        said = np.repeat(action.reshape(-1, 1, action.shape[-1]), action.shape[1], axis=1) if self._apart else action
        for mine, weights in zip(self.planner.weights, self.weigh(said), strict=True):
            mine[:] = weights
        return self.mpc.act(self._vec.outcome.observation)

    def weigh(self, action: np.ndarray) -> TeamWeights:
        """Return the weights of actions (..., N, A)."""
        action = self._scale * action.reshape(*action.shape[:-2], -1)
        objective = self.planner.objective

        def factor(by_action: np.ndarray) -> np.ndarray:
            # No matrix product: its bits depend on the number of rows.
            return np.exp(np.einsum("...a,ab->...b", action, by_action))

        return TeamWeights(
            objective.state * factor(self._by_drone),
            objective.end * factor(self._by_drone + self._by_end),
            objective.rate * factor(self._rate_by_drone),
        )

    def pull_back(self, gradient: Gradient, weights: TeamWeights) -> np.ndarray:
        """Return derivatives (T, E, N, A) by actions, from those by the weights (T, E, ...) that `weigh` made."""
        by_state, by_end, by_rate = (
            given * weight for given, weight in zip((gradient.state, gradient.end, gradient.rate), weights, strict=True)
        )
        total = by_state @ self._by_drone.T + by_end @ (self._by_drone + self._by_end).T
        total += by_rate @ self._rate_by_drone.T
        return self._scale * total.reshape(*total.shape[:-1], self._vec.num_drones, len(_NAMES))

    def reset(self, mask: np.ndarray) -> None:
        """See `Commander.reset`."""
        self.mpc.reset(mask)

    def arrays(self) -> dict[str, np.ndarray]:
        """See `Commander.arrays`."""
        return {"planner": self._settings} | self.mpc.arrays()

    def metrics(self) -> dict[str, np.ndarray]:
        """See `Commander.metrics`."""
        return self.mpc.metrics()


def weight_map(n: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return by how much the logarithm of each weight of N drones changes by each number of their actions.

    Of the state (13 N, 12 + 7 N), of the inputs (13 N, 3 N), and of the state at the end beside that (13 N, 12 + 7 N).
    """
    q, size = 6 + 2 * n, 12 + 7 * n
    state, rate, end = np.zeros((n, len(_NAMES), size)), np.zeros((n, len(_NAMES), 3 * n)), np.zeros((n, 13, size))
    for first, parts in ((0, _PAYLOAD), (q, _MOVING)):
        for name, places in parts:
            for place in places:
                state[:, _NAMES.index(name), first + place] = 1.0 / n
    for m in range(n):
        for name, first, count in (("cable", 6, 2), ("cable_rate", q + 6, 2), ("thrust", 2 * q, 3)):
            state[m, _NAMES.index(name), first + count * m : first + count * (m + 1)] = 1.0
        rate[m, _NAMES.index("thrust_rate"), 3 * m : 3 * (m + 1)] = 1.0
    end[:, _NAMES.index("end")] = 1.0 / n
    return state.reshape(-1, size), rate.reshape(-1, 3 * n), end.reshape(-1, size)


class _ByRates:
    """What acts by `acc_rates`, whatever the environment's actions are."""

    _vec: MultiliftVec
    _last: LastPlan

    @property
    def follows(self) -> np.ndarray:
        """See `PlannerWeights`; of drones that plan for themselves (E N,)."""
        return self._last.age == 0.0

    def _asked(self, vec: MultiliftVec) -> str:
        return f"control.action={vec.config.control.action}"

    def _interface(self, vec: MultiliftVec) -> str:
        return "acc_rates"

    def _make_fallback(self) -> Policy:
        return _HoldByRates(self._vec)


class _WeightedMpc(_ByRates, TeamMpc):
    """See `TeamMpc`."""

    planner: WeightedPlanner

    def _make_planner(self) -> WeightedPlanner:
        vec, settings = self._vec, self._vec.config.planner
        if settings.limits == "hard":
            return WeightedHardPlanner(vec.world.system, settings, vec.num_envs)
        return WeightedPlanner(vec.world.system, settings, vec.num_envs, vec.world.obstacles)


class _DistributedWeightedMpc(_ByRates, DistributedMpc):
    """See `DistributedMpc`."""


class _HoldByRates(HoldAccRates):
    """The same, in environments with other actions: it acts as by `acc_rates`, on what is observed with these."""

    def __init__(self, vec: MultiliftVec):
        observed = observation_names(self.INTERFACE, vec.task.extra(vec.config), vec.config.env.ages)
        self._columns = [vec.observation_names.index(name) for name in observed]  # so that it rounds alike, too
        self._observed = observed
        super().__init__(vec)

    def matrix(self) -> np.ndarray:
        """See `Formation.matrix`."""
        self._names, self._actions = self._observed, tuple(number.name for number in AccRatesAction.numbers)
        return super().matrix()

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return actions (E, N, 5) of `acc_rates` for observations (E, N, D)."""
        return super().act(np.take(observation, self._columns, axis=-1))
