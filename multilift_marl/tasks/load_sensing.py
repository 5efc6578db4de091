"""What each drone knows of the payload, by the level of `env.sensing`.

`mocap`: cameras tell all drones one pose of the payload. `onboard`: a drone measures where its own cable points and how
strongly it pulls, and takes the cable to be as long, and the payload as level, as planned. `blind`: it measures nothing
of the load, and takes its cable to hang as in the resting formation. Velocities follow by an alpha-beta filter
(Kalata, IEEE TAES 20(2), 1984).
"""

from __future__ import annotations

from collections.abc import Callable
from math import radians, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel, prebind
from multilift_marl.control.formation import Goal, Rig, goal_hook
from multilift_marl.math3d import (
    add,
    mat,
    matmul,
    matrow,
    mul,
    norm,
    put,
    putmat,
    rotation_vector,
    row,
    scale,
    sub,
    tmul,
    transpose,
    turn_by,
    unit,
    vec,
)
from multilift_marl.sim.gusts import normal_pair, normal_vector
from multilift_marl.sim.state import SystemState

Call = Callable[[int, int], None]  # of environments lo to hi


class Load(NamedTuple):
    """The payload as drones know it: L = 1 for all, or L = N, each drone its own."""

    position: np.ndarray
    """(E, L, 3) centre of mass as configured [m]."""
    rotation: np.ndarray
    """(E, L, 3, 3) body to world."""
    velocity: np.ndarray
    """(E, L, 3) [m/s]."""
    body_rates: np.ndarray
    """(E, L, 3) body frame [rad/s]."""
    tension: np.ndarray
    """(E, N) of each drone's cable [N]."""


def true_load(state: SystemState) -> Load:
    """Return the true payload, the same for all drones; live."""
    return Load(
        state.payload_position[:, None], state.payload_rotation[:, None], state.payload_velocity[:, None],
        state.payload_body_rates[:, None], state.cable_tension,
    )  # fmt: skip


class LoadMemory(NamedTuple):
    """What the sensors of the payload remember."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    offset: np.ndarray
    """(E, N, 3) of a cable's direction, body frame of its drone [rad]."""
    tension_offset: np.ndarray
    """(E, N) over the tension at rest [-]."""


class LoadSensor(NamedTuple):
    """Numbers of the sensors of the payload; standard deviations are of one sample."""

    dt: float
    """From one sample to the next [s]."""
    delay: float = 0.0
    """Of a pose [s]."""
    position: float = 0.0
    """Of a position [m]."""
    rotation: float = 0.0
    """Of an attitude [rad]."""
    direction: float = 0.0
    """Of a cable's direction, of its white noise and of its offset alike [rad]."""
    tension: float = 0.0
    """Of a tension over that at rest; the offset is twice that [-]."""
    follow: tuple[float, float] = (1.0, 0.0)
    """Alpha and beta of positions."""
    turn: tuple[float, float] = (1.0, 0.0)
    """Alpha and beta of attitudes."""


class Scene(NamedTuple):
    """What the sensors of the payload are about."""

    true: SystemState
    own: SystemState
    """What the drones know of themselves."""
    planned: Goal
    """About which they fly."""
    rig: Rig
    resting_tension: np.ndarray
    """(N,) [N]."""
    memory: LoadMemory
    sensor: LoadSensor


ACCELERATION, ANGULAR_ACCELERATION = 2.0, 10.0  # [m/s²], [rad/s²] assumed standard deviations, Kalata's σ_w


def alpha_beta(maneuver: float, noise: float, dt: float) -> tuple[float, float]:
    """Return the steady gains of a filter of position and velocity (Kalata 1984).

    Args:
        maneuver: standard deviation of the acceleration between samples.
        noise: of a measured position.
        dt: from one sample to the next [s].
    """
    index = maneuver * dt**2 / noise
    r = (4 + index - sqrt(8 * index + index**2)) / 4
    alpha = 1 - r**2
    return alpha, 2 * (2 - alpha) - 4 * sqrt(1 - alpha)


