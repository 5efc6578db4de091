"""Sensors of flight controllers: IMU, magnetometer, barometer and satellite positioning, of many drones at once.

A sensor samples at its own rate and delivers late. A sample is the true value, an offset drawn at the reset, a drift
(first-order Gauss-Markov, Gelb 1974, 3.8) and white noise:

    y = x + b + d + n,  d' = e^(-T/τ) d + √(1 - e^(-2T/τ)) σ_d w,

where σ_d = σ_b √(τ/2) for a random walk of density σ_b. Of the IMU d begins at zero, where its calibration left b.

The accelerometer and the gyroscope deliver means over the time since the sample before, as the integrating ones of
flight controllers do: nothing that the drone feels between two samples is lost. Random numbers are each environment's
own (SplitMix64, see `rng.py`), so results do not depend on how many are computed together.
"""

from __future__ import annotations

from collections.abc import Callable
from math import exp, expm1, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import kernel, prebind
from multilift_marl.math3d import (
    add,
    axis_angle,
    mat,
    matmul,
    norm,
    put,
    putmat,
    rotation_vector,
    row,
    scale,
    sub,
    tmul,
    transpose,
    unit,
    vec,
)
from multilift_marl.physical import GRAVITY
from multilift_marl.rng import normal_pair
from multilift_marl.sensing.suite import Sensor, SensorSuite, random_walk, white  # noqa: F401 (they were here)
from multilift_marl.sim.earth import LAPSE, PRESSURE_EXPONENT, SEA_PRESSURE, SEA_TEMPERATURE, Site
from multilift_marl.sim.state import SystemState

SIZES = {"accelerometer": 3, "gyroscope": 3, "magnetometer": 3, "barometer": 1, "position": 3, "velocity": 3}
SIZE = sum(SIZES.values())


class Channels(NamedTuple):
    """Numbers of the sensors, and of the C numbers that they measure."""

    first: np.ndarray
    """(6 + 1,) int, where the numbers of each sensor begin."""
    period: np.ndarray
    """(6,) int64 [ticks]."""
    delay: np.ndarray
    """(6,) int64 [ticks]."""
    noise: np.ndarray
    """(C,) standard deviation."""
    offset: np.ndarray
    """(C,) standard deviation."""
    drift: np.ndarray
    """(C,) standard deviation once it has gone on for long."""
    first_drift: np.ndarray
    """(C,) standard deviation at the reset."""
    drift_time: np.ndarray
    """(6,) [ticks]."""
    dt: float
    """[s] a tick."""
    magnetic_field: np.ndarray
    """(1, 3) ENU [µT]."""
    altitude: float
    """Of the world's origin above the sea [m]."""


class Readings(NamedTuple):
    """What the sensors of E x N drones remember and have delivered."""

    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    tick: np.ndarray
    """(E,) int64 since the reset."""
    offset: np.ndarray
    """(E, N, C) drawn at the reset."""
    drift: np.ndarray
    """(E, N, C)."""
    sum: np.ndarray
    """(E, N, 6) specific force and body rates since the last sample of each, summed over ticks."""
    past: np.ndarray
    """(E, N, K, C) true values of the last K ticks, at their number modulo K."""
    velocity: np.ndarray
    """(E, N, 3) at the tick before [m/s]."""
    rotation: np.ndarray
    """(E, N, 3, 3) at the tick before."""
    values: np.ndarray
    """(E, N, C) as last delivered, see the properties of `Sensors`."""
    fresh: np.ndarray
    """(E, 6) bool, sensors that have delivered at this tick, in the order of `SIZES`."""


