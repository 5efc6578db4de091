"""Recover: from slack cables, tilted drones and speed to a payload that hangs at its target."""

from __future__ import annotations

from math import atan2, cos, pi, radians, sin
from typing import ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.formation import place_formation
from multilift_marl.kernels.jit import drawing, inlined, kernel
from multilift_marl.math3d import (
    add,
    axis_angle,
    clip,
    matmul,
    matrow,
    mul,
    norm,
    put,
    putmat,
    rot_z,
    row,
    scale,
    sub,
    unit,
    vec,
)
from multilift_marl.mdp.criteria import Criterion, tension_criterion
from multilift_marl.mdp.failures import BELOW, CABLE, GROUND, LOAD_GROUND, TILT, ignore
from multilift_marl.mdp.initial_states import TargetOptions, in_ball
from multilift_marl.mdp.observations import Component, cable_vector
from multilift_marl.mdp.rewards import (
    RestBounds,
    Term,
    action_rate,
    attitude,
    distance,
    failure,
    snatch,
    stillness,
    update_peak_tension,
)
from multilift_marl.physical import GRAVITY
from multilift_marl.schema.values import Float, Section
from multilift_marl.sim.state import place_at_hook
from multilift_marl.tasks.base import Kernels, Task


class RecoverOptions(TargetOptions):
    """How harsh the start is, and what counts as success."""

    start: Literal["slack", "crazymarl"] = Field("slack", description="how teams are thrown; see docs/recover.md")
    start_radius: Float = Field(0.5, ge=0, description="[m] slack: payload within a ball of this radius of the target")
    start_tilt: Float = Field(90.0, ge=0, le=90, description="[deg] slack: largest tilt of drones; of payloads, half")
    start_speed: Float = Field(1.0, ge=0, description="[m/s] slack: largest speed of each body")
    start_slack: Float = Field(0.6, gt=0, le=1, description="[-] slack: shortest distance of a hook over cable length")
    grace: Float = Field(2.0, ge=0, description="[s] in which tilt and cable angle are no failure")
    success_distance: Float = Field(0.01, gt=0, description="[m] payload closer than this to its target ...")
    success_seconds: Float = Field(0.5, gt=0, description="[s] ... throughout the last seconds, and ...")
    success_tension: Float | None = Field(
        None, gt=1,
        description="[-] no cable's tension at any time, mean of a physics step, over its resting tension; None: any",
    )  # fmt: skip

    @property
    def tension(self) -> float:
        """`success_tension`, infinite where any will do."""
        return np.inf if self.success_tension is None else self.success_tension


class SlackStart(NamedTuple):
    """Ranges of the start `slack`, in SI units."""

    radius: float
    tilt: float
    speed: float
    slack: float
    taut: float


@kernel
def _tilted(rng, angle, yaw):
    """Return an attitude, 9 numbers, tilted by up to `angle` about a random horizontal axis at heading `yaw`."""
    azimuth = rng.uniform(-pi, pi)
    return matmul(axis_angle((cos(azimuth), sin(azimuth), 0.0), rng.uniform(0.0, angle)), rot_z(yaw))


@drawing
def _throw(e, rng, state, goal, rig, throw):
    """Write a team whose cables hang slack, each drone somewhere near its slot's direction."""
    payload = add(row(goal.position, e), in_ball(rng, throw.radius))
    attitude = matrow(goal.rotation, e) if rig.is_point else _tilted(rng, 0.5 * throw.tilt, goal.yaw[e])
    put(state.payload_position[e], payload)
    put(state.payload_velocity[e], in_ball(rng, throw.speed))
    putmat(state.payload_rotation[e], attitude)
    for n in range(rig.anchors.shape[0]):
        anchor = mul(attitude, (rig.anchors[n, 0], rig.anchors[n, 1], rig.anchors[n, 2]))
        at_rest = add(row(goal.position, e), mul(matrow(goal.rotation, e), row(rig.anchors, n)))
        towards = unit(sub(vec(goal.slots, e, n), at_rest))
        # asin 0.5 = 30°.
        towards = unit(add(towards, in_ball(rng, 0.5)))  # within 30° of the slot's
        span = rig.cable_length[n] * rng.uniform(throw.slack, throw.taut)
        put(state.drone_velocity[e, n], in_ball(rng, throw.speed))
        putmat(state.drone_rotation[e, n], _tilted(rng, throw.tilt, goal.drone_yaw[e] + rig.heading[n]))
        place_at_hook(e, n, state, add(add(payload, anchor), scale(span, towards)), rig.hooks)
        state.drone_body_rates[e, n] = 0.0


