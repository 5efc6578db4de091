"""Files of meshes: which are read, by which name, and what is refused before work is done."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import JARGON, refuse_system
from test_mesh import CONCAVE, cells, obj, stl

import multilift_marl as ml
from multilift_marl.config.load import build_config
from multilift_marl.errors import ConfigError
from multilift_marl.rig.mesh import read_mesh
from multilift_marl.rig.mesh_file import MAX_FACES
from multilift_marl.rig.surface import weld
from multilift_marl.sim.scene import build_model


def box(height):
    """Return the text of an .obj file of a box."""
    return obj(*cells(((0.0, 0.6), (0.0, 0.8), height), {(0, 0)}))


def text_stl(points, faces, digits=9, newline="\n"):
    """Return an .stl file in text, as exporters write it."""
    lines = ["solid part one"]
    for corners in points[faces]:
        lines += ["facet normal 0 0 0", "  outer loop"]
        lines += ["    vertex " + " ".join(f"{x:.{digits - 1}e}" for x in corner) for corner in corners]
        lines += ["  endloop", "endfacet"]
    return newline.join([*lines, "endsolid part one", ""])


def heights(*configs):
    return [float(config.system.payload_size[2]) for config in configs]


def test_a_mesh_is_found_beside_the_file_that_names_it_and_kept_by_its_content(tmp_path, monkeypatch):
    (tmp_path / "part.obj").write_text(box(0.3))
    overrides = {"payload.mesh": "part.obj", "payload.shape": "mesh"}
    lines = "payload: {shape: mesh, mesh: part.obj}\ntrain:\n  overrides: {payload.mesh: part.obj}\n"
    (tmp_path / "rig.yaml").write_text(lines + "  rigs: [{payload: {mesh: part.obj}}]\n")
    monkeypatch.chdir(tmp_path)
    here = ml.load_config("hover", overrides)
    monkeypatch.chdir("/")
    config = ml.load_config(tmp_path / "rig.yaml")
    assert config.payload.mesh == here.payload.mesh
    assert config.payload.mesh.startswith(f"{tmp_path / 'part.obj'}#sha256=")
    assert config.train.overrides["payload.mesh"] == config.payload.mesh
    assert config.train.rigs[0]["payload"]["mesh"] == config.payload.mesh
    assert heights(config, build_config(config.model_dump()), here) == [0.3] * 3
    monkeypatch.setenv("HOME", str(tmp_path))
    assert ml.load_config("hover", overrides | {"payload.mesh": "~/part.obj"}).payload.mesh == config.payload.mesh
    stored = config.model_dump()
    (tmp_path / "part.obj").write_text(box(0.6))
    with pytest.raises(ConfigError, match=r"payload\.mesh=.*part\.obj has changed since this configuration was made"):
        _ = build_config(stored).system
    assert heights(ml.load_config(tmp_path / "rig.yaml")) == [0.6]


@pytest.mark.slow
def test_a_file_that_is_written_again_is_read_again(tmp_path):
    """In one process, within the resolution of file times, as the same number of bytes."""
    mesh, vehicle, path, rig = (tmp_path / name for name in ("part.obj", "own.yaml", "path.csv", "rig.yaml"))
    rows = np.column_stack([np.arange(6.0), np.zeros((6, 2)), np.full(6, 2.0)])
    lines = (
        "task: track\nvehicle: {preset: own.yaml}\npayload: {shape: mesh, mesh: part.obj}\n"
        "task_options: {path: file, file: path.csv}\n"
    )
    found = []
    for height, mass, z in ((0.3, 0.6, 2), (0.2, 0.7, 3)):
        rig.write_text(lines + f"wind: {{velocity: [{z}, 0, 0]}}\n")
        mesh.write_text(box(height))
        vehicle.write_text(f"mass: {mass}")
        rows[:, 3] = z
        np.savetxt(path, rows, fmt="%g", delimiter=",")
        vec = ml.make_vec(rig, num_envs=1, num_threads=1)
        vec.reset(seed=0)
        system = vec.world.system
        seen = build_model(system)[0].mesh_vert
        read = (system.payload_size[2], system.vehicle.mass, vec.task.goal.position[0, 2], system.wind[0])
        found.append((*read, np.ptp(seen, axis=0)))
    for (*values, edges), expected in zip(found, ([0.3, 0.6, 2.0, 2.0], [0.2, 0.7, 3.0, 3.0]), strict=True):
        np.testing.assert_allclose(values, expected)
        np.testing.assert_allclose(np.sort(edges), np.sort([0.6, 0.8, expected[0]]), atol=1e-6)


@pytest.mark.parametrize("newline", ["\n", "\r\n"])
@pytest.mark.parametrize("name", CONCAVE)
def test_an_stl_file_in_text_holds_the_same_body(name, newline, tmp_path):
    (points, faces), (center, inertia) = CONCAVE[name]
    path = tmp_path / "body.STL"
    path.write_text(text_stl(points, faces, newline=newline), newline="")
    mesh = read_mesh(str(path))
    np.testing.assert_allclose(mesh.center_of_mass, center, atol=1e-7)
    np.testing.assert_allclose(np.sort(mesh.inertia), np.linalg.eigvalsh(inertia), atol=1e-7)
    assert len(mesh.points) == len(np.unique(points[np.unique(faces)], axis=0))


def test_an_obj_file_may_hold_polygons_numbers_from_the_end_and_points_without_a_face(tmp_path):
    corners = [(x, y, z) for z in (0, 0.2) for x, y in ((0, 0), (0.4, 0), (0.4, 0.6), (0, 0.6))]
    sides = ["4 3 2 1", "5/1/1 6/2/1 7/3/1 8/4/1", "1//2 2//2 6//2 5//2", "2 3 7 6", "3 4 8 7", "-5 -8 -4 -1"]
    text = "# box\no box\nv 9 9 9\n" + "".join(f"v {x} {y} {z} 1.0\n" for x, y, z in corners)
    shift = lambda word: word if word.startswith("-") else str(int(word.split("/")[0]) + 1)  # noqa: E731
    text += "vn 0 0 1\n" + "".join("f " + " ".join(map(shift, side.split())) + "\n" for side in sides)
    (tmp_path / "box.obj").write_text(text)
    mesh = read_mesh(str(tmp_path / "box.obj"))
    np.testing.assert_allclose(mesh.edges, [0.4, 0.6, 0.2])
    np.testing.assert_allclose(mesh.center_of_mass, [0.2, 0.3, 0.1])
    assert mesh.volume == pytest.approx(0.4 * 0.6 * 0.2)
    moments = np.array([0.6**2 + 0.2**2, 0.4**2 + 0.2**2, 0.4**2 + 0.6**2]) / 12
    np.testing.assert_allclose(np.sort(mesh.inertia), np.sort(moments))


@pytest.mark.parametrize("noise", [1e-7, 1e-6, 3e-6, 2e-5])
@pytest.mark.parametrize("seed", range(3))
def test_corners_that_exporters_round_differently_are_one(noise, seed, tmp_path):
    """Every triangle has corners of its own, each off by up to `noise` of the body's size."""
    (points, faces), (center, inertia) = CONCAVE["ring"]
    rng = np.random.default_rng(seed)
    corners = points[faces].reshape(-1, 3)
    corners = corners + noise * rng.uniform(-1, 1, corners.shape)
    (tmp_path / "ring.stl").write_text(text_stl(corners, np.arange(len(corners)).reshape(-1, 3)))
    mesh = read_mesh(str(tmp_path / "ring.stl"))
    np.testing.assert_allclose(mesh.center_of_mass, center, atol=3 * noise)
    np.testing.assert_allclose(np.sort(mesh.inertia), np.linalg.eigvalsh(inertia), rtol=100 * noise)


