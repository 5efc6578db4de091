"""The report's multi-lift flight (section 4.2): from the ground to hover and around a circle, yaw along it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config
from multilift_marl.control.disturbance import REJECTIONS, Disturbance, make_rejection
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import Gains, make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.rig.system import System
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Curve, Plot, Result, Row
from multilift_marl.validation.trajectory import (
    HEIGHT,
    RADIUS,
    Plan,
    Trajectory,
    make_plan,
    make_trajectory,
    on_the_ground,
)

LIMITS = {"report4": (0.005, 0.010), "falcon4": (0.005, 0.015)}
"""Mean position error of a drone [m] on the circle at 0.2 and 0.4 rad/s, by rig."""
_CIRCLES = ("slow circle", "fast circle")
_OVERSHOOT = 0.1  # [m]
_WIND = 5.0  # [m/s]


class Flight(NamedTuple):
    """What happened over T control steps, and what was planned."""

    plan: Plan
    system: System
    time: np.ndarray
    """(T,) [s]."""
    way: Trajectory
    payload: np.ndarray
    """(T, 3) [m]."""
    drones: np.ndarray
    """(T, N, 3) [m]."""
    tension: np.ndarray
    """(T, N) [N]."""
    yaw_error: np.ndarray
    """(T, N) [deg]."""
    plain_payload: np.ndarray
    """(T, 3) of a second team, which is fed the load's weight alone forward [m]."""

    @property
    def drone_error(self) -> np.ndarray:
        """Distance of each drone from its reference (T, N) [m]."""
        return np.linalg.norm(self.drones - self.way.position, axis=2)

    @property
    def payload_error(self) -> np.ndarray:
        """Distance of the payload from its path (T,) [m]."""
        return np.linalg.norm(self.payload - self.way.payload, axis=1)

    @property
    def plain_error(self) -> np.ndarray:
        """The same with the load's weight alone fed forward (T,) [m]."""
        return np.linalg.norm(self.plain_payload - self.way.payload, axis=1)


def flight(fast: bool) -> Result:
    """From the ground with slack cables to hover and around the circle at 0.2 and 0.4 rad/s, in one flight."""
    result = Result()
    for rig in LIMITS:
        flown = fly_rig(rig, make_plan((0.25, 0.5) if fast else (1.0, 1.0)))
        result.rows += _take_off_rows(rig, flown) + _circle_rows(rig, flown)
        result.plots += [_take_off_plot(rig, flown), _error_plot(rig, flown), _path_plot(rig, flown)]
    return result


def flight_in_wind(fast: bool) -> Result:
    """The same flight in 5 m/s of wind with its turbulence, with and without rejection of disturbances (`indi`)."""
    result = Result()
    caption = "Mean position error of the drones in 5 m/s of wind with turbulence, with and without rejection."
    plot = Plot("flight_in_wind", "the flight in wind", "time [s]", "error [cm]", caption=caption)
    for rig in LIMITS:
        plan = make_plan((0.25, 0.5) if fast else (1.0, 1.0))
        plot.phases = _phases(plan, "fast circle")
        for kind in ("indi", "none"):
            wind = {"wind__velocity": [_WIND, 0.0, 0.0], "wind__turbulence": True}
            flown = fly_rig(rig, plan, control__disturbance=kind, **wind)
            for phase, rate in zip(_CIRCLES, plan.rates, strict=True):
                during, name = plan.during(phase, flown.time), f"in wind, {rig}, {rate:g} rad/s, {kind}"
                error = float(flown.drone_error[during].mean(axis=0).max())
                limit = 0.03 if kind == "indi" else float("inf")
                quantity = "mean position error [m] of the drone with the largest"
                result.rows.append(Row(name, quantity, 0.0, error, error, limit))
                payload = float(flown.payload_error[during].mean())
                result.rows.append(Row(name, "mean payload error [m]", 0.0, payload, payload, float("inf")))
            shown = flown.time >= plan.start[1]
            error = 100 * flown.drone_error[shown].mean(axis=1)
            plot.curves.append(Curve(f"{rig}, {kind}", flown.time[shown], error))
    result.plots.append(plot)
    return result


