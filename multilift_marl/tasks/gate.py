"""Gate: the team carries its payload through gaps that are narrower than its formation."""

from __future__ import annotations

from math import pi
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import Field

from multilift_marl.control.formation import place_formation
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import drawing, inlined, kernel
from multilift_marl.math3d import add, ease, mat, matrow, mul, put, putmat, rot_z, row, sub, triple, vec
from multilift_marl.mdp.criteria import ArrivalOptions, Criterion, rest_criteria, tension_criterion
from multilift_marl.mdp.failures import WALL
from multilift_marl.mdp.initial_states import in_ball, set_equilibrium
from multilift_marl.mdp.observations import Component, target_velocity
from multilift_marl.mdp.rewards import (
    RestBounds,
    Term,
    action_rate,
    attitude,
    body_rate,
    distance,
    is_at_rest,
    tolerance,
    update_peak_tension,
    velocity,
)
from multilift_marl.planning.paths import STEP, differences, set_goal
from multilift_marl.schema.values import Float, Int, Section, Span
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.tasks.base import Box, Kernels, Task
from multilift_marl.tasks.target_checks import check_gaps, warn_of_time

THICKNESS = 0.1  # [m] of the walls
SPACING = 1.5  # [m] between walls
MARGIN = 1.25  # [m] from the start to the first wall and from the last one to the goal, and no less than 2 m in all
SPARE = 0.05  # [m] of clearance that the reward asks for
_WALL = (0.62, 0.52, 0.45, 1.0)  # colour


class GateOptions(ArrivalOptions):
    """The gates, the way through them, and what counts as success."""

    gates: Int = Field(1, ge=1, le=5, description="walls with a gap, 1.5 m apart, their middle at x = 0")
    gap_width: Span = Field((1.0, 1.0), description="[m] or its range, from which each gap's is drawn")
    gap_height: Float = Field(3.0, gt=0, description="[m] from the ground")
    gap_offset: Float = Field(0.3, ge=0, description="[m] gap's middle within ± this of the line from start to goal")
    height: Float = Field(1.3, gt=0, description="[m] of start and goal")
    start_radius: Float = Field(0.2, ge=0, description="[m] start within a ball of this radius of the target's")
    set_off: Float = Field(1.0, ge=0, description="[s] when the target sets off ...")
    arrival: Float = Field(11.0, gt=0, description="[s] ... and when it arrives at the goal")


class GateArrays(NamedTuple):
    """What an episode holds beside its goal."""

    gap_y: np.ndarray
    """(E, G) of the gaps' middles [m]."""
    half_width: np.ndarray
    """(E, G) of the gaps [m]."""
    peak_tension: np.ndarray
    """(E,) largest tension in the episode over that at rest [-]."""


class GateSettings(NamedTuple):
    """The walls, the target's motion, and what must not touch a wall."""

    x: np.ndarray
    """(G,) of the walls [m]."""
    gap_height: float
    """[m]."""
    reach: float
    """The target moves from x = -reach to x = reach [m]."""
    begin: float
    """When the target sets off [s]."""
    duration: float
    """How long it moves [s]."""
    arrival: float
    """When it arrives [s]."""
    level: float
    """Its height [m]."""
    radius: float
    """Of the ball in which the team starts [m]."""
    drone: np.ndarray
    """(N, 3) half edges of the drones [m]."""
    clear: np.ndarray
    """(N,) how far past a wall's middle nothing of a drone is in the wall [m]."""
    passed: float
    """The same of a payload and its formation [m]."""
    payload: np.ndarray
    """(3,) half edges of the payload [m]."""
    center: tuple[float, float, float]
    """Geometric centre of the payload from its centre of mass, in its frame [m]."""
    bounds: RestBounds


@inlined
def target_position(e, t, v):
    """Return where the target of environment e is at a time: straight through every gap."""
    gates, gap_y = v.settings, v.own.gap_y
    x = gates.reach * (2.0 * ease(t, gates.begin, gates.duration)[0] - 1.0)
    y, before, last = 0.0, -gates.reach, 0.0
    # The path is straight from 0.25 m before a wall to 0.25 m behind it.
    for g in range(gates.x.shape[0]):
        # Eased over x in place of time: the same curve, however fast it is followed.
        y += (gap_y[e, g] - last) * ease(x, before, gates.x[g] - 0.25 - before)[0]
        before, last = gates.x[g] + 0.25, gap_y[e, g]
    y -= last * ease(x, before, gates.reach - before)[0]
    return (x, y, gates.level)


