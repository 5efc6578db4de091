"""The report's multi-lift flight (section 4.2): a team flies a circle of 5 m, every drone's yaw along its path."""

from __future__ import annotations

import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.config.system import System
from multilift_marl.control.formation import Reference
from multilift_marl.control.geometric import fly, make_gains
from multilift_marl.sim.world import REST_HEIGHT, World
from multilift_marl.validation.experiment import Curve, Plot, Result, Row

RADIUS = 5.0  # [m]
_HOVER, _RAMP = 2.0, 6.0  # [s] at rest, and from rest to the full angular velocity
_DIFFERENCE = 0.01  # [s] between samples of the path that are differentiated
_LIMITS = {  # mean position error of the drones [m] by rig and angular velocity [rad/s]
    ("report4", 0.2): 0.005,
    ("report4", 0.4): 0.010,
    ("falcon4", 0.2): 0.005,
    ("falcon4", 0.4): 0.015,
}


def circle(fast: bool) -> Result:
    """Two rigs on the circle at 0.2 and 0.4 rad/s, 1 and 2 m/s, beside plain feed-forward of the load's weight."""
    result = Result()
    above = Plot("circle_path", "falcon4 on the circle, 0.4 rad/s", "x [m]", "y [m]", equal=True)
    plot = Plot("circle_error", "mean position error of the drones", "time [s]", "error [mm]")
    for (rig, rate), limit in _LIMITS.items():
        flight = fly_circle(rig, rate, laps=0.5 if fast else 1.0)
        name = f"circle, {rig}, {rate:g} rad/s"
        steady = flight["time"] > _HOVER + _RAMP + 2.0
        error = flight["drone_error"][steady]
        result.rows.append(Row(name, "mean position error of the drones [m]", 0.0, error.mean(), error.mean(), limit))
        yaw = np.abs(flight["yaw_error"][steady])
        result.rows.append(Row(name, "mean yaw error [deg]", 0.0, yaw.mean(), yaw.mean(), 0.1))
        result.rows.append(Row(name, "largest yaw error [deg]", 0.0, yaw.max(), yaw.max(), 0.3))
        payload = flight["payload_error"][steady].mean()
        plain = fly_circle(rig, rate, laps=0.5 if fast else 1.0, plain=True)["payload_error"][steady].mean()
        quantity = "mean payload error [m]; limit: half of that with the weight alone fed forward"
        result.rows.append(Row(name, quantity, 0.0, payload, payload, 0.5 * plain))
        whole = np.abs(flight["drone_error"]).max()
        result.rows.append(Row(name, "largest position error, all phases [m]", 0.0, whole, whole, 0.1))
        plot.curves.append(Curve(f"{rig}, {rate:g} rad/s", flight["time"], 1e3 * flight["drone_error"].mean(axis=1)))
    for label, path in (("payload", flight["payload"]), ("drone 0", flight["drones"][:, 0])):
        above.curves.append(Curve(label, path[:, 0], path[:, 1]))
    result.plots += [plot, above]
    return result


