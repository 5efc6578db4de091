"""How cables hang at rest: the end of one by its tension; a chain between two points, an arc where it is slack."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.math3d import add, cross, dot, norm, put, row, scale, sub, unit

SLACK = 0.98  # [-] of its length: a chain whose ends are closer is laid in an arc, else it hangs by its weight


@kernel
def cable_end(direction, tension, length, stiffness, segments, weight):
    """Return the drone's end of a hanging cable at rest, from its anchor [m].

    Args:
        direction, tension: unit vector and magnitude [N] of the force in its middle.
        length, stiffness: of the whole cable [m], [N/m].
        segments: of a chain, whose mass is that of the nodes between them.
        weight: of the whole cable [N]; 0 if massless.
    """
    if weight == 0.0:
        return scale(length + tension / stiffness, direction)
    end = (0.0, 0.0, 0.0)
    for j in range(segments):
        # The nodes between segments weigh weight/(segments - 1) each: the lowest segment carries half less than the
        # middle, the topmost half more.
        force = add(scale(tension, direction), (0.0, 0.0, weight * (j / (segments - 1) - 0.5)))
        size = norm(force)
        end = add(end, scale((length / size + 1.0 / stiffness) / segments, force))
    return end


@kernel
def hang(chord, opening, length, stiffness, weight, links):
    """Write direction, stretch [m] and velocity [m/s] of each link (n, 7) of a chain that hangs between two points.

    The force of segment j is F_j = F_0 + j w e_z. The F_0 whose links reach the other end minimises the complementary
    energy, Σ (l |F_j| + |F_j|²/2k) - F_0 · chord, which is convex: Newton's method with halved steps finds it.
    Velocities, of a link's upper end relative to its lower one, are all alike; those of an arc do not stretch it.

    Args:
        chord: from the first point to the other [m].
        opening: its rate [m/s].
        length, stiffness: of a segment, l [m] and k [N/m].
        weight: of a node, w [N].
        links: written.
    """
    n = links.shape[0]
    distance = norm(chord)
    if distance < SLACK * n * length:
        _hang_slack(chord, distance, length, links)
        _turn_links(opening, links)
        return
    # Start from a straight chain, pulled at its middle by what stretches it to the distance, at least its weight.
    middle = max(stiffness * (distance / n - length), n * weight)
    force = sub(scale(middle / distance, chord), (0.0, 0.0, 0.5 * n * weight))
    energy, gap, step = _complementary(chord, force, length, stiffness, weight, n)
    # Newton's method; a step that does not lower the energy is halved.
    for _ in range(50):
        if norm(gap) < 1e-14 * distance:
            break
        fraction = 1.0
        for _ in range(30):
            trial = add(force, scale(fraction, step))
            found = _complementary(chord, trial, length, stiffness, weight, n)
            if found[0] <= energy + 1e-14 * abs(energy):
                break
            fraction *= 0.5
        force = trial
        energy, gap, step = found
    # Where it did not converge (or gave NaN), the chain is straight, or an arc if that would compress it.
    straight = not norm(gap) < 1e-9 * distance
    for j in range(n):
        put(links[j, 4:], scale(1.0 / n, opening))
    if straight and distance < n * length:
        _hang_slack(chord, distance, length, links)
        return
    for j in range(n):
        cable_force = add(force, (0.0, 0.0, j * weight))
        put(links[j], unit(chord if straight else cable_force))
        links[j, 3] = distance / n - length if straight else norm(cable_force) / stiffness


@kernel
def _complementary(chord, force, length, stiffness, weight, n):
    """Return the energy of `hang` at F_0, how far the links miss the other end, and Newton's step."""
    energy = -dot(force, chord)
    gap = chord
    xx = yy = zz = xy = xz = yz = 0.0
    for j in range(n):
        cable_force = add(force, (0.0, 0.0, j * weight))
        size = max(norm(cable_force), 1e-9)
        # d/dF of l |F| + |F|²/2k is F (l/|F| + 1/k), the segment that F stretches: the gradient is -gap.
        energy += length * size + 0.5 * size * size / stiffness
        gap = sub(gap, scale(length / size + 1.0 / stiffness, cable_force))
        flat = length / size + 1.0 / stiffness
        bend = length / size**3
        # Its Hessian, the sum of (l/|F| + 1/k) 1 - l F Fᵀ/|F|³: flexibility across a segment, 1/k along it.
        xx += flat - bend * cable_force[0] * cable_force[0]
        yy += flat - bend * cable_force[1] * cable_force[1]
        zz += flat - bend * cable_force[2] * cable_force[2]
        xy -= bend * cable_force[0] * cable_force[1]
        xz -= bend * cable_force[0] * cable_force[2]
        yz -= bend * cable_force[1] * cable_force[2]
    return energy, gap, _solve(xx, yy, zz, xy, xz, yz, gap)


@kernel
def _hang_slack(chord, distance, length, links):
    """Write a slack chain: an arc below the chord, or beside it if that is vertical, no link stretched."""
    n = links.shape[0]
    along = unit(chord)
    below = sub(scale(along[2], along), (0.0, 0.0, 1.0))
    if norm(below) < 1e-3:
        below = sub((1.0, 0.0, 0.0), scale(along[0], along))
    below = unit(below)
    # n links of length l on a circle, turned by b from one to the next, span l sin(n b/2)/sin(b/2): bisected for b,
    # from a straight chain to one that closes on itself.
    low = 1e-9
    high = 2.0 * np.pi / n
    for _ in range(60):
        bend = 0.5 * (low + high)
        if length * sin(0.5 * n * bend) > distance * sin(0.5 * bend):
            low = bend
        else:
            high = bend
    for j in range(n):
        # From the first link, which leads below, to the last, which leads up to the chord's end.
        angle = (0.5 * (n - 1) - j) * bend
        put(links[j], add(scale(cos(angle), along), scale(sin(angle), below)))
        links[j, 3] = 0.0


@kernel
def _turn_links(opening, links):
    """Write the velocities of links that do not stretch and turn as little as their ends' motion allows.

    They are what is left of one vector λ across each link d, λ - d (d · λ), and add up to `opening`.
    """
    n = links.shape[0]
    xx = yy = zz = float(n)
    xy = xz = yz = 0.0
    for j in range(n):
        x, y, z = row(links, j)
        xx -= x * x
        yy -= y * y
        zz -= z * z
        xy -= x * y
        xz -= x * z
        yz -= y * z
    common = _solve(xx, yy, zz, xy, xz, yz, opening)
    for j in range(n):
        link = row(links, j)
        put(links[j, 4:], sub(common, scale(dot(link, common), link)))


@kernel
def _solve(xx, yy, zz, xy, xz, yz, right):
    """Return the solution of three linear equations with a symmetric matrix."""
    first = (xx, xy, xz)
    second = (xy, yy, yz)
    third = (xz, yz, zz)
    minor = cross(second, third)
    volume = dot(first, minor)
    return scale(1.0 / volume, (dot(minor, right), dot(cross(third, first), right), dot(cross(first, second), right)))
