"""Whether a team can fly a motion of its payload: thrusts, tilts, cable forces and distances, and their limits.

By flatness (`flatness.py`) the motion determines all of them, without errors and feedback, which need spare thrust.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import put, vec
from multilift_marl.mdp.failures import MAX_TILT, TOUCH, make_limits
from multilift_marl.planning.flatness import (
    MIN_LIFT,
    SAMPLES,
    STEP,
    FlatMotion,
    FlatTeam,
    FlatWork,
    make_flat_team,
    set_flat_state,
    steady_shape,
)  # fmt: skip
from multilift_marl.planning.spline import sample_spline
from multilift_marl.planning.team_model import has_model, make_model, state_size
from multilift_marl.rig.system import System
from multilift_marl.schema.sections import RandomizationConfig

MAX_CABLE_ANGLE = 90.0  # [deg] from a drone's thrust: beyond it the failure is `failures.CABLE`
LARGEST = ("thrust", "tilt", "turning", "cable angle")  # of the other quantities the least values are limited
SPACING = 0.02  # [s] between the times that are looked at, of paths up to ...
MAX_TIMES = 50_000


class Quantity(NamedTuple):
    """What is limited: a column for each drone, of `height` one for the payload before them."""

    name: str
    """thrust, tilt, turning (angular acceleration of the thrust), cable angle, cable lift, distance or height."""
    unit: str
    values: np.ndarray
    """(T, N), (T, 1 + N)."""
    limits: np.ndarray
    """Of the same shape; largest values of those in `LARGEST`, else least ones."""

    def spare(self) -> np.ndarray:
        """Return what is left to the limits, negative beyond them."""
        return (self.limits - self.values) * (1 if self.name in LARGEST else -1)


class Margin(NamedTuple):
    """A quantity beside its limit, of one drone at one time."""

    quantity: str
    drone: int
    """-1: the payload."""
    time: float
    """[s]"""
    value: float
    limit: float
    spare: float
    """What is left to the limit, negative beyond it."""
    unit: str

    def __str__(self) -> str:
        """Say whose it is, when, and what the limit is."""
        who = "the payload" if self.drone < 0 else f"drone {self.drone}"
        bound = "at most" if self.quantity in LARGEST else "at least"
        if self.quantity == "cable lift":  # a value at its limit stands for any below
            bound = "which must be more than"
        amount = f"{self.value:.3g} {self.unit}, {bound} {self.limit:.3g} {self.unit}"
        return f"at {self.time:.2f} s the {self.quantity} of {who} is {amount}"


class Feasibility(NamedTuple):
    """A motion beside the limits of its team."""

    times: np.ndarray
    """(T,) [s]."""
    tension: np.ndarray
    """(T, N) of the cables [N]."""
    quantities: tuple[Quantity, ...]
    margins: tuple[Margin, ...]
    """Of each quantity the least."""
    violation: Margin | None
    """The first limit that is exceeded, None if none is."""


def find_violation(table: np.ndarray, system: System, ranges: RandomizationConfig) -> Margin | None:
    """Return the first limit that the path of a level payload exceeds, None if none; see `assess_path`.

    A body that hangs on one point, whose attitude is not planned, is not assessed.
    """
    if not has_model(system):
        return None
    return assess_path(table, system, ranges).violation


def assess_path(table: np.ndarray, system: System, ranges: RandomizationConfig) -> Feasibility:
    """Assess the path of a level payload; see `assess_motion`.

    Args:
        table: (K, 13) of x, y, z and yaw, see `spline.fit_spline`.
        system, ranges: the team and what its episodes draw.
    """
    times = np.linspace(0.0, table[-1, 0], min(int(table[-1, 0] / SPACING) + 2, MAX_TIMES))
    t = times[:, None] + STEP * (np.arange(SAMPLES) - SAMPLES // 2)
    place = sample_spline(table, t.ravel())[0].reshape(*t.shape, 4)
    rotations = np.zeros((*t.shape, 3, 3))
    rotations[..., 0, 0] = rotations[..., 1, 1] = np.cos(place[..., 3])
    rotations[..., 1, 0] = np.sin(place[..., 3])
    rotations[..., 0, 1], rotations[..., 2, 2] = -rotations[..., 1, 0], 1.0
    return assess_motion(times, np.ascontiguousarray(place[..., :3]), rotations, system, ranges)


def assess_motion(
    times: np.ndarray, positions: np.ndarray, rotations: np.ndarray, system: System, ranges: RandomizationConfig
) -> Feasibility:
    """Return what a motion of the payload asks of a team, beside its limits.

    Payload and drones are the heaviest, and rotors the weakest, that `ranges` draw.

    Args:
        times: (T,) [s].
        positions: (T, 5, 3) of its centre of mass, `flatness.STEP` apart, the third at the time [m].
        rotations: (T, 5, 3, 3) its attitude there.
        system, ranges: the team and what its episodes draw.
    """
    team = _heaviest_team(system, ranges)
    count, n = len(times), system.num_drones
    motion = TeamMotion(*(np.zeros((count, n, 3)) for _ in TeamMotion._fields))
    poses = positions, rotations, steady_shape(team)
    write_motion(poses, np.zeros(7), team, FlatWork.of(n), np.zeros(state_size(n)), motion)
    middle = SAMPLES // 2
    payload = positions[:, middle], rotations[:, middle]
    quantities = (
        *_measure_drones(motion, times, system, ranges.weakest_rotor),
        *_measure_places(motion, payload, team, system),
    )
    margins, violations = [], []
    for quantity in quantities:
        spare = quantity.spare()
        margins.append(_margin(quantity, times, spare, *map(int, np.unravel_index(spare.argmin(), spare.shape))))
        if (exceeded := spare.min(axis=1) < 0).any():
            row = int(exceeded.argmax())
            violations.append(_margin(quantity, times, spare, row, int(spare[row].argmin())))
    first = min(violations, key=lambda margin: margin.time, default=None)
    return Feasibility(times, np.linalg.norm(motion.force, axis=-1), quantities, tuple(margins), first)


class TeamMotion(NamedTuple):
    """How drones move along, (T, N, 3) each, world frame."""

    thrust: np.ndarray
    """Without the drones' drag [N]."""
    force: np.ndarray
    """Of each cable on the payload [N]."""
    place: np.ndarray
    """[m]"""
    velocity: np.ndarray
    """[m/s]"""


