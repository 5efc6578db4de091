"""Navigate: the team carries its payload from a start to a goal, among obstacles that nothing may touch."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.formation import place_formation
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import drawing, inlined
from multilift_marl.math3d import IDENTITY, add, ease, norm, put, putmat, row, scale, sub
from multilift_marl.mdp.criteria import ArrivalOptions, Criterion, rest_criteria, tension_criterion
from multilift_marl.mdp.failures import RANGE
from multilift_marl.mdp.initial_states import check_target_height, in_ball, set_equilibrium
from multilift_marl.mdp.observations import Component, target_velocity
from multilift_marl.mdp.rewards import (
    RestBounds,
    Term,
    action_rate,
    attitude,
    body_rate,
    distance,
    failure,
    tolerance,
    update_peak_tension,
    velocity,
)
from multilift_marl.navigation.team_clearance import rest_clearance
from multilift_marl.planning.maps import (
    GAPS,
    LENGTH,
    LEVELS,
    MAX_WALLS,
    SLOTS,
    WALLS,
    Course,
    Map,
    draw_map,
    place_map,
    unit_length,
)
from multilift_marl.rig.obstacles import NONE
from multilift_marl.rig.system import System
from multilift_marl.schema.values import Between, Counts, Float, Int, Section, Span, Vector
from multilift_marl.sim.obstacles import Obstacles, half_extents
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.target_checks import check_way, warn_of_time

Place = Annotated[Vector, Between(-1e3, 1e3, "m")]
SPARE = 0.10  # [m] of clearance that the reward asks for
FAR = 9.0  # [m] that a goal is seen to be away at most, of four falcons: beyond all of the usual length
APART = 0.01  # [m] that start and goal of a given map are at least
ROOM = 2.0  # [m] of the payload's space about a given map
PEAK = 35.0 / 16.0  # of an eased motion's speed over its mean, see `math3d.ease`


class NavigateOptions(ArrivalOptions):
    """The map, the target's motion along the straight line, and what counts as success."""

    level: Literal["sparse", "dense", "narrow", "low", "unknown", "given"] = Field(
        "sparse", description="of the maps; given: scene.obstacles, start and goal"
    )
    start: Place | None = Field(None, description="[m] of the payload, level given")
    goal: Place | None = Field(None, description="[m] of the payload, level given")
    low: Place | None = Field(
        None, description="[m] lowest corner of the payload's space, level given; None: 2 m beyond all"
    )
    high: Place | None = Field(None, description="[m] highest corner")
    gaps: Annotated[Span, Between(0.1, 1.5)] = Field(
        GAPS, description="[-] widths of the gaps of level narrow over the resting formation's, or their range"
    )
    slots: Annotated[Span, Between(0.1, 3)] = Field(
        SLOTS, description="[-] heights of the slots of level low over the resting formation's, or their range"
    )
    walls: Int = Field(WALLS, ge=1, le=MAX_WALLS, description="of levels narrow and low")
    length: Annotated[Float, Between(4, 100, "m")] = Field(
        LENGTH, description="[m] from start to goal, for a formation as wide as that of four falcons"
    )
    pillars: Counts | None = Field(None, description="of a map, or their range; None: the level's, in 8 m")
    map: Int | None = Field(None, ge=0, lt=2**31, description="seed of the one map; None: drawn for each episode")
    speed: Annotated[Float, Between(0.01, 100, "m/s")] = Field(1.0, description="[m/s] peak speed of the target")
    start_radius: Float = Field(0.05, ge=0, description="[m] start within a ball of this radius about the map's")

    @property
    def course(self) -> Course:
        """What the level leaves open."""
        return Course(self.length, self.pillars, self.gaps, self.walls, self.slots)


OF_LEVELS = {
    ("start", "goal", "low", "high"): ("given",),
    ("pillars",): ("sparse", "dense", "unknown"),
    ("map",): LEVELS,
}


def check_level(option: NavigateOptions) -> None:
    """Refuse, by a ConfigError, options of other levels; gaps, slots, walls, length may come from a configuration."""
    for names, levels in OF_LEVELS.items():
        if option.level in levels:
            continue
        for name in names:
            if getattr(option, name) != NavigateOptions.model_fields[name].get_default():
                raise ConfigError(
                    f"task_options.{name} means nothing at level {option.level}; set it to null, or "
                    f"task_options.level={'|'.join(levels)}"
                )


class NavigateArrays(NamedTuple):
    """What an episode holds beside its goal."""

    map: np.ndarray
    """(E,) int64 seed of the map."""
    start: np.ndarray
    """(E, 3) of the target [m]."""
    goal: np.ndarray
    """(E, 3) [m]."""
    low: np.ndarray
    """(E, 3) of the space that the payload may use [m]."""
    high: np.ndarray
    """(E, 3)."""
    place: np.ndarray
    """(E, 3) of the payload at the last policy step [m]."""
    travelled: np.ndarray
    """(E,) length of its way [m]."""
    peak_tension: np.ndarray
    """(E,) largest tension in the episode over that at rest [-]."""


