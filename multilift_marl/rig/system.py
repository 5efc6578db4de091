"""The physical system in numbers, as simulated, and nominal to controllers and tasks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from multilift_marl.math3d import quat_to_mat, thrust_frame
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.mesh import Mesh
from multilift_marl.rig.obstacles import Scenery
from multilift_marl.rig.vehicle import Vehicle
from multilift_marl.schema.sections import ContactConfig, PushConfig, WindConfig


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
        cable_model: name of a model of `sim.cables`.
        cable_length, cable_stiffness, cable_damping: (N,) [m], [N/m], [N s/m].
        breaking_load: tension that breaks each cable (N,) [N]; infinite if none does.
        cable_segments: links of each cable (N,); 1 if massless.
        cable_mass: (N,) [kg]; 0 if massless.
        bending_stiffness, bending_damping: between the links of a chain (N,) [N m/rad], [N m s/rad].
        formation_force: force of each cable on the resting payload, in the payload frame (N, 3) [N].
        hooks: where each cable is tied to its drone, from its centre of mass, in its frame (N, 3) [m].
        cable_ends: the hooks of resting drones in the payload frame, cables stretched and sagging (N, 3) [m].
        slots: resting drones in the payload frame (N, 3) [m].
        slot_azimuth: direction of each slot from the payload, in its horizontal plane (N,) [rad].
        heading: of each resting drone, from the payload's (N,) [rad].
        min_separation: distance between two drones that counts as a collision (N, N) [m].
        wind: mean wind (3,) [m/s].
        air: what else the air does.
        push: pushes of its bodies.
        contact: friction and restitution.
        scenery: obstacles.
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
    heading: np.ndarray
    min_separation: np.ndarray
    wind: np.ndarray
    air: WindConfig
    push: PushConfig
    contact: ContactConfig
    scenery: Scenery
    timestep: float
    control_interval: int
    varied: frozenset[str] = frozenset()

    @property
    def num_drones(self) -> int:
        """Drones in the team, N."""
        return len(self.anchors)

    @property
    def inflow(self) -> bool:
        """Whether the air along the rotors' axes changes their thrust."""
        return self.air.wash if self.air.inflow is None else self.air.inflow

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
    def hook_force(self) -> np.ndarray:
        """Force of each resting drone on its cable: `formation_force` and the cable's weight (N, 3) [N]."""
        return self.formation_force + GRAVITY * self.cable_mass[:, None] * [0, 0, 1]

    def bending_rate(self, cable_length: np.ndarray) -> np.ndarray:
        """Return the rate of the fastest bending of any chain [1/s], twice where it swings; 0 without chains.

        Nodes m that move to and fro across links l have ω² = 16 κ/(m l²), and by damping alone the rate 16 β/(m l²).

        Args:
            cable_length: (..., N) [m], whose nodes weigh as much more than the nominal ones as they are longer.

        Returns:
            (...).
        """
        if not self.cable_mass.any():
            return np.zeros(cable_length.shape[:-1])
        node_mass = self.cable_mass / (self.cable_segments - 1) * (cable_length / self.cable_length)
        inertia = node_mass * (cable_length / self.cable_segments) ** 2
        swing = 2 * np.sqrt(16 * self.bending_stiffness / inertia).max(axis=-1)
        return np.maximum(swing, (16 * self.bending_damping / inertia).max(axis=-1))

    @property
    def resting_tension(self) -> np.ndarray:
        """Tension of each resting cable where it is measured, in its segment next to the drone (N,) [N]."""
        return np.linalg.norm(self.hook_force, axis=1)

    @property
    def resting_rotation(self) -> np.ndarray:
        """Attitude of each resting drone in the payload's frame (N, 3, 3)."""
        return resting_rotations(self.vehicles, self.hook_force, self.heading)

    @property
    def principal_axes(self) -> np.ndarray:
        """The payload's principal axes of inertia in its frame, as columns (3, 3)."""
        return np.reshape(quat_to_mat(*(float(q) for q in self.payload_axes)), (3, 3))

    @property
    def inertia_matrix(self) -> tuple[float, ...]:
        """Return the payload's nominal inertia about its centre of mass, in its frame, row by row (9,) [kg m²]."""
        axes = self.principal_axes
        return tuple(float(moment) for moment in ((axes * self.payload_inertia) @ axes.T).ravel())


def resting_rotations(vehicles: tuple[Vehicle, ...], cable_forces: np.ndarray, heading: np.ndarray) -> np.ndarray:
    """Return the attitudes (N, 3, 3) of drones that hold `cable_forces` (N, 3) [N] and their own weight at rest."""
    forces = cable_forces + GRAVITY * np.array([[0, 0, vehicle.mass] for vehicle in vehicles])
    frames = (thrust_frame(tuple(force), yaw) for force, yaw in zip(forces, heading, strict=True))
    return np.array(list(frames)).reshape(-1, 3, 3)
