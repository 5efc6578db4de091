"""From a configuration to the physical system it describes, in numbers, refused in one sentence if impossible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.config.mesh import Mesh, read_mesh
from multilift_marl.config.vehicles import GRAVITY, PRESETS, Vehicle, resolve_vehicle
from multilift_marl.errors import ConfigError

if TYPE_CHECKING:
    from multilift_marl.config.schema import Config, PayloadConfig

MIN_THRUST_TO_WEIGHT = 1.18
MIN_SEPARATION = 0.35  # [m] between the centres of two falcons; scales with the vehicle's span
MAX_ANCHOR_DISTANCE = 0.1  # [m] of an anchor from the payload's surface
REST_SEPARATION = 0.6  # [m] between falcons at rest, by which the standard rig is sized
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
        cable_segments: links of each cable; 1 if massless.
        cable_mass: (N,) [kg]; 0 if massless.
        bending_stiffness, bending_damping: between the links of a chain (N,) [N m/rad], [N m s/rad].
        formation_force: pull of each cable on the resting payload, in the payload frame (N, 3) [N].
        slots: resting drones in the payload frame, cables stretched and sagging as they hang (N, 3) [m].
        slot_azimuth: direction of each slot from the payload, in its horizontal plane (N,) [rad].
        min_separation: distance between drones that counts as a collision [m].
        wind: mean wind (3,) [m/s].
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
    cable_segments: int
    cable_mass: np.ndarray
    bending_stiffness: np.ndarray
    bending_damping: np.ndarray
    formation_force: np.ndarray
    slots: np.ndarray
    slot_azimuth: np.ndarray
    min_separation: float
    wind: np.ndarray
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
        return np.linalg.norm(self.segment_forces[:, -1], axis=1)

    @property
    def segment_forces(self) -> np.ndarray:
        """Pull of each segment of the resting cables, from the payload up, payload frame (N, segments, 3) [N]."""
        return _segment_forces(self.formation_force, self.cable_mass, self.cable_segments)


def resolve_system(config: Config) -> System:
    """Return the system of `config`.

    Raises:
        ConfigError: it cannot exist or cannot fly; the message says why and what to change.
    """
    n, payload, cable = config.env.num_drones, config.payload, config.cable
    vehicle = resolve_vehicle(config.vehicle)
    scale = vehicle.span / _FALCON.span
    length = _per_drone(_standard_length(config, scale) if cable.length is None else cable.length, n, "cable.length")
    mesh = _mesh(payload)
    anchors, size = _rig(config, n, length, scale, mesh)
    uniform = np.zeros(3) if mesh is None else mesh.center_of_mass - mesh.middle
    center_of_mass = uniform if payload.center_of_mass is None else np.array(payload.center_of_mass)
    _check_body(payload.shape, size, center_of_mass, anchors)
    anchors = anchors - center_of_mass
    standard = 0.35 * n * (vehicle.spare_lift / _FALCON.spare_lift)
    mass = payload.mass if payload.mass is not None else standard
    axes = np.array([1.0, 0.0, 0.0, 0.0])
    if payload.inertia is not None:
        inertia = np.array(payload.inertia)
    elif mesh is not None:
        inertia, axes = mass * mesh.inertia, mesh.axes
    else:
        inertia = _uniform_inertia(payload.shape, mass, size)
    if 2 * inertia.max() > inertia.sum() * (1 + 1e-9):
        raise ConfigError(
            f"payload.inertia {inertia.tolist()} is impossible: no moment may exceed the sum of the other two"
        )
    stiffness = _per_drone(cable.stiffness, n, "cable.stiffness")
    force = formation_forces(anchors, mass * GRAVITY, np.deg2rad(cable.angle), payload.shape == "point")
    chain = cable.model == "chain"
    segments = cable.segments if chain else 1
    rope = cable.density * length if chain else np.zeros(n)
    forces = _segment_forces(force, rope, segments)
    tension = np.linalg.norm(forces, axis=2)
    reach = (length / segments)[:, None] + tension / (segments * stiffness)[:, None]
    slots = anchors + (forces / tension[..., None] * reach[..., None]).sum(axis=1)
    bending = cable.bending_damping
    if bending is None:
        bending = _steady_bending(tension[:, -1], rope, length, segments, config.sim.timestep) if chain else 0.0
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
        cable_damping=_per_drone(cable.damping, n, "cable.damping"),
        cable_segments=segments,
        cable_mass=rope,
        bending_stiffness=np.full(n, cable.bending_stiffness),
        bending_damping=np.broadcast_to(bending, n).astype(float),
        formation_force=force,
        slots=slots,
        slot_azimuth=np.where(centred, 0.0, np.arctan2(slots[:, 1], slots[:, 0])),
        min_separation=MIN_SEPARATION * scale,
        wind=np.asarray(config.wind.velocity, float),
        timestep=config.sim.timestep,
        control_interval=whole_ratio(
            1 / config.sim.timestep, config.sim.control_hz, "sim.control_hz", "1/sim.timestep"
        ),
    )
    _check_possible(system, heaviest=1 + config.randomization.payload_mass)
    return system


def _segment_forces(force: np.ndarray, mass: np.ndarray, segments: int) -> np.ndarray:
    """Return the pulls (N, segments, 3) [N] of cables of `mass` (N,) [kg] that pull the payload by `force` (N, 3) [N].

    The mass of each segment is at its upper end, so each carries one segment's weight more than that below it.
    """
    carried = GRAVITY * mass[:, None] / segments * np.arange(segments)
    return force[:, None] + carried[..., None] * [0, 0, 1]


def _steady_bending(tension: np.ndarray, mass: np.ndarray, length: np.ndarray, n: int, h: float) -> np.ndarray:
    """Return the bending damping (N,) [N m s/rad] that keeps the sideways motion of a chain's nodes stable.

    Tension T acts on it explicitly: mode λ = 2 - 2 cos(jπ/n) of nodes m on links l moves stably in steps h if
    m + h d λ²/l² ≥ h² T λ/4l. T l h is enough unless the nodes are light; twice the tension at rest is allowed for.
    """
    modes = 2 - 2 * np.cos(np.pi * np.arange(1, n) / n)
    tension, node, link = tension[:, None], mass[:, None] / n, length[:, None] / n
    least = 2 * tension * link * h / (4 * modes) - node * link**2 / (h * modes**2)
    return np.maximum(tension[:, 0] * link[:, 0] * h, least.max(axis=1))


def _standard_length(config: Config, scale: float) -> float:
    """Return 1 m for a falcon's span, or more where a ring of drones about one point would be too narrow."""
    n, spread = config.env.num_drones, np.sin(np.deg2rad(config.cable.angle))
    if config.payload.shape != "point" or n == 1 or spread == 0:
        return scale
    return scale * max(1.0, REST_SEPARATION / (2 * np.sin(np.pi / n) * spread))


