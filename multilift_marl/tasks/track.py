"""Track: the payload follows a path, level."""

from __future__ import annotations

from collections.abc import Callable
from math import cos, pi, radians, sin, sqrt
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.values import Choice, Float, Section, Span, Vector
from multilift_marl.control.formation import Reference, place_formation, set_heading
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import add, matrow, norm, put, putmat, rot_z, row, scale, sub, turn, vec
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Task
from multilift_marl.tasks.observations import Component
from multilift_marl.tasks.path_file import load_path
from multilift_marl.tasks.paths import (
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
from multilift_marl.tasks.rewards import action_rate, tolerance
from multilift_marl.tasks.spline import NO_FILE, spline_yaw
from multilift_marl.tasks.starts import hang_team, in_ball

AHEAD = (0.1, 0.2, 0.4, 0.8)  # [s]
_DRAWN = 400  # points of a path that is drawn


Form = Literal["circle", "figure8", "lemniscate", "helix", "random", "file"]


class TrackOptions(Section):
    """The path, drawn for each episode where it is given as a list of forms or a range, and what counts as success."""

    path: Annotated[tuple[Form, ...], Choice] = Field(
        ("figure8",),
        min_length=1,
        description="its form: circle, figure8, lemniscate, helix, random, file, or some to draw from",
    )
    file: str | None = Field(None, description="of path=file: CSV, .npy or .npz with t [s], x, y, z [m], yaw [rad]")
    file_spacing: Float = Field(
        0.1, ge=0, description="[s] closer rows of a file are smoothed and thinned out to this; 0: none are"
    )
    speed: Span = Field((1.0, 1.0), description="[m/s] peak speed v of figure8, lemniscate and random, or its range")
    acceleration: Span = Field((0.5, 0.5), description="[m/s²] their peak acceleration a, or its range")
    radius: Span = Field((5.0, 5.0), description="[m] of circle and helix, or its range")
    rate: Span = Field((0.2, 0.2), description="[rad/s] of circle and helix, or its range")
    climb: Float = Field(0.5, ge=0, description="[m] that a helix goes up, and down, from its middle height")
    room: Vector = Field((3.0, 3.0, 0.5), description="[m] random way-points within ± this of the start")
    height: Float = Field(2.0, gt=0, description="[m] of the path's centre")
    start_radius: Float = Field(0.1, ge=0, description="[m] start within a ball of this radius about the path's start")
    success_distance: Float = Field(0.5, gt=0, description="[m] payload never farther than this from its target")
    rmse_from: Float = Field(5.0, ge=0, description="[s] errors count for payload_rmse_m from this time on")


class Track(Task):
    """Follow a path; see docs/track.md."""

    name: ClassVar[str] = "track"
    Options: ClassVar[type[Section]] = TrackOptions
    options: TrackOptions
    REWARD: ClassVar[dict[str, float]] = {
        "position": 0.4,
        "precision": 0.3,
        "attitude": 0.1,
        "velocity": 0.2,
        "heading": 0.0,
        "action_rate": -0.05,
    }
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("target_velocity", 3, "slot", "m/s", "velocity of the target"),
        Component("target_acceleration", 3, "slot", "m/s²", "acceleration of the target"),
        *(
            Component(
                f"target_ahead_{round(1000 * t)}ms", 3, "slot", "m", f"the way the target moves in the next {t:g} s"
            )
            for t in AHEAD
        ),
    )
    EXTRA_STATE: ClassVar[int] = 6 + 3 * len(AHEAD)
    SAVED: ClassVar[tuple[str, ...]] = ("worst", *(f"path.{name}" for name in Path._fields if name != "table"))

    def __init__(self, config: Config, world: World, reference: Reference):
        super().__init__(config, world, reference)
        self.seconds = config.env.episode_seconds
        self.rmse_after = self.options.rmse_from if self.options.rmse_from < self.seconds else 0.0
        file, spacing = self._file(), self.options.file_spacing
        table = load_path(file, spacing, world.system, config.randomization) if file else NO_FILE
        self.path, self.worst = Path.zeros(world.num_envs, table), np.zeros(world.num_envs)

    def _file(self) -> str:
        """Return the reference to the file that is flown, "" if none is; a ConfigError if the options disagree."""
        forms, file = self.options.path, self.options.file
        if "file" in forms and not file:
            raise ConfigError("task_options.path=file needs the path of one; set task_options.file=<path>")
        if file and "file" not in forms:
            raise ConfigError(
                f"task_options.file is given, but task_options.path={','.join(forms)} does not fly it; set "
                "task_options.path=file, or task_options.file=null"
            )
        return file or ""

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw heading, form and figures of the path; the team hangs at its start. See `Task.start`.

        The path of a file has its own heading and place.
        """
        option, path = self.options, self.path
        heading = rng.uniform(-pi, pi)
        form = option.path[rng.integers(len(option.path))] if len(option.path) > 1 else option.path[0]
        kind = PATHS.index(form)
        path.kind[env], path.heading[env], path.climb[env] = kind, heading, option.climb
        v, a = _draw(rng, option.speed), _draw(rng, option.acceleration)
        if kind in (CIRCLE, HELIX):
            path.size[env], path.rate[env] = _draw(rng, option.radius), _draw(rng, option.rate)
        elif kind == FIGURE8:  # peak speed A ω √2, peak acceleration with its factor at that size
            path.size[env], path.rate[env] = 1.0625 * v**2 / a, 0.6655 * a / v
        elif kind == LEMNISCATE:  # Bernoulli's: peak speed A ω and acceleration 3 A ω² at the ends
            path.size[env], path.rate[env] = 3 * v**2 / a, a / (3 * v)
        elif kind == RANDOM:
            path.curve[env] = draw_curve(rng, np.array(option.room))
            fastest, hardest = largest_rates(path.curve[env])
            path.rate[env] = min(v / fastest, sqrt(a / hardest))
        _start(env, rng, self.world.state, self.goal, self.rig, self.hanging, mass, path, option.height,
               option.start_radius)  # fmt: skip
        self.worst[env] = 0.0

    def planner(self, lo: int, hi: int) -> Callable[[], None]:
        """Move the goals along their paths; see `Task.planner`."""
        return bind(_plan, lo, hi, self.time, self.control_dt, self.path, self.goal, self.rig)

    def observe_extra(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None]:
        """Tell how the target will move; see `Task.observer`."""
        return bind(_look_ahead, lo, hi, self.time, self.path, self.goal, observation, critic)

    def target_path(self, env: int) -> np.ndarray:
        """Return the path, one round of it if it repeats; see `Task.route`."""
        points, kind = np.zeros((_DRAWN, 3)), self.path.kind[env]
        turns = 4 if kind == HELIX else 1
        if kind == FILE:
            lap = float(self.path.table[-1, 0])
        else:
            lap = np.inf if kind == RANDOM else turns * 2 * pi / self.path.rate[env] + RAMP / 2  # half the ramp is lost
        _trace(env, min(self.seconds, lap), self.path, points)
        return points

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Pay for closeness to the moving target; see `Task.scorer`."""
        return bind(
            _score, lo, hi, self.world.state, self.goal, self.errors, action, previous, self.weights, self.terms,
            self.worst,
        )  # fmt: skip

    def succeeded(self) -> np.ndarray:
        """Never too far from the target."""
        return self.worst <= self.options.success_distance


