"""The air about the drones: their downwash, what inflow and ground do to their thrust, moments. See docs/air.md.

What is the same for the whole team, turbulence and gusts, is in `gusts.py`.
"""

from __future__ import annotations

from math import exp, log, pi, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import column, mat, norm, put, row, scale, sub, tmul, vec
from multilift_marl.physical import AIR_DENSITY
from multilift_marl.rig.constants import RotorArrays, make_rotors
from multilift_marl.rig.system import System

SPREADING = 0.094  # [-] half-width of a round turbulent jet over the distance (Hussein, Capp and George, JFM 1994)
GROWTH = SPREADING / sqrt(2.0 * log(2.0))  # half the velocity is where a quarter of the momentum flux is
_REACH = 4.0  # [-] widths of a jet beyond which it is left out: e^-16 of its axis


class AirConstants(NamedTuple):
    """Numbers of the compiled loops."""

    gusts: bool
    """Whether there is turbulence or a gust."""
    turbulence: bool
    turbulence_speed: float
    """Mean wind that it is as strong as [m/s]; negative: the one there is."""
    gust: tuple[float, float, float]
    """Amplitude, world frame [m/s]; times in [s]."""
    gust_start: float
    gust_rise: float
    gust_hold: float
    downwash: bool
    payload_breadth: float
    """Radius of a disc as large as the payload's C_d A [m]."""
    inflow: bool
    """Whether the air along the rotors' axes changes their thrust."""
    rotors: np.ndarray
    """(N, 3) `Vehicle.blade_ratio` [-], `disc_momentum` [kg/m], and the moment of the induced power over its thrust,
    λ R [m]."""
    ground_effect: bool
    images: np.ndarray
    """(N, M, 2) squared distances between rotor axes [m²], each with its share of the 16 pairs of rotor and image."""
    moments: bool
    """Whether the air turns drones about their horizontal axes."""
    roll_moment: float
    """[N s] about body x, for each m/s through the air along body y."""
    rotor_radius: np.ndarray
    """(N,) [m]."""
    arm: np.ndarray
    """(N,) [m]."""
    rolling_moment: np.ndarray
    """(N,) of a rotor, over its speed and that of the air across it [kg m]."""
    drones: RotorArrays

    @property
    def still(self) -> bool:
        """Whether all of it is switched off."""
        return not (self.gusts or self.downwash or self.inflow or self.ground_effect or self.moments)


def make_air(system: System) -> AirConstants:
    """Return the air of `system`."""
    air = system.air
    vehicles = system.vehicles
    hold = float("inf") if air.gust_hold is None else air.gust_hold
    return AirConstants(
        gusts=bool(air.turbulence or any(air.gust)),
        turbulence=air.turbulence,
        turbulence_speed=-1.0 if air.turbulence_speed is None else float(air.turbulence_speed),
        gust=air.gust,
        gust_start=float(air.gust_start),
        gust_rise=float(air.gust_rise),
        gust_hold=float(hold),
        downwash=air.wash,
        payload_breadth=sqrt(system.payload_drag_area / pi),
        inflow=system.inflow,
        rotors=np.array([(v.blade_ratio, v.disc_momentum, v.induced_ratio * v.rotor_radius) for v in vehicles]),
        ground_effect=air.ground_effect,
        images=_images(system),
        moments=bool(air.roll_moment or any(vehicle.rolling_moment for vehicle in vehicles)),
        roll_moment=float(air.roll_moment),
        rotor_radius=np.array([vehicle.rotor_radius for vehicle in vehicles]),
        arm=np.array([vehicle.arm for vehicle in vehicles]),
        rolling_moment=np.array([vehicle.rolling_moment for vehicle in vehicles], float),
        drones=make_rotors(system),
    )


def _images(system: System) -> np.ndarray:
    """Return `AirConstants.images`; rows that a drone does not need have a share of zero."""
    tables = []
    for vehicle in system.vehicles:
        rotors = vehicle.rotor_positions
        squares = ((rotors[:, None] - rotors[None]) ** 2).sum(axis=-1)
        # By symmetry of a layout many of the 16 pairs are alike: each distance once, with its share.
        distances, counts = np.unique(squares.round(12), return_counts=True)
        tables.append(np.stack([distances, counts / 16], axis=1))
    images = np.zeros((len(tables), max(map(len, tables)), 2))
    for own, table in zip(images, tables, strict=True):
        own[: len(table)] = table
    return images


@kernel
def update_downwash(e, state, air, c):
    """Write the downwash at every body of environment e, `air.downwash`, from the state as it is."""
    wash = air.downwash[e]
    count = state.drone_position.shape[1]
    payload = row(state.payload_position, e)
    wash[:] = 0.0
    # Momentum fluxes of all jets add up at each body.
    for n in range(count):
        attitude = mat(state.drone_rotation, e, n)
        here = vec(state.drone_position, e, n)
        speed = _vec4(state.rotor_speed, e, n)
        for i in range(count + 1):
            if i == n:
                continue
            away = sub(vec(state.drone_position, e, i) if i < count else payload, here)
            breadth = c.arm[i] if i < count else c.payload_breadth
            flux = jet_flux(n, away, breadth, attitude, speed, c)
            if flux > 0.0:
                # Air goes against the thrust, along -b3.
                put(wash[i], sub(row(wash, i), scale(flux, column(attitude, 2))))
    # Velocities follow from their sums.
    for i in range(count + 1):
        put(wash[i], _velocity(row(wash, i)))


