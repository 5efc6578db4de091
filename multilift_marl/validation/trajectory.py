"""The way of a team from the ground onto a circle: the load's path, and the drones' places and pulls with it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import AIR_DENSITY
from multilift_marl.sim.contact import drone_half_size

RADIUS, HEIGHT = 5.0, 1.5  # [m] of the circle
ASIDE = 0.6  # [m] from its anchor to a drone on the ground
SECONDS = 2.0, 4.0, 3.0, 5.0, 3.0, 8.0  # [s] rest, climb, tighten, lift, hover, gather speed
_SAMPLE = 0.008  # [s] between samples of the path that are differentiated


class Plan(NamedTuple):
    """Phases of a flight: they begin at `start` [s], the last one ends at `end`; the rates of the circles [rad/s]."""

    names: tuple[str, ...]
    start: tuple[float, ...]
    end: float
    rates: tuple[float, float]

    def during(self, name: str, time: np.ndarray) -> np.ndarray:
        """Return which of the times (T,) lie in a phase, (T,) bool."""
        i = self.names.index(name)
        return (time >= self.start[i]) & (time < (*self.start, self.end)[i + 1])


class Trajectory(NamedTuple):
    """References over T control steps."""

    payload: np.ndarray
    """(T, 3) [m]."""
    position: np.ndarray
    """(T, N, 3) of the drones [m]; the next three are its derivatives."""
    velocity: np.ndarray
    acceleration: np.ndarray
    jerk: np.ndarray
    cable_force: np.ndarray
    """(T, N, 3) of the drones on their cables [N]."""
    yaw: np.ndarray
    """(T,) along the circle [rad]."""
    yaw_rate: np.ndarray
    """(T,) [rad/s]."""


def make_plan(laps: tuple[float, float], rates: tuple[float, float] = (0.2, 0.4)) -> Plan:
    """Return the phases of a flight with so many laps of the circle at each of two angular velocities."""
    rest, climb, tighten, lift, hover, gather = SECONDS
    seconds = [laps[i] * 2 * np.pi / rates[i] for i in (0, 1)]
    names = ("rest", "climb", "tighten", "lift", "hover", "gather", "slow circle", "gather more", "fast circle")
    edges = np.cumsum([0.0, rest, climb, tighten, lift, hover, gather, seconds[0], gather, seconds[1]])
    return Plan(names, tuple(edges[:-1].tolist()), float(edges[-1]), rates)


def on_the_ground(system: System) -> tuple[float, np.ndarray]:
    """Return the height of a resting payload's centre of mass [m] and the places (N, 3) of the drones around it.

    The payload is centred on the start of the circle; each drone stands beside its anchor, its cable slack.
    """
    height = float(system.payload_size[2] / 2 - system.payload_center[2])
    outward = system.formation_force[:, :2] / np.linalg.norm(system.formation_force[:, :2], axis=1, keepdims=True)
    places = np.zeros((system.num_drones, 3))
    places[:, :2] = system.anchors[:, :2] + ASIDE * outward + [RADIUS, 0.0]
    places[:, 2] = drone_half_size(system.vehicle)[2]
    return height, places


def make_trajectory(system: System, plan: Plan, time: np.ndarray, plain: bool = False) -> Trajectory:
    """Return what a team is to follow at the times (T,).

    The drones climb from the ground until their cables are just taut, pull until the ground bears no more of the load,
    lift it, hover and circle. What the cables must pull at every moment follows from the load's acceleration and drag;
    where the drones must be follows from the directions of these pulls (the load is flat in the sense of Fliess;
    Sreenath and Kumar, RSS 2013). A slack cable is fed no pull, one that comes taut a growing share of the load's.

    Args:
        system: the team.
        plan: its phases.
        time: [s].
        plain: feed the load's weight alone forward, with the formation as it is at rest.
    """
    around = [_team(system, plan, time + k * _SAMPLE, plain)[0] for k in (-2, -1, 0, 1, 2)]
    angle, rate, _ = _turning(plan, time)
    position, velocity, acceleration, jerk = _derivatives(around)
    payload = load_path(system, plan, time)[0]
    cable_force = _team(system, plan, time, plain)[1]
    return Trajectory(payload, position, velocity, acceleration, jerk, cable_force, angle + np.pi / 2, rate)


def load_path(system: System, plan: Plan, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, velocity and acceleration of the load, (T, 3) each, at the times (T,)."""
    s, seconds = _share(plan, "lift", time)
    ground = on_the_ground(system)[0]
    angle, rate, change = _turning(plan, time)
    outward = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    along = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    rise = (HEIGHT - ground) * np.array([0, 0, 1.0])
    position = RADIUS * outward + [0, 0, ground] + _smooth(s)[:, None] * rise
    velocity = RADIUS * rate[:, None] * along + _slope(s)[:, None] / seconds * rise
    acceleration = RADIUS * (change[:, None] * along - rate[:, None] ** 2 * outward)
    return position, velocity, acceleration + _bend(s)[:, None] / seconds**2 * rise


