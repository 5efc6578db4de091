"""From a configuration to the physical system it describes, refused in one sentence if impossible."""

from __future__ import annotations

import numpy as np

from multilift_marl.config.schema import RandomizationConfig, SystemConfig
from multilift_marl.errors import ConfigError
from multilift_marl.rig.feasibility import check_possible, check_resolved
from multilift_marl.rig.payload import (
    check_body,
    find_mesh,
    formation_forces,
    mean,
    per_drone,
    place_anchors,
    standard_length,
    uniform_inertia,
    vector_per_drone,
)
from multilift_marl.rig.system import System, resting_rotations
from multilift_marl.rig.vehicles import GRAVITY, PRESETS, resolve_vehicles

_BENDING_DECAY = 90.0  # [1/s] of the default damping of bending, over a node's mass times the square of a link
MIN_SEPARATION = 0.35  # [m] between the centres of two falcons; scales with the mean span
_FALCON = PRESETS["falcon"]


def resolve_system(config: SystemConfig) -> System:
    """Return the system of `config`.

    Raises:
        ConfigError: it cannot exist or cannot fly; the message says why and what to change.
    """
    n, payload, cable = config.env.num_drones, config.payload, config.cable
    vehicles = resolve_vehicles(config.vehicle, n)
    spans = np.array([vehicle.span for vehicle in vehicles])
    scale = mean(list(spans)) / _FALCON.span
    length = per_drone(standard_length(config, scale) if cable.length is None else cable.length, n, "cable.length")
    mesh = find_mesh(payload)
    anchors, size = place_anchors(config, n, length, scale, mesh)
    uniform = np.zeros(3) if mesh is None else mesh.center_of_mass - mesh.middle
    center_of_mass = uniform if payload.center_of_mass is None else np.array(payload.center_of_mass)
    check_body(payload.shape, size, center_of_mass, anchors)
    anchors = anchors - center_of_mass
    spare = np.array([vehicle.spare_lift for vehicle in vehicles])
    standard = 0.35 * n * mean(list(spare / _FALCON.spare_lift))
    mass = payload.mass if payload.mass is not None else standard
    axes = np.array([1.0, 0.0, 0.0, 0.0])
    if payload.inertia is not None:
        inertia = np.array(payload.inertia)
    elif mesh is not None:
        inertia, axes = mass * mesh.inertia, mesh.axes
    else:
        inertia = uniform_inertia(payload.shape, mass, size)
    if 2 * inertia.max() > inertia.sum() * (1 + 1e-9):
        raise ConfigError(
            f"payload.inertia {inertia.tolist()} is impossible: no moment may exceed the sum of the other two"
        )
    stiffness = per_drone(cable.stiffness, n, "cable.stiffness")
    point, angle = payload.shape == "point", np.deg2rad(cable.angle)
    force = formation_forces(anchors, mass * GRAVITY, angle, point, spare / mean(list(spare)))
    massless = cable.model == "massless"
    segments = per_drone(1 if massless else cable.segments, n, "cable.segments").astype(int)
    cable_mass = np.zeros(n) if massless else per_drone(cable.density, n, "cable.density") * length
    ends = anchors.copy()
    for i, links in enumerate(segments):
        forces = _segment_forces(force[i], cable_mass[i], links)
        tension = np.linalg.norm(forces, axis=1)
        reach = length[i] / links + tension / (links * stiffness[i])
        ends[i] += (forces / tension[:, None] * reach[:, None]).sum(axis=0)
    bending_damping = _BENDING_DECAY * cable_mass / np.maximum(segments - 1, 1) * (length / segments) ** 2
    if cable.bending_damping is not None:
        bending_damping = np.full(n, cable.bending_damping)
    hooks = vector_per_drone(cable.hook, n, "cable.hook")
    heading = _azimuth(ends) if config.control.heading == "outward" else np.zeros(n)
    resting = resting_rotations(vehicles, force + GRAVITY * cable_mass[:, None] * [0, 0, 1], heading)
    slots = ends - (resting * hooks[:, None, :]).sum(axis=-1)
    system = System(
        vehicles=vehicles,
        payload_shape=payload.shape,
        payload_mesh=mesh,
        payload_size=size,
        payload_center=-center_of_mass,
        payload_mass=mass,
        payload_inertia=inertia,
        payload_axes=axes,
        payload_drag_area=payload.drag_area,
        anchors=anchors,
        cable_model=cable.model,
        cable_length=length,
        cable_stiffness=stiffness,
        cable_damping=per_drone(cable.damping, n, "cable.damping"),
        breaking_load=per_drone(
            np.inf if cable.breaking_load is None else cable.breaking_load, n, "cable.breaking_load"
        ),
        cable_segments=segments,
        cable_mass=cable_mass,
        bending_stiffness=np.full(n, cable.bending_stiffness),
        bending_damping=bending_damping,
        formation_force=force,
        hooks=hooks,
        cable_ends=ends,
        slots=slots,
        slot_azimuth=_azimuth(slots),
        heading=heading,
        min_separation=MIN_SEPARATION * ((spans[:, None] + spans) / 2 / _FALCON.span),
        wind=np.asarray(config.wind.velocity, float),
        air=config.wind,
        push=config.push,
        timestep=config.sim.timestep,
        control_interval=whole_ratio(
            1 / config.sim.timestep, config.sim.control_hz, "sim.control_hz", "1/sim.timestep"
        ),
        varied=frozenset(key for key, value in config.randomization if np.any(value)),
    )
    _check_ranges(config.randomization, system)
    check_possible(system, config.randomization)
    check_resolved(config, system)
    return system


def _azimuth(places: np.ndarray) -> np.ndarray:
    """Return the directions (N,) [rad] of level places (N, 3) [m] from the origin; 0 of one in its middle."""
    centred = np.hypot(places[:, 0], places[:, 1]) < 1e-9
    return np.where(centred, 0.0, np.arctan2(places[:, 1], places[:, 0]))


def _segment_forces(force: np.ndarray, mass: float, segments: int) -> np.ndarray:
    """Return the forces (segments, 3) [N] in a cable of `mass` [kg] that holds the payload by `force` (3,) [N].

    Its mass is that of the nodes between segments, so each segment carries one node's weight more than that below it.
    """
    return force + GRAVITY * mass / max(segments - 1, 1) * np.arange(segments)[:, None] * [0, 0, 1]


def _check_ranges(ranges: RandomizationConfig, system: System) -> None:
    """Refuse to vary what the system has not, and delays in the wrong order."""
    if system.payload_shape == "point":
        for key in ("payload_inertia", "payload_center_of_mass"):
            if np.any(getattr(ranges, key)):
                raise ConfigError(f"randomization.{key} needs a payload with extent, not a point; set it to 0")
    for key in ("action_delay", "observation_delay"):
        low, high = getattr(ranges, key)
        if low > high:
            raise ConfigError(f"randomization.{key}={[low, high]} must list the shorter delay first")


def whole_ratio(fast: float, slow: float, slow_key: str, fast_key: str) -> int:
    """Return fast/slow, two rates, as a whole number; the keys name them in the ConfigError if it is none."""
    ratio = round(fast / slow)
    if ratio < 1 or abs(fast / slow - ratio) > 1e-6:
        raise ConfigError(f"{slow_key}={slow:g} must divide {fast_key}={fast:g} into whole steps")
    return ratio
