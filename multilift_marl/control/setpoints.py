"""Set-points below the position: velocity, acceleration, attitude and body rates, each flown by one loop over a team.

All of them compose the levels of `geometric`. The position set-point is `geometric.fly`; rotor thrusts need no loop.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.control.allocation import allocate
from multilift_marl.control.formation import smooth_yaw
from multilift_marl.control.gains import drone_gains
from multilift_marl.control.geometric import (
    desired_rates,
    follow_attitude,
    follow_force,
    hook_moment,
    rate_torque,
    wanted_force,
)
from multilift_marl.math3d import add, column, dot, mat, put, scale, sub, thrust_frame, unit, vec

STILL = (0.0, 0.0, 0.0)


class Setpoint(NamedTuple):
    """What drones are told below the position, until the next action."""

    velocity: np.ndarray
    """(E, N, 3) world frame [m/s]."""
    rates: np.ndarray
    """(E, N, 3) body rates [rad/s]."""
    thrust: np.ndarray
    """(E, N) total thrust [N]."""

    @classmethod
    def zeros(cls, num_envs: int, num_drones: int) -> Setpoint:
        """Return set-points of zero."""
        e, n = num_envs, num_drones
        return cls(*(np.zeros(shape) for shape in ((e, n, 3), (e, n, 3), (e, n))))


@kernel
def smooth_velocity(lo, hi, state, reference, setpoint, frequency, dt):
    """Move the reference velocities of environments lo to hi one control step towards their set-points.

    The filter is critically damped, (s/ω + 1)², so that acceleration and jerk can be fed forward. The yaw moves at
    its rate; the reference position is the drone's own.
    """
    w = frequency
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            v, a = vec(reference.velocity, e, n), vec(reference.acceleration, e, n)
            jerk = sub(scale(w * w, sub(vec(setpoint.velocity, e, n), v)), scale(2.0 * w, a))
            a = add(a, scale(dt, jerk))
            put(reference.velocity[e, n], add(v, scale(dt, a)))
            put(reference.acceleration[e, n], a)
            put(reference.jerk[e, n], jerk)
            put(reference.position[e, n], vec(state.drone_position, e, n))
            reference.yaw[e, n] += dt * reference.yaw_rate[e, n]


@kernel
def fly_velocity(lo, hi, state, reference, cable_force, thrust, g):
    """Compute the rotor thrusts with which drones follow reference velocity, acceleration, jerk and yaw; see `fly`.

    The velocity error falls as exp(-k_v t).
    """
    for e in range(lo, hi):
        for n in range(thrust.shape[1]):
            velocity, d = vec(reference.velocity, e, n), drone_gains(g, n)
            feedback = scale(d.k_v, sub(vec(state.drone_velocity, e, n), velocity))
            attitude, acceleration = mat(state.drone_rotation, e, n), vec(reference.acceleration, e, n)
            force = wanted_force(feedback, acceleration, velocity, vec(cable_force, e, n), attitude, d)
            moment = hook_moment(n, attitude, vec(cable_force, e, n), acceleration, g)
            force_rate = scale(d.mass + d.load_share, vec(reference.jerk, e, n))
            rates, yaw, yaw_rate = vec(state.drone_body_rates, e, n), reference.yaw[e, n], reference.yaw_rate[e, n]
            rotors = follow_force(attitude, rates, force, force_rate, yaw, yaw_rate, moment, d)
            for k in range(4):
                thrust[e, n, k] = rotors[k]


@kernel
def track_own_state(lo, hi, state, reference, dt):
    """Let reference positions and velocities of environments lo to hi be the drones' own; the yaw moves at its rate."""
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            put(reference.position[e, n], vec(state.drone_position, e, n))
            put(reference.velocity[e, n], vec(state.drone_velocity, e, n))
            reference.yaw[e, n] += dt * reference.yaw_rate[e, n]


