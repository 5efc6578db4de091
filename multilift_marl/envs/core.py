"""The batched environment that all APIs build on: E environments of N drones, stepped together."""

from __future__ import annotations

from collections.abc import Callable
from copy import copy
from typing import Any, ClassVar

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import resolve_config
from multilift_marl.control.controller import Controller
from multilift_marl.envs.commander import COMMANDERS, Commander, find_commander
from multilift_marl.envs.episodes import Episodes
from multilift_marl.envs.history import History
from multilift_marl.envs.options import Rows, check_mask, check_seed
from multilift_marl.envs.pipeline import Pipeline, StageContext, describe_stages, join_pipelines
from multilift_marl.envs.refusals import check_action, ending_all, refuse_action, refuse_step
from multilift_marl.envs.step_kernels import TAKEN, Outcome, end_step, take_actions
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import bind
from multilift_marl.mdp.observations import observation_names
from multilift_marl.rig.resolve import whole_ratio
from multilift_marl.sensing.estimator import StateEstimator
from multilift_marl.sensing.measurement import Sensing
from multilift_marl.sim.saved import check_counts, check_saved, fingerprint
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World
from multilift_marl.tasks import find_task

TRAINING, TRAINING_EVALUATION, EVALUATION = 0, 1, 2  # purposes of seeds
_SAVED = ("_stacked", "seeds", "episodes", "steps", "_ended")  # arrays of its own


