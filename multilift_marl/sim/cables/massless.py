"""Massless cables: a Kelvin-Voigt element without compression on a MuJoCo tendon limit.

With direct solref (-A, -B) and constant impedance I, a stretched limit's row wants the acceleration
-(A r + B v)/I for stretch r and stretch rate v, softened by the regulariser R = (1 - I)/I · tendon_invweight0. For
small I its force is (A r + B v)/(I R), the Kelvin-Voigt law k r + c v if A = k I R and B = c I R, and the force of a
limit never pushes. See "Solver parameters" in MuJoCo's computation chapter. At rest the law is exact; in motion the
softening of each cable acts like a little extra mass along it, about 1 % of the mass that it couples.

MuJoCo's tension is the mean over a physics step. A snatch, of a slack cable that goes taut between moving ends, is
shorter: for the default cable and 1 m/s the force is 1000 N when it goes taut and down to a half after 0.3 ms, so that
mean depends on the time step. Its peak does not: until the ends have turned round they are two bodies on a spring and
damper with all other forces nearly constant, which `snatch_peak` solves.
"""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, atanh, cos, cosh, exp, isfinite, pi, sin, sinh, sqrt
from typing import NamedTuple

import mujoco
import numpy as np
from mujoco.batch import Batch

from multilift_marl.kernels.jit import bind, kernel
from multilift_marl.math3d import (
    IDENTITY,
    add,
    cross,
    dot,
    mat,
    matrow,
    mul,
    norm,
    putmat,
    quat_to_mat,
    row,
    scale,
    sub,
    tmul,
    vec,
)
from multilift_marl.rig.system import System
from multilift_marl.sim.cables.common import (
    MAX_RATE,
    MAX_SPEED,
    MAX_STRETCH,
    Cables,
    cable_tension,
    clear_stats,
    make_common,
    update_tension_stats,
)
from multilift_marl.sim.contact import body_radii
from multilift_marl.sim.parameters import MASSES, Inertias, Parameters
from multilift_marl.sim.rotation import add_gyroscopic
from multilift_marl.sim.state import SimData, hook_position
from multilift_marl.sim.state_io import Rows, read_payload, write_bodies

SLACK = 1.0  # [-] of its length: a cable whose ends are closer has no tension
IMPEDANCE = 0.01  # [-] I: in motion the cable is softer than its law by about this
_FAR = 1e9  # [m] at which the limit of a broken cable's tendon begins


def add_cable(spec: mujoco.MjSpec, system: System, index: int) -> None:
    """Add a limited tendon from hook to anchor, and a sensor of its force."""
    name = f"cable_{index}"
    cable = spec.add_tendon(name=name, limited=True, range=[0, system.cable_length[index]])
    cable.wrap_site(f"drone_{index}/hook")
    cable.wrap_site(f"payload/anchor_{index}")
    # (d0, d_width, width, midpoint, power): with d0 = d_width the impedance is I at any stretch, the other three idle.
    cable.solimp_limit = [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2]
    cable.width = 0.006
    cable.rgba = [0.08, 0.08, 0.1, 1]
    sensor = mujoco.mjtSensor.mjSENS_TENDONLIMITFRC
    tendon = mujoco.mjtObj.mjOBJ_TENDON
    spec.add_sensor(name=f"{name}/tension", type=sensor, objtype=tendon, objname=name)


def set_constants(model: mujoco.MjModel, system: System) -> None:
    """Give the tendon limits of a compiled model stiffness and damping."""
    model.tendon_solref_lim[:] = limit_solref(system.cable_stiffness, system.cable_damping, model.tendon_invweight0)


def limit_solref(stiffness: np.ndarray, damping: np.ndarray, tendon_invweight0: np.ndarray) -> np.ndarray:
    """Return `tendon_solref_lim` that makes tendon limits cables.

    It must be computed anew whenever masses change, because tendon_invweight0 does.

    Args:
        stiffness: k (..., N) [N/m].
        damping: c (..., N) [N s/m].
        tendon_invweight0: (..., N) [1/kg]; each of the three may lack the axes before the last.

    Returns:
        (..., N, 2).
    """
    # R of the module's law. With A = k I R and B = c I R the force (A r + B v)/(I R) is k r + c v.
    regulariser = (1 - IMPEDANCE) / IMPEDANCE * tendon_invweight0
    # Negative numbers are MuJoCo's direct stiffness and damping; positive ones would be a time constant and a ratio.
    law = np.broadcast_arrays(stiffness * regulariser * IMPEDANCE, damping * regulariser * IMPEDANCE)
    return -np.stack(law, axis=-1)


