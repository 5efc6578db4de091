"""What acts on the bodies between two physics steps: rotors with lag, drag, wind and the hidden force.

Loads enter MuJoCo as generalised forces of the free joints, (force in the world frame, torque in the body frame),
which needs no Jacobian. Drones on chains have no free joint: theirs are Cartesian, both in the world frame.
"""

from __future__ import annotations

from math import exp, isfinite, sqrt
from typing import NamedTuple

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.config.system import GRAVITY, System
from multilift_marl.math3d import (
    add,
    clip,
    dot,
    mat,
    mat_to_quat,
    matrow,
    mul,
    norm,
    put,
    putmat,
    quat_to_mat,
    row,
    scale,
    sub,
    thrust_frame,
    tmul,
    vec,
)
from multilift_marl.sim.scene import Layout

AIR_DENSITY = 1.225  # [kg/m³] at sea level, 15 °C (ISA)
MAX_SPEED = 100.0  # [m/s] beyond this a simulation has diverged
MAX_RATE = 500.0  # [rad/s]
MAX_STRETCH = 0.2  # [-] of a cable's length


class Constants(NamedTuple):
    """Numbers of the compiled loops."""

    timestep: float
    payload_drag: float
    """½ ρ C_d A [kg/m]."""
    rotor_positions: np.ndarray
    """(4, 3) [m]."""
    rotor_spin: np.ndarray
    """(4,) sign of the reaction torque."""
    thrust_coefficient: float
    torque_ratio: float
    speed_min: float
    speed_max: float
    rising: tuple[float, float, float]
    """Of a rotor whose speed rises: exp(-timestep/τ), and the means of exp(-t/τ) and exp(-2t/τ) over a step."""
    falling: tuple[float, float, float]
    """The same of one whose speed falls."""
    drag: np.ndarray
    """(3,) linear drag of a drone along its axes [kg/s]."""
    anchors: np.ndarray
    """(N, 3) [m]."""
    cable_length: np.ndarray
    cable_stiffness: np.ndarray
    qpos: int
    """Offset of qpos in a row of `batch.state`; likewise the next ones."""
    qvel: int
    force: int
    drone_loads: np.ndarray
    """(N,) offsets of the drones' forces and torques."""
    world_torque: bool
    """Whether those torques are in the world frame in place of the body frame."""
    payload_nq: int
    payload_nv: int


def make_constants(system: System, layout: Layout, qpos: int, qvel: int, force: int, cartesian: int) -> Constants:
    """Return the constants of `system`; the offsets are of qpos, qvel, qfrc_applied and xfrc_applied."""
    chain = system.cable_model == "chain"
    loads = [
        cartesian + 6 * body if chain else force + layout.payload_nv + 6 * n
        for n, body in enumerate(layout.drone_bodies)
    ]
    vehicle = system.vehicle
    return Constants(
        timestep=system.timestep,
        payload_drag=0.5 * AIR_DENSITY * system.payload_drag_area,
        rotor_positions=vehicle.rotor_positions,
        rotor_spin=np.asarray(vehicle.rotor_spin, float),
        thrust_coefficient=vehicle.thrust_coefficient,
        torque_ratio=vehicle.torque_ratio,
        speed_min=vehicle.rotor_speed_min,
        speed_max=vehicle.rotor_speed_max,
        rising=_lag(system.timestep / vehicle.rotor_time_constant_up),
        falling=_lag(system.timestep / vehicle.rotor_time_constant_down),
        drag=np.asarray(vehicle.drag, float),
        anchors=np.ascontiguousarray(system.anchors),
        cable_length=system.cable_length,
        cable_stiffness=system.cable_stiffness,
        qpos=qpos,
        qvel=qvel,
        force=force,
        drone_loads=np.array(loads),
        world_torque=chain,
        payload_nq=layout.payload_nq,
        payload_nv=layout.payload_nv,
    )


def _lag(h: float) -> tuple[float, float, float]:
    return exp(-h), (1 - exp(-h)) / h, (1 - exp(-2 * h)) / (2 * h)


