"""How a chain hangs between two points: the elastic catenary of its links, and an arc where it is slack."""

from __future__ import annotations

from math import cos, sin

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.math3d import add, cross, dot, norm, put, scale, sub, unit

SLACK = 0.98  # of its length: a cable whose ends are closer is laid in an arc, one that sags less hangs by its weight


@kernel
def hang(chord, length, stiffness, weight, links):
    """Write direction and stretch [m] of each link (n, 4) of a chain at rest between two points.

    Segment j pulls with F_j = F_0 + j w e_z. The F_0 whose links reach to the other end minimises the complementary
    energy, Σ (l |F_j| + |F_j|²/2k) - F_0 · chord, which is convex: Newton's method with halved steps finds it.

    Args:
        chord: from the first point to the other [m].
        length, stiffness: of a segment, l [m] and k [N/m].
        weight: of a node, w [N].
        links: written.
    """
    n, distance = links.shape[0], norm(chord)
    if distance < SLACK * n * length:
        _hang_slack(chord, distance, length, links)
        return
    middle = max(stiffness * (distance / n - length), n * weight)
    force = sub(scale(middle / distance, chord), (0.0, 0.0, 0.5 * n * weight))
    energy, gap, step = _complementary(chord, force, length, stiffness, weight, n)
    for _ in range(50):
        if norm(gap) < 1e-14 * distance:
            break
        share = 1.0
        for _ in range(30):
            trial = add(force, scale(share, step))
            found = _complementary(chord, trial, length, stiffness, weight, n)
            if found[0] <= energy + 1e-14 * abs(energy):
                break
            share *= 0.5
        force = trial
        energy, gap, step = found
    straight = not norm(gap) < 1e-9 * distance
    if straight and distance < n * length:
        _hang_slack(chord, distance, length, links)
        return
    for j in range(n):
        pull = add(force, (0.0, 0.0, j * weight))
        put(links[j], unit(chord if straight else pull))
        links[j, 3] = distance / n - length if straight else norm(pull) / stiffness


@kernel
def _complementary(chord, force, length, stiffness, weight, n):
    """Return the energy of `hang` at F_0, how far the links miss the other end, and Newton's step."""
    energy, gap = -dot(force, chord), chord
    xx, yy, zz, xy, xz, yz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for j in range(n):
        pull = add(force, (0.0, 0.0, j * weight))
        size = max(norm(pull), 1e-9)
        energy += length * size + 0.5 * size * size / stiffness
        gap = sub(gap, scale(length / size + 1.0 / stiffness, pull))
        flat, bend = length / size + 1.0 / stiffness, length / size**3
        xx += flat - bend * pull[0] * pull[0]
        yy += flat - bend * pull[1] * pull[1]
        zz += flat - bend * pull[2] * pull[2]
        xy -= bend * pull[0] * pull[1]
        xz -= bend * pull[0] * pull[2]
        yz -= bend * pull[1] * pull[2]
    first = cross((xy, yy, yz), (xz, yz, zz))
    volume = dot((xx, xy, xz), first)
    second, third = cross((xz, yz, zz), (xx, xy, xz)), cross((xx, xy, xz), (xy, yy, yz))
    return energy, gap, scale(1.0 / volume, (dot(first, gap), dot(second, gap), dot(third, gap)))


@kernel
def _hang_slack(chord, distance, length, links):
    """Write a slack chain: an arc below the chord, or beside it if that is vertical, no link stretched."""
    n = links.shape[0]
    along = unit(chord)
    below = sub(scale(along[2], along), (0.0, 0.0, 1.0))
    if norm(below) < 1e-3:
        below = sub((1.0, 0.0, 0.0), scale(along[0], along))
    below = unit(below)
    low, high = 1e-9, 2.0 * np.pi / n
    for _ in range(60):
        bend = 0.5 * (low + high)
        if length * sin(0.5 * n * bend) > distance * sin(0.5 * bend):
            low = bend
        else:
            high = bend
    for j in range(n):
        angle = (0.5 * (n - 1) - j) * bend
        put(links[j], add(scale(cos(angle), along), scale(sin(angle), below)))
        links[j, 3] = 0.0
