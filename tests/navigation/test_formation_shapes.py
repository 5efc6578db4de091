"""Shapes of a formation: they balance the payload, keep drones and cables apart, and are narrow enough for gaps."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, make_system
from scipy.optimize import nnls

from multilift_marl.config.load import load_config
from multilift_marl.navigation.formation_shapes import drone_places, find_breach, make_shapes
from multilift_marl.planning.maps import GAPS, formation_width

TEAMS = (2, 3, 4, 6, 8)


def blends(shapes):
    """Yield coordinates of shapes along every link of choices."""
    for i, j in zip(*np.nonzero(shapes.linked), strict=True):
        for share in np.linspace(0, 1, 11):
            yield (1 - share) * shapes.choices[i] + share * shapes.choices[j]


def height(system, force):
    """Return how far drones are above or below the payload's centre of mass, at most [m]."""
    return np.abs(drone_places(system, force)[:, 2]).max()


@pytest.mark.parametrize("low", [False, True])
@pytest.mark.parametrize("num_drones", TEAMS)
def test_cables_in_the_shapes_directions_hold_the_payload_level(num_drones, low):
    """Tensions are found anew, by non-negative least squares, from the directions of the cables alone."""
    system = make_system(num_drones)
    shapes = make_shapes(system, low)
    weight = system.payload_mass * GRAVITY
    for coordinates in blends(shapes):
        force = shapes.forces(coordinates)
        assert force.sum(axis=0) == pytest.approx([0, 0, weight], abs=1e-9 * weight)
        assert np.cross(system.anchors, force).sum(axis=0) == pytest.approx(np.zeros(3), abs=1e-9 * weight)
        direction = drone_places(system, force) - system.anchors
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        exerted = np.vstack([direction.T, np.cross(system.anchors, direction).T])
        tension, missed = nnls(exerted, np.array([0, 0, weight, 0, 0, 0]))
        assert missed < 1e-9 * weight and (tension >= 0).all()


@pytest.mark.parametrize("low", [False, True])
@pytest.mark.parametrize("num_drones", TEAMS)
def test_drones_stay_apart_and_cables_taut_and_steep_from_shape_to_shape(num_drones, low):
    system = make_system(num_drones)
    shapes = make_shapes(system, low)
    rest = np.linalg.norm(shapes.rest, axis=1)
    for coordinates in blends(shapes):
        force = shapes.forces(coordinates)
        places = drone_places(system, force)
        apart = np.linalg.norm(places[:, None] - places[None], axis=-1)
        pairs = np.triu_indices(num_drones, 1)
        assert (apart[pairs] >= 1.15 * system.min_separation[pairs] - 1e-6).all()
        assert (np.linalg.norm(force, axis=1) >= 0.25 * rest).all()
        assert (np.degrees(np.arctan2(np.hypot(force[:, 0], force[:, 1]), force[:, 2])) <= 50.01).all()
        share = np.linspace(0, 1, 41)[:, None, None]
        cable = system.anchors + share * (places - system.anchors)
        for i, j in zip(*pairs, strict=True):
            assert np.linalg.norm(cable[:, None, i] - cable[None, :, j], axis=-1).min() >= 0.1


@pytest.mark.parametrize("num_drones", TEAMS)
def test_a_shape_passes_the_narrowest_gap_with_room_on_both_sides(num_drones):
    system = make_system(num_drones)
    shapes = make_shapes(system)
    gap = GAPS[0] * formation_width(system)
    body = float(np.linalg.norm(system.vehicle.half_size))
    widths = [
        max(2 * np.abs(drone_places(system, shapes.forces(each))[:, axis]).max() + 2 * body, system.payload_size[axis])
        for each in shapes.choices
        for axis in (0, 1)
    ]
    assert min(widths) < gap - 2 * 0.06


@pytest.mark.parametrize("num_drones", TEAMS)
def test_low_shapes_are_further_ones_and_lean_as_far_as_cables_may(num_drones):
    """Anchors are level: the lowest formation has all cables at 50 degrees, and tensions of cos 30 / cos 50."""
    system = make_system(num_drones)
    usual, low = make_shapes(system), make_shapes(system, low=True)
    assert len(low.modes) == len(usual.modes) + 1 and np.array_equal(low.modes[:-1], usual.modes)
    assert np.array_equal(low.choices[: len(usual.choices), :-1], usual.choices)
    assert low.linked[0, -2] and low.linked[-2, -1] and not low.linked[0, -1]
    force = low.rest + low.modes[-1]
    lean = np.degrees(np.arctan2(np.hypot(force[:, 0], force[:, 1]), force[:, 2]))
    assert lean == pytest.approx(np.full(num_drones, 50.0), abs=0.6)
    expected = system.anchors[0, 2] + system.cable_length[0] * np.cos(np.deg2rad(50))
    assert height(system, force) == pytest.approx(expected, abs=0.008)
    tension = np.linalg.norm(force, axis=1) / np.linalg.norm(low.rest, axis=1)
    assert tension == pytest.approx(np.full(num_drones, np.cos(np.pi / 6) / np.cos(np.deg2rad(50))), rel=0.02)


def test_a_payload_whose_centre_is_off_the_middle_takes_unequal_tensions_in_a_low_shape():
    """Lower than any formation whose level forces are scaled alike."""
    system = load_config("track_auto6").system
    low = make_shapes(system, low=True)
    force = low.rest + low.modes[-1]
    assert find_breach(force, system) is None
    assert np.ptp(np.linalg.norm(force, axis=1)) > 0.2 * np.linalg.norm(force, axis=1).mean()
    alike = [low.rest * [scale, scale, 1.0] for scale in np.linspace(1, 3, 81)]
    least = min(height(system, each) for each in alike if find_breach(each, system) is None)
    assert height(system, force) < least - 0.2 and least < height(system, low.rest) - 0.15
    # No formation is lower whose cables lean by 50 degrees.
    bound = system.anchors[0, 2] + system.cable_length[0] * np.cos(np.deg2rad(50))
    assert bound <= height(system, force) < bound + 0.02


def test_a_shape_whose_drones_meet_is_a_breach():
    system = make_system(4)
    assert find_breach(system.formation_force, system) is None
    upright = system.formation_force * [0.0, 0.0, 1.0]
    assert find_breach(upright, system) is None  # cables hang straight, 0.44 m apart
    inwards = system.formation_force * [1.0, -0.3, 1.0]
    assert find_breach(inwards, system) == "the distance of drones"


def test_one_drone_has_the_resting_shape_alone_and_shapes_are_found_once():
    system = make_system(1)
    shapes = make_shapes(system)
    assert shapes.modes.shape == (0, 1, 3) and shapes.choices.shape == (1, 0) and make_shapes(system) is shapes
