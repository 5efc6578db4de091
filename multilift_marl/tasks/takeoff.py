"""Takeoff: drones and payload start on the ground; drones rise, cables become taut, the payload is lifted."""

from __future__ import annotations

from math import radians
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.formation import place_formation
from multilift_marl.kernels.jit import drawing, inlined
from multilift_marl.math3d import add, clip, ease, matrow, put, putmat, rot_z, row, scale, sub, vec
from multilift_marl.mdp.criteria import Criterion, rest_criteria
from multilift_marl.mdp.failures import BELOW, CABLE, GROUND, LOAD_GROUND, ignore, payload_height
from multilift_marl.mdp.ground import (
    CARRIED,
    CREEP,
    Ground,
    Margin,
    Origin,
    Pace,
    cable_chord,
    cable_rise,
    keep_hook,
    make_ground,
    margin_ratio,
    move_goal,
    pace_of,
    paced,
    place_on_ground,
    pull_fraction,
    readiness,
    resting_distance,
    scale_cable_force,
    set_resting_goal,
)
from multilift_marl.mdp.initial_states import check_target_height
from multilift_marl.mdp.observations import Component
from multilift_marl.mdp.rewards import RestBounds, Term, action_rate, is_at_rest
from multilift_marl.schema.values import Float, Section
from multilift_marl.tasks.base import Kernels, Task
from multilift_marl.tasks.target_checks import check_way, warn_of_time

RISE = (0.1, 1.6)  # begin and length of each phase [s], as of the next ones: drones rise,
TIGHTEN = (1.7, 1.2)  # cables become taut,
PULL = (2.9, 1.2)  # drones pull,
LIFT = (4.1, 2.5)  # the target rises, and stays
SLACK = 0.006  # of a cable's length, short of taut after the rise
TAUT = 0.002  # of a cable's length, beyond taut before the pull
RESTING, FLYING, LIFTED = range(3)
IGNORED = (ignore(GROUND, LOAD_GROUND, BELOW, CABLE), ignore(LOAD_GROUND, CABLE), 0)
_HALF_WAY = 0.5  # of the formation's height: every drone that far above its anchor, and the team counts as flying
_LIFTED = 0.02  # [m] of the payload's lowest point above the ground, for the span of a falcon
HARMLESS = 1.5  # times the resting tension that costs nothing


class TakeoffOptions(Section):
    """Ranges of the start and bounds of success."""

    origin: Origin = (0.0, 0.0)
    place_xy: Float = Field(1.0, ge=0, description="[m] payload's x and y within ± this")
    target_yaw: Float = Field(45.0, ge=0, le=180, description="[deg] heading of payload and target within ± this")
    target_height: Float = Field(1.5, gt=0, description="[m] of the payload at the end")
    start_spread: Float = Field(0.1, ge=0, description="[-] drones' places about their slots', in lengths of a cable")
    success_distance: Float = Field(0.05, gt=0, description="[m] payload within this of its final target ...")
    success_angle: Float = Field(5.0, gt=0, description="[deg] ... and within this of its attitude ...")
    success_seconds: Float = Field(2.0, gt=0, description="[s] ... throughout the last seconds")
    success_tension: Float = Field(2.0, gt=1, description="[-] largest tension at any time, over the resting tension")
    pace: Pace = 1.0
    margin: Margin = 0.0


class TakeoffArrays(NamedTuple):
    """What an episode holds beside its goal."""

    place: np.ndarray
    """(E, 3) of the payload on the ground [m]."""
    drone_place: np.ndarray
    """(E, N, 3) of the drones on the ground [m]."""
    stage: np.ndarray
    """(E,) int64, RESTING, FLYING or LIFTED."""
    pull_fraction: np.ndarray
    """(E,) of the nominal cable forces that is fed forward [-]."""
    peak: np.ndarray
    """(E,) largest tension in the policy step, over that at rest [-]."""


class TakeoffSettings(NamedTuple):
    """Constants of the task."""

    ground: Ground
    origin: tuple[float, float]
    """About which payloads are placed [m]."""
    bounds: RestBounds
    climb: float
    """Of the target [m]."""
    rise: tuple[float, float]
    """Begin and length [s], as of the next ones."""
    tighten: tuple[float, float]
    pull: tuple[float, float]
    lift: tuple[float, float]
    margin: np.ndarray
    """(N,) of each cable's length, beside `SLACK` and `TAUT` [-]."""