class MasslessCables(NamedTuple):
    """Massless cables and the bodies at their ends."""

    cables: Cables
    bodies: Inertias
    gyroscopic: np.ndarray
    """(E, 1 + N, 3) torque that `rotation.add_gyroscopic` added to the loads of the last step [N m]."""
    radii: np.ndarray
    """(1 + N,) of spheres about payload and drones [m]."""
    nodes: None = None


def make_cables(system: System, parameters: Parameters, inertias: Inertias) -> MasslessCables:
    """Return the cables of `system`, which follow parameters and inertias."""
    return MasslessCables(make_common(system, parameters), inertias, np.zeros_like(inertias.center), body_radii(system))


def update_cables(cables: MasslessCables, system: System, parameters: Parameters) -> None:
    """Do nothing: all that depends on parameters is in the models."""


def update_models(
    batch: Batch, system: System, parameters: Parameters, mask: np.ndarray, names: set[str], broken: np.ndarray
) -> None:
    """Write lengths, stiffnesses and broken cables into a batch's models; see `CableModel.update_models`."""
    if names & {"cable_length", "cable_broken"}:
        # A compiled model cannot lose a tendon: that of a broken cable gets a limit that it never reaches.
        batch.expand("tendon_range")[..., 1] = np.where(broken, _FAR, parameters.cable_length)
    if names & {*MASSES, "cable_stiffness"}:
        inverse_weight = batch.expand("tendon_invweight0")[mask]
        solref = limit_solref(parameters.cable_stiffness[mask], system.cable_damping, inverse_weight)
        batch.expand("tendon_solref_lim")[mask] = solref


def bind_steps(
    batch: Batch, rows: Rows, data: SimData, cables: MasslessCables
) -> tuple[Callable[[], None], Callable[[], None]]:
    """Return what to call before and after MuJoCo's step of a batch."""
    read = bind(read_state, rows, batch.bind("sensordata"), batch.bind("ten_length"), data, cables)
    return bind(add_gyroscopic, rows, data, cables), read


@kernel
def read_state(rows, tension, length, data, cables):
    """Read the physical state out of `batch.state` and mark environments that have diverged.

    A diverged environment keeps its last sound state.

    Args:
        rows: Rows of the environments.
        tension: cable tensions of the last physics step (environments, N) [N].
        length: distances of the cables' ends at its beginning (environments, N) [m].
        data: SimData, written.
        cables: MasslessCables.
    """
    state = data.state
    stats = data.stats
    diverged = data.diverged
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        line = rows.state[i]
        if diverged[e] or not _is_sound(e, line, tension[i], length[i], cables, rows):
            diverged[e] = True
            continue
        # `at` and `v` are places in the row, of the next drone's coordinates (3 + 4) and velocities (3 + 3). Here `v`
        # is no view of a task's arrays, as it is in kernels of tasks, nor a speed.
        at = rows.qpos + rows.payload_nq
        v = rows.qvel + rows.payload_nv
        slack = False
        for n in range(tension.shape[1]):
            # A cable that has gone taut in this step: its peak, from the state before the step.
            if tension[i, n] > 0.0 and state.cable_tension[e, n] == 0.0:
                peak = _step_peak(e, n, line, tension[i, n], state, cables, rows)
                stats.tension_peak[e] = max(stats.tension_peak[e], peak)
                state.cable_broken[e, n] = state.cable_broken[e, n] or peak > cables.cables.breaking_load[n]
            # Its drone.
            for j in range(3):
                state.drone_position[e, n, j] = line[at + j]
                state.drone_velocity[e, n, j] = line[v + j]
                state.drone_body_rates[e, n, j] = line[v + 3 + j]
            putmat(state.drone_rotation[e, n], quat_to_mat(line[at + 3], line[at + 4], line[at + 5], line[at + 6]))
            at += 7
            v += 6
            state.cable_tension[e, n] = tension[i, n]
            slack = slack or tension[i, n] <= 0.0
        read_payload(e, line, state, rows)
        if slack:
            stats.slack_time[e] += cables.cables.timestep
    update_tension_stats(rows, diverged, False, data, cables.cables)


