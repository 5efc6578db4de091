"""Which sensors a drone carries: their rates, delays and errors."""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from math import sqrt

import numpy as np

from multilift_marl.physical import GRAVITY


@dataclass(frozen=True)
class Sensor:
    """One sensor; each number of the last three is that of each of its axes.

    Attributes:
        rate: of its samples [Hz].
        delay: from a sample until it is delivered [s].
        noise: standard deviation of the white noise of a sample.
        offset: standard deviation of what is drawn at the reset.
        drift: standard deviation of the drift once it has gone on for long.
        drift_time: its correlation time [s].
        drifting: whether it has gone on for long at the reset; else it begins at zero there.
    """

    rate: float
    delay: float = 0.0
    noise: float | tuple[float, ...] = 0.0
    offset: float | tuple[float, ...] = 0.0
    drift: float | tuple[float, ...] = 0.0
    drift_time: float = 100.0
    drifting: bool = True

    def scaled(self, factor: float) -> Sensor:
        """Return the sensor with `factor` times its errors."""
        noise, offset, drift = (tuple(factor * np.atleast_1d(x)) for x in (self.noise, self.offset, self.drift))
        return replace(self, noise=noise, offset=offset, drift=drift)


def white(density: float, rate: float) -> float:
    """Return the standard deviation of samples at `rate` [Hz] of noise of a one-sided density [.../√Hz]."""
    return density * sqrt(rate / 2)


def random_walk(density: float, time: float) -> float:
    """Return the standard deviation of a drift by the density of its random walk [.../s/√Hz] and its correlation time.

    The drift follows d' = -d/τ + σ_b w with w of a two-sided density of 1. From zero it has the variance
    σ_b² τ/2 (1 - e^(-2t/τ)): σ_b² t at first, as a random walk, and in the end σ_b² τ/2.

    Args:
        density: σ_b.
        time: τ [s].
    """
    return density * sqrt(time / 2)


@dataclass(frozen=True)
class SensorSuite:
    """The sensors of a drone. Those of a Pixhawk-class flight controller with RTK positioning by default.

    Attributes:
        accelerometer, gyroscope: ICM-42688-P, data sheet DS-000347: 70 µg/√Hz, 2.8 mdps/√Hz; the offsets are what
            calibration leaves of ± 20 mg and ± 0.5 °/s, the drifts from then on those of Furrer et al., RotorS (2016,
            gazebo_imu_plugin.h, twice an ADIS16448's): random walks of 6e-3 m/s³/√Hz and 8 °/h/√s = 3.88e-5
            rad/s²/√Hz with 300 and 1000 s. After 8 s they are 0.017 m/s² and 1.1e-4 rad/s, in the end 0.073 and 8.7e-4.
        magnetometer: RM3100, data sheet: 15 nT of noise at 200 cycles; the offset is what calibration leaves.
        barometer: MS5611-01BA03, data sheet: resolution 0.012 mbar RMS at the highest oversampling; the drift is that
            of the weather and of the sensor's temperature, 40 Pa/K before compensation.
        position: u-blox ZED-F9P with RTK, data sheet: 0.01 m horizontally, 0.01 m vertically (+ 1 ppm CEP).
        velocity: ZED-F9P, data sheet: 0.05 m/s.
    """

    accelerometer: Sensor = field(
        default=Sensor(
            250.0, noise=white(70e-6 * GRAVITY, 250), offset=0.02,
            drift=random_walk(6e-3, 300), drift_time=300, drifting=False,
        )
    )  # fmt: skip
    gyroscope: Sensor = field(
        default=Sensor(
            250.0, noise=white(np.radians(2.8e-3), 250), offset=1e-3,
            drift=random_walk(np.radians(8 / 3600), 1000), drift_time=1000, drifting=False,
        )
    )  # fmt: skip
    magnetometer: Sensor = field(default=Sensor(50.0, noise=0.015, offset=0.2, drift=0.05, drift_time=100))
    barometer: Sensor = field(default=Sensor(50.0, noise=1.2, drift=3.0, drift_time=300))
    position: Sensor = field(default=Sensor(10.0, delay=0.1, noise=(0.005, 0.005, 0.01), drift=(0.008, 0.008, 0.015)))
    velocity: Sensor = field(default=Sensor(10.0, delay=0.1, noise=0.05))

    @classmethod
    def ideal(cls, rate: float = 250.0) -> SensorSuite:
        """Return sensors without an error, all at one rate [Hz]."""
        return cls(*(Sensor(rate) for _ in fields(cls)))