@inlined
def move_target(e, t, v):
    """Write the goal of environment e at a time."""
    a, b, c = target_position(e, t - 2.0 * STEP, v), target_position(e, t - STEP, v), target_position(e, t, v)
    d, f = target_position(e, t + STEP, v), target_position(e, t + 2.0 * STEP, v)
    set_goal(e, differences(a, b, c, d, f), v.goal)
    place_formation(e, v.goal, v.rig)


@kernel
def trace(e, seconds, v, points):
    """Write positions of the target at points.shape[0] moments from 0 to `seconds`."""
    for i in range(points.shape[0]):
        put(points[i], target_position(e, seconds * i / (points.shape[0] - 1), v))


@drawing
def start_before_gate(e, rng, v, equilibrium):
    """Write goal and team at the start, the long side of the formation across the path."""
    goal = v.goal
    putmat(goal.rotation[e], rot_z(0.5 * pi))
    move_target(e, 0.0, v)
    moved = in_ball(rng, v.settings.radius)
    pose = add(row(goal.position, e), moved), matrow(goal.rotation, e)
    set_equilibrium(e, v, goal, equilibrium, pose, (0.0, 0.0, 0.0), moved)


@inlined
def advance_target(e, v):
    """Move the goal on; note the largest tension."""
    update_peak_tension(e, v, v.own.peak_tension)
    move_target(e, v.time[e], v)


@inlined
def _next_gap(e, x, clear, v):
    """Return the first gap of environment e that what is at x has before it: G if it is `clear` [m] past all walls."""
    for g in range(v.settings.x.shape[0]):
        if x < v.settings.x[g] + clear:
            return g
    return v.settings.x.shape[0]


@inlined
def own_gap(e, n, state, v):
    """Return the gap that a drone has before it, each its own: the first ones are in the next gap before the last."""
    return _next_gap(e, state.drone_position[e, n, 0], v.settings.clear[n], v)


@inlined
def _reach(frame, half, axis):
    """Return how far a box of `half` edges reaches along a world axis [m]."""
    # Support of a turned box along axis i: Σ |R_ij| h_j.
    return abs(frame[3 * axis]) * half[0] + abs(frame[3 * axis + 1]) * half[1] + abs(frame[3 * axis + 2]) * half[2]


@inlined
def _room(e, g, center, frame, half, v):
    """Return the room [m] of a box to the edges of gap g if it is in the wall, else 1."""
    gates = v.settings
    if abs(center[0] - gates.x[g]) > 0.5 * THICKNESS + _reach(frame, half, 0):
        return 1.0
    side = v.own.half_width[e, g] - abs(center[1] - v.own.gap_y[e, g]) - _reach(frame, half, 1)
    return min(side, gates.gap_height - center[2] - _reach(frame, half, 2))


@inlined
def _cable_room(e, g, low, high, v):
    """Return the same of a straight cable."""
    gates = v.settings
    begin, end = gates.x[g] - 0.5 * THICKNESS, gates.x[g] + 0.5 * THICKNESS
    if max(low[0], high[0]) < begin or min(low[0], high[0]) > end:
        return 1.0
    room, span = 1.0, high[0] - low[0]
    for side in (begin, end):
        # y and z are linear along the cable: it is nearest to an edge where it enters or leaves the wall.
        share = 0.0 if abs(span) < 1e-9 else min(max((side - low[0]) / span, 0.0), 1.0)
        y, z = low[1] + share * (high[1] - low[1]), low[2] + share * (high[2] - low[2])
        room = min(room, v.own.half_width[e, g] - abs(y - v.own.gap_y[e, g]), gates.gap_height - z)
    return room


@inlined
def least_room(e, v):
    """Return the least room of the team of environment e in any wall [m]; below 0 it touches."""
    state, bodies, rig = v.state, v.settings, v.rig
    room, attitude = 1.0, matrow(state.payload_rotation, e)
    payload = row(state.payload_position, e)
    for g in range(bodies.x.shape[0]):
        room = min(room, _room(e, g, add(payload, mul(attitude, bodies.center)), attitude, bodies.payload, v))
        for n in range(rig.anchors.shape[0]):
            drone, frame = vec(state.drone_position, e, n), mat(state.drone_rotation, e, n)
            room = min(room, _room(e, g, drone, frame, bodies.drone[n], v))
            anchor = add(payload, mul(attitude, row(rig.anchors, n)))
            room = min(room, _cable_room(e, g, anchor, add(drone, mul(frame, row(rig.hooks, n))), v))
    return room