@drawing
def start_on_ground(e, rng, v, ranges, distance):
    """Write goal and team at rest on the ground; ranges are x and y [m], heading [rad] and spread of drones [m]."""
    goal, (xy, yaw, spread), ground, (x, y) = v.goal, ranges, v.settings.ground, v.settings.origin
    set_resting_goal(e, goal, (x + rng.uniform(-xy, xy), y + rng.uniform(-xy, xy), ground.payload))
    putmat(goal.rotation[e], rot_z(rng.uniform(-yaw, yaw)))
    place_formation(e, goal, v.rig)
    place_on_ground(e, rng, v, ground, distance, spread)


@inlined
def advance(e, v):
    """Move the goal on, and find out who has left the ground."""
    goal, rig, own, t, plan = v.goal, v.rig, v.own, v.time[e], v.settings
    set_resting_goal(e, goal, row(own.place, e))
    move_goal(e, goal, (0.0, 0.0, plan.climb), ease(t, plan.lift[0], plan.lift[1]))
    place_formation(e, goal, rig)
    risen, tight = ease(t, plan.rise[0], plan.rise[1]), ease(t, plan.tighten[0], plan.tighten[1])
    pulled = ease(t, plan.pull[0], plan.pull[1])
    # From -1 to 1 at a constant rate: wherever in the margin a cable becomes taut, it does so slowly.
    crept = clip(2.0 * (t - plan.tighten[0]) / plan.tighten[1] - 1.0, -1.0, 1.0)
    own.pull_fraction[e] = pulled[0]
    for n in range(rig.slots.shape[0]):
        # along the cable: short of taut, a little beyond, then where the force puts the slot
        chord = cable_chord(e, n, goal, rig)
        keep_hook(e, n, v, pulled[0], plan.ground.cable_weight)
        reach = -SLACK + (SLACK + TAUT) * tight[0] - TAUT * pulled[0] + plan.margin[n] * (crept - pulled[0])
        slot = add(vec(goal.slots, e, n), scale(reach, chord))
        # from its place on the ground: up first, inward faster and faster
        under = sub(vec(own.drone_place, e, n), add(vec(goal.slots, e, n), scale(-SLACK - plan.margin[n], chord)))
        put(goal.slots[e, n], add(slot, _stretched(under, 1.0 - risen[0] ** 2, 1.0 - risen[0])))
        # Derivatives of 1 - s² and 1 - s: of the way from the ground alone. What tightening the cable adds is not fed
        # forward.
        put(goal.slot_velocity[e, n], _stretched(under, -2.0 * risen[0] * risen[1], -risen[1]))
        curved = risen[1] ** 2 + risen[0] * risen[2]
        put(goal.slot_acceleration[e, n], _stretched(under, -2.0 * curved, -risen[2]))
        scale_cable_force(e, n, v, pulled[0], plan.ground.cable_weight)
        own.peak[e] = max(own.peak[e], v.state.cable_tension[e, n] / v.resting_tension[n])
    own.stage[e] = _stage(e, v)
    v.mask.ignored[e] = IGNORED[own.stage[e]]


@inlined
def _stretched(vector, level, up):
    """Return a vector, its level part and its height scaled."""
    return (level * vector[0], level * vector[1], up * vector[2])


@inlined
def _stage(e, v):
    """Return how far off the ground a team is."""
    state, rig, stage = v.state, v.rig, v.own.stage[e]
    payload, attitude = row(state.payload_position, e), matrow(state.payload_rotation, e)
    if stage == RESTING:
        for n in range(rig.slots.shape[0]):
            if cable_rise(e, n, state, rig) < _HALF_WAY * (rig.slots[n, 2] - rig.anchors[n, 2]):
                return RESTING
        return FLYING
    if stage == FLYING and payload_height(payload, attitude, v.limits) > _LIFTED * v.settings.ground.size:
        return LIFTED
    return stage


@inlined
def is_lifted(e, v):
    """Payload at its final target."""
    return v.time[e] >= v.settings.lift[0] + v.settings.lift[1] and is_at_rest(e, v, v.settings.bounds)


@inlined
def snatch(e, v):
    """Largest tension of the step beyond what is harmless, at most 1."""
    return clip(v.own.peak[e] - HARMLESS, 0.0, 1.0)


@inlined
def forget_peak(e, v):
    """Let the next step have a peak of its own."""
    v.own.peak[e] = 0.0


