"""The physical state: plain arrays with the environment as first axis. E environments, N drones."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, cross, mat, mul, norm, put, putmat, row, sub, thrust_frame, tmul, vec
from multilift_marl.physical import GRAVITY


class SystemState(NamedTuple):
    """The physical state (float64, SI units; world z up, body x forward, y left, z up)."""

    payload_position: np.ndarray
    """(E, 3) centre of mass as configured, a fixed point of the payload, world frame [m]."""
    payload_rotation: np.ndarray
    """(E, 3, 3) body to world; of a point payload what a task has set, without effect."""
    payload_velocity: np.ndarray
    """(E, 3) of that point, world frame [m/s]."""
    payload_body_rates: np.ndarray
    """(E, 3) body frame [rad/s]."""
    drone_position: np.ndarray
    """(E, N, 3) centre of mass, world frame [m]."""
    drone_rotation: np.ndarray
    """(E, N, 3, 3) body to world."""
    drone_velocity: np.ndarray
    """(E, N, 3) world frame [m/s]."""
    drone_body_rates: np.ndarray
    """(E, N, 3) body frame [rad/s]."""
    rotor_speed: np.ndarray
    """(E, N, 4) of each rotor, with its lag, never negative [rad/s]; times 30/π for revolutions per minute."""
    cable_tension: np.ndarray
    """(E, N) [N]. Massless: mean of the last physics step, exactly 0 when slack. Chain: now, next to the drone."""
    cable_broken: np.ndarray
    """(E, N) bool, once its tension has exceeded its breaking load, or by `World.break_cables`."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> SystemState:
        """Return a state at the origin."""
        e, n = num_envs, num_drones
        payload = ((e, 3), (e, 3, 3), (e, 3), (e, 3))
        drones = ((e, n, 3), (e, n, 3, 3), (e, n, 3), (e, n, 3), (e, n, 4), (e, n))
        state = cls._make((*(np.zeros(shape) for shape in (*payload, *drones)), np.zeros((e, n), bool)))
        state.payload_rotation[:] = np.eye(3)
        state.drone_rotation[:] = np.eye(3)
        return state


class HiddenLoads(NamedTuple):
    """True parameters and loads that may differ between environments and that no drone observes."""

    payload_mass: np.ndarray
    """(E,) [kg]."""
    payload_force: np.ndarray
    """(E, 3) constant external force on the payload's true centre of mass, world frame [N]."""
    wind: np.ndarray
    """(E, 3) air velocity, world frame [m/s]."""
    motors_off: np.ndarray
    """(E, N) bool, drones whose motors have stopped; `World.load` starts them again."""


class Air(NamedTuple):
    """Turbulence, gusts and downwash beside the mean wind, and their states; all zero where it is switched off."""

    gust: np.ndarray
    """(E, 3) turbulence and gust in the last physics step, the same for all bodies, world frame [m/s]."""
    downwash: np.ndarray
    """(E, N + 1, 3) downwash of the other drones at each drone, then at the payload, world frame [m/s]."""
    filter: np.ndarray
    """(E, 5) states of the turbulence filters: one of u, two each of v and w [-]."""
    generator: np.ndarray
    """(E,) uint64, state of the random numbers."""
    steps: np.ndarray
    """(E,) int64, physics steps since the reset, while there are gusts."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> Air:
        """Return still air."""
        return cls(
            np.zeros((num_envs, 3)), np.zeros((num_envs, num_drones + 1, 3)), np.zeros((num_envs, 5)),
            np.zeros(num_envs, np.uint64), np.zeros(num_envs, np.int64),
        )  # fmt: skip


class EpisodeStats(NamedTuple):
    """What accumulates over an episode, at every physics step."""

    energy: np.ndarray
    """(E,) ∫ Σ rotor torque · rotor speed [J]."""
    tension_min: np.ndarray
    """(E,) smallest cable tension [N]."""
    tension_max: np.ndarray
    """(E,) largest cable tension, mean of a physics step; of chains of its last substep [N]."""
    tension_peak: np.ndarray
    """(E,) largest cable tension, the peaks of snatches inside a step and all substeps included [N]."""
    slack_time: np.ndarray
    """(E,) time with any cable slack, or a chain whose tension at the drone is no more than its weight [s]."""
    stretch_max: np.ndarray
    """(E,) largest tension over stiffness, relative to the cable's length [-]."""

    @classmethod
    def zeros(cls, num_envs: int) -> EpisodeStats:
        """Return statistics without a step."""
        return cls(*(np.zeros(num_envs) for _ in cls._fields))


class SimData(NamedTuple):
    """The arrays of all environments that the compiled functions of a physics step write."""

    state: SystemState
    stats: EpisodeStats
    diverged: np.ndarray
    """(E,) bool, environments that are left as they are."""


@kernel
def hook_position(e, n, state, hooks):
    """Return where cable n is tied to its drone, world frame [m]."""
    return add(vec(state.drone_position, e, n), mul(mat(state.drone_rotation, e, n), row(hooks, n)))


@kernel
def place_at_hook(e, n, state, place, hooks):
    """Put drone n where its hook is at `place`, with the attitude that it has."""
    put(state.drone_position[e, n], sub(place, mul(mat(state.drone_rotation, e, n), row(hooks, n))))


@kernel
def hover_drone(e, n, state, cable_force, yaw, drones):
    """Let drone n of environment e hover: attitude and rotor speeds that hold its weight and `cable_force` [N].

    Args:
        e, n: environment and drone.
        state: SystemState, written.
        cable_force: that the drone exerts on its cable, world frame [N].
        yaw: heading [rad].
        drones: `rig.constants.RigArrays`.
    """
    # Thrust holds the weight and the cable, along the body z axis: the drone tilts away from its cable's pull.
    force = add(cable_force, (0.0, 0.0, drones.mass[n] * GRAVITY))
    attitude = thrust_frame(force, yaw)
    putmat(state.drone_rotation[e, n], attitude)

    # Rotors share the thrust evenly, or so that they hold the moment of a hook that is off the centre of mass.
    total = norm(force)
    torque = (0.0, 0.0, 0.0)
    if drones.hooked:
        # Rotors have to exert hook × P, against the cable's own moment hook × (-P).
        torque = cross(row(drones.hooks, n), tmul(attitude, cable_force))
    for k in range(4):
        square = total / (4.0 * drones.thrust_coefficient[n])
        if drones.hooked:
            a = drones.allocation[n, k]
            thrust = a[0] * total + a[1] * torque[0] + a[2] * torque[1] + a[3] * torque[2]
            # ω² = f/b; a rotor cannot push down.
            square = max(thrust, 0.0) / drones.thrust_coefficient[n]
        state.rotor_speed[e, n, k] = sqrt(square / drones.rotor_strength[n, k])
