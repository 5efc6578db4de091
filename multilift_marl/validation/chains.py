"""Chains below fixed anchors, and what eqs 14-16 of the report say about them, solved without MuJoCo."""

from __future__ import annotations

from typing import Any

import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.physical import GRAVITY
from multilift_marl.sim.world import REST_HEIGHT, World

ROPE = 0.01  # [kg/m]
SEGMENTS = 10
_ANCHOR_MASS = 1e6  # [kg] of what holds the upper ends; it moves by less than 1e-6 m


def hanging_chain(
    mass: float, timestep: float, cables: int = 1, angle: float = 0.0, **overrides: Any
) -> tuple[World, np.ndarray]:
    """Return a load below fixed anchors on chains of 1 m, straight and at their natural length.

    It is the package's own simulation, with drones so heavy that they stay where they are, held against gravity and
    against what the load will weigh.

    Args:
        mass: of the load, a point [kg].
        timestep: [s].
        cables: evenly spaced about the vertical.
        angle: of the cables from the vertical [rad].
        **overrides: configuration values by name, with __ for the dot.

    Returns:
        The world before its first step, and the thrusts that hold the drones (1, N, 4) [N].
    """
    values = {
        "env.num_drones": cables, "cable.model": "chain", "cable.length": 1.0, "cable.angle": float(np.rad2deg(angle)),
        "cable.density": ROPE, "cable.segments": SEGMENTS, "cable.bending_damping": 0.0, "payload.shape": "point",
        "payload.mass": mass, "payload.drag_area": 0.0, "vehicle.mass": _ANCHOR_MASS,
        "vehicle.inertia": (_ANCHOR_MASS,) * 3, "vehicle.rotor_thrust_max": 10 * _ANCHOR_MASS,
        "vehicle.thrust_coefficient": 1.0, "vehicle.drag": (0.0, 0.0, 0.0), "vehicle.rotor_inertia": 0.0,
        "sim.timestep": timestep, "sim.control_hz": 1 / timestep,
    }  # fmt: skip
    system = load_config("hover", values | {key.replace("__", "."): value for key, value in overrides.items()}).system
    world = World(system, 1, 1)
    direction = system.formation_force / np.linalg.norm(system.formation_force, axis=1, keepdims=True)
    world.state.payload_position[0] = [0.0, 0.0, REST_HEIGHT]
    world.state.drone_position[0] = world.state.payload_position[0] + system.anchors + direction
    world.load(np.ones(1, bool))
    assert world.nodes is not None
    share = np.arange(1, SEGMENTS)[:, None] / SEGMENTS
    world.nodes.position[0] = world.state.payload_position[0] + system.anchors[:, None] + share * direction[:, None]
    world.nodes.velocity[:] = 0.0
    force = np.linalg.norm(system.hook_force + [0, 0, _ANCHOR_MASS * GRAVITY], axis=1)
    return world, np.tile(force[:, None] / 4, (1, 1, 4))


def tested_stiffness(world: World) -> float:
    """Return the stiffness [N/m] of the first cable of a load at rest: its tensions over its stretches.

    The tensions are what statics says: the load's share below, one node's weight more with every segment, and the
    horizontal force that goes with the direction of the lowest link.
    """
    system = world.system
    links = np.diff(world.cable_points(0, 0), axis=0)
    n = len(links)
    size = np.linalg.norm(links, axis=1)
    lowest = links[0] / size[0]
    share = system.payload_mass * GRAVITY / system.num_drones
    upward = share + GRAVITY * system.cable_mass[0] / (n - 1) * np.arange(n)
    tension = np.hypot(upward, share * np.hypot(lowest[0], lowest[1]) / lowest[2])
    return float(tension.sum() / (n * np.sum(size - system.cable_length[0] / n)))


def exponential(matrix: np.ndarray) -> np.ndarray:
    """Return the exponential of a square matrix, by Taylor's series of matrix/2^k and k squarings."""
    halvings = max(0, int(np.ceil(np.log2(np.linalg.norm(matrix, 1))))) + 4
    term = total = np.eye(len(matrix))
    for order in range(1, 14):
        term = term @ matrix / 2**halvings / order
        total = total + term
    for _ in range(halvings):
        total = total @ total
    return total


