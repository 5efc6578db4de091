"""Vectors, rotations, quaternions and smooth paths on scalars, for compiled loops.

A vector is a tuple of 3, a matrix of 9 (rows). Quaternions are (w, x, y, z). Tuples live in registers, so that a loop
over drones allocates nothing.
"""

from __future__ import annotations

from math import atan2, cos, sin, sqrt

import numpy as np

from multilift_marl.kernels.jit import kernel

IDENTITY = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0)


def triple(vector: np.ndarray) -> tuple[float, float, float]:
    """Return a vector (3,) as kernels take it."""
    x, y, z = vector.tolist()
    return x, y, z


@kernel
def vec(a, i, j):
    """Return row (i, j) of an (E, N, 3) array."""
    return (a[i, j, 0], a[i, j, 1], a[i, j, 2])


@kernel
def row(a, i):
    """Return row i of an (E, 3) array."""
    return (a[i, 0], a[i, 1], a[i, 2])


@kernel
def mat(a, i, j):
    """Return matrix (i, j) of an (E, N, 3, 3) array."""
    m = a[i, j]
    return (m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@kernel
def matrow(a, i):
    """Return matrix i of an (E, 3, 3) array."""
    m = a[i]
    return (m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2], m[2, 0], m[2, 1], m[2, 2])


@kernel
def put(target, v):
    """Write a vector into an array of 3."""
    target[0], target[1], target[2] = v


@kernel
def putmat(target, m):
    """Write a matrix into an array of 3 × 3."""
    target[0, 0], target[0, 1], target[0, 2] = m[0], m[1], m[2]
    target[1, 0], target[1, 1], target[1, 2] = m[3], m[4], m[5]
    target[2, 0], target[2, 1], target[2, 2] = m[6], m[7], m[8]


@kernel
def add(a, b):
    """Return a + b."""
    return (a[0] + b[0], a[1] + b[1], a[2] + b[2])


@kernel
def sub(a, b):
    """Return a - b."""
    return (a[0] - b[0], a[1] - b[1], a[2] - b[2])


@kernel
def scale(k, a):
    """Return k a."""
    return (k * a[0], k * a[1], k * a[2])


