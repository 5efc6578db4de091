"""The reduced model of a team for planners: a rigid payload, taut cables of fixed length, and thrust vectors.

The state x of N drones has q = (payload position, roll, pitch, yaw, c), its velocities ν = (velocity, body rates, ċ),
and the thrust vector F of each drone, drag compensated, world frame; c are the horizontal components of each cable's
unit vector d from payload to drone, whose vertical one is √(1 − |c|²). The input u is Ḟ.

Newton's law of drone n along its cable gives its tension as t = S − m g·a, with a = (acceleration, angular
acceleration) of the payload and g = (d, r × Rᵀd). The payload's laws then are one 6 × 6 system, (M + Σ m g gᵀ) a =
b + Σ S g, and what is left of each drone's law is c̈ (Sreenath and Kumar, RSS 2013, eqs 3 to 6, solved for the
accelerations). A step takes the acceleration in its middle.
"""

from __future__ import annotations

from math import cos, sin, sqrt, tan
from typing import NamedTuple

import numpy as np

from multilift_marl.errors import warn_once
from multilift_marl.kernels.jit import kernel
from multilift_marl.physical import AIR_DENSITY, GRAVITY
from multilift_marl.rig.system import System

LOCAL = 13  # what the law of a drone depends on: attitude 3, body rates 3, c 2, ċ 2, thrust vector 3
_STEEPEST = 0.1  # least vertical component of a cable's unit vector that the chart is used with
HEAVY = 0.15  # [-] of the payload: weight of the cables above which sag matters
SLUGGISH = 0.06  # [s] motor lag above which teams get worse: at 0.07 s errors double, at 0.1 s teams are lost
SLOW = 1e-6  # [m²/s²] that makes the drag smooth at rest


class TeamModel(NamedTuple):
    """Numbers of a team."""

    payload_mass: float
    """[kg]."""
    inertia: np.ndarray
    """(3, 3) of the payload about its centre of mass, its frame [kg m²]."""
    anchors: np.ndarray
    """(N, 3) from its centre of mass [m]."""
    drone_mass: np.ndarray
    """(N,) each with half of its cable [kg]."""
    length: np.ndarray
    """(N,) of the cables, stretched as at rest [m]."""
    drag: float
    """Of the payload, ½ ρ C_d A [kg/m]."""


def has_model(system: System) -> bool:
    """Return whether there is a model of a team: its payload is a point, or has anchors apart from each other."""
    return not system.anchors.any() or bool(np.ptp(system.anchors, axis=0).max() > 1e-9)


def warn_of_heavy_cables(system: System, asked: str) -> None:
    """Warn where cables weigh so much that the model's straight ones lead a team astray; `asked`: key=value for it."""
    share = float(system.cable_mass.sum()) / system.payload_mass
    if share > HEAVY:
        warn_once(
            "planning",
            f"plans are of straight cables, but these weigh {share:.0%} of the payload and sag: teams of {asked} may "
            f"be lost; lower cable.density, or take another {asked.partition('=')[0]}",
        )


def warn_of_slow_motors(system: System, asked: str) -> None:
    """Warn where rotors follow commands so late that a team oscillates; `asked`: key=value for it."""
    slowest = max(system.vehicles, key=lambda vehicle: vehicle.rotor_time_constant)
    if slowest.rotor_time_constant > SLUGGISH:
        warn_once(
            "planning",
            f"the motors of {slowest.name} lag by {slowest.rotor_time_constant:.3g} s, and above {SLUGGISH:g} s teams "
            f"of {asked} err more or are lost; lower vehicle.rotor_time_constant_up and _down, or take another "
            f"{asked.partition('=')[0]}",
        )


def make_model(system: System) -> TeamModel:
    """Return the nominal model of a team."""
    # The model's cables do not stretch: they are as long as real ones under the resting load.
    stretched = system.cable_length + np.linalg.norm(system.formation_force, axis=1) / system.cable_stiffness
    mass = float(system.payload_mass + 0.5 * system.cable_mass.sum())
    inertia = np.reshape(system.inertia_matrix, (3, 3)).copy()
    if not system.anchors.any():  # nothing turns a point; any moments of inertia do
        inertia = mass * float(stretched.mean()) ** 2 * np.eye(3)
    return TeamModel(
        payload_mass=mass,
        inertia=inertia,
        anchors=np.ascontiguousarray(system.anchors, float),
        drone_mass=system.drone_mass + 0.5 * system.cable_mass,
        length=stretched,
        drag=0.5 * AIR_DENSITY * system.payload_drag_area,
    )


def state_size(num_drones: int) -> int:
    """Return how many numbers a state has."""
    return 12 + 7 * num_drones


