"""Alpha-beta filters of the payload's pose and velocities as drones measure it (Kalata, IEEE TAES 20(2), 1984)."""

from __future__ import annotations

from math import sqrt

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import (
    add,
    mat,
    matmul,
    matrow,
    mul,
    put,
    putmat,
    rotation_vector,
    row,
    scale,
    sub,
    tmul,
    transpose,
    turn_by,
    vec,
)


def alpha_beta(maneuver: float, noise: float, dt: float) -> tuple[float, float]:
    """Return the steady gains of a filter of position and velocity (Kalata 1984).

    Args:
        maneuver: standard deviation of the acceleration between samples.
        noise: of a measured position.
        dt: from one sample to the next [s].
    """
    # Kalata's tracking index Λ = σ_w T²/σ_v; r, and from it α = 1 - r² and β = 2 (2 - α) - 4 √(1 - α).
    index = maneuver * dt**2 / noise
    r = (4 + index - sqrt(8 * index + index**2)) / 4
    alpha = 1 - r**2
    return alpha, 2 * (2 - alpha) - 4 * sqrt(1 - alpha)


@kernel
def follow_position(e, k, place, velocity, load, sensor, first):
    """Let position and velocity of row k follow a measured position; `first` they are what is given."""
    if first:
        put(load.position[e, k], place)
        put(load.velocity[e, k], velocity)
        return
    alpha, beta = sensor.follow
    expected = add(vec(load.position, e, k), scale(sensor.dt, vec(load.velocity, e, k)))
    gap = sub(place, expected)
    put(load.position[e, k], add(expected, scale(alpha, gap)))
    put(load.velocity[e, k], add(vec(load.velocity, e, k), scale(beta / sensor.dt, gap)))


@kernel
def follow_attitude(e, k, measured, body_rates, load, sensor, first):
    """Let attitude and body rates of row k follow a measured attitude, as `follow_position` does."""
    if first:
        putmat(load.rotation[e, k], measured)
        put(load.body_rates[e, k], body_rates)
        return
    alpha, beta = sensor.turn  # of turns in the world frame
    spin = mul(mat(load.rotation, e, k), vec(load.body_rates, e, k))
    expected = turn_by(scale(sensor.dt, spin), mat(load.rotation, e, k))
    # A turn in the world frame from expected to measured, and the shorter way: never more than half a turn.
    gap = rotation_vector(matmul(measured, transpose(expected)))
    corrected = turn_by(scale(alpha, gap), expected)
    putmat(load.rotation[e, k], corrected)
    # Rates are of the payload's own frame, filtered as a spin in the world frame.
    put(load.body_rates[e, k], tmul(corrected, add(spin, scale(beta / sensor.dt, gap))))


@kernel
def predict_position(e, n, load, sensor):
    """Predict the position of a payload of which nothing is measured, by its velocity."""
    put(load.position[e, n], add(vec(load.position, e, n), scale(sensor.dt, vec(load.velocity, e, n))))


@kernel
def assume_planned(e, n, planned, load):
    """Write the planned motion, a Goal, as what drone n knows of the payload."""
    putmat(load.rotation[e, n], matrow(planned.rotation, e))
    put(load.position[e, n], row(planned.position, e))
    put(load.velocity[e, n], row(planned.velocity, e))
    put(load.body_rates[e, n], (0.0, 0.0, 0.0))