@kernel
def dot(a, b):
    """Return a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a, b):
    """Return a × b."""
    return (a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0])


@kernel
def norm(a):
    """Return |a|."""
    return sqrt(dot(a, a))


@kernel
def unit(a):
    """Return a/|a|, or e_z where a is (almost) zero."""
    length = norm(a)
    if length < 1e-9:
        return (0.0, 0.0, 1.0)
    return scale(1.0 / length, a)


@kernel
def clip(value, low, high):
    """Return value within [low, high]."""
    return min(max(value, low), high)


@kernel
def limit(a, largest):
    """Return a, shortened to `largest` where it is longer."""
    length = norm(a)
    if length > largest:
        return scale(largest / length, a)
    return scale(1.0, a)


@kernel
def mul(m, v):
    """Return M v."""
    return (
        m[0] * v[0] + m[1] * v[1] + m[2] * v[2],
        m[3] * v[0] + m[4] * v[1] + m[5] * v[2],
        m[6] * v[0] + m[7] * v[1] + m[8] * v[2],
    )


@kernel
def tmul(m, v):
    """Return Mᵀ v."""
    return (
        m[0] * v[0] + m[3] * v[1] + m[6] * v[2],
        m[1] * v[0] + m[4] * v[1] + m[7] * v[2],
        m[2] * v[0] + m[5] * v[1] + m[8] * v[2],
    )


@kernel
def transpose(m):
    """Return Mᵀ."""
    return (m[0], m[3], m[6], m[1], m[4], m[7], m[2], m[5], m[8])


@kernel
def matmul(a, b):
    """Return A B."""
    c0, c1, c2 = column(b, 0), column(b, 1), column(b, 2)
    return from_columns(mul(a, c0), mul(a, c1), mul(a, c2))


@kernel
def column(m, i):
    """Return column i of M."""
    return (m[i], m[3 + i], m[6 + i])


@kernel
def from_columns(x, y, z):
    """Return the matrix with columns x, y, z."""
    return (x[0], y[0], z[0], x[1], y[1], z[1], x[2], y[2], z[2])


@kernel
def rot_z(angle):
    """Return the rotation by `angle` about z."""
    c, s = cos(angle), sin(angle)
    return (c, -s, 0.0, s, c, 0.0, 0.0, 0.0, 1.0)


@kernel
def turn(c, s, v):
    """Return v rotated about z by the angle of cosine c and sine s."""
    return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])


@kernel
def quat_to_mat(w, x, y, z):
    """Return the rotation matrix of the quaternion, normalised first (Shuster 1993, eq 97)."""
    k = 2.0 / (w * w + x * x + y * y + z * z)
    return (
        1.0 - k * (y * y + z * z), k * (x * y - w * z), k * (x * z + w * y),
        k * (x * y + w * z), 1.0 - k * (x * x + z * z), k * (y * z - w * x),
        k * (x * z - w * y), k * (y * z + w * x), 1.0 - k * (x * x + y * y),
    )  # fmt: skip


@kernel
def mat_to_quat(m):
    """Return the unit quaternion (w, x, y, z) of a rotation matrix (Shepperd 1978)."""
    # The largest of w, x, y, z first: the others follow by what cannot be near 0.
    trace = m[0] + m[4] + m[8]
    if trace >= m[0] and trace >= m[4] and trace >= m[8]:
        w = 1.0 + trace
        x, y, z = m[7] - m[5], m[2] - m[6], m[3] - m[1]
    elif m[0] >= m[4] and m[0] >= m[8]:
        x = 1.0 + 2.0 * m[0] - trace
        w, y, z = m[7] - m[5], m[1] + m[3], m[2] + m[6]
    elif m[4] >= m[8]:
        y = 1.0 + 2.0 * m[4] - trace
        w, x, z = m[2] - m[6], m[1] + m[3], m[5] + m[7]
    else:
        z = 1.0 + 2.0 * m[8] - trace
        w, x, y = m[3] - m[1], m[2] + m[6], m[5] + m[7]
    k = 1.0 / sqrt(w * w + x * x + y * y + z * z)
    return (k * w, k * x, k * y, k * z)


@kernel
def axis_angle(axis, angle):
    """Return the rotation by `angle` about the unit vector `axis` (Rodrigues)."""
    h = 0.5 * angle
    s = sin(h)
    return quat_to_mat(cos(h), s * axis[0], s * axis[1], s * axis[2])


@kernel
def turn_by(rotation, m):
    """Return the attitude M turned by a rotation vector, in the frame that M leads to."""
    angle = norm(rotation)
    return matmul(axis_angle(scale(1.0 / angle, rotation), angle), m) if angle > 0.0 else m


@kernel
def rotation_vector(m):
    """Return axis times angle of M, angle in [0, π]."""
    w, x, y, z = mat_to_quat(m)
    # q and -q are one rotation; of the two, that by at most half a turn.
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    s = sqrt(x * x + y * y + z * z)
    k = 2.0 if s < 1e-12 else 2.0 * atan2(s, w) / s
    return (k * x, k * y, k * z)


@kernel
def heading(m):
    """Return the yaw that eq 29 prescribes, ψ = atan2(-R01, R11)."""
    return atan2(-m[1], m[4])


@kernel
def thrust_frame(force, yaw):
    """Return the attitude whose z axis is along `force` and whose heading is `yaw` (report eqs 28-30).

    Where the force points along the heading, eq 29 has no answer; the body y axis then stays horizontal.
    """
    b3 = unit(force)
    # b2 across thrust and heading, b1 = b2 × b3: the heading bends, the thrust's direction does not.
    side = cross(b3, (cos(yaw), sin(yaw), 0.0))
    if norm(side) < 1e-6:
        side = (-sin(yaw), cos(yaw), 0.0)
    b2 = unit(side)
    return from_columns(cross(b2, b3), b2, b3)


@kernel
def segment_distance(p1, q1, p2, q2):
    """Return the distance between the segments p1 q1 and p2 q2."""
    d1, d2 = sub(q1, p1), sub(q2, p2)
    s, t = nearest_points(sub(p1, p2), d1, d2)
    return norm(sub(add(p1, scale(s, d1)), add(p2, scale(t, d2))))


@kernel
def nearest_points(r, d1, d2):
    """Return the shares of two segments at which they are nearest (Ericson, Real-Time Collision Detection, 5.1.9).

    Args:
        r: from the start of the second to that of the first.
        d1, d2: the segments.
    """
    a, e, f = dot(d1, d1), dot(d2, d2), dot(d2, r)
    b, c = dot(d1, d2), dot(d1, r)
    denominator = a * e - b * b
    # Parallel segments have no nearest pair of their own: any point of the first will do.
    s = clip((b * f - c * e) / denominator, 0.0, 1.0) if denominator > 1e-12 * a * e else 0.0
    t = (b * s + f) / e
    if t < 0.0:
        t, s = 0.0, clip(-c / a, 0.0, 1.0)
    elif t > 1.0:
        t, s = 1.0, clip((b - c) / a, 0.0, 1.0)
    return s, t


@kernel
def ease(t, begin, seconds):
    """Return the fraction of a smooth path covered at time t [s], and its first three derivatives in time.

    The polynomial of degree seven whose first three derivatives are zero at both ends: of all moves from rest to rest
    that with the least squared snap, as of paths through way-points (`planning/minimum_snap.py`).
    """
    s = min(max((t - begin) / seconds, 0.0), 1.0)
    # d/ds of the fraction is 140 u³; the rest follows by the chain rule.
    u = s * (1.0 - s)
    fraction = s**4 * (35.0 - 84.0 * s + 70.0 * s**2 - 20.0 * s**3)
    second = 420.0 * u**2 * (1.0 - 2.0 * s) / seconds**2
    return fraction, 140.0 * u**3 / seconds, second, 840.0 * u * (1.0 - 5.0 * u) / seconds**3