@kernel
def _is_sound(e, line, tension, length, cables, rows):
    """Return whether a simulation's numbers are finite and within physical bounds."""
    v = rows.qvel
    for j in range(rows.payload_nv):
        bound = MAX_SPEED if j < 3 else MAX_RATE
        # `not a < b`, for NaN must not pass: every comparison with it is False.
        if not abs(line[v + j]) < bound:
            return False
    v += rows.payload_nv
    for n in range(tension.shape[0]):
        for j in range(6):
            if not abs(line[v + 6 * n + j]) < (MAX_SPEED if j < 3 else MAX_RATE):
                return False
        if not isfinite(tension[n]):
            return False
        # The ends of a slack or broken cable may be anywhere.
        if tension[n] > 0.0 and not length[n] < (1.0 + MAX_STRETCH) * cables.cables.length[e, n]:
            return False
    for j in range(rows.payload_nq + 7 * tension.shape[0]):
        if not isfinite(line[rows.qpos + j]):
            return False
    return True


@kernel
def _step_peak(e, n, line, tension, state, cables, rows):
    """Return the peak of the snatch of cable n, which went taut before the step that has just been made [N].

    The state is that before the step, `line` that after it. The ends parted freely until the cable was taut.
    """
    # Distance of the ends, and the speed at which they part, before the step.
    anchor = row(cables.cables.anchors, n)
    hook = row(cables.cables.hooks, n)
    payload = matrow(state.payload_rotation, e) if rows.payload_nv == 6 else IDENTITY
    drone = mat(state.drone_rotation, e, n)
    low = add(row(state.payload_position, e), mul(payload, anchor))
    # Free joints have linear velocities in the world frame and body rates in the body frame: Ω × r is turned after.
    low_velocity = row(state.payload_velocity, e)
    low_velocity = add(low_velocity, mul(payload, cross(row(state.payload_body_rates, e), anchor)))
    high = add(vec(state.drone_position, e, n), mul(drone, hook))
    high_velocity = vec(state.drone_velocity, e, n)
    high_velocity = add(high_velocity, mul(drone, cross(vec(state.drone_body_rates, e, n), hook)))
    cable = sub(high, low)
    length = norm(cable)
    direction = scale(1.0 / length, cable)
    speed = dot(direction, sub(high_velocity, low_velocity))
    stretch = length - cables.cables.length[e, n]

    # The other forces that part the ends follow from the velocities after the step.
    v = rows.qvel
    after = (line[v], line[v + 1], line[v + 2])
    rates = (line[v + 3], line[v + 4], line[v + 5]) if rows.payload_nv == 6 else (0.0, 0.0, 0.0)
    after = add(after, mul(payload, cross(rates, anchor)))
    v += rows.payload_nv + 6 * n
    rates = (line[v + 3], line[v + 4], line[v + 5])
    ending = add((line[v], line[v + 1], line[v + 2]), mul(drone, cross(rates, hook)))
    inverse_mass = _mobility(e, 0, payload, anchor, direction, cables.bodies)
    inverse_mass += _mobility(e, 1 + n, drone, hook, direction, cables.bodies)
    # MuJoCo's tension has slowed the parting by (1/m) T already: what it took is added back, the others' effect is
    # left.
    acceleration = (dot(direction, sub(ending, after)) - speed) / cables.cables.timestep + inverse_mass * tension

    # The speed at the moment when the cable was at its natural length, by that acceleration.
    # Where the cable was stretched at first, v² - 2 a s is the square of the speed at s = 0.
    speed = sqrt(max(speed * speed - 2.0 * acceleration * max(stretch, 0.0), 0.0)) if speed > 0.0 else 0.0
    if speed == 0.0:
        return 0.0
    return snatch_peak(speed, acceleration, 1.0 / inverse_mass, cables.cables.stiffness[e, n], cables.cables.damping[n])