def _draw(rng: np.random.Generator, span: tuple[float, float]) -> float:
    """Return a number uniform in a range; one that is given is not drawn."""
    return span[0] if span[0] == span[1] else float(rng.uniform(*span))


@kernel
def _start(e, rng, state, goal, rig, hanging, mass, path, height, radius):
    put(path.centre[e], (0.0, 0.0, 0.0))
    begin = place(e, 0.0, path)
    put(path.centre[e], (-begin[0], -begin[1], height - begin[2]))  # every path but a file's starts above the origin
    putmat(goal.rotation[e], rot_z(path.heading[e]))
    goal.drone_yaw_rate[e] = 0.0  # the last episode may have been on a path of another form
    for turning in (goal.slot_velocity, goal.slot_acceleration, goal.slot_jerk):
        turning[e] = 0.0
    goal.angular_velocity[e] = 0.0
    _aim(e, 0.0, path, goal, rig)
    moved = in_ball(rng, radius)
    payload = add(row(goal.position, e), moved)
    hang_team(e, state, goal, rig, hanging, mass, payload, matrow(goal.rotation, e), row(goal.velocity, e), moved)


@kernel
def _aim(e, t, path, goal, rig):
    """Write the goal of environment e at a time."""
    set_goal(e, motion(e, t, path), goal)
    if path.kind[e] == FILE:
        _turn_target(e, t, path.table, goal, rig)
        return
    place_formation(e, goal, rig)
    if path.kind[e] == CIRCLE or path.kind[e] == HELIX:  # drones face along the path
        set_heading(e, path.heading[e] + path.rate[e] * own_time(t) + 0.5 * pi, goal, rig)
        goal.drone_yaw_rate[e] = path.rate[e] * (own_time(t + 1e-3) - own_time(t - 1e-3)) / 2e-3


