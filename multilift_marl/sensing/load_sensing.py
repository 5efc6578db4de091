"""What each drone knows of the payload, by the level of `env.sensing`.

`mocap`, `rtk`: cameras tell all drones one pose of the payload. `onboard`: a drone measures where its own cable points
and how strongly it pulls, and takes the cable to be as long, and the payload as level, as planned. `blind`: it measures
nothing of the load, and takes its cable to hang as in the resting formation. Velocities follow by an alpha-beta filter
(Kalata, IEEE TAES 20(2), 1984). Drones that hear of others' anchors fit the payload to all that they know.
"""

from __future__ import annotations

from collections.abc import Callable
from math import radians
from typing import NamedTuple

import numpy as np

from multilift_marl.control.formation import Goal, goal_hook
from multilift_marl.kernels.jit import kernel, prebind
from multilift_marl.math3d import (
    add,
    mat,
    matrow,
    mul,
    norm,
    put,
    putmat,
    row,
    scale,
    sub,
    tmul,
    turn_by,
    unit,
    vec,
)
from multilift_marl.mdp.env_data import Load
from multilift_marl.rig.constants import RigArrays
from multilift_marl.rng import normal_pair, normal_vector
from multilift_marl.sensing.communication import (
    Broadcast,
    Links,
    clear_messages,
    exchange_messages,
    make_messages,
    update_shared_estimate,
)
from multilift_marl.sensing.load_filter import (
    alpha_beta,
    assume_planned,
    follow_attitude,
    follow_position,
    predict_position,
)
from multilift_marl.sim.state import SystemState

Call = Callable[[int, int], None]  # of environments lo to hi


class LoadMemory(NamedTuple):
    """What the sensors of the payload remember."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    offset: np.ndarray
    """(E, N, 3) of a cable's direction, body frame of its drone [rad]."""
    tension_offset: np.ndarray
    """(E, N) over the tension at rest [-]."""
    known: np.ndarray
    """(E, N) bool, whether the drone has had an anchor to go by in the episode."""


CAMERA_DELAY = 0.008  # [s] of a pose by motion capture
CAMERAS = ("mocap", "rtk")  # levels at which cameras measure the payload


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
    rig: RigArrays
    resting_tension: np.ndarray
    """(N,) [N]."""
    anchor: np.ndarray
    """(E, N, 3) where each drone takes its cable to end, of `onboard` and `blind` [m]."""
    knows_anchor: np.ndarray
    """(E, N) whether it does: a slack cable points nowhere, that of `blind` is supposed."""
    memory: LoadMemory
    sensor: LoadSensor


ACCELERATION, ANGULAR_ACCELERATION = 2.0, 10.0  # [m/s²], [rad/s²] assumed standard deviations, Kalata's σ_w
_TURNED = 0.02  # [rad] standard deviation of an attitude that is fitted to anchors, 5 mm of them over 0.25 m


def make_sensor(level: str, dt: float, length: float) -> LoadSensor:
    """Return the sensors of a level.

    Args:
        level: of `env.sensing`, not "ideal".
        dt: a policy step [s].
        length: of the cables [m].
    """
    if level in CAMERAS:  # as for the drones of mocap: 1 mm, 0.2°, 8 ms
        place, turned = 1e-3, radians(0.2)
        gains = alpha_beta(ACCELERATION, place, dt), alpha_beta(ANGULAR_ACCELERATION, turned, dt)
        return LoadSensor(dt, CAMERA_DELAY, place, turned, follow=gains[0], turn=gains[1])
    if level == "onboard":  # an encoder at the hook, a load cell of 1 %
        direction = 5e-3
        gains = alpha_beta(ACCELERATION, direction * length, dt), alpha_beta(ANGULAR_ACCELERATION, _TURNED, dt)
        return LoadSensor(dt, direction=direction, tension=0.01, follow=gains[0], turn=gains[1])
    assert level == "blind", level
    return LoadSensor(dt)


