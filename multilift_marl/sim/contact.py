"""Contact of ground, payload and drones: where they touch, how stiffly, and when they might."""

from __future__ import annotations

from itertools import combinations, product

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import dot, norm, row, sub, vec
from multilift_marl.rig.obstacles import NONE
from multilift_marl.rig.restitution import FRICTION, STICKING, contact_law
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicle import Vehicle
from multilift_marl.sim.obstacle_bodies import box_distance, obstacle_names

_FAST = 2.0  # [m/s] bodies that approach each other no faster meet before they can pass each other
_SPECULATIVE = int(mujoco.mjtEnableBit.mjENBL_SPECULATIVE)
_NO_CONTACT = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
_SOLVER = mujoco.mjtSolver
APART, NEAR, FAST = range(3)


def drone_half_size(vehicle: Vehicle) -> np.ndarray:
    """Return the half edges (3,) of a drone's collision box [m]."""
    return vehicle.half_size


def add_contact(spec: mujoco.MjSpec, system: System, visuals: bool) -> None:
    """Let ground, obstacles, payload and drones touch, by pairs: cheaper than MuJoCo's sweep over all bodies.

    The contacts' parameters are in the `pair_*` fields of the compiled model, not in those of its geoms. The cone of
    friction is round, so that it is the same in all directions.
    """
    spec.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    spec.option.impratio = STICKING
    stiffness, damping = contact_law(system.contact.restitution, system.timestep)
    friction = [system.contact.friction] * 2 + [0.005, 1e-4, 1e-4]  # the last three count for other kinds of contact
    bodies = ["payload", *(f"drone_{i}" for i in range(system.num_drones))]
    obstacles = [] if visuals else obstacle_names(system)
    for name in ("floor", *bodies, *obstacles):
        # Without its bits a geom meets others by the pairs below alone.
        spec.geom(name).contype = spec.geom(name).conaffinity = 0
    for one, other in (*combinations(["floor", *bodies], 2), *product(obstacles, bodies)):
        # Direct stiffness and damping, over the mass that the contact moves: MuJoCo's negative solref.
        spec.add_pair(
            geomname1=one, geomname2=other, friction=friction,
            solref=[-stiffness, -damping], solreffriction=[0.0, -FRICTION / system.timestep],
        )  # fmt: skip


def body_radii(system: System) -> np.ndarray:
    """Return the radii (1 + N,) of spheres about payload and drones, at the origins of their frames [m]."""
    payload = np.linalg.norm(system.payload_size / 2) + np.linalg.norm(system.payload_center)
    return np.array([payload, *(np.linalg.norm(drone_half_size(vehicle)) for vehicle in system.vehicles)])


@kernel
def find_close(lo, state, proximity, radii, timestep, obstacles):
    """Find the environments in which bodies might touch: APART, NEAR, or FAST.

    Contacts need not be searched where the spheres about bodies are apart from each other, above the ground and away
    from obstacles, as in most steps. FAST are bodies that would be behind each other within a step before a contact is
    found.

    Args:
        lo: the first of the environments.
        state: SystemState.
        proximity: (environments,) int8, written.
        radii: `body_radii` (1 + N,) [m].
        timestep: [s].
        obstacles: Obstacles.

    Returns:
        Whether any of `proximity` has changed.
    """
    count = radii.shape[0]
    changed = False
    for i in range(proximity.shape[0]):
        e = lo + i
        # Where all are slower than half of the limit, as in most steps, no two approach each other fast.
        velocity = row(state.payload_velocity, e)
        quickest = dot(velocity, velocity)
        for n in range(count - 1):
            velocity = vec(state.drone_velocity, e, n)
            quickest = max(quickest, dot(velocity, velocity))
        quick = 4.0 * quickest > _FAST * _FAST

        # The ground, then pairs of a drone with the payload and with the drones before it.
        found = NEAR if state.payload_position[e, 2] < radii[0] else APART
        for b in range(1, count):
            position = vec(state.drone_position, e, b - 1)
            velocity = vec(state.drone_velocity, e, b - 1)
            if position[2] < radii[b]:
                found = max(found, NEAR)
            for j in range(b):
                other = row(state.payload_position, e) if j == 0 else vec(state.drone_position, e, j - 1)
                offset = sub(position, other)
                square, reach = dot(offset, offset), radii[b] + radii[j]
                if square < reach * reach:
                    found = max(found, NEAR)
                if quick:
                    other = row(state.payload_velocity, e) if j == 0 else vec(state.drone_velocity, e, j - 1)
                    relative = sub(velocity, other)
                    speed = norm(relative)
                    reach += 2.0 * timestep * speed
                    if dot(offset, relative) < 0.0 and speed > _FAST and square < reach * reach:
                        found = FAST
        if obstacles.kind.shape[1] > 0:
            found = max(found, _find_obstacle(e, state, radii, timestep, obstacles))
        changed = changed or proximity[i] != found
        proximity[i] = found
    return changed


@kernel
def _find_obstacle(e, state, radii, timestep, obstacles):
    """Return how near any body is to any obstacle: APART, NEAR or FAST."""
    found, payload = APART, row(state.payload_position, e)
    # First by a sphere about the whole team, with room for what a step may bring of 10 m/s.
    team = radii[0]
    for b in range(1, radii.shape[0]):
        team = max(team, norm(sub(vec(state.drone_position, e, b - 1), payload)) + radii[b])
    team += 20.0 * timestep
    for m in range(obstacles.kind.shape[1]):
        if obstacles.kind[e, m] == NONE or box_distance(e, m, payload, obstacles) > team:
            continue
        for b in range(radii.shape[0]):
            position = payload if b == 0 else vec(state.drone_position, e, b - 1)
            velocity = row(state.payload_velocity, e) if b == 0 else vec(state.drone_velocity, e, b - 1)
            distance = box_distance(e, m, position, obstacles)
            if distance < radii[b]:
                found = max(found, NEAR)
            speed = norm(sub(velocity, vec(obstacles.velocity, e, m)))
            if speed > _FAST and distance < radii[b] + 2.0 * timestep * speed:
                found = FAST
    return found


def search_contacts(batch: Batch, proximity: np.ndarray) -> None:
    """Let MuJoCo search for contacts where bodies might touch, by `proximity` (n,) of `find_close`.

    Where they are FAST, it also searches for those of the step to come, which takes a seventh of a step's time. Sliding
    contacts take conjugate gradients twelve times as long as Newton's method, which without contacts takes longer.
    """
    solver = batch.expand("opt.solver").reshape(len(proximity), -1)[:, 0]
    solver[:] = np.where(proximity == APART, _SOLVER.mjSOL_CG, _SOLVER.mjSOL_NEWTON)
    for name, bit, wanted in (
        ("disable", _NO_CONTACT, proximity == APART),
        ("enable", _SPECULATIVE, proximity == FAST),
    ):
        flags = batch.expand(f"opt.{name}flags").reshape(len(proximity), -1)[:, 0]
        flags[:] = np.where(wanted, flags | bit, flags & ~bit)
