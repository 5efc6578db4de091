"""From a configuration to the physical system it describes, in numbers, refused in one sentence if impossible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.config.mesh import Mesh
from multilift_marl.config.rig import (
    check_body,
    find_mesh,
    formation_forces,
    per_drone,
    place_anchors,
    standard_length,
    uniform_inertia,
)
from multilift_marl.config.vehicles import GRAVITY, PRESETS, Vehicle, check_rotors, resolve_vehicle
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import quat_to_mat

if TYPE_CHECKING:
    from multilift_marl.config.schema import Config, WindConfig

MIN_THRUST_TO_WEIGHT = 1.18
MIN_SEPARATION = 0.35  # [m] between the centres of two falcons; scales with the vehicle's span
_FALCON = PRESETS["falcon"]


@dataclass(frozen=True, eq=False)
class System:
    """Drones, cables and payload in numbers (SI units; N drones).

    Attributes:
        vehicle: the quadrotor, the same for all drones.
        payload_shape: "box", "cylinder", "mesh" or "point".
        payload_mesh: of a "mesh", else None.
        payload_size: edges of the payload's bounding box (3,) [m].
        payload_center: its geometric centre from its centre of mass, in its frame (3,) [m].
        payload_mass: nominal mass [kg].
        payload_inertia: nominal principal moments about the centre of mass (3,) [kg m²].
        payload_axes: quaternion of the principal axes in its frame (4,).
        payload_drag_area: C_d A [m²].
        anchors: attachment of each cable from the payload's centre of mass, in its frame (N, 3) [m].
        cable_model: "massless" or "chain".
        cable_length, cable_stiffness, cable_damping: (N,) [m], [N/m], [N s/m].
        breaking_load: tension that breaks each cable (N,) [N]; infinite if none does.
        cable_segments: links of each cable (N,); 1 if massless.
        cable_mass: (N,) [kg]; 0 if massless.
        bending_stiffness, bending_damping: between the links of a chain (N,) [N m/rad], [N m s/rad].
        formation_force: pull of each cable on the resting payload, in the payload frame (N, 3) [N].
        slots: resting drones in the payload frame, cables stretched and sagging as they hang (N, 3) [m].
        slot_azimuth: direction of each slot from the payload, in its horizontal plane (N,) [rad].
        min_separation: distance between drones that counts as a collision [m].
        wind: mean wind (3,) [m/s].
        air: what else the air does.
        timestep: physics step [s].
        control_interval: physics steps for each control step.
    """

    vehicle: Vehicle
    payload_shape: str
    payload_mesh: Mesh | None
    payload_size: np.ndarray
    payload_center: np.ndarray
    payload_mass: float
    payload_inertia: np.ndarray
    payload_axes: np.ndarray
    payload_drag_area: float
    anchors: np.ndarray
    cable_model: str
    cable_length: np.ndarray
    cable_stiffness: np.ndarray
    cable_damping: np.ndarray
    breaking_load: np.ndarray
    cable_segments: np.ndarray
    cable_mass: np.ndarray
    bending_stiffness: np.ndarray
    bending_damping: np.ndarray
    formation_force: np.ndarray
    slots: np.ndarray
    slot_azimuth: np.ndarray
    min_separation: float
    wind: np.ndarray
    air: WindConfig
    timestep: float
    control_interval: int

    @property
    def num_drones(self) -> int:
        """Drones in the team, N."""
        return len(self.anchors)

    @property
    def weight(self) -> float:
        """Weight of payload, drones and cables [N]."""
        return GRAVITY * (self.payload_mass + self.num_drones * self.vehicle.mass + self.cable_mass.sum())

    @property
    def drone_pull(self) -> np.ndarray:
        """Pull of each resting drone on its cable, which is the payload's share and the cable's weight (N, 3) [N]."""
        return self.formation_force + GRAVITY * self.cable_mass[:, None] * [0, 0, 1]

    @property
    def resting_tension(self) -> np.ndarray:
        """Tension of each resting cable where it is measured, in its segment next to the drone (N,) [N]."""
        last = self.cable_mass * (1 - 1 / self.cable_segments)
        return np.linalg.norm(self.formation_force + GRAVITY * last[:, None] * [0, 0, 1], axis=1)

    @property
    def inertia_matrix(self) -> tuple[float, ...]:
        """Return the payload's nominal inertia about its centre of mass, in its frame, row by row (9,) [kg m²]."""
        axes = np.reshape(quat_to_mat(*(float(q) for q in self.payload_axes)), (3, 3))
        return tuple(float(moment) for moment in ((axes * self.payload_inertia) @ axes.T).ravel())


