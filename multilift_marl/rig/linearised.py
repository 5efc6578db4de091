"""The team at rest, linearised: how fast payload and drones swing between cables of a given tension.

Coordinates are small shifts of the centres of mass and small turns of payload and drones, in the payload's frame.
Under constant forces of the rotors the potential energy is Σ T_i ℓ_i to second order, with the tensions T and the
distances ℓ of the cables' ends. Its Hessian K has two parts: a cable resists a shift of its ends across it, by T/ℓ; and
where a body turns, the arm of the cable's force turns with it. The stiffness of cables along themselves is left out:
MuJoCo and the chains solve for it implicitly, at any time step. What is explicit is K, and the square of its fastest
rate is the largest eigenvalue of M⁻¹ K over all motions: cables that hardly stretch take motions away and make none
faster.

Whether a payload hangs stable is another question: with the stiffness of cables along themselves and that by which
controllers hold the drones in place, m ω², it does if no eigenvalue is negative (dissipation changes no sign: Kelvin,
Tait and Chetaev).
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import NamedTuple

import numpy as np

from multilift_marl.errors import warn_once
from multilift_marl.rig.system import System
from multilift_marl.schema.sections import RandomizationConfig

_HALVINGS = 14  # of the range of what is enough
_SLOW = 0.1  # [1/s] of a fall that takes longer than any episode: within what is rounded, or of no account


class Swing(NamedTuple):
    """The fastest swing of a team at rest."""

    rate: float
    """[rad/s]"""
    body: int
    """That moves most in it, by kinetic energy: 0 the payload, 1 + n drone n."""
    turns: bool
    """Whether that body turns more than its centre of mass moves."""


def fastest_swing(system: System, ranges: RandomizationConfig) -> Swing:
    """Return the fastest swing of a team whose parameters are drawn from `ranges`.

    The rate grows with 1/length and falls with the drones' masses; with the payload's mass, to which tensions are
    proportional, it goes one way. A centre of mass that is drawn shifts the cables' share of the load, the most at the
    corners of its range.
    """
    # The extremes that make the rate largest: the lightest drones, the shortest cables, the least inertia. Of the
    # payload's mass both ends, because which is faster depends on the rig.
    light = 1 - ranges.vehicle_mass
    shift = [sorted({-width, width}) for width in ranges.payload_center_of_mass]
    payloads = sorted({1 - ranges.payload_mass, 1 + ranges.payload_mass})
    turned = _principal_axes(system)
    drawn = []
    for load, *center in product(payloads, *shift):
        stiffness = swing_stiffness(system, load, 1 - ranges.cable_length, np.array(center))
        # M^-½ K M^-½ has the eigenvalues of M⁻¹ K and is symmetric; M is diagonal in principal axes only.
        root = 1 / np.sqrt(_inertia(system, load, load * (1 - ranges.payload_inertia), light))
        drawn.append(root[:, None] * (turned.T @ stiffness @ turned) * root)
    worst = max(drawn, key=lambda matrix: np.linalg.eigvalsh(matrix)[-1])
    square, shape = np.linalg.eigh(worst)
    energy = (shape[:, -1] ** 2).reshape(-1, 2, 3).sum(axis=2)  # kinetic, of each body's shift and turn
    body = int(energy.sum(axis=1).argmax())
    return Swing(float(np.sqrt(max(square[-1], 0.0))), body, bool(energy[body, 1] > energy[body, 0]))


def swing_stiffness(
    system: System, load: float = 1.0, length: float = 1.0, center: np.ndarray | None = None
) -> np.ndarray:
    """Return K (6 + 6 N, 6 + 6 N): of the payload, then of each drone, three shifts [m] and three turns [rad].

    Args:
        system: the team; of a point payload the turns have no stiffness.
        load: mass of the payload over its nominal one.
        length: of the cables over their nominal ones.
        center: of mass of the payload from its nominal one (3,) [m].
    """
    n = system.num_drones
    anchors = system.anchors - (0.0 if center is None or system.payload_shape == "point" else center)
    low = load * (system.formation_force if center is None else _shared(system, anchors))
    # At its hook a drone holds the cable's weight, too, which does not change with the load.
    high = low + system.hook_force - system.formation_force
    hooks = (system.resting_rotation * system.hooks[:, None, :]).sum(axis=-1)
    stiffness = np.zeros((6 + 6 * n, 6 + 6 * n))
    if system.payload_shape != "point":
        # Forces on the payload are along the cables, `low`; on a drone they are the opposite of `high`, hence the sign
        # below.
        stiffness[3:6, 3:6] = sum(_turned_arm(arm, force) for arm, force in zip(anchors, low, strict=True))
    for i in range(n):
        # The far end's shift from the near one's, by the coordinates of both bodies; the cable resists what is across.
        both = np.r_[:6, 6 + 6 * i : 12 + 6 * i]
        # d(end) = shift + turn × arm = shift - [arm]× turn.
        ends = np.hstack([-np.eye(3), _cross_matrix(anchors[i]), np.eye(3), -_cross_matrix(hooks[i])])
        tension = np.linalg.norm(high[i])
        across = np.eye(3) - np.outer(high[i], high[i]) / tension**2
        stiffness[np.ix_(both, both)] += tension / (length * system.cable_length[i]) * ends.T @ across @ ends
        stiffness[np.ix_(both[9:], both[9:])] -= _turned_arm(hooks[i], high[i])
    if system.payload_shape == "point":
        # A point does not turn: its rows stay free of stiffness, with a mass of 1 in `_inertia` for a rate of 0.
        stiffness[3:6], stiffness[:, 3:6] = 0.0, 0.0
    return stiffness


def divergence_rate(
    system: System, frequency: np.ndarray, load: float = 1.0, center: np.ndarray | None = None
) -> float:  # fmt: skip
    """Return the rate at which the resting payload leaves its pose while controllers hold the drones [1/s], 0 if none.

    Args:
        system: the team.
        frequency: natural ones of the drones' position loops (N,) [rad/s]; attitudes are held.
        load, center: see `swing_stiffness`.
    """
    n = system.num_drones
    anchors = system.anchors - (0.0 if center is None or system.payload_shape == "point" else center)
    stiffness = swing_stiffness(system, load, center=center)
    for i, (force, anchor, vehicle) in enumerate(zip(system.hook_force, anchors, system.vehicles, strict=True)):
        shift = slice(6 + 6 * i, 9 + 6 * i)
        direction = force / np.linalg.norm(force)
        # How fast the cable grows longer by each coordinate: its ends part along u, and u · (θ × r) = θ · (r × u).
        along = np.zeros(6 + 6 * n)
        along[:3], along[3:6], along[shift] = -direction, -np.cross(anchor, direction), direction
        stiffness += system.cable_stiffness[i] * np.outer(along, along)
        stiffness[shift, shift] += vehicle.mass * frequency[i] ** 2 * np.eye(3)
    turned = _principal_axes(system)
    root = 1 / np.sqrt(_inertia(system, load, load, 1.0))
    moves = np.ones(6 + 6 * n, bool)
    moves[6:] = np.tile([True] * 3 + [False] * 3, n)  # drones shift and do not turn
    moves[3:6] = system.payload_shape != "point"
    matrix = (root[:, None] * (turned.T @ stiffness @ turned) * root)[np.ix_(moves, moves)]
    return float(np.sqrt(max(-np.linalg.eigvalsh(matrix)[0], 0.0)))


def warn_of_instability(system: System, frequency: np.ndarray, ranges: RandomizationConfig) -> None:
    """Log a warning of a payload that leaves its pose between drones that hold their places, and what would keep it.

    Args:
        system: the team.
        frequency: see `divergence_rate`.
        ranges: of which the heaviest payload counts, with the highest centre of mass.
    """
    load, center, verb = 1.0, np.zeros(3), "hangs"
    rate = divergence_rate(system, frequency)
    if rate <= _SLOW and (ranges.payload_mass or ranges.payload_center_of_mass[2]):
        load, center, verb = 1 + ranges.payload_mass, np.array([0, 0, ranges.payload_center_of_mass[2]]), "may hang"
        rate = divergence_rate(system, frequency, load, center)
    if rate <= _SLOW:
        return

    def stands(rise: float) -> bool:
        raised = replace(system, anchors=system.anchors + [0.0, 0.0, rise])
        return divergence_rate(raised, frequency, load, center) <= _SLOW

    # Bisection for the least rise of the anchors at which the payload hangs stable.
    low, enough = 0.0, 2 * float(np.abs(system.anchors).max() + system.payload_size.max())
    for _ in range(_HALVINGS):
        middle = (low + enough) / 2
        low, enough = (low, middle) if stands(middle) else (middle, enough)
    enough = float(np.ceil(1e3 * enough) / 1e3)
    if stands(enough):
        why = "as its centre of mass is too high above payload.anchors"
        cure = f"raise them or lower payload.center_of_mass by {enough:g} m"
    else:
        why = "as its cables turn it away from rest"
        cure = "let cables lean outward by cable.azimuth and cable.angle, their anchors apart"
    warn_once(
        "rig",
        f"the payload {verb} unstable where drones only hold their places, its error e times as large after "
        f"{1 / rate:.2g} s, {why}; {cure}, or let the policy balance it",
    )


def _shared(system: System, anchors: np.ndarray) -> np.ndarray:
    """Return the cables' forces (N, 3) [N] nearest to the nominal ones that balance with `anchors` (N, 3) [m]."""
    force = system.formation_force
    if system.payload_shape == "point":
        return force
    turning = sum(np.cross(arm, pull) for arm, pull in zip(anchors, force, strict=True))
    # Six rows, force and moment: the least change of the forces that takes `turning` away and adds no force.
    balance = np.concatenate([np.concatenate([np.eye(3), _cross_matrix(arm)]) for arm in anchors], axis=1)
    change = np.linalg.pinv(balance) @ -np.concatenate([np.zeros(3), turning])
    return force + change.reshape(-1, 3)