def carrying_forces(system: System, acceleration: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the smallest changes of the cables' pulls (T, N, 3) [N] that accelerate a level load against its drag.

    Args:
        system: the team.
        acceleration: (T, 3) [m/s²].
        velocity: (T, 3) in still air [m/s].
    """
    moments = [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in system.anchors]
    balance = np.concatenate([np.tile(np.eye(3), system.num_drones), np.concatenate(np.array(moments), axis=1)])
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    force = system.payload_mass * acceleration + 0.5 * AIR_DENSITY * system.payload_drag_area * speed * velocity
    wrench = np.concatenate([force, np.zeros_like(force)], axis=1)
    return (wrench @ np.linalg.pinv(balance).T).reshape(len(wrench), -1, 3)


def _team(system: System, plan: Plan, time: np.ndarray, plain: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return positions and pulls (T, N, 3) of the drones that belong to the load's motion."""
    payload, velocity, acceleration = load_path(system, plan, time)
    force = np.broadcast_to(system.formation_force, (len(time), system.num_drones, 3))
    if not plain:
        force = force + carrying_forces(system, acceleration, velocity)
    direction = force / np.linalg.norm(force, axis=2, keepdims=True)
    cable_force = _smooth(_share(plan, "tighten", time)[0])[:, None, None] * force
    tension = np.linalg.norm(cable_force, axis=2, keepdims=True)
    length = system.cable_length[:, None] + tension / system.cable_stiffness[:, None]
    aloft = payload[:, None] + system.anchors + length * direction
    ground = on_the_ground(system)[1]
    return ground + _smooth(_share(plan, "climb", time)[0])[:, None, None] * (aloft - ground), cable_force


def _turning(plan: Plan, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angle on the circle [rad], angular velocity and acceleration, (T,) each."""
    angle, rate, change = np.zeros_like(time), np.zeros_like(time), np.zeros_like(time)
    for name, more in (("gather", plan.rates[0]), ("gather more", plan.rates[1] - plan.rates[0])):
        s, seconds = _share(plan, name, time)
        past = np.maximum(time - plan.start[plan.names.index(name)] - seconds, 0.0)
        angle += more * (seconds * _sum(s) + past)
        rate += more * _smooth(s)
        change += more * _slope(s) / seconds
    return angle, rate, change


def _share(plan: Plan, name: str, time: np.ndarray) -> tuple[np.ndarray, float]:
    """Return how much of a phase has passed (T,), 0 to 1, and how long it lasts [s]."""
    i = plan.names.index(name)
    seconds = (*plan.start, plan.end)[i + 1] - plan.start[i]
    return np.clip((time - plan.start[i]) / seconds, 0.0, 1.0), seconds


def _smooth(s: np.ndarray) -> np.ndarray:
    """Return a step from 0 to 1 over s from 0 to 1, smooth to the fifth derivative.

    The load's acceleration moves the drones, so its second derivative enters their acceleration and must not jump.
    """
    return s**6 * (462 - 1980 * s + 3465 * s**2 - 3080 * s**3 + 1386 * s**4 - 252 * s**5)


def _sum(s: np.ndarray) -> np.ndarray:
    return s**7 * (66 - 247.5 * s + 385 * s**2 - 308 * s**3 + 126 * s**4 - 21 * s**5)


def _slope(s: np.ndarray) -> np.ndarray:
    return 2772 * s**5 * (1 - s) ** 5


def _bend(s: np.ndarray) -> np.ndarray:
    return 13860 * s**4 * (1 - s) ** 4 * (1 - 2 * s)


def _derivatives(around: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return value, first, second and third derivative from five samples `_SAMPLE` apart."""
    a, b, c, d, e = around
    h = _SAMPLE
    first = (a - 8 * b + 8 * d - e) / (12 * h)
    second = (-a + 16 * b - 30 * c + 16 * d - e) / (12 * h**2)
    return c, first, second, (e - 2 * d + 2 * b - a) / (2 * h**3)
