"""From a system to a MuJoCo model, with what is drawn where pictures are made; it decides the order of bodies."""

from __future__ import annotations

from itertools import combinations, product
from typing import Any

import mujoco
import numpy as np

from multilift_marl.physical import GRAVITY
from multilift_marl.rig.mesh import add_mesh
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicle import Vehicle
from multilift_marl.sim.cables import CABLE_MODELS
from multilift_marl.sim.contact import add_contact, drone_half_size
from multilift_marl.sim.obstacle_bodies import add_hulls, add_obstacles
from multilift_marl.sim.state_io import Layout

_GEOM = mujoco.mjtGeom
VISUAL_GROUP = 2
DRONE_COLOURS = (  # distinct to the colour-blind (Okabe & Ito 2008), none of them green like the target
    (0.00, 0.45, 0.70, 1), (0.84, 0.37, 0.00, 1), (0.80, 0.47, 0.65, 1),
    (0.34, 0.71, 0.91, 1), (0.90, 0.62, 0.00, 1), (0.35, 0.35, 0.38, 1),
)  # fmt: skip
PAYLOAD_COLOUR = (0.86, 0.66, 0.35, 1)


def build_spec(system: System, visuals: bool = False) -> mujoco.MjSpec:
    """Return the model's specification.

    Args:
        system: what to build.
        visuals: add rotors, sky, light and the translucent target (a mocap body); physics is the same without.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "multilift"
    set_options(spec, system.timestep)
    # cables are limits of tendons or act as loads: there are no springs and dampers to evaluate
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER
    _add_world(spec, visuals)
    # The payload first: `Layout` and compiled loops find the drones' joints after its own.
    _add_payload(spec, system)
    for i in range(system.num_drones):
        body = spec.worldbody.add_body(name=f"drone_{i}", pos=system.slots[i] + [0, 0, 1.5])
        body.add_freejoint(name=f"drone_{i}")
        _add_drone(body, system, i, visuals)
        CABLE_MODELS[system.cable_model].add_cable(spec, system, i)
    if visuals:  # there obstacles are scenery
        add_hulls(spec, system)
    else:
        add_obstacles(spec, system)
    add_contact(spec, system, visuals)
    if visuals:
        _add_light(spec.body("payload"))
        margin = 0.04 * system.payload_size.min()
        _add_target(spec, system, margin, _payload_form(system, margin))
    return spec


def set_options(spec: mujoco.MjSpec, timestep: float) -> None:
    """Set integrator, gravity, flags, solver and Jacobian."""
    option = spec.option
    disable = mujoco.mjtDisableBit
    option.timestep = timestep
    option.gravity = [0, 0, -GRAVITY]
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.solver = mujoco.mjtSolver.mjSOL_NEWTON
    option.tolerance = 1e-18
    option.iterations = 1000
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    # AUTORESET would put a diverged simulation back to its start unnoticed; `World.diverged` marks it instead.
    option.disableflags |= disable.mjDSBL_REFSAFE | disable.mjDSBL_AUTORESET | disable.mjDSBL_ISLAND


def build_model(system: System, visuals: bool = False) -> tuple[mujoco.MjModel, Layout]:
    """Return the compiled model and where its bodies are."""
    model = build_spec(system, visuals).compile()
    # After compiling, which computes the inverse weights that stiffness and damping of cables are scaled by.
    CABLE_MODELS[system.cable_model].set_constants(model, system)
    point = system.payload_shape == "point"
    drones = tuple(model.body(f"drone_{i}").id for i in range(system.num_drones))
    return model, Layout(3 if point else 7, 3 if point else 6, model.body("payload").id, drones)


def _add_world(spec: mujoco.MjSpec, visuals: bool) -> None:
    world = spec.worldbody
    floor = world.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[0, 0, 0.05])
    # The top view is a little off straight down, where `right` would be 0/0.
    for name, pos, forward in (("side", [0.0, -5.2, 3.4], [0, 1, -0.3]), ("top", [0.0, 0.0, 8.0], [0, 1e-3, -1])):
        forward = np.asarray(forward, float) / np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        quat = np.zeros(4)
        # A camera of MuJoCo has its view along -z, x to the right and y up.
        mujoco.mju_mat2Quat(quat, np.stack([right, up, -forward], axis=1).ravel())
        world.add_camera(name=name, pos=pos, quat=quat, fovy=45)
    if visuals:
        _add_surroundings(spec, floor)


def _add_payload(spec: mujoco.MjSpec, system: System) -> None:
    point = system.payload_shape == "point"  # its slide joints count from the body's place, so that must be the origin
    body = spec.worldbody.add_body(name="payload", pos=[0, 0, 0 if point else 1.5])
    body.mass = system.payload_mass
    # Stated, or MuJoCo would compute it from the geom and its density. The frame's origin is the centre of mass.
    body.explicitinertial = True
    body.inertia = system.payload_inertia
    body.ipos = [0, 0, 0]
    body.iquat = system.payload_axes
    if "payload_center_of_mass" in system.varied:
        body.simple = False  # or MuJoCo takes the centre of mass to be the origin for good
    colour = list(PAYLOAD_COLOUR)
    if point:
        for name, axis in zip("xyz", np.eye(3), strict=True):
            body.add_joint(name=f"payload/{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        body.add_geom(name="payload", type=_GEOM.mjGEOM_SPHERE, size=[system.payload_size[0] / 2, 0, 0], rgba=colour)
    else:
        body.add_freejoint(name="payload")
        if system.payload_mesh is not None:
            add_mesh(spec, "payload", system.payload_mesh)
        body.add_geom(name="payload", **_payload_form(system), rgba=colour)
    for i, anchor in enumerate(system.anchors):
        body.add_site(name=f"payload/anchor_{i}", pos=anchor, size=[0.012, 0, 0], rgba=[0.2, 0.2, 0.2, 1])


def _payload_form(system: System, margin: float = 0.0) -> dict[str, Any]:
    """Return type, size and place of the geom of a payload with extent, `margin` [m] larger on every side.

    A mesh has no margin; it collides as its convex hull.
    """
    half = system.payload_size / 2 + margin
    pos = system.payload_center
    mesh = system.payload_mesh
    if mesh is not None:
        # Vertices count from the mesh's own origin: its middle goes to where the payload's is.
        return {"type": _GEOM.mjGEOM_MESH, "meshname": "payload", "pos": pos - mesh.middle}
    if system.payload_shape == "cylinder":
        return {"type": _GEOM.mjGEOM_CYLINDER, "size": [half[0], half[2], 0], "pos": pos}
    return {"type": _GEOM.mjGEOM_BOX, "size": half, "pos": pos}


def _add_drone(body: mujoco.MjsBody, system: System, i: int, visuals: bool) -> None:
    vehicle = system.vehicles[i]
    name = f"drone_{i}"
    body.mass = vehicle.mass
    body.explicitinertial = True
    body.inertia = vehicle.inertia
    body.ipos = [0, 0, 0]
    colour = DRONE_COLOURS[i % len(DRONE_COLOURS)]
    # Transparent where a rotorcraft is drawn in place of its collision box.
    body.add_geom(
        name=name, type=_GEOM.mjGEOM_BOX, size=drone_half_size(vehicle),
        rgba=[*colour[:3], 0.0 if visuals else 1.0],
    )  # fmt: skip
    body.add_site(name=f"{name}/hook", pos=system.hooks[i], size=[0.008, 0, 0], rgba=[0.2, 0.2, 0.2, 1])
    if visuals:
        _add_rotorcraft(body, vehicle, colour)


def _add_surroundings(spec: mujoco.MjSpec, floor: mujoco.MjsGeom) -> None:
    """Add a pale sky, a floor of 1 m squares that fades into it, and soft light."""
    visual = spec.visual
    horizon = [0.88, 0.92, 0.96]
    spec.stat.extent = 4.0  # fixed, so that every team is lit alike
    spec.stat.center = [0, 0, 1.5]
    visual.headlight.ambient = [0.42] * 3
    visual.headlight.diffuse = [0.22] * 3
    visual.headlight.specular = [0.05] * 3
    visual.quality.shadowsize = 2048
    visual.map.shadowclip = 1.2
    visual.rgba.haze = [*horizon, 1]
    visual.rgba.fog = [*horizon, 1]
    # Distances of `map` are in units of `stat.extent`.
    visual.map.fogstart = 2.5
    visual.map.fogend = 7.0
    visual.map.znear = 0.01
    visual.map.zfar = 50
    texture = mujoco.mjtTexture
    builtin = mujoco.mjtBuiltin
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


def _add_light(payload: mujoco.MjsBody) -> None:
    """Hang a sun above the payload, so that its shadows reach wherever the team flies."""
    payload.add_light(
        name="sun", type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL, mode=mujoco.mjtCamLight.mjCAMLIGHT_TRACK,
        pos=[-1.0, -1.0, 5.0], dir=[0.15, 0.15, -1], castshadow=True, diffuse=[0.42] * 3, specular=[0.15] * 3,
    )  # fmt: skip


def _add_rotorcraft(body: mujoco.MjsBody, vehicle: Vehicle, colour: tuple[float, ...]) -> None:
    """Draw hull, arms and rotor discs; the front ones in the drone's colour."""
    arm = vehicle.arm
    dark = [0.13, 0.13, 0.15, 1]
    pale = [0.30, 0.32, 0.36, 0.55]
    plain = {"contype": 0, "conaffinity": 0, "group": VISUAL_GROUP, "mass": 0}
    hull = np.array([0.50, 0.36, 0.26]) * arm
    body.add_geom(type=_GEOM.mjGEOM_ELLIPSOID, size=hull, rgba=colour, **plain)
    for position in vehicle.rotor_positions:
        tip = position + [0, 0, 0.22 * arm]
        disc = [0.62 * arm, 0.02 * arm, 0]
        thick = [0.08 * arm, 0, 0]
        body.add_geom(type=_GEOM.mjGEOM_CAPSULE, fromto=[0, 0, 0, *position], size=thick, rgba=dark, **plain)
        body.add_geom(type=_GEOM.mjGEOM_CYLINDER, fromto=[*position, *tip], size=thick, rgba=dark, **plain)
        tint = [*colour[:3], 0.75] if position[0] > 0 else pale
        body.add_geom(type=_GEOM.mjGEOM_CYLINDER, pos=tip, size=disc, rgba=tint, **plain)


