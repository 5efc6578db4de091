"""From a system to a MuJoCo model. The order of bodies in MuJoCo's arrays is decided here."""

from __future__ import annotations

from typing import Any, NamedTuple

import mujoco
import numpy as np

from multilift_marl.rig.mesh import add_mesh
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.cables import IMPEDANCE, limit_solref
from multilift_marl.sim.contact import add_contact, drone_half_size
from multilift_marl.sim.visuals import (
    DRONE_COLOURS,
    PAYLOAD_COLOUR,
    add_light,
    add_rotorcraft,
    add_surroundings,
    add_target,
)

_GEOM, _OBJECT = mujoco.mjtGeom, mujoco.mjtObj


class Layout(NamedTuple):
    """Where the bodies stand in MuJoCo's arrays: the payload first, then the drones, each a free joint.

    A point payload has three slide joints in place of its free joint. Chains are no part of the model.
    """

    payload_nq: int
    """Coordinates of the payload: 7, or 3 for a point."""
    payload_nv: int
    """Velocities of the payload: 6, or 3 for a point."""
    payload_body: int
    """Index of the payload among bodies."""
    drone_bodies: tuple[int, ...]
    """Indices of the drones among bodies."""


def build_spec(system: System, visuals: bool = False) -> mujoco.MjSpec:
    """Return the model's specification.

    Args:
        system: what to build.
        visuals: add rotors, sky, light and the translucent target (a mocap body); physics is the same without.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "multilift"
    set_options(spec, system.timestep)
    # cables are limits of tendons or act as loads: there are no springs and dampers to look for
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER
    _add_world(spec, visuals)
    _add_payload(spec, system)
    for i in range(system.num_drones):
        body = spec.worldbody.add_body(name=f"drone_{i}", pos=system.slots[i] + [0, 0, 1.5])
        body.add_freejoint(name=f"drone_{i}")
        _add_drone(body, system, i, visuals)
        if system.cable_model == "massless":
            _add_cable(spec, system, i)
    add_contact(spec, system.num_drones)
    if visuals:
        add_light(spec.body("payload"))
        margin = 0.04 * system.payload_size.min()
        add_target(spec, system, margin, _payload_form(system, margin))
    return spec


def set_options(spec: mujoco.MjSpec, timestep: float) -> None:
    """Set integrator, gravity, flags, solver and Jacobian."""
    option, disable = spec.option, mujoco.mjtDisableBit
    option.timestep, option.gravity = timestep, [0, 0, -GRAVITY]
    option.integrator = mujoco.mjtIntegrator.mjINT_DISCRETE
    option.solver, option.tolerance, option.iterations = mujoco.mjtSolver.mjSOL_CG, 1e-18, 300
    option.jacobian = mujoco.mjtJacobian.mjJAC_DENSE
    option.disableflags |= disable.mjDSBL_REFSAFE | disable.mjDSBL_AUTORESET | disable.mjDSBL_ISLAND


def build_model(system: System, visuals: bool = False) -> tuple[mujoco.MjModel, Layout]:
    """Return the compiled model and where its parts stand."""
    model = build_spec(system, visuals).compile()
    if system.cable_model == "massless":
        model.tendon_solref_lim[:] = limit_solref(system.cable_stiffness, system.cable_damping, model.tendon_invweight0)
    point = system.payload_shape == "point"
    drones = tuple(model.body(f"drone_{i}").id for i in range(system.num_drones))
    return model, Layout(3 if point else 7, 3 if point else 6, model.body("payload").id, drones)


def _add_world(spec: mujoco.MjSpec, visuals: bool) -> None:
    world = spec.worldbody
    floor = world.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[0, 0, 0.05])
    for name, pos, forward in (("side", [0.0, -5.2, 3.4], [0, 1, -0.3]), ("top", [0.0, 0.0, 8.0], [0, 1e-3, -1])):
        forward = np.asarray(forward, float) / np.linalg.norm(forward)
        right = np.cross(forward, [0, 0, 1])
        right /= np.linalg.norm(right)
        up = np.cross(right, forward)
        quat = np.zeros(4)
        mujoco.mju_mat2Quat(quat, np.stack([right, up, -forward], axis=1).ravel())
        world.add_camera(name=name, pos=pos, quat=quat, fovy=45)
    if visuals:
        add_surroundings(spec, floor)


def _add_payload(spec: mujoco.MjSpec, system: System) -> None:
    point = system.payload_shape == "point"  # its slide joints count from the body's place, so that must be the origin
    body = spec.worldbody.add_body(name="payload", pos=[0, 0, 0 if point else 1.5])
    body.mass, body.explicitinertial = system.payload_mass, True
    body.inertia, body.ipos, body.iquat = system.payload_inertia, [0, 0, 0], system.payload_axes
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
            add_mesh(spec, "payload", system.payload_mesh.path, system.payload_mesh.scale)
        body.add_geom(name="payload", **_payload_form(system), rgba=colour)
    for i, anchor in enumerate(system.anchors):
        body.add_site(name=f"payload/anchor_{i}", pos=anchor, size=[0.012, 0, 0], rgba=[0.2, 0.2, 0.2, 1])


def _payload_form(system: System, margin: float = 0.0) -> dict[str, Any]:
    """Return type, size and place of the geom of a payload with extent, `margin` [m] larger on every side.

    A mesh has no margin; it collides as its convex hull.
    """
    half, pos, mesh = system.payload_size / 2 + margin, system.payload_center, system.payload_mesh
    if mesh is not None:
        return {"type": _GEOM.mjGEOM_MESH, "meshname": "payload", "pos": pos - mesh.middle}
    if system.payload_shape == "cylinder":
        return {"type": _GEOM.mjGEOM_CYLINDER, "size": [half[0], half[2], 0], "pos": pos}
    return {"type": _GEOM.mjGEOM_BOX, "size": half, "pos": pos}


def _add_drone(body: mujoco.MjsBody, system: System, i: int, visuals: bool) -> None:
    vehicle, name = system.vehicles[i], f"drone_{i}"
    body.mass, body.explicitinertial = vehicle.mass, True
    body.inertia, body.ipos = vehicle.inertia, [0, 0, 0]
    colour = DRONE_COLOURS[i % len(DRONE_COLOURS)]
    body.add_geom(
        name=name, type=_GEOM.mjGEOM_BOX, size=drone_half_size(vehicle),
        rgba=[*colour[:3], 0.0 if visuals else 1.0],
    )  # fmt: skip
    body.add_site(name=f"{name}/hook", pos=system.hooks[i], size=[0.008, 0, 0], rgba=[0.2, 0.2, 0.2, 1])
    for r, position in enumerate(vehicle.rotor_positions):
        body.add_site(name=f"{name}/rotor_{r}", pos=position, size=[0.008, 0, 0], group=4)
    if visuals:
        add_rotorcraft(body, vehicle, colour)


def _add_cable(spec: mujoco.MjSpec, system: System, i: int) -> None:
    cable = spec.add_tendon(name=f"cable_{i}", limited=True, range=[0, system.cable_length[i]])
    cable.wrap_site(f"drone_{i}/hook")
    cable.wrap_site(f"payload/anchor_{i}")
    cable.solimp_limit = [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2]
    cable.width, cable.rgba = 0.006, [0.08, 0.08, 0.1, 1]
    spec.add_sensor(
        name=f"cable_{i}/tension", type=mujoco.mjtSensor.mjSENS_TENDONLIMITFRC,
        objtype=_OBJECT.mjOBJ_TENDON, objname=f"cable_{i}",
    )  # fmt: skip