class NavigateSettings(NamedTuple):
    """Constants of the task."""

    speed: float
    radius: float
    far: float
    bounds: RestBounds


@inlined
def move_target(e, t, v):
    """Write the goal of environment e at a time: straight from the start to the goal."""
    begin, way = row(v.own.start, e), sub(row(v.own.goal, e), row(v.own.start, e))
    share, first, second, third = ease(t, 0.0, PEAK * norm(way) / v.settings.speed)
    goal = v.goal
    put(goal.position[e], add(begin, scale(share, way)))
    put(goal.velocity[e], scale(first, way))
    put(goal.acceleration[e], scale(second, way))
    put(goal.jerk[e], scale(third, way))
    place_formation(e, goal, v.rig)


@drawing
def start_at_rest(e, rng, v, equilibrium):
    """Write goal and team at the start of the map."""
    goal = v.goal
    putmat(goal.rotation[e], IDENTITY)
    move_target(e, 0.0, v)
    moved = in_ball(rng, v.settings.radius)
    pose = add(row(goal.position, e), moved), IDENTITY
    set_equilibrium(e, v, goal, equilibrium, pose, (0.0, 0.0, 0.0), moved)


@inlined
def advance_target(e, v):
    """Move the goal on; note the largest tension."""
    update_peak_tension(e, v, v.own.peak_tension)
    move_target(e, v.time[e], v)


@inlined
def has_arrived(e, v):
    """Payload at rest at the goal, wherever the target is."""
    bounds, state = v.settings.bounds, v.state
    if norm(sub(row(state.payload_position, e), row(v.own.goal, e))) > bounds.distance:
        return False
    moving = norm(row(state.payload_velocity, e)) > bounds.speed
    turning = norm(row(state.payload_body_rates, e)) > bounds.body_rate
    return v.errors.angle[e] <= bounds.angle and not (moving or turning)


@inlined
def measure_way(e, v):
    """Add to the length of the payload's way; count leaving the map as a failure."""
    here = row(v.state.payload_position, e)
    moved = norm(sub(here, row(v.own.place, e)))
    # At the first check, of the reset, no way has been made.
    v.own.travelled[e] = v.own.travelled[e] + moved if v.time[e] > 0.0 else 0.0
    put(v.own.place[e], here)
    for i in range(3):
        if v.cause[e] == 0 and not v.own.low[e, i] <= here[i] <= v.own.high[e, i]:
            v.cause[e] = RANGE


@inlined
def clearance(e, v, margin):
    """Drones, cables and payload away from obstacles."""
    return tolerance(max(SPARE - v.clearance[e], 0.0), margin)


@inlined
def to_goal(e, n, v):
    """Goal minus where the target is, no longer than on a course of the usual length."""
    way = sub(row(v.own.goal, e), row(v.goal.position, e))
    return scale(v.settings.far / max(norm(way), v.settings.far), way)


@inlined
def least_clearance(e, n, v):
    """Least distance of drones, cables and payload from obstacles, at most 2 m."""
    return v.clearance[e]


def given_map(option: NavigateOptions, system: System, obstacles: Obstacles) -> Map:
    """Return the map of level `given`: obstacles are the scene's.

    Raises:
        ConfigError: no start or goal, or one in the ground or outside the payload's space, or where the team is in an
            obstacle.
    """
    if option.start is None or option.goal is None:
        raise ConfigError("task_options.level=given needs task_options.start and task_options.goal, x, y, z [m] each")
    start, goal = np.array(option.start), np.array(option.goal)
    used = obstacles.kind[0] != NONE
    far = half_extents(obstacles.kind[0, used], obstacles.size[0, used], obstacles.rotation[0, used])
    if np.linalg.norm(goal - start) < APART:
        raise ConfigError(
            f"task_options.start and goal are less than {APART:g} m apart, and there is no way between them; move one"
        )
    points = np.vstack([start, goal, obstacles.center[0, used] - far, obstacles.center[0, used] + far])
    low = points.min(axis=0) - ROOM if option.low is None else np.array(option.low)
    high = points.max(axis=0) + ROOM if option.high is None else np.array(option.high)
    for name, place in (("start", start), ("goal", goal)):
        check_target_height(f"task_options.{name}={place.tolist()}", place[2], system)
        if (place < low).any() or (place > high).any():
            raise ConfigError(
                f"task_options.{name}={place.tolist()} is outside the payload's space from {low.tolist()} to "
                f"{high.tolist()} m; move it, or widen task_options.low and task_options.high"
            )
        if rest_clearance(system, obstacles, 0, (*place.tolist(), 0.0)) <= 0:
            raise ConfigError(f"at task_options.{name}={place.tolist()} the team is in an obstacle; move one of them")
    return Map(start, goal, low, high, ())