def _mesh(payload: PayloadConfig) -> Mesh | None:
    if payload.shape == "mesh" and payload.mesh is not None:
        return read_mesh(payload.mesh, payload.size)
    if payload.shape == "mesh":
        raise ConfigError("payload.shape=mesh needs payload.mesh; give the path of an .obj or .stl file")
    if payload.mesh is not None:
        raise ConfigError(f"payload.mesh means nothing to a {payload.shape}; drop it or use payload.shape=mesh")
    return None


def _rig(config: Config, n: int, length: np.ndarray, scale: float, mesh: Mesh | None) -> tuple[np.ndarray, np.ndarray]:
    """Return anchors (n, 3) from the geometric centre and edges (3,): the configured or the standard ones."""
    payload = config.payload
    reach = length.min() * np.sin(np.deg2rad(config.cable.angle))
    ring = max(0.27 * scale, REST_SEPARATION * scale / (2 * np.sin(np.pi / n)) - reach) if n > 1 else 0.0
    edge = 2 * max(ring, 0.15 * scale)
    rectangle = n == 4 and payload.shape != "cylinder"
    standard = np.array([0.55, 0.45, 0.15]) * scale if rectangle else np.array([edge, edge, 0.15 * scale])
    size = standard if payload.size is None else np.asarray(payload.size, float)
    size = size if mesh is None else mesh.edges
    inset = 0.005 * scale  # the cables are tied to rings this far inside the rim and above the lid
    lid, rim = size[2] / 2 + inset, size[:2] / 2 - inset
    if payload.anchors is not None:
        anchors = np.asarray(payload.anchors, float)
        if len(anchors) != n:
            raise ConfigError(f"payload.anchors lists {len(anchors)} anchors for env.num_drones={n}: give one for each")
    elif payload.shape == "point":
        anchors = np.zeros((n, 3))
    elif rectangle:
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        anchors = np.concatenate([corners * rim, np.full((4, 1), lid)], axis=1)
    else:
        azimuth, ring = 2 * np.pi * np.arange(n) / n, min(ring, size[:2].min() / 2)
        anchors = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.full(n, lid)], axis=1)
    if payload.shape == "point":
        for key in ("size", "inertia", "center_of_mass"):
            if getattr(payload, key) is not None:
                raise ConfigError(f"payload.{key} means nothing to a point; drop it or use payload.shape=box")
        size = np.full(3, 0.1 * scale)
        if np.any(anchors != 0):
            raise ConfigError(
                "payload.anchors of a point payload must all be [0, 0, 0]; use payload.shape=box for others"
            )
    return anchors, size


def _uniform_inertia(shape: str, mass: float, size: np.ndarray) -> np.ndarray:
    """Return the principal moments (3,) of a uniform body [kg m²]."""
    if shape == "cylinder":
        across = size[0] ** 2 / 16 + size[2] ** 2 / 12
        return mass * np.array([across, across, size[0] ** 2 / 8])
    return mass / 12 * np.array([size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2])


