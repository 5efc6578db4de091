"""Gate: the team carries its payload through a gap that is narrower than its formation."""

from __future__ import annotations

from collections.abc import Callable
from math import pi, radians
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl._jit import bind, kernel
from multilift_marl.config.config import Config
from multilift_marl.config.values import Float, Int, Section
from multilift_marl.control.formation import Reference, place_formation
from multilift_marl.math3d import add, ease, mat, matrow, mul, norm, put, putmat, rot_z, row, sub, triple, turn, vec
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.state import hook_position
from multilift_marl.sim.world import World
from multilift_marl.tasks.base import Box, Task
from multilift_marl.tasks.failures import WALL
from multilift_marl.tasks.observations import Component
from multilift_marl.tasks.paths import STEP, differences, set_goal
from multilift_marl.tasks.rewards import RestBounds, action_rate, is_at_rest, tolerance, update_peak_tension
from multilift_marl.tasks.starts import hang_team, in_ball

THICKNESS = 0.1  # [m] of the walls
PASSED = 0.8  # [m] that a payload is past a wall when its last drone is, too
_WALL = (0.62, 0.52, 0.45, 1.0)  # colour


class GateOptions(Section):
    """The gates, the way through them, and what counts as success."""

    gates: Int = Field(1, ge=1, le=2, description="walls with a gap: one at x = 0, or two at x = -0.75 and 0.75 m")
    gap_width: Float = Field(1.0, gt=0, description="[m]")
    gap_height: Float = Field(3.0, gt=0, description="[m] from the ground")
    gap_offset: Float = Field(0.3, ge=0, description="[m] gap's middle within ± this of the line from start to goal")
    height: Float = Field(1.3, gt=0, description="[m] of start and goal")
    start_radius: Float = Field(0.2, ge=0, description="[m] start within a ball of this radius about x = -2 m")
    set_off: Float = Field(1.0, ge=0, description="[s] when the target sets off ...")
    arrival: Float = Field(11.0, gt=0, description="[s] ... and when it arrives at x = 2 m")
    success_distance: Float = Field(0.10, gt=0, description="[m] payload within this of the goal ...")
    success_angle: Float = Field(10.0, gt=0, description="[deg] ... and of its attitude, heading included ...")
    success_speed: Float = Field(0.1, gt=0, description="[m/s] ... no faster than this ...")
    success_body_rate: Float = Field(0.2, gt=0, description="[rad/s] ... and turning no faster than this ...")
    success_seconds: Float = Field(1.0, gt=0, description="[s] ... throughout the last seconds, and ...")
    success_tension: Float = Field(
        3.0, gt=1, description="[-] no cable's tension at any time, mean of a physics step, over its resting tension"
    )


class Gates(NamedTuple):
    """The walls of each environment and the way through their gaps."""

    x: np.ndarray
    """(G,) of the walls [m]."""
    y: np.ndarray
    """(E, G) of the gaps' middles [m]."""
    half_width: float
    """Of the gaps [m]."""
    gap_height: float
    """[m]."""
    start: float
    """When the target sets off [s]."""
    duration: float
    """How long it flies [s]."""
    level: float
    """Its height [m]."""


class Bodies(NamedTuple):
    """What must not touch a wall."""

    drone: np.ndarray
    """(N, 3) half edges of the drones [m]."""
    payload: np.ndarray
    """(3,) half edges [m]."""
    centre: tuple[float, float, float]
    """Geometric centre of the payload from its centre of mass, in its frame [m]."""
    anchors: np.ndarray
    """(N, 3) [m]."""
    hooks: np.ndarray
    """(N, 3) [m]."""


