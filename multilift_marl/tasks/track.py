"""Track: the payload follows a path, level."""

from __future__ import annotations

from math import pi, sqrt
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.config.config import Config
from multilift_marl.control.formation import place_formation, set_heading
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import drawing, inlined, kernel
from multilift_marl.math3d import add, matrow, put, putmat, rot_z, row, scale, sub, vec
from multilift_marl.mdp.criteria import Criterion
from multilift_marl.mdp.failures import least_height
from multilift_marl.mdp.initial_states import in_ball, set_equilibrium
from multilift_marl.mdp.observations import Component, target_velocity
from multilift_marl.mdp.rewards import Term, action_rate, attitude, distance, failure, tolerance, velocity
from multilift_marl.planning.path_file import PathFile, load_path
from multilift_marl.planning.paths import (
    CIRCLE,
    FIGURE8,
    FILE,
    HELIX,
    LEMNISCATE,
    PATHS,
    RAMP,
    RANDOM,
    STEP,
    Path,
    differences,
    draw_curve,
    largest_rates,
    motion,
    own_time,
    place,
    set_goal,
)  # fmt: skip
from multilift_marl.planning.spline import NO_FILE, spline_yaw
from multilift_marl.planning.waypoints import load_waypoints
from multilift_marl.schema.validate import validate
from multilift_marl.schema.values import Between, Choice, Float, Places, Section, Span, Vector
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.target_checks import check_paths

AHEAD = (0.1, 0.2, 0.4, 0.8)  # [s], with env.units=cable, too
_DRAWN = 400  # points of a path that is drawn


Form = Literal["circle", "figure8", "lemniscate", "helix", "random", "file", "waypoints"]


class TrackOptions(Section):
    """The path, drawn for each episode where it is given as a list of forms or a range, and what counts as success."""

    path: Annotated[tuple[Form, ...], Choice] = Field(
        ("figure8",),
        min_length=1,
        description="its form: circle, figure8, lemniscate, helix, random, file, waypoints, or some to draw from",
    )
    file: str | None = Field(None, description="of path=file: CSV, .npy or .npz with t [s], x, y, z [m], yaw [rad]")
    file_spacing: Float = Field(
        0.1, ge=0, description="[s] closer rows of a file are smoothed and thinned out to this; 0: none are"
    )
    file_ramp: Annotated[Float, Between(0, 60, "s")] = Field(
        0.0, description="[s] in which the target of a file gathers its speed, and loses it at the end; 0: as written"
    )
    file_offset: Annotated[Vector, Between(-1e6, 1e6, "m")] = Field(
        (0.0, 0.0, 0.0), description="[m] added to the positions of a file"
    )
    waypoints: Places = Field(
        None,
        description="of path=waypoints: a list of [x, y, z] or [x, y, z, yaw], in m and rad, or a CSV file of columns "
        "x, y, z and perhaps yaw and t [s]",
    )
    waypoint_times: tuple[Float, ...] | None = Field(
        None, description="[s] at which they are passed, from the first; None: the file's, or by speed and acceleration"
    )
    speed: Span = Field(
        (1.0, 1.0), description="[m/s] peak speed v of figure8, lemniscate, random and waypoints, or its range"
    )
    acceleration: Span = Field((0.5, 0.5), description="[m/s²] their peak acceleration a, or its range")
    radius: Span = Field((5.0, 5.0), description="[m] of circle and helix, or its range")
    rate: Span = Field((0.2, 0.2), description="[rad/s] of circle and helix, or its range")
    climb: Float = Field(0.5, ge=0, description="[m] that a helix goes up, and down, from its middle height")
    room: Annotated[Vector, Between(0.01, 1e3, "m")] = Field(
        (3.0, 3.0, 0.5), description="[m] random way-points within ± this of the start"
    )
    height: Float = Field(2.0, gt=0, description="[m] of the path's centre")
    start_radius: Float = Field(0.1, ge=0, description="[m] start within a ball of this radius about the path's start")
    preview: bool = Field(
        True, description="whether drones observe where the target will be; if not, its velocity and acceleration alone"
    )
    success_distance: Float = Field(0.5, gt=0, description="[m] payload never farther than this from its target")
    rmse_from: Float = Field(5.0, ge=0, description="[s] errors count for payload_rmse_m from this time on")