@inlined
def time_to_lift(e, n, v):
    """Time until the target leaves the ground."""
    return max(v.settings.lift[0] - v.time[e], -4.0)


@inlined
def climb_rate(e, n, v):
    """Vertical velocity of the target."""
    return v.goal.velocity[e, 2]


class Takeoff(Task):
    """Lift off and hold; see docs/takeoff.md."""

    name: ClassVar[str] = "takeoff"
    Options: ClassVar[type[Section]] = TakeoffOptions
    options: TakeoffOptions
    own: TakeoffArrays
    settings: TakeoffSettings
    REWARD: ClassVar[dict[str, Term]] = {
        **CARRIED,
        "ready": Term(1.0, readiness, 0.1, "m"),
        "snatch": Term(-0.5, snatch),
        "action_rate": Term(-0.05, action_rate),
    }
    CAN_PLAN: ClassVar[bool] = False
    KERNELS: ClassVar[Kernels] = Kernels(is_good=is_lifted, plan=advance, update=forget_peak)
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component(
            "time_to_lift", 1, "-", "s", "until the target leaves the ground; negative afterwards, at least -4",
            time_to_lift,
        ),
        Component("pull_share", 1, "-", "-", "share of the nominal cable force that is fed forward", pull_fraction),
        Component("climb_rate", 1, "world", "m/s", "vertical velocity of the target", climb_rate),
    )  # fmt: skip
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = EXTRA

    def count_limits(self) -> dict[str, tuple[int, int]]:
        """Bound what kernels index by, see `Task`."""
        return {"stage": (RESTING, LIFTED)}

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, system, e, n = self.options, self.world.system, self.world.num_envs, self.world.num_drones
        pace = pace_of(option.pace, system)
        ground = make_ground(system)
        self._spread = option.start_spread * float(system.cable_length.min())
        self._distance = resting_distance(system, self._spread)
        creeping = 2 * option.margin / CREEP
        self.own = TakeoffArrays(np.zeros((e, 3)), np.zeros((e, n, 3)), np.zeros(e, np.int64), np.zeros(e), np.zeros(e))
        self.settings = TakeoffSettings(
            ground=ground,
            origin=option.origin,
            bounds=RestBounds.of(option),
            climb=option.target_height - ground.payload,
            rise=paced(RISE, pace),
            tighten=paced(TIGHTEN, pace, longer=creeping),
            pull=paced(PULL, pace, later=creeping),
            lift=paced(LIFT, pace, later=creeping),
            margin=margin_ratio(option.margin, system),
        )
        target = f"task_options.target_height={option.target_height:g} m"
        check_target_height(target, option.target_height, system)
        check_way(target, "lower it", (0.0, 0.0, self.settings.climb), self.settings.lift[1], system)
        end = sum(self.settings.lift) + option.success_seconds
        if end > sum(LIFT) + TakeoffOptions().success_seconds:  # else the usual plan, cut on purpose
            warn_of_time(f"by its plan, task {self.name} can succeed from", end, self.config.env.episode_seconds)

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw where the payload and the drones are on the ground; see `Task.start`."""
        ranges = self.options.place_xy, radians(self.options.target_yaw), self._spread
        start_on_ground(env, rng, self.view_for(start_on_ground), ranges, self._distance)
        own = self.own
        own.place[env], own.drone_place[env] = self.goal.position[env], self.world.state.drone_position[env]
        own.stage[env], own.pull_fraction[env], own.peak[env] = RESTING, 0.0, 0.0
        self.mask.ignored[env] = IGNORED[RESTING]
        self.time[env] = 0.0
        advance(env, self.view_for(advance))

    def succeeded(self) -> np.ndarray:
        """At the final target throughout the last seconds, and never too large a tension."""
        gentle = self.world.stats.tension_max <= self.options.success_tension * self._resting_tension()
        return gentle & super().succeeded()

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        bound, stats, lifted = self.options.success_tension, self.world.stats, self.KERNELS.is_good is is_lifted
        found = rest_criteria(self.settings.bounds, self.errors, self.world.state) if lifted else ()
        tension = Criterion("tension", bound, lambda: stats.tension_max / self._resting_tension() - bound, False)
        return (*found, tension)

    def _resting_tension(self) -> np.ndarray:
        """Return the largest tension at rest with the true payload (E,) [N]."""
        load = self.world.hidden_loads.payload_mass / self.world.system.payload_mass
        return np.asarray(self.view.resting_tension.max() * load)
