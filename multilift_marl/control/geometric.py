"""The geometric controller on SO(3) of each drone (report eqs 25-32; Lee, Leok and McClamroch, CDC 2010).

Its levels follow one another: position and velocity → force (`desired_force`) → attitude and body rates
(`thrust_frame`, `desired_rates`) → torque (`attitude_torque`, `rate_torque`) → rotors (`allocate`). `fly` computes all
of them, `fly_rates` begins at the body rates; `setpoints` prepares the references of the levels in between.
"""

from __future__ import annotations

from math import cos, sin
from typing import NamedTuple

import numpy as np

from multilift_marl.control.allocation import allocate
from multilift_marl.control.gains import drone_gains
from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    add,
    column,
    cross,
    dot,
    mat,
    matmul,
    mul,
    norm,
    row,
    scale,
    sub,
    thrust_frame,
    tmul,
    transpose,
    unit,
    vec,
)
from multilift_marl.physical import GRAVITY


class AttitudeCommand(NamedTuple):
    """What the autopilots of E teams are asked for."""

    attitude: np.ndarray
    """(E, N, 3, 3) desired."""
    rates: np.ndarray
    """(E, N, 3) at which to turn to it, body frame [rad/s]."""
    thrust: np.ndarray
    """(E, N) of all rotors [N]."""


@kernel
def desired_rates(attitude, force, force_rate, yaw, yaw_rate):
    """Return Ω_d, the body rates of the frame that `thrust_frame` turns with force and yaw [rad/s].

    With b3 = F/|F| and b2 = c/|c|, c = b3 × (cos ψ, sin ψ, 0), the derivatives of the unit vectors are those parts of
    Ḟ/|F| and ċ/|c| that are perpendicular to b3 and b2; Ω_d = (-b2·ḃ3, b1·ḃ3, -b1·ḃ2).

    Args:
        attitude: R_d = thrust_frame(force, yaw), 9 numbers.
        force, force_rate: F [N], Ḟ [N/s].
        yaw, yaw_rate: ψ [rad], ψ̇ [rad/s].
    """
    # ḃ3: the part of Ḟ/|F| across b3. The floors keep the rates finite where a force vanishes or points along the
    # heading.
    b1, b2, b3 = column(attitude, 0), column(attitude, 1), column(attitude, 2)
    b3_rate = scale(1.0 / max(norm(force), 1e-6), sub(force_rate, scale(dot(force_rate, b3), b3)))
    heading = (cos(yaw), sin(yaw), 0.0)
    heading_rate = (-yaw_rate * sin(yaw), yaw_rate * cos(yaw), 0.0)
    side_rate = add(cross(b3_rate, heading), cross(b3, heading_rate))
    # b1 · ḃ2, with ḃ2 the part of ċ/|c| across b2.
    turning = dot(b1, side_rate) / max(norm(cross(b3, heading)), 1e-3)
    return (-dot(b2, b3_rate), dot(b1, b3_rate), -turning)


@kernel
def attitude_error(attitude, desired, desired_rate):
    """Return e_R of eq 31, and Ω_d in the body frame, Rᵀ R_d Ω_d; arguments are those of `attitude_torque`."""
    # e_R = ½ (R_dᵀ R - Rᵀ R_d)^∨: the antisymmetric part of `error`, whose (2,1), (0,2), (1,0) entries less their
    # mirror images are the three components.
    error = matmul(transpose(desired), attitude)
    e_r = (0.5 * (error[7] - error[5]), 0.5 * (error[2] - error[6]), 0.5 * (error[3] - error[1]))
    # e_Ω = Ω - Rᵀ R_d Ω_d: Ω_d is in the desired frame and must be brought into the body's.
    return e_r, mul(transpose(error), desired_rate)