class ModelWork(NamedTuple):
    """Results of `accelerations` and `slopes`, and arrays that they work in."""

    column: np.ndarray
    acceleration: np.ndarray
    """(6 + 2 N,) ν̇."""
    tension: np.ndarray
    """(N,) [N]."""
    slope: np.ndarray
    """(6 + 2 N, 12 + 7 N) of the accelerations by the state."""
    tension_slope: np.ndarray
    """(N, 12 + 7 N)."""
    rotation: np.ndarray
    turning: np.ndarray
    mass: np.ndarray
    right: np.ndarray
    direction: np.ndarray
    swing: np.ndarray
    arm: np.ndarray
    spin: np.ndarray
    spin_world: np.ndarray
    pull: np.ndarray
    across: np.ndarray
    by_tension: np.ndarray
    by_across: np.ndarray
    by_arm: np.ndarray
    by_c: np.ndarray
    by_c_swing: np.ndarray
    middle: np.ndarray
    nothing: np.ndarray

    @classmethod
    def of(cls, n: int) -> ModelWork:
        """Return arrays for N drones."""
        size, q = state_size(n), 6 + 2 * n
        shapes = (
            (q,), (n,), (q, size), (n, size), (3, 3), (3, 3, 3), (6, 6), (6, size), (n, 3), (n, 3), (n, 6), (n, 3),
            (n, 3), (n,), (n, 3), (n, LOCAL), (n, LOCAL, 3), (n, LOCAL, 6), (n, 2, 3), (n, 2, 3), (size,), (7,),
        )  # fmt: skip
        return cls(np.zeros((n, LOCAL), np.int64), *(np.zeros(shape) for shape in shapes))


