"""Turbulence and gusts, the same for a whole team: at these heights turbulence is metres to tens of metres long."""

from __future__ import annotations

from math import cos, exp, expm1, hypot, pi, sqrt

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, clip, norm, put, row, scale, sub
from multilift_marl.rng import normal_pair

FOOT = 0.3048  # [m]
MIN_HEIGHT = 3.0  # [m] of the low-altitude model, which is not defined below 10 ft
MAX_HEIGHT = 1000 * FOOT  # [m] of that model
MIN_AIRSPEED = 1.0  # [m/s] at which a team that drifts with the wind meets turbulence


@kernel
def dryden(height, wind_speed):
    """Return intensities and scale lengths of turbulence at low altitude (MIL-F-8785C, 3.7, Dryden form).

    Args:
        height: above the ground [m]; taken to be at least 3 m and at most 1000 ft.
        wind_speed: mean wind at 20 ft [m/s].

    Returns:
        σ_u = σ_v, σ_w [m/s], L_u = L_v, L_w [m].
    """
    # The standard's constants are in feet.
    feet = clip(height, MIN_HEIGHT, MAX_HEIGHT) / FOOT
    shape = 0.177 + 0.000823 * feet
    # σ_w = 0.1 W_20; σ_u/σ_w = 1/(0.177 + 0.000823 h)^0.4; L_u = h/(0.177 + 0.000823 h)^1.2; L_w = h.
    up = 0.1 * wind_speed
    return up / shape**0.4, up, feet / shape**1.2 * FOOT, feet * FOOT


@kernel
def start_turbulence(e, air):
    """Draw the filters' state of environment e from its stationary distribution."""
    a, b = normal_pair(e, air)
    c, d = normal_pair(e, air)
    f, _ = normal_pair(e, air)
    # (u; x, y of v): variances 1, 1 and 1/2, covariance of x and y 1/2, as `advance_turbulence` keeps them.
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
    # `first`, `both`, `second`: the Cholesky factor of the noise's covariance. expm1 keeps the digits of a short step.
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
    # (1 + √3 T s) y = √3 x + (1 - √3) y, because T y' = x - y. Its variance is 2: hence the √2.
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
        speed = hypot(wind[0], wind[1]) if c.turbulence_speed < 0.0 else c.turbulence_speed
        across, upward, long, high = dryden(state.payload_position[e, 2], speed)
        gust = add(gust, turbulence(e, air, across, upward, wind))
        # Frozen turbulence (Taylor): time in the filters is the way through the air over the scale length.
        distance = timestep * max(MIN_AIRSPEED, norm(sub(row(state.payload_velocity, e), wind)))
        advance_turbulence(e, air, distance / long, distance / high)
    put(air.gust[e], gust)
    air.steps[e] += 1
    return gust
