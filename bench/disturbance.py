"""Drones' errors in wind and with a wrong payload mass, for each `control.disturbance`.

    python bench/disturbance.py [rigs=falcon4] [seconds=30] [any configuration key]

A team hovers, then flies a circle of 5 m with its yaw along the path, at 0.2 and at 0.4 rad/s (1 and 2 m/s). The drones
follow references with all derivatives and feed forward the nominal load and drag; the payload is not controlled.
Printed are the mean position errors of the drones over the last `seconds`, and in brackets the payload's; then the
decay rate of a swing of the payload. `rigs` may name several, as rigs=falcon4,report4.
"""

from __future__ import annotations

import sys

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config, parse_overrides
from multilift_marl.control.disturbance import REJECTIONS, Disturbance, make_rejection, reset_estimate
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.sim.world import REST_HEIGHT, World

RADIUS = 5.0  # [m]
START, RAMP = 10.0, 6.0  # [s] before errors are counted, and of it to gather speed
CASES = {  # true payload mass over nominal, mean wind [m/s], gust amplitude [m/s] and frequency [rad/s]
    "nominal": (1.0, 0.0, 0.0, 0.0),
    "payload +20 %": (1.2, 0.0, 0.0, 0.0),
    "payload -20 %": (0.8, 0.0, 0.0, 0.0),
    "wind 5 m/s": (1.0, 5.0, 0.0, 0.0),
    "both (+20 %)": (1.2, 5.0, 0.0, 0.0),
    "wind 5 ± 2 m/s, 0.3 rad/s": (1.0, 5.0, 2.0, 0.3),
    "wind 5 ± 2 m/s, 1 rad/s": (1.0, 5.0, 2.0, 1.0),
}


class Flight:
    """Teams of one rig whose drones hold their formation, or follow `reference`.

    Args:
        config: rig and rejection.
        mass: true payload mass over nominal (E,).
    """

    def __init__(self, config: Config, mass: np.ndarray):
        self.system = config.system
        self.dt = 1 / config.sim.control_hz
        self.kind = config.control.disturbance
        e = len(mass)
        n = self.system.num_drones
        self.world = World(self.system, e, 1)
        self.reference = Reference.zeros(e, n)
        self.world.set_parameters(np.ones(e, bool), payload_mass=mass * self.system.payload_mass)
        self.gains = make_gains(config.control, self.system)
        self.cable_force = np.broadcast_to(self.system.hook_force, (e, n, 3)).copy()
        self.slots = self.system.slots + [0, 0, REST_HEIGHT]
        self.reference.position[:] = self.slots
        self.disturbance = Disturbance.zeros(e, n)
        if self.kind != "none":
            self.rejection = make_rejection(config.control, self.system, self.gains, self.dt)
        self.begin()

    def begin(self) -> None:
        """Start from `world.state`."""
        self.world.load(np.ones(self.world.num_envs, bool))
        for e in range(self.world.num_envs):
            reset_estimate(e, self.world.state, self.disturbance)

    def reject(self) -> None:
        """Update the estimates."""
        known = self.world.state, self.reference, self.cable_force
        REJECTIONS[self.kind](0, self.world.num_envs, *known, self.disturbance, self.rejection)

    def step(self) -> None:
        """Simulate one control step."""
        cable_force = self.cable_force
        thrust = self.world.thrust
        if self.kind != "none":
            self.reject()
            cable_force = self.disturbance.cable_force
        fly(0, self.world.num_envs, self.world.state, self.reference, cable_force, thrust, self.gains)
        self.world.step(thrust, self.system.control_interval)


def circle(t: float, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, float]:
    """Return position, velocity, acceleration and jerk (3,) on the circle, yaw and yaw rate at time t [s]."""
    s = min(t / RAMP, 1.0)
    angle = rate * RAMP * (s**4 * (2.5 - 3 * s + s**2)) + rate * max(t - RAMP, 0.0)
    w = rate * s**3 * (10 - 15 * s + 6 * s**2)
    w1 = rate / RAMP * 30 * s**2 * (1 - s) ** 2
    w2 = rate / RAMP**2 * 60 * s * (1 - s) * (1 - 2 * s)
    outward = np.array([np.cos(angle), np.sin(angle), 0])
    along = np.array([-np.sin(angle), np.cos(angle), 0])
    velocity = w * along
    acceleration = w1 * along - w**2 * outward
    jerk = (w2 - w**3) * along - 3 * w * w1 * outward
    return RADIUS * (outward - [1, 0, 0]), RADIUS * velocity, RADIUS * acceleration, RADIUS * jerk, angle, w


