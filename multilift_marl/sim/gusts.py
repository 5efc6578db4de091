"""Turbulence and gusts, the same for a whole team: at these heights turbulence is metres to tens of metres long.

Random numbers are each environment's own, by SplitMix64 (Steele, Lea and Flood, OOPSLA 2014), one word of state. They
depend on its seed and how many it has drawn before, so results do not depend on how many are computed together.
"""

from __future__ import annotations

from math import cos, exp, expm1, hypot, log, pi, sin, sqrt

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, clip, norm, put, row, scale, sub

FOOT = 0.3048  # [m]
MIN_HEIGHT = 3.0  # [m] of the low-altitude model, which is not defined below 10 ft
MAX_HEIGHT = 1000 * FOOT  # [m] of that model
MIN_AIRSPEED = 1.0  # [m/s] at which a team that drifts with the wind meets turbulence
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)  # constants of SplitMix64
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)
_30 = np.uint64(30)
_27 = np.uint64(27)
_31 = np.uint64(31)
_11 = np.uint64(11)


@kernel
def uniform(e, air):
    """Return the next number of environment e, uniform in (0, 1]."""
    air.generator[e] += _GOLDEN
    z = air.generator[e]
    z = (z ^ (z >> _30)) * _FIRST
    z = (z ^ (z >> _27)) * _SECOND
    z = z ^ (z >> _31)
    return (float(z >> _11) + 1.0) * 2.0**-53


@kernel
def normal_pair(e, air):
    """Return two independent standard normal numbers of environment e (Box and Muller 1958)."""
    radius = sqrt(-2.0 * log(uniform(e, air)))
    angle = 2.0 * pi * uniform(e, air)
    return radius * cos(angle), radius * sin(angle)


@kernel
def normal_vector(e, air):
    """Return three independent standard normal numbers of environment e."""
    (a, b), (c, _) = normal_pair(e, air), normal_pair(e, air)
    return (a, b, c)


@kernel
def dryden(height, wind_speed):
    """Return intensities and scale lengths of turbulence at low altitude (MIL-F-8785C, 3.7, Dryden form).

    Args:
        height: above the ground [m]; taken to be at least 3 m and at most 1000 ft.
        wind_speed: mean wind at 20 ft [m/s].

    Returns:
        σ_u = σ_v, σ_w [m/s], L_u = L_v, L_w [m].
    """
    feet = clip(height, MIN_HEIGHT, MAX_HEIGHT) / FOOT
    shape = 0.177 + 0.000823 * feet
    up = 0.1 * wind_speed
    return up / shape**0.4, up, feet / shape**1.2 * FOOT, feet * FOOT


@kernel
def start_turbulence(e, air):
    """Draw the filters' state of environment e from its stationary distribution."""
    a, b = normal_pair(e, air)
    c, d = normal_pair(e, air)
    f, _ = normal_pair(e, air)
    put(air.filter[e], (a, b, 0.5 * b + 0.5 * c))
    air.filter[e, 3] = d
    air.filter[e, 4] = 0.5 * d + 0.5 * f


@kernel
def advance_turbulence(e, air, across, upward):
    """Advance the filters of environment e, exactly, whatever the step.

    The longitudinal filter 1/(1 + Ts) has one state, x' = -x/T + noise; the transverse ones (1 + √3 Ts)/(1 + Ts)² two,
    x as before and y' = (x - y)/T. With white noise that gives x the variance 1, y has 1/2, as has their covariance,
    at any T, so the noise of a step is the stationary covariance less what the step leaves of it.

    Args:
        e: the environment.
        air: its filter states are written.
        across, upward: time step over T = L/V of the horizontal components and of the vertical one [-].
    """
    a, b = normal_pair(e, air)
    c, d = normal_pair(e, air)
    f, _ = normal_pair(e, air)
    x = air.filter[e]
    x[0] = exp(-across) * x[0] + sqrt(-expm1(-2.0 * across)) * a
    x[1], x[2] = _step_pair(x[1], x[2], across, b, c)
    x[3], x[4] = _step_pair(x[3], x[4], upward, d, f)


@kernel
def _step_pair(x, y, h, a, b):
    """Return the two states of a transverse filter after a step h, in units of T, with normal numbers a and b."""
    decay = exp(-h)
    left = exp(-2.0 * h)
    first = sqrt(-expm1(-2.0 * h))
    both = (0.5 - left * (h + 0.5)) / first
    second = sqrt(max(0.0, 0.5 - left * (h * h + h + 0.5) - both * both))
    return decay * x + first * a, decay * (y + h * x) + both * a + second * b


@kernel
def turbulence(e, air, across, upward, wind):
    """Return the turbulent velocity [m/s], world frame: u along the mean wind's horizontal part, v across, w up.

    Args:
        e: the environment.
        air: its filter states.
        across, upward: intensities σ_u = σ_v and σ_w [m/s].
        wind: mean wind [m/s].
    """
    x = air.filter[e]
    root = sqrt(3.0)
    u = across * x[0]
    v = across * (root * x[1] + (1.0 - root) * x[2]) / sqrt(2.0)
    w = upward * (root * x[3] + (1.0 - root) * x[4]) / sqrt(2.0)
    speed = hypot(wind[0], wind[1])
    c, s = (wind[0] / speed, wind[1] / speed) if speed > 0.0 else (1.0, 0.0)
    return (c * u - s * v, s * u + c * v, w)


@kernel
def gust_factor(t, start, rise, hold):
    """Return a "1 - cosine" gust over its amplitude at time t (MIL-F-8785C, 3.7), held and taken back."""
    s = t - start
    if s <= 0.0:
        return 0.0
    if s < rise:
        return 0.5 - 0.5 * cos(pi * s / rise)
    if s <= rise + hold:
        return 1.0
    s -= rise + hold
    return 0.5 + 0.5 * cos(pi * s / rise) if s < rise else 0.0


@kernel
def step_gusts(e, wind, state, air, timestep, c):
    """Return turbulence and gust of this step [m/s], kept in `air.gust`, and advance both to the next step.

    Height and airspeed are the payload's.

    Args:
        e: the environment.
        wind: mean wind [m/s].
        state, air: SystemState and Air; the latter is written.
        timestep: [s].
        c: AirConstants.
    """
    gust = scale(gust_factor(air.steps[e] * timestep, c.gust_start, c.gust_rise, c.gust_hold), c.gust)
    if c.turbulence:
        across, upward, long, high = dryden(state.payload_position[e, 2], hypot(wind[0], wind[1]))
        gust = add(gust, turbulence(e, air, across, upward, wind))
        distance = timestep * max(MIN_AIRSPEED, norm(sub(row(state.payload_velocity, e), wind)))
        advance_turbulence(e, air, distance / long, distance / high)
    put(air.gust[e], gust)
    air.steps[e] += 1
    return gust
