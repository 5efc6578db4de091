"""Quadrotors from URDF files: mass, inertia and where the rotors are; of gym-pybullet-drones also their thrust."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from multilift_marl.errors import ConfigError
from multilift_marl.physical import GRAVITY

REQUIRED = ("thrust_coefficient", "torque_ratio", "rotor_thrust_max")
"""Fields of a vehicle that URDF has no words for."""
_ROTOR = re.compile(r"prop|rotor|motor", re.IGNORECASE)
_PROPERTIES = ("kf", "km", "thrust2weight", "prop_radius")
_TURNING = ("continuous", "revolute")
_SKEW = 0.05  # [-] products of inertia over the largest moment, beyond which the body axes are not principal
_UNEVEN = 0.02  # [-] of the arm by which rotors may lie off a regular place, and off the centre of mass
_UPRIGHT = 1.0  # [deg] by which a rotor's axis may be off body z
_PER_RPM = (30 / np.pi) ** 2  # from a coefficient per rpm² to one per (rad/s)²


class _Link(NamedTuple):
    """A body, in the frame of the root: its mass [kg], place (3,) [m] and inertia about that (3, 3) [kg m²].

    Its axis (3,) is that of its joint, by length one; where it is fixed and the joint has none, its own z.
    """

    name: str
    mass: float
    place: np.ndarray
    inertia: np.ndarray
    turns: bool
    axis: np.ndarray


def read_urdf(path: Path, content: bytes) -> dict[str, Any]:
    """Return the fields of the vehicle in a URDF file, as in the section `vehicle`.

    Drag, idle speed and, where the rotors' links have none, the rotors' inertia are zero. Rotors are in counter-
    clockwise order from body x, and their reaction torques alternate, the first about +z.

    Raises:
        ConfigError: another kind of file, or no quadrotor that is as symmetric as vehicles here are.
    """
    links, properties = _parse(path, content)
    mass = sum(link.mass for link in links)
    if not mass > 0:
        raise _fault(path, "its links have no mass")
    center = sum(link.mass * link.place for link in links) / mass
    # About the common centre of mass (Steiner).
    inertia = sum(link.inertia + link.mass * _steiner(link.place - center) for link in links)
    moments = np.diag(inertia)
    if np.abs(inertia - np.diag(moments)).max() > _SKEW * moments.max():
        raise _fault(path, "its principal axes of inertia are not those of the body")
    rotors = _find_rotors(links)
    if len(rotors) != 4:
        names = f" ({', '.join(link.name for link in rotors)})" if rotors else ""
        raise _fault(path, f"it has {len(rotors)} rotors{names} where vehicles have 4")
    for link in rotors:
        tilt = float(np.rad2deg(np.arctan2(np.linalg.norm(link.axis[:2]), abs(link.axis[2]))))
        if tilt > _UPRIGHT:
            raise _fault(path, f"the axis of {link.name} is tilted by {tilt:.1f}° from body z")
    fields = _place_rotors(path, np.array([link.place for link in rotors]) - center)
    spinning = np.mean([link.inertia[2, 2] for link in rotors])
    fields |= {"mass": mass, "inertia": tuple(map(float, moments)), "drag": (0.0, 0.0, 0.0), "rotor_speed_min": 0.0}
    return fields | {"rotor_inertia": float(spinning)} | _read_properties(properties, mass)


def _find_rotors(links: list[_Link]) -> list[_Link]:
    """Return the four links that are the rotors; others where no choice by joints and names gives four."""
    named = [link for link in links if _ROTOR.search(link.name)]
    turning = [link for link in links if link.turns]
    rotors = [link for link in named if "motor" not in link.name.lower()]
    choices = ([link for link in named if link.turns], turning, rotors, named)
    return next((found for found in choices if len(found) == 4), turning or named)


def _place_rotors(path: Path, places: np.ndarray) -> dict[str, Any]:
    """Return arm and directions of rotors at places (4, 3) [m] from the centre of mass, made exactly opposite."""
    middle = places[:, :2].mean(axis=0)
    level = places[:, :2] - middle
    arm = float(np.linalg.norm(level, axis=1).mean())
    azimuth = np.sort(np.rad2deg(np.arctan2(level[:, 1], level[:, 0])).round(9) % 360)
    azimuth = np.tile((azimuth[:2] + azimuth[2:] - 180) / 2, 2) + np.repeat([0.0, 180.0], 2)
    regular = arm * np.stack([np.cos(np.deg2rad(azimuth)), np.sin(np.deg2rad(azimuth))], axis=1)
    gaps = np.linalg.norm(level[:, None] - regular[None], axis=2).min(axis=1)
    if arm == 0 or max(gaps.max(), np.linalg.norm(middle)) > _UNEVEN * arm:
        raise _fault(path, "its rotors do not lie in opposite pairs, equally far from the centre of mass")
    return {"arm": arm, "rotor_azimuth": tuple(map(float, azimuth)), "rotor_spin": (1.0, -1.0, 1.0, -1.0)}


def _read_properties(given: dict[str, float], mass: float) -> dict[str, float]:
    """Return what gym-pybullet-drones adds to URDF: coefficients per rpm², thrust over weight, radius."""
    fields = {}
    if "kf" in given:
        fields["thrust_coefficient"] = given["kf"] * _PER_RPM
    if {"kf", "km"} <= given.keys() and given["kf"] > 0:
        fields["torque_ratio"] = given["km"] / given["kf"]
    if "thrust2weight" in given:
        fields["rotor_thrust_max"] = given["thrust2weight"] * mass * GRAVITY / 4
    return fields | ({"rotor_radius": given["prop_radius"]} if "prop_radius" in given else {})


def _parse(path: Path, content: bytes) -> tuple[list[_Link], dict[str, float]]:
    """Return the links and those attributes of `properties` that are read."""
    kind = path.suffix.lower()
    if kind == ".xacro" or b"ros.org/wiki/xacro" in content:
        raise ConfigError(f"vehicle.preset={path} is a xacro file; make a URDF of it: xacro {path.name} > vehicle.urdf")
    if kind == ".sdf":
        raise ConfigError(f"vehicle.preset={path} is an SDF file, which is not read; give a URDF or a YAML file")
    try:
        plain = content.replace(b"\0", b"")  # of UTF-16
        if b"<!DOCTYPE" in plain or b"<!ENTITY" in plain:
            raise ValueError("it defines entities")
        root = ElementTree.fromstring(content)
        if root.tag != "robot":
            raise ValueError(f"its root is <{root.tag}> and not <robot>")
        properties = root.find("properties")
        given = {} if properties is None else properties.attrib
        return _place_links(root), {key: _number(given[key]) for key in _PROPERTIES if key in given}
    except (ElementTree.ParseError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise ConfigError(f"vehicle.preset={path} is no URDF file ({error}); correct it") from None


def _place_links(root: ElementTree.Element) -> list[_Link]:
    joints = {}
    for joint in root.findall("joint"):
        child = joint.find("child").attrib["link"]  # type: ignore[union-attr]
        joints[child] = (joint.find("parent").attrib["link"], joint)  # type: ignore[union-attr]
    links = []
    for link in root.findall("link"):
        name, turns, axis = link.attrib["name"], False, np.array([0.0, 0.0, 1.0])
        rotation, place, above, depth = np.eye(3), np.zeros(3), name, 0
        while above in joints:
            above, joint = joints[above]
            if depth == 0:
                turns = joint.attrib.get("type") in _TURNING
                axis = _read_axis(joint, turns)
            own, offset = _read_origin(joint)
            rotation, place, depth = own @ rotation, offset + own @ place, depth + 1
            if depth > 100:
                raise ValueError(f"link {name} hangs on itself")
        axis = rotation @ axis
        inertial = link.find("inertial")
        mass, inertia = 0.0, np.zeros((3, 3))
        if inertial is not None:
            own, offset = _read_origin(inertial)
            rotation, place = rotation @ own, place + rotation @ offset
            mass = _number(inertial.find("mass").attrib["value"])  # type: ignore[union-attr]
            given = inertial.find("inertia").attrib  # type: ignore[union-attr]
            x, y, z, xy, xz, yz = (_number(given.get(f"i{at}", "0")) for at in ("xx", "yy", "zz", "xy", "xz", "yz"))
            inertia = rotation @ np.array([[x, xy, xz], [xy, y, yz], [xz, yz, z]]) @ rotation.T
        links.append(_Link(name, mass, place, inertia, turns, axis))
    return links


def _read_axis(joint: ElementTree.Element, turns: bool) -> np.ndarray:
    """Return the axis (3,) of a joint in its child's frame; x where one that turns names none, as in URDF."""
    element = joint.find("axis")
    usual = "1 0 0" if turns else "0 0 1"
    axis = np.array([_number(x) for x in (usual if element is None else element.attrib.get("xyz", usual)).split()])
    if axis.shape != (3,) or not (length := np.linalg.norm(axis)) > 0:
        raise ValueError("an axis has no three numbers, or no length")
    return axis / length


