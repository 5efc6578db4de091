"""What a team flies by while no new plan can be had: the last sound one, as far as it goes."""

from __future__ import annotations

import numpy as np

from multilift_marl.planning.team_planner import Plans

NEVER = 1e6  # [s] without a plan where there never was one; finite, so that saved states hold sound numbers alone


class LastPlan:
    """The last sound plans of E teams, and how old they are.

    Args:
        plans: of `TeamPlanner`, for their shapes.
        step: length of a plan's steps [s].
        dt: policy step [s].
        ahead: policy steps from when a plan is made until it begins.

    Attributes:
        age: (E,) time since the plan was made [s].
        without: (E,) how long no sound plan has been made [s]; `NEVER` or more where there was none.
        steps, late, failed: (E,) policy steps of the episode, those with a late plan, those with one that failed.
    """

    def __init__(self, plans: Plans, step: float, dt: float, ahead: int = 0):
        self._begun = np.zeros((len(plans.states), ahead, plans.states.shape[2]))  # where plans under way begin
        self._states, self._inputs = np.zeros_like(plans.states), np.zeros_like(plans.inputs)
        self._step, self._dt = step, dt
        num_envs = len(self._states)
        self.age, self.without = np.zeros(num_envs), np.full(num_envs, NEVER)
        self.steps, self.late, self.failed = np.zeros((3, num_envs))

    def reset(self, mask: np.ndarray) -> None:
        """Forget the plans and counts of the teams in the mask (E,)."""
        self.without[mask] = NEVER
        for count in (self.age, self.steps, self.late, self.failed):
            count[mask] = 0.0

    def keep(self, plans: Plans, late: bool, failed: np.ndarray) -> None:
        """Take over the plans that came in time and did not fail (E,); all others grow older by a policy step."""
        sound, first = ~failed & (not late), self.without >= NEVER
        self._states[sound], self._inputs[sound] = plans.states[sound], plans.inputs[sound]
        self.age = np.where(sound, 0.0, self.age + self._dt)
        self.without = np.where(sound, 0.0, self.without + self._dt)
        self.steps += 1.0
        self.late += late
        self.failed += failed
        if self._begun.shape[1]:
            self._begun[:, :-1] = self._begun[:, 1:]
            self._begun[:, -1] = self.states()
            self._begun[first] = self._begun[first, -1:]  # nothing was planned for so early

    def next(self) -> np.ndarray:
        """Return where the team was planned to be (E, 12 + 7 N) a policy step after plans were made last."""
        return self._begun[:, 0].copy() if self._begun.shape[1] else self.states(self._dt)

    def states(self, later: float | np.ndarray = 0.0) -> np.ndarray:
        """Return the planned states (E, 12 + 7 N) `later` [s] from now, scalar or (E,); where a plan ends, its last."""
        every = np.arange(len(self.age))
        at = np.minimum((self.age + later) / self._step, self._inputs.shape[1])
        before = np.minimum(at.astype(int), self._inputs.shape[1] - 1)
        share = (at - before)[:, None]
        return (1.0 - share) * self._states[every, before] + share * self._states[every, before + 1]

    def inputs(self) -> np.ndarray:
        """Return the planned change of the thrust vectors (E, 3 N) now [N/s], zero where a plan has ended."""
        every, at = np.arange(len(self.age)), (self.age / self._step).astype(int)
        last = self._inputs.shape[1] - 1
        return np.where((at <= last)[:, None], self._inputs[every, np.minimum(at, last)], 0.0)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the live arrays, by name."""
        names = "_states", "_inputs", "_begun", "age", "without", "steps", "late", "failed"
        return {name.lstrip("_"): getattr(self, name) for name in names}

    def metrics(self) -> dict[str, np.ndarray]:
        """Return the shares of policy steps (E,) by metric."""
        steps = np.maximum(self.steps, 1.0)
        return {"planner_late": self.late / steps, "planner_failed": self.failed / steps}
