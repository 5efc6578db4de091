"""From a configuration to the physical system it describes, in numbers, refused in one sentence if impossible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.config.feasibility import check_possible
from multilift_marl.config.mesh import Mesh
from multilift_marl.config.resolution import check_resolved
from multilift_marl.config.rig import (
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
from multilift_marl.config.teams import resolve_vehicles
from multilift_marl.config.vehicles import GRAVITY, PRESETS, Vehicle
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import quat_to_mat, thrust_frame

if TYPE_CHECKING:
    from multilift_marl.config.schema import Config, RandomizationConfig, WindConfig

_BENDING_DECAY = 90.0  # [1/s] of the default damping of bending, over a node's mass times the square of a link
MIN_SEPARATION = 0.35  # [m] between the centres of two falcons; scales with the mean span
_FALCON = PRESETS["falcon"]


@dataclass(frozen=True, eq=False)
class System:
    """Drones, cables and payload in numbers (SI units; N drones).

    Attributes:
        vehicles: the quadrotor of each drone, N of them.
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
        hooks: where each cable is tied to its drone, from its centre of mass, in its frame (N, 3) [m].
        cable_ends: the hooks of resting drones in the payload frame, cables stretched and sagging (N, 3) [m].
        slots: resting drones in the payload frame (N, 3) [m].
        slot_azimuth: direction of each slot from the payload, in its horizontal plane (N,) [rad].
        min_separation: distance between two drones that counts as a collision (N, N) [m].
        wind: mean wind (3,) [m/s].
        air: what else the air does.
        timestep: physics step [s].
        control_interval: physics steps for each control step.
        varied: keys of `randomization` by which environments differ.
    """

    vehicles: tuple[Vehicle, ...]
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
    hooks: np.ndarray
    cable_ends: np.ndarray
    slots: np.ndarray
    slot_azimuth: np.ndarray
    min_separation: np.ndarray
    wind: np.ndarray
    air: WindConfig
    timestep: float
    control_interval: int
    varied: frozenset[str] = frozenset()

    @property
    def num_drones(self) -> int:
        """Drones in the team, N."""
        return len(self.anchors)

    @property
    def vehicle(self) -> Vehicle:
        """The quadrotor of a team whose drones are all alike; ValueError for others."""
        if any(vehicle != self.vehicles[0] for vehicle in self.vehicles):
            raise ValueError("the drones of this team are not alike: use system.vehicles")
        return self.vehicles[0]

    @property
    def drone_mass(self) -> np.ndarray:
        """Mass of each drone (N,) [kg]."""
        return np.array([vehicle.mass for vehicle in self.vehicles])

    @property
    def weight(self) -> float:
        """Weight of payload, drones and cables [N]."""
        return GRAVITY * (self.payload_mass + self.drone_mass.sum() + self.cable_mass.sum())

    @property
    def drone_pull(self) -> np.ndarray:
        """Pull of each resting drone on its cable, which is the payload's share and the cable's weight (N, 3) [N]."""
        return self.formation_force + GRAVITY * self.cable_mass[:, None] * [0, 0, 1]

    @property
    def bending_rate(self) -> float:
        """Rate of the fastest bending of any chain [1/s], twice where it swings; 0 without chains.

        Nodes m that move to and fro across links l have ω² = 16 κ/(m l²), and by damping alone the rate 16 β/(m l²).
        """
        if self.cable_model != "chain":
            return 0.0
        inertia = self.cable_mass / (self.cable_segments - 1) * (self.cable_length / self.cable_segments) ** 2
        swing = 2 * np.sqrt(16 * self.bending_stiffness / inertia).max()
        return float(max(swing, (16 * self.bending_damping / inertia).max()))

    @property
    def resting_tension(self) -> np.ndarray:
        """Tension of each resting cable where it is measured, in its segment next to the drone (N,) [N]."""
        return np.linalg.norm(self.drone_pull, axis=1)

    @property
    def resting_rotation(self) -> np.ndarray:
        """Attitude of each resting drone in the payload's frame (N, 3, 3)."""
        return _resting_rotations(self.vehicles, self.drone_pull)

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
    chain = cable.model == "chain"
    segments = per_drone(cable.segments if chain else 1, n, "cable.segments").astype(int)
    rope = per_drone(cable.density, n, "cable.density") * length if chain else np.zeros(n)
    ends = anchors.copy()
    for i, links in enumerate(segments):
        forces = _segment_forces(force[i], rope[i], links)
        tension = np.linalg.norm(forces, axis=1)
        reach = length[i] / links + tension / (links * stiffness[i])
        ends[i] += (forces / tension[:, None] * reach[:, None]).sum(axis=0)
    bending_damping = _BENDING_DECAY * rope / np.maximum(segments - 1, 1) * (length / segments) ** 2
    if cable.bending_damping is not None:
        bending_damping = np.full(n, cable.bending_damping)
    hooks = vector_per_drone(cable.hook, n, "cable.hook")
    resting = _resting_rotations(vehicles, force + GRAVITY * rope[:, None] * [0, 0, 1])
    slots = ends - (resting * hooks[:, None, :]).sum(axis=-1)
    centred = np.hypot(slots[:, 0], slots[:, 1]) < 1e-9
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
        cable_mass=rope,
        bending_stiffness=np.full(n, cable.bending_stiffness),
        bending_damping=bending_damping,
        formation_force=force,
        hooks=hooks,
        cable_ends=ends,
        slots=slots,
        slot_azimuth=np.where(centred, 0.0, np.arctan2(slots[:, 1], slots[:, 0])),
        min_separation=MIN_SEPARATION * ((spans[:, None] + spans) / 2 / _FALCON.span),
        wind=np.asarray(config.wind.velocity, float),
        air=config.wind,
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


def _resting_rotations(vehicles: tuple[Vehicle, ...], pulls: np.ndarray) -> np.ndarray:
    """Return the attitudes (N, 3, 3) in which drones at rest exert `pulls` (N, 3) [N] beside their own weight."""
    forces = pulls + GRAVITY * np.array([[0, 0, vehicle.mass] for vehicle in vehicles])
    return np.array([thrust_frame(tuple(force), 0.0) for force in forces]).reshape(-1, 3, 3)


def _segment_forces(force: np.ndarray, mass: float, segments: int) -> np.ndarray:
    """Return the pulls (segments, 3) [N] of a cable of `mass` [kg] that pulls the payload by `force` (3,) [N].

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
