"""Plots of paths: the payload's own outline, cables from their anchors."""

import mujoco
import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.evaluation import plots
from multilift_marl.evaluation.outline import payload_surface
from multilift_marl.evaluation.rollout import Trace, trace_episode
from multilift_marl.policies.baselines import make_scripted

L_SHAPE = """
v 0 0 0\nv 2 0 0\nv 2 1 0\nv 1 1 0\nv 1 3 0\nv 0 3 0
v 0 0 1\nv 2 0 1\nv 2 1 1\nv 1 1 1\nv 1 3 1\nv 0 3 1
f 1 4 3 2\nf 1 6 5 4\nf 7 8 9 10\nf 7 10 11 12
f 1 2 8 7\nf 2 3 9 8\nf 3 4 10 9\nf 4 5 11 10\nf 5 6 12 11\nf 6 1 7 12
"""


@pytest.fixture
def l_shape(tmp_path):
    (tmp_path / "l.obj").write_text(L_SHAPE)
    return {
        "payload.shape": "mesh", "payload.mesh": str(tmp_path / "l.obj"), "payload.size": [0.4, 0.6, 0.2],
        "env.num_drones": 3, "payload.anchors": [[0.15, -0.2, 0.1], [-0.1, 0.2, 0.1], [-0.15, -0.25, 0.1]],
    }  # fmt: skip


def enclosed(triangles):
    """Return volume and centroid that triangles enclose, by the divergence theorem."""
    parts = np.linalg.det(triangles) / 6
    return parts.sum(), (parts[:, None] * triangles.sum(axis=1) / 4).sum(axis=0) / parts.sum()


@pytest.mark.parametrize("shape", ["box", "cylinder"])
def test_surfaces_of_plain_bodies_enclose_their_volume(shape):
    system = ml.load_config("hover", {"payload.shape": shape}).system
    x, y, z = system.payload_size
    volume, centre = enclosed(payload_surface(system))
    sides = 48 / 2 * np.sin(2 * np.pi / 48) * (x / 2) ** 2  # of a regular polygon
    assert volume == pytest.approx({"box": x * y, "cylinder": sides}[shape] * z)
    np.testing.assert_allclose(centre, system.payload_center, atol=1e-12)


def test_the_surface_of_a_mesh_is_its_own_and_a_point_has_none(l_shape):
    system = ml.load_config("hover", l_shape).system
    volume, centre = enclosed(payload_surface(system))
    assert volume == pytest.approx(4 / 6 * 0.4 * 0.6 * 0.2)  # an L of 4 of 6 squares
    np.testing.assert_allclose(centre, 0, atol=1e-9)  # its centre of mass
    assert payload_surface(ml.load_config("hover", {"payload.shape": "point"}).system).shape == (0, 3, 3)
    assert Trace._field_defaults["surface"].shape == (0, 3, 3)


def test_paths_show_the_outline_and_the_anchors(tmp_path, monkeypatch):
    config, ends = ml.load_config("hover", {"env.episode_seconds": 0.4}), []

    def note(vec):
        state, system = vec.world.state, vec.world.system
        quaternion, anchor = np.zeros(4), np.zeros(3)
        mujoco.mju_mat2Quat(quaternion, state.payload_rotation[0].ravel())
        mujoco.mju_rotVecQuat(anchor, system.anchors[2], quaternion)
        payload = state.payload_position[0].copy()
        ends.append((payload + anchor, state.drone_position[0, 2].copy(), payload))

    trace = trace_episode(config, lambda vec: make_scripted("formation", vec), 0, 5, note)
    anchor, drone, payload = ends[-1]
    np.testing.assert_allclose(trace.cables[2][[0, -1]], [anchor, drone], atol=1e-9)
    assert not np.allclose(anchor, payload, atol=0.05)
    volume, centre = enclosed(trace.surface - payload)
    assert volume == pytest.approx(np.prod(config.system.payload_size))
    np.testing.assert_allclose(centre, config.system.payload_center, atol=0.01)
    drawn = []
    monkeypatch.setattr(plots, "_save", lambda figure, path, pdf: drawn.append(figure))
    plots.plot_paths(tmp_path / "paths.png", trace)
    for axes, up in zip(drawn[0].axes, (1, 2), strict=True):
        [outline] = axes.collections
        found = np.array([path.vertices[:3] for path in outline.get_paths()])
        np.testing.assert_array_equal(found, trace.surface[..., [0, up]])
        lines = [line.get_xydata() for line in axes.lines]
        assert any(line.shape == (2, 2) and (line == trace.cables[2][:, [0, up]]).all() for line in lines)
        assert any(line.shape == (1, 2) and (line[0] == trace.cables[2][0, [0, up]]).all() for line in lines)


def area(polygon):
    """Return what a counter-clockwise polygon (K, 2) encloses."""
    x, y = polygon.T
    return (x * np.roll(y, -1) - y * np.roll(x, -1)).sum() / 2


def test_paths_show_obstacles_as_they_stand(tmp_path, monkeypatch, l_shape):
    """Areas from above and from the side, and their middles, of a body of each kind."""
    around = [
        {"shape": "box", "size": [1.0, 0.4, 2.0], "position": [3.0, 1.0, 1.0], "rotation": [0.0, 0.0, 30.0]},
        {"shape": "cylinder", "size": [0.6, 3.0], "position": [-3.0, 1.0, 1.5]},
        {"shape": "sphere", "size": [0.8], "position": [0.0, 4.0, 2.0]},
        {"shape": "mesh", "mesh": l_shape["payload.mesh"], "size": [0.4, 0.6, 0.2], "position": [0.0, -4.0, 1.0]},
    ]
    config = ml.load_config("hover", {"env.episode_seconds": 0.1, "scene.obstacles": around})
    trace = trace_episode(config, lambda vec: make_scripted("formation", vec), 0, 5)
    turned = np.deg2rad(30.0)
    ring = 48 / 2 * np.sin(2 * np.pi / 48)  # of a regular polygon about a unit circle
    expected = [
        (1.0 * 0.4, (np.cos(turned) + 0.4 * np.sin(turned)) * 2.0),
        (ring * 0.3**2, 0.6 * 3.0),
        (ring * 0.4**2, ring * 0.4**2),
        ((0.4 * 0.6 - 0.2 * 0.4 / 2), 0.4 * 0.2),  # of the hull of an L
    ]
    drawn = []
    monkeypatch.setattr(plots, "_save", lambda figure, path, pdf: drawn.append(figure))
    plots.plot_paths(tmp_path / "paths.png", trace)
    for k, axes in enumerate(drawn[0].axes):
        shades = [each.get_paths()[0].vertices[:-1] for each in axes.collections[: len(around)]]
        np.testing.assert_allclose([area(shade) for shade in shades], [areas[k] for areas in expected], rtol=1e-6)
        for shade, body in zip(shades, around, strict=True):
            middle = (shade.min(axis=0) + shade.max(axis=0)) / 2
            np.testing.assert_allclose(middle, np.array(body["position"])[[0, k + 1]], atol=1e-6)
        assert np.ptp(axes.get_xlim()) < 5  # as wide as the paths