class Gate(Task):
    """Fly through gaps; see docs/gate.md."""

    name: ClassVar[str] = "gate"
    Options: ClassVar[type[Section]] = GateOptions
    options: GateOptions
    REWARD: ClassVar[dict[str, float]] = {
        "position": 0.4,
        "precision": 0.2,
        "clearance": 0.8,
        "velocity": 0.2,
        "attitude": 0.2,
        "stillness": 0.1,
        "action_rate": -0.05,
    }
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("target_velocity", 2, "slot", "m/s", "horizontal velocity of the target"),
        Component("gap", 2, "slot", "m", "own position minus the middle of the next gap, from above"),
        Component("clearance", 1, "-", "m", "own room to the next wall's edges, within ± 0.5"),
    )
    EXTRA_STATE: ClassVar[int] = 6
    SAVED: ClassVar[tuple[str, ...]] = ("gap_y", "peak_tension")

    def __init__(self, config: Config, world: World, reference: Reference):
        super().__init__(config, world, reference)
        option, system = self.options, world.system
        x = np.array([0.0] if option.gates == 1 else [-0.75, 0.75])
        self.gap_y, self.peak_tension = np.zeros((world.num_envs, len(x))), np.zeros(world.num_envs)
        self.gates = Gates(
            x, self.gap_y, option.gap_width / 2, option.gap_height, option.set_off,
            option.arrival - option.set_off, option.height,
        )  # fmt: skip
        self.bodies = Bodies(
            np.array([drone_half_size(vehicle) for vehicle in system.vehicles]), system.payload_size / 2,
            triple(system.payload_center), np.ascontiguousarray(system.anchors),
            np.ascontiguousarray(system.hooks),
        )  # fmt: skip

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw the gaps and where the team starts; see `Task.start`."""
        option = self.options
        self.peak_tension[env] = 0.0
        self.gap_y[env] = rng.uniform(-option.gap_offset, option.gap_offset, option.gates)
        _start(env, rng, self.world.state, self.goal, self.rig, self.hanging, mass, self.gates, option.start_radius)

    def planner(self, lo: int, hi: int) -> Callable[[], None]:
        """Move the goals through the gaps; see `Task.planner`."""
        tensions = (self.world.state, self.watch, self.world.system.resting_tension, self.peak_tension)
        return bind(_plan, lo, hi, self.time, self.control_dt, self.gates, self.goal, self.rig, tensions)

    def observe_extra(self, lo: int, hi: int, observation: np.ndarray, critic: np.ndarray) -> Callable[[], None]:
        """Tell where the next gap is; see `Task.observer`."""
        state = self.world.state
        return bind(
            _write_observation, lo, hi, state, self.seen, self.goal, self.gates, self.bodies, observation, critic
        )

    def reward(self, lo: int, hi: int, action: np.ndarray, previous: np.ndarray) -> Callable[[], None]:
        """Pay for closeness to the moving target and for room; a touched wall is a failure. See `Task.scorer`."""
        option = self.options
        bounds = RestBounds(
            option.success_distance, radians(option.success_angle), option.success_speed, option.success_body_rate
        )
        return bind(
            _score, lo, hi, self.time, self.world.state, self.goal, self.errors, self.gates, self.bodies, action,
            previous, self.weights, bounds, option.arrival, self.dt, self.terms, self.good_time, self.cause,
        )  # fmt: skip

    def succeeded(self) -> np.ndarray:
        """At rest at the goal throughout the last moments, and never too large a tension."""
        rested = self.good_time >= self.options.success_seconds - 1e-9
        return rested & (self.peak_tension <= self.options.success_tension)

    def target_path(self, env: int) -> np.ndarray:
        """Return points of the way through the gaps; see `Task.route`."""
        return np.array([_place(env, t, self.gates) for t in np.linspace(0, self.options.arrival, 61)])

    def scenery(self, env: int) -> list[Box]:
        """Return the walls; see `Task.scenery`."""
        half, gap, top = 2.5, self.gates.half_width, self.gates.gap_height
        boxes = []
        for x, y in zip(self.gates.x, self.gap_y[env], strict=True):
            for side in (-1, 1):
                boxes.append(Box((THICKNESS / 2, half / 2, top / 2), (x, y + side * (gap + half / 2), top / 2), _WALL))
            boxes.append(Box((THICKNESS / 2, half + gap, 0.25), (x, y, top + 0.25), _WALL))
        return boxes


@kernel
def _place(e, t, gates):
    """Return where the target of environment e is at a time: straight through every gap, from x = -2 to 2 m."""
    x = -2.0 + 4.0 * ease(t, gates.start, gates.duration)[0]
    y, before, last = 0.0, -2.0, 0.0
    for g in range(gates.x.shape[0]):
        y += (gates.y[e, g] - last) * ease(x, before, gates.x[g] - 0.25 - before)[0]
        before, last = gates.x[g] + 0.25, gates.y[e, g]
    y -= last * ease(x, before, 2.0 - before)[0]
    return (x, y, gates.level)


@kernel
def _aim(e, t, gates, goal, rig):
    a, b, c = _place(e, t - 2.0 * STEP, gates), _place(e, t - STEP, gates), _place(e, t, gates)
    set_goal(e, differences(a, b, c, _place(e, t + STEP, gates), _place(e, t + 2.0 * STEP, gates)), goal)
    place_formation(e, goal, rig)


@kernel
def _start(e, rng, state, goal, rig, hanging, mass, gates, radius):
    putmat(goal.rotation[e], rot_z(0.5 * pi))  # the long side of the formation across the way
    _aim(e, 0.0, gates, goal, rig)
    moved = in_ball(rng, radius)
    payload = add(row(goal.position, e), moved)
    hang_team(e, state, goal, rig, hanging, mass, payload, matrow(goal.rotation, e), (0.0, 0.0, 0.0), moved)


@kernel
def _plan(lo, hi, time, dt, gates, goal, rig, tensions):
    state, watch, resting, peak = tensions
    for e in range(lo, hi):
        update_peak_tension(e, state, watch, resting, peak)
        time[e] += dt
        _aim(e, time[e], gates, goal, rig)


@kernel
def _next(e, x, gates):
    """Return the gate that a payload at x has before it, the last one after all."""
    for g in range(gates.x.shape[0]):
        if x < gates.x[g] + PASSED:
            return g
    return gates.x.shape[0] - 1


@kernel
def _reach(frame, half, axis):
    """Return how far a box of `half` edges reaches along a world axis [m]."""
    return abs(frame[3 * axis]) * half[0] + abs(frame[3 * axis + 1]) * half[1] + abs(frame[3 * axis + 2]) * half[2]


@kernel
def _room(e, g, centre, frame, half, gates):
    """Return the room [m] of a box to the edges of gap g if it is in the wall, else 1."""
    if abs(centre[0] - gates.x[g]) > 0.5 * THICKNESS + _reach(frame, half, 0):
        return 1.0
    side = gates.half_width - abs(centre[1] - gates.y[e, g]) - _reach(frame, half, 1)
    return min(side, gates.gap_height - centre[2] - _reach(frame, half, 2))


@kernel
def _cable_room(e, g, low, high, gates):
    """Return the same of a straight cable."""
    begin, end = gates.x[g] - 0.5 * THICKNESS, gates.x[g] + 0.5 * THICKNESS
    if max(low[0], high[0]) < begin or min(low[0], high[0]) > end:
        return 1.0
    room, span = 1.0, high[0] - low[0]
    for side in (begin, end):
        share = 0.0 if abs(span) < 1e-9 else min(max((side - low[0]) / span, 0.0), 1.0)
        y, z = low[1] + share * (high[1] - low[1]), low[2] + share * (high[2] - low[2])
        room = min(room, gates.half_width - abs(y - gates.y[e, g]), gates.gap_height - z)
    return room


@kernel
def _least_room(e, state, gates, bodies):
    """Return the least room of the team of environment e in any wall [m]; below 0 it touches."""
    room, attitude = 1.0, matrow(state.payload_rotation, e)
    payload = row(state.payload_position, e)
    for g in range(gates.x.shape[0]):
        room = min(room, _room(e, g, add(payload, mul(attitude, bodies.centre)), attitude, bodies.payload, gates))
        for n in range(bodies.anchors.shape[0]):
            drone = vec(state.drone_position, e, n)
            room = min(room, _room(e, g, drone, mat(state.drone_rotation, e, n), bodies.drone[n], gates))
            anchor = add(payload, mul(attitude, row(bodies.anchors, n)))
            room = min(room, _cable_room(e, g, anchor, hook_position(e, n, state, bodies.hooks), gates))
    return room


@kernel
def _clearance(e, n, g, state, gates, bodies):
    """Return the room [m] that a drone would have in gap g if it flew straight on; below 0 it would hit the wall."""
    across = abs(state.drone_position[e, n, 1] - gates.y[e, g])
    return gates.half_width - across - _reach(mat(state.drone_rotation, e, n), bodies.drone[n], 1)


@kernel
def _write_observation(lo, hi, state, seen, goal, gates, bodies, observation, critic):
    for e in range(lo, hi):
        g = _next(e, state.payload_position[e, 0], gates)
        middle = (gates.x[g], gates.y[e, g], gates.level)
        told = critic[e, critic.shape[1] - 6 :]
        put(told[0:3], row(goal.velocity, e))
        put(told[3:6], sub(row(state.payload_position, e), middle))
        for n in range(observation.shape[1]):
            c, s = goal.slot_frame[e, n, 0], -goal.slot_frame[e, n, 1]
            own = observation[e, n, observation.shape[2] - 5 :]
            own[0], own[1] = turn(c, s, row(goal.velocity, e))[:2]
            own[2], own[3] = turn(c, s, sub(vec(seen.drone_position, e, n), middle))[:2]
            own[4] = min(max(_clearance(e, n, g, seen, gates, bodies), -0.5), 0.5)


@kernel
def _score(
    lo, hi, time, state, goal, errors, gates, bodies, action, previous, weights, bounds, arrival, dt, terms, good_time,
    cause,
):  # fmt: skip
    for e in range(lo, hi):
        distance = errors.distance[e]
        slip = norm(sub(row(state.payload_velocity, e), row(goal.velocity, e)))
        g = _next(e, state.payload_position[e, 0], gates)
        before = state.payload_position[e, 0] < gates.x[g] + PASSED
        passing, count = 0.0, action.shape[1]
        for n in range(count):
            lacking = max(0.05 - _clearance(e, n, g, state, gates, bodies), 0.0) if before else 0.0
            passing += tolerance(lacking, 0.25) / count
        terms[e, 0] = weights[0] * tolerance(distance, 0.25)
        terms[e, 1] = weights[1] * tolerance(distance, 0.05)
        terms[e, 2] = weights[2] * passing
        terms[e, 3] = weights[3] * tolerance(slip, 0.2)
        terms[e, 4] = weights[4] * tolerance(errors.angle[e], radians(6.0))
        terms[e, 5] = weights[5] * tolerance(norm(row(state.payload_body_rates, e)), 0.3)
        terms[e, 6] = weights[6] * action_rate(e, action, previous)
        good = time[e] >= arrival and is_at_rest(e, state, errors, bounds)
        good_time[e] = good_time[e] + dt if good else 0.0
        if cause[e] == 0 and _least_room(e, state, gates, bodies) < 0.0:
            cause[e] = WALL
