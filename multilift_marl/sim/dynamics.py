"""What acts on the bodies between two physics steps: rotors with lag, drag, wind and the hidden force.

Loads enter MuJoCo as generalised forces of the free joints, (force in the world frame, torque in the body frame),
which needs no Jacobian.
"""

from __future__ import annotations

from math import sqrt

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, clip, cross, mat, matrow, mul, norm, put, row, scale, sub, tmul, vec
from multilift_marl.sim.air import air_moment, axial_thrust, ground_gain, update_downwash
from multilift_marl.sim.gusts import step_gusts
from multilift_marl.sim.state_io import body_dof


@kernel
def apply_loads(rows, thrust, hidden_loads, data, constants, air_model, varied):
    """Advance the rotors by one physics step and write the loads of that step into `batch.state`.

    The rotor speed follows its command with a first-order lag, one for rising and one for falling. The thrust applied
    is the exact mean of b ω² over the step, so the impulse is exact. Reaction torque is κ f (report eqs 5-8). Rotors
    with `rotor_inertia` also exert the torque that changes their speed and that which turns their axes. Drag of a
    drone is linear in its velocity through the air along its body axes (Faessler 2018), drag of the payload quadratic.
    Gusts, downwash, inflow, ground effect and moments of the air are in `gusts.py` and `air.py`.

    Args:
        rows: Rows of the environments.
        thrust: commanded thrust of each rotor (E, N, 4) [N].
        hidden_loads: HiddenLoads.
        data: SimData of all environments.
        constants: RotorArrays.
        air_model: Air of all environments and AirConstants; None where all of it is off, for which Numba compiles
            a version without it.
        varied: RotorVariation of all environments; None where the payload's centre of mass, rotors and drag are
            nominal.
    """
    state = data.state
    timestep = constants.timestep
    if air_model is not None:
        air, air_constants = air_model
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        line = rows.state[i]

        # Air that all bodies share, and the downwash at each.
        wind = row(hidden_loads.wind, e)
        if air_model is not None:
            if air_constants.gusts:
                wind = add(wind, step_gusts(e, wind, state, air, timestep, air_constants))
            if air_constants.downwash:
                update_downwash(e, state, air, air_constants)

        for n in range(thrust.shape[1]):
            # The drone's velocity through the air, body frame.
            attitude = mat(state.drone_rotation, e, n)
            p, q, _ = vec(state.drone_body_rates, e, n)
            here = wind
            if air_model is not None:
                here = add(wind, vec(air.downwash, e, n))
            # Against still air it is the velocity itself: a wind of v has the drag of flying at -v.
            through = tmul(attitude, sub(vec(state.drone_velocity, e, n), here))

            # Rotors: speeds at the end of the step, mean thrust, torques and power. `turning` and `change` are sums
            # over the rotors, against body z: mean speed, and its growth in the step.
            total = mx = my = mz = power = turning = change = 0.0
            b = constants.thrust_coefficient[n]
            kappa = constants.torque_ratio[n]
            slowest = constants.rotor_speed[n, 0]
            fastest = constants.rotor_speed[n, 1]
            rising = row(constants.lag[n], 0)
            falling = row(constants.lag[n], 1)
            for k in range(4):
                before = state.rotor_speed[e, n, k]
                # f = b ω² (report eq 5): commands are thrusts, what lags is the speed.
                target = sqrt(max(thrust[e, n, k], 0.0) / b)
                target = 0.0 if hidden_loads.motors_off[e, n] else clip(target, slowest, fastest)
                gap = before - target
                if varied is None:
                    # `lag_shares` of this step: e^-h/τ, and the means of e^-t/τ and of its square over the step.
                    decay, mean_first, mean_second = falling if gap > 0.0 else rising
                else:
                    decay, mean_first, mean_second = vec(varied.lag[e], n, 1 if gap > 0.0 else 0)
                # ω = target + gap e^-t/τ; its square averaged term by term.
                after = target + gap * decay
                square = target * target + 2.0 * target * gap * mean_first + gap * gap * mean_second
                f = b * square
                if varied is not None:
                    f *= varied.thrust[e, n] * varied.rotor[e, n, k]
                reaction = kappa * f
                if air_model is not None:
                    if air_constants.inflow:
                        x, y, _ = vec(constants.rotor_positions, n, k)
                        # The rotor's own speed along its axis: v_z + (Ω × r)_z, with r = (x, y, 0) as for a hub in the
                        # drone's plane.
                        f, further = axial_thrust(f, through[2] + p * y - q * x, n, air_constants)
                        reaction += further
                state.rotor_speed[e, n, k] = after
                total += f
                # r × f e3 = (y f, -x f, 0); the reaction is about the axis itself.
                mx += constants.rotor_positions[n, k, 1] * f
                my -= constants.rotor_positions[n, k, 0] * f
                mz += constants.rotor_spin[n, k] * reaction
                turning += constants.rotor_spin[n, k] * (target + gap * mean_first)
                change += constants.rotor_spin[n, k] * (after - before)
                # Torque times the mean of the speeds at both ends of the step.
                power += reaction * 0.5 * (before + after)

            # Ground effect and moments of the air.
            if air_model is not None:
                if air_constants.ground_effect:
                    gain = ground_gain(state.drone_position[e, n, 2], n, air_constants)
                    total *= gain
                    mx *= gain
                    my *= gain
                if air_constants.moments:
                    roll, pitch = air_moment(e, n, through, state, air_constants)
                    mx += roll
                    my += pitch
            if varied is not None:
                through = scale(varied.drag[e, n], through)

            # Force and torque of the drone. The rotors' angular momentum is h = -J turning e3; the drone is turned by
            # -dh/dt - Ω × h, the mean over the step.
            # -R D Rᵀ v; Faessler's D [1/s] is over the mass, here it is [kg/s].
            drag = row(constants.drag, n)
            body = (-drag[0] * through[0], -drag[1] * through[1], total - drag[2] * through[2])
            spin = constants.rotor_inertia[n] * turning
            torque = (mx + spin * q, my - spin * p, mz + constants.rotor_inertia[n] * change / timestep)
            at = rows.force + body_dof(1 + n, rows)
            put(line[at : at + 3], mul(attitude, body))
            put(line[at + 3 : at + 6], torque)
            data.stats.energy[e] += timestep * power

        # The payload: drag and hidden force at its true centre of mass, which may be off the origin of its free joint,
        # where the state is counted. About the origin they then have a torque, too (body frame).
        here = wind
        if air_model is not None:
            here = add(wind, vec(air.downwash, e, thrust.shape[1]))
        velocity = row(state.payload_velocity, e)
        if varied is not None and varied.center_varies:
            attitude = matrow(state.payload_rotation, e)
            center = row(varied.payload_center_of_mass, e)
            velocity = add(velocity, mul(attitude, cross(row(state.payload_body_rates, e), center)))
        through = sub(velocity, here)
        drag = scale(-constants.payload_drag * norm(through), through)
        if varied is not None:
            drag = scale(varied.payload_drag[e], drag)
        force = add(drag, row(hidden_loads.payload_force, e))
        at = rows.force
        put(line[at : at + 3], force)
        if varied is not None and varied.center_varies:
            put(line[at + 3 : at + 6], cross(center, tmul(attitude, force)))
        elif rows.payload_nv == 6:  # chains add to it
            put(line[at + 3 : at + 6], (0.0, 0.0, 0.0))
