"""Derivatives of the accelerations and tensions of the reduced model by its state, see `team_model.py`."""

from __future__ import annotations

from math import sqrt

from multilift_marl.kernels.jit import kernel
from multilift_marl.physical import GRAVITY
from multilift_marl.planning.team_model import LOCAL, SLOW, set_moment_arm, solve_factorised, turning_of_anchor


@kernel
def slopes(x, model, w):
    """Write the derivatives of accelerations and tensions by the state, at the state of the last `accelerations`."""
    count = model.anchors.shape[0]
    q = 6 + 2 * count
    size = 2 * q + 3 * count
    right = w.right
    right[:] = 0.0
    w.tension_slope[:] = 0.0
    w.slope[:] = 0.0
    _slope_alone(x, q, model, right)

    # b + Σ S g − Σ m g (g·a) at steady a: what each drone's own numbers change, by its tension and by its arm
    for n in range(count):
        _slope_locally(x, n, q, model, w)
        m = model.drone_mass[n]
        for k in range(LOCAL):
            column, change = w.column[n, k], w.by_tension[n, k]
            for i in range(6):
                change -= m * w.by_arm[n, k, i] * w.acceleration[i]
            w.tension_slope[n, column] += change
            for i in range(6):
                right[i, column] += w.by_arm[n, k, i] * w.tension[n] + w.arm[n, i] * change
    # A a = b: the derivatives solve A a' = b' - A' a, by the factors that `accelerations` has left in `mass`.
    solve_factorised(w.mass, right, 6, size)
    for i in range(6):
        for k in range(size):
            w.slope[i, k] = right[i, k]
    for n in range(count):
        _slope_cable(n, q, size, model, w)


@kernel
def _slope_alone(x, q, model, right):
    """Add the derivatives of the payload's drag and gyroscopic moment."""
    j = model.inertia
    w0, w1, w2 = x[q + 3], x[q + 4], x[q + 5]
    speed = sqrt(x[q] ** 2 + x[q + 1] ** 2 + x[q + 2] ** 2 + SLOW)
    l0 = j[0, 0] * w0 + j[0, 1] * w1 + j[0, 2] * w2
    l1 = j[1, 0] * w0 + j[1, 1] * w1 + j[1, 2] * w2
    l2 = j[2, 0] * w0 + j[2, 1] * w1 + j[2, 2] * w2
    # Drag: the derivative of |v| v_i by v_k is |v| (i = k) + v_i v_k/|v|.
    for i in range(3):
        right[i, q + i] -= model.drag * speed
        for k in range(3):
            right[i, q + k] -= model.drag * x[q + i] * x[q + k] / speed
    for k in range(3):
        # The derivative of ω × J ω by ω_k is e_k × J ω + ω × J e_k.
        e0, e1, e2 = 1.0 * (k == 0), 1.0 * (k == 1), 1.0 * (k == 2)
        right[3, q + 3 + k] -= e1 * l2 - e2 * l1 + w1 * j[2, k] - w2 * j[1, k]
        right[4, q + 3 + k] -= e2 * l0 - e0 * l2 + w2 * j[0, k] - w0 * j[2, k]
        right[5, q + 3 + k] -= e0 * l1 - e1 * l0 + w0 * j[1, k] - w1 * j[0, k]


@kernel
def _slope_locally(x, n, q, model, w):
    """Write what S, h and g of drone n change by each of its `LOCAL` numbers, the payload's accelerations steady."""
    m, arm, rotation, d = model.drone_mass[n], model.anchors[n], w.rotation, w.direction[n]
    column, by_tension, by_across, by_arm = w.column[n], w.by_tension[n], w.by_across[n], w.by_arm[n]
    by_tension[:] = 0.0
    by_across[:] = 0.0
    by_arm[:] = 0.0
    # Where the numbers that its law depends on are in the state: attitude, body rates and thrust; then c and ċ.
    for i in range(3):
        column[i], column[3 + i], column[10 + i] = 3 + i, q + 3 + i, 2 * q + 3 * n + i
    for i in range(2):
        column[6 + i], column[8 + i] = 6 + 2 * n + i, q + 6 + 2 * n + i
    w0, w1, w2 = x[q + 3], x[q + 4], x[q + 5]
    along = w0 * arm[0] + w1 * arm[1] + w2 * arm[2]
    c0, c1, c2 = turning_of_anchor(n, arm, w)
    for k in range(3):
        # attitude: Rᵀd, R κ and the anchor's acceleration turn with it
        turning, spin = w.turning[k], w.spin[n]
        set_moment_arm(arm, turning, d[0], d[1], d[2], by_arm[k])
        for i in range(3):
            by_tension[k] -= m * d[i] * (turning[i, 0] * spin[0] + turning[i, 1] * spin[1] + turning[i, 2] * spin[2])
            by_across[k, i] = -(turning[i, 0] * c0 + turning[i, 1] * c1 + turning[i, 2] * c2)
        # body rates: κ = ω (ω·r) − r |ω|²
        wk = 2.0 * x[q + 3 + k]
        k0 = along * 1.0 * (k == 0) + w0 * arm[k] - arm[0] * wk
        k1 = along * 1.0 * (k == 1) + w1 * arm[k] - arm[1] * wk
        k2 = along * 1.0 * (k == 2) + w2 * arm[k] - arm[2] * wk
        for i in range(3):
            centripetal = rotation[i, 0] * k0 + rotation[i, 1] * k1 + rotation[i, 2] * k2
            by_tension[3 + k] -= m * d[i] * centripetal
            by_across[3 + k, i] = -centripetal
        # thrust vector
        by_tension[10 + k] = d[k]
        by_across[10 + k, k] = 1.0 / m
    _slope_by_swing(x, n, q, model, w)