class TrackArrays(NamedTuple):
    """What an episode holds beside its goal."""

    path: Path
    worst: np.ndarray
    """(E,) largest distance from the target in the episode [m]."""
    ahead: np.ndarray
    """(E, K, 3) how the target moves in the next seconds, see `AHEAD` [m]."""


class TrackSettings(NamedTuple):
    """Constants of the task."""

    table: np.ndarray
    """Spline of the path of a file or of way-points, see `path_file.load_path`."""
    height: float
    """Of the path's centre [m]."""
    radius: float
    """Of the ball about the path's start in which the team starts [m]."""


@kernel
def _turn_target(e, t, table, goal, rig):
    """Write heading of the target of environment e by a file, and how its formation moves as it turns with it."""
    # The yaw comes as the first of three numbers, so that `differences` takes it like a place.
    before, after = spline_yaw(table, t - STEP), spline_yaw(table, t + STEP)
    outer, last = spline_yaw(table, t - 2.0 * STEP), spline_yaw(table, t + 2.0 * STEP)
    yaw, rate, change, jerk = differences(outer, before, spline_yaw(table, t), after, last)
    w, dw, ddw = rate[0], change[0], jerk[0]
    putmat(goal.rotation[e], rot_z(yaw[0]))
    place_formation(e, goal, rig)
    put(goal.angular_velocity[e], (0.0, 0.0, w))
    goal.drone_yaw_rate[e] = w
    for n in range(rig.slots.shape[0]):  # derivatives of a level arm that turns about the vertical
        # level' = w across, across' = -w level.
        arm = sub(vec(goal.slots, e, n), row(goal.position, e))
        level, across = (arm[0], arm[1], 0.0), (-arm[1], arm[0], 0.0)
        # Hence level'' = w' across - w² level and level''' = (w'' - w³) across - 3 w w' level.
        put(goal.slot_velocity[e, n], scale(w, across))
        put(goal.slot_acceleration[e, n], sub(scale(dw, across), scale(w * w, level)))
        put(goal.slot_jerk[e, n], sub(scale(ddw - w**3, across), scale(3.0 * w * dw, level)))


@inlined
def aim(e, t, v):
    """Write the goal of environment e at a time."""
    path, goal, rig = v.own.path, v.goal, v.rig
    set_goal(e, motion(e, t, path, v.settings.table), goal)
    if path.kind[e] == FILE:
        _turn_target(e, t, v.settings.table, goal, rig)
        return
    place_formation(e, goal, rig)
    if path.kind[e] == CIRCLE or path.kind[e] == HELIX:  # drones face along the path
        set_heading(e, path.heading[e] + path.rate[e] * own_time(t) + 0.5 * pi, goal, rig)
        # ω dτ/dt, by a central difference of the path's own time: 0 at the start, ω after the ramp.
        goal.drone_yaw_rate[e] = path.rate[e] * (own_time(t + 1e-3) - own_time(t - 1e-3)) / 2e-3


@drawing
def start_on_path(e, rng, v, equilibrium):
    """Write goal and team at the start of the path, with the target's velocity."""
    goal, path = v.goal, v.own.path
    # Without a centre `place` returns where the bare curve begins, which the centre then takes away.
    put(path.centre[e], (0.0, 0.0, 0.0))
    begin = place(e, 0.0, path, v.settings.table)
    # every path but a file's starts above the origin
    put(path.centre[e], (-begin[0], -begin[1], v.settings.height - begin[2]))
    putmat(goal.rotation[e], rot_z(path.heading[e]))
    goal.drone_yaw_rate[e] = 0.0  # the last episode may have been on a path of another form
    for turning in (goal.slot_velocity, goal.slot_acceleration, goal.slot_jerk):
        turning[e] = 0.0
    goal.angular_velocity[e] = 0.0
    aim(e, 0.0, v)
    moved = in_ball(rng, v.settings.radius)
    pose = add(row(goal.position, e), moved), matrow(goal.rotation, e)
    set_equilibrium(e, v, goal, equilibrium, pose, row(goal.velocity, e), moved)


@inlined
def advance_target(e, v):
    """Move the goal along its path."""
    aim(e, v.time[e], v)


@inlined
def preview_target(e, v):
    """Compute how the target moves in the next seconds."""
    for i in range(len(AHEAD)):
        there = place(e, v.time[e] + AHEAD[i], v.own.path, v.settings.table)
        put(v.own.ahead[e, i], sub(there, row(v.goal.position, e)))


