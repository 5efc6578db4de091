"""What pictures show beside the bodies: tension as colour, trails, paths, scenery; and where they are taken from."""

from itertools import pairwise

import mujoco
import numpy as np
import pytest
from conftest import COMMON, TASKS, make, slow, zeros

from multilift_marl.planning.paths import own_time
from multilift_marl.rendering import Stage
from multilift_marl.rendering.overlays import TENSION_COLOURS, dashes, tension_colours
from multilift_marl.sim.scene import DRONE_COLOURS
from multilift_marl.tasks.base import Box

SLACK, RESTING, DOUBLE = TENSION_COLOURS[[0, 4, 8]]
TENDON, GEOM = int(mujoco.mjtObj.mjOBJ_TENDON), int(mujoco.mjtObj.mjOBJ_GEOM)
# Dichromats' view of linear sRGB: Viénot, Brettel and Mollon 1999 (protan, deutan); Brettel's tritan, one half-plane
BLIND = {
    "protan": [[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]],
    "deutan": [[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]],
    "tritan": [[1.01277, 0.13548, -0.14826], [-0.01243, 0.86812, 0.14431], [0.07589, 0.80500, 0.11911]],
}


def shown(vec, env=0, **keywords):
    stage = Stage(vec, **keywords)
    stage.update(env)
    return stage


def geoms(stage):
    return list(stage.scene.geoms[: stage.scene.ngeom])


def cable_colours(stage):
    """Return the colours (N, 3) in which cables are drawn, of chains those of their first links, of ten."""
    tendons = {geom.objid: np.array(geom.rgba[:3]) for geom in geoms(stage) if geom.objtype == TENDON}
    links = [np.array(geom.rgba[:3]) for geom in extra(stage) if geom.emission > 0]
    return np.array([tendons[n] for n in sorted(tendons)] or links[::10])


def extra(stage):
    """Return the geoms that are no part of the model."""
    return [geom for geom in geoms(stage) if geom.objtype == mujoco.mjtObj.mjOBJ_UNKNOWN]


def to_oklab(linear):
    """Return OKLab coordinates (..., 3) of linear sRGB colours (B. Ottosson, 2020)."""
    lms = [[0.4122214708, 0.5363325363, 0.0514459929], [0.2119034982, 0.6806995451, 0.1073969566]]
    lms.append([0.0883024619, 0.2817188376, 0.6299787005])
    lab = [[0.2104542553, 0.7936177850, -0.0040720468], [1.9779984951, -2.4285922050, 0.4505937099]]
    lab.append([0.0259040371, 0.7827717662, -0.8086757660])
    return np.cbrt(linear @ np.array(lms).T) @ np.array(lab).T


def to_linear(colours):
    return np.where(colours <= 0.04045, colours / 12.92, ((colours + 0.055) / 1.055) ** 2.4)


def test_the_scale_goes_from_grey_over_blue_to_red_in_equal_steps():
    ratios = np.linspace(0, 2, 17)
    colours = tension_colours(10.0 * ratios, np.full(17, 10.0))
    for at, end in ((0, SLACK), (8, RESTING), (16, DOUBLE)):
        assert np.allclose(colours[at], end, atol=1e-6)
    assert (tension_colours(np.array([30.0, np.inf]), np.full(2, 10.0)) == colours[16]).all()
    lab = to_oklab(to_linear(colours[::2]))
    for half in (lab[:5], lab[4:]):
        steps = [np.linalg.norm(b - a) for a, b in pairwise(half)]
        assert max(steps) < 1.05 * min(steps)


@pytest.mark.parametrize("kind", BLIND)
def test_slack_resting_and_double_differ_for_the_colour_blind(kind):
    seen = np.clip(to_linear(np.array([SLACK, RESTING, DOUBLE])) @ np.array(BLIND[kind]).T, 0, 1)
    lab = to_oklab(seen)
    apart = [np.linalg.norm(lab[i] - lab[j]) for i, j in ((0, 1), (1, 2), (0, 2))]
    assert min(apart) > 0.15  # 0.02 is just noticeable


@pytest.mark.parametrize("cable", ["massless", pytest.param("chain", marks=pytest.mark.slow)])
def test_cables_are_coloured_by_tension(cable):
    vec = make(num_envs=1, num_drones=3, **{"cable.model": cable})
    vec.reset(seed=0)
    resting = vec.world.system.resting_tension
    vec.world.state.cable_tension[0] = resting * [0, 1, 2]
    assert np.allclose(cable_colours(shown(vec)), [SLACK, RESTING, DOUBLE], atol=1e-3)
    vec.world.state.cable_tension[0] = resting * [2, 0, 1]
    assert np.allclose(cable_colours(shown(vec)), [DOUBLE, SLACK, RESTING], atol=1e-3)