def _add_target(spec: mujoco.MjSpec, system: System, margin: float, form: dict[str, Any]) -> None:
    """Add the target: a translucent payload with firm edges, a little larger, so that one that has arrived fits in.

    Args:
        spec, system: of the scene.
        margin: by which it is larger on every side [m].
        form: type, size and place of its geom, `margin` included; a point has a form of its own.
    """
    # Below the ground until the first picture puts it where the goal is.
    body = spec.worldbody.add_body(name="target", mocap=True, pos=[0, 0, -10])
    plain = {"contype": 0, "conaffinity": 0, "group": VISUAL_GROUP}
    faint = [0.0, 0.75, 0.35, 0.18]
    firm = [0.0, 0.60, 0.25, 1]
    center = system.payload_center
    half = system.payload_size / 2 + margin
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
    # Corners that differ along one axis alone are the ends of an edge.
    return [(a, b) for a, b in combinations(corners, 2) if np.count_nonzero(a != b) == 1]


def _rims(half: np.ndarray, count: int = 24) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the ends of the sides of two polygons, the rims of an upright cylinder."""
    angle = np.linspace(0, 2 * np.pi, count + 1)
    rims = [half * np.stack([np.cos(angle), np.sin(angle), np.full(count + 1, side)], axis=1) for side in (-1.0, 1.0)]
    return [(a, b) for rim in rims for a, b in zip(rim[:-1], rim[1:], strict=True)]