def straight_chain(mass: float, stiffness: float, damping: float, gravity: float, t: np.ndarray) -> np.ndarray:
    """Return the elongation (T,) [m] of a vertical chain that is let go at its natural length.

    The matrix exponential of SEGMENTS masses, springs and dampers, the last mass being the load.

    Args:
        mass: of the load [kg].
        stiffness, damping: of the whole chain [N/m], [N s/m].
        gravity: along the chain [m/s²].
        t: evenly spaced times, the first one step after the start (T,) [s].
    """
    n = SEGMENTS
    masses = np.full(n, ROPE / (n - 1))  # of the nodes between the segments
    masses[-1] = mass
    # Fixed above, free below.
    springs = np.diag(np.r_[np.full(n - 1, 2.0), 1.0]) - np.eye(n, k=1) - np.eye(n, k=-1)
    rest = np.linalg.solve(n * stiffness * springs, gravity * masses)
    inverse = 1 / masses[:, None]
    flow = np.block(
        [[np.zeros((n, n)), np.eye(n)], [-n * stiffness * springs * inverse, -n * damping * springs * inverse]]
    )
    propagator = exponential(flow * t[0])
    # Counted from the equilibrium, `rest` below the natural length.
    state = np.r_[-rest, np.zeros(n)]
    depth = []
    for _ in t:
        state = propagator @ state
        depth.append(state[n - 1] + rest[-1])
    return np.array(depth)


def inclined_chains(
    mass: float, stiffness: float, damping: float, cables: int, angle: float, t: np.ndarray, step: float = 5e-5
) -> np.ndarray:
    """Return the depth (T,) [m] of a load that evenly spaced inclined chains let go at their natural length.

    Unlike `straight_chain`, chains of a load that is light against them sag while they stretch. One of them, in its
    plane, is solved by the implicit midpoint rule in Cartesian coordinates.

    Args:
        mass, stiffness, damping: as in `straight_chain`.
        cables: number of chains.
        angle: from the vertical [rad].
        t: times (T,) [s], multiples of `step`.
        step: of the midpoint rule [s]; its error is of second order in it.
    """
    n = SEGMENTS
    link = 1.0 / SEGMENTS
    along = np.array([np.sin(angle), np.cos(angle)])
    place = link * np.arange(n)[:, None] * along  # the load and the n - 1 free nodes; horizontal, vertical
    velocity = np.zeros_like(place)
    top = along
    masses = np.full((n, 2), ROPE / (n - 1))
    masses[0] = mass / cables
    free = np.ones(2 * n, bool)
    free[0] = False  # by symmetry the load moves vertically
    times = np.round(t / step).astype(int)
    depth = []
    kept = 0
    for i in range(1, times[-1] + 1):
        change = np.zeros_like(velocity)
        for _ in range(20):  # Newton's method for the change of velocity
            middle = place + 0.5 * step * (velocity + 0.5 * change)
            speed = velocity + 0.5 * change
            force, by_place, by_speed = _cable_forces(middle, speed, top, link, n * stiffness, n * damping)
            gap = (masses * change - step * (force - masses * [0, GRAVITY])).ravel()
            # A change of velocity moves the middle by h/4 of it, and the velocity there by half of it.
            slope = np.diag(masses.ravel()) + step * (0.25 * step * by_place + 0.5 * by_speed)
            correction = np.zeros(2 * n)
            correction[free] = np.linalg.solve(slope[np.ix_(free, free)], gap[free])
            change -= correction.reshape(n, 2)
            if np.abs(correction).max() < 1e-13:
                break
        place = place + step * (velocity + 0.5 * change)
        velocity = velocity + change
        if i == times[kept]:
            depth.append(-place[0, 1])
            kept += 1
    return np.array(depth)


def _cable_forces(
    place: np.ndarray, velocity: np.ndarray, top: np.ndarray, length: float, stiffness: float, damping: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return forces (n, 2) of eqs 14-15 on the nodes, and minus their derivatives by place and velocity (2n, 2n)."""
    n = len(place)
    link = np.diff(np.vstack([place, top]), axis=0)
    opening = np.diff(np.vstack([velocity, [0.0, 0.0]]), axis=0)
    size = np.linalg.norm(link, axis=1, keepdims=True)
    along = link / size
    tension = stiffness * (size - length) + damping * (along * opening).sum(axis=1, keepdims=True)
    force = tension * along
    total = force.copy()
    total[1:] -= force[:-1]
    outer = along[:, :, None] * along[:, None, :]
    # A tense link that turns resists by T/l.
    across = (tension / size)[..., None] * (np.eye(2) - outer)
    by_place, by_speed = np.zeros((2, n, 2, n, 2))
    for blocks, sums in ((stiffness * outer + across, by_place), (damping * outer, by_speed)):
        for j in range(n):
            sums[j, :, j] += blocks[j]
            if j + 1 < n:
                sums[j + 1, :, j + 1] += blocks[j]
                sums[j, :, j + 1] -= blocks[j]
                sums[j + 1, :, j] -= blocks[j]
    return total, by_place.reshape(2 * n, 2 * n), by_speed.reshape(2 * n, 2 * n)