@inlined
def update_max_error(e, v):
    """Note the largest distance from the target."""
    v.own.worst[e] = max(v.own.worst[e], v.errors.distance[e])


@inlined
def never(e, v):
    """Success does not depend on the last seconds."""
    return False


@inlined
def heading(e, v, margin):
    """Payload's heading close to its target's."""
    return tolerance(v.errors.rotation[e, 2], margin)


@inlined
def target_acceleration(e, n, v):
    """Acceleration of the target."""
    return row(v.goal.acceleration, e)


@inlined
def target_ahead_0(e, n, v):
    """How the target moves in the next seconds, number 0 of `AHEAD`."""
    return row(v.own.ahead[e], 0)


@inlined
def target_ahead_1(e, n, v):
    """How the target moves in the next seconds, number 1 of `AHEAD`."""
    return row(v.own.ahead[e], 1)


@inlined
def target_ahead_2(e, n, v):
    """How the target moves in the next seconds, number 2 of `AHEAD`."""
    return row(v.own.ahead[e], 2)


@inlined
def target_ahead_3(e, n, v):
    """How the target moves in the next seconds, number 3 of `AHEAD`."""
    return row(v.own.ahead[e], 3)


@kernel
def _preview(times, path, table, position, rotation):
    """Write places (E, M, 3) and attitudes (E, M, 3, 3) of the targets at times (E, M)."""
    for e in range(times.shape[0]):
        for m in range(times.shape[1]):
            # Planners take differences about the start, too; before it the target stands where it begins.
            t = max(times[e, m], 0.0)
            put(position[e, m], place(e, t, path, table))
            yaw = spline_yaw(table, t)[0] if path.kind[e] == FILE else path.heading[e]
            putmat(rotation[e, m], rot_z(yaw))


@kernel
def _trace(e, seconds, path, table, points):
    for i in range(points.shape[0]):
        put(points[i], place(e, seconds * i / (points.shape[0] - 1), path, table))


def _components(frame: str) -> tuple[Component, ...]:
    values = (target_ahead_0, target_ahead_1, target_ahead_2, target_ahead_3)
    ahead = (
        Component(
            f"target_ahead_{round(1000 * t)}ms", 3, frame, "m", f"how the target moves in the next {t:g} s", value
        )
        for t, value in zip(AHEAD, values, strict=True)
    )
    return (
        Component("target_velocity", 3, frame, "m/s", "velocity of the target", target_velocity),
        Component("target_acceleration", 3, frame, "m/s²", "acceleration of the target", target_acceleration),
        *ahead,
    )


