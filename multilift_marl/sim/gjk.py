"""Distance of two convex bodies by their support functions (Gilbert, Johnson and Keerthi 1988).

A body is its kind, its middle, nine numbers, the half edges of its box as columns, of a HULL its attitude alone, and a
HULL's row of `hulls`, vertices (H, V, 3) [m]. A segment is a BOX two of whose half edges are zero. Points of the
difference A - B are tuples; no array is made.
"""

from __future__ import annotations

from math import sqrt

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, column, cross, dot, mul, norm, scale, sub, tmul
from multilift_marl.sim.obstacles import BOX, CYLINDER

TOUCHING = 1e-7  # [m] bodies that are no farther apart touch
_TOLERANCE = 1e-7  # [m] between the bounds of a distance
_STEPS = 100  # enough for the roundest bodies; polytopes take about five
_FLAT = 1e-14  # relative volume of a simplex that has none
_ZERO = (0.0, 0.0, 0.0)


@kernel
def separation(one, other, hulls, beyond):
    """Return the vector from the nearest point of the second body to that of the first [m]; zero if they touch.

    Args:
        one, other: bodies, see the module.
        hulls: vertices (H, V, 3) of the hulls [m].
        beyond: bodies farther apart than that may be reported at any greater distance [m].
    """
    kind, middle, axes, hull = one
    other_kind, other_middle, other_axes, other_hull = other
    # Any point of A - B will do to begin with; the middle of a hull need not be in it.
    toward = sub(other_middle, middle)
    a = sub(
        add(middle, support(kind, axes, toward, hulls, hull)),
        add(other_middle, support(other_kind, other_axes, scale(-1.0, toward), hulls, other_hull)),
    )
    v, b, c = a, _ZERO, _ZERO
    count = 1
    for _ in range(_STEPS):
        length = norm(v)
        if length <= TOUCHING:
            return _ZERO
        # The plane across v through w separates the origin from A - B: a lower bound, as |v| is an upper one.
        toward = scale(-1.0, v)
        w = sub(
            add(middle, support(kind, axes, toward, hulls, hull)),
            add(other_middle, support(other_kind, other_axes, v, hulls, other_hull)),
        )
        least = dot(v, w) / length
        if least > beyond or length - least <= _TOLERANCE:
            return v
        # Only faces with the new point can be nearer than v.
        nearer, found, p, q, r = _nearest(w, count, a, b, c)
        if found == 4:
            return _ZERO
        if dot(nearer, nearer) >= length * length:
            return v
        v, count, a, b, c = nearer, found, p, q, r
    return v


@kernel
def support(kind, axes, direction, hulls, hull):
    """Return the point of a body that is farthest in a direction, from its middle."""
    x, y, z = tmul(axes, direction)
    if kind == BOX:
        return mul(axes, (_sign(x), _sign(y), _sign(z)))
    if kind == CYLINDER:
        radial = sqrt(x * x + y * y)
        if radial > 0.0:
            x, y = x / radial, y / radial
        return mul(axes, (x, y, _sign(z)))
    # A HULL: spheres are left to closed forms.
    best, largest = 0, -1e300
    for i in range(hulls.shape[1]):
        height = x * hulls[hull, i, 0] + y * hulls[hull, i, 1] + z * hulls[hull, i, 2]
        if height > largest:
            best, largest = i, height
    return mul(axes, (hulls[hull, best, 0], hulls[hull, best, 1], hulls[hull, best, 2]))


@kernel
def _sign(x):
    return 1.0 if x >= 0.0 else -1.0


@kernel
def _nearest(w, count, a, b, c):
    """Return the point nearest to the origin of w and `count` further points, and the points that span its face."""
    if count == 1:
        v, found, p, q = _nearest_of_two(w, a)
        return v, found, p, q, _ZERO
    if count == 2:
        return _nearest_of_three(w, a, b)
    # A tetrahedron holds the origin if it is on the inner side of all faces: four volumes of one sign.
    ab, bc, ca = cross(a, b), cross(b, c), cross(c, a)
    outer, first, second, third = dot(a, bc), dot(w, bc), dot(w, ca), dot(w, ab)
    volume = outer - first - second - third
    size = norm(sub(a, w)) * norm(sub(b, w)) * norm(sub(c, w))
    if abs(volume) > _FLAT * size:
        s = _sign(volume)
        if s * outer > 0.0 and s * first < 0.0 and s * second < 0.0 and s * third < 0.0:
            return _ZERO, 4, a, b, c
    best = _nearest_of_three(w, a, b)
    for i in range(2):
        face = _nearest_of_three(w, b, c) if i == 0 else _nearest_of_three(w, c, a)
        if dot(face[0], face[0]) < dot(best[0], best[0]):
            best = face
    return best


@kernel
def _nearest_of_three(w, a, b):
    """Do as `_nearest` for a triangle."""
    one, other = sub(a, w), sub(b, w)
    normal = cross(one, other)
    square = dot(normal, normal)
    if square > _FLAT * dot(one, one) * dot(other, other):
        # The origin's foot is inside if all its barycentric coordinates are positive.
        inside = dot(normal, cross(a, b)) > 0.0
        inside = inside and dot(normal, cross(b, w)) > 0.0 and dot(normal, cross(w, a)) > 0.0
        if inside:
            return scale(dot(normal, w) / square, normal), 3, w, a, b
    v, found, p, q = _nearest_of_two(w, a)
    v2, found2, p2, q2 = _nearest_of_two(w, b)
    if dot(v2, v2) < dot(v, v):
        v, found, p, q = v2, found2, p2, q2
    return v, found, p, q, _ZERO


@kernel
def _nearest_of_two(w, a):
    """Do as `_nearest` for a segment."""
    along = sub(a, w)
    square = dot(along, along)
    share = -dot(w, along) / square if square > 0.0 else 0.0
    if share <= 0.0:
        return w, 1, w, _ZERO
    if share >= 1.0:
        return a, 1, a, _ZERO
    return add(w, scale(share, along)), 2, w, a


@kernel
def nearest_within(kind, axes, point):
    """Return the point of a BOX or CYLINDER nearest to another, both from its middle: itself if it is inside."""
    # Coordinates in half edges; an edge of no length has none.
    x, y, z = tmul(axes, point)
    one, two, three = column(axes, 0), column(axes, 1), column(axes, 2)
    x, y, z = _share(x, dot(one, one)), _share(y, dot(two, two)), _share(z, dot(three, three))
    z = min(max(z, -1.0), 1.0)
    if kind == CYLINDER:
        outside = max(sqrt(x * x + y * y), 1.0)
        return mul(axes, (x / outside, y / outside, z))
    return mul(axes, (min(max(x, -1.0), 1.0), min(max(y, -1.0), 1.0), z))


@kernel
def _share(x, square):
    return x / square if square > 0.0 else 0.0