def fly_cases(config: Config, rate: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean position errors [m] of the drones and of the payload, (cases,) each.

    Args:
        config: rig and rejection.
        rate: angular velocity on the circle [rad/s]; 0 to hover.
        seconds: how long to measure [s].
    """
    cases = np.array(list(CASES.values()))
    flight = Flight(config, cases[:, 0])
    state = flight.world.state
    reference = flight.reference
    rest = np.array([0, 0, REST_HEIGHT])
    drones = np.zeros(len(cases))
    payload = np.zeros(len(cases))
    counted = 0
    for tick in range(round((START + seconds) / flight.dt)):
        t = tick * flight.dt
        flight.world.hidden_loads.wind[:, 0] = cases[:, 1] + cases[:, 2] * np.sin(cases[:, 3] * t)
        position, velocity, acceleration, jerk, yaw, yaw_rate = circle(t, rate)
        reference.position[:] = flight.slots + position
        reference.velocity[:] = velocity
        reference.acceleration[:] = acceleration
        reference.jerk[:] = jerk
        reference.yaw[:] = yaw
        reference.yaw_rate[:] = yaw_rate
        if t >= START:
            drones += np.linalg.norm(state.drone_position - reference.position, axis=-1).mean(axis=1)
            payload += np.linalg.norm(state.payload_position - rest - position, axis=-1)
            counted += 1
        flight.step()
    if flight.world.diverged.any():
        raise RuntimeError(
            f"{flight.kind} at {rate:g} rad/s has diverged: {list(CASES)[flight.world.diverged.argmax()]}"
        )
    return drones / counted, payload / counted


def swing_decay(config: Config, seconds: float) -> np.ndarray:
    """Return the least decay rate [1/s] of swings of payloads of 0.8, 1 and 1.2 of the nominal mass, (3,).

    They start at 0.3 m/s and 0.3 rad/s, about either axis; counted from 6 s on, `seconds` long.
    """
    flight = Flight(config, np.array([0.8, 1.0, 1.2] * 2))
    state = flight.world.state
    state.payload_velocity[:3, 0] = state.payload_velocity[3:, 1] = 0.3
    if flight.system.payload_shape != "point":
        state.payload_body_rates[:3, 2] = state.payload_body_rates[3:, 0] = 0.3
    flight.begin()

    def most(duration: float) -> np.ndarray:
        speed = np.zeros(6)
        for _ in range(round(duration / flight.dt)):
            flight.step()
            spin = np.linalg.norm(state.payload_body_rates, axis=1) * (flight.system.payload_shape != "point")
            speed = np.maximum(speed, np.linalg.norm(state.payload_velocity, axis=1) + 0.2 * spin)
        return speed

    most(4.0)
    early = most(2.0)
    most(seconds)
    late = most(2.0)
    return np.log(early / late).reshape(2, 3).min(axis=0) / (seconds + 2.0)


def main(arguments: list[str]) -> None:
    """Measure and print two tables for each rig."""
    values = parse_overrides(arguments)
    seconds = float(values.pop("seconds", 30.0))
    for rig in str(values.pop("rigs", "falcon4")).split(","):
        options = {"control.drag_feedforward": True} | values
        configs = {
            kind: load_config(f"rigs/{rig}", options | {"control.disturbance": kind}) for kind in ("none", *REJECTIONS)
        }
        print(f"\n{rig}: drones' error [cm], mean over {seconds:g} s (payload's)\n")
        columns = [(rate, kind) for rate in (0.0, 0.2, 0.4) for kind in configs]
        print("| | " + " | ".join(f"{f'{rate:g} rad/s' if rate else 'hover'}, {kind}" for rate, kind in columns) + " |")
        print("|---" * (len(columns) + 1) + "|")
        errors = [fly_cases(configs[kind], rate, seconds) for rate, kind in columns]
        for i, case in enumerate(CASES):
            cells = [f"{100 * drones[i]:.2f} ({100 * payload[i]:.1f})" for drones, payload in errors]
            print(f"| {case} | " + " | ".join(cells) + " |")
        print(f"\n{rig}: decay of a swing [1/s] with 0.8, 1, 1.2 of the payload's mass\n")
        for kind, config in configs.items():
            print(f"| {kind} | " + ", ".join(f"{rate:.2f}" for rate in swing_decay(config, seconds / 3)) + " |")


if __name__ == "__main__":
    main(sys.argv[1:])
