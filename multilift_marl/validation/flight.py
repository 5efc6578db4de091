"""The report's multi-lift flight (section 4.2): from the ground to hover and around a circle, yaw along it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.polynomial import Polynomial

from multilift_marl.config.load import load_config
from multilift_marl.control.disturbance import REJECTIONS, Disturbance, make_rejection
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.physical import AIR_DENSITY
from multilift_marl.rig.system import System
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Plot, Result, Row

RADIUS, HEIGHT = 5.0, 1.5  # [m] of the circle
ASIDE = 0.6  # [m] from its anchor to a drone on the ground
LIMITS = {"report4": (0.005, 0.010), "falcon4": (0.005, 0.015)}
"""Mean position error of a drone [m] on the circle at 0.2 and 0.4 rad/s, by rig."""
SMOOTH = Polynomial([0, 0, 0, 0, 0, 0, 462, -1980, 3465, -3080, 1386, -252])
"""A step from 0 to 1 over [0, 1], smooth to the fifth derivative: the second derivative of the load's acceleration
enters the drones' acceleration and must not jump."""
_SAMPLE = 0.008  # [s] between samples of the path that are differentiated
_CIRCLES = ("slow circle", "fast circle")
_OVERSHOOT = 0.1  # [m]
_WIND = 5.0  # [m/s]


class Plan(NamedTuple):
    """Phases of a flight between `edges` [s], (K + 1,), and the rates of the two circles [rad/s]."""

    names: tuple[str, ...]
    edges: np.ndarray
    rates: tuple[float, float]

    def start(self, name: str) -> float:
        """Return when a phase begins [s]."""
        return float(self.edges[self.names.index(name)])

    def seconds(self, name: str) -> float:
        """Return how long a phase lasts [s]."""
        return float(np.diff(self.edges)[self.names.index(name)])

    def during(self, name: str, time: np.ndarray) -> np.ndarray:
        """Return which of the times (T,) lie in a phase, (T,) bool."""
        return (time >= self.start(name)) & (time < self.start(name) + self.seconds(name))

    def share(self, name: str, time: np.ndarray) -> np.ndarray:
        """Return how much of a phase has passed (T,), 0 to 1."""
        return np.clip((time - self.start(name)) / self.seconds(name), 0.0, 1.0)

    def phases(self, last: str) -> list[tuple[str, float, float]]:
        """Return name, start and end of the phases up to `last`."""
        return list(zip(self.names, self.edges[:-1], self.edges[1:], strict=True))[: self.names.index(last) + 1]


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


class Flight(NamedTuple):
    """What was planned and what happened over T control steps to two teams.

    The first one's drones are fed the cable forces that move the load forward, the second one's its weight alone.
    """

    plan: Plan
    system: System
    time: np.ndarray
    """(T,) [s]."""
    planned: Trajectory
    drones: np.ndarray
    """(T, N, 3) of the first team [m]."""
    tension: np.ndarray
    """(T, N) of the first team [N]."""
    yaw_error: np.ndarray
    """(T, N) of the first team [deg]: of ψ = atan2(-R01, R11), which eq 29 prescribes, not of atan2(R10, R00)."""
    payload: np.ndarray
    """(T, 2, 3) of both teams [m]."""

    @property
    def drone_error(self) -> np.ndarray:
        """Distance of each drone from its reference (T, N) [m]."""
        return np.linalg.norm(self.drones - self.planned.position, axis=2)

    @property
    def payload_error(self) -> np.ndarray:
        """Distance of both payloads from their path (T, 2) [m]."""
        return np.linalg.norm(self.payload - self.planned.payload[:, None], axis=2)


def make_plan(laps: tuple[float, float], rates: tuple[float, float] = (0.2, 0.4)) -> Plan:
    """Return the phases of a flight with so many laps of the circle at each of two angular velocities."""
    slow, fast = (2 * np.pi * count / rate for count, rate in zip(laps, rates, strict=True))
    seconds = {
        "rest": 2.0, "climb": 4.0, "tighten": 3.0, "lift": 5.0, "hover": 3.0, "gather": 8.0, "slow circle": slow,
        "gather more": 8.0, "fast circle": fast,
    }  # fmt: skip
    return Plan(tuple(seconds), np.cumsum([0.0, *seconds.values()]), rates)


def on_the_ground(system: System) -> tuple[float, np.ndarray]:
    """Return the height of a resting payload's centre of mass [m] and the places (N, 3) of the drones around it.

    The payload is centred on the start of the circle; each drone rests beside its anchor, its cable slack.
    """
    height = float(system.payload_size[2] / 2 - system.payload_center[2])
    outward = system.formation_force[:, :2] / np.linalg.norm(system.formation_force[:, :2], axis=1, keepdims=True)
    places = np.zeros((system.num_drones, 3))
    places[:, :2] = system.anchors[:, :2] + ASIDE * outward + [RADIUS, 0.0]
    places[:, 2] = drone_half_size(system.vehicle)[2]
    return height, places