@kernel
def apply_loads(rows, lo, hi, thrust, state, plant, record, c):
    """Advance the rotors by one physics step and write the loads of that step into `batch.state`.

    The rotor speed follows its command with a first-order lag, one for rising and one for falling. The thrust applied
    is the exact mean of b ω² over the step, so the impulse is exact. Reaction torque is κ f (report eqs 5-8), drag of
    a drone is linear in its velocity through the air along its body axes (Faessler 2018), drag of the payload
    quadratic.

    Args:
        rows: `batch.state` of environments lo to hi.
        lo, hi: the environments.
        thrust: commanded thrust of each rotor (E, N, 4) [N].
        state, plant, record: SystemState, Plant, Record of all environments.
        c: Constants.
    """
    for e in range(lo, hi):
        line = rows[e - lo]
        wind = row(plant.wind, e)
        for n in range(thrust.shape[1]):
            total, mx, my, mz, power = 0.0, 0.0, 0.0, 0.0, 0.0
            for k in range(4):
                before = state.rotor_speed[e, n, k]
                target = sqrt(max(thrust[e, n, k], 0.0) / c.thrust_coefficient)
                target = clip(target, c.speed_min, c.speed_max)
                gap = before - target
                decay, mean_first, mean_second = c.falling if gap > 0.0 else c.rising
                after = target + gap * decay
                square = target * target + 2.0 * target * gap * mean_first + gap * gap * mean_second
                f = c.thrust_coefficient * square
                state.rotor_speed[e, n, k] = after
                total += f
                mx += c.rotor_positions[k, 1] * f
                my -= c.rotor_positions[k, 0] * f
                mz += c.rotor_spin[k] * c.torque_ratio * f
                power += c.torque_ratio * f * 0.5 * (before + after)
            attitude = mat(state.drone_rotation, e, n)
            air = tmul(attitude, sub(vec(state.drone_velocity, e, n), wind))
            body = (-c.drag[0] * air[0], -c.drag[1] * air[1], total - c.drag[2] * air[2])
            torque = (mx, my, mz)
            if c.world_torque:
                torque = mul(attitude, torque)
            at = c.drone_loads[n]
            put(line[at : at + 3], mul(attitude, body))
            put(line[at + 3 : at + 6], torque)
            record.energy[e] += c.timestep * power
        air = sub(row(state.payload_velocity, e), wind)
        drag = scale(-c.payload_drag * norm(air), air)
        put(line[c.force : c.force + 3], add(drag, row(plant.payload_force, e)))


@kernel
def read_rows(rows, lo, hi, tension, state, record, diverged, c):
    """Read the physical state out of `batch.state` and mark environments that have diverged.

    A diverged environment keeps its last sound state.

    Args:
        rows: `batch.state` of environments lo to hi.
        lo, hi: the environments.
        tension: cable tensions of the last physics step (hi - lo, N) [N].
        state, record: written.
        diverged: (E,) bool, set, never cleared.
        c: Constants.
    """
    for e in range(lo, hi):
        line = rows[e - lo]
        if diverged[e] or not _sound(line, tension[e - lo], c):
            diverged[e] = True
            continue
        read_payload(e, line, state, c)
        at, v = c.qpos + c.payload_nq, c.qvel + c.payload_nv
        slack = False
        for n in range(tension.shape[1]):
            for j in range(3):
                state.drone_position[e, n, j] = line[at + j]
                state.drone_velocity[e, n, j] = line[v + j]
                state.drone_body_rates[e, n, j] = line[v + 3 + j]
            putmat(state.drone_rotation[e, n], quat_to_mat(line[at + 3], line[at + 4], line[at + 5], line[at + 6]))
            at += 7
            v += 6
            pull = tension[e - lo, n]
            keep_tension(e, n, pull, state, record, c)
            slack = slack or pull <= 0.0
        if slack:
            record.slack_time[e] += c.timestep


