"""Sensing of obstacles: each drone observes their nearest points, or a ring of ranges (`env.obstacle_sensing`).

- `map`: the nearest point of each of the k nearest obstacles, exact, at any distance.
- `local`: the same within the range and the field of view of a sensor with a rate, a delay and noise.
- `ranges`: lengths of horizontal beams about the drone until they meet an obstacle, of such a sensor.

Points are observed in the drone's heading frame as it is now: where it measured them, as it knows its own way since,
as if obstacles stood still. Ranges stay those of the measurement, which sees from the true pose. Sensors see obstacles
alone, neither ground nor team; points are seen through other obstacles, and a point outside the field of view is not
replaced by another of the same obstacle.
"""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, cos, inf, pi, radians, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.kernels.jit import kernel, prebind
from multilift_marl.math3d import add, heading, mat, norm, put, row, scale, sub, turn, vec
from multilift_marl.mdp.observations import NO_OBSTACLE, count_readings
from multilift_marl.rig.resolve import whole_ratio
from multilift_marl.rng import normal_pair, normal_vector
from multilift_marl.sim.obstacle_distance import point_distance, ray_distance
from multilift_marl.sim.obstacles import NONE, Obstacles
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World


class ObstacleSensor(NamedTuple):
    """Constants of the sensor."""

    beams: np.ndarray
    """(B, 3) their directions in the heading frame."""
    points: int
    """k; 0 of a ring of beams."""
    range: float
    """[m]."""
    half_view: float
    """Half of the field of view [rad]."""
    noise: float
    """[m]."""
    period: int
    """Policy steps from one measurement to the next."""
    delay: int
    """[policy steps]."""


