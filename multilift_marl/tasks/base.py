"""The contract between a task and the environment core."""

from __future__ import annotations

import operator
from collections.abc import Callable
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.validate import validate
from multilift_marl.config.values import Section
from multilift_marl.control.formation import Goal, Reference, make_rig, place_formation
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.world import World
from multilift_marl.tasks.failures import FailureMask, find_failures, make_limits
from multilift_marl.tasks.observations import Component, observation_names, observe_team
from multilift_marl.tasks.rewards import Errors, update_errors
from multilift_marl.tasks.sensing import Sensing
from multilift_marl.tasks.starts import make_hanging, true_hanging

Look = tuple[Callable[..., None], tuple[Any, ...]]  # a kernel and its arguments
FINAL_SECONDS = 2.0  # reported errors are means over these last seconds
INTEGRAL_LIMIT = 0.5  # [m s] and [rad s], each component of the error integrals


class Box(NamedTuple):
    """A box to look at."""

    size: tuple[float, float, float]
    """Half its edges [m]."""
    position: tuple[float, float, float]
    """Of its middle [m]."""
    rgba: tuple[float, float, float, float]
    """Colour and opacity, 0 to 1."""


@kernel
def check_team(lo, hi, state, goal, planned, is_planned, errors, dt, limits, watch, cause, min_separation):
    """Measure the errors of environments lo to hi, integrate them over `dt` [s], look for failures."""
    update_errors(lo, hi, state, goal, planned, is_planned, errors, dt, INTEGRAL_LIMIT)
    find_failures(lo, hi, state, errors, limits, watch, cause, min_separation)