def resolve_system(config: Config) -> System:
    """Return the system of `config`.

    Raises:
        ConfigError: it cannot exist or cannot fly; the message says why and what to change.
    """
    n, payload, cable = config.env.num_drones, config.payload, config.cable
    vehicle = resolve_vehicle(config.vehicle)
    scale = vehicle.span / _FALCON.span
    length = per_drone(standard_length(config, scale) if cable.length is None else cable.length, n, "cable.length")
    mesh = find_mesh(payload)
    anchors, size = place_anchors(config, n, length, scale, mesh)
    uniform = np.zeros(3) if mesh is None else mesh.center_of_mass - mesh.middle
    center_of_mass = uniform if payload.center_of_mass is None else np.array(payload.center_of_mass)
    check_body(payload.shape, size, center_of_mass, anchors)
    anchors = anchors - center_of_mass
    standard = 0.35 * n * (vehicle.spare_lift / _FALCON.spare_lift)
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
    force = formation_forces(anchors, mass * GRAVITY, np.deg2rad(cable.angle), payload.shape == "point")
    chain = cable.model == "chain"
    segments = per_drone(cable.segments if chain else 1, n, "cable.segments").astype(int)
    rope = per_drone(cable.density, n, "cable.density") * length if chain else np.zeros(n)
    slots, bending = anchors.copy(), np.zeros(n)
    for i, links in enumerate(segments):
        forces = _segment_forces(force[i], rope[i], links)
        tension = np.linalg.norm(forces, axis=1)
        reach = length[i] / links + tension / (links * stiffness[i])
        slots[i] += (forces / tension[:, None] * reach[:, None]).sum(axis=0)
        if chain:
            bending[i] = _steady_bending(tension[-1], rope[i], length[i], links, config.sim.timestep)
    if cable.bending_damping is not None:
        bending[:] = cable.bending_damping
    centred = np.hypot(slots[:, 0], slots[:, 1]) < 1e-9
    system = System(
        vehicle=vehicle,
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
        cable_mass=rope,
        bending_stiffness=np.full(n, cable.bending_stiffness),
        bending_damping=bending,
        formation_force=force,
        slots=slots,
        slot_azimuth=np.where(centred, 0.0, np.arctan2(slots[:, 1], slots[:, 0])),
        min_separation=MIN_SEPARATION * scale,
        wind=np.asarray(config.wind.velocity, float),
        air=config.wind,
        timestep=config.sim.timestep,
        control_interval=whole_ratio(
            1 / config.sim.timestep, config.sim.control_hz, "sim.control_hz", "1/sim.timestep"
        ),
    )
    _check_possible(system, heaviest=1 + config.randomization.payload_mass)
    return system


def _segment_forces(force: np.ndarray, mass: float, segments: int) -> np.ndarray:
    """Return the pulls (segments, 3) [N] of a cable of `mass` [kg] that pulls the payload by `force` (3,) [N].

    The mass of each segment is at its upper end, so each carries one segment's weight more than that below it.
    """
    return force + GRAVITY * mass / segments * np.arange(segments)[:, None] * [0, 0, 1]


def _steady_bending(tension: float, mass: float, length: float, n: int, h: float) -> float:
    """Return the bending damping [N m s/rad] that keeps the sideways motion of a chain's nodes stable.

    Tension T acts on it explicitly: mode λ = 2 - 2 cos(jπ/n) of nodes m on links l moves stably in steps h if
    m + h d λ²/l² ≥ h² T λ/4l. T l h is enough unless the nodes are light; twice the tension at rest is allowed for.
    """
    modes = 2 - 2 * np.cos(np.pi * np.arange(1, n) / n)
    node, link = mass / n, length / n
    least = 2 * tension * link * h / (4 * modes) - node * link**2 / (h * modes**2)
    return max(tension * link * h, float(least.max()))


def _check_possible(system: System, heaviest: float) -> None:
    """Refuse what cannot fly, hovering under a payload `heaviest` times its nominal mass included."""
    n, vehicle = system.num_drones, system.vehicle
    if system.air.wash or system.air.ground_effect:
        check_rotors(vehicle)
    thrust = 4 * vehicle.rotor_thrust_max
    if n * thrust < MIN_THRUST_TO_WEIGHT * system.weight:
        lifted = "payload, drones and cables" if system.cable_mass.any() else "payload and drones"
        raise ConfigError(
            f"{n} × {vehicle.name} lift {n * thrust:.1f} N, less than {MIN_THRUST_TO_WEIGHT} × the weight of "
            f"{lifted}, {system.weight:.1f} N; lower payload.mass ({system.payload_mass:g} kg) or add drones"
        )
    rope = system.drone_pull - system.formation_force
    hover = np.linalg.norm(heaviest * system.formation_force + rope + [0, 0, vehicle.mass * GRAVITY], axis=1)
    if np.any(hover > thrust):
        i = int(hover.argmax())
        raise ConfigError(
            f"drone {i} would need {hover[i]:.1f} N of its {thrust:.1f} N to hover under the heaviest payload; lower "
            "payload.mass, randomization.payload_mass or cable.angle, or share the load by payload.anchors"
        )
    tight = heaviest * system.resting_tension
    if np.any(tight >= system.breaking_load):
        i = int(np.argmax(tight - system.breaking_load))
        raise ConfigError(
            f"cable {i} would break at rest: {tight[i]:.1f} N under the heaviest payload, but cable.breaking_load is "
            f"{system.breaking_load[i]:g} N; raise it or lower payload.mass"
        )
    if n > 1:
        apart = np.linalg.norm(system.slots[:, None] - system.slots[None], axis=-1) + 1e9 * np.eye(n)
        if apart.min() < system.min_separation:
            raise ConfigError(
                f"neighbouring drones would rest {apart.min():.2f} m apart, closer than the separation limit of "
                f"{system.min_separation:.2f} m; spread payload.anchors or raise cable.length or cable.angle"
            )


def whole_ratio(fast: float, slow: float, slow_key: str, fast_key: str) -> int:
    """Return fast/slow, two rates, as a whole number; the keys name them in the ConfigError if it is none."""
    ratio = round(fast / slow)
    if ratio < 1 or abs(fast / slow - ratio) > 1e-6:
        raise ConfigError(f"{slow_key}={slow:g} must divide {fast_key}={fast:g} into whole steps")
    return ratio
