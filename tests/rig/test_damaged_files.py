"""Files of paths, meshes and vehicles with random damage: read, or refused in one sentence."""

from __future__ import annotations

import io

import numpy as np
import pytest
from conftest import JARGON
from test_mesh import CONCAVE, obj, stl
from test_mesh_file import text_stl
from test_path_file import loop
from test_path_formats import polynomials
from test_urdf import cf2x, plus

import multilift_marl as ml
from multilift_marl.errors import ConfigError
from multilift_marl.planning.path_file import PathFile, load_path
from multilift_marl.rig.mesh import read_mesh
from multilift_marl.rig.urdf import read_urdf

WORDS = (
    b"1e300", b"-1e300", b"1e-300", b"nan", b"inf", b"9999999999999999999999", b"0" * 50, b"-1", b"e", b"#", b'"',
    b"\r", b"\n", b"\x00", b"\xff", b";", b",", b"\t", b" ", b"_deg", b"[mm]", b"<", b">", b"/",
)  # fmt: skip


def packed(save, *columns, **arrays):
    file = io.BytesIO()
    save(file, *columns, **arrays)
    return file.getvalue()


def sound_files():
    rows, (points, faces) = loop(40, turn=1.0), CONCAVE["ell"][0]
    t, x, y, z, yaw = rows.T
    table = "t,x,y,z,yaw\n" + "\n".join(",".join(f"{value:.6f}" for value in row) for row in rows)
    pieces = "\n".join(",".join(f"{value:.6f}" for value in row) for row in polynomials()[1])
    return [
        ("path.csv", table.encode()), ("pieces.csv", pieces.encode()), ("path.npy", packed(np.save, rows)),
        ("path.npz", packed(np.savez, t=t, x=x, y=y, z=z)),
        ("small.npz", packed(np.savez_compressed, t=t, x=x, y=y, z=z, yaw_deg=yaw)),
        ("part.obj", obj(points, faces).encode()), ("part.stl", stl(points, faces)),
        ("text.stl", text_stl(points, faces).encode()), ("plus.urdf", plus().encode()), ("cf2x.urdf", cf2x().encode()),
    ]  # fmt: skip


def damage(content, rng):
    """Return bytes of which up to five places are changed, cut out, cut off, doubled or replaced."""
    content = bytearray(content)
    for _ in range(rng.integers(1, 6)):
        kind, at = rng.integers(6), int(rng.integers(len(content) + 1))
        end, word = at + int(rng.integers(1, 60)), WORDS[rng.integers(len(WORDS))]
        if kind == 0 and content:
            content[min(at, len(content) - 1)] = rng.integers(256)
        elif kind == 1:
            content[at:at] = word
        elif kind == 2:
            del content[at:end]
        elif kind == 3:
            del content[at:]
        elif kind == 4:
            content[at:at] = content[end - at : 2 * end - at]
        else:
            content[at : at + len(word)] = word
    return bytes(content)


@pytest.mark.parametrize("name, sound", sound_files(), ids=lambda value: value if isinstance(value, str) else "")
@pytest.mark.filterwarnings("error")
def test_a_damaged_file_is_read_or_refused_in_one_sentence(name, sound, tmp_path):
    config, rng, refused = ml.load_config("track"), np.random.default_rng(0), 0
    for i in range(30):
        (tmp_path / name).write_bytes(content := damage(sound, rng))
        path = tmp_path / name
        try:
            if path.suffix == ".urdf":
                read_urdf(path, content)
            elif path.suffix in (".obj", ".stl"):
                read_mesh(str(path), (0.5, 0.4, 0.3) if i % 2 else None)
            else:
                smoothing = (0.1, 0.0)[i % 2], (0.0, 2.0)[i % 3 == 0], (0.0, 0.0, 2.0)
                load_path(PathFile(str(path), *smoothing), 20.0, config.system, config.randomization)
        except ConfigError as error:
            assert len(str(error)) < 700 and not [word for word in JARGON if word in str(error)], error
            refused += 1
    assert refused > 3