@kernel
def read_payload(e, line, state, c):
    """Read the payload's state out of a row of `batch.state`."""
    at, v = c.qpos, c.qvel
    for j in range(3):
        state.payload_position[e, j] = line[at + j]
        state.payload_velocity[e, j] = line[v + j]
    if c.payload_nv == 6:
        putmat(state.payload_rotation[e], quat_to_mat(line[at + 3], line[at + 4], line[at + 5], line[at + 6]))
        for j in range(3):
            state.payload_body_rates[e, j] = line[v + 3 + j]


@kernel
def keep_tension(e, n, pull, state, record, c):
    """Note the tension [N] of cable n in state and record."""
    state.cable_tension[e, n] = pull
    record.tension_min[e] = min(record.tension_min[e], pull)
    record.tension_max[e] = max(record.tension_max[e], pull)
    record.stretch_max[e] = max(record.stretch_max[e], pull / (c.cable_stiffness[n] * c.cable_length[n]))


@kernel
def _sound(line, tension, c):
    """Return whether a simulation's numbers are finite and within physical bounds."""
    v = c.qvel
    for j in range(c.payload_nv):
        bound = MAX_SPEED if j < 3 else MAX_RATE
        if not abs(line[v + j]) < bound:
            return False
    v += c.payload_nv
    for n in range(tension.shape[0]):
        for j in range(6):
            if not abs(line[v + 6 * n + j]) < (MAX_SPEED if j < 3 else MAX_RATE):
                return False
        if not tension[n] < MAX_STRETCH * c.cable_stiffness[n] * c.cable_length[n]:
            return False
    for j in range(c.payload_nq + 7 * tension.shape[0]):
        if not isfinite(line[c.qpos + j]):
            return False
    return True


@kernel
def hover_drone(e, n, state, pull, yaw, mass, thrust_coefficient):
    """Let drone n of environment e hold still: attitude and rotor speeds that pull its cable by `pull` [N]."""
    force = add(pull, (0.0, 0.0, mass * GRAVITY))
    putmat(state.drone_rotation[e, n], thrust_frame(force, yaw))
    for k in range(4):
        state.rotor_speed[e, n, k] = sqrt(norm(force) / (4.0 * thrust_coefficient))


@kernel
def write_rows(rows, lo, hi, mask, state, record, c):
    """Write the state of the environments in `mask` into `batch.state`; tensions follow from the stretch."""
    for e in range(lo, hi):
        if not mask[e]:
            continue
        line = rows[e - lo]
        clear_record(e, record)
        write_payload(e, line, state, c)
        attitude = matrow(state.payload_rotation, e)
        at, v = c.qpos + c.payload_nq, c.qvel + c.payload_nv
        for n in range(state.drone_position.shape[1]):
            position = vec(state.drone_position, e, n)
            put(line[at : at + 3], position)
            q = mat_to_quat(mat(state.drone_rotation, e, n))
            line[at + 3], line[at + 4], line[at + 5], line[at + 6] = q
            put(line[v : v + 3], vec(state.drone_velocity, e, n))
            put(line[v + 3 : v + 6], vec(state.drone_body_rates, e, n))
            at += 7
            v += 6
            anchor = (c.anchors[n, 0], c.anchors[n, 1], c.anchors[n, 2])
            cable = sub(position, add(row(state.payload_position, e), mul(attitude, anchor)))
            pull = c.cable_stiffness[n] * max(0.0, sqrt(dot(cable, cable)) - c.cable_length[n])
            keep_tension(e, n, pull, state, record, c)


@kernel
def write_payload(e, line, state, c):
    """Write the payload's state into a row of `batch.state`."""
    at, v = c.qpos, c.qvel
    put(line[at : at + 3], row(state.payload_position, e))
    put(line[v : v + 3], row(state.payload_velocity, e))
    if c.payload_nv == 6:
        q = mat_to_quat(matrow(state.payload_rotation, e))
        line[at + 3], line[at + 4], line[at + 5], line[at + 6] = q
        put(line[v + 3 : v + 6], row(state.payload_body_rates, e))


@kernel
def clear_record(e, record):
    """Let the record of environment e start anew."""
    record.energy[e], record.slack_time[e] = 0.0, 0.0
    record.tension_min[e], record.tension_max[e], record.stretch_max[e] = 1e9, 0.0, 0.0
