"""Rejection of unknown forces on a drone: wind, a payload heavier than thought, or whatever else moves it.

The estimate is added to the nominal force on the drone's cable, which every set-point feeds forward.
"""

from __future__ import annotations

from math import exp
from typing import NamedTuple

import numpy as np

from multilift_marl.control.gains import Gains, limited
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, column, limit, mat, mul, norm, put, scale, sub, tmul, vec
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.constants import make_rig
from multilift_marl.rig.system import System
from multilift_marl.schema.control import ControlConfig

# Bandwidth over ω_p m/(m + m_L), at most: ω_p of the position loop, m and m_L the masses of a drone and of its load.
# The share m_L/(m + m_L) of a thrust comes back through the cable, which slows any loop around the drone. Faster,
# the rejection would drive a payload that swings slower than the drones move, in place of damping it.
BANDWIDTH = {"integral": 0.5, "indi": 1.0}


class Disturbance(NamedTuple):
    """What the rejection remembers."""

    force: np.ndarray
    """(E, N, 3) estimated force that the drone has to overcome beside the nominal ones, world frame [N]."""
    velocity: np.ndarray
    """(E, N, 3) of the drone one control step ago [m/s]."""
    cable_force: np.ndarray
    """(E, N, 3) nominal cable force and estimate: what the controller feeds forward [N]."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> Disturbance:
        """Return estimates of zero."""
        return cls(*(np.zeros((num_envs, num_drones, 3)) for _ in cls._fields))


class Rejection(NamedTuple):
    """Numbers of a rejection."""

    dt: float
    """Control step [s]."""
    share: np.ndarray
    """(N,) of the gap to the measured force that the filtered one closes in a step, 1 - exp(-ω dt)."""
    gain: np.ndarray
    """(N,) of the integral, m k_p ω [N/(m s)]."""
    largest: np.ndarray
    """(N,) limit of the estimate [N]."""
    thrust_coefficient: np.ndarray
    """(N,) [N s²]."""
    gains: Gains
    """Of the controller, which says what is fed forward."""


def make_rejection(control: ControlConfig, system: System, g: Gains, dt: float) -> Rejection:
    """Return the numbers of `control.disturbance`, "integral" or "indi", for control steps of dt [s]."""
    own_share = g.mass / (g.mass + max(g.load_share.max(), 0.0))
    slowest = BANDWIDTH[control.disturbance] * np.sqrt(g.k_p) * own_share
    frequency = limited(control, "disturbance_frequency", slowest, "what the load lets through")
    return Rejection(
        dt=dt,
        # Exact for a first-order filter whose input is held over a step: stable at any frequency.
        share=np.array([1 - exp(-each * dt) for each in frequency]),
        gain=g.mass * g.k_p * frequency,
        largest=control.disturbance_limit * g.mass * GRAVITY,
        thrust_coefficient=make_rig(system).thrust_coefficient,
        gains=g,
    )


@kernel
def rotor_force(e, n, state, thrust_coefficient):
    """Return the force of drone n's rotors at their present speeds, Σ b ω² R e3 [N]."""
    total = 0.0
    for k in range(4):
        total += thrust_coefficient * state.rotor_speed[e, n, k] ** 2
    return scale(total, column(mat(state.drone_rotation, e, n), 2))


@kernel
def reset_estimate(e, state, disturbance):
    """Let the estimates of environment e start anew."""
    for n in range(disturbance.force.shape[1]):
        disturbance.force[e, n] = 0.0
        put(disturbance.velocity[e, n], vec(state.drone_velocity, e, n))


@kernel
def integrate_error(lo, hi, state, reference, cable_force, disturbance, c):
    """Add the integral of the position error to the cable forces of environments lo to hi: `integral`.

    F_i = -m k_p ω ∫ (p - p_d) dt, no longer than the limit. While a rotor is at its limit the integral may only shrink.

    Args:
        lo, hi: the environments.
        state, reference: SystemState, Reference.
        cable_force: nominal (E, N, 3) [N].
        disturbance: Disturbance, written.
        c: Rejection.
    """
    g = c.gains
    for e in range(lo, hi):
        for n in range(cable_force.shape[1]):
            low, high = g.thrust_min[n], g.thrust_max[n]
            saturated = False  # within 1 % of the range
            for k in range(4):
                thrust = c.thrust_coefficient[n] * state.rotor_speed[e, n, k] ** 2
                # Anti-windup, by the rotors' speeds: what acts is their thrust, not the command.
                saturated = saturated or thrust > high - 0.01 * high or thrust < low + 0.01 * high
            # A drone beyond its reference (positive error) is to push back: hence the minus.
            error = sub(vec(state.drone_position, e, n), vec(reference.position, e, n))
            before = vec(disturbance.force, e, n)
            force = limit(sub(before, scale(c.gain[n] * c.dt, error)), c.largest[n])
            if saturated and norm(force) > norm(before):
                force = before
            put(disturbance.force[e, n], force)
            put(disturbance.cable_force[e, n], add(vec(cable_force, e, n), force))


@kernel
def estimate_force(lo, hi, state, reference, cable_force, disturbance, c):
    """Add the measured external force to the cable forces of environments lo to hi: `indi`.

    What moved the drone over the last control step is m Δv/Δt = F_rotors - m g e3 - (cable force, load and drag that
    are fed forward) - F. The rotors' force comes from their speeds, so their lag and limits are in it; acceleration and
    force pass the same first-order low-pass filter, here as one number (Smeur, de Croon and Chu, Control Engineering
    Practice 73, 2018; Tal and Karaman, IEEE TCST 29(3), 2021). Arguments are those of `integrate_error`.
    """
    g = c.gains
    for e in range(lo, hi):
        for n in range(cable_force.shape[1]):
            # What the controller feeds forward.
            velocity = vec(state.drone_velocity, e, n)
            rotors = rotor_force(e, n, state, c.thrust_coefficient[n])
            nominal = vec(cable_force, e, n)
            attitude = mat(state.drone_rotation, e, n)
            air = tmul(attitude, vec(reference.velocity, e, n))
            drag = mul(attitude, (g.drag[n, 0] * air[0], g.drag[n, 1] * air[1], g.drag[n, 2] * air[2]))
            fed_forward = add(add(nominal, drag), scale(g.load_share[n], vec(reference.acceleration, e, n)))

            # What the rotors exert beyond that and beyond what moves the drone, filtered and limited.
            inertial = scale(g.mass[n] / c.dt, sub(velocity, vec(disturbance.velocity, e, n)))
            # m (Δv/Δt + g e3), what moves the drone and holds it up.
            used = add(inertial, (0.0, 0.0, g.mass[n] * GRAVITY))
            before = vec(disturbance.force, e, n)
            # What the rotors exert = what moves the drone + what is fed forward + F. `before` makes the filter's step F
            # += share (F_measured - F).
            gap = sub(sub(sub(rotors, used), fed_forward), before)
            force = limit(add(before, scale(c.share[n], gap)), c.largest[n])
            put(disturbance.force[e, n], force)
            put(disturbance.velocity[e, n], velocity)
            put(disturbance.cable_force[e, n], add(nominal, force))


REJECTIONS = {"integral": integrate_error, "indi": estimate_force}