class Sensors:
    """The sensors of E x N drones, read once a tick.

    Args:
        suite: which ones.
        state: true state of the drones, live arrays.
        dt: a tick [s].
        site: where the world is.

    Attributes:
        readings: live arrays.
        channels: numbers of the sensors.

    Raises:
        ConfigError: a rate or a delay that is no whole number of ticks.
    """

    def __init__(self, suite: SensorSuite, state: SystemState, dt: float, site: Site | None = None):
        site = site or Site()
        e, n = state.drone_position.shape[:2]
        sensors = [getattr(suite, name) for name in SIZES]
        for name, each in zip(SIZES, sensors, strict=True):
            if not 0 < each.rate * dt < 1 + 1e-6:
                raise ConfigError(f"{name}.rate={each.rate:g} Hz must be above 0, and at most 1/{dt:g} s; change it")
        period = [_ticks(1 / each.rate, dt, f"{name}.rate") for name, each in zip(SIZES, sensors, strict=True)]
        delay = [_ticks(each.delay, dt, f"{name}.delay") for name, each in zip(SIZES, sensors, strict=True)]

        def spread(part: str) -> np.ndarray:
            values = [np.broadcast_to(getattr(each, part), k) for each, k in zip(sensors, SIZES.values(), strict=True)]
            return np.concatenate(values).astype(float)

        self.channels = Channels(
            first=np.cumsum([0, *SIZES.values()]),
            period=np.array(period),
            delay=np.array(delay),
            noise=spread("noise"),
            offset=spread("offset"),
            drift=spread("drift"),
            first_drift=spread("drift") * spread("drifting"),
            drift_time=np.array([each.drift_time for each in sensors]) / dt,
            dt=dt,
            magnetic_field=site.magnetic_field()[None],
            altitude=site.altitude,
        )
        self.readings = Readings(
            generator=np.zeros(e, np.uint64),
            tick=np.zeros(e, np.int64),
            offset=np.zeros((e, n, SIZE)),
            drift=np.zeros((e, n, SIZE)),
            sum=np.zeros((e, n, 6)),
            past=np.zeros((e, n, max(delay) + 1, SIZE)),
            velocity=np.zeros((e, n, 3)),
            rotation=np.zeros((e, n, 3, 3)),
            values=np.zeros((e, n, SIZE)),
            fresh=np.zeros((e, len(SIZES)), bool),
        )
        self._state = state
        self._read = prebind(read_sensors, state, self.readings, self.channels)

    def reset(self, env: int, seed: np.random.SeedSequence) -> None:
        """Begin an episode: draw offsets and drifts, and deliver what every sensor says of the state as it is."""
        self.readings.generator[env] = seed.generate_state(1, np.uint64)[0]
        start_sensors(env, self._state, self.readings, self.channels)

    def read(self) -> None:
        """Let all sensors measure the state as it is, one tick after the last time."""
        self._read(0, len(self.readings.tick))

    def bind(self) -> Callable[[int, int], None]:
        """Return the call of (lo, hi) that does as `read` for environments lo to hi."""
        return self._read

    @property
    def magnetic_reference(self) -> np.ndarray:
        """(3,) the field, world frame [µT]."""
        return self.channels.magnetic_field[0]

    @property
    def specific_force(self) -> np.ndarray:
        """(E, N, 3) of the accelerometer, body frame [m/s²]."""
        return self.readings.values[..., 0:3]

    @property
    def body_rates(self) -> np.ndarray:
        """(E, N, 3) of the gyroscope, body frame [rad/s]."""
        return self.readings.values[..., 3:6]

    @property
    def magnetic_field(self) -> np.ndarray:
        """(E, N, 3) body frame [µT]."""
        return self.readings.values[..., 6:9]

    @property
    def pressure(self) -> np.ndarray:
        """(E, N) [Pa]."""
        return self.readings.values[..., 9]

    @property
    def position(self) -> np.ndarray:
        """(E, N, 3) world frame [m]."""
        return self.readings.values[..., 10:13]

    @property
    def velocity(self) -> np.ndarray:
        """(E, N, 3) world frame [m/s]."""
        return self.readings.values[..., 13:16]

    def is_fresh(self, name: str) -> np.ndarray:
        """Return whether the sensor `name`, one of `SIZES`, has delivered at this tick (E,) bool."""
        return self.readings.fresh[:, list(SIZES).index(name)]


def _ticks(seconds: float, dt: float, name: str) -> int:
    ticks = seconds / dt
    if abs(ticks - round(ticks)) > 1e-6 * max(ticks, 1.0):
        raise ConfigError(f"{name} makes {seconds:g} s, which is no whole number of steps of {dt:g} s; change it")
    return round(ticks)