def test_a_broken_cable_is_not_drawn():
    vec = make(num_envs=1, num_drones=3)
    vec.reset(seed=0)
    vec.world.break_cables(np.array([[False, True, False]]))
    drawn = {geom.objid for geom in geoms(shown(vec)) if geom.objtype == TENDON and geom.rgba[3] > 0}
    assert drawn == {0, 2}


def test_trails_follow_payload_and_drones_and_fade():
    vec = make(num_envs=1, num_drones=2)
    vec.reset(seed=0)
    stage = shown(vec, trail=1.0)
    assert not [geom for geom in extra(stage) if geom.rgba[3] > 0.01 and geom.size[2] > 1e-4]
    past = [vec.world.state.drone_position[0, 1].copy()]
    for _ in range(20):
        vec.step(zeros(vec))
        past.append(vec.world.state.drone_position[0, 1].copy())
        stage.update(0)
    colour = DRONE_COLOURS[1][:3]
    trail = [geom for geom in extra(stage) if np.allclose(geom.rgba[:3], colour, atol=1e-3)]
    middles = np.array([geom.pos for geom in trail])
    assert len(trail) >= 10
    gaps = np.linalg.norm(middles[:, None] - np.array(past)[None], axis=2).min(axis=1)
    assert gaps.max() < 0.05  # each piece lies where the drone was
    strength = [geom.rgba[3] for geom in trail]
    assert strength == sorted(strength) and strength[0] < 0.75 * strength[-1]


def test_a_trail_ends_after_its_time_and_with_its_episode():
    vec = make(num_envs=1, num_drones=2)
    vec.reset(seed=0)
    stage, lengths = shown(vec, trail=0.2), []
    for _ in range(40):
        vec.step(zeros(vec))
        stage.update(0)
        lengths.append(len(extra(stage)))
    assert max(lengths[20:]) <= max(lengths[:15])
    vec.reset()
    stage.update(0)
    assert len(extra(stage)) <= 3 < lengths[-1]
    assert not extra(shown(vec))  # none unless asked for


def test_the_path_of_a_track_is_dashed_through_its_targets():
    vec = make("track", num_envs=1, **{"env.episode_seconds": 6.0, "task_options.path": "circle"})
    vec.reset(seed=3)
    lines = np.array([geom.pos for geom in extra(shown(vec))])
    assert len(lines) > 20
    for step in range(150):
        if step % 30 == 0:
            assert np.linalg.norm(lines - vec.task.goal.position[0], axis=1).min() < 0.25
        vec.step(zeros(vec))
    target_path = vec.task.target_path(0)
    assert np.linalg.norm(lines[:, None] - target_path[None], axis=2).min(axis=1).max() < 0.1


@pytest.mark.parametrize("task", [task if task in COMMON else slow(task) for task in TASKS])
def test_a_target_path_is_of_points_in_space(task):
    vec = make(task, num_envs=1)
    vec.reset(seed=0)
    path = vec.task.target_path(0)
    assert (path.ndim, path.shape[1:]) == (2, (3,))


@pytest.mark.parametrize("path, closes", [("circle", True), ("figure8", True), ("lemniscate", True), ("random", False)])
def test_a_path_that_repeats_is_drawn_once(path, closes):
    options = {"task_options.path": path, "task_options.acceleration": 2.0, "task_options.rate": 0.8}
    vec = make("track", num_envs=1, **options)
    vec.reset(seed=0)
    target_path = vec.task.target_path(0)
    if closes:  # more than a round is flown
        assert vec.task.own.path.rate[0] * own_time(vec.config.env.episode_seconds) > 2.2 * np.pi
    assert (np.linalg.norm(target_path[-1] - target_path[0]) < 1e-6 * np.ptp(target_path, axis=0).max()) == closes
    if path == "circle":
        assert np.linalg.norm(np.diff(target_path, axis=0), axis=1).sum() == pytest.approx(10 * np.pi, rel=1e-3)


def test_dashes_are_as_long_as_their_gaps():
    corner = np.array([[0, 0, 0], [1.0, 0, 0], [1.0, 1.0, 0]])
    starts, ends = dashes(corner, 0.1)
    assert len(starts) == len(ends) == 10
    assert np.allclose(np.linalg.norm(ends - starts, axis=1), 0.1, atol=1e-9)
    assert np.allclose(starts[0], corner[0]) and len(dashes(corner[:1], 0.1)[0]) == 0


def test_scenery_stands_where_the_task_says(monkeypatch):
    vec = make(num_envs=1)
    vec.reset(seed=0)
    before = len(extra(shown(vec)))
    box = Box((0.1, 1.0, 2.0), (1.0, 2.0, 3.0), (0.5, 0.4, 0.3, 1.0))
    monkeypatch.setattr(vec.task, "scenery", lambda env: [box])
    found = extra(shown(vec))
    assert len(found) == before + 1
    for value, expected in ((found[-1].size, box.size), (found[-1].pos, box.position), (found[-1].rgba, box.rgba)):
        assert np.allclose(value, expected, atol=1e-6)