def _check_body(shape: str, size: np.ndarray, center_of_mass: np.ndarray, anchors: np.ndarray) -> None:
    """Refuse bodies that cannot be, and anchors (N, 3) off the body, counted from its geometric centre."""
    if shape == "cylinder" and size[0] != size[1]:
        raise ConfigError(
            f"payload.size {size.tolist()} of a cylinder must give its diameter twice, then its height; "
            "make the first two equal"
        )
    if _outside(shape, size, center_of_mass[None])[0] > 1e-9:
        raise ConfigError(
            f"payload.center_of_mass {center_of_mass.tolist()} lies outside the payload of size {size.tolist()}; "
            "count it from the geometric centre"
        )
    outside = _outside(shape, size, anchors)
    if np.any(outside > MAX_ANCHOR_DISTANCE):
        i = int(np.argmax(outside))
        raise ConfigError(
            f"payload.anchors: anchor {i} is out of reach, {outside[i]:.2f} m outside the payload; move it onto the "
            "payload"
        )


def _outside(shape: str, size: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return how far (N,) points (N, 3), counted from the geometric centre, lie outside the body [m]."""
    over = np.maximum(np.abs(points) - size / 2, 0)
    if shape == "cylinder":
        over[:, 0] = np.maximum(np.hypot(points[:, 0], points[:, 1]) - size[0] / 2, 0)
        over[:, 1] = 0
    return np.linalg.norm(over, axis=1)


def formation_forces(anchors: np.ndarray, weight: float, angle: float, point: bool) -> np.ndarray:
    """Return the cables' pulls (N, 3) [N] that hold a payload level, as near as possible to `angle` from the vertical.

    The pulls nearest to equal, symmetric ones in the least-squares sense among all that balance the weight and
    its moments about the centre of mass.

    Args:
        anchors: (N, 3) [m] from the centre of mass.
        weight: of the payload [N].
        angle: of the cables from the vertical [rad].
        point: True where the payload has no attitude to hold.

    Raises:
        ConfigError: no pulls balance the payload, or some cable would have to push.
    """
    n = len(anchors)
    centre = anchors[:, :2].mean(axis=0)
    radial = anchors[:, :2] - centre
    distance = np.linalg.norm(radial, axis=1, keepdims=True)
    even = 2 * np.pi * np.arange(n) / n
    radial = np.where(
        distance > 1e-6, radial / np.maximum(distance, 1e-6), np.stack([np.cos(even), np.sin(even)], axis=1)
    )
    if n == 1:
        radial = np.zeros((1, 2))
    nominal = weight / n * np.concatenate([np.tan(angle) * radial, np.ones((n, 1))], axis=1)
    balance = np.concatenate([np.eye(3)] * n, axis=1)
    load = np.array([0, 0, weight, 0, 0, 0])
    if point:
        load = load[:3]
    else:
        moments = [[[0, -z, y], [z, 0, -x], [-y, x, 0]] for x, y, z in anchors]
        balance = np.concatenate([balance, np.concatenate(np.array(moments, float), axis=1)], axis=0)
    flat = nominal.ravel()
    force = (flat + np.linalg.pinv(balance) @ (load - balance @ flat)).reshape(n, 3)
    residual = np.abs(balance @ force.ravel() - load).max()
    if residual > 1e-6 * weight:
        raise ConfigError(
            f"payload.anchors {np.round(anchors, 3).tolist()} cannot hold the payload level: place them around its "
            "centre of mass"
        )
    if np.any(force[:, 2] < 0.02 * weight / n):
        raise ConfigError(
            f"payload.anchors: cable {int(force[:, 2].argmin())} would have to push; move the anchors around the "
            "centre of mass"
        )
    return force


def _check_possible(system: System, heaviest: float) -> None:
    """Refuse what cannot fly, hovering under a payload `heaviest` times its nominal mass included."""
    n, vehicle = system.num_drones, system.vehicle
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
    if n > 1:
        apart = np.linalg.norm(system.slots[:, None] - system.slots[None], axis=-1) + 1e9 * np.eye(n)
        if apart.min() < system.min_separation:
            raise ConfigError(
                f"neighbouring drones would rest {apart.min():.2f} m apart, closer than the separation limit of "
                f"{system.min_separation:.2f} m; spread payload.anchors or raise cable.length or cable.angle"
            )


def _per_drone(value: float | tuple[float, ...], n: int, key: str) -> np.ndarray:
    values = np.atleast_1d(np.asarray(value, float))
    if len(values) not in (1, n) or (isinstance(value, tuple) and len(values) != n):
        raise ConfigError(
            f"{key} lists {len(values)} values for env.num_drones={n}: give one value or one for each drone"
        )
    return np.broadcast_to(values, (n,)).copy()


def whole_ratio(fast: float, slow: float, slow_key: str, fast_key: str) -> int:
    """Return fast/slow, two rates, as a whole number; the keys name them in the ConfigError if it is none."""
    ratio = round(fast / slow)
    if ratio < 1 or abs(fast / slow - ratio) > 1e-6:
        raise ConfigError(f"{slow_key}={slow:g} must divide {fast_key}={fast:g} into whole steps")
    return ratio