@inlined
def _clearance(e, n, g, state, v):
    """Return the room [m] that a drone would have in gap g if it flew straight on; below 0 it would hit the wall."""
    across = abs(state.drone_position[e, n, 1] - v.own.gap_y[e, g])
    return v.own.half_width[e, g] - across - _reach(mat(state.drone_rotation, e, n), v.settings.drone[n], 1)


@inlined
def passage(e, v, margin):
    """Drones with room to pass their next gap, or through all."""
    passing, count = 0.0, v.action.shape[1]
    for n in range(count):
        g, lacking = own_gap(e, n, v.state, v), 0.0
        if g < v.settings.x.shape[0]:
            lacking = max(SPARE - _clearance(e, n, g, v.state, v), 0.0)
        passing += tolerance(lacking, margin) / count
    return passing


@inlined
def has_arrived(e, v):
    """Payload at rest at the goal, after the target's arrival."""
    return v.time[e] >= v.settings.arrival and is_at_rest(e, v, v.settings.bounds)


@inlined
def failure(e, v):
    """1 in the step in which the team fails, or touches a wall."""
    return 1.0 if v.cause[e] != 0 or least_room(e, v) < 0.0 else 0.0


@inlined
def find_touch(e, v):
    """Count a touched wall as a failure."""
    if v.cause[e] == 0 and least_room(e, v) < 0.0:
        v.cause[e] = WALL


@inlined
def gap_offset(e, n, v):
    """Own position from the middle of the own next gap, along the wall; 0 past the last."""
    g = own_gap(e, n, v.estimated, v)
    if g == v.settings.x.shape[0]:
        return (0.0, 0.0, 0.0)
    return (0.0, v.estimated.drone_position[e, n, 1] - v.own.gap_y[e, g], 0.0)


@inlined
def gap_distance(e, n, v):
    """Own distance past the wall of the own next gap, or past the last."""
    g = min(own_gap(e, n, v.estimated, v), v.settings.x.shape[0] - 1)
    return v.estimated.drone_position[e, n, 0] - v.settings.x[g]


@inlined
def clearance(e, n, v):
    """Own room to the edges of the own next gap, within ± 0.5 m; past the last 0.5."""
    g = own_gap(e, n, v.estimated, v)
    if g == v.settings.x.shape[0]:
        return 0.5
    return min(max(_clearance(e, n, g, v.estimated, v), -0.5), 0.5)


@inlined
def payload_gap(e, v):
    """Return the gap that the payload has before it, the last one after all."""
    return min(_next_gap(e, v.state.payload_position[e, 0], v.settings.passed, v), v.settings.x.shape[0] - 1)


@inlined
def payload_gap_offset(e, n, v):
    """Payload's position minus the middle of its next gap."""
    g = payload_gap(e, v)
    return sub(row(v.state.payload_position, e), (v.settings.x[g], v.own.gap_y[e, g], v.settings.level))


@inlined
def payload_gap_width(e, n, v):
    """Width of the payload's next gap."""
    return 2.0 * v.own.half_width[e, payload_gap(e, v)]