def make_sensor(level: str, dt: float, length: float) -> LoadSensor:
    """Return the sensors of a level.

    Args:
        level: of `env.sensing`, not "ideal".
        dt: a policy step [s].
        length: of the cables [m].
    """
    if level == "mocap":  # as for the drones: 1 mm, 0.2°, 8 ms
        place, turned = 1e-3, radians(0.2)
        gains = alpha_beta(ACCELERATION, place, dt), alpha_beta(ANGULAR_ACCELERATION, turned, dt)
        return LoadSensor(dt, 0.008, place, turned, follow=gains[0], turn=gains[1])
    if level == "onboard":  # an encoder at the hook, a load cell of 1 %
        direction = 5e-3
        return LoadSensor(
            dt, direction=direction, tension=0.01, follow=alpha_beta(ACCELERATION, direction * length, dt)
        )
    assert level == "blind", level
    return LoadSensor(dt)


class LoadSensing:
    """The payload of E teams as their drones know it.

    Args:
        level: of `env.sensing`, not "ideal".
        true, own: the true state, and that which the drones know of themselves.
        dt: a policy step [s].
        length: of the cables, the mean [m].

    Attributes:
        load: Load.
    """

    def __init__(self, level: str, true: SystemState, own: SystemState, dt: float, length: float):
        e, n = true.cable_tension.shape
        rows = 1 if level == "mocap" else n
        self._level, self._true, self._own = level, true, own
        self.load = Load(
            np.zeros((e, rows, 3)), np.tile(np.eye(3), (e, rows, 1, 1)), np.zeros((e, rows, 3)),
            np.zeros((e, rows, 3)), np.zeros((e, n)),
        )  # fmt: skip
        self._memory = LoadMemory(np.zeros(e, np.uint64), np.zeros((e, n, 3)), np.zeros((e, n)))
        self._sensor = make_sensor(level, dt, length)

    def start(self, env: int, seed: np.random.SeedSequence) -> None:
        """Begin an episode of one environment: draw offsets."""
        memory = self._memory
        memory.generator[env] = seed.generate_state(1, np.uint64)[0]
        draw_offsets(env, memory, self._sensor)

    def bind(self, planned: Goal, rig: Rig, resting_tension: np.ndarray, first: bool) -> Call:
        """Return the call of (lo, hi) that measures the payload; `first` of an episode, without a past to filter."""
        see = {"mocap": see_payload, "onboard": see_cable, "blind": suppose_cable}[self._level]
        scene = Scene(self._true, self._own, planned, rig, resting_tension, self._memory, self._sensor)
        return prebind(see, scene, self.load, first)

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the live arrays that outlive a step."""
        arrays = {f"load_{name}": array for name, array in self.load._asdict().items()}
        return arrays | {f"load_sensor_{name}": array for name, array in self._memory._asdict().items()}


@kernel
def draw_offsets(e, memory, sensor):
    """Draw the offsets of environment e."""
    for n in range(memory.offset.shape[1]):
        put(memory.offset[e, n], scale(sensor.direction, normal_vector(e, memory)))
        memory.tension_offset[e, n] = 2.0 * sensor.tension * normal_pair(e, memory)[0]


@kernel
def _follow(e, k, place, velocity, load, sensor, first):
    """Let position and velocity of row k follow a measured position; `first` they are what is given."""
    if first:
        put(load.position[e, k], place)
        put(load.velocity[e, k], velocity)
        return
    alpha, beta = sensor.follow
    expected = add(vec(load.position, e, k), scale(sensor.dt, vec(load.velocity, e, k)))
    gap = sub(place, expected)
    put(load.position[e, k], add(expected, scale(alpha, gap)))
    put(load.velocity[e, k], add(vec(load.velocity, e, k), scale(beta / sensor.dt, gap)))


@kernel
def see_payload(lo, hi, scene, load, first):
    """Measure the payload's pose by cameras: `mocap`.

    Args:
        lo, hi: the environments.
        scene: Scene; the generators of its memory advance.
        load: Load, written.
        first: whether an episode begins.
    """
    true, memory, sensor = scene.true, scene.memory, scene.sensor
    for e in range(lo, hi):
        # The pose of `delay` ago, to first order in it.
        velocity, attitude = row(true.payload_velocity, e), matrow(true.payload_rotation, e)
        place = sub(row(true.payload_position, e), scale(sensor.delay, velocity))
        place = add(place, scale(sensor.position, normal_vector(e, memory)))
        spin = mul(attitude, row(true.payload_body_rates, e))
        off = sub(scale(sensor.rotation, normal_vector(e, memory)), scale(sensor.delay, spin))
        measured = turn_by(off, attitude)

        _follow(e, 0, place, velocity, load, sensor, first)
        if first:
            putmat(load.rotation[e, 0], measured)
            put(load.body_rates[e, 0], row(true.payload_body_rates, e))
        else:
            # The same filter for attitude and angular velocity, in the world frame.
            alpha, beta = sensor.turn
            spin = mul(mat(load.rotation, e, 0), vec(load.body_rates, e, 0))
            expected = turn_by(scale(sensor.dt, spin), mat(load.rotation, e, 0))
            gap = rotation_vector(matmul(measured, transpose(expected)))
            corrected = turn_by(scale(alpha, gap), expected)
            putmat(load.rotation[e, 0], corrected)
            put(load.body_rates[e, 0], tmul(corrected, add(spin, scale(beta / sensor.dt, gap))))
        for n in range(load.tension.shape[1]):
            load.tension[e, n] = scene.resting_tension[n]


@kernel
def see_cable(lo, hi, scene, load, first):
    """Measure direction and tension of each drone's own cable: `onboard`. Arguments are those of `see_payload`."""
    true, own, rig, memory, sensor = scene.true, scene.own, scene.rig, scene.memory, scene.sensor
    for e in range(lo, hi):
        payload, payload_attitude = row(true.payload_position, e), matrow(true.payload_rotation, e)
        for n in range(load.tension.shape[1]):
            # Direction from hook to anchor in the body frame, and the tension.
            attitude, hook = mat(true.drone_rotation, e, n), row(rig.drones.hooks, n)
            anchor = add(payload, mul(payload_attitude, row(rig.anchors, n)))
            along = unit(sub(tmul(attitude, sub(anchor, vec(true.drone_position, e, n))), hook))
            off = add(vec(memory.offset, e, n), scale(sensor.direction, normal_vector(e, memory)))
            along = unit(add(along, off))
            off_tension = memory.tension_offset[e, n] + sensor.tension * normal_pair(e, memory)[0]
            load.tension[e, n] = max(true.cable_tension[e, n] + off_tension * scene.resting_tension[n], 0.0)
            if true.cable_tension[e, n] == 0.0 and not first:  # slack or broken: it points nowhere
                put(load.position[e, n], add(vec(load.position, e, n), scale(sensor.dt, vec(load.velocity, e, n))))
                continue

            # The anchor is a nominal length along it; the payload as it is planned to stand about its anchor.
            reach = norm(_planned_cable(e, n, scene))
            arm = mul(mat(own.drone_rotation, e, n), add(hook, scale(reach, along)))
            _place(e, n, add(vec(own.drone_position, e, n), arm), scene, load, first)


