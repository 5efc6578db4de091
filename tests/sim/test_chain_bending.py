"""Bending of chains: forces and moments are slopes of its energy, by finite differences, on bodies of any attitude."""

from __future__ import annotations

import numpy as np
from plain_kernels import plain, record, turned

from multilift_marl.sim.cables.chain_dynamics import _find_bending

STIFFNESS = np.array([0.7, 1.3, 0.4])  # [N m/rad]
ANCHORS = np.array([[0.3, 0.1, 0.08], [-0.25, 0.15, 0.05], [0.1, -0.2, 0.06]])
HOOKS = np.array([[0.03, -0.05, -0.07], [-0.04, 0.02, -0.06], [0.02, 0.06, -0.05]])
CENTER = np.array([[0.02, -0.03, 0.04], [0, 0, 0], [0, 0, 0], [0, 0, 0]])
LINKS = 3


def make_scene():
    """Return places (4, 3) and attitudes (4, 3, 3) of the payload and three drones, and nodes (3, 2, 3)."""
    rng = np.random.default_rng(3)
    places = np.array([[0.1, -0.2, 1.0], [0.9, 0.4, 1.9], [-0.8, 0.5, 2.1], [0.2, -1.0, 2.0]])
    attitudes = np.stack([turned(rng.normal(size=3), angle) for angle in (0.3, 0.5, -0.6, 0.8)])
    low, high = ends(places, attitudes)
    share = np.arange(1, LINKS) / LINKS
    nodes = low[:, None] + share[:, None] * (high - low)[:, None]
    return places, attitudes, nodes + 0.1 * rng.normal(size=nodes.shape)


def ends(places, attitudes):
    """Return anchors and hooks of the three cables (3, 3)."""
    low = places[0] + (ANCHORS - CENTER[0]) @ attitudes[0].T
    return low, places[1:] + np.einsum("nij,nj->ni", attitudes[1:], HOOKS)


def energy(places, attitudes, nodes) -> float:
    """Return the sum of κ θ² / 2 over all bends."""
    low, high = ends(places, attitudes)
    points = np.concatenate([low[:, None], nodes, high[:, None]], axis=1)
    links = np.diff(points, axis=1)
    links /= np.linalg.norm(links, axis=-1, keepdims=True)
    angle = np.arccos((links[:, 1:] * links[:, :-1]).sum(-1))
    return 0.5 * float((STIFFNESS[:, None] * angle**2).sum())


def find_bending(places, attitudes, nodes):
    """Return what the kernel writes: forces on bodies and nodes, moments on bodies."""
    still = record(position=nodes[None], velocity=np.zeros((1, *nodes.shape)))
    motion = record(
        position=places[None], rotation=attitudes[None], velocity=np.zeros((1, 4, 3)), rates=np.zeros((1, 4, 3))
    )
    chain = record(
        motion=motion, nodes=still, segments=np.full(3, LINKS), cables=record(anchors=ANCHORS, hooks=HOOKS),
        bodies=record(center=CENTER[None]), bending_stiffness=STIFFNESS, bending_damping=np.zeros(3),
    )  # fmt: skip
    written = {"bend_power": 1, "bend_force": (4, 3), "bend_moment": (4, 3), "bending": (3, LINKS - 1, 3)}
    work = record(**{name: np.ones(shape) for name, shape in written.items()})
    plain(_find_bending)(0, record(cable_broken=np.zeros((1, 3), bool)), chain, work)
    return work


def slope(function, array) -> np.ndarray:
    """Return the derivatives of a function of an array by its numbers."""
    found, step = np.zeros(array.shape), 1e-6
    for index in np.ndindex(array.shape):
        change = np.zeros(array.shape)
        change[index] = step
        found[index] = (function(array + change) - function(array - change)) / (2 * step)
    return found


def test_forces_and_moments_are_slopes_of_the_energy_of_bending():
    places, attitudes, nodes = make_scene()
    work = find_bending(places, attitudes, nodes)

    def turn(angles):
        moved = [turned(each, np.linalg.norm(each)) @ R for each, R in zip(angles, attitudes, strict=True)]
        return energy(places, np.stack(moved), nodes)

    np.testing.assert_allclose(work.bend_force, -slope(lambda p: energy(p, attitudes, nodes), places), atol=1e-7)
    np.testing.assert_allclose(work.bending, -slope(lambda x: energy(places, attitudes, x), nodes), atol=1e-7)
    np.testing.assert_allclose(work.bend_moment, -slope(turn, np.full((4, 3), 1e-12)), atol=1e-7)
    assert np.abs(work.bend_moment).min(axis=1).min() > 1e-4 and work.bend_power[0] == 0.0
