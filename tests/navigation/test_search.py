"""The search on the lattice and the elastic band, each alone."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_system
from test_routes import GOAL, PILLARS, START, WALL, placed

from multilift_marl.navigation.formation_shapes import make_shape_limits, make_shapes
from multilift_marl.navigation.search import make_lattice, search_route, states_at
from multilift_marl.navigation.smoothing import Band, assemble, coordinate_scale, make_work, smooth_knots, space_knots
from multilift_marl.navigation.team_clearance import make_body, make_scene, measure_clearance, write_arms

SPACE = np.array([[-4.5, -3.0, 0.5], [4.5, 3.0, 3.2]])
KEPT = 0.03, 0.25


def searched(rows):
    """Return states (S, 6) from start to goal, the body, the scene and the shapes of four drones."""
    system = make_system(4)
    shapes = make_shapes(system)
    body, scene = make_body(system, shapes.rest, shapes.modes), make_scene(placed(rows), 0)
    lattice = make_lattice(START, GOAL, SPACE, np.array([0.15, 0.15, 0.25]), body, shapes, KEPT)
    way, _ = search_route(lattice, START, 0, body, scene, 100_000)
    return states_at(way, lattice, shapes), body, scene, shapes


def clearances(states, body, scene):
    arms, found = np.zeros((len(states), 4, 3)), np.zeros(len(states))
    for k, state in enumerate(states):
        write_arms(state[4:].copy(), body, arms[k])
    measure_clearance(states[:, :4].copy(), arms, body, scene, KEPT[1], found)
    return found


@pytest.mark.parametrize("rows", [PILLARS, WALL], ids=["pillars", "gap"])
def test_states_of_a_way_are_neighbours_and_keep_their_clearance(rows):
    states, body, scene, shapes = searched(rows)
    assert states[0] == pytest.approx(np.append(START, [0, 0])) and (np.abs(states[-1, :3] - GOAL[:3]) <= 0.13).all()
    steps = np.abs(np.diff(states, axis=0))
    assert (steps <= np.array([0.15, 0.15, 0.25, np.pi / 8, 0.5, 0.5]) + 1e-9).all()
    assert ((steps[:, :3].max(axis=1) > 0).astype(int) + (steps[:, 3] > 0) + (steps[:, 4:].max(axis=1) > 0) == 1).all()
    assert clearances(states, body, scene).min() >= KEPT[0]
    assert all((shapes.choices == state[4:]).all(axis=1).any() for state in states)


def band_of(states, body, scene):
    knots, spacing = space_knots(states, coordinate_scale(2))
    return knots, Band(
        body=body,
        scene=scene,
        limits=make_shape_limits(make_system(4)),
        space=SPACE,
        scale=coordinate_scale(2),
        safe=np.full(len(knots), 0.08),
        comfort=KEPT[1],
        spacing=spacing,
        lead=np.zeros(6),
    )


def test_the_gradient_of_the_distances_is_that_of_their_cost():
    """By differences over 1 cm, since distances are known to within a millimetre, and without the band's own part."""
    knots, band = band_of(*searched(PILLARS)[:3])
    knots = knots + 0.02 * np.random.default_rng(1).standard_normal(knots.shape)
    bands = band, band._replace(scene=make_scene(placed([]), 0))
    works = make_work(knots, band), make_work(knots, band)

    def cost(knots):
        return np.subtract(*(assemble(knots, each, work) for each, work in zip(bands, works, strict=True)))

    cost(knots)
    gradient = (works[0].gradient - works[1].gradient).reshape(-1, 6)
    slope = np.zeros_like(gradient)
    for k, i in np.ndindex(slope.shape):
        step = np.zeros_like(knots)
        step[1 + k, i] = 0.01
        slope[k, i] = (cost(knots + step) - cost(knots - step)) / 0.02
    for i in range(6):
        agreement = gradient[:, i] @ slope[:, i] / (np.linalg.norm(gradient[:, i]) * np.linalg.norm(slope[:, i]))
        assert agreement > 0.97, i


def test_a_smooth_band_is_shorter_and_farther_from_obstacles():
    states, body, scene, _ = searched(PILLARS)
    knots, band = band_of(states, body, scene)
    smooth = smooth_knots(knots, band)
    assert smooth[[0, -1]] == pytest.approx(knots[[0, -1]])
    length = [np.linalg.norm(np.diff(each[:, :3], axis=0), axis=1).sum() for each in (knots, smooth)]
    bend = [np.linalg.norm(np.diff(each, n=2, axis=0), axis=1).max() for each in (knots, smooth)]
    assert length[1] < length[0] and bend[1] < 0.5 * bend[0]
    assert clearances(smooth, body, scene).min() > 0.07
