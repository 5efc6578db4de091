"""The contract between a task and the environment core."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from math import radians
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multilift_marl._jit import compose, inlined, prebind
from multilift_marl.config.config import Config
from multilift_marl.config.schema import RewardTerm
from multilift_marl.config.validate import validate
from multilift_marl.config.values import Section
from multilift_marl.control.formation import Goal, Reference, make_rig, place_formation
from multilift_marl.errors import ConfigError, nearest
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.world import World
from multilift_marl.tasks.failures import FailureMask, find_cause, make_limits
from multilift_marl.tasks.global_state import state_components
from multilift_marl.tasks.load_sensing import true_load
from multilift_marl.tasks.observation_kernels import check_written, compose_observation, compose_state
from multilift_marl.tasks.observations import SENSED, Component, list_components
from multilift_marl.tasks.rewards import RestBounds, Term, compose_reward, is_at_rest
from multilift_marl.tasks.rig_numbers import RIG, describe_rig, observed_units, scale_numbers
from multilift_marl.tasks.sensing import Sensing
from multilift_marl.tasks.starts import make_hanging, true_hanging
from multilift_marl.tasks.view import INTEGRAL_LIMIT, Errors, View, reduce_view, update_errors

FINAL_SECONDS = 2.0  # reported errors are means over these last seconds
Call = Callable[[int, int], None]  # of environments lo to hi


class Box(NamedTuple):
    """A box to draw."""

    size: tuple[float, float, float]
    """Half its edges [m]."""
    position: tuple[float, float, float]
    """Of its middle [m]."""
    rgba: tuple[float, float, float, float]
    """Colour and opacity, 0 to 1."""


@inlined
def is_within_bounds(e, v):
    """Return whether the payload is within `bounds` of the task's settings."""
    return is_at_rest(e, v, v.settings.bounds)


class Kernels(NamedTuple):
    """What a task adds to the steps of its environments: inlined kernels of (environment, View), None for nothing."""

    is_good: Callable[..., Any] = is_within_bounds
    """Whether the payload is within the success region; `good_time` counts how long."""
    plan: Callable[..., Any] | None = None
    """At every control step, `time` advanced: writes goal and its velocities for that moment. A goal may leap, see
    `Task.place_goal`: references are smoothed to slots that leap, and move along with those that move."""
    check: Callable[..., Any] | None = None
    """After every policy step, before failures are looked for."""
    update: Callable[..., Any] | None = None
    """After the reward."""
    preview: Callable[..., Any] | None = None
    """Before the global state and the observations are written: computes what several components need."""


class Settings(NamedTuple):
    """Constants of a task that asks for nothing but a payload at rest."""

    bounds: RestBounds


