"""Payloads of a mesh: their volume, centre and inertia, and files that hold no body."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from conftest import make, make_system, refuse_system

import multilift_marl as ml
from multilift_marl.math3d import axis_angle
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.rig.mesh import read_mesh
from multilift_marl.schema.files import pin_file
from multilift_marl.sim.scene import build_model

WEDGE = "v 0 0 0\nv 0.6 0 0\nv 0 0.8 0\nv 0 0 0.3\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
FLAT = "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


@pytest.fixture
def wedge(write):
    """Return overrides for a tetrahedron with three edges along the axes from its corner."""
    anchors = [[0.0, -0.05, 0.1], [-0.28, -0.05, 0.1], [-0.28, -0.35, 0.1], [0.0, -0.35, 0.1]]
    return {"payload.shape": "mesh", "payload.mesh": str(write(WEDGE, "wedge.obj")), "payload.anchors": anchors}


def test_uniform_mesh_has_the_centre_and_inertia_of_its_volume(wedge):
    system = make_system(4, **wedge, **{"payload.mass": 2.0})
    edges = np.array([0.6, 0.8, 0.3])
    np.testing.assert_allclose(system.payload_size, edges)
    np.testing.assert_allclose(system.payload_center, edges / 4, atol=1e-7)  # its mass lies a quarter up each edge
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, system.payload_axes)
    axes = rotation.reshape(3, 3)
    second = 2.0 * (4 * np.diag(edges**2) - np.outer(edges, edges)) / 80
    inertia = np.trace(second) * np.eye(3) - second
    np.testing.assert_allclose(axes @ np.diag(system.payload_inertia) @ axes.T, inertia, atol=1e-6)


def test_mesh_is_scaled_to_its_size_and_keeps_what_is_given(wedge):
    given = {"payload.size": (0.6, 0.8, 0.2), "payload.inertia": (0.01, 0.011, 0.012)}
    given["payload.center_of_mass"] = (-0.1, -0.2, 0.0)
    system = make_system(4, **wedge, **given)
    np.testing.assert_allclose(system.payload_size, [0.6, 0.8, 0.2])
    np.testing.assert_allclose(system.payload_inertia, [0.01, 0.011, 0.012])
    assert system.payload_axes.tolist() == [1, 0, 0, 0]
    np.testing.assert_allclose(system.payload_center, [0.1, 0.2, 0.0])


def test_mesh_stands_where_its_file_says_and_flies(wedge):
    vec = make(num_envs=2, **wedge)
    system = vec.world.system
    model, _ = build_model(system, visuals=True)
    data = mujoco.MjData(model)
    mujoco.mj_kinematics(model, data)
    geom, mesh = model.geom("payload").id, model.geom("payload").dataid[0]
    count = model.mesh_vertnum[mesh]
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] :][:count]
    points = vertices @ data.geom_xmat[geom].reshape(3, 3).T + data.geom_xpos[geom] - data.body("payload").xpos
    np.testing.assert_allclose(points.min(axis=0), system.payload_center - system.payload_size / 2, atol=1e-6)
    np.testing.assert_allclose(points.max(axis=0), system.payload_center + system.payload_size / 2, atol=1e-6)
    policy = make_scripted("formation", vec)
    observation, _ = vec.reset(seed=0)
    for _ in range(200):
        observation, _, terminated, _, _ = vec.step(policy.act(observation).astype(float))
        assert not terminated.any()


def obj(points, faces):
    lines = [f"v {x:.17g} {y:.17g} {z:.17g}" for x, y, z in points] + [
        f"f {a + 1} {b + 1} {c + 1}" for a, b, c in faces
    ]
    return "\n".join(lines) + "\n"


def stl(points, faces):
    """Return a binary .stl file, in which every triangle has vertices of its own."""
    facets = np.zeros(len(faces), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
    facets["corners"] = points[faces]
    return bytes(80) + np.uint32(len(faces)).tobytes() + facets.tobytes()


def cells(lines, filled):
    """Return the surface of the boxes between coordinate lines of x and y, extruded from 0 to the last of `lines`."""
    xs, ys, height = lines
    corner = {}

    def number(*at):
        return corner.setdefault(at, len(corner))

    faces = []

    def square(*around):
        a, b, c, d = (number(*at) for at in around)
        faces.extend([(a, b, c), (a, c, d)])

    for i, j in filled:
        square((i, j, 0), (i, j + 1, 0), (i + 1, j + 1, 0), (i + 1, j, 0))
        square((i, j, 1), (i + 1, j, 1), (i + 1, j + 1, 1), (i, j + 1, 1))
        if (i - 1, j) not in filled:
            square((i, j, 0), (i, j, 1), (i, j + 1, 1), (i, j + 1, 0))
        if (i + 1, j) not in filled:
            square((i + 1, j, 0), (i + 1, j + 1, 0), (i + 1, j + 1, 1), (i + 1, j, 1))
        if (i, j - 1) not in filled:
            square((i, j, 0), (i + 1, j, 0), (i + 1, j, 1), (i, j, 1))
        if (i, j + 1) not in filled:
            square((i, j + 1, 0), (i, j + 1, 1), (i + 1, j + 1, 1), (i + 1, j + 1, 0))
    return np.array([(xs[i], ys[j], k * height) for i, j, k in corner]), np.array(faces)


def union(lines, filled):
    """Return centre of mass (3,) and inertia about it (3, 3) of 1 kg of those boxes, in closed form."""
    xs, ys, height = lines
    edges = np.array([(xs[i + 1] - xs[i], ys[j + 1] - ys[j], height) for i, j in filled])
    middles = np.array([((xs[i + 1] + xs[i]) / 2, (ys[j + 1] + ys[j]) / 2, height / 2) for i, j in filled])
    share = edges.prod(axis=1) / edges.prod(axis=1).sum()
    center = share @ middles
    second = sum(
        m * (np.diag(edge**2) / 12 + np.outer(place - center, place - center))
        for m, edge, place in zip(share, edges, middles, strict=True)
    )
    return center, np.trace(second) * np.eye(3) - second


def ring(sides, outer, inner, height):
    """Return the surface of a ring between two regular polygons, its centre of mass and its inertia per kg."""
    angle = 2 * np.pi * np.arange(sides) / sides
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    points = np.concatenate(
        [np.c_[radius * circle, np.full(sides, z)] for z in (0, height) for radius in (inner, outer)]
    )
    faces = []
    for k in range(sides):
        a, b = k, (k + 1) % sides
        for p, q, _, s in ((0, 1, 1, 0), (1, 3, 3, 1), (3, 2, 2, 3), (2, 0, 0, 2)):  # below, outside, above, inside
            faces += [(p * sides + a, q * sides + b, q * sides + a), (p * sides + a, s * sides + b, q * sides + b)]
    area, polar = 0.0, 0.0
    for radius, sign in ((outer, 1), (inner, -1)):
        part = sign * sides / 2 * radius**2 * np.sin(2 * np.pi / sides)
        area, polar = area + part, polar + part * radius**2 * (2 + np.cos(2 * np.pi / sides)) / 6
    across, along = polar / area / 2 + height**2 / 12, polar / area
    return (points, np.array(faces)), (np.array([0, 0, height / 2]), np.diag([across, across, along]))


ELL = ((0.0, 0.2, 0.6), (0.0, 0.2, 0.5), 0.15), {(0, 0), (1, 0), (0, 1)}
CHANNEL = ((0.0, 0.1, 0.5, 0.6), (0.0, 0.1, 0.7), 0.2), {(0, 0), (1, 0), (2, 0), (0, 1), (2, 1)}
CONCAVE = {
    "ell": (cells(*ELL), union(*ELL)),
    "channel": (cells(*CHANNEL), union(*CHANNEL)),
    "ring": ring(24, 0.5, 0.4, 0.1),
}


@pytest.mark.parametrize("form", [obj, stl], ids=["obj", "stl"])
@pytest.mark.parametrize("name", CONCAVE)
def test_concave_meshes_have_the_centre_and_inertia_of_their_matter(name, form, tmp_path):
    (points, faces), (center, inertia) = CONCAVE[name]
    turn = np.reshape(axis_angle((0.6, 0.0, 0.8), 0.5), (3, 3))  # so that no principal axis is one of the file's
    path, content = tmp_path / f"body.{form.__name__}", form(points @ turn.T, faces)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    mesh = read_mesh(str(path))
    np.testing.assert_allclose(mesh.center_of_mass, turn @ center, atol=1e-6)
    rotation = np.zeros(9)
    mujoco.mju_quat2Mat(rotation, mesh.axes)
    axes = rotation.reshape(3, 3)
    np.testing.assert_allclose(axes @ np.diag(mesh.inertia) @ axes.T, turn @ inertia @ turn.T, atol=1e-7)


@pytest.mark.parametrize(
    "text, name, complaint",
    [
        (None, "none.obj", r"payload\.mesh=/.*none\.obj is missing; put the file back, or give the path of another"),
        (WEDGE, "wedge.txt", r"payload\.mesh=.* is no \.obj or \.stl file"),
        (FLAT, "flat.obj", r"payload\.mesh=.* is no closed surface: it is flat"),
        (
            obj(CONCAVE["ell"][0][0], CONCAVE["ell"][0][1][:-1]),
            "open.obj",
            r"payload\.mesh=.* has holes, so close them",
        ),
        (obj(CONCAVE["ell"][0][0], CONCAVE["ell"][0][1][:, ::-1]), "in.obj", r"payload\.mesh=.* faces look inwards"),
        (
            obj(CONCAVE["ell"][0][0], [*CONCAVE["ell"][0][1][:-1], CONCAVE["ell"][0][1][-1][::-1]]),
            "mixed.obj",
            r"payload\.mesh=.* neighbouring faces look to different sides",
        ),
    ],
)
def test_a_file_that_holds_no_body_is_refused(text, name, complaint, write, tmp_path):
    path = tmp_path / name if text is None else write(text, name)
    message = refuse_system(payload__shape="mesh", payload__mesh=str(path))
    assert re.match(complaint, message), message
    stone = {"shape": "mesh", "mesh": str(path), "position": [5, 0, 1]}
    message = refuse_system(scene__obstacles=[{"size": [1, 1, 1]}, stone])
    assert re.match(complaint.replace(r"payload\.mesh", r"scene\.obstacles\[1\]\.mesh"), message), message


def test_a_file_that_cannot_be_read_is_blamed_on_its_own_key(write):
    text = str(write("v 0 0 0\nv 1\n", "torn.obj"))
    stone = {"shape": "mesh", "mesh": text, "position": [5, 0, 1]}
    assert refuse_system(scene__obstacles=[stone]).startswith(f"cannot read scene.obstacles[0].mesh={text}: ")


def test_the_mesh_of_an_obstacle_may_lie_beside_its_configuration(write):
    path = write(WEDGE, "wedge.obj")
    mine = write("base: hover\nscene: {obstacles: [{shape: mesh, mesh: wedge.obj, position: [5, 0, 1]}]}\n")
    config = ml.load_config(str(mine))
    assert config.scene.obstacles[0].mesh == pin_file(str(path)) and len(config.system.scenery.obstacles) == 1


def test_mesh_and_its_shape_belong_together():
    assert re.match(r"payload\.shape=mesh needs payload\.mesh; give the path", refuse_system(payload__shape="mesh"))
    assert re.match(r"payload\.mesh means nothing to a box; drop it or use", refuse_system(payload__mesh="a.obj"))
