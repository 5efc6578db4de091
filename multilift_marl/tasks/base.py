"""The contract between a task and the environment core."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from multilift_marl.config.config import Config
from multilift_marl.control.formation import Goal, Reference, place_formation
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import inlined, is_plain, prebind
from multilift_marl.mdp.criteria import Criterion, rest_criteria
from multilift_marl.mdp.env_data import INTEGRAL_LIMIT, Call, Errors, View, bind_kernel, in_turn, reduce_view, true_load
from multilift_marl.mdp.failures import CAUSES, FIRST_OWN, MAX_DISTANCE, SIGHT, FailureMask, make_limits
from multilift_marl.mdp.global_state import state_components
from multilift_marl.mdp.initial_states import check_options, true_equilibrium
from multilift_marl.mdp.numpy_functions import NumpyFunctions
from multilift_marl.mdp.observation_kernels import bind_state, check_written, compose_observation
from multilift_marl.mdp.observations import Component, kernels_first, list_components, sensed_components
from multilift_marl.mdp.rewards import RestBounds, Term, compose_reward, is_at_rest, resolve_reward
from multilift_marl.mdp.rig_features import RIG, describe_rig, observed_units, scale_numbers
from multilift_marl.mdp.stage_kernels import bind_check, compose_plan
from multilift_marl.schema.validate import validate
from multilift_marl.schema.values import Section
from multilift_marl.sensing.measurement import Sensing
from multilift_marl.sim.obstacles import restart_obstacles
from multilift_marl.sim.parameters import Parameters
from multilift_marl.sim.saved import flatten
from multilift_marl.sim.world import World
from multilift_marl.tasks.scenery import Box as Box
from multilift_marl.tasks.scenery import draw_obstacles

_HANDED_ON = (
    "action", "cause", "clearance", "errors", "goal", "good_time", "limits", "mask", "min_clearance", "min_separation",
    "own", "planned", "previous", "rig", "settings", "terms", "time",
)  # fmt: skip
"""Attributes of a task that its kernels read and write as fields of the view."""
FINAL_SECONDS = 2.0  # reported errors are means over these last seconds


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
    `Task.place_goal`: references are smoothed to slots that leap, and move along with those that move.

    Or a NumPy function of (View), called at the start of an episode and before every policy step with `time` at its
    end, that returns a dict of `numpy_functions.GOAL_FIELDS`; control steps lead there by velocity and acceleration."""
    check: Callable[..., Any] | None = None
    """After every policy step, errors up to date, before common failures are looked for: finds the task's own.

    A cause other than 0 that it writes into `cause` ends the episode, as one written by any other of these does."""
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
        FAILURES: names of failures of its own; the first is cause `failures.FIRST_OWN`. A tuple where `KERNELS` write
            them, or a dict with what finds each: an inlined kernel of (e, View) that returns a truth value, or a NumPy
            function of (View) that returns truth values (E,). They count where nothing else has failed.
        MIN_DRONES: with fewer it makes no sense.
        ERROR: metric of `run_episodes` by which policies that succeed alike are compared, a length [m].
        MAX_DISTANCE: of the payload from its target, beyond which it is out of range [m].
        CAN_PLAN: whether planners can fly it: all cables taut throughout, no drone lost, nothing in the way.
        CHAINS: whether cables may be chains.

    Args:
        config: of the environments; `task_options`, `reward`, `env` and `sim` count.
        world: the simulated teams.
        reference: what the drones follow.
        sensing: what they observe through.

    Attributes:
        config, world, reference: as given.
        options: `task_options`, checked; a subclass that annotates it with its own `Options` has it typed.
        numpy: NumpyFunctions, those of its functions that are no kernels.
        view: View, what its kernels read and write; the following are fields of it: goal, planned, errors, mask, rig,
            limits, time, cause, terms, good_time, min_separation, action, previous, dt, control_dt, own, settings.
        weights, margins: of the reward terms (T,), (T, M), in the order of `REWARD`.
        drone_numbers: where the drones' numbers stand in the global state.
        rmse_after: time from which errors count for `payload_rmse_m` [s].
        equilibrium: RigArrays; in `start`, the true ones of the environment, else `rig`, which is nominal.

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
    FAILURES: ClassVar[tuple[str, ...] | dict[str, Callable[..., Any]]] = ()
    MIN_DRONES: ClassVar[int] = 1
    ERROR: ClassVar[str] = "payload_position_error_m"
    MAX_DISTANCE: ClassVar[float] = MAX_DISTANCE
    CAN_PLAN: ClassVar[bool] = True
    CHAINS: ClassVar[bool] = True
    own: Any
    settings: Any

    def __init__(self, config: Config, world: World, reference: Reference, sensing: Sensing):
        e, n, system = world.num_envs, world.num_drones, world.system
        if n < self.MIN_DRONES:
            raise ConfigError(f"task {self.name} needs more drones; raise env.num_drones to {self.MIN_DRONES} or more")
        if config.cable.model == "chain" and not self.CHAINS:
            raise ConfigError(f"task {self.name} has no chains; set cable.model=massless")
        self.config, self.world, self.reference, self._sensing = config, world, reference, sensing
        self.options = validate(self.Options, config.task_options, "task_options")
        check_options(self.options, world.system)
        self.weights, self.margins = resolve_reward(self.name, self.REWARD, config.reward)
        self.dt, self.control_dt = 1.0 / config.env.policy_hz, 1.0 / config.sim.control_hz
        self.goal, self.errors = Goal.zeros(e, n), Errors.zeros(e)
        self.planned = self.goal
        self.rig = self.equilibrium = world.rig
        self.limits, self.mask = make_limits(system, self.MAX_DISTANCE), FailureMask.zeros(e, n)
        size = sensing.action_size
        self.action, self.previous = np.zeros((2, e, n, size))
        self.observation = np.zeros((e, n, sensing.observation_size), np.float32)
        varied = system.varied | ({"gust"} if config.wind.turbulence or any(config.wind.gust) else set())
        varied |= {"obstacles"} if sensing.obstacles else set()
        self._state = state_components(varied, self.EXTRA_STATE)
        self.drone_numbers = self._state.drone_numbers(n, size)
        self.critic = np.zeros((e, self._state.size(n, size)), np.float32)
        self.cause, self.time, self.good_time, self.min_separation = np.zeros(e, np.int64), *np.zeros((3, e))
        self.clearance, self.min_clearance = np.full((2, e), SIGHT)
        self.terms = np.zeros((e, len(self.REWARD)))
        self.rmse_after = 0.0
        self.own, self.settings = (), ()
        self.prepare()
        self.view = View(
            state=world.state,
            estimated=sensing.state,
            payload_estimate=sensing.load,
            payload=true_load(world.state),
            true_errors=self.errors.as_rows(),
            disturbances=world.hidden_loads,
            parameters=world.parameters,
            gust=world.air.gust,
            action_delay=sensing.memory.action_delay,
            goal=self.goal,
            planned=self.planned,
            has_plan=self.planned is not self.goal,
            errors=self.errors,
            integral_limit=INTEGRAL_LIMIT * observed_units(config, ("m s", "rad s")),
            estimated_errors=sensing.errors or self.errors.as_rows(),
            reference=reference,
            rig=self.rig,
            rig_numbers=describe_rig(system, self.dt),
            resting_tension=system.resting_tension,
            limits=self.limits,
            mask=self.mask,
            action=self.action,
            previous=self.previous,
            time=self.time,
            cause=self.cause,
            good_time=self.good_time,
            min_separation=self.min_separation,
            obstacles=world.obstacles,
            obstacle_readings=sensing.obstacles.readings.observed if sensing.obstacles else None,
            nodes=world.nodes,
            clearance=self.clearance,
            min_clearance=self.min_clearance,
            terms=self.terms,
            dt=self.dt,
            control_dt=self.control_dt,
            own=self.own,
            settings=self.settings,
        )
        self._views: dict[Callable[..., Any], View] = {}
        true = self.view._replace(
            estimated=world.state, payload_estimate=self.view.payload, estimated_errors=self.view.true_errors
        )
        parts = list_components(config.control.action, self.extra(config))
        units = [part.unit for part in parts for _ in range(part.size)]
        listed = self._state.listed(n, size)
        self.numpy = NumpyFunctions(self, true, parts, 1 / observed_units(config, units), listed)
        self.stages = self._compose(true)

    @classmethod
    def extra(cls, config: Config) -> tuple[Component, ...]:
        """Return what observations have beside the common components: the task's own, and what only sensors tell."""
        rig = () if config.env.units == "si" else (RIG,)
        return kernels_first((*cls.EXTRA, *sensed_components(config.env), *rig))

    @classmethod
    def causes(cls) -> tuple[str, ...]:
        """Return the names of the values of `cause`: those of all tasks, then the task's own."""
        return (*CAUSES, *cls.FAILURES)

    @classmethod
    def own_failures(cls) -> dict[str, Callable[..., Any]]:
        """Return what finds each of its own failures; none where `KERNELS` write them."""
        return dict(cls.FAILURES) if isinstance(cls.FAILURES, dict) else {}

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
        return self.good_time >= min(seconds, self.config.env.length) - 1e-9

    def criteria(self) -> tuple[Criterion, ...]:
        """Return what a success needs beside time, for reports; who overrides `succeeded` overrides this, too."""
        if self.KERNELS.is_good is not is_within_bounds:
            return ()
        return rest_criteria(getattr(self.settings, "bounds", None), self.errors, self.world.state)

    def success_windows(self) -> tuple[tuple[float, float], ...]:
        """Return from when to when [s] an episode has to be within the success region throughout."""
        length = self.config.env.length
        return ((length - min(getattr(self.options, "success_seconds", 0.0), length), length),)

    def metrics(self) -> dict[str, np.ndarray]:
        """Return numbers (E,) of the episodes so far by name, which evaluation reports beside those of all tasks."""
        return {"min_clearance_m": self.min_clearance.copy()} if self.world.system.scenery.count else {}

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

    def preview_targets(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return where the payload is to be, and its attitude, (E, M, 3) [m] and (E, M, 3, 3), at times to come.

        A planner sees ahead by this; here the target is taken to stay where it is.

        Args:
            times: (E, M) since the start of the episode [s].
        """
        shape = times.shape
        position = np.broadcast_to(self.planned.position[:, None], (*shape, 3))
        return position, np.broadcast_to(self.planned.rotation[:, None], (*shape, 3, 3))

    def target_path(self, env: int) -> np.ndarray:
        """Return points (P, 3) [m] of the path that the target takes in this episode, to draw it; none if it stays."""
        return np.zeros((0, 3))

    def scenery(self, env: int) -> list[Box]:
        """Return what stands around in environment `env`, to draw it: its obstacles."""
        return draw_obstacles(env, self.world.obstacles)

    def draw_start(self, env: int, rng: np.random.Generator, parameters: Parameters) -> bool:
        """Draw a start of environment `env`, whose team has true `parameters`; return whether it is sound.

        That is what the core calls, for as many draws as it takes; tasks say by `start` what is drawn.
        """
        self.equilibrium = true_equilibrium(self.rig, parameters, env)
        self.start(env, rng, float(parameters.payload_mass[env]))
        self.numpy.start_goals(env, env + 1)
        self.equilibrium = self.rig
        for name in _HANDED_ON:
            if getattr(self, name) is not getattr(self.view, name):
                raise ConfigError(
                    f"task {self.name} replaced `{name}` after prepare(), which its kernels never see; write into its "
                    "arrays in place"
                )
        return self.begin(env)

    def begin(self, env: int) -> bool:
        """Reset the measurements of one environment to its drawn start; return whether that start is sound."""
        self.errors.position_integral[env] = self.errors.rotation_integral[env] = 0.0
        self.good_time[env], self.min_separation[env], self.terms[env], self.time[env] = 0.0, 1e9, 0.0, 0.0
        self.clearance[env] = self.min_clearance[env] = SIGHT
        self.cause[env] = 0
        restart_obstacles(env, self.world.obstacles)
        self.stages["measure"](env, env + 1)
        self.numpy.find_failures(env, env + 1)
        return bool(self.cause[env] == 0)

    def check_written(self, env: int) -> None:
        """Refuse, by a ConfigError, components of observation or global state that are not written in a first step."""
        size, parts = self.action.shape[2], list_components(self.config.control.action, self.extra(self.config))
        check_written(self.observation[env], parts, "observation")
        check_written(self.critic[env], self._state.listed(self.world.num_drones, size), "global state")

    def state_dict(self) -> dict[str, np.ndarray]:
        """Return copies of the task's arrays that outlive a step."""
        return {name: array.copy() for name, array in self._arrays().items()}

    def count_limits(self) -> dict[str, tuple[int, int]]:
        """Return the least and largest value of whole numbers in `own` that kernels index by, by dotted name."""
        return {}

    def load_state_dict(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore what `state_dict` returned."""
        for name, array in self._arrays().items():
            array[:] = saved[name]

    def _arrays(self) -> dict[str, np.ndarray]:
        """Return the arrays that outlive a step, by dotted name."""
        names = ["cause", "good_time", "min_separation", "time", "action", "observation", "critic"]
        names += ["clearance", "min_clearance"] if self.world.system.scenery.count else []
        arrays = {name: getattr(self, name) for name in names}
        groups = {"goal": self.goal, "errors": self.errors, "mask": self.mask}
        groups |= {"planned": self.planned} if self.planned is not self.goal else {}
        groups |= {"own": self.own} if self.own else {}
        for group, record in groups.items():
            arrays |= {f"{group}.{name}": array for name, array in flatten(record)}
        return arrays

    def _compose(self, true: View) -> dict[str, Call]:
        """Return the stages of a step that are the task's kernels, each a call of (lo, hi)."""
        v, kernels, size = self.view, self.KERNELS, self.action.shape[2]
        extra, action = self.extra(self.config), self.config.control.action
        observe = bind_kernel(compose_observation(extra, action), v, self.observation)
        if self.config.env.units != "si":
            units = [part.unit for part in list_components(action, extra) for _ in range(part.size)]
            factors = 1 / observed_units(self.config, units)
            observe = in_turn(observe, prebind(scale_numbers, self.observation, factors))
        own = enumerate(self.own_failures().values(), FIRST_OWN)
        failures = {number: has_failed for number, has_failed in own if not is_plain(has_failed)}
        has_obstacles = self.world.system.scenery.count > 0
        found: dict[str, Any] = {"check": kernels.check, "own": failures, "obstacles": has_obstacles}
        stages = {
            # In a reset time stands still, and chains are placed later, by `World.load`.
            "measure": bind_check(v._replace(nodes=None), 0.0, **found, passed=0.0),
            "check": bind_check(v, self.dt, **found, passed=self.dt if kernels.plan is None else 0.0),
            "reward": bind_kernel(
                compose_reward(self.REWARD, kernels.is_good, kernels.update), v, self.weights, self.margins
            ),
            "observe": observe,
        }
        stages["observe state"] = bind_state(self._state, kernels.preview, true, self.critic, size)
        if self.numpy.plans:
            stages["plan"] = self.numpy.bind_approach()
        elif kernels.plan is not None:
            stages["plan"] = bind_kernel(compose_plan(kernels.plan), v)
        return stages