def _read_origin(element: ElementTree.Element) -> tuple[np.ndarray, np.ndarray]:
    """Return rotation (3, 3) and place (3,) [m] of an element's origin."""
    origin = element.find("origin")
    given = {} if origin is None else origin.attrib
    place = np.array([_number(x) for x in given.get("xyz", "0 0 0").split()])
    roll, pitch, yaw = (_number(x) for x in given.get("rpy", "0 0 0").split())
    (cr, cp, cy), (sr, sp, sy) = np.cos([roll, pitch, yaw]), np.sin([roll, pitch, yaw])
    rotation = [
        [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
        [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
        [-sp, cp * sr, cp * cr],
    ]
    if place.shape != (3,):
        raise ValueError("an origin has no three coordinates")
    return np.array(rotation), place


def _number(text: str) -> float:
    """Return a number below 1e9; a ValueError for other text."""
    if not abs(number := float(text)) < 1e9:
        raise ValueError(f"it holds {text}")
    return number


def _steiner(arm: np.ndarray) -> np.ndarray:
    return np.dot(arm, arm) * np.eye(3) - np.outer(arm, arm)


def _fault(path: Path, why: str) -> ConfigError:
    return ConfigError(f"vehicle.preset={path} is no such quadrotor: {why}; give its numbers in a YAML file")