class LoadSensing:
    """The payload of E teams as their drones know it.

    Args:
        level: of `env.sensing`, not "ideal".
        true, own: the true state, and that which the drones know of themselves.
        dt: a policy step [s].
        length: of the cables, the mean [m].
        links: by which drones tell each other of their anchors; None: they do not.

    Attributes:
        load: Load.
    """

    def __init__(
        self, level: str, true: SystemState, own: SystemState, dt: float, length: float, links: Links | None = None
    ):  # fmt: skip
        e, n = true.cable_tension.shape
        rows = 1 if level in CAMERAS else n
        self._level, self._true, self._own = level, true, own
        self.load = Load(
            np.zeros((e, rows, 3)), np.tile(np.eye(3), (e, rows, 1, 1)), np.zeros((e, rows, 3)),
            np.zeros((e, rows, 3)), np.zeros((e, n)),
        )  # fmt: skip
        self._memory = LoadMemory(np.zeros(e, np.uint64), np.zeros((e, n, 3)), np.zeros((e, n)), np.zeros((e, n), bool))
        self._anchor, self._knows_anchor = np.zeros((e, n, 3)), np.ones((e, n), bool)
        self._sensor, self._links = make_sensor(level, dt, length), links
        self._messages = None if links is None else make_messages(e, n, links.delay)

    def start(self, env: int, seed: np.random.SeedSequence) -> None:
        """Begin an episode of one environment: draw offsets."""
        memory = self._memory
        memory.generator[env] = seed.generate_state(1, np.uint64)[0]
        draw_offsets(env, memory, self._sensor)
        if self._messages is not None:
            clear_messages(env, self._messages, seed.spawn(1)[0])

    def bind(self, planned: Goal, rig: RigArrays, resting_tension: np.ndarray, first: bool) -> Call:
        """Return the call of (lo, hi) that measures the payload; `first` of an episode, without a past to filter."""
        scene = self._scene(planned, rig, resting_tension)
        if self._level in CAMERAS:
            return prebind(measure_payload, scene, self.load, first)
        see = prebind(measure_cable if self._level == "onboard" else assume_nominal_cable, scene, self.load, first)
        if self._messages is None:
            stages = [see, prebind(update_own_estimate, scene, self.load, first or self._level == "blind")]
        else:
            sent = Broadcast(self._true.drone_position, self._anchor, self._knows_anchor)
            stages = [see, prebind(exchange_messages, sent, self._links, self._messages, first)]
            stages.append(prebind(update_shared_estimate, scene, self._messages, self.load, first))

        def call(lo: int, hi: int) -> None:
            for stage in stages:
                stage(lo, hi)

        return call

    def _scene(self, planned: Goal, rig: RigArrays, resting_tension: np.ndarray) -> Scene:
        return Scene(
            self._true, self._own, planned, rig, resting_tension, self._anchor, self._knows_anchor, self._memory,
            self._sensor,
        )  # fmt: skip

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the live arrays that outlive a step."""
        arrays = {f"load_{name}": array for name, array in self.load._asdict().items()}
        arrays |= {f"load_sensor_{name}": array for name, array in self._memory._asdict().items()}
        return arrays | (
            {} if self._messages is None else {f"message_{k}": a for k, a in self._messages._asdict().items()}
        )


@kernel
def draw_offsets(e, memory, sensor):
    """Draw the offsets of environment e."""
    for n in range(memory.offset.shape[1]):
        put(memory.offset[e, n], scale(sensor.direction, normal_vector(e, memory)))
        memory.tension_offset[e, n] = 2.0 * sensor.tension * normal_pair(e, memory)[0]


@kernel
def measure_payload(lo, hi, scene, load, first):
    """Measure the payload's pose by cameras: `mocap`, `rtk`.

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
        # By the velocity of now, in place of a store of past poses: 8 ms are short.
        place = sub(row(true.payload_position, e), scale(sensor.delay, velocity))
        place = add(place, scale(sensor.position, normal_vector(e, memory)))
        spin = mul(attitude, row(true.payload_body_rates, e))
        off = sub(scale(sensor.rotation, normal_vector(e, memory)), scale(sensor.delay, spin))
        measured = turn_by(off, attitude)

        follow_position(e, 0, place, velocity, load, sensor, first)
        follow_attitude(e, 0, measured, row(true.payload_body_rates, e), load, sensor, first)
        for n in range(load.tension.shape[1]):
            load.tension[e, n] = scene.resting_tension[n]