@kernel
def attitude_torque(attitude, rates, desired, desired_rate, g):
    """Return the torque M of eqs 31-32 with Ω̇_d = 0 [N m].

    Args:
        attitude, desired: R and R_d, 9 numbers each.
        rates, desired_rate: Ω and Ω_d in their own frames [rad/s].
        g: DroneGains.
    """
    e_r, rotated = attitude_error(attitude, desired, desired_rate)
    e_w = sub(rates, rotated)
    momentum = (g.inertia[0] * rates[0], g.inertia[1] * rates[1], g.inertia[2] * rates[2])
    gyroscopic = cross(rates, momentum)
    # Of eq 32 the part Ω × Rᵀ R_d Ω_d; gains are for unit inertia, so that J stands before all of the feedback.
    transport = cross(rates, rotated)
    return (
        gyroscopic[0] - g.inertia[0] * (g.k_R[0] * e_r[0] + g.k_w[0] * e_w[0] + transport[0]),
        gyroscopic[1] - g.inertia[1] * (g.k_R[1] * e_r[1] + g.k_w[1] * e_w[1] + transport[1]),
        gyroscopic[2] - g.inertia[2] * (g.k_R[2] * e_r[2] + g.k_w[2] * e_w[2] + transport[2]),
    )


@kernel
def rate_torque(rates, desired, g):
    """Return the torque that turns body rates Ω into desired ones, Ω × JΩ - J k_w (Ω - Ω_d) [N m]."""
    momentum = (g.inertia[0] * rates[0], g.inertia[1] * rates[1], g.inertia[2] * rates[2])
    gyroscopic = cross(rates, momentum)
    return (
        gyroscopic[0] - g.inertia[0] * g.k_w[0] * (rates[0] - desired[0]),
        gyroscopic[1] - g.inertia[1] * g.k_w[1] * (rates[1] - desired[1]),
        gyroscopic[2] - g.inertia[2] * g.k_w[2] * (rates[2] - desired[2]),
    )


@kernel
def hook_moment(n, attitude, cable_force, acceleration, g):
    """Return the moment of the cable about the drone's centre of mass that its rotors are to hold [N m].

    Args:
        n: the drone.
        attitude: R, 9 numbers.
        cable_force: force that the drone exerts on its cable, at the hook [N].
        acceleration: of the set-point, which the load follows [m/s²].
        g: Gains.
    """
    if not g.hooked:
        return (0.0, 0.0, 0.0)
    # The rotors must balance the cable's moment, hook × (-P), which takes hook × P.
    return cross(row(g.hooks, n), tmul(attitude, add(cable_force, scale(g.load_share[n], acceleration))))


@kernel
def desired_force(feedback, acceleration, velocity, cable_force, attitude, g):
    """Return the force [N] that a drone's rotors are to exert, world frame.

    The nominal force on the cable, the inertia of the load that hangs on it and the drag are fed forward.

    Args:
        feedback: acceleration that corrects the errors, negative [m/s²].
        acceleration: of the set-point [m/s²].
        velocity: of the set-point, for the drag [m/s].
        cable_force: force that the drone exerts on its cable [N].
        attitude: R, 9 numbers.
        g: DroneGains.
    """
    # (m + m_L) a_d - m (k_p e_p + k_v e_v): feedback is for the drone's own mass, feed-forward for its share of the
    # load, too.
    force = sub(scale(g.mass + g.load_share, acceleration), scale(g.mass, feedback))
    force = add(force, cable_force)
    # R D Rᵀ v_d, of the set-point: with the drone's own velocity it would take its damping away.
    air = tmul(attitude, velocity)
    force = add(force, mul(attitude, (g.drag[0] * air[0], g.drag[1] * air[1], g.drag[2] * air[2])))
    # Not downward: eq 28 follows the force wherever it points, and would turn the drone over.
    return (force[0], force[1], max(force[2] + g.mass * GRAVITY, 0.1 * g.mass * GRAVITY))


@kernel
def following_force(e, n, state, reference, cable, g):
    """Return the force [N] with which drone n of environment e follows its reference, world frame.

    Args:
        e, n: environment and drone.
        state, reference: SystemState, Reference.
        cable: force that the drone is to exert on its cable [N].
        g: DroneGains.
    """
    velocity = vec(reference.velocity, e, n)
    position_error = sub(vec(state.drone_position, e, n), vec(reference.position, e, n))
    velocity_error = sub(vec(state.drone_velocity, e, n), velocity)
    feedback = add(scale(g.k_p, position_error), scale(g.k_v, velocity_error))
    attitude = mat(state.drone_rotation, e, n)
    return desired_force(feedback, vec(reference.acceleration, e, n), velocity, cable, attitude, g)


@kernel
def thrust_along(force, attitude):
    """Return the total thrust [N] of a desired force along the actual body z axis, F · R e3 (Lee 2010), not negative.

    In place of eq 27's |a_d|.
    """
    return max(dot(force, unit(column(attitude, 2))), 0.0)


