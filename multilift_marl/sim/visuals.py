"""What only eyes need: colours, sky, floor, light, rotors and the translucent target; physics is the same without."""

from __future__ import annotations

from itertools import combinations, product
from typing import Any

import mujoco
import numpy as np

from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import Vehicle

_GEOM = mujoco.mjtGeom
VISUAL_GROUP = 2
DRONE_COLOURS = (  # told apart by the colour-blind too (Okabe & Ito 2008), none of them green like the target
    (0.00, 0.45, 0.70, 1), (0.84, 0.37, 0.00, 1), (0.80, 0.47, 0.65, 1),
    (0.34, 0.71, 0.91, 1), (0.90, 0.62, 0.00, 1), (0.35, 0.35, 0.38, 1),
)  # fmt: skip
PAYLOAD_COLOUR = (0.86, 0.66, 0.35, 1)


def add_surroundings(spec: mujoco.MjSpec, floor: mujoco.MjsGeom) -> None:
    """Add a pale sky, a floor of 1 m squares that fades into it, and soft light."""
    visual, horizon = spec.visual, [0.88, 0.92, 0.96]
    spec.stat.extent, spec.stat.center = 4.0, [0, 0, 1.5]  # fixed, so that every team is lit alike
    visual.headlight.ambient, visual.headlight.diffuse, visual.headlight.specular = [0.42] * 3, [0.22] * 3, [0.05] * 3
    visual.quality.shadowsize, visual.map.shadowclip = 2048, 1.2
    visual.rgba.haze, visual.rgba.fog = [*horizon, 1], [*horizon, 1]
    visual.map.fogstart, visual.map.fogend, visual.map.znear, visual.map.zfar = 2.5, 7.0, 0.01, 50
    texture, builtin = mujoco.mjtTexture, mujoco.mjtBuiltin
    spec.add_texture(
        name="sky", type=texture.mjTEXTURE_SKYBOX, builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[0.30, 0.52, 0.82], rgb2=horizon, width=64, height=384,
    )  # fmt: skip
    spec.add_texture(
        name="grid", type=texture.mjTEXTURE_2D, builtin=builtin.mjBUILTIN_CHECKER, mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.70, 0.73, 0.76], rgb2=[0.66, 0.69, 0.73], markrgb=[0.86, 0.88, 0.90], width=512, height=512,
    )  # fmt: skip
    material = spec.add_material(name="grid", texrepeat=[1, 1], texuniform=True, specular=0.0)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    floor.material = "grid"


def add_light(payload: mujoco.MjsBody) -> None:
    """Hang a sun above the payload, so that its shadows reach wherever the team flies."""
    payload.add_light(
        name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
        pos=[-1.0, -1.0, 5.0], dir=[0.15, 0.15, -1], castshadow=True, diffuse=[0.42] * 3, specular=[0.15] * 3,
    )  # fmt: skip


def add_rotorcraft(body: mujoco.MjsBody, vehicle: Vehicle, colour: tuple[float, ...]) -> None:
    """Draw hull, arms and rotor discs; the front ones in the drone's colour."""
    arm, dark, pale = vehicle.arm, [0.13, 0.13, 0.15, 1], [0.30, 0.32, 0.36, 0.55]
    plain = {"contype": 0, "conaffinity": 0, "group": VISUAL_GROUP, "mass": 0}
    hull = np.array([0.50, 0.36, 0.26]) * arm
    body.add_geom(type=_GEOM.mjGEOM_ELLIPSOID, size=hull, rgba=colour, **plain)
    for position in vehicle.rotor_positions:
        tip, disc = position + [0, 0, 0.22 * arm], [0.62 * arm, 0.02 * arm, 0]
        thick = [0.08 * arm, 0, 0]
        body.add_geom(type=_GEOM.mjGEOM_CAPSULE, fromto=[0, 0, 0, *position], size=thick, rgba=dark, **plain)
        body.add_geom(type=_GEOM.mjGEOM_CYLINDER, fromto=[*position, *tip], size=thick, rgba=dark, **plain)
        tint = [*colour[:3], 0.75] if position[0] > 0 else pale
        body.add_geom(type=_GEOM.mjGEOM_CYLINDER, pos=tip, size=disc, rgba=tint, **plain)


def add_target(spec: mujoco.MjSpec, system: System, margin: float, form: dict[str, Any]) -> None:
    """Add the target: a translucent payload with firm edges, a little larger, so that one that has arrived fits in.

    Args:
        spec, system: of the scene.
        margin: by which it is larger on every side [m].
        form: type, size and place of its geom, `margin` included; a point has a form of its own.
    """
    body = spec.worldbody.add_body(name="target", mocap=True, pos=[0, 0, -10])
    plain = {"contype": 0, "conaffinity": 0, "group": VISUAL_GROUP}
    faint, firm = [0.0, 0.75, 0.35, 0.18], [0.0, 0.60, 0.25, 1]
    center, half = system.payload_center, system.payload_size / 2 + margin
    if system.payload_shape == "point":
        body.add_geom(type=_GEOM.mjGEOM_SPHERE, size=[half[0], 0, 0], rgba=[*firm[:3], 0.5], **plain)
        return
    body.add_geom(**form, rgba=faint, **plain)
    thick = [0.03 * system.payload_size.min(), 0, 0]
    for a, b in _rims(half) if system.payload_shape == "cylinder" else _edges(half):
        body.add_geom(type=_GEOM.mjGEOM_CAPSULE, fromto=[*(center + a), *(center + b)], size=thick, rgba=firm, **plain)


def _edges(half: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the ends of the twelve edges of a box."""
    corners = half * np.array(list(product((-1, 1), repeat=3)))
    return [(a, b) for a, b in combinations(corners, 2) if np.count_nonzero(a != b) == 1]


def _rims(half: np.ndarray, count: int = 24) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the ends of the sides of two polygons, the rims of an upright cylinder."""
    angle = np.linspace(0, 2 * np.pi, count + 1)
    rims = [half * np.stack([np.cos(angle), np.sin(angle), np.full(count + 1, side)], axis=1) for side in (-1.0, 1.0)]
    return [(a, b) for rim in rims for a, b in zip(rim[:-1], rim[1:], strict=True)]