class Task:
    """A cooperative transport task for E environments of N drones.

    A subclass says how an episode starts (`start`), what the team is paid and when it does well (`scorer`), and what
    counts as success at the end (`succeeded`). Goal, errors, failures and observations are kept here; time limit,
    seeding, divergence and clipping of actions belong to the core.

    Class attributes:
        name: registry name.
        Options: its `task_options`, typed.
        REWARD: default weight of every reward term; `reward.<term>` overrides.
        EXTRA: what its observations have beside the common components.
        EXTRA_STATE: how many numbers it adds to the global state.
        MIN_DRONES: with fewer it makes no sense.
        KEPT: names of further arrays, environment first, that outlive a step.

    Args:
        config: of the environments; `task_options`, `reward`, `env` and `sim` count.
        world: what is flown.
        reference: what the drones are told to follow.

    Attributes:
        world, reference: as given.
        options: `task_options`, checked; a subclass that annotates it with its own `Options` has it typed.
        weights: of the reward terms (T,), in the order of `REWARD`.
        dt, control_dt: policy and control step [s].
        rig: the nominal formation in the payload frame.
        limits: lengths of the failures.
        goal, errors: Goal, Errors; live arrays.
        way: Goal that the drones fly about: `goal` itself, unless a task leads the team there.
        cause: failure cause (E,), an index into `failures.CAUSES`.
        terms: weighted reward terms (E, T) in the order of `REWARD`.
        good_time: time since the payload was last outside the success region (E,) [s].
        min_separation: smallest distance between drones in the episode (E,) [m].
        watch: failures that do not count for now.
        time: since the start, for tasks with a plan (E,) [s].
        rmse_after: time from which errors count for `payload_rmse_m` [s].
        seen: the state as the drones are told it, for observers; live arrays.
        hanging: numbers of a hanging team; in `start`, the true ones of the environment, else nominal.
        nominal_hanging: always nominal, for goals.

    Raises:
        ConfigError: too few drones, an unknown option or reward term, or one that cannot be.
    """

    name: ClassVar[str]
    Options: ClassVar[type[Section]] = Section
    options: Section
    REWARD: ClassVar[dict[str, float]] = {}
    EXTRA: ClassVar[tuple[Component, ...]] = ()
    EXTRA_STATE: ClassVar[int] = 0
    MIN_DRONES: ClassVar[int] = 1
    SAVED: ClassVar[tuple[str, ...]] = ()

    def __init__(self, config: Config, world: World, reference: Reference):
        e, n, system = world.num_envs, world.num_drones, world.system
        self.world, self.reference, self.seen = world, reference, world.state
        self._sensing: Sensing | None = None
        if n < self.MIN_DRONES:
            raise ConfigError(f"task {self.name} needs more drones; raise env.num_drones to {self.MIN_DRONES} or more")
        self.options = validate(self.Options, config.task_options, "task_options")
        self.weights = self._weights(config.reward)
        self.dt, self.control_dt = 1.0 / config.env.policy_hz, 1.0 / config.sim.control_hz
        self.goal, self.errors = Goal.zeros(e, n), Errors.zeros(e)
        self.planned = self.goal
        self.rig = make_rig(system)
        self.limits, self.nominal_hanging = make_limits(system), make_hanging(system)
        self.hanging = self.nominal_hanging
        tension = system.resting_tension
        self._nominal = np.append(np.stack([system.cable_length, tension], axis=1), [[system.payload_mass, 0]], axis=0)
        self.cause, self.good_time = np.zeros(e, np.int64), np.zeros(e)
        self.min_separation, self.time = np.zeros(e), np.zeros(e)
        self.watch = FailureMask.zeros(e, n)
        self.rmse_after = 0.0
        self.terms = np.zeros((e, len(self.REWARD)))

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw a start of one environment: write its goal and `world.state`; a start that is a failure is drawn again.

        Args:
            env: the environment.
            rng: generator of this episode, the only source of what is random.
            mass: true mass of the payload [kg].
        """
        raise NotImplementedError

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Return what, after each policy step, writes `terms` and updates `good_time` of environments lo to hi.

        Args:
            lo, hi: the environments.
            action, previous: this action and the last one (E, N, A), live arrays.
        """
        raise NotImplementedError

    def succeeded(self) -> np.ndarray:
        """Return which environments (E,) would be successes if they ended now."""
        raise NotImplementedError

    def planner(self, lo: int, hi: int) -> Callable[[], None] | None:
        """Return what moves the goals of environments lo to hi on by one control step; None if they stay.

        It adds `control_dt` to `time` and writes goal and its velocities for that moment. A goal may leap, see
        `place_goal`: references are smoothed to slots that leap, and ride along with those that move.
        """
        return None

    def place_goal(self, env: int, position: ArrayLike, rotation: ArrayLike | None = None) -> None:
        """Put the target of one environment elsewhere, the formation with it, at a start or in flight.

        Compiled planners write `goal.position` and `goal.rotation` and call `formation.place_formation`.

        Args:
            env: the environment.
            position: (3,) of the payload [m].
            rotation: (3, 3) its attitude; None leaves it.
        """
        self.goal.position[env] = position
        if rotation is not None:
            self.goal.rotation[env] = rotation
        place_formation(env, self.goal, self.rig)

    def in_error_window(self, time: float, length: float) -> bool:
        """Return whether errors at `time` [s] of an episode of `length` [s] belong to those that are reported."""
        return time > length - FINAL_SECONDS + 1e-9

    def observe_extra(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None] | None:
        """Return what writes `EXTRA` and `EXTRA_STATE`, the last numbers of each row, of environments lo to hi.

        Args:
            lo, hi: the environments.
            observation: (E, N, D) float32, live array.
            critic: global state (E, S) float32, live array.
        """
        return None

    def use_sensing(self, sensing: Sensing) -> None:
        """Let the drones observe through these from now on."""
        self._sensing = sensing
        self.seen = sensing.state if sensing.has_noise else self.world.state

    def draw_start(self, env: int, rng: np.random.Generator, parameters: Parameters) -> bool:
        """Draw a start of environment `env`, whose team has true `parameters`; return whether it is sound.

        That is what the core calls, for as many draws as it takes; tasks say by `start` what is drawn.
        """
        self.hanging = true_hanging(self.nominal_hanging, parameters, env)
        self.start(env, rng, float(parameters.payload_mass[env]))
        self.hanging = self.nominal_hanging
        return self.begin(env)

    def target_path(self, env: int) -> np.ndarray:
        """Return points (P, 3) [m] of the way that the target takes in this episode, to draw it; none if it stays."""
        return np.zeros((0, 3))

    def scenery(self, env: int) -> list[Box]:
        """Return what stands around in environment `env`, to draw it; what may be touched is `failures`' business."""
        return []

    def begin(self, env: int) -> bool:
        """Reset the measurements of one environment to its drawn start; return whether that start is sound."""
        self.errors.position_integral[env] = self.errors.rotation_integral[env] = 0.0
        self.good_time[env], self.min_separation[env], self.terms[env], self.time[env] = 0.0, 1e9, 0.0, 0.0
        self.check(env, env + 1, 0.0)
        return bool(self.cause[env] == 0)

    def check(self, lo: int, hi: int, dt: float) -> None:
        """Measure errors of environments lo to hi, integrate them over `dt` [s], and look for failures."""
        check_team(*self._checked(lo, hi, dt))

    def observe(self, lo: int, hi: int, action: np.ndarray, observation: np.ndarray, critic: np.ndarray) -> None:
        """Write observations (E, N, D) and global states (E, S) of environments lo to hi."""
        looks, delays = self._observe_kernels(lo, hi, 0.0, action, observation, critic)
        for function, arguments in looks:
            function(*arguments)
        if extra := self.observe_extra(lo, hi, observation, critic):
            extra()
        for function, arguments in delays:
            function(*arguments)

    def after_step(
        self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray, observation: np.ndarray, critic: np.ndarray
    ) -> list[Callable[[], None]]:
        """Return what is called in turn for environments lo to hi after each policy step: check, score, observe.

        Args:
            lo, hi: the environments.
            action, previous: this action and the last one (E, N, A), live arrays.
            observation, critic: observations (E, N, D) and global states (E, S), written.
        """
        extra = self.observe_extra(lo, hi, observation, critic)
        looks, delays = self._observe_kernels(lo, hi, self.dt, action, observation, critic)
        return [
            bind(check_team, *self._checked(lo, hi, self.dt)),
            self.reward(lo, hi, action, previous),
            *(bind(function, *arguments) for function, arguments in looks),
            *([extra] if extra else []),
            *(bind(function, *arguments) for function, arguments in delays),
        ]

    def _observe_kernels(
        self, lo: int, hi: int, dt: float, action: np.ndarray, observation: np.ndarray, critic: np.ndarray
    ) -> tuple[list[Look], list[Look]]:
        """Return the kernels that observe, before and after the task's own, with their arguments."""
        loads, goal, reference = self.world.hidden_loads, self.goal, self.reference
        rig, nominal = self.rig, self._nominal
        common, span, sensing = (action, rig, nominal, observation), (lo, hi), self._sensing
        state, errors = self.world.state, self.errors
        looks: list[Look] = [(observe_team, (*span, state, loads, goal, reference, errors, *common, critic))]
        if sensing is None:
            return looks, []
        if sensing.has_noise:
            led = self.planned, self.planned is not goal
            state, errors = sensing.state, sensing.errors
            looks += [
                sensing.sense(*span, self.world.state),
                (update_errors, (*span, state, goal, *led, errors, dt, INTEGRAL_LIMIT)),
                (observe_team, (*span, state, loads, goal, reference, errors, *common, sensing.unused)),
            ]
        own = len(observation_names(0))
        delays = [sensing.delay(*span, observation, (own, own + action.shape[2]))] if sensing.delays_observation else []
        return looks, delays

    def _checked(self, lo: int, hi: int, dt: float) -> tuple[Any, ...]:
        state, goal, planned, errors = self.world.state, self.goal, self.planned, self.errors
        found = (self.limits, self.watch, self.cause, self.min_separation)
        return lo, hi, state, goal, planned, planned is not goal, errors, dt, *found

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return copies of the task's arrays that outlive a step."""
        kept = ("cause", "good_time", "min_separation", "time", *self.SAVED)
        saved = {name: operator.attrgetter(name)(self).copy() for name in kept}
        for group in ("goal", "errors", "watch", *(() if self.planned is self.goal else ("planned",))):
            saved |= {f"{group}.{name}": array.copy() for name, array in getattr(self, group)._asdict().items()}
        return saved

    def load_state_dict(self, saved: dict[str, np.ndarray]) -> None:
        """Restore what `state_dict` returned."""
        for key, array in saved.items():
            owner, _, name = key.rpartition(".")
            getattr(getattr(self, owner) if owner else self, name)[:] = array

    def _weights(self, values: dict[str, float]) -> np.ndarray:
        for term in values:
            if term not in self.REWARD:
                hint = nearest(term, self.REWARD, lambda near: f"reward.{near}")
                raise ConfigError(f"unknown key 'reward.{term}' of task {self.name}{hint}")
        return np.array(list((self.REWARD | values).values()), float)