@kernel
def set_rotation(x, rotation, turning):
    """Write R = Rz(yaw) Ry(pitch) Rx(roll) of a state, and its derivatives (3, 3, 3) by roll, pitch and yaw."""
    sr, cr, sp, cp, sy, cy = sin(x[3]), cos(x[3]), sin(x[4]), cos(x[4]), sin(x[5]), cos(x[5])
    rotation[0, 0], rotation[0, 1], rotation[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    rotation[1, 0], rotation[1, 1], rotation[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    rotation[2, 0], rotation[2, 1], rotation[2, 2] = -sp, cp * sr, cp * cr
    # A roll turns the columns R e_y and R e_z into each other, a yaw (last lines) the rows x and y.
    for i in range(3):
        turning[0, i, 0], turning[0, i, 1], turning[0, i, 2] = 0.0, rotation[i, 2], -rotation[i, 1]
    turning[1, 0, 0], turning[1, 0, 1], turning[1, 0, 2] = -cy * sp, cy * cp * sr, cy * cp * cr
    turning[1, 1, 0], turning[1, 1, 1], turning[1, 1, 2] = -sy * sp, sy * cp * sr, sy * cp * cr
    turning[1, 2, 0], turning[1, 2, 1], turning[1, 2, 2] = -cp, -sp * sr, -sp * cr
    for j in range(3):
        turning[2, 0, j], turning[2, 1, j], turning[2, 2, j] = -rotation[1, j], rotation[0, j], 0.0


@kernel
def factorise(matrix, size):
    """Replace the lower triangle of a positive definite matrix by its Cholesky factor."""
    for i in range(size):
        for j in range(i + 1):
            rest = matrix[i, j]
            for k in range(j):
                rest -= matrix[i, k] * matrix[j, k]
            matrix[i, j] = sqrt(rest) if i == j else rest / matrix[j, j]


@kernel
def solve_factorised(factor, right, size, columns):
    """Replace `right` (size, columns) by the solution with a matrix that `factorise` took apart."""
    # Forward, L y = b, ...
    for i in range(size):
        for k in range(i):
            part = factor[i, k]
            for c in range(columns):
                right[i, c] -= part * right[k, c]
        part = 1.0 / factor[i, i]
        for c in range(columns):
            right[i, c] *= part
    # ... and back, Lᵀ x = y.
    for i in range(size - 1, -1, -1):
        for k in range(i + 1, size):
            part = factor[k, i]
            for c in range(columns):
                right[i, c] -= part * right[k, c]
        part = 1.0 / factor[i, i]
        for c in range(columns):
            right[i, c] *= part


@kernel
def accelerations(x, model, load, w):
    """Write ν̇ and the tensions of a state.

    Args:
        x: (12 + 7 N,) state.
        model: TeamModel.
        load: (7,) other force on the payload, world frame [N], moment on it, its frame [N m], and mass beside the
            nominal one [kg]; or (49,), then what drones exert that the model is without: Σ S g (6,) and Σ m g gᵀ (36,).
        w: ModelWork, written.
    """
    count = model.anchors.shape[0]
    q = 6 + 2 * count
    mass, right = w.mass, w.right
    set_rotation(x, w.rotation, w.turning)
    w0, w1, w2 = x[q + 3], x[q + 4], x[q + 5]
    speed = sqrt(x[q] ** 2 + x[q + 1] ** 2 + x[q + 2] ** 2 + SLOW)

    # the payload alone: weight, drag, gyroscopic moment
    j = model.inertia
    l0 = j[0, 0] * w0 + j[0, 1] * w1 + j[0, 2] * w2
    l1 = j[1, 0] * w0 + j[1, 1] * w1 + j[1, 2] * w2
    l2 = j[2, 0] * w0 + j[2, 1] * w1 + j[2, 2] * w2
    mass[:] = 0.0
    payload_mass = model.payload_mass + load[6]
    for i in range(3):
        mass[i, i] = payload_mass
        right[i, 0] = load[i] - model.drag * speed * x[q + i]
        for k in range(3):
            mass[3 + i, 3 + k] = j[i, k]
    right[2, 0] -= payload_mass * GRAVITY
    # Euler's equation in the payload's frame: J α = moment - ω × J ω.
    right[3, 0] = load[3] - (w1 * l2 - w2 * l1)
    right[4, 0] = load[4] - (w2 * l0 - w0 * l2)
    right[5, 0] = load[5] - (w0 * l1 - w1 * l0)

    if load.shape[0] > 7:
        for i in range(6):
            right[i, 0] += load[7 + i]
            for k in range(6):
                mass[i, k] += load[13 + 6 * i + k]
    # each drone adds its mass along its cable, and S
    for n in range(count):
        pull_payload(x, n, q, model, w)
        m, pull = model.drone_mass[n], w.pull[n]
        for i in range(6):
            right[i, 0] += w.arm[n, i] * pull
            for k in range(6):
                mass[i, k] += m * w.arm[n, i] * w.arm[n, k]
    factorise(mass, 6)
    solve_factorised(mass, right, 6, 1)
    for i in range(6):
        w.acceleration[i] = right[i, 0]
    for n in range(count):
        swing_cable(x, n, q, model, w)


@kernel
def pull_payload(x, n, q, model, w):
    """Write g and S = d·(F − m κ) − m g d_z + m L |ḋ|² of drone n, after `set_rotation`."""
    _place_cable(x, n, q, model, w)
    m = model.drone_mass[n]
    pull, fast = -m * GRAVITY * w.direction[n, 2], 0.0
    for i in range(3):
        pull += w.direction[n, i] * (x[2 * q + 3 * n + i] - m * w.spin_world[n, i])
        fast += w.swing[n, i] ** 2
    w.pull[n] = pull + m * model.length[n] * fast


@kernel
def _place_cable(x, n, q, model, w):
    """Write direction and swing of cable n, its arm g, and the anchor's centripetal acceleration κ = ω × (ω × r)."""
    arm = model.anchors[n]
    cx, cy, dx, dy = x[6 + 2 * n], x[7 + 2 * n], x[q + 6 + 2 * n], x[q + 7 + 2 * n]
    # Bounded, so that a trial state of an optimiser with a cable near the horizontal does not divide by zero.
    z = sqrt(max(1.0 - cx * cx - cy * cy, _STEEPEST**2))
    w.direction[n, 0], w.direction[n, 1], w.direction[n, 2] = cx, cy, z
    # ḋ_z from d · ḋ = 0, as d stays a unit vector.
    w.swing[n, 0], w.swing[n, 1], w.swing[n, 2] = dx, dy, -(cx * dx + cy * dy) / z
    w0, w1, w2 = x[q + 3], x[q + 4], x[q + 5]
    along, square = w0 * arm[0] + w1 * arm[1] + w2 * arm[2], w0 * w0 + w1 * w1 + w2 * w2
    spin = w.spin[n]
    # ω × (ω × r) = ω (ω · r) - r |ω|², in the payload's frame.
    spin[0], spin[1], spin[2] = w0 * along - arm[0] * square, w1 * along - arm[1] * square, w2 * along - arm[2] * square
    g = w.arm[n]
    g[0], g[1], g[2] = cx, cy, z
    set_moment_arm(arm, w.rotation, cx, cy, z, g)
    for i in range(3):
        w.spin_world[n, i] = w.rotation[i, 0] * spin[0] + w.rotation[i, 1] * spin[1] + w.rotation[i, 2] * spin[2]


@kernel
def set_moment_arm(arm, rotation, d0, d1, d2, target):
    """Write r × Rᵀd into the last three of `target`."""
    b0 = rotation[0, 0] * d0 + rotation[1, 0] * d1 + rotation[2, 0] * d2
    b1 = rotation[0, 1] * d0 + rotation[1, 1] * d1 + rotation[2, 1] * d2
    b2 = rotation[0, 2] * d0 + rotation[1, 2] * d1 + rotation[2, 2] * d2
    target[3], target[4], target[5] = arm[1] * b2 - arm[2] * b1, arm[2] * b0 - arm[0] * b2, arm[0] * b1 - arm[1] * b0


@kernel
def turning_of_anchor(n, arm, w):
    """Return α × r + κ, by which the anchor of cable n accelerates beside the payload, body frame [m/s²]."""
    a, spin = w.acceleration, w.spin[n]
    return (
        a[4] * arm[2] - a[5] * arm[1] + spin[0],
        a[5] * arm[0] - a[3] * arm[2] + spin[1],
        a[3] * arm[1] - a[4] * arm[0] + spin[2],
    )


@kernel
def swing_cable(x, n, q, model, w):
    """Write tension and c̈ of cable n: L d̈ = h − d (d·h) − L |ḋ|² d, h the drone's acceleration beside the anchor's."""
    a, d, h = w.acceleration, w.direction[n], w.across[n]
    tension = w.pull[n]
    for i in range(6):
        tension -= model.drone_mass[n] * w.arm[n, i] * a[i]
    w.tension[n] = tension
    c0, c1, c2 = turning_of_anchor(n, model.anchors[n], w)
    for i in range(3):
        anchor = a[i] + w.rotation[i, 0] * c0 + w.rotation[i, 1] * c1 + w.rotation[i, 2] * c2
        h[i] = x[2 * q + 3 * n + i] / model.drone_mass[n] - anchor
    # h = F/m - g e_z - (a + R (α × r + κ)). The tension, along d, has no part in what is across d.
    h[2] -= GRAVITY
    along, fast = 0.0, 0.0
    for i in range(3):
        along += d[i] * h[i]
        fast += w.swing[n, i] ** 2
    for i in range(2):
        a[6 + 2 * n + i] = (h[i] - d[i] * along) / model.length[n] - fast * d[i]


@kernel
def euler_rates(roll, pitch):
    """Return six numbers of the matrix T by which T ω are the rates of roll, pitch and yaw: those beside 0 and 1."""
    # With φ, θ, ψ of Rz(ψ) Ry(θ) Rx(φ): φ̇ = p + tan θ (q sin φ + r cos φ), θ̇ = q cos φ - r sin φ,
    # ψ̇ = (q sin φ + r cos φ)/cos θ.
    sr, cr, tp, cp = sin(roll), cos(roll), tan(pitch), cos(pitch)
    return (sr * tp, cr * tp, cr, -sr, sr / cp, cr / cp)


@kernel
def move_to_middle(x, u, h, model, middle):
    """Write the state that a step of `h` [s] takes its accelerations at: half of it at steady velocities."""
    count = model.anchors.shape[0]
    q = 6 + 2 * count
    for i in range(x.shape[0]):
        middle[i] = x[i]
    t = euler_rates(x[3], x[4])
    w0, w1, w2 = x[q + 3], x[q + 4], x[q + 5]
    for i in range(q):
        middle[i] += 0.5 * h * x[q + i]
    # Body rates are no rates of angles: these three, which the loop has moved like the others, are written anew.
    middle[3] = x[3] + 0.5 * h * (w0 + t[0] * w1 + t[1] * w2)
    middle[4] = x[4] + 0.5 * h * (t[2] * w1 + t[3] * w2)
    middle[5] = x[5] + 0.5 * h * (t[4] * w1 + t[5] * w2)
    for i in range(3 * count):
        middle[2 * q + i] += 0.5 * h * u[i]


@kernel
def step_state(x, u, h, model, load, w, after):
    """Write the state after a step of `h` [s] with input u (3 N,) [N/s]: ν by the acceleration in the middle, q by ν.

    Args:
        x: (12 + 7 N,) state.
        u: (3 N,) Ḟ.
        h: [s].
        model: TeamModel.
        load: see `accelerations`.
        w: ModelWork, whose accelerations and tensions are those in the middle.
        after: written; another array than `x`.
    """
    count = model.anchors.shape[0]
    q = 6 + 2 * count
    move_to_middle(x, u, h, model, w.middle)
    accelerations(w.middle, model, load, w)
    a = w.acceleration
    t = euler_rates(x[3], x[4])
    for i in range(q):
        after[i] = x[i] + h * x[q + i] + 0.5 * h * h * a[i]
        after[q + i] = x[q + i] + h * a[i]
    # The mean body rates of the step, as the matrix of the angles' rates stays that of its start.
    w0, w1, w2 = x[q + 3] + 0.5 * h * a[3], x[q + 4] + 0.5 * h * a[4], x[q + 5] + 0.5 * h * a[5]
    after[3] = x[3] + h * (w0 + t[0] * w1 + t[1] * w2)
    after[4] = x[4] + h * (t[2] * w1 + t[3] * w2)
    after[5] = x[5] + h * (t[4] * w1 + t[5] * w2)
    for i in range(3 * count):
        after[2 * q + i] = x[2 * q + i] + h * u[i]