@kernel
def write_motion(poses, load, team, work, x, motion):
    """Write the TeamMotion (T, N, 3) of a payload; see `assess_motion`, and `set_flat_state` for the others."""
    positions, rotations, shape = poses
    count = team.force.shape[0]
    for t in range(positions.shape[0]):
        set_flat_state(FlatMotion(positions[t], rotations[t], shape), 0.0, load, team, work, x)
        thrust = x[12 + 4 * count :]
        for n in range(count):
            put(motion.thrust[t, n], (thrust[3 * n], thrust[3 * n + 1], thrust[3 * n + 2]))
            put(motion.force[t, n], vec(work.force, 1, n))
            put(motion.place[t, n], vec(work.place, 1, n))
            for i in range(3):
                motion.velocity[t, n, i] = (work.place[2, n, i] - work.place[0, n, i]) * (0.5 / STEP)


def _heaviest_team(system: System, ranges: RandomizationConfig) -> FlatTeam:
    """Return the numbers of the team with the heaviest payload and drones."""
    load, own, model = 1 + ranges.payload_mass, 1 + ranges.vehicle_mass, make_model(system)
    heavy = model._replace(
        payload_mass=load * model.payload_mass, inertia=load * model.inertia, drone_mass=own * model.drone_mass
    )
    team = make_flat_team(heavy, system)
    return team._replace(force=load * team.force)


