"""Numbers in another unit than that of their key: refused by name, with the unit that they are likely in."""

from __future__ import annotations

import logging
from math import pi

import numpy as np
import pytest
from conftest import make_system, refuse_system
from test_mesh import cells, obj

import multilift_marl as ml
from multilift_marl.config.load import list_configs
from multilift_marl.errors import warn_once
from multilift_marl.rig.mesh import read_mesh
from multilift_marl.rig.presets import PRESETS

NAMES = sorted(PRESETS)
FALCON = PRESETS["falcon"]
EDGES = np.array([0.6, 0.8, 0.15])


@pytest.fixture
def block(tmp_path):
    """Return a writer of overrides for a box of EDGES whose file counts in a unit, from one of its corners."""

    def write(unit, edges=EDGES):
        x, y, z = edges / unit
        (tmp_path / "block.obj").write_text(obj(*cells(((0.0, x), (0.0, y), z), {(0, 0)})))
        return {"payload.shape": "mesh", "payload.mesh": str(tmp_path / "block.obj")}

    return write


@pytest.mark.parametrize("unit, name", [(1e-3, "mm"), (1e-2, "cm"), (0.0254, "inch")])
@pytest.mark.parametrize("preset, size", [("falcon", 1.0), ("crazyflie", 0.4), ("x500", 1.5)])
def test_a_mesh_in_another_unit_is_refused_with_the_size_that_it_has(unit, name, preset, size, block):
    overrides = block(unit, size * EDGES) | {"vehicle.preset": preset}
    message = refuse_system(**{key.replace(".", "__"): value for key, value in overrides.items()})
    mass = make_system(4, **{"vehicle.preset": preset}).payload_mass
    words = f"lighter than air with {mass:.3g} kg; if it is in {name}, "
    assert words in message and message.startswith(f"payload.mesh={overrides['payload.mesh']} makes a payload of ")
    cure = [float(edge) for edge in message.rpartition("payload.size=")[2].strip("[]").split(", ")]
    np.testing.assert_allclose(cure, size * EDGES, rtol=1e-3)
    make_system(4, **overrides, **{"payload.size": cure})


def test_a_mesh_as_heavy_as_no_metal_is_refused(block):
    message = refuse_system(**{key.replace(".", "__"): value for key, value in block(1.0, EDGES / 1000).items()})
    assert "denser than any metal" in message


@pytest.mark.parametrize("edges", [[0.55, 0.45, 0.15], [2.0, 2.0, 0.3], [1.6, 0.04, 0.04]])
@pytest.mark.parametrize("unit, name", [(1e-2, "cm"), (0.0254, "inch")])
def test_a_box_in_another_unit_is_refused(edges, unit, name):
    size = [float(edge) / unit for edge in edges]
    if max(size) > 100:
        assert "payload.size must be from 0.001 to 100 m" in refuse_system(payload__size=size)
    else:
        message = refuse_system(payload__size=size)
        assert "lighter than air with 1.4 kg; if it is in " in message
        assert edges[0] != 0.55 or f"in {name}, give payload.size={edges}" in message


def test_light_and_large_payloads_stay():
    make_system(4, **{"payload.size": [2.0, 2.0, 1.0], "payload.mass": 0.5, "cable.length": 2.0})  # a frame
    make_system(
        1, **{"payload.size": [0.02, 0.02, 0.02], "payload.mass": 0.3, "payload.inertia": [1e-3] * 3}
    )  # a weight


@pytest.mark.parametrize("preset", NAMES)
@pytest.mark.parametrize(
    "field, factor, unit",
    [
        ("thrust_coefficient", (pi / 30) ** 2, "per rpm²"),
        ("mass", 1e3, "in g"),
        ("inertia", 1e3, "in g m²"),
        ("inertia", 1e4, "kg cm²"),
        ("inertia", 1e6, "kg mm²"),
        ("inertia", 1e7, "g cm²"),
        ("inertia", 1e9, "g mm²"),
        ("rotor_thrust_max", 1 / 9.80665e-3, "in gf"),
        ("rotor_radius", 1e3, "in mm"),
        ("rotor_radius", 1e2, "cm"),
        ("rotor_radius", 1 / 0.0254, "inch"),
        ("arm", 1e3, "in mm"),
        ("arm", 1e2, "cm"),
        ("torque_ratio", 1e3, "in mm"),
        ("rotor_time_constant_up", 1e3, "in ms"),
        ("rotor_time_constant_down", 1e3, "in ms"),
        ("rotor_inertia", 1e7, "g cm²"),
    ],
)
def test_a_vehicle_in_another_unit_is_refused(preset, field, factor, unit):
    value = getattr(PRESETS[preset], field)
    wrong = [factor * part for part in value] if isinstance(value, tuple) else factor * value
    message = refuse_system(1, vehicle__preset=preset, **{f"vehicle__{field}": wrong})
    assert f"vehicle.{field}" in message and unit in message, message


