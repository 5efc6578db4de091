"""Distances of a team from obstacles, against points spread over all bodies."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_system

from multilift_marl.navigation.formation_shapes import make_shapes
from multilift_marl.navigation.team_clearance import make_body, make_scene, measure_clearance, write_arms
from multilift_marl.sim.obstacles import BOX, CYLINDER, SPHERE, Obstacles, place_obstacle


def point_distance(kind, size, place, yaw, points):
    """Return the distance (P,) of points outside an obstacle, by its own formula; 0 within."""
    c, s = np.cos(yaw), np.sin(yaw)
    local = (points - place) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    if kind == SPHERE:
        return np.maximum(np.linalg.norm(local, axis=-1) - size[0], 0)
    if kind == CYLINDER:
        over = np.maximum(np.hypot(local[..., 0], local[..., 1]) - size[0], 0)
        return np.hypot(over, np.maximum(np.abs(local[..., 2]) - size[2], 0))
    return np.linalg.norm(local - np.clip(local, -np.array(size), size), axis=-1)


def team_points(system, place, arms, spacing=0.01):
    """Return points of the payload's surface and of the cables (P, 3), and the drones' places (N, 3)."""
    half = system.payload_size / 2
    spread = [np.linspace(-h, h, max(2, int(2 * h / spacing))) for h in half]
    faces = []
    for axis in range(3):
        grid = [spread[i] if i != axis else half[i] * np.array([-1.0, 1.0]) for i in range(3)]
        faces.append(np.stack(np.meshgrid(*grid, indexing="ij"), axis=-1).reshape(-1, 3))
    payload = np.vstack(faces) + system.payload_center
    share = np.arange(0, 1 + spacing / 2, spacing)[:, None, None]
    cables = (system.anchors + share * arms).reshape(-1, 3)
    c, s = np.cos(place[3]), np.sin(place[3])
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    return place[:3] + np.vstack([payload, cables]) @ turn.T, place[:3] + (system.anchors + arms) @ turn.T


def exact_clearance(system, place, arms, rows):
    bodies, drones = team_points(system, place, arms)
    radius = np.array([np.linalg.norm(vehicle.half_size) for vehicle in system.vehicles])
    radius = radius + np.linalg.norm(system.hooks, axis=1)
    return min(min(point_distance(*row, bodies).min(), (point_distance(*row, drones) - radius).min()) for row in rows)


@pytest.mark.parametrize("kind", [BOX, CYLINDER, SPHERE], ids=["box", "cylinder", "sphere"])
def test_clearance_is_the_least_distance_of_all_points_of_the_team(kind):
    rng = np.random.default_rng(3)
    system = make_system(4)
    shapes = make_shapes(system)
    body = make_body(system, shapes.rest, shapes.modes)
    obstacles = Obstacles.zeros(1, 1)
    seen = 0
    for _ in range(60):
        across, tall = rng.uniform(0.1, 0.6), rng.uniform(0.1, 1.5)
        size = {BOX: (across, rng.uniform(0.05, 1.0), tall), CYLINDER: (across, across, tall)}.get(kind, (across,) * 3)
        row = kind, size, tuple(rng.uniform(-1.5, 1.5, 3)), rng.uniform(0, 3)
        place_obstacle(0, 0, obstacles, *row)
        place = np.append(rng.uniform(-0.3, 0.3, 3), rng.uniform(-3, 3))
        arms = np.zeros((4, 3))
        write_arms(rng.uniform(0, 1, 2), body, arms)
        found = np.zeros(1)
        measure_clearance(place[None], arms[None], body, make_scene(obstacles, 0), 0.5, found)
        exact = exact_clearance(system, place, arms, [row])
        if exact <= 0.01:
            assert found[0] < 0.02
        else:
            assert exact - 0.012 <= found[0] <= min(exact, 0.5) + 1e-9 or (exact > 0.5 and found[0] == 0.5)
            seen += exact < 0.5
    assert seen > 15


def test_free_rows_and_other_environments_do_not_count():
    obstacles = Obstacles.zeros(2, 3)
    place_obstacle(1, 2, obstacles, SPHERE, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    assert len(make_scene(obstacles, 0).kind) == 0 and len(make_scene(obstacles, 1).kind) == 1