@kernel
def command_attitude(lo, hi, state, reference, cable_force, command, g):
    """Compute attitudes, body rates and total thrusts by which drones follow their references, for autopilots.

    The rates are those at which the torque of eq 32 vanishes but for the gyroscopic part: Rᵀ R_d Ω_d - k_R/k_Ω e_R.

    Args:
        lo, hi: the environments.
        state, reference, cable_force, g: see `fly`.
        command: AttitudeCommand, written.
    """
    for e in range(lo, hi):
        for n in range(command.thrust.shape[1]):
            d = drone_gains(g, n)
            attitude = mat(state.drone_rotation, e, n)
            force = following_force(e, n, state, reference, vec(cable_force, e, n), d)
            frame = thrust_frame(force, reference.yaw[e, n])
            force_rate = scale(d.mass + d.load_share, vec(reference.jerk, e, n))
            turning = desired_rates(frame, force, force_rate, reference.yaw[e, n], reference.yaw_rate[e, n])
            e_r, turning = attitude_error(attitude, frame, turning)
            for k in range(9):
                command.attitude[e, n, k // 3, k % 3] = frame[k]
            for k in range(3):
                command.rates[e, n, k] = turning[k] - d.k_R[k] / d.k_w[k] * e_r[k]
            command.thrust[e, n] = thrust_along(force, attitude)


@kernel
def fly(lo, hi, state, reference, cable_force, thrust, g, tilt_rates=None):
    """Compute the rotor thrusts with which the drones of environments lo to hi follow their references.

    Position, velocity, acceleration, jerk and yaw are followed together. A reference whose position is the drone's own
    gives a velocity controller, one whose velocity is, too, an acceleration controller: the errors are then zero.

    Args:
        lo, hi: the environments.
        state: SystemState.
        reference: Reference to follow.
        cable_force: force that each drone is to exert on its cable (E, N, 3) [N].
        thrust: written, (E, N, 4) [N].
        g: Gains.
        tilt_rates: (E, N, 3), whose first two are roll and pitch rate of the desired attitude [rad/s]; None: they
            follow from the jerk.
    """
    for e in range(lo, hi):
        for n in range(thrust.shape[1]):
            d = drone_gains(g, n)
            attitude = mat(state.drone_rotation, e, n)
            cable = vec(cable_force, e, n)
            yaw = reference.yaw[e, n]

            # Position and velocity errors to the desired force.
            force = following_force(e, n, state, reference, cable, d)

            # Force and its rate to the desired attitude and its body rates.
            desired = thrust_frame(force, yaw)
            force_rate = scale(d.mass + d.load_share, vec(reference.jerk, e, n))
            desired_rate = desired_rates(desired, force, force_rate, yaw, reference.yaw_rate[e, n])
            if tilt_rates is not None:
                desired_rate = (tilt_rates[e, n, 0], tilt_rates[e, n, 1], desired_rate[2])

            total = thrust_along(force, attitude)
            torque = attitude_torque(attitude, vec(state.drone_body_rates, e, n), desired, desired_rate, d)
            torque = add(torque, hook_moment(n, attitude, cable, vec(reference.acceleration, e, n), g))
            rotors = allocate(total, torque, d.allocation, d.thrust_min, d.thrust_max)
            for k in range(4):
                thrust[e, n, k] = rotors[k]


@kernel
def fly_rates(lo, hi, state, setpoint, cable_force, thrust, g):
    """Compute the rotor thrusts that turn drones at the body rates of a Setpoint, at its total thrust.

    The moment of the cables at the hooks is held beside. Arguments are those of `fly`.
    """
    for e in range(lo, hi):
        for n in range(thrust.shape[1]):
            d = drone_gains(g, n)
            torque = rate_torque(vec(state.drone_body_rates, e, n), vec(setpoint.rates, e, n), d)
            moment = hook_moment(n, mat(state.drone_rotation, e, n), vec(cable_force, e, n), (0.0, 0.0, 0.0), g)
            rotors = allocate(setpoint.thrust[e, n], add(torque, moment), d.allocation, d.thrust_min, d.thrust_max)
            for k in range(4):
                thrust[e, n, k] = rotors[k]
