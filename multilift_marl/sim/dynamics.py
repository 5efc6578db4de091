"""What acts on the bodies between two physics steps: rotors with lag, drag, wind and the hidden force.

Loads enter MuJoCo as generalised forces of the free joints, (force in the world frame, torque in the body frame),
which needs no Jacobian.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
from mujoco.batch import Batch

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, clip, cross, mat, matrow, mul, norm, put, row, scale, sub, tmul, vec
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import AIR_DENSITY
from multilift_marl.sim.air import air_moment, ground_gain, update_downwash
from multilift_marl.sim.gusts import step_gusts
from multilift_marl.sim.parameters import lag_shares
from multilift_marl.sim.scene import Layout
from multilift_marl.sim.state_io import field_offset


class Constants(NamedTuple):
    """Numbers of the compiled loops."""

    timestep: float
    payload_drag: float
    """½ ρ C_d A [kg/m]."""
    rotor_positions: np.ndarray
    """(N, 4, 3) [m]."""
    rotor_spin: np.ndarray
    """(N, 4) sign of the reaction torque."""
    thrust_coefficient: np.ndarray
    """(N,), likewise the next ones."""
    torque_ratio: np.ndarray
    rotor_inertia: np.ndarray
    speed_min: np.ndarray
    speed_max: np.ndarray
    rising: np.ndarray
    """(N, 3) of rotors whose speed rises: exp(-timestep/τ), and the means of exp(-t/τ) and exp(-2t/τ) over a step."""
    falling: np.ndarray
    """(N, 3) the same of those whose speed falls."""
    drag: np.ndarray
    """(N, 3) linear drag of a drone along its axes [kg/s]."""
    force: int
    """Offset of the payload's force in a row of `batch.state`."""
    payload_turns: bool
    """Whether the payload has a torque beside it, which chains add to."""
    drone_loads: np.ndarray
    """(N,) offsets of the drones' forces and torques."""
    center_varies: bool
    """Whether the payload's centre of mass may be off the origin of its free joint."""


def make_constants(system: System, layout: Layout, batch: Batch) -> Constants:
    """Return the constants of `system` and where its loads are in the rows of a batch."""
    force = field_offset(batch, "qfrc_applied")
    vehicles, h = system.vehicles, system.timestep
    return Constants(
        timestep=system.timestep,
        payload_drag=0.5 * AIR_DENSITY * system.payload_drag_area,
        rotor_positions=np.array([vehicle.rotor_positions for vehicle in vehicles]),
        rotor_spin=np.array([vehicle.rotor_spin for vehicle in vehicles], float),
        thrust_coefficient=np.array([vehicle.thrust_coefficient for vehicle in vehicles]),
        torque_ratio=np.array([vehicle.torque_ratio for vehicle in vehicles]),
        rotor_inertia=np.array([vehicle.rotor_inertia for vehicle in vehicles], float),
        speed_min=np.array([vehicle.rotor_speed_min for vehicle in vehicles], float),
        speed_max=np.array([vehicle.rotor_speed_max for vehicle in vehicles]),
        rising=np.array([lag_shares(h / vehicle.rotor_time_constant_up) for vehicle in vehicles]),
        falling=np.array([lag_shares(h / vehicle.rotor_time_constant_down) for vehicle in vehicles]),
        drag=np.array([vehicle.drag for vehicle in vehicles], float),
        force=force,
        payload_turns=layout.payload_nv == 6,
        drone_loads=force + layout.payload_nv + 6 * np.arange(system.num_drones),
        center_varies="payload_center_of_mass" in system.varied,
    )