def test_a_part_far_from_its_origin_closes_in_single_precision(tmp_path):
    """Of 0.1 m at 100 m, as a part of an assembly: numbers there are 8 µm apart."""
    (points, faces), (center, _) = CONCAVE["ell"]
    far = points / 6 + [100.0, -50.0, 20.0]
    (tmp_path / "far.stl").write_bytes(stl(far, faces))
    np.testing.assert_allclose(read_mesh(str(tmp_path / "far.stl")).center_of_mass, center / 6 + far[0] - points[0] / 6,
                               atol=2e-5)  # fmt: skip


def test_points_are_welded_across_the_lines_of_any_grid():
    rng = np.random.default_rng(0)
    points = rng.uniform(0, 1, (400, 3))
    near = points + 0.57e-3 * rng.uniform(-1, 1, points.shape)  # within 1e-3
    label = weld(np.concatenate([points, near]), 1e-3)
    assert (label[:400] == label[400:]).all()
    apart = np.linalg.norm(points[:, None] - points[None], axis=2) + np.eye(400)
    assert apart.min() > 3.5e-3 and len(np.unique(label)) == 400


def test_a_hole_is_not_welded(tmp_path):
    (points, faces), _ = CONCAVE["ring"]
    (tmp_path / "open.stl").write_text(text_stl(points, faces[:-1]))
    assert "has holes, so close them" in refuse_system(payload__shape="mesh", payload__mesh=str(tmp_path / "open.stl"))


