"""From a configuration to the physical system it describes, refused in one sentence if impossible."""

from __future__ import annotations

import numpy as np

from multilift_marl.errors import ConfigError, RigError
from multilift_marl.physical import GRAVITY
from multilift_marl.rig import plausible
from multilift_marl.rig.balance import formation_forces, nominal_forces
from multilift_marl.rig.feasibility import check_possible, check_resolved
from multilift_marl.rig.obstacles import resolve_scenery
from multilift_marl.rig.payload import (
    check_body,
    find_mesh,
    find_origin,
    mean,
    per_drone,
    place_anchors,
    standard_length,
    uniform_inertia,
    vector_per_drone,
)
from multilift_marl.rig.presets import PRESETS
from multilift_marl.rig.separation import check_separation
from multilift_marl.rig.system import System, resting_rotations
from multilift_marl.rig.vehicles import resolve_vehicles
from multilift_marl.schema.sections import RandomizationConfig, SystemConfig

_BENDING_DECAY = 90.0  # [1/s] of the default damping of bending, over a node's mass times the square of a link
MIN_SEPARATION = 0.35  # [m] between the centres of two falcons; scales with the mean span
_FALCON = PRESETS["falcon"]


def resolve_system(config: SystemConfig) -> System:
    """Return the system of `config`.

    Raises:
        ConfigError: it cannot exist or cannot fly; the message says why and what to change.
    """
    system = build_system(config)
    spans = np.array([vehicle.span for vehicle in system.vehicles])
    plausible.warn_of_cables(system.cable_length, spans, config.cable.angle)
    _check_ranges(config.randomization, system)
    check_possible(system, config.randomization)
    check_separation(config, system, build_system, _check_flight)
    check_resolved(config, system)
    return system


def draft_system(config: SystemConfig) -> tuple[System, RigError]:
    """Return a system that cannot be, for pictures of it, with the complaint of `resolve_system`.

    Where it can only be put together so far, forces do not balance and anchors hang in the air. The complaint names
    parts that conflict, none where it is of the whole.

    Raises:
        ConfigError: not even a picture of it can be made.
        ValueError: the system can be.
    """
    try:
        resolve_system(config)
    except ConfigError as error:
        conflict = error if isinstance(error, RigError) else RigError(str(error))
        return build_system(config, draft=True), conflict
    raise ValueError("this system can be")