class Navigate(Task):
    """Carry the payload to the goal among obstacles; see docs/navigate.md."""

    name: ClassVar[str] = "navigate"
    Options: ClassVar[type[Section]] = NavigateOptions
    options: NavigateOptions
    own: NavigateArrays
    settings: NavigateSettings
    MAX_DISTANCE: ClassVar[float] = 1e4  # the map's bounds count instead
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.4, distance, 0.5, "m"),
        "clearance": Term(0.4, clearance, 0.05, "m"),
        "velocity": Term(0.2, velocity, 0.3, "m/s"),
        "attitude": Term(0.1, attitude, 10.0, "deg"),
        "stillness": Term(0.1, body_rate, 0.3, "rad/s"),
        "failure": Term(-20.0, failure),
        "action_rate": Term(-0.05, action_rate),
    }
    KERNELS: ClassVar[Kernels] = Kernels(is_good=has_arrived, plan=advance_target, check=measure_way)
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("to_goal", 3, "slot", "m", "goal minus the target's present place, up to 9 m", to_goal),
        Component("target_velocity", 3, "slot", "m/s", "velocity of the target", target_velocity),
    )
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = (
        Component("to_goal", 3, "world", "m", "goal minus the target's present place, up to 9 m", to_goal),
        Component("target_velocity", 3, "world", "m/s", "velocity of the target", target_velocity),
        Component("clearance", 1, "-", "m", "least distance from obstacles, at most 2", least_clearance),
    )

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, e, scenery = self.options, self.world.num_envs, self.world.system.scenery
        check_level(option)
        if option.level == "low" and self.world.num_drones == 1:
            raise ConfigError("task_options.level=low needs two drones or more, whose cables lean; set another level")
        if option.level == "given":
            self._given = given_map(option, self.world.system, self.world.obstacles)
        elif scenery.reserved < (rows := option.course.capacity(option.level)):
            raise ConfigError(f"task navigate places up to {rows} obstacles; set scene.reserved={rows} or more")
        way = np.array([option.length * unit_length(self.world.system), 0.0, 0.0])
        if option.level == "given":
            way = self._given.goal - self._given.start
        lasts = PEAK * float(np.linalg.norm(way)) / option.speed
        check_way(f"task_options.speed={option.speed:g} m/s", "lower it", way, lasts, self.world.system)
        arrives = f"with task_options.speed={option.speed:g} m/s the target of task navigate arrives at"
        warn_of_time(arrives, lasts, self.config.env.episode_seconds)
        self._first = len(scenery.obstacles)
        start, goal, low, high, place = (np.zeros((e, 3)) for _ in range(5))
        lengths = np.zeros(e), np.zeros(e)
        far = FAR * unit_length(self.world.system)
        self.own = NavigateArrays(np.zeros(e, np.int64), start, goal, low, high, place, *lengths)
        self.settings = NavigateSettings(option.speed, option.start_radius, far, RestBounds.of(option))

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw the map, and where the team starts; see `Task.start`."""
        option, own = self.options, self.own
        seed = int(rng.integers(2**31)) if option.map is None else option.map
        if option.level == "given":
            drawn = self._given
        else:
            drawn = draw_map(option.level, seed, self.world.system, option.course)
        place_map(env, drawn, self.world.obstacles, self._first)
        own.map[env], own.start[env], own.goal[env] = seed, drawn.start, drawn.goal
        own.low[env], own.high[env], own.peak_tension[env] = drawn.low, drawn.high, 0.0
        start_at_rest(env, rng, self.view_for(start_at_rest), self.equilibrium)
        own.place[env], own.travelled[env] = self.world.state.payload_position[env], 0.0

    def succeeded(self) -> np.ndarray:
        """At rest at the goal throughout the last moments, and never too large a tension."""
        return super().succeeded() & (self.own.peak_tension <= self.options.success_tension)

    def metrics(self) -> dict[str, np.ndarray]:
        """See `Task.metrics`; `arrival_time_s` is the whole episode's where the payload is not at rest at the goal."""
        straight = np.linalg.norm(self.own.goal - self.own.start, axis=1)
        arrived = np.where(self.good_time > 0, self.time - self.good_time, self.config.env.length)
        return super().metrics() | {"arrival_time_s": arrived, "path_length_ratio": self.own.travelled / straight}

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        found = rest_criteria(self.settings.bounds, self.errors, self.world.state, self.own.goal)
        return (*found, tension_criterion(self.own.peak_tension, self.options.success_tension))

    def preview_targets(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """See `Task.preview_targets`."""
        way = self.own.goal - self.own.start
        duration = PEAK * np.linalg.norm(way, axis=1, keepdims=True) / self.settings.speed
        s = np.clip(times / duration, 0.0, 1.0)
        # `math3d.ease` of whole arrays: rest to rest, smooth to the third derivative.
        share = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
        position = self.own.start[:, None] + share[..., None] * way[:, None]
        return position, np.broadcast_to(np.eye(3), (*times.shape, 3, 3))

    def target_path(self, env: int) -> np.ndarray:
        """Return the ends of the straight line; see `Task.target_path`."""
        return np.stack([self.own.start[env], self.own.goal[env]])