def _turned_arm(arm: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return the stiffness (3, 3) against turns of a body on whose point `arm` a constant force acts [N m/rad]."""
    # A point at arm r, turned by θ, moves by θ × r + ½ θ × (θ × r). The energy of F with the second part is -F · ½ θ ×
    # (θ × r) = ½ θᵀ ((r · F) 1 - (r Fᵀ + F rᵀ)/2) θ.
    mixed = np.outer(arm, force)
    return arm @ force * np.eye(3) - (mixed + mixed.T) / 2


def _cross_matrix(v: np.ndarray) -> np.ndarray:
    """Return the matrix of v × ."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def _inertia(system: System, load: float, turning: float, light: float) -> np.ndarray:
    """Return masses and principal moments (6 + 6 N,) of all bodies, of a point payload a mass in place of moments."""
    moments = np.ones(3) if system.payload_shape == "point" else turning * system.payload_inertia
    bodies = [np.full(3, load * system.payload_mass), moments]
    for vehicle in system.vehicles:
        bodies += [np.full(3, light * vehicle.mass), light * np.array(vehicle.inertia)]
    return np.concatenate(bodies)


def _principal_axes(system: System) -> np.ndarray:
    """Return the matrix from turns about principal axes to those about the axes of the payload's frame."""
    turned = np.eye(6 + 6 * system.num_drones)
    turned[3:6, 3:6] = system.principal_axes
    for i, rotation in enumerate(system.resting_rotation):
        turned[9 + 6 * i : 12 + 6 * i, 9 + 6 * i : 12 + 6 * i] = rotation
    return turned