def fly_circle(rig: str, rate: float, laps: float, plain: bool = False) -> dict[str, np.ndarray]:
    """Hover, gather speed and fly `laps` of the circle with the team of a rig.

    The load is to follow the circle, level. What its cables must pull at every moment follows from its acceleration,
    where the drones must be follows from the directions of these pulls (the load is flat in the sense of Fliess;
    Sreenath and Kumar, RSS 2013), and both are fed forward.

    Args:
        rig: name of a configuration in configs/rigs.
        rate: angular velocity [rad/s].
        laps: at the full rate.
        plain: feed the load's weight alone forward, with the formation as it is at rest.

    Returns:
        Over T control steps: time (T,) [s], payload (T, 3), drones (T, N, 3) [m], drone_error (T, N) [m] from the
        references, payload_error (T,) [m] from the circle, yaw_error (T, N) [deg].
    """
    config = load_config(f"rigs/{rig}", {"control.drag_feedforward": True})
    system, dt = config.system, 1 / config.sim.control_hz
    world = World(system, 1, 1)
    gains = make_gains(config.control, system)._replace(load_share=np.zeros(system.num_drones))
    start = np.array([RADIUS, 0.0, -REST_HEIGHT])

    def team(t: float) -> tuple[np.ndarray, np.ndarray]:
        """Return positions (N, 3) [m] and pulls (N, 3) [N] that belong to the load's motion."""
        position, acceleration = _along_circle(t, rate)[:2]
        force = system.formation_force
        if not plain:
            force = force + accelerating_forces(system, acceleration)
        tension = np.linalg.norm(force, axis=1, keepdims=True)
        length = system.cable_length[:, None] + tension / system.cable_stiffness[:, None]
        return position - start + system.anchors + length * force / tension, force

    reference = Reference.zeros(1, system.num_drones)
    names = ("time", "payload", "drones", "drone_error", "payload_error", "yaw_error")
    rows: dict[str, list] = {name: [] for name in names}
    for i in range(round((_HOVER + _RAMP + laps * 2 * np.pi / rate) / dt) + 1):
        t = i * dt
        around = [team(t + k * _DIFFERENCE)[0] for k in (-2, -1, 0, 1, 2)]
        slots, velocity, acceleration, jerk = _derivatives(around)
        position, _, yaw, yaw_rate = _along_circle(t, rate)
        reference.position[0], reference.velocity[0] = slots, velocity
        reference.acceleration[0], reference.jerk[0] = acceleration, jerk
        reference.yaw[0], reference.yaw_rate[0] = yaw, yaw_rate
        state = world.state
        rotation = state.drone_rotation[0]
        turned = np.arctan2(-rotation[:, 0, 1], rotation[:, 1, 1]) - yaw
        rows["time"].append(t)
        rows["payload"].append(state.payload_position[0].copy())
        rows["drones"].append(state.drone_position[0].copy())
        rows["drone_error"].append(np.linalg.norm(state.drone_position[0] - slots, axis=1))
        rows["payload_error"].append(np.linalg.norm(state.payload_position[0] - position + start))
        rows["yaw_error"].append(np.rad2deg(np.arctan2(np.sin(turned), np.cos(turned))))
        fly(0, 1, state, reference, team(t)[1][None], world.thrust, gains)
        world.step(world.thrust, system.control_interval)
    return {name: np.array(values) for name, values in rows.items()}


def accelerating_forces(system: System, acceleration: np.ndarray) -> np.ndarray:
    """Return the smallest changes of the cables' pulls (N, 3) [N] that accelerate the load (3,) [m/s²], level."""
    moments = [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in system.anchors]
    balance = np.concatenate([np.tile(np.eye(3), system.num_drones), np.concatenate(np.array(moments), axis=1)])
    wrench = np.concatenate([system.payload_mass * acceleration, np.zeros(3)])
    return (np.linalg.pinv(balance) @ wrench).reshape(-1, 3)


def _derivatives(around: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return value, first, second and third derivative from five samples `_DIFFERENCE` apart."""
    a, b, c, d, e = around
    h = _DIFFERENCE
    first = (a - 8 * b + 8 * d - e) / (12 * h)
    second = (-a + 16 * b - 30 * c + 16 * d - e) / (12 * h**2)
    return c, first, second, (e - 2 * d + 2 * b - a) / (2 * h**3)


def _along_circle(t: float, rate: float) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return position and acceleration (3,) of a point that starts to circle, the drones' yaw and yaw rate."""
    s = np.clip((t - _HOVER) / _RAMP, 0.0, 1.0)
    angle = rate * _RAMP * (s**5 * (7 - 14 * s + 10 * s**2 - 2.5 * s**3)) + rate * max(0.0, t - _HOVER - _RAMP)
    first = rate * s**4 * (35 - 84 * s + 70 * s**2 - 20 * s**3)  # smooth to the third derivative
    second = rate / _RAMP * 140 * s**3 * (1 - s) ** 3
    outward, along = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    return RADIUS * outward, RADIUS * (second * along - first**2 * outward), angle, first
