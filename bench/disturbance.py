"""How far wind and a payload heavier than thought move the drones, with each `control.disturbance`.

    python bench/disturbance.py [rigs=falcon4] [seconds=30] [any configuration key]

A team hovers, then flies a circle of 5 m with its yaw along the path, at 0.2 and at 0.4 rad/s (1 and 2 m/s). The drones
are told where to be, with all derivatives, and feed forward the nominal load and drag; the payload is not controlled.
Printed are the mean distances of the drones from their places over the last `seconds`, and below them the payload's
from its own. `rigs` may name several, as rigs=falcon4,report4.
"""

from __future__ import annotations

import sys

import numpy as np

from multilift_marl.config import Config, load_config, parse_overrides
from multilift_marl.control.disturbance import REJECTIONS, Disturbance, forget, make_rejection
from multilift_marl.control.formation import Reference
from multilift_marl.control.geometric import fly, make_gains
from multilift_marl.sim.world import REST_HEIGHT, World

RADIUS = 5.0  # [m]
START = 10.0  # [s] to gather speed and settle in the wind, not counted
CASES = {  # true payload mass over nominal, mean wind [m/s], gust amplitude [m/s] and frequency [rad/s]
    "nominal": (1.0, 0.0, 0.0, 0.0),
    "payload +20 %": (1.2, 0.0, 0.0, 0.0),
    "payload -20 %": (0.8, 0.0, 0.0, 0.0),
    "wind 5 m/s": (1.0, 5.0, 0.0, 0.0),
    "both (+20 %)": (1.2, 5.0, 0.0, 0.0),
    "wind 5 ± 2 m/s, 0.3 rad/s": (1.0, 5.0, 2.0, 0.3),
    "wind 5 ± 2 m/s, 1 rad/s": (1.0, 5.0, 2.0, 1.0),
}


def circle(t: float, rate: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float, float]:
    """Return position, velocity, acceleration and jerk (3,) on the circle, yaw and yaw rate at time t [s]."""
    s = min(t / (0.6 * START), 1.0)
    ramp = 0.6 * START
    angle = rate * ramp * (s**4 * (2.5 - 3 * s + s**2)) + rate * max(t - ramp, 0.0)
    w = rate * s**3 * (10 - 15 * s + 6 * s**2)
    w1 = rate / ramp * 30 * s**2 * (1 - s) ** 2
    w2 = rate / ramp**2 * 60 * s * (1 - s) * (1 - 2 * s)
    outward, along = np.array([np.cos(angle), np.sin(angle), 0]), np.array([-np.sin(angle), np.cos(angle), 0])
    return (
        RADIUS * (outward - [1, 0, 0]),
        RADIUS * w * along,
        RADIUS * (w1 * along - w**2 * outward),
        RADIUS * ((w2 - w**3) * along - 3 * w * w1 * outward),
        angle,
        w,
    )


def fly_cases(config: Config, rate: float, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return mean distances from their places [m] of the drones and of the payload, (cases,) each.

    Args:
        config: rig and rejection.
        rate: angular velocity on the circle [rad/s]; 0 to hover.
        seconds: how long to measure [s].
    """
    system, dt, cases = config.system, 1 / config.sim.control_hz, np.array(list(CASES.values()))
    e, n = len(cases), system.num_drones
    world = World(system, e, 1)
    world.set_payload_mass(np.ones(e, bool), cases[:, 0] * system.payload_mass)
    gains = make_gains(config.control, system)
    state, reference, kind = world.state, Reference.zeros(e, n), config.control.disturbance
    flown = pull = np.broadcast_to(system.drone_pull, (e, n, 3)).copy()
    if kind != "none":
        disturbance, rejection = Disturbance.zeros(e, n), make_rejection(config.control, system, gains, dt)
        for i in range(e):
            forget(i, state, disturbance, rejection.thrust_coefficient)
        flown = disturbance.pull
    slots, rest = system.slots + [0, 0, REST_HEIGHT], np.array([0, 0, REST_HEIGHT])
    drones, payload, counted = np.zeros(e), np.zeros(e), 0
    for tick in range(round((START + seconds) / dt)):
        t = tick * dt
        world.plant.wind[:, 0] = cases[:, 1] + cases[:, 2] * np.sin(cases[:, 3] * t)
        position, velocity, acceleration, jerk, yaw, yaw_rate = circle(t, rate)
        reference.position[:], reference.velocity[:] = slots + position, velocity
        reference.acceleration[:], reference.jerk[:] = acceleration, jerk
        reference.yaw[:], reference.yaw_rate[:] = yaw, yaw_rate
        if t >= START:
            drones += np.linalg.norm(state.drone_position - reference.position, axis=-1).mean(axis=1)
            payload += np.linalg.norm(state.payload_position - rest - position, axis=-1)
            counted += 1
        if kind != "none":
            REJECTIONS[kind](0, e, state, reference, pull, disturbance, gains, rejection)
        fly(0, e, state, reference, flown, world.thrust, gains)
        world.step(world.thrust, system.control_interval)
    if world.diverged.any():
        raise RuntimeError(f"{kind} at {rate:g} rad/s: {list(CASES)[int(world.diverged.argmax())]} has diverged")
    return drones / counted, payload / counted


def main(arguments: list[str]) -> None:
    """Measure and print a table for each rig."""
    values = parse_overrides(arguments)
    seconds = float(values.pop("seconds", 30.0))
    for rig in str(values.pop("rigs", "falcon4")).split(","):
        told = {"control.drag_feedforward": True} | values
        configs = {
            kind: load_config(f"rigs/{rig}", told | {"control.disturbance": kind}) for kind in ("none", *REJECTIONS)
        }
        print(f"\n{rig}: drones' error [cm], mean over {seconds:g} s (payload's)\n")
        columns = [(rate, kind) for rate in (0.0, 0.2, 0.4) for kind in configs]
        print("| | " + " | ".join(f"{f'{rate:g} rad/s' if rate else 'hover'}, {kind}" for rate, kind in columns) + " |")
        print("|---" * (len(columns) + 1) + "|")
        flown = [fly_cases(configs[kind], rate, seconds) for rate, kind in columns]
        for i, case in enumerate(CASES):
            cells = [f"{100 * drones[i]:.2f} ({100 * payload[i]:.1f})" for drones, payload in flown]
            print(f"| {case} | " + " | ".join(cells) + " |")


if __name__ == "__main__":
    main(sys.argv[1:])
