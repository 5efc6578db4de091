"""Vehicles from URDF files, against their bodies put together in another way, and files that are none."""

from __future__ import annotations

import re
from math import pi

import mujoco
import numpy as np
import pytest
from conftest import make_system, refuse_system

import multilift_marl as ml
from multilift_marl.rig.presets import PRESETS

THRUST = {"vehicle.thrust_coefficient": 8e-6, "vehicle.torque_ratio": 0.016, "vehicle.rotor_thrust_max": 6.0}


def link(name, mass, xyz, moments, rpy="0 0 0"):
    x, y, z = moments
    return (
        f'<link name="{name}"><inertial><origin xyz="{xyz}" rpy="{rpy}"/><mass value="{mass}"/>'
        f'<inertia ixx="{x}" ixy="0" ixz="0" iyy="{y}" iyz="0" izz="{z}"/></inertial></link>'
    )


def joint(child, kind, xyz="0 0 0", parent="base_link", rpy="0 0 0"):
    return (
        f'<joint name="{child}_joint" type="{kind}"><origin xyz="{xyz}" rpy="{rpy}"/><parent link="{parent}"/>'
        f'<child link="{child}"/><axis xyz="0 0 1"/></joint>'
    )


def plus(arm=0.17, kind="continuous", turned="0 0 0"):
    """Return a drone with a body, a battery below it and four rotors on the body axes that hang on a frame."""
    parts = [
        link("base_link", 0.5, "0 0 0", (6e-3, 6.5e-3, 11e-3)),
        link("frame", 0.05, "0 0 0.01", (4e-4, 5e-4, 6e-4)),
    ]
    parts += [joint("frame", "fixed", "0 0 0.02"), link("battery", 0.15, "0 0 -0.01", (2e-4, 3e-5, 2e-4), turned)]
    parts += [joint("battery", "fixed", "0 0 -0.03")]
    for i, (x, y) in enumerate(((arm, 0), (-arm, 0), (0, arm), (0, -arm))):
        name = f"rotor_{i}"
        parts += [link(name, 0.009, "0 0 0", (1.6e-5, 1.6e-5, 3e-5)), joint(name, kind, f"{x} {y} 0.03", "frame")]
    return f'<?xml version="1.0"?><robot name="plus">{"".join(parts)}</robot>'


def cf2x():
    """Return a drone as in gym-pybullet-drones: rotors without mass, their places in the links, forces per rpm²."""
    still = (0, 0, 0)
    parts = ['<properties arm="0.0397" kf="3.16e-10" km="7.94e-12" thrust2weight="2.25" prop_radius="2.31348e-2"/>']
    parts += [link("base_link", 0.027, "0 0 0", (1.4e-5, 1.4e-5, 2.17e-5))]
    parts += [link("center_of_mass_link", 0, "0 0 0", still), joint("center_of_mass_link", "fixed")]
    for i, xyz in enumerate(("0.028 -0.028 0", "-0.028 -0.028 0", "-0.028 0.028 0", "0.028 0.028 0")):
        parts += [link(f"prop{i}_link", 0, xyz, still), joint(f"prop{i}_link", "fixed")]
    return f'<robot name="cf2">{"".join(parts)}</robot>'