class Track(Task):
    """Follow a path; see docs/track.md."""

    name: ClassVar[str] = "track"
    Options: ClassVar[type[Section]] = TrackOptions
    options: TrackOptions
    own: TrackArrays
    settings: TrackSettings
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.4, distance, 0.25, "m"),
        "precision": Term(0.3, distance, 0.02, "m"),
        "attitude": Term(0.1, attitude, 6.0, "deg"),
        "velocity": Term(0.2, velocity, 0.2, "m/s"),
        "heading": Term(0.0, heading, 0.5, "deg"),
        "failure": Term(0.0, failure),
        "action_rate": Term(-0.05, action_rate),
    }
    ERROR: ClassVar[str] = "payload_rmse_m"
    KERNELS: ClassVar[Kernels] = Kernels(never, plan=advance_target, update=update_max_error, preview=preview_target)
    EXTRA: ClassVar[tuple[Component, ...]] = _components("slot")
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = _components("target")

    @classmethod
    def extra(cls, config: Config) -> tuple[Component, ...]:
        """See `Task.extra`; without a preview what the target will do is left out."""
        parts = super().extra(config)
        if validate(TrackOptions, config.task_options, "task_options").preview:
            return parts
        return tuple(part for part in parts if not part.name.startswith("target_ahead"))

    def count_limits(self) -> dict[str, tuple[int, int]]:
        """Bound what kernels index by, see `Task`."""
        return {"path.kind": (0, len(PATHS) - 1)}

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, world, e = self.options, self.world, self.world.num_envs
        seconds, self._lowest = self.config.env.episode_seconds, least_height(world.system)
        self.rmse_after = option.rmse_from if option.rmse_from < seconds else 0.0
        self._check_forms()
        check_paths(option, seconds, world.system)
        table, team = NO_FILE, (world.system, self.config.randomization)
        if option.file:
            file = PathFile(option.file, option.file_spacing, option.file_ramp, option.file_offset)
            table = load_path(file, seconds, *team)
        elif option.waypoints:
            limits = option.speed, option.acceleration
            table = load_waypoints(option.waypoints, option.waypoint_times, *limits, seconds, *team)
        self.own = TrackArrays(Path.zeros(e), np.zeros(e), np.zeros((e, len(AHEAD), 3)))
        self.settings = TrackSettings(table, option.height, option.start_radius)

    def _check_forms(self) -> None:
        """Refuse files and way-points that the path does not fly, and a path without them, by a ConfigError."""
        option = self.options
        forms = ",".join(option.path)
        for form, value, kind in (("file", option.file, "path"), ("waypoints", option.waypoints, "list or CSV file")):
            if form in option.path and not value:
                raise ConfigError(f"task_options.path={form} needs one; set task_options.{form}=<{kind}>")
            if value and form not in option.path:
                raise ConfigError(
                    f"task_options.{form} is given, but task_options.path={forms} does not fly it; set "
                    f"task_options.path={form}, or task_options.{form}=null"
                )
        if option.file and option.waypoints:
            raise ConfigError(f"task_options.path={forms} has a file and way-points; leave one of them out")
        if option.waypoint_times and not option.waypoints:
            raise ConfigError("task_options.waypoint_times means nothing without task_options.waypoints; leave it out")

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw heading, form and figures of the path; the team hangs at its start. See `Task.start`.

        The path of a file and that of way-points have their own heading and place.
        """
        option, path = self.options, self.own.path
        heading = rng.uniform(-pi, pi)
        form = option.path[rng.integers(len(option.path))] if len(option.path) > 1 else option.path[0]
        kind = FILE if form == "waypoints" else PATHS.index(form)
        path.kind[env], path.heading[env], path.climb[env] = kind, heading, option.climb
        v, a = _draw(rng, option.speed), _draw(rng, option.acceleration)
        if kind in (CIRCLE, HELIX):
            path.size[env], path.rate[env] = _draw(rng, option.radius), _draw(rng, option.rate)
        elif kind == FIGURE8:  # peak speed A ω √2, peak acceleration with its factor at that size
            path.size[env], path.rate[env] = 1.0625 * v**2 / a, 0.6655 * a / v
        elif kind == LEMNISCATE:  # Bernoulli's: peak speed A ω and acceleration 3 A ω² at the ends
            path.size[env], path.rate[env] = 3 * v**2 / a, a / (3 * v)
        elif kind == RANDOM:
            path.curve[env] = draw_curve(rng, np.array(option.room), self._lowest - option.height)
            fastest, hardest = largest_rates(path.curve[env])
            path.rate[env] = min(v / fastest, sqrt(a / hardest))
        start_on_path(env, rng, self.view_for(start_on_path), self.equilibrium)
        self.own.worst[env] = 0.0

    def preview_targets(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the path's places and the target's headings; see `Task.preview_targets`."""
        position, rotation = np.zeros((*times.shape, 3)), np.zeros((*times.shape, 3, 3))
        _preview(times, self.own.path, self.settings.table, position, rotation)
        return position, rotation

    def target_path(self, env: int) -> np.ndarray:
        """Return the path, one round of it if it repeats; see `Task.target_path`."""
        path, table, length = self.own.path, self.settings.table, self.config.env.episode_seconds
        # A helix goes up and down by the sine of a quarter of its angle: four rounds until it repeats.
        points, kind = np.zeros((_DRAWN, 3)), path.kind[env]
        turns = 4 if kind == HELIX else 1
        if kind == FILE:
            lap = float(table[-1, 0])
        else:
            lap = np.inf if kind == RANDOM else turns * 2 * pi / path.rate[env] + RAMP / 2  # half the ramp is lost
        _trace(env, min(length, lap), path, table, points)
        return points

    def succeeded(self) -> np.ndarray:
        """Never too far from the target."""
        return self.own.worst <= self.options.success_distance

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        bound = self.options.success_distance
        return (Criterion("distance_m", bound, lambda: self.own.worst - bound, throughout=False),)

    def success_windows(self) -> tuple[tuple[float, float], ...]:
        """Return none: all of the episode counts."""
        return ()


def _draw(rng: np.random.Generator, span: tuple[float, float]) -> float:
    """Return a number uniform in a range; one that is given is not drawn."""
    return span[0] if span[0] == span[1] else float(rng.uniform(*span))