def build_system(config: SystemConfig, draft: bool = False) -> System:
    """Return the system of `config`, that it can fly not checked.

    Args:
        config: of the system.
        draft: whether anchors may be off the payload, and cables may leave it unbalanced.

    Raises:
        ConfigError: its numbers do not go together.
    """
    n, payload, cable = config.env.num_drones, config.payload, config.cable
    vehicles = resolve_vehicles(config.vehicle, n)
    spans = np.array([vehicle.span for vehicle in vehicles])
    scale = mean(list(spans)) / _FALCON.span
    per_drone(cable.angle, n, "cable.angle")  # before they size the standard rig
    length = per_drone(standard_length(config, scale) if cable.length is None else cable.length, n, "cable.length")
    mesh = find_mesh(payload)
    # 2. The payload. Anchors come from its geometric centre; from here on the origin of its frame is its centre of
    # mass.
    anchors, size = place_anchors(config, n, length, scale, mesh)
    uniform = np.zeros(3) if mesh is None else mesh.center_of_mass - mesh.middle
    given = payload.center_of_mass
    center_of_mass = uniform if given is None else np.array(given) - find_origin(payload, mesh)
    if not draft:
        check_body(payload.shape, size, center_of_mass, anchors)
    anchors = anchors - center_of_mass
    spare = np.array([vehicle.spare_lift for vehicle in vehicles])
    # 0.35 kg for each falcon.
    standard = 0.35 * n * mean(list(spare / _FALCON.spare_lift))
    mass = payload.mass if payload.mass is not None else standard
    # Quaternion (w, x, y, z) from the payload's frame to its principal axes; `inertia` are the moments about these.
    axes = np.array([1.0, 0.0, 0.0, 0.0])
    if payload.inertia is not None:
        inertia = np.array(payload.inertia)
    elif mesh is not None:
        inertia, axes = mass * mesh.inertia, mesh.axes
    else:
        inertia = uniform_inertia(payload.shape, mass, size)
    # J_x + J_y ≥ J_z of any mass distribution, equal for a flat one: round-off must not refuse a plate.
    if 2 * inertia.max() > inertia.sum() * (1 + 1e-9):
        raise ConfigError(
            f"payload.inertia {inertia.tolist()} is impossible: no moment may exceed the sum of the other two"
        )
    if payload.shape != "point":
        given_size = payload.size is not None or mesh is not None
        plausible.check_payload(mass, size, inertia, mesh, given_size, length.max() + spans.max())
    stiffness = per_drone(cable.stiffness, n, "cable.stiffness")
    point, angle = payload.shape == "point", np.deg2rad(cable.angle)
    azimuth = None if cable.azimuth is None else np.deg2rad(per_drone(cable.azimuth, n, "cable.azimuth"))
    strength = spare / mean(list(spare))
    try:
        force = formation_forces(anchors, mass * GRAVITY, angle, point, strength, azimuth)
    except RigError:
        if not draft:
            raise
        force = nominal_forces(anchors, mass * GRAVITY / n * strength, angle, azimuth)
    massless = cable.model == "massless"
    segments = per_drone(1 if massless else cable.segments, n, "cable.segments").astype(int)
    cable_mass = np.zeros(n) if massless else per_drone(cable.density, n, "cable.density") * length
    ends = anchors.copy()
    for i, links in enumerate(segments):
        forces = _segment_forces(force[i], cable_mass[i], links)
        tension = np.linalg.norm(forces, axis=1)
        # Stiffness is of the whole cable: of n segments in series each has n k.
        reach = length[i] / links + tension / (links * stiffness[i])
        ends[i] += (forces / tension[:, None] * reach[:, None]).sum(axis=0)
    # β in proportion to m_node l²: a bend then loses its speed at the same rate in any cable, however finely cut.
    bending_damping = _BENDING_DECAY * cable_mass / np.maximum(segments - 1, 1) * (length / segments) ** 2
    if cable.bending_damping is not None:
        bending_damping = np.full(n, cable.bending_damping)
    # 4. Drones. They thrust along what they carry, so a hook that is off the centre of mass turns with them: the tilt
    # has to be found before the slot, which is the end of the cable less the turned hook.
    hooks = vector_per_drone(cable.hook, n, "cable.hook")
    heading = _azimuth(ends) if config.control.heading == "outward" else np.zeros(n)
    # A drone holds its cable's weight as well; its own is added there.
    resting = resting_rotations(vehicles, force + GRAVITY * cable_mass[:, None] * [0, 0, 1], heading)
    slots = ends - (resting * hooks[:, None, :]).sum(axis=-1)
    return System(
        vehicles=vehicles,
        payload_shape=payload.shape,
        payload_mesh=mesh,
        payload_size=size,
        # Of the geometric centre, in the frame whose origin is the centre of mass.
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
        contact=config.contact,
        scenery=resolve_scenery(config.scene),
        timestep=config.sim.timestep,
        control_interval=whole_ratio(
            1 / config.sim.timestep, config.sim.control_hz, "sim.control_hz", "1/sim.timestep"
        ),
        varied=frozenset(key for key, value in config.randomization if np.any(value)),
    )


def _check_flight(config: SystemConfig, system: System) -> None:
    """Refuse what cannot fly, or cannot be simulated, but for drones that rest too close."""
    _check_ranges(config.randomization, system)
    check_possible(system, config.randomization)
    check_resolved(config, system)


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
