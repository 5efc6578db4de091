"""A batched expert: plans of thousands of teams that converge within hard limits, by states and goals alone.

    expert = TeamExpert(ml.load_config("hover", {"env.num_drones": 3}))
    states = expert.rest_states(np.array([0.2, 0.0, 1.0]))
    plans = expert.solve(states, pose_goal(expert.times, np.array([0.0, 0.0, 1.0])))

It needs no environments; states are those of `team_model.py`.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import kernel
from multilift_marl.planning.augmented_lagrangian import CONVERGED, STATUS
from multilift_marl.planning.flatness import (
    SAMPLES,
    STEP,
    FlatMotion,
    FlatWork,
    make_flat_team,
    set_flat_state,
    steady_shape,
)
from multilift_marl.planning.goals import Goal, pose_goal
from multilift_marl.planning.hard_limits import limit_names
from multilift_marl.planning.hard_planner import (
    MOST_ITERATIONS,
    TOLERANCE,
    HardWork,
    make_hard_plans,
    make_limits,
    solve_teams,
)
from multilift_marl.planning.team_model import has_model, make_model, state_size
from multilift_marl.planning.team_planner import Plans, make_objective, make_surroundings

COSTS = "position", "attitude", "cable", "velocity", "body_rates", "cable_rates", "thrust", "thrust_rate"
STEEPEST = 0.99  # horizontal component of a cable's unit vector that a state may have


class Solution(NamedTuple):
    """Plans of E teams, K steps each, with L limits in each step."""

    states: np.ndarray
    """(E, K + 1, 12 + 7 N), which follow the model, see `team_model.py`."""
    inputs: np.ndarray
    """(E, K, 3 N) change of the thrust vectors [N/s]."""
    targets: np.ndarray
    """(E, K + 1, 12 + 7 N) that costs count from."""
    costs: np.ndarray
    """(E, 8) by what they are for, see `COSTS`."""
    margins: np.ndarray
    """(E, K, L) left to each limit, in its tolerance; negative beyond it. `TeamExpert.limit_names` names them."""
    multipliers: np.ndarray
    """(E, K, L) by which the cost would fall if the limit were one tolerance wider."""
    status: np.ndarray
    """(E,) int64, an index into `augmented_lagrangian.STATUS`."""
    iterations: np.ndarray
    """(E,) int64."""
    residual: np.ndarray
    """(E, 3) stationarity, feasibility and complementarity of the KKT conditions, see `Report.residual`."""

    @property
    def converged(self) -> np.ndarray:
        """(E,) bool, plans whose KKT residual is at most that asked for."""
        return self.status == CONVERGED

    @property
    def active(self) -> np.ndarray:
        """(E, K, L) bool, limits that hold the plan back."""
        return self.multipliers > np.maximum(self.margins, 0.0)

    @property
    def status_names(self) -> list[str]:
        """Status of each plan in words."""
        return [STATUS[i] for i in self.status]


class TeamExpert:
    """Plans of teams by states and goals.

    Args:
        config: whose rig and section `planner` count; `planner.iterations` are those of a plan at most.
        tolerance: largest KKT residual of a plan that has converged.

    Attributes:
        times: (K + 1, 5) of the payload's poses that make a goal, from the start of a plan [s].
        model, objective, limits: of the team.
        limit_names: of each step.

    Raises:
        ConfigError: a body that hangs on one point, see `team_model.has_model`.
    """

    def __init__(self, config: Config, tolerance: float = TOLERANCE):
        system, settings = config.system, config.planner
        n, steps = system.num_drones, settings.steps
        if not has_model(system):
            raise ConfigError(
                "the expert plans for bodies with two anchors or more, apart, and for points; give another rig"
            )
        self.times = settings.step * np.arange(steps + 1)[:, None] + STEP * (np.arange(SAMPLES) - SAMPLES // 2)
        self.model = make_model(system)
        self.objective = make_objective(settings, system, self.model)
        self.limits = make_limits(settings, system, self.model, self.objective)
        self.limit_names = limit_names(n)
        self._settings, self._tolerance, self._size = settings, tolerance, state_size(n)
        self._flat = make_flat_team(self.model, system)
        self.around = make_surroundings(settings, system, self.model)
        self._shape = steady_shape(self._flat)

    def rest_states(self, positions: np.ndarray, rotations: np.ndarray | None = None) -> np.ndarray:
        """Return states (E, 12 + 7 N) of teams that hold the payload at rest.

        Args:
            positions: (3,) or (E, 3) of the payload [m].
            rotations: (3, 3) or (E, 3, 3) its attitude; None: level, heading along x.

        Raises:
            ConfigError: see `pose_goal`.
        """
        goal = pose_goal(self.times, positions, rotations)
        states = np.zeros((len(goal.positions), self._size))
        motion = np.ascontiguousarray(goal.positions[:, 0]), np.ascontiguousarray(goal.rotations[:, 0])
        _set_rest((*motion, self._shape), np.zeros(7), self._flat, FlatWork.of(len(self.model.anchors)), states)
        return states

    def random_states(
        self, count: int, seed: int = 0, position: tuple[float, float, float] = (0.0, 0.0, 1.0),
        ranges: tuple[float, float, float, float] = (0.3, 0.5, 0.1, 0.5),
    ) -> np.ndarray:  # fmt: skip
        """Return states (E, 12 + 7 N) about rest, each number uniform, of `count` teams.

        Args:
            count: E.
            seed: of the draw.
            position: of the payload [m].
            ranges: ± of its position [m], of its velocity [m/s], of c [-] and of ċ [1/s], see `team_model.py`.
        """
        rng, n = np.random.default_rng(seed), len(self.model.anchors)
        distance, speed, lean, swing = ranges
        states = np.tile(self.rest_states(np.array(position)), (count, 1))
        q = 6 + 2 * n
        states[:, :3] += rng.uniform(-distance, distance, (count, 3))
        states[:, q : q + 3] += rng.uniform(-speed, speed, (count, 3))
        states[:, q + 6 : 2 * q] += rng.uniform(-swing, swing, (count, 2 * n))
        states[:, 6:q] += rng.uniform(-lean, lean, (count, 2 * n))
        return states

    def solve(
        self, states: np.ndarray, goal: Goal, loads: np.ndarray | None = None, last: Solution | None = None,
        elapsed: float = 0.0,
        threads: int = 1,
    ) -> Solution:  # fmt: skip
        """Return the plans of E teams. They do not depend on each other, nor on the number of threads.

        Args:
            states: (12 + 7 N,) or (E, 12 + 7 N) where plans begin.
            goal: of one team for all, or of each, see `goals.py`.
            loads: (E, 7) on the payload, see `team_model.accelerations`; None for none.
            last: plans of these teams to begin with; None: a cold start.
            elapsed: time since those [s].
            threads: among which teams are divided.

        Raises:
            ConfigError: other shapes, numbers that are not finite, cables that lie almost level.
        """
        states, n, steps = self._checked(states), len(self.model.anchors), self._settings.steps
        count = len(states)
        positions = _of_each("goal's positions", goal.positions, count, (*self.times.shape, 3))
        rotations = _of_each("goal's rotations", goal.rotations, count, (*self.times.shape, 3, 3))
        loads = _of_each("loads", np.zeros((1, 7)) if loads is None else loads, count, (7,))
        if threads < 1 or not 0.0 <= elapsed < np.inf:
            raise ConfigError(
                f"threads={threads}, elapsed={elapsed} cannot be; give one thread or more, and a time [s]"
            )
        shape = (count, steps + 1, self._size)
        fresh = np.full(count, last is None)
        plans = Plans(np.zeros(shape), np.zeros((count, steps, 3 * n)), np.zeros(shape), fresh, np.zeros(count, bool))
        hard = make_hard_plans(count, steps, n)
        if last is not None:
            if last.states.shape != shape:
                raise ConfigError(
                    f"the last plans have shape {last.states.shape}, not {shape}; give those of these teams"
                )
            plans.states[:], plans.targets[:] = last.states, last.targets
            hard.multipliers.push[:] = last.multipliers
        given = states, loads, (positions, rotations, self._shape[None, None], np.zeros((count, steps + 1, 12)))
        settings = elapsed, self._settings.step, self._settings.iterations or MOST_ITERATIONS, self._tolerance
        team = self._flat, self.objective, self.limits, self.around

        def solve(lo: int, hi: int) -> None:
            work = HardWork.of(steps, n)
            solve_teams((lo, hi), given, settings, team, plans, hard, work)

        bounds = np.linspace(0, count, min(threads, count) + 1).astype(int)
        if len(bounds) == 2:
            solve(0, count)
        else:
            with ThreadPoolExecutor(len(bounds) - 1) as pool:
                list(pool.map(solve, bounds[:-1].tolist(), bounds[1:].tolist()))
        m, report = hard
        return Solution(
            plans.states, plans.inputs, plans.targets, self._costs(plans), m.values, m.push, report.status,
            report.iterations, report.residual,
        )  # fmt: skip

    def _checked(self, states: np.ndarray) -> np.ndarray:
        """Return states (E, 12 + 7 N)."""
        array = np.array(states, float, ndmin=2, order="C")
        if array.ndim != 2 or array.shape[1] != self._size or not len(array):
            n = len(self.model.anchors)
            raise ConfigError(
                f"states have shape {np.shape(states)}; give (E, {self._size}) for E teams of {n} drones, as "
                "`rest_states` does"
            )
        if wrong := np.flatnonzero(~np.isfinite(array).all(axis=1)).tolist():
            raise ConfigError(f"the state of team {wrong[0]} holds numbers that are not finite; correct it")
        n = len(self.model.anchors)
        level = np.linalg.norm(array[:, 6 : 6 + 2 * n].reshape(len(array), n, 2), axis=-1).max(axis=1)
        if wrong := np.flatnonzero(level > STEEPEST).tolist():
            raise ConfigError(
                f"a cable of team {wrong[0]} lies almost level (|c| = {level[wrong[0]]:.3g}); give states "
                f"with |c| below {STEEPEST}"
            )
        return array

    def _costs(self, plans: Plans) -> np.ndarray:
        """Return costs (E, 8) by what they are for."""
        n, h, objective = len(self.model.anchors), self._settings.step, self.objective
        off = (plans.states - plans.targets) ** 2
        each = 0.5 * (h * objective.state * off[:, :-1].sum(axis=1) + objective.end * off[:, -1])
        thrusts = plans.targets[:, :, -3 * n :]
        rate = plans.inputs - np.diff(thrusts, axis=1) / h
        ends = np.cumsum([3, 3, 2 * n, 3, 3, 2 * n])
        parts = [part.sum(axis=1) for part in np.split(each, ends, axis=1)]
        return np.stack([*parts, 0.5 * h * (objective.rate * rate**2).sum(axis=(1, 2))], axis=1)


@kernel
def _set_rest(motion, load, flat, w, states):
    positions, rotations, shape = motion
    for e in range(states.shape[0]):
        set_flat_state(FlatMotion(positions[e], rotations[e], shape), 0.0, load, flat, w, states[e])


def _of_each(name: str, values: np.ndarray, count: int, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array (E, *shape), of one for all or of each."""
    array = np.asarray(values, float)
    if array.shape[1:] != shape or len(array) not in (1, count):
        raise ConfigError(f"the {name} have shape {array.shape}; give ({count}, {str(shape)[1:]}, or one for all")
    if not np.isfinite(array).all():
        raise ConfigError(f"the {name} hold numbers that are not finite; correct them")
    return np.array(np.broadcast_to(array, (count, *shape)), order="C")