@kernel
def _mobility(e, b, attitude, point, direction, bodies):
    """Return how fast a point of body b moves along `direction` for a unit impulse along it there [1/kg].

    Args:
        e, b: environment and body.
        attitude: of the body, 9 numbers.
        point: from the origin of the body frame, body frame [m].
        direction: unit vector, world frame.
        bodies: Inertias.
    """
    moment = cross(sub(point, row(bodies.center[e], b)), tmul(attitude, direction))
    return 1.0 / bodies.mass[e, b] + dot(moment, mul(matrow(bodies.inverse[e], b), moment))


@kernel
def snatch_peak(speed, acceleration, mass, stiffness, damping):
    """Return the largest tension [N] of a cable that goes taut at a speed.

    With the stretch s, m s̈ = m a - k s - c ṡ and F = k s + c ṡ = m (a - y), where y = s̈ follows the same equation
    without a. F is largest at once, c v, if it falls from there, and else where ẏ first vanishes.

    Args:
        speed: at which the ends part as the cable goes taut, v > 0 [m/s].
        acceleration: at which they would part without the cable, a [m/s²].
        mass: m, with which the ends resist being moved together [kg].
        stiffness, damping: k [N/m], c [N s/m].
    """
    # F falls from the first moment on.
    first = cable_tension(stiffness, damping, 0.0, speed)
    # y_0 = a - c v/m, and ẏ_0 = -(k v + c y_0)/m: F falls at first where ẏ_0 is positive.
    start = acceleration - damping * speed / mass
    slope = -(stiffness * speed + damping * start) / mass
    if slope >= 0.0:
        return first

    # y = e^(-σ t) (y_0 C + (ẏ_0 + σ y_0) S/ω) and ẏ = e^(-σ t) (ẏ_0 C - (σ ẏ_0 + k/m y_0) S/ω), with sine and cosine
    # S, C of ω t, hyperbolic ones if the damping is more than critical. The time of ẏ = 0 in each of the cases.
    square = stiffness / mass
    decay = 0.5 * damping / mass
    fall = decay * slope + square * start
    # ω² = k/m - σ²: positive below critical damping. The band of 1e-9 about 0 keeps S/ω from 0/0.
    gap = square - decay * decay
    if gap > 1e-9 * square:
        rate = sqrt(gap)
        # tan ω t = ω ẏ_0/(σ ẏ_0 + k/m y_0). As ẏ_0 < 0, atan2 is negative: the first root after 0 is half a turn on.
        time = atan2(slope * rate, fall) / rate
        if time < 0.0:
            time += pi / rate
        even = cos(rate * time)
        odd = sin(rate * time) / rate
    elif gap < -1e-9 * square:
        rate = sqrt(-gap)
        # tanh is in (-1, 1), and of positive times positive: elsewhere ẏ keeps its sign, y dies out and F tends to m a.
        if fall >= 0.0 or slope * rate <= fall:
            return first if acceleration <= 0.0 else max(first, mass * acceleration)
        time = atanh(slope * rate / fall) / rate
        even = cosh(rate * time)
        odd = sinh(rate * time) / rate
    else:
        time = slope / fall
        even = 1.0
        odd = time
    lowest = exp(-decay * time) * (start * even + (slope + decay * start) * odd)
    return max(first, mass * (acceleration - lowest))


@kernel
def write_state(rows, mask, data, cables):
    """Write the state of the environments in `mask` into `batch.state`; tensions follow from the stretch."""
    state = data.state
    for i in range(rows.state.shape[0]):
        e = rows.first + i
        if not mask[e]:
            continue
        clear_stats(e, data.stats)
        write_bodies(e, rows.state[i], state, rows)
        attitude = matrow(state.payload_rotation, e)
        for n in range(cables.cables.anchors.shape[0]):
            anchor = add(row(state.payload_position, e), mul(attitude, row(cables.cables.anchors, n)))
            cable = sub(hook_position(e, n, state, cables.cables.hooks), anchor)
            stretch = sqrt(dot(cable, cable)) - cables.cables.length[e, n]
            state.cable_tension[e, n] = cable_tension(cables.cables.stiffness[e, n], 0.0, stretch, 0.0)
    update_tension_stats(rows, mask, True, data, cables.cables)
