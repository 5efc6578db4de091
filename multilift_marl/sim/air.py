"""The air: turbulence, gusts, the rotors' wash and what the ground does to their thrust. docs/air.md derives it.

All of a team feels the same gust at the same time, since turbulence at these heights is metres to tens of metres long;
wash differs from body to body. Random numbers are each environment's own, so results do not depend on how many are
computed together.
"""

from __future__ import annotations

from math import cos, exp, expm1, hypot, log, pi, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.config.system import System
from multilift_marl.math3d import add, clip, column, dot, mat, mul, norm, put, row, scale, sub, vec
from multilift_marl.sim.generator import normal_pair

AIR_DENSITY = 1.225  # [kg/m³] at sea level, 15 °C (ISA)
FOOT = 0.3048  # [m]
LEAST_HEIGHT, LARGEST_HEIGHT = 3.0, 1000 * FOOT  # [m] the low-altitude model's; below 10 ft it is not defined
LEAST_AIRSPEED = 1.0  # [m/s]
SPREADING = 0.094  # [-] half-width of a round turbulent jet over the distance (Hussein, Capp and George, JFM 1994)
_REACH = 4.0  # [-] widths of a jet beyond which it is not felt


class AirConstants(NamedTuple):
    """Numbers of the compiled loops; what is switched off costs one branch."""

    gusts: bool
    """Whether there is turbulence or a gust."""
    turbulence: bool
    gust: tuple[float, float, float]
    """Amplitude, world frame [m/s]; times in [s]."""
    gust_start: float
    gust_rise: float
    gust_hold: float
    wash: bool
    rotor_radius: float
    rotor_positions: np.ndarray
    """(4, 3) [m]."""
    arm: float
    payload_breadth: float
    """Radius of a disc as large as the payload's C_d A [m]."""
    thrust_coefficient: float
    ground_effect: bool
    rotor_distances: np.ndarray
    """(4, 4) squared, between rotor axes [m²]."""
    moments: bool
    """Whether the air turns drones about their horizontal axes."""
    roll_moment: float
    """[N s] about body x, for each m/s through the air along body y."""
    rolling_moment: float
    """[kg m] of each rotor."""
    rotor_spin: np.ndarray


def make_air(system: System) -> AirConstants:
    """Return the air of `system`."""
    air, vehicle = system.air, system.vehicle
    rotors = vehicle.rotor_positions
    hold = float("inf") if air.gust_hold is None else air.gust_hold
    return AirConstants(
        gusts=air.turbulence or any(air.gust),
        turbulence=air.turbulence,
        gust=tuple(float(x) for x in air.gust),
        gust_start=float(air.gust_start),
        gust_rise=float(air.gust_rise),
        gust_hold=float(hold),
        wash=air.wash,
        rotor_radius=float(vehicle.rotor_radius),
        rotor_positions=rotors,
        arm=float(vehicle.arm),
        payload_breadth=sqrt(system.payload_drag_area / pi),
        thrust_coefficient=float(vehicle.thrust_coefficient),
        ground_effect=air.ground_effect,
        rotor_distances=((rotors[:, None] - rotors[None]) ** 2).sum(axis=-1),
        moments=bool(air.roll_moment or vehicle.rolling_moment),
        roll_moment=float(air.roll_moment),
        rolling_moment=float(vehicle.rolling_moment),
        rotor_spin=np.asarray(vehicle.rotor_spin, float),
    )


@kernel
def dryden(height, wind_speed):
    """Return intensities and scale lengths of turbulence at low altitude (MIL-F-8785C, 3.7, Dryden form).

    Args:
        height: above the ground [m]; taken to be at least 3 m and at most 1000 ft.
        wind_speed: mean wind at 20 ft [m/s].

    Returns:
        σ_u = σ_v, σ_w [m/s], L_u = L_v, L_w [m].
    """
    feet = clip(height, LEAST_HEIGHT, LARGEST_HEIGHT) / FOOT
    shape = 0.177 + 0.000823 * feet
    up = 0.1 * wind_speed
    return up / shape**0.4, up, feet / shape**1.2 * FOOT, feet * FOOT


@kernel
def start_turbulence(e, air):
    """Draw the filters' state of environment e from its stationary distribution."""
    (a, b), (c, d), (f, _) = normal_pair(e, air), normal_pair(e, air), normal_pair(e, air)
    put(air.filter[e], (a, b, 0.5 * b + 0.5 * c))
    air.filter[e, 3], air.filter[e, 4] = d, 0.5 * d + 0.5 * f


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
    (a, b), (c, d), (f, _) = normal_pair(e, air), normal_pair(e, air), normal_pair(e, air)
    x = air.filter[e]
    x[0] = exp(-across) * x[0] + sqrt(-expm1(-2.0 * across)) * a
    x[1], x[2] = _step_pair(x[1], x[2], across, b, c)
    x[3], x[4] = _step_pair(x[3], x[4], upward, d, f)


@kernel
def _step_pair(x, y, h, a, b):
    """Return the two states of a transverse filter after a step h, in units of T, with normal numbers a and b."""
    decay, left = exp(-h), exp(-2.0 * h)
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
    x, root = air.filter[e], sqrt(3.0)
    u = across * x[0]
    v = across * (root * x[1] + (1.0 - root) * x[2]) / sqrt(2.0)
    w = upward * (root * x[3] + (1.0 - root) * x[4]) / sqrt(2.0)
    speed = hypot(wind[0], wind[1])
    c, s = (wind[0] / speed, wind[1] / speed) if speed > 0.0 else (1.0, 0.0)
    return (c * u - s * v, s * u + c * v, w)


