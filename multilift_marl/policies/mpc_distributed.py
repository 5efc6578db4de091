"""Model-predictive control by drones that plan for themselves, `policy=mpc_distributed`.

Each drone plans the payload's motion with its own cable and thrust (`planning/distributed_planner.py`), from what it
knows of the payload and of itself. Of the others it knows what they have said: by `env.communication`, late and lossy;
where that is none, all of it at once.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, ClassVar

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.planning.distributed_planner import DistributedPlanner
from multilift_marl.policies.mpc import TeamMpc
from multilift_marl.policies.route_mpc import RouteMpc
from multilift_marl.sensing.communication import Links, make_links

if TYPE_CHECKING:
    from multilift_marl.envs.core import MultiliftVec
    from multilift_marl.policies.mpc import Preview


class DistributedMpc(TeamMpc):
    """See `TeamMpc`; plan e N + n is that of drone n of environment e."""

    NAME: ClassVar[str] = "mpc_distributed"
    INTERFACES: ClassVar[tuple[str, ...]] = ("acc_rates",)
    planner: DistributedPlanner

    def __init__(self, vec: MultiliftVec, preview: Preview | None = None):
        if vec.config.planner.limits == "hard" or vec.num_drones < 2:
            raise ConfigError(
                f"policy={self.NAME} has soft limits, and two drones or more; set planner.limits=soft, or take policy="
                f"{self.NAME.removesuffix('_distributed')}"
            )
        super().__init__(vec, preview)
        self._lately, self._known = np.zeros_like(self.planner.plans.states[:, 0]), np.zeros(len(self._fresh), bool)

    def _make_planner(self) -> DistributedPlanner:
        vec, env = self._vec, self._vec.config.env
        n, slots = vec.num_drones, vec.world.system.slots
        links = Links(~np.eye(n, dtype=bool), 0, 0.0, np.inf)
        if env.communication != "none":
            links = make_links(env, np.arctan2(slots[:, 1], slots[:, 0]))
        world, settings = vec.world, vec.config.planner
        if env.sensing in ("onboard", "blind"):
            # By senses of their own drones disagree on the payload, the more so with each sweep, until they tilt over.
            settings = settings.model_copy(update={"sweeps": 1})
        return DistributedPlanner(world.system, settings, vec.num_envs, world.obstacles, links, self._exact)

    def _time(self) -> np.ndarray:
        return np.repeat(self._vec.task.time, self._vec.num_drones)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """See `TeamMpc.reset`."""
        super().reset(None if mask is None else np.repeat(mask, self._vec.num_drones))

    def arrays(self) -> dict[str, np.ndarray]:
        """See `TeamMpc.arrays`; (E, N, ...) of what each drone has of its own, and messages (E, ...)."""
        teams = self._vec.num_envs, self._vec.num_drones
        own = super().arrays() | {"lately": self._lately, "known": self._known}
        found = {name: array.reshape(*teams, *array.shape[1:]) for name, array in own.items()}  # views
        return found | {f"Post.{name}": array for name, array in self.planner.post._asdict().items()}

    def metrics(self) -> dict[str, np.ndarray]:
        """See `TeamMpc.metrics`: means over the drones."""
        found = super().metrics()
        return {name: value.reshape(self._vec.num_envs, -1).mean(axis=1) for name, value in found.items()}

    def _look_ahead(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        n = self._vec.num_drones
        position, rotation, forces = super()._look_ahead(times[::n])
        repeated = None if forces is None else np.repeat(forces, n, axis=0)
        return np.repeat(position, n, axis=0), np.repeat(rotation, n, axis=0), repeated

    def _of_drones(self, vectors: np.ndarray) -> np.ndarray:
        e, n = self._vec.num_envs, self._vec.num_drones
        return vectors.reshape(e, n, n, 3)[:, np.arange(n), np.arange(n)]

    def _for_estimator(self, states: np.ndarray, known: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `TeamMpc._for_estimator`: exact states of all drones a step ago, as they have told each other since.

        Noisy ones estimate worse than where the others meant to be.
        """
        if not self._exact:
            return states, known
        n, numbers = self._vec.num_drones, np.arange(states.shape[1])
        teams = states.reshape(-1, n, states.shape[1])
        shared = teams[:, 0].copy()
        for own, others in enumerate(others_of(n)):
            is_own = ~np.isin(numbers, others)
            shared[:, is_own] = teams[:, own, is_own]
        before = self._lately.copy(), self._known & ~self._fresh
        self._lately[:], self._known[:] = np.repeat(shared, n, axis=0), known
        return before

    def _measure(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """See `TeamMpc._measure`, (E N, ...): as each drone knows the payload, and plans of the others."""
        e, n = self._vec.num_envs, self._vec.num_drones
        self.planner.measure_ranges(self._vec.world.state.drone_position)
        # Where all is said at once, so is where each takes the payload to be: all know the mean.
        knows = range(n) if self._vec.config.env.communication != "none" else [None] * n
        parts = [super(DistributedMpc, self)._measure_by(m) for m in knows]
        states = np.stack([part[0] for part in parts], axis=1).reshape(e * n, -1)
        rotations = np.stack([part[1] for part in parts], axis=1).reshape(e * n, 3, 3)
        known = ~self._fresh
        if known.any():
            planned, others = self._last.next(), others_of(n)
            rows = np.flatnonzero(known)
            states[rows[:, None], others[rows % n]] = planned[rows[:, None], others[rows % n]]
        return states, rotations, parts[0][2]


class DistributedRouteMpc(RouteMpc, DistributedMpc):
    """Routes as of `RouteMpc`, the same for all drones, flown by drones that plan for themselves."""

    NAME: ClassVar[str] = "mpc_route_distributed"


def others_of(n: int) -> np.ndarray:
    """Return where the numbers of the others' cables and thrusts are in a team's state, for each drone (N, 7 N - 7)."""
    q = 6 + 2 * n
    return np.array(
        [
            [
                at
                for m in range(n)
                if m != own
                for at in (
                    6 + 2 * m, 7 + 2 * m, q + 6 + 2 * m, q + 7 + 2 * m, *range(2 * q + 3 * m, 2 * q + 3 * m + 3)
                )
            ]
            for own in range(n)
        ]
    )  # fmt: skip