@pytest.mark.slow
def test_the_walls_of_gates_are_scenery():
    vec = make("gate", num_envs=2, **{"task_options.gates": 2})
    vec.reset(seed=0)
    for env in (0, 1):
        boxes = vec.task.scenery(env)
        drawn = [geom for geom in extra(shown(vec, env)) if geom.type == mujoco.mjtGeom.mjGEOM_BOX]
        assert len(boxes) == len(drawn) == 6
        openings = {box.position[0] for box in boxes}
        assert openings == set(vec.task.settings.x)


def test_chase_looks_along_the_flight_and_stays_when_the_team_does():
    vec = make("track", num_envs=1, **{"task_options.path": "circle", "task_options.rate": 0.4})
    vec.reset(seed=1)
    stage = Stage(vec, "chase")
    for _ in range(400):
        vec.step(zeros(vec))
        stage.update(0)
    forward, flight = stage.scene.camera[0].forward[:2], vec.world.state.payload_velocity[0, :2]
    cosine = forward @ flight / np.linalg.norm(forward) / np.linalg.norm(flight)
    assert np.linalg.norm(flight) > 1.0 and cosine > np.cos(np.deg2rad(30))
    azimuth = stage.camera.view.azimuth
    stage.update(0)
    assert stage.camera.view.azimuth == azimuth


def test_the_camera_above_a_track_sees_all_of_its_path():
    vec = make("track", num_envs=1, **{"task_options.path": "circle"})
    vec.reset(seed=1)
    stage = shown(vec, camera="top")
    camera, target_path = stage.scene.camera[0], vec.task.target_path(0)
    away = target_path - camera.pos
    depth = away @ camera.forward
    up = (away @ camera.up) / depth / (camera.frustum_top / camera.frustum_near)
    right = (away @ np.cross(camera.forward, camera.up)) / depth / (camera.frustum_top / camera.frustum_near) / (16 / 9)
    assert max(np.abs(up).max(), np.abs(right).max()) < 1.0
    assert max(np.abs(up).max(), np.abs(right).max()) > 0.6  # and not from afar
    assert depth.min() > 0


def test_obstacles_are_drawn_as_they_are(tmp_path):
    wedge = tmp_path / "wedge.obj"
    wedge.write_text("v 0 0 0\nv 0.5 0.1 0\nv 0.1 0.4 0\nv 0.2 0.1 0.3\nf 1 3 2\nf 1 2 4\nf 2 3 4\nf 3 1 4\n")
    around = [
        {"shape": "box", "size": [0.6, 0.4, 2.0], "position": [3, 0, 1]},
        {"shape": "cylinder", "size": [0.6, 1.5], "position": [-3, 0, 1]},
        {"shape": "sphere", "size": [0.5], "position": [0, 3, 1], "travel": [0.5, 0, 0], "period": 1.0},
        {"shape": "mesh", "mesh": str(wedge), "position": [0, -3, 1], "rotation": [0, 70, 30]},
    ]
    vec = make("hover", num_envs=1, **{"scene.obstacles": around})
    vec.reset(seed=0)
    for _ in range(10):
        vec.step(zeros(vec))
    stage = shown(vec)
    box, cylinder, sphere, mesh = extra(stage)[:4]
    form = mujoco.mjtGeom
    kinds = [form.mjGEOM_BOX, form.mjGEOM_CYLINDER, form.mjGEOM_SPHERE, form.mjGEOM_MESH]
    assert [geom.type for geom in (box, cylinder, sphere, mesh)] == kinds
    # The scene's sizes are half extents along all axes.
    for geom, half in ((box, (0.3, 0.2, 1.0)), (cylinder, (0.3, 0.3, 0.75)), (sphere, (0.25, 0.25, 0.25))):
        np.testing.assert_allclose(geom.size, half, atol=1e-6)
    assert sphere.pos[0] == pytest.approx(0.5 * np.sin(2 * np.pi * 0.2), abs=1e-6)
    # Corners of the mesh as drawn are those of the hull in its place.
    vertices = stage.model.mesh_vert[: stage.model.mesh_vertnum[0]]
    corners = vertices @ np.array(mesh.mat).reshape(3, 3).T + mesh.pos
    hull, frame = vec.world.obstacles.vertices[0], vec.world.obstacles.rotation[0, 3]
    expected = hull @ frame.T + vec.world.obstacles.position[0, 3]
    order = np.lexsort(np.round(corners, 4).T), np.lexsort(np.round(expected, 4).T)
    np.testing.assert_allclose(corners[order[0]], expected[order[1]], atol=1e-5)