@kernel
def _turn_target(e, t, table, goal, rig):
    """Write heading of the target of environment e by a file, and how its formation moves as it turns with it."""
    before, after = spline_yaw(table, t - STEP), spline_yaw(table, t + STEP)
    outer, last = spline_yaw(table, t - 2.0 * STEP), spline_yaw(table, t + 2.0 * STEP)
    yaw, rate, change, jerk = differences(outer, before, spline_yaw(table, t), after, last)
    w, dw, ddw = rate[0], change[0], jerk[0]
    putmat(goal.rotation[e], rot_z(yaw[0]))
    place_formation(e, goal, rig)
    put(goal.angular_velocity[e], (0.0, 0.0, w))
    goal.drone_yaw_rate[e] = w
    for n in range(rig.slots.shape[0]):  # derivatives of a level arm that turns about the vertical
        arm = sub(vec(goal.slots, e, n), row(goal.position, e))
        level, across = (arm[0], arm[1], 0.0), (-arm[1], arm[0], 0.0)
        put(goal.slot_velocity[e, n], scale(w, across))
        put(goal.slot_acceleration[e, n], sub(scale(dw, across), scale(w * w, level)))
        put(goal.slot_jerk[e, n], sub(scale(ddw - w**3, across), scale(3.0 * w * dw, level)))


@kernel
def _plan(lo, hi, time, dt, path, goal, rig):
    for e in range(lo, hi):
        time[e] += dt
        _aim(e, time[e], path, goal, rig)


@kernel
def _trace(e, seconds, path, points):
    for i in range(points.shape[0]):
        put(points[i], place(e, seconds * i / (points.shape[0] - 1), path))


@kernel
def _look_ahead(lo, hi, time, path, goal, observation, critic):
    many = 6 + 3 * len(AHEAD)
    for e in range(lo, hi):
        c, s = cos(goal.yaw[e]), -sin(goal.yaw[e])
        told = critic[e, critic.shape[1] - many :]
        _write_observation(e, c, s, time[e], path, goal, told)
        for n in range(observation.shape[1]):
            cn, sn = goal.slot_frame[e, n, 0], -goal.slot_frame[e, n, 1]
            own = observation[e, n, observation.shape[2] - many :]
            for k in range(0, many, 3):  # from the target's frame to the slot's
                cos_turn, sin_turn = cn * c + sn * s, sn * c - cn * s
                v = turn(cos_turn, sin_turn, (float(told[k]), float(told[k + 1]), float(told[k + 2])))
                own[k], own[k + 1], own[k + 2] = v


@kernel
def _write_observation(e, c, s, t, path, goal, out):
    """Write velocity, acceleration and places to come of a target, in its heading frame."""
    put(out[0:3], turn(c, s, row(goal.velocity, e)))
    put(out[3:6], turn(c, s, row(goal.acceleration, e)))
    for i in range(len(AHEAD)):
        put(out[6 + 3 * i : 9 + 3 * i], turn(c, s, sub(place(e, t + AHEAD[i], path), row(goal.position, e))))


@kernel
def _score(lo, hi, state, goal, errors, action, previous, weights, terms, worst):
    for e in range(lo, hi):
        distance, angle = errors.distance[e], errors.angle[e]
        slip = norm(sub(row(state.payload_velocity, e), row(goal.velocity, e)))
        terms[e, 0] = weights[0] * tolerance(distance, 0.25)
        terms[e, 1] = weights[1] * tolerance(distance, 0.02)
        terms[e, 2] = weights[2] * tolerance(angle, radians(6.0))
        terms[e, 3] = weights[3] * tolerance(slip, 0.2)
        terms[e, 4] = weights[4] * tolerance(errors.rotation[e, 2], radians(0.5))
        terms[e, 5] = weights[5] * action_rate(e, action, previous)
        worst[e] = max(worst[e], distance)