@pytest.mark.parametrize("kind", ["continuous", "fixed"])
@pytest.mark.parametrize("turned", ["0 0 0", f"0 0 {pi / 2}"])
def test_mass_and_inertia_are_those_that_mujoco_reads_in_the_same_file(kind, turned, write):
    path = write(plus(kind=kind, turned=turned), "plus.urdf")
    vehicle = make_system(1, **{"vehicle.preset": str(path)}, **THRUST).vehicle
    model = mujoco.MjModel.from_xml_string(plus(kind="fixed", turned=turned).replace("<robot name=\"plus\">",
        '<robot name="plus"><mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'))  # fmt: skip
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    mass = model.body_mass
    center = mass @ data.xipos / mass.sum()
    inertia = np.zeros((3, 3))
    for m, place, rotation, moments in zip(mass, data.xipos, data.ximat, model.body_inertia, strict=True):
        axes, arm = rotation.reshape(3, 3), place - center
        inertia += axes @ np.diag(moments) @ axes.T + m * (arm @ arm * np.eye(3) - np.outer(arm, arm))
    assert vehicle.mass == pytest.approx(mass.sum()) == pytest.approx(0.736)
    np.testing.assert_allclose(vehicle.inertia, np.diag(inertia), rtol=1e-6)
    assert (vehicle.name, vehicle.arm, vehicle.rotor_inertia) == ("plus", pytest.approx(0.17), pytest.approx(3e-5))
    np.testing.assert_allclose(np.rad2deg(vehicle.rotor_azimuth), [0, 90, 180, 270], atol=1e-9)
    assert (vehicle.drag, vehicle.rotor_speed_min, vehicle.thrust_coefficient) == ((0.0, 0.0, 0.0), 0.0, 8e-6)


def test_properties_of_gym_pybullet_drones_are_read_in_their_units(write):
    vehicle = make_system(2, **{"vehicle.preset": str(write(cf2x(), "cf2x.urdf")), "payload.mass": 0.01}).vehicle
    assert vehicle.mass == 0.027 and vehicle.inertia == (1.4e-5, 1.4e-5, 2.17e-5)
    assert vehicle.arm == pytest.approx(0.028 * 2**0.5) and vehicle.rotor_radius == 2.31348e-2
    rpm = 14468.43  # at which its documents let it hover: four times kf rpm² is its weight at 9.8 m/s²
    assert 4 * vehicle.thrust_coefficient * (rpm * pi / 30) ** 2 == pytest.approx(0.027 * 9.8, rel=1e-4)
    assert vehicle.torque_ratio == pytest.approx(7.94e-12 / 3.16e-10)
    assert 4 * vehicle.rotor_thrust_max == pytest.approx(2.25 * 0.027 * 9.81)


def test_a_urdf_file_is_found_beside_the_file_that_names_it_and_pinned(write, tmp_path):
    write(plus(), "plus.urdf")
    rest = ", ".join(f"{key.removeprefix('vehicle.')}: {value}" for key, value in THRUST.items())
    rig = write(f"vehicle: {{preset: [plus.urdf, falcon], {rest}}}\nenv: {{num_drones: 2}}")
    config = ml.load_config(rig)
    assert config.vehicle.preset[0].startswith(f"{tmp_path / 'plus.urdf'}#sha256=")
    assert [vehicle.name for vehicle in config.system.vehicles] == ["plus", "falcon"]
    assert config.system.vehicles[1].mass == PRESETS["falcon"].mass