@kernel
def suppose_cable(lo, hi, scene, load, first):
    """Suppose each cable as in the resting formation: `blind`. Arguments are those of `see_payload`."""
    own, rig = scene.own, scene.rig
    for e in range(lo, hi):
        for n in range(load.tension.shape[1]):
            load.tension[e, n] = scene.resting_tension[n]
            hook = mul(mat(own.drone_rotation, e, n), row(rig.drones.hooks, n))
            arm = sub(hook, _planned_cable(e, n, scene))
            _place(e, n, add(vec(own.drone_position, e, n), arm), scene, load, True)


@kernel
def _planned_cable(e, n, scene):
    """Return the cable from anchor to hook at rest at the planned pose, world frame [m]."""
    planned, rig = scene.planned, scene.rig
    anchor = add(row(planned.position, e), mul(matrow(planned.rotation, e), row(rig.anchors, n)))
    return sub(goal_hook(e, n, planned, rig), anchor)


@kernel
def _place(e, n, anchor, scene, load, first):
    """Write the payload that has drone n's anchor at a place [m], at the planned attitude and at rest in it."""
    # It is the anchor that is followed: the planned attitude may leap.
    arm = row(scene.rig.anchors, n)
    put(load.position[e, n], add(vec(load.position, e, n), mul(mat(load.rotation, e, n), arm)))
    _follow(e, n, anchor, vec(scene.own.drone_velocity, e, n), load, scene.sensor, first)
    attitude = matrow(scene.planned.rotation, e)
    put(load.position[e, n], sub(vec(load.position, e, n), mul(attitude, arm)))
    putmat(load.rotation[e, n], attitude)
    put(load.body_rates[e, n], (0.0, 0.0, 0.0))