class Task:
    """A cooperative transport task for E environments of N drones.

    A subclass says how an episode starts (`start`), what the team is paid (`REWARD`) and when it does well
    (`KERNELS.is_good`, `succeeded`). Goal, errors, failures and observations are kept here; time limit, seeding,
    divergence and clipping of actions belong to the core.

    Class attributes:
        name: registry name.
        Options: its `task_options`, typed.
        REWARD: the reward terms; `reward.<term>.weight` and `reward.<term>.margin` override their numbers.
        KERNELS: what it does in a step.
        EXTRA: what its observations have beside the common components.
        EXTRA_STATE: what it adds to the global state.
        MIN_DRONES: with fewer it makes no sense.

    Args:
        config: of the environments; `task_options`, `reward`, `env` and `sim` count.
        world: the simulated teams.
        reference: what the drones follow.
        sensing: what they observe through.

    Attributes:
        config, world, reference: as given.
        options: `task_options`, checked; a subclass that annotates it with its own `Options` has it typed.
        view: View, what its kernels read and write; the following are fields of it: goal, planned, errors, mask, rig,
            limits, time, cause, terms, good_time, min_separation, action, previous, dt, control_dt, own, settings.
        weights, margins: of the reward terms (T,), (T, M), in the order of `REWARD`.
        drone_numbers: where the drones' numbers stand in the global state.
        rmse_after: time from which errors count for `payload_rmse_m` [s].
        hanging: numbers of a hanging team; in `start`, the true ones of the environment, else nominal.
        nominal_hanging: always nominal, for goals.

    Raises:
        ConfigError: too few drones, an unknown option or reward term, or one that cannot be.
    """

    name: ClassVar[str]
    Options: ClassVar[type[Section]] = Section
    options: Section
    REWARD: ClassVar[dict[str, Term]] = {}
    KERNELS: ClassVar[Kernels] = Kernels()
    EXTRA: ClassVar[tuple[Component, ...]] = ()
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = ()
    MIN_DRONES: ClassVar[int] = 1
    own: Any
    settings: Any

    def __init__(self, config: Config, world: World, reference: Reference, sensing: Sensing):
        e, n, system = world.num_envs, world.num_drones, world.system
        if n < self.MIN_DRONES:
            raise ConfigError(f"task {self.name} needs more drones; raise env.num_drones to {self.MIN_DRONES} or more")
        self.config, self.world, self.reference, self._sensing = config, world, reference, sensing
        self.options = validate(self.Options, config.task_options, "task_options")
        self.weights, self.margins = resolve_reward(self.name, self.REWARD, config.reward)
        self.dt, self.control_dt = 1.0 / config.env.policy_hz, 1.0 / config.sim.control_hz
        self.goal, self.errors = Goal.zeros(e, n), Errors.zeros(e)
        self.planned = self.goal
        self.rig, self.limits, self.mask = make_rig(system), make_limits(system), FailureMask.zeros(e, n)
        self.nominal_hanging = self.hanging = make_hanging(system)
        size = sensing.action_size
        self.action, self.previous = np.zeros((2, e, n, size))
        self.observation = np.zeros((e, n, sensing.observation_size), np.float32)
        varied = system.varied | ({"gust"} if config.wind.turbulence or any(config.wind.gust) else set())
        self._state = state_components(varied, self.EXTRA_STATE)
        self.drone_numbers = self._state.drone_numbers(n, size)
        self.critic = np.zeros((e, self._state.size(n, size)), np.float32)
        self.cause, self.time, self.good_time, self.min_separation = np.zeros(e, np.int64), *np.zeros((3, e))
        self.terms = np.zeros((e, len(self.REWARD)))
        self.rmse_after = 0.0
        self.own, self.settings = (), ()
        self.prepare()
        self.view = View(
            state=world.state,
            seen=sensing.state,
            load=sensing.load,
            true_load=true_load(world.state),
            true_errors=self.errors.as_rows(),
            loads=world.hidden_loads,
            parameters=world.parameters,
            gust=world.air.gust,
            action_delay=sensing.memory.action_delay,
            goal=self.goal,
            planned=self.planned,
            has_plan=self.planned is not self.goal,
            errors=self.errors,
            integral_limit=INTEGRAL_LIMIT * observed_units(config, ("m s", "rad s")),
            seen_errors=sensing.errors or self.errors.as_rows(),
            reference=reference,
            rig=self.rig,
            rig_numbers=describe_rig(system, self.dt),
            nominal=self.nominal_hanging,
            resting_tension=system.resting_tension,
            limits=self.limits,
            mask=self.mask,
            action=self.action,
            previous=self.previous,
            time=self.time,
            cause=self.cause,
            good_time=self.good_time,
            min_separation=self.min_separation,
            terms=self.terms,
            dt=self.dt,
            control_dt=self.control_dt,
            own=self.own,
            settings=self.settings,
        )
        self._views: dict[Callable[..., Any], View] = {}
        self.stages = self._compose()

    @classmethod
    def extra(cls, config: Config) -> tuple[Component, ...]:
        """Return what observations have beside the common components: the task's own, and what only sensors tell."""
        rig = () if config.env.units == "si" else (RIG,)
        return (*cls.EXTRA, *SENSED.get(config.env.sensing, ()), *rig)

    def prepare(self) -> None:
        """Check the options, set `settings`, and `own` where the task has arrays of its own."""
        self.settings = Settings(RestBounds.of(self.options))

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw a start of one environment: write its goal and `world.state`; a start that is a failure is drawn again.

        Args:
            env: the environment.
            rng: generator of this episode, the only source of what is random.
            mass: true mass of the payload [kg].
        """
        raise NotImplementedError

    def view_for(self, kernel: Callable[..., Any]) -> View:
        """Return what a kernel, called by `start`, reads and writes of `view`; see `reduce_view`."""
        if kernel not in self._views:
            self._views[kernel] = reduce_view(self.view, kernel)
        return self._views[kernel]

    def succeeded(self) -> np.ndarray:
        """Return which environments (E,) would be successes if they ended now: good for the last seconds, or all."""
        seconds: float = getattr(self.options, "success_seconds", 0.0)
        return self.good_time >= min(seconds, self.config.env.episode_seconds) - 1e-9

    def place_goal(self, env: int, position: ArrayLike, rotation: ArrayLike | None = None) -> None:
        """Put the target of one environment elsewhere, the formation with it, at a start or in flight.

        Compiled plans write `goal.position` and `goal.rotation` and call `formation.place_formation`.

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

    def target_path(self, env: int) -> np.ndarray:
        """Return points (P, 3) [m] of the path that the target takes in this episode, to draw it; none if it stays."""
        return np.zeros((0, 3))

    def scenery(self, env: int) -> list[Box]:
        """Return what stands around in environment `env`, to draw it; what may be touched is `failures`' business."""
        return []

    def draw_start(self, env: int, rng: np.random.Generator, parameters: Parameters) -> bool:
        """Draw a start of environment `env`, whose team has true `parameters`; return whether it is sound.

        That is what the core calls, for as many draws as it takes; tasks say by `start` what is drawn.
        """
        self.hanging = true_hanging(self.nominal_hanging, parameters, env)
        self.start(env, rng, float(parameters.payload_mass[env]))
        self.hanging = self.nominal_hanging
        return self.begin(env)

    def begin(self, env: int) -> bool:
        """Reset the measurements of one environment to its drawn start; return whether that start is sound."""
        self.errors.position_integral[env] = self.errors.rotation_integral[env] = 0.0
        self.good_time[env], self.min_separation[env], self.terms[env], self.time[env] = 0.0, 1e9, 0.0, 0.0
        self.stages["measure"](env, env + 1)
        return bool(self.cause[env] == 0)

    def check_written(self, env: int) -> None:
        """Refuse, by a ConfigError, components of observation or global state that are not written in a first step."""
        size, parts = self.action.shape[2], list_components(self.config.control.action, self.extra(self.config))
        check_written(self.observation[env], parts, "observation")
        check_written(self.critic[env], self._state.listed(self.world.num_drones, size), "global state")

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return copies of the task's arrays that outlive a step."""
        return {name: array.copy() for name, array in self._arrays().items()}

    def load_state_dict(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `state_dict` returned."""
        for name, array in self._arrays().items():
            array[:] = saved[name]

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that outlive a step, by dotted name."""
        names = ("cause", "good_time", "min_separation", "time", "action", "observation", "critic")
        arrays = {name: getattr(self, name) for name in names}
        groups = {"goal": self.goal, "errors": self.errors, "mask": self.mask}
        groups |= {"planned": self.planned} if self.planned is not self.goal else {}
        groups |= {"own": self.own} if self.own else {}
        for group, record in groups.items():
            arrays |= {f"{group}.{name}": array for name, array in _flatten(record)}
        return arrays

    def _compose(self) -> dict[str, Call]:
        """Return the stages of a step that are the task's, each a call of (lo, hi)."""
        v, kernels, size = self.view, self.KERNELS, self.action.shape[2]
        extra, action = self.extra(self.config), self.config.control.action
        observe = self._bind(compose_observation(extra, action), v, self.observation)
        if self.config.env.units != "si":
            units = [part.unit for part in list_components(action, extra) for _ in range(part.size)]
            factors = 1 / observed_units(self.config, units)
            observe = _follow(observe, prebind(scale_numbers, self.observation, factors))
        check = compose_check(kernels.check)
        stages = {
            "measure": self._bind(check, v, 0.0),
            "check": self._bind(check, v, self.dt),
            "reward": self._bind(
                compose_reward(self.REWARD, kernels.is_good, kernels.update), v, self.weights, self.margins
            ),
            "observe": observe,
        }
        true = v._replace(seen=v.state, load=v.true_load, seen_errors=v.true_errors)
        stages["observe state"] = self._bind(compose_state(self._state, kernels.preview, size), true, self.critic)
        if kernels.plan is not None:
            stages["plan"] = self._bind(compose_plan(kernels.plan), v)
        return stages

    @staticmethod
    def _bind(kernel: Callable[..., Any], view: View, *arguments: Any) -> Call:
        return prebind(kernel, reduce_view(view, kernel), *arguments)


def _follow(first: Call, then: Call) -> Call:
    """Return a call of (lo, hi) that makes both, one after the other."""

    def call(lo: int, hi: int) -> None:
        first(lo, hi)
        then(lo, hi)

    return call


def compose_check(check: Callable[..., Any] | None) -> Callable[..., Any]:
    """Return the kernel of (lo, hi, View, dt) that measures errors, integrates them over `dt` [s], finds failures.

    Args:
        check: inlined kernel of (e, View), called first; None for none.
    """
    source = """def check(lo, hi, v, dt):
    for e in range(lo, hi):
        before(e, v)
        update_errors(e, 0, v.true_load, v.true_errors, v, dt)
        v.cause[e] = find_cause(e, v)
"""
    functions: dict[str, Callable[..., Any]] = {"update_errors": update_errors, "find_cause": find_cause}
    if check:
        functions["before"] = check
    return compose("check", source if check else source.replace("        before(e, v)\n", ""), functions)


def compose_plan(plan: Callable[..., Any]) -> Callable[..., Any]:
    """Return the kernel of (lo, hi, View) that advances time by a control step, then calls `plan` of (e, View)."""
    source = """def advance_plan(lo, hi, v):
    for e in range(lo, hi):
        v.time[e] += v.control_dt
        plan(e, v)
"""
    return compose("advance_plan", source, {"plan": plan})


def resolve_reward(
    task: str, terms: Mapping[str, Term], values: Mapping[str, RewardTerm]
) -> tuple[np.ndarray, np.ndarray]:
    """Return weights (T,) and margins (T, M) of a task's terms, angles in radians, with configured `values` in place.

    Raises:
        ConfigError: an unknown term, or another number of margins than it has.
    """
    for name, given in values.items():
        if name not in terms:
            hint = nearest(name, terms, lambda near: f"reward.{near}")
            raise ConfigError(f"unknown key 'reward.{name}' of task {task}{hint}")
        count = len(terms[name].margins)
        if given.margin is not None and len(given.margin) != count:
            raise ConfigError(f"reward.{name}.margin lists {len(given.margin)} numbers, but the term has {count}")
    weights = np.array([term.weight for term in terms.values()], float)
    margins = np.ones((len(terms), max((len(term.margins) for term in terms.values()), default=0)))
    for i, (name, term) in enumerate(terms.items()):
        given = values.get(name, RewardTerm())
        weights[i] = term.weight if given.weight is None else given.weight
        chosen = term.margins if given.margin is None else given.margin
        margins[i, : len(chosen)] = [radians(margin) if term.unit == "deg" else margin for margin in chosen]
    return weights, margins


def _flatten(record: Any, prefix: str = "") -> Iterator[tuple[str, np.ndarray]]:
    """Return the arrays of a named tuple, those of named tuples within it too, by dotted name."""
    for name, value in record._asdict().items():
        if isinstance(value, tuple):
            yield from _flatten(value, f"{prefix}{name}.")
        else:
            yield prefix + name, value