@pytest.mark.parametrize(
    "text, name, words",
    [
        (plus(), "plus.urdf", "does not say vehicle.thrust_coefficient, vehicle.torque_ratio, vehicle.rotor_th"),
        (plus(), "plus.xacro", "is a xacro file; make a URDF of it: xacro plus.xacro > vehicle.urdf"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"/>', "a.urdf", "is a xacro file"),
        ("<sdf/>", "a.sdf", "is an SDF file, which is not read"),
        ("<model/>", "a.urdf", "is no URDF file (its root is <model> and not <robot>)"),
        ("nonsense", "a.urdf", "is no URDF file (syntax error"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><robot/>', "a.urdf", "is no URDF file (it defines entities)"),
        ("<robot/>", "a.urdf", "its links have no mass"),
        (plus(kind="fixed").replace("rotor_3", "foot_3"), "a.urdf", "it has 3 rotors (rotor_0, rotor_1, rotor_2)"),
        (plus().replace(f"{-0.17} 0 0.03", "-0.15 0 0.03"), "a.urdf", "its rotors do not lie in opposite pairs"),
        (plus().replace('ixy="0"', 'ixy="2e-3"', 1), "a.urdf", "its principal axes of inertia are not those"),
        (plus().replace('value="0.5"', 'value="nan"'), "a.urdf", "is no URDF file (it holds nan)"),
        (cf2x().replace("3.16e-10", "3,16"), "a.urdf", "is no URDF file (could not convert"),
        (plus().replace("<mass", "<weight", 1), "a.urdf", "is no URDF file"),
        (link("a", 1, "0 0", (1, 1, 1)).join(["<robot>", "</robot>"]), "a.urdf", "an origin has no three coordinates"),
    ],
)  # fmt: skip
def test_what_is_no_known_vehicle_is_refused_by_name(text, name, words, write):
    message = refuse_system(1, vehicle__preset=str(write(text, name)))
    assert re.match(r"vehicle\.preset=/", message) and words in message, message


@pytest.mark.parametrize("more", ["imu", "motors"])
def test_other_joints_and_motors_are_no_rotors(more, write):
    parts = []
    for name in ["imu_link"] if more == "imu" else [f"motor_{i}" for i in range(4)]:
        kind = "revolute" if more == "imu" else "fixed"
        parts += [link(name, 1e-6, "0 0 0", (1e-9, 1e-9, 1e-9)), joint(name, kind)]
    text = plus(kind="continuous" if more == "imu" else "fixed").replace("</robot>", "".join(parts) + "</robot>")
    vehicle = make_system(1, **{"vehicle.preset": str(write(text, "more.urdf"))}, **THRUST).vehicle
    assert vehicle.arm == pytest.approx(0.17, rel=1e-3)


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('thrust2weight="2.25"', 'thrust2weight="0"'), ('thrust2weight="2.25"', 'thrust2weight="-1"'),
        ('prop_radius="2.31348e-2"', 'prop_radius="0"'), ('prop_radius="2.31348e-2"', 'prop_radius="-1"'),
        ('km="7.94e-12"', 'km="-1e-12"'), ('kf="3.16e-10"', 'kf="1e8"'),
    ],
)  # fmt: skip
def test_numbers_are_held_to_the_bounds_of_every_vehicle(old, new, write):
    path = write(cf2x().replace(old, new), "odd.urdf")
    assert "vehicle." in refuse_system(1, **{"vehicle.preset": str(path)})


@pytest.mark.parametrize("where", ["axis", "joint", "above", "usual", "fixed"])
def test_tilted_rotors_are_refused_by_name(where, write):
    rotor = joint("rotor_3", "continuous", "0 -0.17 0.03", "frame")
    up, tilt = '<axis xyz="0 0 1"/>', np.deg2rad(3.0)
    text, name, angle = plus(), "rotor_3", "3.0"
    assert rotor in text
    if where == "axis":
        text = text.replace(rotor, rotor.replace(up, f'<axis xyz="0 {np.sin(tilt)} {-np.cos(tilt)}"/>'))
    elif where == "usual":  # of URDF: x
        text, angle = text.replace(rotor, rotor.replace(up, "")), "90.0"
    elif where == "above":
        text = text.replace(joint("frame", "fixed", "0 0 0.02"), joint("frame", "fixed", "0 0 0.02", rpy=f"{tilt} 0 0"))
        name = "rotor_0"
    else:
        tilted = joint("rotor_3", "continuous", "0 -0.17 0.03", "frame", rpy=f"0 {tilt} 1")
        text = text.replace(rotor, tilted)
        text = text.replace("continuous", "fixed") if where == "fixed" else text
    message = refuse_system(1, vehicle__preset=str(write(text, "tilted.urdf")), **THRUST)
    assert f"no such quadrotor: the axis of {name} is tilted by {angle}° from body z; give" in message


def test_rotors_whose_axes_are_upright_by_what_hangs_above_are_read(write):
    rotor = joint("rotor_3", "continuous", "0 -0.17 0.03", "frame")
    turned = joint("rotor_3", "continuous", "0 -0.17 0.03", "frame", rpy=f"{pi / 2} 0 0.3").replace(
        '<axis xyz="0 0 1"/>', '<axis xyz="0 -2 0"/>'
    )
    path = write(plus().replace(rotor, turned), "turned.urdf")
    assert make_system(1, **{"vehicle.preset": str(path)}, **THRUST).vehicle.arm == pytest.approx(0.17)
