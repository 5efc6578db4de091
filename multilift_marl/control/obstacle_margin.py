"""Set-points that stay clear of what a drone sees itself (`control.obstacle_margin` and the two after it).

Each of these keeps a set-point in half-spaces, by projections in turn, as buffered Voronoi cells do (Zhou et al., IEEE
RA-L 2017). They turn as the team moves, so that drones slide along obstacles.

- Obstacles: a point that is seen forbids what is nearer to it, along the line from it to the drone; in the horizontal
  plane if the point is beside the drone, so that its noise does not drive the drone up and down.
- Payload: moved as the set-point is, it stays clear of the same points, in the horizontal plane.
- Sector: the drone stays between the vertical planes through the payload that divide it from its neighbours' slots.
"""

from __future__ import annotations

from math import cos, pi, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.errors import ConfigError
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, dot, heading, mat, norm, put, row, scale, sub, vec
from multilift_marl.schema.control import ControlConfig

SWEEPS = 4
LAG = 3.0
"""Of references behind a command that moves at a speed, times the speed over their frequency, see `smooth`."""
ALIKE = 1e-6
"""[rad] between slots that nothing divides."""
BESIDE = 0.5
"""Sine of the elevation, up or down, below which a point is beside the drone."""
STEEP = 0.9
"""Sine of the elevation above which a point is over the drone, and not beside its payload."""


class Surroundings(NamedTuple):
    """What drones know of what is around them."""

    points: np.ndarray
    """(E, N, k, 3) of obstacles, world frame [m]."""
    payload_position: np.ndarray
    """(E, L, 3) L = 1 for all, or L = N, each drone its own [m]."""
    payload_rotation: np.ndarray
    """(E, L, 3, 3)."""
    planes: np.ndarray
    """(N, 2, 2) normals of those beside each drone's sector, into it, in the payload's heading frame."""
    anchor_line: np.ndarray
    """(3,) direction of the line on which all anchors lie, payload frame; zero if on none."""


class Margins(NamedTuple):
    """What is kept."""

    drone: float
    """From the drone's centre to points [m]."""
    payload: float
    """From the payload's centre to points [m]; 0: none, like the next one."""
    sector: float
    """From the drone's centre to the planes beside its sector [m]."""

    @classmethod
    def of(cls, settings: ControlConfig) -> Margins:
        """Return those of a configuration."""
        return cls(settings.obstacle_margin, settings.payload_margin, settings.sector_margin)


def check_margins(config: Config) -> None:
    """Refuse, by a ConfigError, margins and shifts of set-points that are none, or of what is not seen."""
    settings, seen = config.control, config.env.obstacle_sensing
    for key in ("obstacle_margin", "payload_margin", "sector_margin", "swing_shift"):
        if not (value := getattr(settings, key)):
            continue
        if settings.action != "reference":
            raise ConfigError(
                f"control.{key}={value:g} moves set-points of control.action=reference, not those of "
                f"{settings.action}; take that one, or leave it out"
            )
        if key in ("obstacle_margin", "payload_margin") and seen not in ("map", "local"):
            raise ConfigError(
                f"control.{key}={value:g} needs drones that see points of obstacles, not "
                f"env.obstacle_sensing={seen}; set env.obstacle_sensing=local, or leave it out"
            )


def sector_planes(azimuth: np.ndarray) -> np.ndarray:
    """Return the normals (N, 2, 2), inward, of the planes halfway between slots of azimuths (N,) [rad].

    They are zero, and keep nothing, where no other slot has another azimuth.
    """
    planes = np.zeros((len(azimuth), 2, 2))
    for own, at in enumerate(azimuth):
        beyond = np.mod(azimuth - at, 2 * pi)  # anticlockwise, of the others
        others = beyond[(beyond > ALIKE) & (beyond < 2 * pi - ALIKE)]
        if others.size:
            left, right = at + others.min() / 2, at - (2 * pi - others.max()) / 2
            planes[own] = (sin(left), -cos(left)), (-sin(right), cos(right))
    return planes


@kernel
def keep_clear(lo, hi, team, margins, smoothing):
    """Move commanded positions of environments lo to hi out of the margins about what the drones see.

    Args:
        lo, hi: the environments.
        team: ControlContext with surroundings.
        margins: Margins.
        smoothing: of the references: where they will be at rest beside the goal is kept clear.
    """
    goal, command, around = team.goal, team.reference.command, team.around
    for e in range(lo, hi):
        # References are smoothed beside a goal that moves: a command is kept where its reference will come to be.
        lead = scale(LAG / smoothing.frequency, row(goal.velocity, e))
        for n in range(command.shape[1]):
            place, load = vec(team.state.drone_position, e, n), min(n, around.payload_position.shape[1] - 1)
            payload = vec(around.payload_position, e, load)
            yaw = heading(mat(around.payload_rotation, e, load))
            c, s = cos(yaw), sin(yaw)
            way = sub(add(vec(command, e, n), lead), place)
            # Projections in turn tend to a point of all half-spaces, if there is one (Bregman 1965).
            for _ in range(SWEEPS):
                for j in range(around.points.shape[2]):
                    point = vec(around.points[e], n, j)
                    away = sub(place, point)
                    distance = norm(away)
                    if margins.drone > 0.0:
                        level = abs(away[2]) < BESIDE * distance
                        way = _stay_beyond(way, (away[0], away[1], 0.0) if level else away, margins.drone)
                    if margins.payload > 0.0 and -away[2] < STEEP * distance:
                        # The payload moves as its drone's set-point does: the team's formation is kept.
                        beside = sub(payload, point)
                        way = _stay_beyond(way, (beside[0], beside[1], 0.0), margins.payload)
                if margins.sector > 0.0:
                    for side in range(2):
                        x, y = around.planes[n, side, 0], around.planes[n, side, 1]
                        normal = (c * x - s * y, s * x + c * y, 0.0)
                        lacks = margins.sector - dot(add(sub(place, payload), way), normal)
                        if lacks > 0.0:
                            way = add(way, scale(lacks, normal))
            put(command[e, n], sub(add(place, way), lead))


@kernel
def _stay_beyond(way, away, margin):
    """Return a displacement that brings what is `away` from a point no nearer to it than a margin, along that line."""
    distance = norm(away)
    if distance > 0.0:
        lacks = margin - distance - dot(way, away) / distance
        if lacks > 0.0:
            return add(way, scale(lacks / distance, away))
    return scale(1.0, way)