def fly_rig(rig: str, plan: Plan, **overrides: Any) -> Flight:
    """Fly `plan` with the team of a rig (a configuration in configs/rigs), beside one on plain feed-forward.

    Args:
        rig: its name.
        plan: phases.
        **overrides: configuration values by name, with __ for the dot.
    """
    values = {"control.drag_feedforward": True} | {key.replace("__", "."): value for key, value in overrides.items()}
    config = load_config(f"rigs/{rig}", values)
    system, dt = config.system, 1 / config.sim.control_hz
    time = dt * np.arange(round(plan.end / dt))
    ways = [make_trajectory(system, plan, time, plain) for plain in (False, True)]
    world = World(system, len(ways), 1)
    _put_down(world)
    state, reference = world.state, Reference.zeros(len(ways), system.num_drones)
    cable_force = np.zeros((len(ways), system.num_drones, 3))
    reject = _make_rejection(config, world, reference)
    gains = make_gains(config.control, system)
    gains = gains._replace(load_share=np.zeros(system.num_drones))  # the pulls hold the load's inertia
    payload, drones, tension, yaw_error = [], [], [], []
    for i, t in enumerate(time):
        for e, way in enumerate(ways):
            reference.position[e], reference.velocity[e] = way.position[i], way.velocity[i]
            reference.acceleration[e], reference.jerk[e] = way.acceleration[i], way.jerk[i]
            reference.yaw[e], reference.yaw_rate[e], cable_force[e] = way.yaw[i], way.yaw_rate[i], way.cable_force[i]
        rotation = state.drone_rotation[0]
        turned = np.arctan2(-rotation[:, 0, 1], rotation[:, 1, 1]) - ways[0].yaw[i]
        yaw_error.append(np.rad2deg(np.arctan2(np.sin(turned), np.cos(turned))))
        payload.append(state.payload_position.copy())
        drones.append(state.drone_position[0].copy())
        if t < plan.start[1]:
            world.thrust[:] = 0.0  # at rest the rotors idle
        else:
            fly(0, len(ways), state, reference, reject(cable_force, gains), world.thrust, gains)
        world.step(world.thrust, system.control_interval)
        tension.append(state.cable_tension[0].copy())
    both = np.array(payload)
    flown = np.array(drones), np.array(tension), np.array(yaw_error)
    return Flight(plan, system, time, ways[0], both[:, 0], *flown, both[:, 1])


def _make_rejection(config: Config, world: World, reference: Reference) -> Callable[[np.ndarray, Gains], np.ndarray]:
    """Return what turns nominal pulls (E, N, 3) [N] and gains into the pulls to fly with: the configured rejection."""
    kind = config.control.disturbance
    if kind == "none":
        return lambda cable_force, gains: cable_force
    rejection = make_rejection(
        config.control, world.system, make_gains(config.control, world.system), 1 / config.sim.control_hz
    )
    disturbance = Disturbance.zeros(world.num_envs, world.num_drones)

    def reject(cable_force: np.ndarray, gains: Gains) -> np.ndarray:
        REJECTIONS[kind](0, world.num_envs, world.state, reference, cable_force, disturbance, gains, rejection)
        return disturbance.cable_force

    return reject


def _put_down(world: World) -> None:
    """Put every team on the ground: payload at the start of the circle, drones around it with their rotors idling."""
    height, places = on_the_ground(world.system)
    state = world.state
    state.payload_position[:] = [RADIUS, 0.0, height]
    state.drone_position[:] = places
    state.drone_rotation[:] = [[0, -1, 0], [1, 0, 0], [0, 0, 1]]  # along the circle
    state.rotor_speed[:] = world.system.vehicle.rotor_speed_min
    world.load(np.ones(world.num_envs, bool))


def _take_off_rows(rig: str, flown: Flight) -> list[Row]:
    plan, time, name = flown.plan, flown.time, f"take-off, {rig}"
    rest, hover = plan.during("rest", time) & (time > 1.0), plan.during("hover", time)
    bodies = np.concatenate([flown.payload[rest, None], flown.drones[rest]], axis=1)
    drift = float(np.linalg.norm(np.ptp(bodies, axis=0), axis=1).max())
    rows = [Row(name, "motion of payload and drones at rest on the ground [m]", 0.0, drift, drift, 1e-4)]
    slack = float(flown.tension[time < plan.start[plan.names.index("tighten")] - 0.5].max())
    rows.append(Row(name, "largest tension until the cables come taut [N]", 0.0, slack, slack, 0.0))
    static = np.linalg.norm(flown.system.formation_force, axis=1)
    peak = float((flown.tension[time < plan.start[plan.names.index("gather")]] / static).max())
    rows.append(Row(name, "peak tension over the static one, excess over 2", 1.0, peak, max(0.0, peak - 2.0), 0.0))
    over = float((flown.payload[hover, 2] - HEIGHT).max())
    quantity = "payload's altitude [m] at its highest after take-off, overshoot"
    rows.append(Row(name, quantity, HEIGHT, HEIGHT + over, max(0.0, over), _OVERSHOOT))
    over = float((flown.drones[hover] - flown.way.position[hover])[..., 2].max())
    quantity = "a drone's altitude above its reference [m] after take-off, largest"
    rows.append(Row(name, quantity, 0.0, over, max(0.0, over), _OVERSHOOT))
    for quantity, error in (("a drone", flown.drone_error), ("the payload", flown.payload_error)):
        largest = float(error.max())
        rows.append(Row(name, f"{quantity} off its path in any phase [m], largest", 0.0, largest, largest, _OVERSHOOT))
    return rows