@kernel
def _slope_by_swing(x, n, q, model, w):
    """Write what S and g of drone n change by direction and swing of its cable, and ∂d/∂c and ∂ḋ/∂c."""
    m, length, d, swing = model.drone_mass[n], model.length[n], w.direction[n], w.swing[n]
    z = d[2]
    turned = d[0] * swing[0] + d[1] * swing[1]
    for k in range(2):
        # d_z = √(1 - |c|²) changes by -c_k/d_z, and ḋ_z = -(c · ċ)/d_z by -ċ_k/d_z - (c · ċ) c_k/d_z³.
        b, s, by_arm = w.by_c[n, k], w.by_c_swing[n, k], w.by_arm[n, 6 + k]
        b[0], b[1], b[2] = 1.0 * (k == 0), 1.0 * (k == 1), -d[k] / z
        s[0], s[1], s[2] = 0.0, 0.0, -swing[k] / z - turned * d[k] / z**3
        by_arm[0], by_arm[1], by_arm[2] = b[0], b[1], b[2]
        set_moment_arm(model.anchors[n], w.rotation, b[0], b[1], b[2], by_arm)
        change, by_swing = -m * GRAVITY * b[2], 0.0
        for i in range(3):
            change += b[i] * (x[2 * q + 3 * n + i] - m * w.spin_world[n, i]) + 2.0 * m * length * swing[i] * s[i]
            by_swing += 2.0 * m * length * swing[i] * b[i]  # ∂ḋ/∂ċ = ∂d/∂c
        w.by_tension[n, 6 + k], w.by_tension[n, 8 + k] = change, by_swing


@kernel
def _slope_cable(n, q, size, model, w):
    """Write the derivatives of tension and c̈ of cable n, those by the payload's accelerations with them."""
    d, h, swing, length, slope = w.direction[n], w.across[n], w.swing[n], model.length[n], w.slope
    along = d[0] * h[0] + d[1] * h[1] + d[2] * h[2]
    fast = swing[0] ** 2 + swing[1] ** 2 + swing[2] ** 2
    # L c̈ = h - d (d · h) - L |ḋ|² d: by what changes h, ...
    for k in range(LOCAL):
        column, change = w.column[n, k], w.by_across[n, k]
        pulled = d[0] * change[0] + d[1] * change[1] + d[2] * change[2]
        for i in range(2):
            slope[6 + 2 * n + i, column] += (change[i] - d[i] * pulled) / length
    # ... then by d and ḋ themselves.
    for k in range(2):
        b, s = w.by_c[n, k], w.by_c_swing[n, k]
        turned = h[0] * b[0] + h[1] * b[1] + h[2] * b[2]
        faster = 2.0 * (swing[0] * s[0] + swing[1] * s[1] + swing[2] * s[2])
        swung = 2.0 * (swing[0] * b[0] + swing[1] * b[1] + swing[2] * b[2])
        for i in range(2):
            slope[6 + 2 * n + i, 6 + 2 * n + k] -= (along * b[i] + d[i] * turned) / length + fast * b[i] + faster * d[i]
            slope[6 + 2 * n + i, q + 6 + 2 * n + k] -= swung * d[i]
    # h falls by the acceleration of the anchor, a + R (α × r); p·R (α × r) = α·(r × Rᵀp)
    lever = w.right[:, 0]  # which is free by now
    for i in range(2):
        for k in range(3):
            lever[k] = (1.0 * (i == k) - d[i] * d[k]) / length
        set_moment_arm(model.anchors[n], w.rotation, lever[0], lever[1], lever[2], lever)
        for j in range(6):
            part = lever[j]
            for k in range(size):
                slope[6 + 2 * n + i, k] -= part * slope[j, k]
    for j in range(6):
        part = model.drone_mass[n] * w.arm[n, j]
        for k in range(size):
            w.tension_slope[n, k] -= part * slope[j, k]
