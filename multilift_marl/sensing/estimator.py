"""What each drone knows of its own state: a filter with fixed gains over its IMU, positioning and magnetometer.

The attitude follows the gyroscope, position and velocity the accelerometer turned by it. Positioning and magnetometer
correct them as they arrive, late: an innovation is against what the filter said when the sample was taken. Gains are
those of the steady Kalman filter of the errors about hovering (Solà, arXiv 1711.02508, chapter 5; Farrell, Aided
Navigation, 2008): of each level axis position, velocity, tilt and gyroscope bias, of the vertical one position,
velocity and accelerometer bias, of the heading angle and gyroscope bias.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel, prebind
from multilift_marl.math3d import (
    add,
    axis_angle,
    mat,
    matmul,
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
from multilift_marl.physical import GRAVITY
from multilift_marl.remember import remember
from multilift_marl.sensing.sensors import Sensors
from multilift_marl.sensing.suite import Sensor, SensorSuite, white
from multilift_marl.sim.earth import Site
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World

Call = Callable[[int, int], None]  # of environments lo to hi

# Process noise of the filter beside the IMU's white noise, as densities: what its linear model leaves out.
_MODEL_ACCELERATION = 9e-3  # [m/s²/√Hz] offsets of the accelerometer, in directions that turn with the drone
_MODEL_RATE = 1.8e-4  # [rad/s/√Hz]
_GYRO_WALK = 3e-4  # [rad/s/√s] of the gyroscope's bias
_LIFT_WALK = 3e-3  # [m/s²/√s] of the accelerometer's along the vertical
_CONVERGED = 1e-9  # relative change of the covariance from one correction to the next
_MAX_CORRECTIONS = 20_000

POSITION, MAGNETOMETER = 4, 2  # sensors, in the order of `sensing.sensors.SIZES`


class Filter(NamedTuple):
    """What the filters of E x N drones remember."""

    gyro_bias: np.ndarray
    """(E, N, 3) body frame [rad/s]."""
    lift_bias: np.ndarray
    """(E, N) of the accelerometer along the vertical [m/s²]."""
    past: np.ndarray
    """(E, N, K, 6) position and velocity of the last K ticks, at their number modulo K."""


class FilterGains(NamedTuple):
    """Corrections for each unit of an innovation; the last axis is that of position and velocity.

    A fix is K ticks late when it arrives; entry i corrects the state i ticks after the sample: Aⁱ times the gain.
    """

    level: np.ndarray
    """(K + 1, 4, 2) of position, velocity, tilt, gyroscope bias."""
    vertical: np.ndarray
    """(K + 1, 3, 2) of position, velocity, accelerometer bias."""
    heading: np.ndarray
    """(2, 1) of heading, gyroscope bias, for an innovation of the heading."""


def nearest_rate(rate: float, ticks_per_second: float) -> float:
    """Return the rate [Hz] next to `rate` that is a whole part of that of ticks."""
    return ticks_per_second / max(1, round(ticks_per_second / rate))


def _make_suite(level: str, rate: float) -> SensorSuite:
    """Return the sensors of a level of `env.sensing`, in ticks of `rate` [Hz]."""
    usual, tick = SensorSuite(), 1 / rate
    imu = {
        "accelerometer": replace(usual.accelerometer, rate=rate, noise=white(70e-6 * GRAVITY, rate)),
        "gyroscope": replace(usual.gyroscope, rate=rate, noise=white(np.radians(2.8e-3), rate)),
        "barometer": Sensor(nearest_rate(50.0, rate)),  # not used
    }
    if level == "mocap":
        # Cameras: Vicon and OptiTrack state 0.2 to 0.5 mm; here 1 mm and 8 ms. Their heading, 0.2°, is that of a
        # magnetometer this good in a level field; what they tell of velocity follows from positions alone.
        cameras, delay = nearest_rate(125.0, rate), tick * round(0.008 / tick)
        magnetometer = Sensor(cameras, noise=np.radians(0.2) * Site().field)
        position, velocity = Sensor(cameras, delay, noise=1e-3), Sensor(cameras, delay, noise=1.0)
        return SensorSuite(magnetometer=magnetometer, position=position, velocity=velocity, **imu)
    fixes: dict[str, Any] = {
        "rate": nearest_rate(usual.position.rate, rate), "delay": tick * round(usual.position.delay / tick)
    }  # fmt: skip
    return replace(
        usual,
        magnetometer=replace(usual.magnetometer, rate=nearest_rate(usual.magnetometer.rate, rate)),
        position=replace(usual.position, **fixes),
        velocity=replace(usual.velocity, **fixes),
        **imu,
    )


class StateEstimator:
    """The own states of the drones of E teams as their filters have them.

    Args:
        level: of `env.sensing`, not "ideal".
        world: whose drones they are.
        rate: of ticks, those of the controllers [Hz].

    Attributes:
        state: SystemState whose drones are the estimated ones; what is not estimated (rotors, tensions) is the true.
    """

    def __init__(self, level: str, world: World, rate: float):
        true = world.state
        e, n = world.num_envs, world.num_drones
        suite = _make_suite(level, rate)
        self._true, self._rate = true, rate
        site = Site(inclination=0.0) if level == "mocap" else Site()
        self._sensors = Sensors(suite, true, 1 / rate, site)
        names = ("drone_position", "drone_velocity", "drone_rotation", "drone_body_rates")
        self.state: SystemState = true._replace(**{name: getattr(true, name).copy() for name in names})
        delay = round(suite.position.delay * rate)
        self._filter = Filter(np.zeros((e, n, 3)), np.zeros((e, n)), np.zeros((e, n, delay + 1, 6)))
        field = self._sensors.magnetic_reference
        self._gains = make_gains(suite, float(np.hypot(*field[:2])))
        arguments = (self._sensors.readings, self._sensors.channels, self.state, self._filter, self._gains)
        self.read = self._sensors.bind()
        self.estimate = prebind(estimate, *arguments)

    def start(self, env: int, seed: np.random.SeedSequence) -> None:
        """Begin an episode with the drones where they are: sensors and filters start anew."""
        self._sensors.reset(env, seed)
        start_filter(env, self._true, self._sensors.readings, self.state, self._filter)

    def follow(self, report: Callable[[SystemState], None]) -> None:
        """Let `report` write the state after each tick, in place of sensors and filter; before stages are bound."""

        def nothing(lo: int, hi: int) -> None:
            pass

        def estimate(lo: int, hi: int) -> None:
            report(self.state)

        self.read, self.estimate = nothing, estimate

    def arrays(self) -> dict[str, np.ndarray]:
        """Return the live arrays that outlive a step."""
        names = ("drone_position", "drone_velocity", "drone_rotation", "drone_body_rates")
        arrays = {f"filter_{name}": array for name, array in self._filter._asdict().items()}
        arrays |= {f"readings_{name}": array for name, array in self._sensors.readings._asdict().items()}
        return arrays | {f"estimated_{name}": getattr(self.state, name) for name in names}


@remember
def make_gains(suite: SensorSuite, level_field: float) -> FilterGains:
    """Return the gains of the filter for the sensors of a suite.

    Args:
        suite: sensors; position and velocity have the same rate and delay.
        level_field: level part of the magnetic field [µT].
    """
    rate, fixes = suite.gyroscope.rate, round(suite.gyroscope.rate / suite.position.rate)
    dt, delay = 1 / rate, round(suite.position.delay * rate)
    # Independent noises: variances add. A density [1/√Hz] is a standard deviation of a sample at the tick's rate
    # (`white`).
    push = np.hypot(np.max(suite.accelerometer.noise), white(_MODEL_ACCELERATION, rate))
    turn = np.hypot(np.max(suite.gyroscope.noise), white(_MODEL_RATE, rate))
    measured = [np.broadcast_to(sensor.noise, 3) for sensor in (suite.position, suite.velocity)]

    # A level axis: x' = v, v' = g tilt, tilt' = -bias.
    a = np.eye(4)
    # Tilt is the angle that accelerates along this axis: θy for x, -θx for y (`_correct_motion`).
    a[0, 1], a[1, 2], a[2, 3] = dt, GRAVITY * dt, -dt
    q = np.diag([0.0, push * dt, turn * dt, _GYRO_WALK * np.sqrt(dt)]) ** 2
    # One filter for both level axes, whose sensors are alike.
    level = _late(a, steady_gain(a, q, np.eye(2, 4), np.array([each[0] for each in measured]), fixes), delay)

    # The vertical: z' = w, w' = -bias.
    a = np.eye(3)
    a[0, 1], a[1, 2] = dt, -dt
    q = np.diag([0.0, push * dt, _LIFT_WALK * np.sqrt(dt)]) ** 2
    vertical = _late(a, steady_gain(a, q, np.eye(2, 3), np.array([each[2] for each in measured]), fixes), delay)

    # The heading: angle' = -bias.
    a = np.array([[1.0, -dt], [0.0, 1.0]])
    q = np.diag([turn * dt, _GYRO_WALK * np.sqrt(dt)]) ** 2
    # Noise across the level field, over the field: a small angle. The nearer to a magnetic pole, the noisier the
    # heading.
    angle = np.array([np.max(suite.magnetometer.noise) / level_field])
    heading = steady_gain(a, q, np.eye(1, 2), angle, round(rate / suite.magnetometer.rate))
    return FilterGains(level, vertical, heading)


def _late(a: np.ndarray, gain: np.ndarray, delay: int) -> np.ndarray:
    """Return what a correction has become 0 to `delay` steps later, (delay + 1, X, Y)."""
    return np.array([np.linalg.matrix_power(a, i) @ gain for i in range(delay + 1)])


def steady_gain(a: np.ndarray, q: np.ndarray, c: np.ndarray, noise: np.ndarray, steps: int) -> np.ndarray:
    """Return the steady gain (X, Y) of the Kalman filter that predicts `steps` times between corrections.

    Args:
        a: (X, X) transition of a step.
        q: (X, X) covariance that it adds.
        c: (Y, X) what is measured.
        noise: (Y,) standard deviations of that.
        steps: from one correction to the next.
    """
    through, added = np.eye(len(a)), np.zeros_like(q)
    for _ in range(steps):
        through, added = a @ through, a @ added @ a.T + q
    r = np.diag(noise**2)
    # Any positive start converges to the same solution of the Riccati equation.
    covariance = added + np.eye(len(a)) * 1e-4
    for _ in range(_MAX_CORRECTIONS):
        gain = covariance @ c.T @ np.linalg.inv(c @ covariance @ c.T + r)
        rest = np.eye(len(a)) - gain @ c
        corrected = rest @ covariance @ rest.T + gain @ r @ gain.T  # Joseph's form stays positive
        after = through @ corrected @ through.T + added
        change = np.abs(after - covariance).max()
        covariance = after
        if change <= _CONVERGED * np.abs(after).max():
            break
    return np.asarray(covariance @ c.T @ np.linalg.inv(c @ covariance @ c.T + r))


@kernel
def start_filter(e, true, readings, state, filter):
    """Let the filters of environment e begin: at the first fix, elsewhere at the truth, biases at zero."""
    for n in range(filter.lift_bias.shape[1]):
        # Values of a drone's sensors, in order: specific force 0-2, rates 3-5, field 6-8, pressure 9, position 10-12,
        # velocity 13-15.
        fix = readings.values[e, n, 10:13]
        put(state.drone_position[e, n], (fix[0], fix[1], fix[2]))
        put(state.drone_velocity[e, n], vec(true.drone_velocity, e, n))
        putmat(state.drone_rotation[e, n], mat(true.drone_rotation, e, n))
        put(state.drone_body_rates[e, n], vec(true.drone_body_rates, e, n))
        put(filter.gyro_bias[e, n], (0.0, 0.0, 0.0))
        filter.lift_bias[e, n] = 0.0
        for k in range(filter.past.shape[2]):
            put(filter.past[e, n, k, 0:3], vec(state.drone_position, e, n))
            put(filter.past[e, n, k, 3:6], vec(state.drone_velocity, e, n))


@kernel
def estimate(lo, hi, readings, channels, state, filter, gains):
    """Move the filters of environments lo to hi on by the tick that the sensors have just measured.

    Args:
        lo, hi: the environments.
        readings, channels: of the sensors.
        state: SystemState, drones are written.
        filter: Filter, written.
        gains: FilterGains.
    """
    for e in range(lo, hi):
        for n in range(filter.lift_bias.shape[1]):
            _predict(e, n, readings, channels, state, filter)
            if readings.fresh[e, POSITION]:
                _correct_motion(e, n, readings, channels, state, filter, gains)
            if readings.fresh[e, MAGNETOMETER]:
                _correct_heading(e, n, readings, channels, state, filter, gains)


@kernel
def _predict(e, n, readings, channels, state, filter):
    """Follow gyroscope and accelerometer for one tick."""
    dt, values = channels.dt, readings.values[e, n]
    rates = sub((values[3], values[4], values[5]), vec(filter.gyro_bias, e, n))
    speed = norm(rates)
    axis = unit(rates) if speed > 0.0 else (1.0, 0.0, 0.0)
    before = mat(state.drone_rotation, e, n)

    # Specific force is a mean over the tick: it is turned by the attitude in its middle.
    middle = matmul(before, axis_angle(axis, 0.5 * dt * speed))
    force = mul(middle, (values[0], values[1], values[2]))
    acceleration = sub(force, (0.0, 0.0, GRAVITY + filter.lift_bias[e, n]))
    velocity = vec(state.drone_velocity, e, n)
    moved = add(scale(dt, velocity), scale(0.5 * dt * dt, acceleration))
    put(state.drone_position[e, n], add(vec(state.drone_position, e, n), moved))
    put(state.drone_velocity[e, n], add(velocity, scale(dt, acceleration)))
    putmat(state.drone_rotation[e, n], matmul(before, axis_angle(axis, dt * speed)))
    put(state.drone_body_rates[e, n], rates)

    # Ring buffer: the present is written last, so that a fix of no delay is compared with the prediction.
    past = filter.past[e, n, readings.tick[e] % filter.past.shape[2]]
    put(past[0:3], vec(state.drone_position, e, n))
    put(past[3:6], vec(state.drone_velocity, e, n))


@kernel
def _moved(i, row, innovation, gains):
    """Return how position (row 0) or velocity (1) changes i ticks after the sample by its innovation (6 numbers)."""
    k, z = gains.level, gains.vertical
    return (
        k[i, row, 0] * innovation[0] + k[i, row, 1] * innovation[3],
        k[i, row, 0] * innovation[1] + k[i, row, 1] * innovation[4],
        z[i, row, 0] * innovation[2] + z[i, row, 1] * innovation[5],
    )


@kernel
def _correct_motion(e, n, readings, channels, state, filter, gains):
    """Correct position, velocity, tilt and biases by a fix, against what the filter said when it was taken."""
    delay, size = channels.delay[POSITION], filter.past.shape[2]
    sampled = readings.tick[e] - delay
    then, values = filter.past[e, n, sampled % size], readings.values[e, n]
    off = (
        values[10] - then[0], values[11] - then[1], values[12] - then[2],
        values[13] - then[3], values[14] - then[4], values[15] - then[5],
    )  # fmt: skip

    # The past since the sample, so that later fixes are compared with what is corrected; its last entry is the present.
    for i in range(delay + 1):
        past = filter.past[e, n, (sampled + i) % size]
        put(past[0:3], add((past[0], past[1], past[2]), _moved(i, 0, off, gains)))
        put(past[3:6], add((past[3], past[4], past[5]), _moved(i, 1, off, gains)))
    put(state.drone_position[e, n], add(vec(state.drone_position, e, n), _moved(delay, 0, off, gains)))
    put(state.drone_velocity[e, n], add(vec(state.drone_velocity, e, n), _moved(delay, 1, off, gains)))
    z = gains.vertical
    filter.lift_bias[e, n] += z[delay, 2, 0] * off[2] + z[delay, 2, 1] * off[5]

    # A tilt θ gives the acceleration θ × g e3 = g (θy, -θx, 0): x tells θy, y tells -θx.
    k = gains.level
    along = (k[delay, 2, 0] * off[0] + k[delay, 2, 1] * off[3], k[delay, 2, 0] * off[1] + k[delay, 2, 1] * off[4])
    bias = (k[delay, 3, 0] * off[0] + k[delay, 3, 1] * off[3], k[delay, 3, 0] * off[1] + k[delay, 3, 1] * off[4])
    _turn(e, n, (-along[1], along[0], 0.0), (-bias[1], bias[0], 0.0), state, filter)


@kernel
def _correct_heading(e, n, readings, channels, state, filter, gains):
    """Correct the heading by the magnetic field: how far it is from where the attitude has it, about the vertical."""
    values = readings.values[e, n]
    # The field as the attitude has it in the world. Only its level part tells of the heading, however far the drone is
    # tilted.
    seen = mul(mat(state.drone_rotation, e, n), (values[6], values[7], values[8]))
    north = row(channels.magnetic_field, 0)
    cross = seen[0] * north[1] - seen[1] * north[0]
    angle = np.arctan2(cross, seen[0] * north[0] + seen[1] * north[1])
    k = gains.heading
    _turn(e, n, (0.0, 0.0, k[0, 0] * angle), (0.0, 0.0, k[1, 0] * angle), state, filter)


@kernel
def _turn(e, n, rotation, bias, state, filter):
    """Turn the attitude by a rotation vector and change the gyroscope's bias, both in the world frame."""
    attitude = mat(state.drone_rotation, e, n)
    # The bias is kept in the body frame, where the gyroscope has it.
    put(filter.gyro_bias[e, n], add(vec(filter.gyro_bias, e, n), tmul(attitude, bias)))
    putmat(state.drone_rotation[e, n], turn_by(rotation, attitude))