@pytest.mark.parametrize(
    "overrides, words",
    [
        ({"vehicle.rotor_speed_min": 150 * 30 / pi}, ("idle at vehicle.rotor_speed_min", "in rpm, give 150")),
        ({"vehicle.rotor_speed_min": 600 * 30 / pi}, ("must be less than the 1788", "if that is in rpm, give 600")),
        ({"vehicle.torque_ratio": 3.4375e-8}, ("vehicle.torque_ratio", "vehicle.thrust_coefficient, 0.022")),
        ({"cable.hook": [0.0, 0.0, -5.0]}, ("cable.hook [0.0, 0.0, -5.0]", "if cable.hook is in cm, give 0.05")),
        ({"vehicle.rotor_azimuth": [0.785, 2.356, 3.927, 5.498]}, ("does not balance", "in degrees and not in rad")),
        ({"payload.mass": 1400.0}, ("lower payload.mass (1400 kg)", "if that is in g, give 1.4")),
        ({"payload.anchors": [[270, 220, 75], [-270, 220, 75], [-270, -220, 75], [270, -220, 75]]},
         ("payload.anchors must be from -100 to 100 m", "; is it in mm or cm or",)),
        ({"payload.anchors": [[27, 22, 7.5], [-27, 22, 7.5], [-27, -22, 7.5], [27, -22, 7.5]]},
         ("payload.anchors: anchor 0 is out of reach", "in m and not in cm")),
        ({"payload.center_of_mass": [20.0, 15.0, 0.0]}, ("payload.center_of_mass", "in m and not in cm")),
        ({"payload.inertia": [26.25, 37.92, 58.92]}, ("more than a body of 1.4 kg", "in g m², give 0.05892")),
        ({"payload.inertia": [262.5, 379.2, 589.2]}, ("more than a body of 1.4 kg", "in kg cm², give 0.05892")),
        ({"payload.drag_area": 900.0}, ("payload.drag_area=900 m²", "if that is in cm², give 0.09")),
        ({"payload.size": [550, 450, 150]}, ("must be from 0.001 to 100 m", "is it in mm or cm or inch?")),
        ({"control.max_tilt_rate": 230}, ("must be from 0 to 100 rad/s, but is 230; is it in rpm or deg/s?",)),
        ({"control.max_yaw": 30}, ("from 0 to 3.14159 rad, but is 30; is it in deg?",)),
        ({"cable.length": 1500}, ("cable.length must be from 0.001 to 1000 m, but is 1500; is it in mm or",)),
    ],
)  # fmt: skip
def test_what_cannot_be_in_its_unit_is_refused_with_the_likely_one(overrides, words):
    message = refuse_system(4, **{key.replace(".", "__"): value for key, value in overrides.items()})
    assert all(word in message for word in words), message


@pytest.mark.parametrize(
    "overrides, words",
    [
        ({"cable.angle": 0.5236}, "cable.angle=0.5236 is in degrees and almost vertical; if that is in rad, give 30"),
        ({"cable.length": 150.0}, "cable.length=150 m is 708 × the span of its drone; if that is in cm, give 1.5"),
    ],
)
def test_what_can_be_but_hardly_is_said_once(overrides, words, caplog):
    warn_once.cache_clear()
    with caplog.at_level(logging.WARNING):
        make_system(1, **overrides)
        make_system(1, **overrides)
    assert [record.getMessage() for record in caplog.records] == [words]


@pytest.mark.parametrize("name", list_configs())
def test_shipped_configurations_are_plausible_and_silent(name, caplog):
    warn_once.cache_clear()
    ml.load_config(name).system  # noqa: B018
    assert not caplog.records


def test_anchors_and_centre_of_mass_count_from_the_origin_of_the_file(block):
    """The same body, once by its middle, once by the corner that its file counts from; and once scaled."""
    lid = EDGES[2] + 0.005
    corners = [[0.05, 0.05, lid], [0.55, 0.05, lid], [0.55, 0.75, lid], [0.05, 0.75, lid]]
    center = [0.32, 0.41, 0.07]
    own = {"payload.origin": "file", "payload.anchors": corners, "payload.center_of_mass": center}
    middle = {
        "payload.anchors": (np.array(corners) - EDGES / 2).tolist(),
        "payload.center_of_mass": (np.array(center) - EDGES / 2).tolist(),
    }
    scaled = {"payload.size": EDGES.tolist()}
    for unit, overrides in ((1.0, own), (1.0, middle), (1e-3, own | scaled)):
        system = make_system(4, **block(unit), **overrides)
        np.testing.assert_allclose(system.anchors, np.array(corners) - center, atol=1e-9)
        np.testing.assert_allclose(system.payload_center, EDGES / 2 - center, atol=1e-9)
    assert np.abs(read_mesh(block(1.0)["payload.mesh"]).points.min(axis=0)).max() == 0
    assert "payload.origin means nothing to a box; drop it" in refuse_system(payload__origin="file")