class Gate(Task):
    """Carry the payload through gaps; see docs/gate.md."""

    name: ClassVar[str] = "gate"
    Options: ClassVar[type[Section]] = GateOptions
    options: GateOptions
    own: GateArrays
    settings: GateSettings
    REWARD: ClassVar[dict[str, Term]] = {
        "position": Term(0.4, distance, 0.25, "m"),
        "precision": Term(0.2, distance, 0.05, "m"),
        "clearance": Term(0.8, passage, 0.25, "m"),
        "velocity": Term(0.2, velocity, 0.2, "m/s"),
        "attitude": Term(0.2, attitude, 6.0, "deg"),
        "stillness": Term(0.1, body_rate, 0.3, "rad/s"),
        "failure": Term(0.0, failure),
        "action_rate": Term(-0.05, action_rate),
    }
    CAN_PLAN: ClassVar[bool] = False
    KERNELS: ClassVar[Kernels] = Kernels(is_good=has_arrived, plan=advance_target, check=find_touch)
    EXTRA: ClassVar[tuple[Component, ...]] = (
        Component("target_velocity", 2, "slot", "m/s", "horizontal velocity of the target", target_velocity, True),
        Component(
            "gap", 2, "slot", "m", "own position from the middle of the own next gap, along the wall", gap_offset, True
        ),
        Component("gap_distance", 1, "-", "m", "own distance past the wall of that gap", gap_distance),
        Component("clearance", 1, "-", "m", "own room to the edges of that gap, within ± 0.5", clearance),
    )
    EXTRA_STATE: ClassVar[tuple[Component, ...]] = (
        Component("target_velocity", 3, "world", "m/s", "velocity of the target", target_velocity),
        Component("gap", 3, "world", "m", "payload position minus the middle of its next gap", payload_gap_offset),
        Component("gap_width", 1, "-", "m", "width of that gap", payload_gap_width),
    )

    def prepare(self) -> None:
        """See `Task.prepare`."""
        option, system, e = self.options, self.world.system, self.world.num_envs
        if option.arrival <= option.set_off:
            raise ConfigError(
                f"task_options.arrival={option.arrival:g} s must be later than set_off={option.set_off:g} s, when the "
                "target leaves; raise it"
            )
        x = SPACING * (np.arange(option.gates) - (option.gates - 1) / 2)
        reach = max(x[-1] + MARGIN, 2.0)
        check_gaps(option, reach, SPACING - 0.5 if len(x) > 1 else reach - 0.25, system)
        until = f"with task_options.arrival={option.arrival:g} s, task gate can succeed from"
        warn_of_time(until, option.arrival + option.success_seconds, self.config.env.episode_seconds)
        drone = np.array([drone_half_size(vehicle) for vehicle in system.vehicles])
        clear = THICKNESS / 2 + np.linalg.norm(drone[:, :2], axis=1) + SPARE
        self.own = GateArrays(np.zeros((e, len(x))), np.zeros((e, len(x))), np.zeros(e))
        self.settings = GateSettings(
            x=x,
            gap_height=option.gap_height,
            reach=reach,
            begin=option.set_off,
            duration=option.arrival - option.set_off,
            arrival=option.arrival,
            level=option.height,
            radius=option.start_radius,
            drone=drone,
            clear=clear,
            # The team is turned by 90° (see the start): its slots' y lies along the path.
            passed=float((np.abs(self.rig.slots[:, 1]) + clear).max()),
            payload=system.payload_size / 2,
            center=triple(system.payload_center),
            bounds=RestBounds.of(option),
        )

    def start(self, env: int, rng: np.random.Generator, mass: float) -> None:
        """Draw the gaps and where the team starts; see `Task.start`."""
        option = self.options
        self.own.peak_tension[env] = 0.0
        self.own.gap_y[env] = rng.uniform(-option.gap_offset, option.gap_offset, option.gates)
        low, high = option.gap_width
        self.own.half_width[env] = 0.5 * (low if low == high else rng.uniform(low, high, option.gates))
        start_before_gate(env, rng, self.view_for(start_before_gate), self.equilibrium)

    def succeeded(self) -> np.ndarray:
        """At rest at the goal throughout the last moments, and never too large a tension."""
        return super().succeeded() & (self.own.peak_tension <= self.options.success_tension)

    def criteria(self) -> tuple[Criterion, ...]:
        """See `Task.criteria`."""
        at_rest = self.KERNELS.is_good is has_arrived
        found = rest_criteria(self.settings.bounds, self.errors, self.world.state) if at_rest else ()
        return (*found, tension_criterion(self.own.peak_tension, self.options.success_tension))

    def target_path(self, env: int) -> np.ndarray:
        """Return points of the path through the gaps; see `Task.target_path`."""
        points = np.zeros((61, 3))
        trace(env, self.options.arrival, self.view_for(trace), points)
        return points

    def scenery(self, env: int) -> list[Box]:
        """Return the walls and obstacles; see `Task.scenery`."""
        half, top = 2.5, self.settings.gap_height
        boxes = super().scenery(env)
        for x, y, gap in zip(self.settings.x, self.own.gap_y[env], self.own.half_width[env], strict=True):
            for side in (-1, 1):
                boxes.append(Box((THICKNESS / 2, half / 2, top / 2), (x, y + side * (gap + half / 2), top / 2), _WALL))
            boxes.append(Box((THICKNESS / 2, half + gap, 0.25), (x, y, top + 0.25), _WALL))
        return boxes