def grid(count):
    """Return a sheet of 2 count² triangles: open, so that only a check beforehand can be fast."""
    x, y = np.meshgrid(np.arange(count + 1), np.arange(count + 1))
    at = np.arange(count) + (count + 1) * np.arange(count)[:, None]
    faces = np.concatenate(
        [np.stack([at, at + 1, at + count + 2], -1), np.stack([at, at + count + 2, at + count + 1], -1)]
    )
    return np.stack([x, y, np.sin(x + y)], -1).reshape(-1, 3) / count, faces.reshape(-1, 3)


@pytest.mark.parametrize("name", ["big.stl", "big.obj"])
def test_a_mesh_of_too_many_triangles_is_refused_by_its_number(name, tmp_path):
    points, faces = grid(320)
    assert len(faces) > MAX_FACES
    if name.endswith("obj"):  # their corners need not be read
        content = ("v 0 0 0\n" * 4 + "f 1 2 3\n" * len(faces)).encode()
    else:
        content = stl(points, faces)
    (tmp_path / name).write_bytes(content)
    message = refuse_system(payload__shape="mesh", payload__mesh=str(tmp_path / name))
    assert f"{len(faces)} triangles, more than {MAX_FACES}; reduce it" in message
    assert not any(word in message for word in JARGON)


@pytest.mark.parametrize(
    "content, name, words",
    [
        (b"", "empty.stl", "promises 0 triangles"),
        (b"nonsense", "bad.stl", "promises 0 triangles"),
        (b"", "empty.obj", "holds no triangles"),
        (bytes(80) + (1000).to_bytes(4, "little") + bytes(100), "cut.stl", "promises 1000 triangles, but 2 follow"),
        (b"solid a\nfacet\nvertex 0 0 0\nvertex 1 0 0\nendfacet\n", "cut.stl", "2 vertices, not three for each"),
        (b"solid a\nfacet\nvertex 0 0 0\nvertex 1 0 x\nvertex 1 1 1\nendfacet\n", "odd.stl", "no numbers"),
        (b"solid a\nfacet\nvertex 0 0 0\nvertex 1 0 nan\nvertex 1 1 1\nendfacet\n", "nan.stl", "no finite numbers"),
        (b"v 0 0\n", "two.obj", "a vertex in line 1 has 2 coordinates"),
        (b"v 0 0 0\nv 1 0 0\nf 1 2 3\n", "none.obj", "a face in line 3 is none of vertices above it"),
        (b"v 0 0 0\nf 1 2 -3\n", "before.obj", "a face in line 2 is none of vertices above it"),
        (b"v 0 0 0\nf a b c\n", "word.obj", "a face in line 2 has corners that are no numbers"),
        (b"v 0 0 1e300\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "huge.obj", "no finite numbers below 1e9"),
    ],
)
def test_a_damaged_mesh_is_refused_in_one_sentence(content, name, words, tmp_path):
    (tmp_path / name).write_bytes(content)
    message = refuse_system(payload__shape="mesh", payload__mesh=str(tmp_path / name))
    assert message.startswith(f"cannot read payload.mesh={tmp_path / name}: ") and words in message
    assert not any(word in message for word in JARGON), message


def test_a_file_too_large_to_be_one_is_refused_before_it_is_read(tmp_path):
    for name, key in (("big.obj", "payload.mesh"), ("big.csv", "task_options.file"), ("big.yaml", "vehicle.preset")):
        with open(tmp_path / name, "wb") as file:
            file.truncate(10**11)  # of no bytes on the disk
        with pytest.raises(ConfigError, match="it is larger than 100 MB"):
            ml.load_config("track", {key: str(tmp_path / name)})