@kernel
def start_sensors(e, state, readings, channels):
    """Draw offsets and drifts of environment e; every sensor delivers what it says of the state as it is."""
    readings.tick[e] = 0
    for n in range(state.drone_position.shape[1]):
        for c in range(0, channels.noise.shape[0], 2):
            a, b = normal_pair(e, readings)
            first, second = normal_pair(e, readings)
            _set_error(e, n, c, a, first, readings, channels)
            if c + 1 < channels.noise.shape[0]:
                _set_error(e, n, c + 1, b, second, readings, channels)
        put(readings.velocity[e, n], vec(state.drone_velocity, e, n))
        putmat(readings.rotation[e, n], mat(state.drone_rotation, e, n))
        for j in range(6):
            readings.sum[e, n, j] = 0.0
        # At rest until now, in the state as it is.
        _measure(e, n, 0, state, readings, channels)
        for k in range(1, readings.past.shape[2]):
            for c in range(channels.noise.shape[0]):
                readings.past[e, n, k, c] = readings.past[e, n, 0, c]
        for s in range(channels.period.shape[0]):
            _deliver(e, n, s, 0, readings, channels)
    readings.fresh[e] = True


@kernel
def _set_error(e, n, c, offset, drift, readings, channels):
    readings.offset[e, n, c] = channels.offset[c] * offset
    readings.drift[e, n, c] = channels.first_drift[c] * drift


@kernel
def read_sensors(lo, hi, state, readings, channels):
    """Let the sensors of environments lo to hi measure the state as it is, one tick after the last time."""
    for e in range(lo, hi):
        readings.tick[e] += 1
        now = readings.tick[e]
        for s in range(channels.period.shape[0]):
            then = now - channels.delay[s]
            readings.fresh[e, s] = then >= 0 and then % channels.period[s] == 0
        for n in range(state.drone_position.shape[1]):
            _measure(e, n, now, state, readings, channels)
            for s in range(channels.period.shape[0]):
                if readings.fresh[e, s]:
                    _deliver(e, n, s, now - channels.delay[s], readings, channels)


@kernel
def _measure(e, n, now, state, readings, channels):
    """Write the true values of tick `now`: those of the IMU are means since its last sample."""
    past = readings.past[e, n, now % readings.past.shape[2]]
    rotation = mat(state.drone_rotation, e, n)
    before = mat(readings.rotation, e, n)

    # Mean specific force in the mean attitude of the tick, and mean body rates; at the reset as if in free hover.
    turned = rotation_vector(matmul(transpose(before), rotation))
    middle = matmul(before, axis_angle(unit(turned), 0.5 * norm(turned)))
    change = sub(vec(state.drone_velocity, e, n), vec(readings.velocity, e, n))
    # Specific force: acceleration less gravity, +g upward at rest.
    force = tmul(middle, add(scale(1.0 / channels.dt, change), (0.0, 0.0, GRAVITY)))
    rates = scale(1.0 / channels.dt, turned)
    put(readings.velocity[e, n], vec(state.drone_velocity, e, n))
    putmat(readings.rotation[e, n], rotation)
    total = readings.sum[e, n]
    for j in range(3):
        total[j] += force[j]
        total[3 + j] += rates[j]
    for s in range(2):
        if now % channels.period[s] == 0:
            ticks = channels.period[s] if now > 0 else 1
            for j in range(3):
                past[3 * s + j] = total[3 * s + j] / ticks
                total[3 * s + j] = 0.0

    # Magnetic field, pressure of the standard atmosphere, place and velocity.
    put(past[6:9], tmul(rotation, row(channels.magnetic_field, 0)))
    height = channels.altitude + state.drone_position[e, n, 2]
    past[9] = SEA_PRESSURE * (1.0 - LAPSE * height / SEA_TEMPERATURE) ** PRESSURE_EXPONENT
    put(past[10:13], vec(state.drone_position, e, n))
    put(past[13:16], vec(state.drone_velocity, e, n))


@kernel
def _deliver(e, n, s, then, readings, channels):
    """Deliver the sample that sensor s took at tick `then`."""
    past = readings.past[e, n, then % readings.past.shape[2]]
    step = channels.period[s] / channels.drift_time[s]
    decay = exp(-step)
    # Keeps the drift's variance at σ_d², whatever the period.
    grow = sqrt(-expm1(-2.0 * step))
    for c in range(channels.first[s], channels.first[s + 1]):
        noise, walk = normal_pair(e, readings)
        drift = decay * readings.drift[e, n, c] + grow * channels.drift[c] * walk
        readings.drift[e, n, c] = drift
        readings.values[e, n, c] = past[c] + readings.offset[e, n, c] + drift + channels.noise[c] * noise
