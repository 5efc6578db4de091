"""From a configuration to the physical system it describes, in numbers, refused in one sentence if impossible."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from multilift_marl.config.vehicles import PRESETS, Vehicle
from multilift_marl.errors import ConfigError, nearest

if TYPE_CHECKING:
    from multilift_marl.config.schema import Config

GRAVITY = 9.81  # [m/s²]
MIN_THRUST_TO_WEIGHT = 1.18
MIN_SEPARATION = 0.35  # [m] between the centres of two falcons; scales with the vehicle's span
MAX_ANCHOR_DISTANCE = 0.1  # [m] of an anchor from the payload's surface
REST_SEPARATION = 0.6  # [m] between falcons at rest, by which the standard rig is sized
_FALCON_SPAN = PRESETS["falcon"].span


@dataclass(frozen=True, eq=False)
class System:
    """Drones, cables and payload in numbers (SI units; N drones).

    Attributes:
        vehicle: the quadrotor, the same for all drones.
        payload_shape: "box" or "point".
        payload_size: edges of the box (3,) [m].
        payload_mass: nominal mass [kg].
        payload_inertia: nominal principal moments (3,) [kg m²].
        payload_drag_area: C_d A [m²].
        anchors: attachment of each cable in the payload frame (N, 3) [m].
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
    payload_size: np.ndarray
    payload_mass: float
    payload_inertia: np.ndarray
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
    if config.vehicle.preset not in PRESETS:
        raise ConfigError(f"unknown vehicle.preset '{config.vehicle.preset}'{nearest(config.vehicle.preset, PRESETS)}")
    vehicle = PRESETS[config.vehicle.preset]
    scale = vehicle.span / _FALCON_SPAN
    length = _per_drone(_standard_length(config, scale) if cable.length is None else cable.length, n, "cable.length")
    anchors, size = _rig(config, n, length, scale)
    mass = payload.mass if payload.mass is not None else 0.35 * n
    inertia = payload.inertia or mass / 12 * np.array(
        [size[1] ** 2 + size[2] ** 2, size[0] ** 2 + size[2] ** 2, size[0] ** 2 + size[1] ** 2]
    )
    inertia = np.asarray(inertia, float)
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
        payload_size=size,
        payload_mass=mass,
        payload_inertia=inertia,
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
    if config.payload.shape == "box" or n == 1 or spread == 0:
        return scale
    return scale * max(1.0, REST_SEPARATION / (2 * np.sin(np.pi / n) * spread))


def _rig(config: Config, n: int, length: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Return anchors (n, 3) and the box's edges (3,): the configured or the standard ones of n drones."""
    payload = config.payload
    reach = length.min() * np.sin(np.deg2rad(config.cable.angle))
    ring = max(0.27 * scale, REST_SEPARATION * scale / (2 * np.sin(np.pi / n)) - reach) if n > 1 else 0.0
    edge = 2 * max(ring, 0.15 * scale)
    standard = np.array([0.55, 0.45, 0.15]) * scale if n == 4 else np.array([edge, edge, 0.15 * scale])
    size = standard if payload.size is None else np.asarray(payload.size, float)
    inset = 0.005 * scale  # the cables are tied to rings this far inside the rim and above the lid
    lid, rim = size[2] / 2 + inset, size[:2] / 2 - inset
    if payload.anchors is not None:
        anchors = np.asarray(payload.anchors, float)
        if len(anchors) != n:
            raise ConfigError(f"payload.anchors lists {len(anchors)} anchors for env.num_drones={n}: give one for each")
    elif payload.shape == "point":
        anchors = np.zeros((n, 3))
    elif n == 4:
        corners = np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]])
        anchors = np.concatenate([corners * rim, np.full((4, 1), lid)], axis=1)
    else:
        azimuth, ring = 2 * np.pi * np.arange(n) / n, min(ring, size[:2].min() / 2)
        anchors = np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), np.full(n, lid)], axis=1)
    if payload.shape == "point":
        for key in ("size", "inertia"):
            if getattr(payload, key) is not None:
                raise ConfigError(f"payload.{key} means nothing to a point; drop it or use payload.shape=box")
        size = np.full(3, 0.1 * scale)
        if np.any(anchors != 0):
            raise ConfigError(
                "payload.anchors of a point payload must all be [0, 0, 0]; use payload.shape=box for others"
            )
    return anchors, size


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
    outside = np.linalg.norm(np.maximum(np.abs(system.anchors) - system.payload_size / 2, 0), axis=1)
    if np.any(outside > MAX_ANCHOR_DISTANCE):
        i = int(np.argmax(outside))
        raise ConfigError(
            f"payload.anchors: anchor {i} is out of reach, {outside[i]:.2f} m outside the payload; move it onto the "
            "payload"
        )
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