@kernel
def wash_at(e, point, breadth, state, c):
    """Return the velocity of the downwash of all drones at a point [m/s], world frame, averaged over `breadth` [m]."""
    total = (0.0, 0.0, 0.0)
    for n in range(state.drone_position.shape[1]):
        attitude = mat(state.drone_rotation, e, n)
        away = sub(point, vec(state.drone_position, e, n))
        speed = _vec4(state.rotor_speed, e, n)
        total = sub(total, scale(jet_flux(n, away, breadth, attitude, speed, c), column(attitude, 2)))
    return _velocity(total)


@kernel
def _vec4(a, i, j):
    """Return row (i, j) of an (E, N, 4) array."""
    return (a[i, j, 0], a[i, j, 1], a[i, j, 2], a[i, j, 3])


@kernel
def _velocity(flux):
    """Return the velocity w whose square, along w, is the momentum flux over density."""
    size = norm(flux)
    return scale(1.0 / sqrt(size), flux) if size > 0.0 else flux


@kernel
def jet_flux(n, away, breadth, attitude, speed, c):
    """Return the momentum flux over density of the downwash of drone n, against its thrust [m²/s²].

    Every rotor blows a round turbulent jet against its thrust f: the momentum flux ρ w² is Gaussian across it and
    adds up to f at any distance, the width grows in proportion to the distance once it exceeds that of the contracted
    slipstream of momentum theory. The momentum fluxes of jets add up (Reichardt 1942). On a body acts their mean over
    its breadth, with a Gaussian weight, so that no drag exceeds the momentum that there is.

    Args:
        n: the drone whose jet it is.
        away: middle of the body from the drone, world frame [m].
        breadth: radius of the body [m]; 0 for the flux at a point.
        attitude: of the drone.
        speed: of its rotors, four numbers [rad/s].
        c: AirConstants.
    """
    x, y, z = tmul(attitude, away)
    if z >= 0.0:
        return 0.0
    # Width of the jet there, and whether any of it reaches the body.
    # Momentum theory: far below a rotor the slipstream has half its area, R/√2. Averaging a Gaussian of width a over
    # another of width b gives one of width √(a² + b²).
    square = max(c.rotor_radius[n] / sqrt(2.0), -GROWTH * z) ** 2 + breadth * breadth
    if x * x + y * y > (c.arm[n] + _REACH * sqrt(square)) ** 2:
        return 0.0
    # Thrusts of the four rotors, each weighted by the distance from its axis.
    thrust = 0.0
    for k in range(4):
        dx = x - c.drones.rotor_positions[n, k, 0]
        dy = y - c.drones.rotor_positions[n, k, 1]
        thrust += c.drones.thrust_coefficient[n] * speed[k] * speed[k] * exp(-(dx * dx + dy * dy) / square)
    return thrust / (AIR_DENSITY * pi * square)


@kernel
def axial_thrust(thrust, climb, n, c):
    """Return the thrust of a rotor that climbs, at the same rotor speed [N], and its further reaction torque [N m].

    Blade elements of constant chord give thrust = still thrust + q 2ρA v (v - w) with the air w through the disc, v the
    induced velocity in still air and q = σ a / 8 λ; momentum theory gives thrust = 2ρA w (w - climb) (Leishman,
    Principles of Helicopter Aerodynamics, 2.13 and 3.3; Bangura et al., arXiv 1601.00733). Both hold for one w, a root
    of a quadratic. The torque changes with the power thrust · w that goes into the air.

    Args:
        thrust: in still air, b ω² [N].
        climb: velocity of the rotor through the air along its thrust [m/s].
        n: the drone.
        c: AirConstants.
    """
    if thrust <= 0.0:
        return 0.0, 0.0
    ratio, disc, reach = row(c.rotors, n)
    # Hover: T = 2ρA v², disc = 2ρA.
    still = sqrt(thrust / disc)
    slow = climb - ratio * still
    # w (w - climb) = v² + q v (v - w): w² - (climb - q v) w - (1 + q) v² = 0. The positive root: air goes down through
    # it.
    through = 0.5 * (slow + sqrt(slow * slow + 4.0 * (1.0 + ratio) * still * still))
    blown = max(still + ratio * (still - through), 0.0)  # beyond that blades would stall
    return disc * still * blown, disc * reach * (blown * through - still * still)


@kernel
def ground_gain(height, n, c):
    """Return thrust of drone n near the ground over thrust far from it, at the same rotor speeds.

    On a rotor act the images of all four as sources below the ground: 1/(1 - Σ R² z/(2 (d² + 4 z²)^1.5)) with d the
    distances between axes. For one rotor that is 1/(1 - (R/4z)²) (Cheeseman and Bennett, ARC R&M 3021, 1955), for a
    square of four Sanchez-Cuevas et al. 2017 without their empirical body lift. Mean of the rotors of a level drone.

    Args:
        height: of the rotors [m]; at least R/2 is taken, where potential flow ends.
        n: the drone.
        c: AirConstants.
    """
    radius = c.rotor_radius[n]
    total = 0.0
    z = max(height, 0.5 * radius)
    for i in range(c.images.shape[1]):
        # An image is as far below the ground as the rotor is above it: 2 z apart, beside the distance of the axes.
        square = c.images[n, i, 0] + 4.0 * z * z
        total += c.images[n, i, 1] * z / (square * sqrt(square))
    return 1.0 / (1.0 - 2.0 * radius * radius * total)


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
        turning += c.drones.rotor_spin[n, k] * state.rotor_speed[e, n, k]
    turning *= c.rolling_moment[n]
    return turning * through[0] + c.roll_moment * through[1], turning * through[1]
