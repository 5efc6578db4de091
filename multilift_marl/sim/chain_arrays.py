"""The arrays of chains: their state, their numbers, and what a shard works with while it moves them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.rig.system import System

UNITS = 1024  # into which a physics step can be cut
_SUBSTEP = 2.5e-4  # [s] the longest substep


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
        e, n, s = num_envs, system.num_drones, int(system.cable_segments.max())
        return cls(np.zeros((e, n, s - 1, 3)), np.zeros((e, n, s - 1, 3)), np.zeros((e, 1 + n, 2, 6)))


class Chain(NamedTuple):
    """Numbers of the chains and of the bodies that they tie together; body 0 is the payload, 1 + n drone n."""

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
    anchors: np.ndarray
    """(N, 3) on the payload, from its body frame's origin [m]."""
    hooks: np.ndarray
    """(N, 3) on the drones, from their centres of mass [m]."""
    mass: np.ndarray
    """(E, 1 + N) of the bodies [kg]."""
    inertia: np.ndarray
    """(E, 1 + N, 3, 3) about their centres of mass, body frame [kg m²]."""
    inverse_inertia: np.ndarray
    """(E, 1 + N, 3, 3) zero of a point payload, which does not turn."""
    center: np.ndarray
    """(E, 1 + N, 3) centre of mass from the body frame's origin [m]."""
    breaking_load: np.ndarray
    """(N,) [N]."""
    loads: np.ndarray
    """(1 + N,) offsets of the bodies' applied forces in a row of `batch.state`."""
    timestep: float
    """Of the physics [s]."""
    largest: int
    """Length of the longest substep, a physics step being `UNITS`."""
    bends: bool
    """Whether any cable resists bending."""


class Motion(NamedTuple):
    """Working arrays of a shard: its L environments, B = 1 + N bodies, S links of the longest chain."""

    position: np.ndarray
    """(L, B, 3) of the centres of mass [m]; after the step of the body frames' origins, like the next one."""
    velocity: np.ndarray
    """(L, B, 3) [m/s]."""
    rotation: np.ndarray
    """(L, B, 3, 3)."""
    rates: np.ndarray
    """(L, B, 3) body frame [rad/s]."""
    stretch: np.ndarray
    """(L, N, S) of the links [m]."""
    tension: np.ndarray
    """(L, N) next to the drone, in the last substep, at least 0 [N]."""
    peak: np.ndarray
    """(L, N) largest one in the physics step [N]."""
    dissipated: np.ndarray
    """(L,) energy that dampers, along the links and of bending, took in the physics step [J]."""
    momentum: np.ndarray
    """(B, 3) angular, about the centre of mass, world frame [N m s]; of one environment, like all below."""
    force: np.ndarray
    """(B, 3) gravity and loads, world frame [N]."""
    torque: np.ndarray
    """(B, 3) about the centre of mass, body frame [N m]."""
    impulse: np.ndarray
    """(B, 6) of the cables so far: linear in the world frame, angular about the origin in the body frame."""
    free_velocity: np.ndarray
    """(B, 3) at the end of the substep, were it not for the cables [m/s]."""
    free_rates: np.ndarray
    """(B, 3) likewise, world frame [rad/s]."""
    ends: np.ndarray
    """(N, 2, 3) anchor and hook from their bodies' centres of mass, world frame [m]."""
    twist: np.ndarray
    """(N, 3) angular velocity that a unit impulse of the first link gives the payload [1/(kg m)]."""
    direction: np.ndarray
    """(N, S, 3) of the links, from payload to drone."""
    bending: np.ndarray
    """(N, S - 1, 3) force of bending on the nodes [N]."""
    bend_force: np.ndarray
    """(B, 3) on the bodies, world frame [N], and its moment about their centres of mass, (B, 3) [N m]."""
    bend_moment: np.ndarray
    bend_power: np.ndarray
    """(1,) that the dampers of bending take [W]."""
    turning: np.ndarray
    """(N, S) by how much a link stretches faster because it turns [m/s]."""
    cable_force: np.ndarray
    """(N, S) tension of each link [N]."""
    diagonal: np.ndarray
    """(N, S) of the tridiagonal matrices, and the elements beside it, (N, S) of links j - 1 and j [1/kg]."""
    coupling: np.ndarray
    right: np.ndarray
    """(N, S) right-hand sides [m/s²]."""
    matrix: np.ndarray
    """(N, N) of the first links [1/kg]."""

    @classmethod
    def zeros(cls, size: int, system: System) -> Motion:
        """Return arrays for `size` environments."""
        e, n, s = size, system.num_drones, int(system.cable_segments.max())
        b = 1 + n
        shapes = (
            (e, b, 3), (e, b, 3), (e, b, 3, 3), (e, b, 3), (e, n, s), (e, n), (e, n), (e,),
            (b, 3), (b, 3), (b, 3), (b, 6), (b, 3), (b, 3), (n, 2, 3), (n, 3), (n, s, 3), (n, s - 1, 3),
            (b, 3), (b, 3), (1,), (n, s), (n, s), (n, s), (n, s), (n, s), (n, n),
        )  # fmt: skip
        return cls(*(np.zeros(shape) for shape in shapes))


def largest_substep(system: System) -> int:
    """Return the longest substep that bending, which is explicit, allows: a power of two, of `UNITS` to a step."""
    longest = min(_SUBSTEP, system.timestep, 1 / max(system.bending_rate, 1e-9))
    return 2 ** max(0, int(np.log2(longest * UNITS / system.timestep)))