def make_trajectory(system: System, plan: Plan, time: np.ndarray, plain: bool = False) -> Trajectory:
    """Return what a team is to follow at the times (T,).

    The drones climb from the ground until their cables are just taut, tighten them until the ground bears no more of
    the load, lift it, hover and circle. The cable forces follow from the load's acceleration and drag at every moment,
    the drones' positions from the directions of these forces (the load is flat in the sense of Fliess; Sreenath and
    Kumar, RSS 2013). A slack cable is fed no force, one that comes taut a growing share of the load's.

    Args:
        system: the team.
        plan: its phases.
        time: [s].
        plain: feed the load's weight alone forward, with the formation as it is at rest.
    """
    a, b, c, d, e = (_positions(system, plan, time + k * _SAMPLE, plain)[0] for k in (-2, -1, 0, 1, 2))
    angle, rate, _ = _turning(plan, time)
    return Trajectory(
        payload=load_path(system, plan, time)[0],
        position=c,
        velocity=(a - 8 * b + 8 * d - e) / (12 * _SAMPLE),
        acceleration=(-a + 16 * b - 30 * c + 16 * d - e) / (12 * _SAMPLE**2),
        jerk=(e - 2 * d + 2 * b - a) / (2 * _SAMPLE**3),
        cable_force=_positions(system, plan, time, plain)[1],
        yaw=angle + np.pi / 2,
        yaw_rate=rate,
    )