@drawing
def _throw_as_crazymarl(e, rng, state, goal, rig):
    """Write a team as CrazyMARL's sampler draws it (viktorlorentz/crazyMARL, crazymarl/utils/multi_quad_sampling.py,
    commit 8723b9a, and the reset of crazymarl/envs/multi_quad_env.py, commit 02d5761).

    Load: x, y in ± 1.5 m, z uniform in -1 to 3 m, clipped to the ground; drones: distance normal (L, L/3) clipped to
    0.05 m and L, polar angle normal (45°, 22.5°), azimuths evenly spaced plus normal (π/(N+1)), never below the ground,
    19 cm apart and 3 cm from the load; velocities normal, 0.2 m/s and 20°/s; roll and pitch normal (10°), any heading.
    """
    count = state.drone_position.shape[1]
    # Theirs: min_pz, min_qz. It draws a few teams more than needed and takes the first that are apart, or one that is
    # not where none is; here a team is drawn until it is.
    low_load, low_drone = 0.0055, 0.008
    apart = False
    while not apart:
        z = clip(rng.uniform(-1.0, 3.0), low_load, 3.0)
        payload = (rng.uniform(-1.5, 1.5), rng.uniform(-1.5, 1.5), z)
        turned, apart = rng.uniform(-pi, pi), True
        for n in range(count):
            span = clip(rng.normal(rig.cable_length[n], rig.cable_length[n] / 3.0), 0.05, rig.cable_length[n])
            polar = rng.normal(0.25 * pi, 0.125 * pi)
            azimuth = turned + 2.0 * pi * n / count + rng.normal(0.0, pi / (count + 1))
            flat = span * sin(polar)
            # Clipped after the distance is drawn: cables of drones near the ground are slacker than that.
            height = clip(payload[2] + span * cos(polar), low_drone, 3.0)
            put(
                state.drone_position[e, n], (payload[0] + flat * cos(azimuth), payload[1] + flat * sin(azimuth), height)
            )
            apart = apart and norm(sub(vec(state.drone_position, e, n), payload)) >= 0.03
            for m in range(n):
                apart = apart and norm(sub(vec(state.drone_position, e, n), vec(state.drone_position, e, m))) >= 0.19
    put(state.payload_position[e], payload)
    state.payload_velocity[e] = 0.0
    putmat(state.payload_rotation[e], matrow(goal.rotation, e))
    for n in range(count):
        tilt, limit = radians(10.0), radians(60.0)
        roll, pitch = clip(rng.normal(0.0, tilt), -limit, limit), clip(rng.normal(0.0, tilt), -limit, limit)
        # Those that stand on the ground stand level.
        if state.drone_position[e, n, 2] < 0.02:
            roll, pitch = 0.0, 0.0
        # Rz(yaw) Ry(pitch) Rx(roll), as their quaternion has it.
        level = matmul(axis_angle((0.0, 1.0, 0.0), pitch), axis_angle((1.0, 0.0, 0.0), roll))
        putmat(state.drone_rotation[e, n], matmul(rot_z(rng.uniform(-pi, pi)), level))
        place_at_hook(e, n, state, vec(state.drone_position, e, n), rig.hooks)
        for k in range(3):
            # Theirs draws all of these by one key: velocities are the same for all drones, and rates in proportion to
            # them. Here all are independent.
            state.drone_velocity[e, n, k] = rng.normal(0.0, 0.2)
            state.drone_body_rates[e, n, k] = rng.normal(0.0, radians(20.0))


@kernel
def _turn_formation(e, state, goal, rig):
    """Turn the formation about a point load, which has no heading to hold, to where the drones are."""
    c, s = 0.0, 0.0
    for n in range(rig.slots.shape[0]):
        away = sub(vec(state.drone_position, e, n), row(state.payload_position, e))
        # The mean of angles by their sines and cosines: their plain mean fails across ±180°.
        turned = atan2(away[1], away[0]) - rig.azimuth[n]
        c, s = c + cos(turned), s + sin(turned)
    putmat(goal.rotation[e], rot_z(atan2(s, c)))
    putmat(state.payload_rotation[e], matrow(goal.rotation, e))
    place_formation(e, goal, rig)