@kernel
def fly_acceleration(lo, hi, state, reference, cable_force, thrust, g):
    """Compute the rotor thrusts with which drones accelerate as their references do; see `fly`."""
    for e in range(lo, hi):
        for n in range(thrust.shape[1]):
            attitude, acceleration = mat(state.drone_rotation, e, n), vec(reference.acceleration, e, n)
            velocity, d = vec(reference.velocity, e, n), drone_gains(g, n)
            force = wanted_force(STILL, acceleration, velocity, vec(cable_force, e, n), attitude, d)
            moment = hook_moment(n, attitude, vec(cable_force, e, n), acceleration, g)
            rates, yaw, yaw_rate = vec(state.drone_body_rates, e, n), reference.yaw[e, n], reference.yaw_rate[e, n]
            rotors = follow_force(attitude, rates, force, STILL, yaw, yaw_rate, moment, d)
            for k in range(4):
                thrust[e, n, k] = rotors[k]


@kernel
def track_own_state_to_yaw(lo, hi, state, reference, frequency, dt):
    """Do as `drift`, but move the yaw towards the commanded one."""
    track_own_state(lo, hi, state, reference, 0.0)
    for e in range(lo, hi):
        for n in range(reference.yaw.shape[1]):
            smooth_yaw(e, n, reference, frequency, dt)


@kernel
def fly_acc_rates(lo, hi, state, reference, rates, cable_force, thrust, g):
    """Do as `fly_acceleration`, with the roll and pitch rates of the desired attitude given, (E, N, 3) [rad/s].

    An acceleration alone says nothing of how it will change: these rates feed forward what the jerk would.
    """
    for e in range(lo, hi):
        for n in range(thrust.shape[1]):
            attitude, acceleration = mat(state.drone_rotation, e, n), vec(reference.acceleration, e, n)
            velocity, d = vec(reference.velocity, e, n), drone_gains(g, n)
            force = wanted_force(STILL, acceleration, velocity, vec(cable_force, e, n), attitude, d)
            moment = hook_moment(n, attitude, vec(cable_force, e, n), acceleration, g)
            yaw, yaw_rate = reference.yaw[e, n], reference.yaw_rate[e, n]
            desired = thrust_frame(force, yaw)
            turning = desired_rates(desired, force, STILL, yaw, yaw_rate)
            desired_rate = (rates[e, n, 0], rates[e, n, 1], turning[2])
            total = max(dot(force, unit(column(attitude, 2))), 0.0)
            own = vec(state.drone_body_rates, e, n)
            rotors = follow_attitude(attitude, own, desired, desired_rate, total, moment, d)
            for k in range(4):
                thrust[e, n, k] = rotors[k]


@kernel
def fly_attitude(lo, hi, state, attitude, rates, total, cable_force, thrust, g):
    """Compute the rotor thrusts that turn drones to attitudes (E, N, 3, 3), which turn at body rates (E, N, 3) [rad/s].

    Args:
        lo, hi, state: the environments, SystemState.
        attitude, rates: desired.
        total: total thrust of each drone (E, N) [N].
        pull: force that each drone exerts on its cable (E, N, 3) [N].
        thrust: written, (E, N, 4) [N].
        g: Gains.
    """
    for e in range(lo, hi):
        for n in range(thrust.shape[1]):
            own, own_rates = mat(state.drone_rotation, e, n), vec(state.drone_body_rates, e, n)
            desired, desired_rate, d = mat(attitude, e, n), vec(rates, e, n), drone_gains(g, n)
            moment = hook_moment(n, own, vec(cable_force, e, n), STILL, g)
            rotors = follow_attitude(own, own_rates, desired, desired_rate, total[e, n], moment, d)
            for k in range(4):
                thrust[e, n, k] = rotors[k]


@kernel
def fly_rates(lo, hi, state, rates, total, cable_force, thrust, g):
    """Compute the rotor thrusts that turn drones at body rates (E, N, 3) [rad/s], at total thrusts (E, N) [N].

    The moment of the pulls (E, N, 3) [N] at the hooks is held beside.
    """
    for e in range(lo, hi):
        for n in range(thrust.shape[1]):
            d = drone_gains(g, n)
            torque = rate_torque(vec(state.drone_body_rates, e, n), vec(rates, e, n), d)
            moment = hook_moment(n, mat(state.drone_rotation, e, n), vec(cable_force, e, n), STILL, g)
            torque = add(torque, moment)
            rotors = allocate(total[e, n], torque, d.allocation, d.thrust_min, d.thrust_max)
            for k in range(4):
                thrust[e, n, k] = rotors[k]