class MultiliftVec:
    """E environments of one task. The core does not reset by itself. Copies, also by pickle, go on bit for bit.

    Class attributes:
        world_type: of its world.

    Args:
        config: what to build.
        purpose: first part of every episode's seed: training, evaluation during training, or evaluation.
        first_env: number of the first environment; environment e here is number first_env + e.

    Attributes:
        config, purpose, first_env: as given.
        num_envs, num_drones, observation_size, action_size, state_size: E, N, D, A, S.
        observation_names, action_names: names of the D and A numbers.
        reward_terms: names of the reward terms.
        failure_causes: names of the values of `info["failure_cause"]`.
        max_steps: policy steps of an episode.
        control_ticks: control steps of a policy step.
        seeds, episodes, steps: of the episodes in progress: seed, number, policy steps so far (E,) int64.
        world: the physics; `world.state` is the true state.
        controller: of the drones; `reference` is its reference.
        commander: what makes commands of actions, see `envs/commander.py`; None: actions are commands.
        outcome: what the last step led to; live arrays.
        task: the task; `task.goal` and `task.errors` say where the payload should be.

    Raises:
        ConfigError: an unknown task, an impossible system, or settings that do not go together.
    """

    world_type: ClassVar[type[World]] = World

    def __init__(self, config: Config, purpose: int = TRAINING, first_env: int = 0):
        if first_env < 0:
            raise ConfigError(f"first_env must not be negative, but is {first_env}")
        kind = find_task(config.task)
        self.config, self.purpose, self.first_env = config, purpose, first_env
        self.num_envs, self.num_drones = config.env.num_envs, config.system.num_drones
        e = self.num_envs
        self.control_ticks = whole_ratio(config.sim.control_hz, config.env.policy_hz, "env.policy_hz", "sim.control_hz")
        self.max_steps = round(config.env.episode_seconds * config.env.policy_hz)
        if self.max_steps < 1:
            raise ConfigError(f"env.episode_seconds={config.env.episode_seconds} is shorter than one step; raise it")
        self.world = self.world_type(config.system, e, config.env.num_threads)
        level = config.env.sensing
        estimator = None if level == "ideal" else StateEstimator(level, self.world, config.sim.control_hz)
        self.controller = Controller(config, self.world, estimator.state if estimator else None)
        self.reference = self.controller.reference
        self.action_names = self.controller.action_names
        self.action_size = a = len(self.action_names)
        self.observation_names = observation_names(config.control.action, kind.extra(config), config.env.ages)
        self.observation_size = len(self.observation_names)
        self._estimator = estimator
        commands = self.controller.command_size
        sizes = a, self.observation_size // len(config.env.ages)
        self._sensing = Sensing(config, self.world, estimator, sizes, commands)
        self.task = kind(config, self.world, self.reference, self._sensing)
        self.state_size = self.task.critic.shape[1]
        self.reward_terms, self.failure_causes = tuple(kind.REWARD), kind.causes()
        observation = self.task.observation
        self._history = History(observation, config.env.ages)
        self._stacked = self._history.stacked
        self._starts = Episodes(config, self.world, self.task, self._sensing)
        # Episode -1 is none, and all are over: a first reset begins episode 0, a step before it is refused.
        self.seeds, self.episodes = np.full(e, config.seed, np.int64), np.full(e, -1, np.int64)
        self.steps, self._ended = np.zeros(e, np.int64), np.ones(e, bool)
        self.outcome = outcome = Outcome.of(self._stacked, self.task.terms)
        self._given, self._halted = np.zeros_like(self.task.action), np.zeros(e, bool)
        planned = config.control.action in COMMANDERS
        self._commands = np.zeros((e, self.num_drones, commands)) if planned else self.task.action
        actions = self.task.action, self.task.previous
        self._take_actions: Callable[[], Any] = bind(take_actions, self._given, self._halted, *actions)
        causes, counted = (self.task.cause, len(self.failure_causes)), (self.steps, self.max_steps, self._ended)
        self._end_step: Callable[[], Any] = bind(end_step, self.world.diverged, *causes, *counted, outcome)
        self._checked = False  # whether all components were seen to be written
        self._bind()
        self.commander: Commander | None = find_commander(config.control.action)(self) if planned else None
        self._first_sense = self._sensing.bind_first(self.task.view)
        delays = self._sensing.delays_observation
        self._first_delay = self._sensing.bind_delay(observation) if delays else None

    def reset(
        self, seed: int | None = None, mask: np.ndarray | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Start new episodes in the environments in `mask` (E,) (None: all).

        Args:
            seed: start at episode 0 of this seed; None goes to each environment's next episode.
            mask: bool (E,).
            options: what to fix, see docs/randomization.md: `randomization`, values by the names of
                `info["randomization"]`, and `state`, fields of SystemState by name; each one for all environments in
                the mask or with a row for each.

        Returns:
            Observations of all environments (E, N, D) float32, rows outside the mask unchanged, and info, see `step`.

        Raises:
            ConfigError: no start is free of failure.
            ValueError: a mask, a seed or an option that cannot be; the environments in the mask must be reset again.
        """
        mask = np.ones(self.num_envs, bool) if mask is None else check_mask(mask, self.num_envs)
        check_seed(seed)
        fixed = self._starts.read(options, mask)
        before = self.seeds.copy(), self.episodes.copy()
        if seed is not None:
            self.seeds[mask], self.episodes[mask] = seed, -1
        self.episodes[mask] += 1
        try:
            self._start(mask, fixed)
        except BaseException:
            # A reset that is refused or interrupted skips no episode.
            (self.seeds[:], self.episodes[:]), self._ended[mask] = before, True
            raise
        return self.current()

    def step(
        self, action: np.ndarray, restart: bool = False
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Advance all environments by one policy step.

        Args:
            action: (E, N, A) floating point; values beyond [-1, 1] are clipped.
            restart: start new episodes in environments that have ended, in place of a step: their reward is 0.

        Returns:
            observation (E, N, D) float32, reward (E, N) float32, terminated (E,), truncated (E,) bool, and info:
            `success`, `failure`, `diverged` (E,) bool; `failure_cause` (E,), indices into `failure_causes`;
            `reward_terms` {name: (E,)}, weighted; `randomization` {name: (E, ...)}, the hidden draw, read-only.

        Raises:
            ValueError: wrong shape or dtype, or an action that is not finite.
            RuntimeError: an environment has ended and was not reset.
        """
        outcome = self.step_live(action, restart)
        terminated, truncated, *flags = outcome.flags.copy()
        return outcome.observation.copy(), outcome.reward.copy(), terminated, truncated, self._info(*flags)

    def step_live(self, action: np.ndarray, restart: bool = False) -> Outcome:
        """Do as `step`, and return the live arrays of `outcome`, which the next step overwrites."""
        # Those that were never reset are left out, so that they are refused below.
        begin = self._ended & (self.episodes >= 0) if restart and self._ended.any() else None
        self._set_action(action, self._ended if begin is None else self._ended & ~begin)
        with ending_all(self._ended):
            if self.commander is not None:
                self._commands[:] = self.commander.command(self.task.action)
            for run in self._parts:  # one, unless the task has NumPy functions
                run()
        # Before the step is counted: one in which the simulation diverged has no reward.
        self.world.check_warnings()
        out_of_time, bad = self._end_step()
        if bad >= 0:
            refuse_step(bad, self.outcome, len(self.failure_causes), self.task.name, self.reward_terms)
        # The task is asked at a time limit only: who fails has terminated before, and is no success.
        if out_of_time:
            truncated = self.outcome.flags[1]
            np.logical_and(truncated, self.task.succeeded(), out=self.outcome.flags[2])
        if begin is not None:  # these were simulated on, unseen
            self.reset(mask=begin)
        return self.outcome

    def current(self) -> tuple[np.ndarray, dict[str, Any]]:
        """Return observation (E, N, D) and info of the episodes in progress, as `reset` does, and change nothing."""
        success, failure = np.zeros((2, self.num_envs), bool)
        return self._stacked.copy(), self._info(success, failure, self.world.diverged.copy())

    @property
    def ended(self) -> np.ndarray:
        """Environments (E,) bool that must be reset before the next step."""
        return self._ended.copy()

    def stagger(self, total: int | None = None, rigs: int = 1) -> None:
        """Shorten the episodes in progress to evenly spread lengths, so that time limits no longer coincide.

        A learner then sees all phases of an episode in every batch.

        Args:
            total: environments among which these are those from `first_env` on; None: these are all.
            rigs: that share them, as many each, one rig after the other; each then sees all phases, too.
        """
        first, total = (0, self.num_envs) if total is None else (self.first_env, total)
        rig, own = np.divmod(first + np.arange(self.num_envs), total // rigs)
        # Rigs take turns; the k-th of all goes on as if the share k/total of its episode were over.
        self.steps[:] = (own * rigs + rig) * self.max_steps // total

    @property
    def drawn(self) -> dict[str, np.ndarray]:
        """What `info["randomization"]` holds, read-only; another dict whenever an episode has started."""
        return self._starts.drawn

    def state(self) -> np.ndarray:
        """Return the global state (E, S) float32, which holds what is hidden from the drones."""
        return self.task.critic.copy()

    def describe(self, steps: int = 100) -> str:
        """Return the stages of a policy step in order, and how long each takes; these environments do not change.

        Args:
            steps: policy steps that a copy of the first shard's environments makes, with the last actions.
        """
        # `copy` goes through `__reduce__`: the twin has a world of its own.
        twin = copy(self)
        pipeline = twin._pipelines[twin.world.shards[0].lo]
        seconds = np.zeros(len(pipeline.stages))
        if (twin.episodes < 0).any():
            twin.reset()
        for _ in range(steps):
            pipeline.run_timed(seconds)
        return describe_stages(pipeline.stages, seconds / steps)

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return copies of everything that later steps depend on, by dotted name, environment first."""
        saved = {f"world.{key}": array for key, array in self.world.state_dict().items()}
        saved |= {f"task.{key}": array for key, array in self.task.state_dict().items()}
        saved |= self.controller.state_dict()
        saved |= {f"sensing.{key}": array.copy() for key, array in self._sensing.arrays().items()}
        saved |= {f"history.{key}": array.copy() for key, array in self._history.arrays().items()}
        saved |= {name: getattr(self, name).copy() for name in _SAVED}
        if self.commander is not None:
            saved |= {f"commander.{name}": array.copy() for name, array in self.commander.arrays().items()}
        c, env = self.config.control.model_dump(exclude_defaults=True), self.config.env
        saved["task_name"] = fingerprint(self.task.name, self.num_envs)
        saved["control"] = fingerprint(f"{c} {env.policy_hz} {env.sensing} {env.units}", self.num_envs)
        return saved

    def load_state_dict(self, saved: dict[str, np.ndarray]) -> None:
        """Continue bit for bit from what `state_dict` returned, at any number of threads.

        Raises:
            ValueError: it is of other environments, or not what `state_dict` returned; nothing is changed then.
        """
        now = {key: each for key, each in self.state_dict().items() if key != "control" or key in saved}  # not in older
        check_saved(saved, now, "world.diverged", "world.system", "task_name", "control", "commander.planner")
        delays, most = self.config.randomization, 2**63 - 1
        whole = "steps", "seeds", "sensing.sent", "sensing.seen", "sensing.obstacle_steps"
        counts = dict.fromkeys(whole, (0, most))
        counts |= {"episodes": (-1, most), "task.time": (0, most), "task.cause": (0, len(self.failure_causes) - 1)}
        counts["history.newest"] = 0, max(self.config.env.ages)
        counts |= {f"task.own.{name}": limits for name, limits in self.task.count_limits().items()}
        counts |= {f"sensing.{name}": (0, getattr(delays, name)[1]) for name in ("action_delay", "observation_delay")}
        # Kernels index by these and check no bounds: a number out of range would reach into other memory.
        check_counts(saved, counts)
        groups: dict[str, Rows] = {"world": {}, "task": {}, "sensing": {}}
        for key, array in saved.items():
            group, _, name = key.partition(".")
            if group in groups:
                groups[group][name] = array
        self.world.load_state_dict(groups["world"])
        self.task.load_state_dict(groups["task"])
        self.controller.load_state_dict(saved)
        self._starts.load_state_dict(groups["sensing"])
        for name in _SAVED:
            getattr(self, name)[:] = saved[name]
        for name, array in self._history.arrays().items():
            array[:] = saved[f"history.{name}"]
        if self.commander is not None:
            for name, array in self.commander.arrays().items():
                array[:] = saved[f"commander.{name}"]

    def __reduce__(
        self,
    ) -> tuple[type[MultiliftVec], tuple[Config, int, int], tuple[dict[str, np.ndarray], np.ndarray]]:
        saved = self.state_dict(), self.task.terms.copy()
        return type(self), (self.config, self.purpose, self.first_env), saved

    def __setstate__(self, saved: tuple[dict[str, np.ndarray], np.ndarray]) -> None:
        self.load_state_dict(saved[0])
        self.task.terms[:] = saved[1]  # of the last step: later ones do not depend on them

    def _start(self, mask: np.ndarray, fixed: dict[str, Rows]) -> None:
        """Start the episodes in `mask`, with a row of what is fixed of draw and state for each."""
        chosen = np.flatnonzero(mask).tolist()
        for i, e in enumerate(chosen):
            # All that an episode depends on beside the seed: it is the same in any batch, on any thread.
            key = (self.purpose, self.first_env + e, int(self.episodes[e]))
            self._starts.draw(e, int(self.seeds[e]), key, fixed, i)
        self._starts.load(mask)
        self.task.action[mask] = self.task.previous[mask] = 0.0
        self.steps[mask], self._ended[mask] = 0, False
        self.outcome.clear(mask)
        if self.commander is not None:
            self.commander.reset(mask)
        for e in chosen:
            self._sensing.start_sensors(e)
            self.controller.start(e)
            if not self._checked:  # NaN stands for what is not written
                self.task.observation[e] = self.task.critic[e] = np.nan
            self._observe(e)
            if not self._checked:
                self.task.check_written(e)
                self._checked = True
            self._history.begin(e)

    def use_controller(self, controller: Controller, report: Callable[[SystemState], None] | None = None) -> None:
        """Let another controller of this world fly the drones from the next reset on.

        `report` writes after each control tick what drones know of themselves, but with `env.sensing=ideal`.
        """
        self.controller, self.reference = controller, controller.reference
        if self._estimator is not None and report is not None:
            self._estimator.follow(report)
        self._bind()

    def _bind(self) -> None:
        """Build the stages of every shard, from the controller and the task as they are."""
        teams = StageContext(
            self.world, self.controller, self.task, self._estimator, self._sensing, self._commands, self._history
        )
        self._pipelines = {shard.lo: Pipeline(teams, shard, self.control_ticks) for shard in self.world.shards}
        self._parts = join_pipelines(self._pipelines, self.world)

    def _observe(self, e: int) -> None:
        """Write the first observation and global state of an episode."""
        self._first_sense(e, e + 1)
        # The global state first: its kernel computes the task's `preview`, which observations read, too.
        self.task.stages["observe state"](e, e + 1)
        self.task.stages["observe"](e, e + 1)
        self.task.numpy.observe(e, e + 1)
        if self._first_delay is not None:
            self._first_delay(e, e + 1)

    def _set_action(self, action: np.ndarray, ended: np.ndarray) -> None:
        """Take actions (E, N, A) unless an environment in `ended` (E,) cannot go on, or one of them cannot be."""
        action = check_action(action, self.task.action.shape)
        # Kernels are bound to this array, so actions of any float type are copied into it.
        np.copyto(self._given, action)
        self._halted[:] = ended
        taken = self._take_actions()
        if taken != TAKEN:
            refuse_action(taken, action, ended, self.action_names)

    def _info(self, success: np.ndarray, failure: np.ndarray, diverged: np.ndarray) -> dict[str, Any]:
        """Return info of the last step with these flags (E,), of which those of failures are of that step or none."""
        return {
            "success": success,
            "failure": failure,
            "diverged": diverged,
            "failure_cause": self.outcome.cause * failure,
            "reward_terms": dict(zip(self.reward_terms, self.task.terms.T.copy(), strict=True)),
            "randomization": self.drawn.copy(),
        }


def make_vec(
    task: str | Config = "hover", *, num_envs: int | None = None, num_threads: int | None = None,
    num_drones: int | None = None, seed: int | None = None, first_env: int = 0, **overrides: Any,
) -> MultiliftVec:  # fmt: skip
    """Return E environments of a task on the batched core.

    Args:
        task: a configuration's name, the path of one, or a Config.
        num_envs: E; None for the configured value, as for the next three.
        num_threads: threads that step them; 0 for one on each CPU. Results do not depend on it.
        num_drones: N.
        seed: seed of the first reset.
        first_env: number of the first environment, for replaying one of a larger batch.
        **overrides: configuration values by dotted name, `**{"payload.mass": 2.0}`; type checkers want them in a
            `dict[str, Any]`.

    Raises:
        ConfigError: an unknown key, a wrong value or an impossible system.
    """
    config = resolve_config(
        task, num_envs=num_envs, num_threads=num_threads, num_drones=num_drones, seed=seed, **overrides
    )
    return MultiliftVec(config, first_env=first_env)