@kernel
def measure_cable(lo, hi, scene, load, first):
    """Measure direction and tension of each drone's own cable: `onboard`. Arguments are those of `measure_payload`."""
    true, own, rig, memory, sensor = scene.true, scene.own, scene.rig, scene.memory, scene.sensor
    for e in range(lo, hi):
        payload, payload_attitude = row(true.payload_position, e), matrow(true.payload_rotation, e)
        for n in range(load.tension.shape[1]):
            # Direction from hook to anchor in the body frame, and the tension.
            attitude, hook = mat(true.drone_rotation, e, n), row(rig.hooks, n)
            anchor = add(payload, mul(payload_attitude, row(rig.anchors, n)))
            along = unit(sub(tmul(attitude, sub(anchor, vec(true.drone_position, e, n))), hook))
            # Small angles: an error of a unit vector's components, normalised after. Its part along the cable has no
            # effect.
            off = add(vec(memory.offset, e, n), scale(sensor.direction, normal_vector(e, memory)))
            along = unit(add(along, off))
            off_tension = memory.tension_offset[e, n] + sensor.tension * normal_pair(e, memory)[0]
            load.tension[e, n] = max(true.cable_tension[e, n] + off_tension * scene.resting_tension[n], 0.0)
            # slack or broken: it points nowhere
            scene.knows_anchor[e, n] = true.cable_tension[e, n] > 0.0 and not true.cable_broken[e, n]

            # The anchor is a nominal length along it.
            # Nominal length and stretch at rest: the true length is not known.
            # A planned cable may be slack: of a lowered slot in `regroup`, before `takeoff` and after `land`.
            reach = max(norm(_planned_cable(e, n, scene)), rig.cable_length[n])
            arm = mul(mat(own.drone_rotation, e, n), add(hook, scale(reach, along)))
            put(scene.anchor[e, n], add(vec(own.drone_position, e, n), arm))


@kernel
def assume_nominal_cable(lo, hi, scene, load, first):
    """Suppose each cable as in the resting formation: `blind`. Arguments are those of `measure_payload`."""
    own, rig = scene.own, scene.rig
    for e in range(lo, hi):
        for n in range(load.tension.shape[1]):
            load.tension[e, n] = scene.resting_tension[n]
            hook = mul(mat(own.drone_rotation, e, n), row(rig.hooks, n))
            arm = sub(hook, _planned_cable(e, n, scene))
            put(scene.anchor[e, n], add(vec(own.drone_position, e, n), arm))


@kernel
def _planned_cable(e, n, scene):
    """Return the cable from anchor to hook at rest at the planned pose, world frame [m]."""
    planned, rig = scene.planned, scene.rig
    anchor = add(row(planned.position, e), mul(matrow(planned.rotation, e), row(rig.anchors, n)))
    return sub(goal_hook(e, n, planned, rig), anchor)


@kernel
def update_own_estimate(lo, hi, scene, load, first):
    """Estimate each payload from a drone's own anchor alone, at rest in the planned attitude.

    Without a cable, and before it has ever been taut, a drone takes the payload to be where it is planned to be.
    """
    known = scene.memory.known
    for e in range(lo, hi):
        for n in range(load.tension.shape[1]):
            begins = first or not known[e, n]
            known[e, n] = scene.knows_anchor[e, n] or scene.true.cable_broken[e, n] or not begins
            if scene.true.cable_broken[e, n] or not known[e, n]:
                assume_planned(e, n, scene.planned, load)
                continue
            if not scene.knows_anchor[e, n]:
                predict_position(e, n, load, scene.sensor)
                continue
            # It is the anchor that is followed: the planned attitude may leap.
            arm = row(scene.rig.anchors, n)
            put(load.position[e, n], add(vec(load.position, e, n), mul(mat(load.rotation, e, n), arm)))
            follow_position(
                e, n, vec(scene.anchor, e, n), vec(scene.own.drone_velocity, e, n), load, scene.sensor, begins
            )
            attitude = matrow(scene.planned.rotation, e)
            put(load.position[e, n], sub(vec(load.position, e, n), mul(attitude, arm)))
            putmat(load.rotation[e, n], attitude)
            put(load.body_rates[e, n], (0.0, 0.0, 0.0))
