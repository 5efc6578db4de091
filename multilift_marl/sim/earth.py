"""Where a world is on Earth: frames of flight software, a local tangent plane, the standard atmosphere.

The world is ENU (x east, y north, z up) and bodies are FLU (x forward, y left, z up), as in ROS (REP 103). Flight
software is NED (north, east, down) and FRD (forward, right, down). All conversions between the two are here.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import cos, radians, sin

import numpy as np

# WGS 84 (NIMA TR8350.2)
SEMI_MAJOR = 6378137.0  # [m]
FLATTENING = 1 / 298.257223563
_ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)

_LOCAL_RADIUS = 6371000.0  # [m] of PX4's sphere

# International standard atmosphere (ISO 2533), troposphere
SEA_PRESSURE = 101325.0  # [Pa]
SEA_TEMPERATURE = 288.15  # [K]
LAPSE = 0.0065  # [K/m]
PRESSURE_EXPONENT = 9.80665 * 0.0289644 / (8.31446 * LAPSE)

_SWAP = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
_DOWN = np.array([1.0, 1.0, -1.0])
_FLIP = np.array([1.0, -1.0, -1.0])


def swap_enu_ned(vector: np.ndarray) -> np.ndarray:
    """Return ENU vectors (..., 3) in NED, or NED ones in ENU."""
    return np.asarray(vector, float)[..., [1, 0, 2]] * _DOWN  # axis by axis: NaN of one stays there


def swap_flu_frd(vector: np.ndarray) -> np.ndarray:
    """Return FLU vectors (..., 3) in FRD, or FRD ones in FLU."""
    return np.asarray(vector, float) * _FLIP


def swap_attitude(rotation: np.ndarray) -> np.ndarray:
    """Return rotations (..., 3, 3) FLU to ENU as FRD to NED, or the other way round."""
    return _SWAP @ np.asarray(rotation, float) * _FLIP


def swap_yaw(yaw: np.ndarray | float) -> np.ndarray:
    """Return headings from east, counter-clockwise, as headings from north, clockwise, or the other way round [rad].

    The results are in [-π, π).
    """
    # Compass heading = π/2 - yaw, wrapped: remainder of (π/2 - yaw) + π, less π.
    return np.remainder(1.5 * np.pi - np.asarray(yaw, float), 2 * np.pi) - np.pi


def pressure_at(altitude: np.ndarray | float) -> np.ndarray:
    """Return the pressure [Pa] at altitudes above the sea [m] of the troposphere (ISO 2533)."""
    return SEA_PRESSURE * (1 - LAPSE * np.asarray(altitude, float) / SEA_TEMPERATURE) ** PRESSURE_EXPONENT


def altitude_at(pressure: np.ndarray | float) -> np.ndarray:
    """Return the altitude above the sea [m] at pressures [Pa], the inverse of `pressure_at`."""
    return SEA_TEMPERATURE / LAPSE * (1 - (np.asarray(pressure, float) / SEA_PRESSURE) ** (1 / PRESSURE_EXPONENT))


@dataclass(frozen=True)
class Site:
    """The place of the world's origin.

    Attributes:
        latitude, longitude: of the origin [deg].
        altitude: of the origin above the ellipsoid, taken as that above the sea [m].
        declination, inclination: of the magnetic field: east of north, below the horizon [deg].
        field: its strength [µT].
    """

    latitude: float = 47.397742  # PX4's usual place of simulation, near Zurich
    longitude: float = 8.545594
    altitude: float = 488.0
    declination: float = 3.3  # World Magnetic Model 2025 there
    inclination: float = 63.4
    field: float = 48.4

    def magnetic_field(self) -> np.ndarray:
        """Return the magnetic field (3,), ENU [µT]."""
        east, dip = radians(self.declination), radians(self.inclination)
        return self.field * np.array([cos(dip) * sin(east), cos(dip) * cos(east), -sin(dip)])

    def to_geodetic(self, position: np.ndarray) -> np.ndarray:
        """Return latitude, longitude [deg] and altitude [m] (..., 3) of places in the world (..., 3) [m].

        The tangent plane touches the ellipsoid at the origin, so that far places are above what they show.
        """
        earth = _to_earth(np.array([self.latitude, self.longitude, self.altitude]))
        return _from_earth(earth + np.asarray(position, float) @ self._axes())

    def to_world(self, geodetic: np.ndarray) -> np.ndarray:
        """Return places in the world (..., 3) [m] from latitude, longitude [deg] and altitude [m] (..., 3)."""
        earth = _to_earth(np.array([self.latitude, self.longitude, self.altitude]))
        return (_to_earth(np.asarray(geodetic, float)) - earth) @ self._axes().T

    def _axes(self) -> np.ndarray:
        """Return the world's axes east, north and up as rows, in the Earth's frame."""
        lat, lon = radians(self.latitude), radians(self.longitude)
        return np.array(
            [
                [-sin(lon), cos(lon), 0.0],
                [-sin(lat) * cos(lon), -sin(lat) * sin(lon), cos(lat)],
                [cos(lat) * cos(lon), cos(lat) * sin(lon), sin(lat)],
            ]
        )


def project_local(geodetic: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """Return the local frame of PX4: NED places (..., 3) [m] of latitude, longitude [deg] and altitude [m] (..., 3).

    It is the azimuthal equidistant projection of a sphere of 6371 km about the estimator's origin (Snyder 1987, 25),
    so that its metres are those of the ellipsoid to 0.3 % only.

    Args:
        geodetic: places.
        origin: latitude, longitude [deg] and altitude [m] (3,).
    """
    lat, lon = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1])
    lat0, lon0 = np.radians(origin[0]), np.radians(origin[1])
    # Round-off may exceed 1 at the origin itself.
    angle = np.arccos(np.clip(np.sin(lat0) * np.sin(lat) + np.cos(lat0) * np.cos(lat) * np.cos(lon - lon0), -1.0, 1.0))
    # c/sin c; NumPy's sinc(x) is sin(πx)/(πx), and 1 at 0.
    scale = _LOCAL_RADIUS / np.sinc(angle / np.pi)
    north = scale * (np.cos(lat0) * np.sin(lat) - np.sin(lat0) * np.cos(lat) * np.cos(lon - lon0))
    east = scale * np.cos(lat) * np.sin(lon - lon0)
    return np.stack([north, east, origin[2] - geodetic[..., 2]], axis=-1)


def _to_earth(geodetic: np.ndarray) -> np.ndarray:
    """Return Earth-centred, Earth-fixed places (..., 3) [m] of geodetic ones."""
    lat, lon, altitude = np.radians(geodetic[..., 0]), np.radians(geodetic[..., 1]), geodetic[..., 2]
    normal = SEMI_MAJOR / np.sqrt(1 - _ECCENTRICITY2 * np.sin(lat) ** 2)  # radius of curvature in the prime vertical
    across = (normal + altitude) * np.cos(lat)
    along = (normal * (1 - _ECCENTRICITY2) + altitude) * np.sin(lat)
    return np.stack([across * np.cos(lon), across * np.sin(lon), along], axis=-1)


def _from_earth(earth: np.ndarray) -> np.ndarray:
    """Return geodetic places of Earth-centred, Earth-fixed ones, by Bowring's iteration on the reduced latitude."""
    x, y, z = earth[..., 0], earth[..., 1], earth[..., 2]
    across, semi_minor = np.hypot(x, y), SEMI_MAJOR * (1 - FLATTENING)
    # tan β = (1 - f) tan φ; the start is exact on the ellipsoid itself.
    reduced = np.arctan2(z * SEMI_MAJOR, across * semi_minor)
    for _ in range(3):  # each makes the error 1e-3 to 1e-5 times as large, near the ground
        lat = np.arctan2(
            z + _ECCENTRICITY2 / (1 - _ECCENTRICITY2) * semi_minor * np.sin(reduced) ** 3,
            across - _ECCENTRICITY2 * SEMI_MAJOR * np.cos(reduced) ** 3,
        )
        reduced = np.arctan2((1 - FLATTENING) * np.sin(lat), np.cos(lat))
    normal = SEMI_MAJOR / np.sqrt(1 - _ECCENTRICITY2 * np.sin(lat) ** 2)
    height = across * np.cos(lat) + z * np.sin(lat) - SEMI_MAJOR**2 / normal
    return np.stack([np.degrees(lat), np.degrees(np.arctan2(y, x)), height], axis=-1)