def load_path(system: System, plan: Plan, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return position, velocity and acceleration of the load, (T, 3) each, at the times (T,)."""
    ground = on_the_ground(system)[0]
    angle, rate, change = (values[:, None] for values in _turning(plan, time))
    outward = np.concatenate([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    along = np.concatenate([-np.sin(angle), np.cos(angle), 0 * angle], axis=1)
    s = plan.share("lift", time)[:, None]
    seconds = plan.seconds("lift")
    rise = np.array([0, 0, HEIGHT - ground])
    position = RADIUS * outward + [0, 0, ground] + SMOOTH(s) * rise
    velocity = RADIUS * rate * along + SMOOTH.deriv()(s) / seconds * rise
    acceleration = RADIUS * (change * along - rate**2 * outward) + SMOOTH.deriv(2)(s) / seconds**2 * rise
    return position, velocity, acceleration


def carrying_forces(system: System, acceleration: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Return the smallest changes of the cable forces (T, N, 3) [N] that accelerate a level load against its drag.

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


def _positions(system: System, plan: Plan, time: np.ndarray, plain: bool) -> tuple[np.ndarray, np.ndarray]:
    """Return positions of the drones and forces on their cables (T, N, 3) that belong to the load's motion."""
    payload, velocity, acceleration = load_path(system, plan, time)
    force = np.broadcast_to(system.formation_force, (len(time), system.num_drones, 3))
    if not plain:
        force = force + carrying_forces(system, acceleration, velocity)
    direction = force / np.linalg.norm(force, axis=2, keepdims=True)
    cable_force = SMOOTH(plan.share("tighten", time))[:, None, None] * force
    tension = np.linalg.norm(cable_force, axis=2, keepdims=True)
    length = system.cable_length[:, None] + tension / system.cable_stiffness[:, None]
    aloft = payload[:, None] + system.anchors + length * direction
    ground = on_the_ground(system)[1]
    return ground + SMOOTH(plan.share("climb", time))[:, None, None] * (aloft - ground), cable_force


def _turning(plan: Plan, time: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return angle on the circle [rad], angular velocity and acceleration, (T,) each."""
    angle, rate, change = np.zeros((3, len(time)))
    for name, more in (("gather", plan.rates[0]), ("gather more", plan.rates[1] - plan.rates[0])):
        s = plan.share(name, time)
        seconds = plan.seconds(name)
        after = np.maximum(time - plan.start(name) - seconds, 0.0)
        angle += more * (seconds * SMOOTH.integ()(s) + after)
        rate += more * SMOOTH(s)
        change += more * SMOOTH.deriv()(s) / seconds
    return angle, rate, change


def fly_rig(rig: str, plan: Plan, **overrides: Any) -> Flight:
    """Fly `plan` with two teams of a rig (a configuration in configs/rigs), the second on plain feed-forward.

    Args:
        rig: its name.
        plan: phases.
        **overrides: configuration values by name, with __ for the dot.
    """
    values = {"control.drag_feedforward": True} | {key.replace("__", "."): value for key, value in overrides.items()}
    config = load_config(f"rigs/{rig}", values)
    system = config.system
    dt = 1 / config.sim.control_hz
    kind = config.control.disturbance
    time = dt * np.arange(round(plan.edges[-1] / dt))
    planned = [make_trajectory(system, plan, time, plain) for plain in (False, True)]
    world = World(system, 2, 1)
    reference = Reference.zeros(2, system.num_drones)
    state = world.state
    disturbance = Disturbance.zeros(2, system.num_drones)
    _put_down(world)
    gains = make_gains(config.control, system)
    rejection = None if kind == "none" else make_rejection(config.control, system, gains, dt)
    gains = gains._replace(load_share=np.zeros(system.num_drones))  # the cable forces hold the load's inertia
    if rejection is not None:
        rejection = rejection._replace(gains=gains)
    payload = []
    drones = []
    tension = []
    yaw = []
    for i, t in enumerate(time):
        for name in ("position", "velocity", "acceleration", "jerk", "yaw", "yaw_rate"):
            for e in (0, 1):
                getattr(reference, name)[e] = getattr(planned[e], name)[i]
        yaw.append(np.arctan2(-state.drone_rotation[0, :, 0, 1], state.drone_rotation[0, :, 1, 1]))
        payload.append(state.payload_position.copy())
        drones.append(state.drone_position[0].copy())
        cable_force = np.stack([each.cable_force[i] for each in planned])
        if t < plan.start("climb"):
            world.thrust[:] = 0.0  # at rest the rotors idle
        else:
            if rejection is not None:
                REJECTIONS[kind](0, 2, state, reference, cable_force, disturbance, rejection)
                cable_force = disturbance.cable_force
            fly(0, 2, state, reference, cable_force, world.thrust, gains)
        world.step(world.thrust, system.control_interval)
        tension.append(state.cable_tension[0].copy())
    turned = np.array(yaw) - planned[0].yaw[:, None]
    yaw_error = np.rad2deg(np.arctan2(np.sin(turned), np.cos(turned)))
    return Flight(plan, system, time, planned[0], np.array(drones), np.array(tension), yaw_error, np.array(payload))


def _put_down(world: World) -> None:
    """Put every team on the ground: payload at the start of the circle, drones around it with their rotors idling."""
    height, places = on_the_ground(world.system)
    state = world.state
    state.payload_position[:] = [RADIUS, 0.0, height]
    state.drone_position[:] = places
    state.drone_rotation[:] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # along the circle
    state.rotor_speed[:] = world.system.vehicle.rotor_speed_min
    world.load(np.ones(world.num_envs, bool))


def flight(fast: bool) -> Result:
    """From the ground with slack cables to hover and around the circle at 0.2 and 0.4 rad/s, in one flight."""
    result = Result()
    for rig in LIMITS:
        run = fly_rig(rig, make_plan((0.25, 0.5) if fast else (1.0, 1.0)))
        _add_take_off(result, f"take-off, {rig}", run)
        _add_circles(result, rig, run)
        result.plots += [_take_off_plot(rig, run), _error_plot(rig, run), _path_plot(rig, run)]
    return result


def flight_in_wind(fast: bool) -> Result:
    """The same flight in 5 m/s of wind with its turbulence, with and without rejection of disturbances (`indi`)."""
    plan = make_plan((0.25, 0.5) if fast else (1.0, 1.0))
    caption = "Mean position error of the drones in 5 m/s of wind with turbulence, with and without rejection."
    plot = Plot("flight_in_wind", "the flight in wind", "time [s]", "error [cm]", caption=caption)
    plot.shade(plan.phases("fast circle"))
    result = Result(plots=[plot])
    for rig in LIMITS:
        for kind in ("indi", "none"):
            wind = {"wind__velocity": [_WIND, 0.0, 0.0], "wind__turbulence": True}
            run = fly_rig(rig, plan, control__disturbance=kind, **wind)
            for phase, rate in zip(_CIRCLES, plan.rates, strict=True):
                during = plan.during(phase, run.time)
                name = f"in wind, {rig}, {rate:g} rad/s, {kind}"
                error = float(run.drone_error[during].mean(axis=0).max())
                quantity = "mean position error [m] of the drone with the largest"
                result.check(name, quantity, error, 0.03 if kind == "indi" else np.inf)
                result.check(name, "mean payload error [m]", float(run.payload_error[during, 0].mean()))
            shown = run.time >= plan.start("climb")
            plot.add(f"{rig}, {kind}", run.time[shown], 100 * run.drone_error[shown].mean(axis=1))
    return result


def _add_take_off(result: Result, name: str, run: Flight) -> None:
    plan = run.plan
    time = run.time
    rest = plan.during("rest", time) & (time > 1.0)
    hover = plan.during("hover", time)
    bodies = np.concatenate([run.payload[rest, :1], run.drones[rest]], axis=1)
    drift = float(np.linalg.norm(np.ptp(bodies, axis=0), axis=1).max())
    result.check(name, "motion of payload and drones at rest on the ground [m]", drift, 1e-4)
    slack = float(run.tension[time < plan.start("tighten") - 0.5].max())
    result.check(name, "largest tension until the cables come taut [N]", slack, 0.0)
    static = np.linalg.norm(run.system.formation_force, axis=1)
    peak = float((run.tension[time < plan.start("gather")] / static).max())
    result.at_most(name, "peak tension over the static one, excess over 2", 1.0, peak, peak - 2.0)
    over = float((run.payload[hover, 0, 2] - HEIGHT).max())
    quantity = "payload's altitude [m] at its highest after take-off, overshoot"
    result.rows.append(Row(name, quantity, HEIGHT, HEIGHT + over, max(0.0, over), _OVERSHOOT))
    over = float((run.drones[hover] - run.planned.position[hover])[..., 2].max())
    quantity = "a drone's altitude above its reference [m] after take-off, largest"
    result.rows.append(Row(name, quantity, 0.0, over, max(0.0, over), _OVERSHOOT))
    result.check(name, "a drone off its path in any phase [m], largest", float(run.drone_error.max()), _OVERSHOOT)
    largest = float(run.payload_error[:, 0].max())
    result.check(name, "the payload off its path in any phase [m], largest", largest, _OVERSHOOT)


def _add_circles(result: Result, rig: str, run: Flight) -> None:
    for phase, rate, limit in zip(_CIRCLES, run.plan.rates, LIMITS[rig], strict=True):
        during = run.plan.during(phase, run.time)
        name = f"circle, {rig}, {rate:g} rad/s"
        error = float(run.drone_error[during].mean(axis=0).max())
        result.check(name, "mean position error [m] of the drone with the largest", error, limit)
        yaw = np.abs(run.yaw_error[during])
        result.check(name, "mean yaw error [deg] of the drone with the largest", float(yaw.mean(axis=0).max()), 0.1)
        result.check(name, "largest yaw error [deg]", float(yaw.max()), 0.3)
        payload, plain = run.payload_error[during].mean(axis=0).tolist()
        quantity = "mean payload error [m]; limit: half of that with the weight alone fed forward"
        result.check(name, quantity, payload, 0.5 * plain)


def _take_off_plot(rig: str, run: Flight) -> Plot:
    caption = f"{rig} takes off: altitudes, and the tension of each cable below."
    plot = Plot(f"take_off_{rig}", f"{rig}: take-off", "time [s]", "altitude [m]", "tension [N]", caption=caption)
    plot.shade(run.plan.phases("gather"))
    shown = run.time < run.plan.start("slow circle")
    time = run.time[shown]
    planned = run.planned
    plot.add("drones (mean)", time, run.drones[shown, :, 2].mean(axis=1))
    plot.add("payload", time, run.payload[shown, 0, 2])
    plot.add("references", time, planned.position[shown, :, 2].mean(axis=1), theory=True)
    plot.add("", time, planned.payload[shown, 2], theory=True)
    for n, tension in enumerate(run.tension[shown].T):
        plot.add(f"cable {n}", time, tension, panel=1)
    return plot


def _error_plot(rig: str, run: Flight) -> Plot:
    caption = f"{rig}: position error of each drone and of the payload, yaw error of each drone, over the whole flight."
    plot = Plot(f"flight_error_{rig}", f"{rig}: tracking", "time [s]", "error [mm]", "yaw error [deg]", caption=caption)
    plot.shade(run.plan.phases("fast circle"))
    airborne = run.time >= run.plan.start("climb")
    time = run.time[airborne]
    for n in range(run.system.num_drones):
        plot.add(f"drone {n}", time, 1e3 * run.drone_error[airborne, n])
        plot.add(f"drone {n}", time, run.yaw_error[airborne, n], panel=1)
    plot.add("payload", time, 1e3 * run.payload_error[airborne, 0])
    return plot


def _path_plot(rig: str, run: Flight) -> Plot:
    caption = f"{rig} from above: the payload on its circle, the second time faster, and the drones about it."
    plot = Plot(f"flight_path_{rig}", f"{rig}: path from above", "x [m]", "y [m]", caption=caption)
    plot.figure.set_figheight(4.8)
    plot.panels[0].set_aspect("equal")
    circling = run.time >= run.plan.start("gather")
    for n in range(run.system.num_drones):
        plot.add(f"drone {n}", *run.drones[circling, n, :2].T)
    plot.add("payload", *run.payload[circling, 0, :2].T)
    x, y = run.planned.payload[circling, :2].T
    plot.add("payload's path", x, y, theory=True)
    return plot
