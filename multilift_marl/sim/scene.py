"""From a system to a MuJoCo model. Only this file knows how bodies, cables and sensors are laid out in MuJoCo's arrays."""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np

from multilift_marl.config.system import GRAVITY, System
from multilift_marl.sim.cables import IMPEDANCE, limit_solref

_GEOM, _OBJECT = mujoco.mjtGeom, mujoco.mjtObj
_VISUAL_GROUP = 2
DRONE_COLOURS = ((0.12, 0.47, 0.71, 1), (0.84, 0.37, 0.0, 1), (0.17, 0.63, 0.17, 1), (0.58, 0.40, 0.74, 1))


class Layout(NamedTuple):
    """Where the bodies stand in MuJoCo's arrays: the payload first, then the drones, each a free joint.

    A point payload has three slide joints in place of its free joint.
    """

    payload_nq: int
    """Coordinates of the payload: 7, or 3 for a point."""
    payload_nv: int
    """Velocities of the payload: 6, or 3 for a point."""
    payload_body: int
    """Index of the payload among bodies."""


def build_spec(system: System, visuals: bool = False) -> mujoco.MjSpec:
    """Return the model's specification.

    Args:
        system: what to build.
        visuals: add rotors, arms, a sky and the translucent target (a mocap body); physics is the same without.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "multilift"
    option = spec.option
    option.timestep, option.gravity = system.timestep, [0, 0, -GRAVITY]
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    disable = mujoco.mjtDisableBit
    option.disableflags |= disable.mjDSBL_REFSAFE | disable.mjDSBL_AUTORESET | disable.mjDSBL_ISLAND
    _add_world(spec, visuals)
    _add_payload(spec, system)
    for i in range(system.num_drones):
        _add_drone(spec, system, i, visuals)
        _add_cable(spec, system, i)
    if visuals:
        _add_target(spec, system)
    return spec


def build_model(system: System, visuals: bool = False) -> tuple[mujoco.MjModel, Layout]:
    """Return the compiled model and where its parts stand."""
    model = build_spec(system, visuals).compile()
    model.tendon_solref_lim[:] = limit_solref(system.cable_stiffness, system.cable_damping, model.tendon_invweight0)
    point = system.payload_shape == "point"
    return model, Layout(3 if point else 7, 3 if point else 6, model.body("payload").id)


def _add_world(spec: mujoco.MjSpec, visuals: bool) -> None:
    world = spec.worldbody
    floor = world.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[0, 0, 0.05])
    for name, pos, forward in (("side", [0.0, -5.2, 2.5], [0, 1, -0.12]), ("top", [0.0, 0.0, 8.0], [0, 1e-3, -1])):
        forward = np.asarray(forward, float) / np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.stack([right, up, -forward], axis=1).ravel())
        world.add_camera(name=name, pos=pos, quat=quat, fovy=45)
    if not visuals:
        return
    spec.visual.global_.offwidth, spec.visual.global_.offheight = 1920, 1080
    spec.visual.headlight.ambient, spec.visual.headlight.diffuse = [0.45] * 3, [0.45] * 3
    spec.visual.headlight.specular = [0.1] * 3
    spec.visual.quality.shadowsize = 4096
    texture = mujoco.mjtTexture
    builtin = mujoco.mjtBuiltin
    spec.add_texture(
        name="sky", type=texture.mjTEXTURE_SKYBOX, builtin=builtin.mjBUILTIN_GRADIENT,
        rgb1=[0.93, 0.96, 1.0], rgb2=[0.62, 0.74, 0.88], width=64, height=384,
    )  # fmt: skip
    spec.add_texture(
        name="grid", type=texture.mjTEXTURE_2D, builtin=builtin.mjBUILTIN_CHECKER, mark=mujoco.mjtMark.mjMARK_EDGE,
        rgb1=[0.80, 0.82, 0.84], rgb2=[0.76, 0.78, 0.80], markrgb=[0.9, 0.9, 0.9], width=256, height=256,
    )  # fmt: skip
    material = spec.add_material(name="grid", texrepeat=[1, 1], texuniform=True, reflectance=0.03)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "grid"
    floor.material = "grid"
    world.add_light(pos=[1, -2, 8], dir=[-0.1, 0.25, -1], castshadow=True, diffuse=[0.5] * 3, specular=[0.1] * 3)


def _add_payload(spec: mujoco.MjSpec, system: System) -> None:
    point = system.payload_shape == "point"  # its slide joints count from the body's place, so that must be the origin
    body = spec.worldbody.add_body(name="payload", pos=[0, 0, 0 if point else 1.5])
    body.mass, body.explicitinertial = system.payload_mass, True
    body.inertia, body.ipos = system.payload_inertia, [0, 0, 0]
    colour = [0.86, 0.66, 0.35, 1]
    if point:
        for name, axis in zip("xyz", np.eye(3), strict=True):
            body.add_joint(name=f"payload/{name}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        body.add_geom(name="payload", type=_GEOM.mjGEOM_SPHERE, size=[system.payload_size[0] / 2, 0, 0], rgba=colour)
    else:
        body.add_freejoint(name="payload")
        body.add_geom(name="payload", type=_GEOM.mjGEOM_BOX, size=system.payload_size / 2, rgba=colour)
    for i, anchor in enumerate(system.anchors):
        body.add_site(name=f"payload/anchor_{i}", pos=anchor, size=[0.012, 0, 0], rgba=[0.2, 0.2, 0.2, 1])


def _add_drone(spec: mujoco.MjSpec, system: System, i: int, visuals: bool) -> None:
    vehicle, name = system.vehicle, f"drone_{i}"
    body = spec.worldbody.add_body(name=name, pos=system.slots[i] + [0, 0, 1.5])
    body.add_freejoint(name=name)
    body.mass, body.explicitinertial = vehicle.mass, True
    body.inertia, body.ipos = vehicle.inertia, [0, 0, 0]
    colour = DRONE_COLOURS[i % len(DRONE_COLOURS)]
    half = 0.7 * vehicle.arm
    body.add_geom(
        name=name, type=_GEOM.mjGEOM_BOX, size=[half, half, drone_half_height(system)],
        rgba=[*colour[:3], 0.0 if visuals else 1.0],
    )  # fmt: skip
    body.add_site(name=f"{name}/hook", pos=[0, 0, 0], size=[0.008, 0, 0], rgba=[0.2, 0.2, 0.2, 1])
    for r, position in enumerate(vehicle.rotor_positions):
        body.add_site(name=f"{name}/rotor_{r}", pos=position, size=[0.008, 0, 0], group=4)
    if not visuals:
        return
    plain = {"contype": 0, "conaffinity": 0, "group": _VISUAL_GROUP, "mass": 0}
    thick = 0.07 * vehicle.arm
    body.add_geom(type=_GEOM.mjGEOM_ELLIPSOID, size=[0.45 * vehicle.arm, 0.34 * vehicle.arm, 0.24 * vehicle.arm], rgba=colour, **plain)
    for r, position in enumerate(vehicle.rotor_positions):
        tip = position + [0, 0, 0.25 * vehicle.arm]
        body.add_geom(type=_GEOM.mjGEOM_CAPSULE, fromto=[0, 0, 0, *position], size=[thick, 0, 0], rgba=[0.15, 0.15, 0.17, 1], **plain)
        body.add_geom(type=_GEOM.mjGEOM_CYLINDER, fromto=[*position, *tip], size=[thick, 0, 0], rgba=[0.15, 0.15, 0.17, 1], **plain)
        front = [0.85, 0.2, 0.2, 0.55] if position[0] > 0 else [0.25, 0.25, 0.3, 0.45]
        body.add_geom(
            type=_GEOM.mjGEOM_CYLINDER, pos=tip, size=[0.6 * vehicle.arm, 0.02 * vehicle.arm, 0], rgba=front, **plain
        )


def drone_half_height(system: System) -> float:
    """Return half the height of a drone's collision box [m]."""
    return 0.3 * system.vehicle.arm


