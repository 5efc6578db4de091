"""The arrays of chains: their state, their numbers, and what they are advanced with."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.rig.system import System
from multilift_marl.sim.cables.common import Cables
from multilift_marl.sim.parameters import Inertias

UNITS = 1024  # into which a physics step can be cut
_SUBSTEP = 2.5e-4  # [s] the longest substep: docs/cables.md compares it with 0.5 ms


class Nodes(NamedTuple):
    """State of the chains: E environments, N cables, S links of the longest one."""

    position: np.ndarray
    """(E, N, S - 1, 3) from the payload to the drone, world frame [m]."""
    velocity: np.ndarray
    """(E, N, S - 1, 3) [m/s]."""
    contact: np.ndarray
    """(E, 1 + N, 2, 6) force (world frame) and torque (body frame) of contact in the last step and in that before."""

    @classmethod
    def zeros(cls, num_envs: int, system: System) -> Nodes:
        """Return chains at the origin."""
        e = num_envs
        n = system.num_drones
        s = int(system.cable_segments.max())
        return cls(np.zeros((e, n, s - 1, 3)), np.zeros((e, n, s - 1, 3)), np.zeros((e, 1 + n, 2, 6)))


class Motion(NamedTuple):
    """What a physics step finds: E environments, B = 1 + N bodies (payload, drones), S links of the longest chain."""

    position: np.ndarray
    """(E, B, 3) of the centres of mass [m]; after the step of the body frames' origins, like the next one."""
    velocity: np.ndarray
    """(E, B, 3) [m/s]."""
    rotation: np.ndarray
    """(E, B, 3, 3)."""
    rates: np.ndarray
    """(E, B, 3) body frame [rad/s]."""
    stretch: np.ndarray
    """(E, N, S) of the links [m]."""
    tension: np.ndarray
    """(E, N) next to the drone, in the last substep, at least 0 [N]."""
    peak: np.ndarray
    """(E, N) largest one in the physics step [N]."""
    dissipated: np.ndarray
    """(E,) energy that dampers, along the links and of bending, took in the physics step [J]."""
    impulse: np.ndarray
    """(E, B, 6) of the cables in the physics step: linear in the world frame, angular about the body frame's origin."""
    first_position: np.ndarray
    """(E, N, S - 1, 3) of the nodes at the start of the physics step [m]."""
    first_velocity: np.ndarray
    """(E, N, S - 1, 3) [m/s]."""
    first_broken: np.ndarray
    """(E, N) bool, cables that were broken then."""

    @classmethod
    def zeros(cls, num_envs: int, system: System) -> Motion:
        """Return arrays for `num_envs` environments."""
        e = num_envs
        n = system.num_drones
        s = int(system.cable_segments.max())
        b = 1 + n
        bodies = (e, b, 3), (e, b, 3), (e, b, 3, 3), (e, b, 3)
        nodes = (e, n, s - 1, 3)
        shapes = (*bodies, (e, n, s), (e, n), (e, n), (e,), (e, b, 6), nodes, nodes)
        arrays = [np.zeros(shape) for shape in shapes]
        return cls(*arrays, *[np.zeros((e, n), bool)])


class Chain(NamedTuple):
    """Chains, with the bodies that they tie together; body 0 is the payload, 1 + n drone n."""

    cables: Cables
    bodies: Inertias
    segments: np.ndarray
    """(N,) links."""
    length: np.ndarray
    """(E, N) of a link [m]."""
    stiffness: np.ndarray
    """(E, N) of a link [N/m]."""
    damping: np.ndarray
    """(N,) of a link [N s/m]."""
    node_mass: np.ndarray
    """(E, N) [kg]."""
    bending_stiffness: np.ndarray
    """(N,) between neighbouring links [N m/rad]."""
    bending_damping: np.ndarray
    """(N,) [N m s/rad]."""
    bends: bool
    """Whether any cable resists bending."""
    largest: np.ndarray
    """(E,) int, length of the longest substep, a physics step being `UNITS`."""
    nodes: Nodes
    links: np.ndarray
    """(E, S, 7) of a cable while its state is written: direction, stretch [m] and velocity [m/s] of each link."""
    motion: Motion


class Workspace(NamedTuple):
    """Numbers of one environment within a substep."""

    momentum: np.ndarray
    """(B, 3) angular, about the centre of mass, world frame [N m s]."""
    force: np.ndarray
    """(B, 3) gravity and loads, world frame [N]."""
    torque: np.ndarray
    """(B, 3) about the centre of mass, body frame [N m]."""
    free_velocity: np.ndarray
    """(B, 3) at the end of the substep, were it not for the cables [m/s]."""
    free_rates: np.ndarray
    """(B, 3) at the end of the substep, were it not for the cables, world frame [rad/s]."""
    ends: np.ndarray
    """(N, 2, 3) anchor and hook from their bodies' centres of mass, world frame [m]."""
    twist: np.ndarray
    """(N, 3) angular velocity that a unit impulse of the first link gives the payload [1/(kg m)]."""
    direction: np.ndarray
    """(N, S, 3) of the links, from payload to drone."""
    bending: np.ndarray
    """(N, S - 1, 3) force of bending on the nodes [N]."""
    bend_force: np.ndarray
    """(B, 3) of bending on the bodies, world frame [N]."""
    bend_moment: np.ndarray
    """(B, 3) of that about their centres of mass [N m]."""
    bend_power: np.ndarray
    """(1,) that the dampers of bending take [W]."""
    turning: np.ndarray
    """(N, S) by how much a link stretches faster because it turns [m/s]."""
    tension: np.ndarray
    """(N, S) of each link [N]."""
    steady: np.ndarray
    """(N, S) that it would have if its stretch did not change in the substep [N]."""
    diagonal: np.ndarray
    """(N, S) of the tridiagonal matrices [1/kg]."""
    coupling: np.ndarray
    """(N, S) their elements of links j - 1 and j [1/kg]."""
    right: np.ndarray
    """(N, S) right-hand sides [m/s²]."""
    matrix: np.ndarray
    """(N, N) of the first links [1/kg]."""

    @classmethod
    def zeros(cls, segments: np.ndarray) -> Workspace:
        """Return arrays for chains of `segments` (N,) links."""
        n = len(segments)
        s = int(segments.max())
        bodies = (1 + n, 3)
        links = (n, s)
        shapes = (
            bodies, bodies, bodies, bodies, bodies, (n, 2, 3), (n, 3), (n, s, 3), (n, s - 1, 3),
            bodies, bodies, (1,), links, links, links, links, links, links, (n, n),
        )  # fmt: skip
        return cls(*(np.zeros(shape) for shape in shapes))


def largest_substep(system: System, cable_length: np.ndarray) -> np.ndarray:
    """Return the longest substeps that bending, which is explicit, allows: powers of two, of `UNITS` to a step.

    Args:
        system: of the chains.
        cable_length: the true ones (..., N) [m].

    Returns:
        (...) int.
    """
    # Symplectic steps are stable up to 2/ω, those of a damper alone up to 2/rate: a quarter and a half of that.
    longest = np.minimum(min(_SUBSTEP, system.timestep), 1 / np.maximum(system.bending_rate(cable_length), 1e-9))
    return 2 ** np.maximum(0, np.log2(longest * UNITS / system.timestep).astype(int))