class RecoverArrays(NamedTuple):
    """What an episode holds beside its goal."""

    peak_tension: np.ndarray
    """(E,) largest tension in the episode over that at rest [-]."""
    counted_tension: np.ndarray
    """(E,) the same, as the reward has counted it [-]."""


class RecoverSettings(NamedTuple):
    """Constants of the task."""

    grace: float
    """[s] in which tilt and cable angle are no failure."""
    bounds: RestBounds
    tension: float
    """Largest tension of a success over that at rest [-]."""


@inlined
def end_grace(e, v):
    """Let all failures count once the grace is over; note the largest tension; the goals stay."""
    update_peak_tension(e, v, v.own.peak_tension)
    if v.time[e] > v.settings.grace:
        v.mask.ignored[e] = 0


@inlined
def end_step(e, v):
    """Let the next step count what tension it adds."""
    v.own.counted_tension[e] = v.own.peak_tension[e]


@inlined
def grace(e, n, v):
    """Share of the grace that is left."""
    return clip(1.0 - v.time[e] / max(v.settings.grace, 1e-9), 0.0, 1.0)


@inlined
def slack(e, n, v):
    """Own cable's natural length minus the distance it spans, over the length."""
    return 1.0 - norm(cable_vector(e, n, v)) / v.rig.cable_length[n]


class Recover(Task):
    """Recover from a harsh start; see docs/recover.md."""

    name: ClassVar[str] = "recover"
    Options: ClassVar[type[Section]] = RecoverOptions
    options: RecoverOptions
    own: RecoverArrays
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.4, distance, 0.25, "m"),
        "precision": Term(0.25, distance, 0.01, "m"),
        "attitude": Term(0.15, attitude, 6.0, "deg"),
        "stillness": Term(0.2, stillness, (0.2, 0.3), "m/s, rad/s"),
        "failure": Term(0.0, failure),
        "snatch": Term(0.0, snatch),
        "action_rate": Term(-0.05, action_rate),
    }
    CAN_PLAN: ClassVar[bool] = False
    KERNELS: ClassVar[Kernels] = Kernels(plan=end_grace, update=end_step)
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("grace", 1, "-", "-", "share of the time left in which tilt and cable angle are no failure", grace),
        Component(
            "slack", 1, "-", "-", "own cable's natural length minus the distance it spans, over the length", slack
        ),
    )
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = (EXTRA[0],)

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option = self.options
        taut = self.world.cable_model.SLACK
        self._slack = min(option.start_slack, taut), taut
        self._early = ignore(TILT, CABLE)
        if option.start == "crazymarl":  # a quarter of its teams start on the ground
            self._early = ignore(TILT, CABLE, BELOW, GROUND, LOAD_GROUND)
        self.own = RecoverArrays(np.zeros(self.world.num_envs), np.zeros(self.world.num_envs))
        self.settings = RecoverSettings(option.grace, RestBounds(option.success_distance), option.tension)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw target and team; see `Task.start`."""
        option, goal, state = self.options, self.goal, self.world.state
        flat = rng.uniform(-option.target_xy, option.target_xy, 2)
        goal.position[env] = *flat, rng.uniform(*option.target_height)
        putmat(goal.rotation[env], rot_z(radians(rng.uniform(-option.target_yaw, option.target_yaw))))
        place_formation(env, goal, self.rig)
        self.mask.ignored[env] = self._early
        self.own.peak_tension[env] = self.own.counted_tension[env] = 0.0
        throw = SlackStart(option.start_radius, radians(option.start_tilt), option.start_speed, *self._slack)
        if option.start == "slack":
            _throw(env, rng, state, goal, self.equilibrium, throw)
        else:
            _throw_as_crazymarl(env, rng, state, goal, self.equilibrium)
        if not self.rig.anchors.any():
            _turn_formation(env, state, goal, self.rig)
        rig = self.equilibrium
        carried = rig.mass + mass / self.world.num_drones
        each = (carried * GRAVITY / 4 / rig.thrust_coefficient)[:, None]
        state.rotor_speed[env] = np.sqrt(each / rig.rotor_strength)
        state.payload_body_rates[env] = 0.0

    def succeeded(self) -> np.ndarray:
        """At the target throughout the last seconds, and never too large a tension."""
        return super().succeeded() & (self.own.peak_tension <= self.options.tension)

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        bound, others = self.options.tension, super().criteria()
        return others if bound == np.inf else (*others, tension_criterion(self.own.peak_tension, bound))