class ObstacleReadings(NamedTuple):
    """What the sensors have measured; P numbers of each drone, environment first."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    steps: np.ndarray
    """(E,) int64 policy steps since the reset."""
    latest: np.ndarray
    """(E, N, P) the last measurement [m]."""
    held: np.ndarray
    """(E, K, N, P) the last ones of the last policy steps, at their number modulo K [m]."""
    observed: np.ndarray
    """(E, N, P) what drones observe [m]."""
    placed: np.ndarray
    """(E, N, k, 3) world frame: the points that they observe, from where they took themselves to be when they measured
    [m]."""
    latest_placed: np.ndarray
    """(E, N, k, 3) as `placed`, of the last measurement."""
    held_placed: np.ndarray
    """(E, K, N, k, 3) as `placed`, held as `held`."""


class DronePoses(NamedTuple):
    """Where the drones of E teams are, and where they take themselves to be."""

    position: np.ndarray
    """(E, N, 3) true [m]."""
    rotation: np.ndarray
    """(E, N, 3, 3) true."""
    own_position: np.ndarray
    """(E, N, 3) as they know it [m]."""
    own_rotation: np.ndarray
    """(E, N, 3, 3) as they know it."""


class ObstacleSensing:
    """The sensors of obstacles of E teams.

    Args:
        config: `env.obstacle_sensing`, not none, and `env.obstacles`.
        world: the teams and obstacles.
        own: what the drones know of themselves.

    Attributes:
        readings: ObstacleReadings; live.
        sense: call of (lo, hi), once at the start of an episode and in each policy step.

    Raises:
        ConfigError: a rate that does not divide `env.policy_hz`.
    """

    def __init__(self, config: Config, world: World, own: SystemState):
        mode, given, rate = config.env.obstacle_sensing, config.env.obstacles, config.env.policy_hz
        period = 1 if given.rate is None else whole_ratio(rate, given.rate, "env.obstacles.rate", "env.policy_hz")
        azimuth = 2 * pi * np.arange(given.beams) / given.beams
        beams = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(given.beams)], axis=1)
        if mode == "map":
            sensor = ObstacleSensor(beams, given.points, NO_OBSTACLE, pi, 0.0, 1, 0)
        else:
            points = given.points if mode == "local" else 0
            half_view = radians(given.field_of_view) / 2
            sensor = ObstacleSensor(beams, points, given.range, half_view, given.noise, period, given.delay)
        e, n = world.num_envs, world.num_drones
        shape = e, n, count_readings(config.env)
        held = np.zeros((e, sensor.delay + 1, *shape[1:]))
        placed = e, n, sensor.points, 3
        self.readings = ObstacleReadings(
            np.zeros(e, np.uint64), np.zeros(e, np.int64), np.zeros(shape), held, np.zeros(shape),
            np.zeros(placed), np.zeros(placed), np.zeros((e, sensor.delay + 1, *placed[1:])),
        )  # fmt: skip
        distances = np.zeros((e, n, max(sensor.points, 1)))
        true = world.state
        drones = DronePoses(true.drone_position, true.drone_rotation, own.drone_position, own.drone_rotation)
        self.sense: Callable[[int, int], None] = prebind(
            sense_obstacles, drones, _needed(world.obstacles), sensor, self.readings, distances
        )

    def start(self, env: int, seed: np.random.SeedSequence) -> None:
        """Begin an episode of one environment."""
        self.readings.generator[env] = seed.generate_state(1, np.uint64)[0]

    def begin(self, lo: int, hi: int) -> None:
        """Measure in environments lo to hi for the first time in an episode; that is observed until another is."""
        self.readings.steps[lo:hi] = 0
        self.sense(lo, hi)


def _needed(obstacles: Obstacles) -> Obstacles:
    """Return the obstacles with None in place of what distances do not need: kernels compile faster."""
    needed = ("kind", "size", "rotation", "position", "hull", "vertices")
    unknown = {name: None for name in Obstacles._fields if name not in needed}
    return obstacles._replace(**unknown)  # type: ignore[arg-type]


@kernel
def sense_obstacles(lo, hi, drones, obstacles, sensor, readings, distances):
    """Measure in environments lo to hi where it is time, and observe what was measured `delay` steps ago.

    Args:
        lo, hi: the environments.
        drones: DronePoses.
        obstacles: Obstacles.
        sensor: ObstacleSensor.
        readings: ObstacleReadings, written.
        distances: (E, N, k) [m], written.
    """
    for e in range(lo, hi):
        now = readings.steps[e]
        count = readings.held.shape[1]
        then = now - min(sensor.delay, now)  # at first the first
        for n in range(drones.position.shape[1]):
            latest = readings.latest[e, n]
            if now % sensor.period == 0:
                drone, yaw = vec(drones.position, e, n), heading(mat(drones.rotation, e, n))
                if sensor.points > 0:
                    _find_points(e, drone, yaw, obstacles, sensor, latest, distances[e, n])
                    _blur_points(e, sensor, readings, latest, distances[e, n])
                    _place_points(e, n, drones, readings)
                else:
                    _measure_ranges(e, drone, yaw, obstacles, sensor, latest)
                    _blur_ranges(e, sensor, readings, latest)
            # Held before it is read: without delay it is the present itself.
            for k in range(latest.shape[0]):
                readings.held[e, now % count, n, k] = latest[k]
                readings.observed[e, n, k] = readings.held[e, then % count, n, k]
            for j in range(sensor.points):
                put(readings.held_placed[e, now % count, n, j], vec(readings.latest_placed[e], n, j))
                put(readings.placed[e, n, j], vec(readings.held_placed[e, then % count], n, j))
            if sensor.delay > 0 or sensor.period > 1:
                _move_points(e, n, drones, sensor, readings)
        readings.steps[e] = now + 1


@kernel
def _place_points(e, n, drones, readings):
    """Write where the points of the last measurement are in the world, as the drone knows itself."""
    yaw = heading(mat(drones.own_rotation, e, n))
    c, s = cos(yaw), sin(yaw)
    for j in range(readings.latest_placed.shape[2]):
        measured = readings.latest[e, n, 3 * j : 3 * j + 3]
        point = turn(c, s, (measured[0], measured[1], measured[2]))
        put(readings.latest_placed[e, n, j], add(vec(drones.own_position, e, n), point))


@kernel
def _move_points(e, n, drones, sensor, readings):
    """Observe points where they are now, seen from where the drone knows itself to be, if they do not move."""
    yaw = heading(mat(drones.own_rotation, e, n))
    c, s = cos(yaw), sin(yaw)
    for j in range(readings.placed.shape[2]):
        observed = readings.observed[e, n, 3 * j : 3 * j + 3]
        if observed[0] != 0.0 or observed[1] != 0.0 or observed[2] != sensor.range:  # something is seen
            put(observed, turn(c, -s, sub(vec(readings.placed[e], n, j), vec(drones.own_position, e, n))))


@kernel
def _find_points(e, drone, yaw, obstacles, sensor, points, distances):
    """Write the nearest points (3 k) in the heading frame, nearest first, and their distances (k), inf where none is.

    What is not seen is straight above at the sensor's range.
    """
    for j in range(distances.shape[0]):
        distances[j] = inf
        put(points[3 * j : 3 * j + 3], (0.0, 0.0, sensor.range))
    c, s = cos(yaw), sin(yaw)
    last = distances.shape[0] - 1
    for m in range(obstacles.kind.shape[1]):
        if obstacles.kind[e, m] == NONE:
            continue
        distance, nearest = point_distance(e, m, drone, obstacles)
        if distance > sensor.range or distance >= distances[last]:
            continue
        point = turn(c, -s, sub(nearest, drone))
        if abs(atan2(point[1], point[0])) > sensor.half_view:
            continue
        # Into its place among those found before; the farthest of k drops out.
        j = last
        while j > 0 and distances[j - 1] > distance:
            distances[j] = distances[j - 1]
            for i in range(3):
                points[3 * j + i] = points[3 * j - 3 + i]
            j -= 1
        distances[j] = distance
        put(points[3 * j : 3 * j + 3], point)


@kernel
def _blur_points(e, sensor, readings, points, distances):
    """Add noise to the points that are seen."""
    if sensor.noise > 0.0:
        for j in range(distances.shape[0]):
            if distances[j] < inf:
                point = (points[3 * j], points[3 * j + 1], points[3 * j + 2])
                put(points[3 * j : 3 * j + 3], add(point, scale(sensor.noise, normal_vector(e, readings))))


@kernel
def _measure_ranges(e, drone, yaw, obstacles, sensor, ranges):
    """Write the lengths of the beams until they meet an obstacle, at most the range."""
    for b in range(ranges.shape[0]):
        ranges[b] = sensor.range
    c, s = cos(yaw), sin(yaw)
    for m in range(obstacles.kind.shape[1]):
        # Obstacles whose sphere is out of range, or above or below all beams, are met by none.
        if obstacles.kind[e, m] == NONE:
            continue
        offset, radius = sub(vec(obstacles.position, e, m), drone), norm(vec(obstacles.size, e, m))
        if norm(offset) - radius > sensor.range or abs(offset[2]) > radius:
            continue
        for b in range(ranges.shape[0]):
            direction = turn(c, s, row(sensor.beams, b))
            # Nor are those beams that pass the sphere, or point away from it.
            along = offset[0] * direction[0] + offset[1] * direction[1]
            across = offset[1] * direction[0] - offset[0] * direction[1]
            if abs(across) <= radius and along >= -radius:
                ranges[b] = min(ranges[b], ray_distance(e, m, drone, direction, obstacles))


@kernel
def _blur_ranges(e, sensor, readings, ranges):
    """Add noise to the ranges of beams that have met something."""
    if sensor.noise > 0.0:
        for b in range(ranges.shape[0]):
            if ranges[b] < sensor.range:
                measured = ranges[b] + sensor.noise * normal_pair(e, readings)[0]
                ranges[b] = min(max(measured, 0.0), sensor.range)
