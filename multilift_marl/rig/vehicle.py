"""A quadrotor: its numbers, and what follows from them alone."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from multilift_marl.physical import AIR_DENSITY, GRAVITY, LIFT_SLOPE


@dataclass(frozen=True)
class Vehicle:
    """Physical parameters of one quadrotor (SI units; body x forward, y left, z up).

    Attributes:
        name: preset name.
        mass: total mass [kg].
        inertia: principal moments I_xx, I_yy, I_zz [kg m²].
        arm: distance from the centre of mass to a rotor axis [m].
        rotor_azimuth: direction of each arm, counter-clockwise from body x [rad].
        rotor_spin: sign of each rotor's reaction torque about body z.
        thrust_coefficient: b in f = b ω² [N s²] (report eq 5).
        torque_ratio: κ = d/b, reaction torque per newton of thrust [m] (report eq 7).
        rotor_time_constant_up: first-order lag of rotor speed while it rises [s].
        rotor_time_constant_down: the same while it falls [s].
        rotor_speed_min: idle speed [rad/s].
        rotor_thrust_max: largest thrust of one rotor [N].
        drag: linear drag along the body axes [kg/s].
        rotor_radius: [m].
        rotor_solidity: area of a rotor's blades over that of its disc.
        rolling_moment: of a rotor, over its speed and that of the air across it [kg m].
        rotor_inertia: of one rotor and what turns with it, about its axis [kg m²]; 0: as if it had none.
    """

    name: str
    mass: float
    inertia: tuple[float, float, float]
    arm: float
    thrust_coefficient: float
    torque_ratio: float
    rotor_time_constant_up: float
    rotor_time_constant_down: float
    rotor_speed_min: float
    rotor_thrust_max: float
    drag: tuple[float, float, float]
    rotor_radius: float
    rotor_solidity: float = 0.1
    rotor_azimuth: tuple[float, ...] = tuple(np.pi / 4 + np.pi / 2 * np.arange(4))
    rotor_spin: tuple[float, ...] = (1.0, -1.0, 1.0, -1.0)
    rolling_moment: float = 0.0
    rotor_inertia: float = 0.0

    @property
    def rotor_positions(self) -> np.ndarray:
        """Rotor positions in the body frame (4, 3) [m]."""
        azimuth = np.asarray(self.rotor_azimuth)
        return self.arm * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)

    @property
    def allocation(self) -> np.ndarray:
        """A (4, 4) with (T, M_x, M_y, M_z) = A f for rotor thrusts f [N]; report eq 11 for any layout and spin."""
        position = self.rotor_positions
        # r × f e3 = (y f, -x f, 0); the reaction is κ f with the rotor's sign.
        return np.stack([np.ones(4), position[:, 1], -position[:, 0], self.torque_ratio * np.asarray(self.rotor_spin)])

    @property
    def rotor_time_constant(self) -> float:
        """The slower of the two lags [s], by which controllers are tuned."""
        return max(self.rotor_time_constant_up, self.rotor_time_constant_down)

    @property
    def span(self) -> float:
        """Diagonal distance between rotor axes [m]."""
        return 2 * self.arm

    @property
    def half_size(self) -> np.ndarray:
        """Half edges (3,) of its collision box [m]."""
        return self.arm * np.array([0.7, 0.7, 0.3])

    @property
    def spare_lift(self) -> float:
        """Largest thrust less the drone's own weight [N]."""
        return 4 * self.rotor_thrust_max - self.mass * GRAVITY

    @property
    def rotor_speed_max(self) -> float:
        """Rotor speed at the thrust limit [rad/s]."""
        return float(np.sqrt(self.rotor_thrust_max / self.thrust_coefficient))

    @property
    def disc_momentum(self) -> float:
        """Thrust of a rotor in still air over the square of its induced velocity, 2 ρ A [kg/m]."""
        return float(2 * AIR_DENSITY * np.pi * self.rotor_radius**2)

    @property
    def induced_ratio(self) -> float:
        """Induced velocity of a rotor in still air over the speed of its blades' tips, λ = √(b / 2ρA) / R."""
        return float(np.sqrt(self.thrust_coefficient / self.disc_momentum) / self.rotor_radius)

    @property
    def blade_ratio(self) -> float:
        """Fall of a rotor's thrust with the air through its disc, over that of momentum theory: σ a / 8 λ."""
        return self.rotor_solidity * LIFT_SLOPE / (8 * self.induced_ratio)

    @property
    def inflow_damping(self) -> float:
        """Bound of the fall of the drone's thrust with the speed at which it climbs [kg/s]."""
        return float(4 * self.blade_ratio * np.sqrt(self.disc_momentum * self.rotor_thrust_max))