@kernel
def apply_loads(rows, lo, hi, thrust, state, hidden_loads, stats, c, air, flow, varied):
    """Advance the rotors by one physics step and write the loads of that step into `batch.state`.

    The rotor speed follows its command with a first-order lag, one for rising and one for falling. The thrust applied
    is the exact mean of b ω² over the step, so the impulse is exact. Reaction torque is κ f (report eqs 5-8). Rotors
    with `rotor_inertia` also exert the torque that changes their speed and that which turns their axes. Drag of a
    drone is linear in its velocity through the air along its body axes (Faessler 2018), drag of the payload quadratic.
    What else the air does, if switched on, is in `air.py`.

    Args:
        rows: `batch.state` of environments lo to hi.
        lo, hi: the environments.
        thrust: commanded thrust of each rotor (E, N, 4) [N].
        state, plant, record: SystemState, Plant, Record of all environments.
        c: Constants.
        air, flow: Air of all environments and AirConstants; both None where all of it is off, for which Numba compiles
            a version without it.
        varied: Varied of all environments; None where the payload's centre of mass, rotors and drag are nominal.
    """
    for e in range(lo, hi):
        line = rows[e - lo]
        wind = row(hidden_loads.wind, e)
        if flow is not None:
            if flow.gusts:
                wind = add(wind, step_gusts(e, wind, state, air, c.timestep, flow))
            if flow.downwash:
                update_downwash(e, state, air, flow)
        for n in range(thrust.shape[1]):
            total, mx, my, mz, power = 0.0, 0.0, 0.0, 0.0, 0.0
            turning, change = 0.0, 0.0  # sums over the rotors, against body z: mean speed, and its growth in the step
            b, kappa = c.thrust_coefficient[n], c.torque_ratio[n]
            slowest, fastest = c.speed_min[n], c.speed_max[n]
            rising, falling, drag = row(c.rising, n), row(c.falling, n), row(c.drag, n)
            for k in range(4):
                before = state.rotor_speed[e, n, k]
                target = sqrt(max(thrust[e, n, k], 0.0) / b)
                target = 0.0 if hidden_loads.motors_off[e, n] else clip(target, slowest, fastest)
                gap = before - target
                if varied is None:
                    decay, mean_first, mean_second = falling if gap > 0.0 else rising
                else:
                    decay, mean_first, mean_second = vec(varied.falling if gap > 0.0 else varied.rising, e, n)
                after = target + gap * decay
                square = target * target + 2.0 * target * gap * mean_first + gap * gap * mean_second
                f = b * square
                if varied is not None:
                    f *= varied.thrust[e, n]
                state.rotor_speed[e, n, k] = after
                total += f
                mx += c.rotor_positions[n, k, 1] * f
                my -= c.rotor_positions[n, k, 0] * f
                mz += c.rotor_spin[n, k] * kappa * f
                turning += c.rotor_spin[n, k] * (target + gap * mean_first)
                change += c.rotor_spin[n, k] * (after - before)
                power += kappa * f * 0.5 * (before + after)
            attitude = mat(state.drone_rotation, e, n)
            here = wind
            if flow is not None:
                here = add(wind, vec(air.downwash, e, n))
            through = tmul(attitude, sub(vec(state.drone_velocity, e, n), here))
            if flow is not None:
                if flow.ground_effect:
                    gain = ground_gain(state.drone_position[e, n, 2], n, flow)
                    total, mx, my = gain * total, gain * mx, gain * my
                if flow.moments:
                    more = air_moment(e, n, through, state, flow)
                    mx, my = mx + more[0], my + more[1]
            if varied is not None:
                through = scale(varied.drag[e, n], through)
            body = (-drag[0] * through[0], -drag[1] * through[1], total - drag[2] * through[2])
            # The rotors' angular momentum is h = -J turning e3; the drone feels -dh/dt - Ω × h, the mean over the step.
            p, q, _ = vec(state.drone_body_rates, e, n)
            spin = c.rotor_inertia[n] * turning
            torque = (mx + spin * q, my - spin * p, mz + c.rotor_inertia[n] * change / c.timestep)
            at = c.drone_loads[n]
            put(line[at : at + 3], mul(attitude, body))
            put(line[at + 3 : at + 6], torque)
            stats.energy[e] += c.timestep * power
        here = wind
        if flow is not None:
            here = add(wind, vec(air.downwash, e, thrust.shape[1]))
        velocity = row(state.payload_velocity, e)
        if varied is not None and c.center_varies:
            # The true centre of mass is at `center` from the origin of the free joint, where the state is counted.
            attitude, center = matrow(state.payload_rotation, e), row(varied.payload_center_of_mass, e)
            velocity = add(velocity, mul(attitude, cross(row(state.payload_body_rates, e), center)))
        through = sub(velocity, here)
        drag = scale(-c.payload_drag * norm(through), through)
        if varied is not None:
            drag = scale(varied.payload_drag[e], drag)
        force = add(drag, row(hidden_loads.payload_force, e))
        put(line[c.force : c.force + 3], force)
        if varied is not None and c.center_varies:
            # Drag and hidden force act at the centre of mass: about the origin that is a torque, too (body frame).
            put(line[c.force + 3 : c.force + 6], cross(center, tmul(attitude, force)))
        elif c.payload_turns:
            put(line[c.force + 3 : c.force + 6], (0.0, 0.0, 0.0))