def _add_cable(spec: mujoco.MjSpec, system: System, i: int) -> None:
    cable = spec.add_tendon(name=f"cable_{i}", limited=True, range=[0, system.cable_length[i]])
    cable.wrap_site(f"drone_{i}/hook")
    cable.wrap_site(f"payload/anchor_{i}")
    cable.solimp_limit = [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2]
    cable.width, cable.rgba = 0.004, [0.1, 0.1, 0.1, 1]
    spec.add_sensor(
        name=f"cable_{i}/tension", type=mujoco.mjtSensor.mjSENS_TENDONLIMITFRC,
        objtype=_OBJECT.mjOBJ_TENDON, objname=f"cable_{i}",
    )  # fmt: skip


def _add_target(spec: mujoco.MjSpec, system: System) -> None:
    body = spec.worldbody.add_body(name="target", mocap=True, pos=[0, 0, -10])
    plain = {"contype": 0, "conaffinity": 0, "group": _VISUAL_GROUP, "rgba": [0.1, 0.75, 0.35, 0.28]}
    if system.payload_shape == "point":
        body.add_geom(type=_GEOM.mjGEOM_SPHERE, size=[system.payload_size[0] / 2, 0, 0], **plain)
    else:
        body.add_geom(type=_GEOM.mjGEOM_BOX, size=system.payload_size / 2, **plain)