@kernel
def gust_share(t, start, rise, hold):
    """Return the share of a "1 - cosine" gust's amplitude at time t (MIL-F-8785C, 3.7), held and taken back."""
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
def blow(e, wind, state, air, timestep, c):
    """Return turbulence and gust of this step [m/s], kept in `air.gust`, and go on to the next step.

    Height and airspeed are the payload's.
    """
    gust = scale(gust_share(air.steps[e] * timestep, c.gust_start, c.gust_rise, c.gust_hold), c.gust)
    if c.turbulence:
        across, upward, long, high = dryden(state.payload_position[e, 2], hypot(wind[0], wind[1]))
        gust = add(gust, turbulence(e, air, across, upward, wind))
        distance = timestep * max(LEAST_AIRSPEED, norm(sub(row(state.payload_velocity, e), wind)))
        advance_turbulence(e, air, distance / long, distance / high)
    put(air.gust[e], gust)
    air.steps[e] += 1
    return gust


@kernel
def spread_wash(e, state, air, c):
    """Find the rotors' wash at every body of environment e, from the state as it is; write `air.wash`."""
    count = state.drone_position.shape[1]
    for i in range(count):
        put(air.wash[e, i], wash_at(e, i, vec(state.drone_position, e, i), c.arm, state, c))
    put(air.wash[e, count], wash_at(e, -1, row(state.payload_position, e), c.payload_breadth, state, c))


@kernel
def wash_at(e, drone, point, breadth, state, c):
    """Return the velocity of the wash of all drones but one at a body [m/s], world frame.

    Every rotor blows a round turbulent jet against its thrust f: the momentum flux ρ w² is Gaussian across it and
    adds up to f at any distance, the width grows in proportion to the distance once it exceeds that of the contracted
    slipstream of momentum theory. The momentum fluxes of jets add up (Reichardt 1942). A body feels their mean over
    its breadth, with a Gaussian weight, so that no drag exceeds the momentum that there is.

    Args:
        e: the environment.
        drone: whose own wash does not count; -1 for none.
        point: middle of the body [m].
        breadth: its radius [m]; 0 for the velocity at a point.
        state: SystemState; positions, attitudes and rotor speeds are used.
        c: AirConstants.
    """
    flux = (0.0, 0.0, 0.0)
    growth = SPREADING / sqrt(2.0 * log(2.0))  # half the velocity is where a quarter of the flux is
    for n in range(state.drone_position.shape[1]):
        if n == drone:
            continue
        attitude = mat(state.drone_rotation, e, n)
        axis, away = column(attitude, 2), sub(point, vec(state.drone_position, e, n))
        depth = -dot(away, axis)
        if depth <= 0.0:
            continue
        square = max(c.rotor_radius / sqrt(2.0), growth * depth) ** 2 + breadth * breadth
        if dot(away, away) - depth * depth > (c.arm + _REACH * sqrt(square)) ** 2:
            continue
        amount = 0.0
        for k in range(4):
            rotor = mul(attitude, row(c.rotor_positions, k))
            beside = sub(add(away, scale(depth, axis)), rotor)
            thrust = c.thrust_coefficient * state.rotor_speed[e, n, k] ** 2
            amount += thrust * exp(-dot(beside, beside) / square)
        flux = sub(flux, scale(amount / (AIR_DENSITY * pi * square), axis))
    size = norm(flux)
    return scale(1.0 / sqrt(size), flux) if size > 0.0 else flux


@kernel
def ground_gain(height, c):
    """Return thrust near the ground over thrust far from it, at the same rotor speeds.

    A rotor feels the images of all four as sources below the ground: 1/(1 - Σ R² z/(2 (d² + 4 z²)^1.5)) with d the
    distances between axes. For one rotor that is 1/(1 - (R/4z)²) (Cheeseman and Bennett, ARC R&M 3021, 1955), for a
    square of four Sanchez-Cuevas et al. 2017 without their empirical body lift. Mean of the rotors of a level drone.

    Args:
        height: of the rotors [m]; at least R/2 is taken, where potential flow ends.
        c: AirConstants.
    """
    z, total = max(height, 0.5 * c.rotor_radius), 0.0
    for i in range(4):
        for j in range(4):
            square = c.rotor_distances[i, j] + 4.0 * z * z
            total += z / (square * sqrt(square))
    return 1.0 / (1.0 - 0.125 * c.rotor_radius * c.rotor_radius * total)


@kernel
def air_moment(e, n, through, state, c):
    """Return the moments of the air about the body x and y axes of drone n [N m].

    Of each rotor μ ω (v_x, v_y) with the sign of its reaction torque, from the blades that advance (Martin and Salaün,
    ICRA 2010), and the report's moment about the roll axis (eqs 12-13), in proportion to v_y.

    Args:
        e, n: environment and drone.
        through: its velocity through the air, body frame [m/s].
        state: SystemState; rotor speeds are used.
        c: AirConstants.
    """
    turning = 0.0
    for k in range(4):
        turning += c.rotor_spin[k] * state.rotor_speed[e, n, k]
    turning *= c.rolling_moment
    return turning * through[0] + c.roll_moment * through[1], turning * through[1]