def _circle_rows(rig: str, flown: Flight) -> list[Row]:
    rows = []
    for phase, rate, limit in zip(_CIRCLES, flown.plan.rates, LIMITS[rig], strict=True):
        during, name = flown.plan.during(phase, flown.time), f"circle, {rig}, {rate:g} rad/s"
        error = float(flown.drone_error[during].mean(axis=0).max())
        rows.append(Row(name, "mean position error [m] of the drone with the largest", 0.0, error, error, limit))
        yaw = np.abs(flown.yaw_error[during])
        mean, largest = float(yaw.mean(axis=0).max()), float(yaw.max())
        rows.append(Row(name, "mean yaw error [deg] of the drone with the largest", 0.0, mean, mean, 0.1))
        rows.append(Row(name, "largest yaw error [deg]", 0.0, largest, largest, 0.3))
        payload, plain = float(flown.payload_error[during].mean()), float(flown.plain_error[during].mean())
        quantity = "mean payload error [m]; limit: half of that with the weight alone fed forward"
        rows.append(Row(name, quantity, 0.0, payload, payload, 0.5 * plain))
    return rows


def _phases(plan: Plan, until: str) -> list[tuple[str, float, float]]:
    last = plan.names.index(until) + 1
    ends = (*plan.start[1:], plan.end)
    return list(zip(plan.names[:last], plan.start[:last], ends[:last], strict=True))


def _take_off_plot(rig: str, flown: Flight) -> Plot:
    shown = flown.time < flown.plan.start[flown.plan.names.index("slow circle")]
    time, phases = flown.time[shown], _phases(flown.plan, "gather")
    cable_force = Plot(f"tension_{rig}", "", "time [s]", "tension [N]", phases=phases)
    for n in range(flown.system.num_drones):
        cable_force.curves.append(Curve(f"cable {n}", time, flown.tension[shown, n]))
    caption = f"{rig} takes off: altitudes, and the tension of each cable below."
    plot = Plot(f"take_off_{rig}", f"{rig}: take-off", "time [s]", "altitude [m]", caption=caption, phases=phases)
    plot.below = cable_force
    plot.curves.append(Curve("drones (mean)", time, flown.drones[shown, :, 2].mean(axis=1)))
    plot.curves.append(Curve("payload", time, flown.payload[shown, 2]))
    plot.curves.append(Curve("references", time, flown.way.position[shown, :, 2].mean(axis=1), theory=True))
    plot.curves.append(Curve("", time, flown.way.payload[shown, 2], theory=True))
    return plot


def _error_plot(rig: str, flown: Flight) -> Plot:
    phases, airborne = _phases(flown.plan, "fast circle"), flown.time >= flown.plan.start[1]
    yaw = Plot(f"yaw_{rig}", "", "time [s]", "yaw error [deg]", phases=phases)
    caption = f"{rig}: position error of each drone and of the payload, yaw error of each drone, over the whole flight."
    plot = Plot(f"flight_error_{rig}", f"{rig}: tracking", "time [s]", "error [mm]", caption=caption, phases=phases)
    plot.below = yaw
    time = flown.time[airborne]
    for n in range(flown.system.num_drones):
        plot.curves.append(Curve(f"drone {n}", time, 1e3 * flown.drone_error[airborne, n]))
        yaw.curves.append(Curve(f"drone {n}", time, flown.yaw_error[airborne, n]))
    plot.curves.append(Curve("payload", time, 1e3 * flown.payload_error[airborne]))
    return plot


def _path_plot(rig: str, flown: Flight) -> Plot:
    caption = f"{rig} from above: the payload on its circle, the second time faster, and the drones about it."
    plot = Plot(f"flight_path_{rig}", f"{rig}: path from above", "x [m]", "y [m]", caption=caption, equal=True)
    circling = flown.time >= flown.plan.start[flown.plan.names.index("gather")]
    for n in range(flown.system.num_drones):
        plot.curves.append(Curve(f"drone {n}", *flown.drones[circling, n, :2].T))
    plot.curves.append(Curve("payload", *flown.payload[circling, :2].T))
    x, y = flown.way.payload[circling, :2].T
    plot.curves.append(Curve("payload's path", x, y, theory=True))
    return plot