def _measure_drones(motion: TeamMotion, times: np.ndarray, system: System, strength: float) -> tuple[Quantity, ...]:
    """Return the quantities of each drone alone; `strength` is that of its rotors over the nominal one [-]."""
    count, n = motion.place.shape[:2]
    # drag of the drones, its two lateral coefficients taken as equal
    vehicles = system.vehicles
    drag = np.array([vehicle.drag for vehicle in vehicles])
    up = motion.thrust / np.linalg.norm(motion.thrust, axis=-1, keepdims=True)
    climb = (up * motion.velocity).sum(axis=-1, keepdims=True) * up
    across = drag[:, :2].mean(axis=1, keepdims=True)
    thrust = motion.thrust + drag[:, 2:] * climb + across * (motion.velocity - climb)
    size = np.linalg.norm(thrust, axis=-1)
    axis = thrust / size[..., None]

    # angular acceleration of that axis, which takes rotors away from their mean thrust, each no farther than its limits
    turning = np.gradient(np.cross(axis, np.gradient(axis, times, axis=0)), times, axis=0)
    rotors = strength * np.array([[v.thrust_coefficient * v.rotor_speed_min**2, v.rotor_thrust_max] for v in vehicles])
    levers = [np.abs(v.allocation[1:3]).sum(axis=1) / np.array(v.inertia)[:2] for v in vehicles]
    room = np.minimum(size / 4 - rotors[:, 0], rotors[:, 1] - size / 4)

    # of each cable from its drone's thrust, at which its failure is
    pull = motion.force / np.linalg.norm(motion.force, axis=-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((pull * axis).sum(axis=-1), -1, 1)))
    return (
        Quantity("thrust", "N", size, np.tile(4 * rotors[:, 1], (count, 1))),
        Quantity("tilt", "deg", np.degrees(np.arccos(axis[..., 2])), np.full((count, n), MAX_TILT)),
        Quantity("turning", "rad/s²", np.linalg.norm(turning, axis=-1), room * np.min(levers, axis=1)),
        Quantity("cable angle", "deg", angle, np.full((count, n), MAX_CABLE_ANGLE)),
    )


def _measure_places(
    motion: TeamMotion, payload: tuple[np.ndarray, np.ndarray], team: FlatTeam, system: System
) -> tuple[Quantity, ...]:
    """Return the quantities of the team; `payload` are its places (T, 3) and attitudes (T, 3, 3)."""
    count, n = motion.place.shape[:2]
    # `set_flat_state` keeps cable forces that would push at their least, and then lacks the rest of the wrench
    least = MIN_LIFT * (1 + 1e-9) * team.force[:, 2]
    lift = Quantity("cable lift", "N", motion.force[..., 2], np.tile(least, (count, 1)))

    limits = make_limits(system)
    gaps = np.linalg.norm(motion.place[:, :, None] - motion.place[:, None], axis=-1)
    gaps[:, np.arange(n), np.arange(n)] = np.inf
    nearest = (gaps - limits.separation).argmin(axis=-1)
    distance = np.take_along_axis(gaps, nearest[..., None], axis=-1)[..., 0]
    apart = Quantity("distance", "m", distance, limits.separation[np.arange(n), nearest])

    place, attitude = payload
    down = attitude[:, 2] @ np.array(limits.payload_center) - np.abs(attitude[:, 2]) @ limits.payload_half  # of a box
    height = np.column_stack([place[:, 2] + down, motion.place[..., 2] - limits.drone_half[:, 2]])
    low = Quantity("height", "m", height, np.full((count, 1 + n), TOUCH))
    return (lift, low) if n == 1 else (lift, apart, low)


def _margin(quantity: Quantity, times: np.ndarray, spare: np.ndarray, i: int, k: int) -> Margin:
    """Return the margin at time i in column k."""
    drone = k - (quantity.name == "height")
    value, limit = float(quantity.values[i, k]), float(quantity.limits[i, k])
    return Margin(quantity.name, drone, float(times[i]), value, limit, float(spare[i, k]), quantity.unit)
