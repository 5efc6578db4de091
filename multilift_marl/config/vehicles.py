"""Quadrotor presets: the numbers of real vehicles, each with its source."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


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
        rotor_time_constant: first-order lag of rotor speed [s].
        rotor_speed_min: idle speed [rad/s].
        rotor_thrust_max: largest thrust of one rotor [N].
        drag: linear drag along the body axes [kg/s].
    """

    name: str
    mass: float
    inertia: tuple[float, float, float]
    arm: float
    thrust_coefficient: float
    torque_ratio: float
    rotor_time_constant: float
    rotor_speed_min: float
    rotor_thrust_max: float
    drag: tuple[float, float, float]
    rotor_azimuth: tuple[float, ...] = tuple(np.pi / 4 + np.pi / 2 * np.arange(4))
    rotor_spin: tuple[float, ...] = (1.0, -1.0, 1.0, -1.0)

    @property
    def rotor_positions(self) -> np.ndarray:
        """Rotor positions in the body frame (4, 3) [m]."""
        azimuth = np.asarray(self.rotor_azimuth)
        return self.arm * np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], axis=1)

    @property
    def span(self) -> float:
        """Diagonal distance between rotor axes [m]."""
        return 2 * self.arm

    @property
    def rotor_speed_max(self) -> float:
        """Rotor speed at the thrust limit [rad/s]."""
        return float(np.sqrt(self.rotor_thrust_max / self.thrust_coefficient))


# Mass, inertia, arm, rotor and motor constants: TU Delft multi-lift simulation (arXiv 2508.01522), flycrane.urdf and
# motor_model.py: 0.6 kg body and four rotors of 4.2 g, 20 N in all (5 N a rotor; its speed limit of 2800 rad/s lies
# beyond that). Drag per unit mass: Faessler et al., RA-L 3(2), 2018, table of identified coefficients.
_FALCON_MASS = 0.6 + 4 * 0.0042
PRESETS: dict[str, Vehicle] = {
    "falcon": Vehicle(
        name="falcon",
        mass=_FALCON_MASS,
        inertia=(1.64e-3, 1.84e-3, 3.0e-3),
        arm=0.106,
        thrust_coefficient=1.562522e-6,
        torque_ratio=3.4375e-8 / 1.562522e-6,
        rotor_time_constant=0.033,
        rotor_speed_min=150.0,
        rotor_thrust_max=5.0,
        drag=(0.54 * _FALCON_MASS, 0.39 * _FALCON_MASS, 0.0),
    ),
}
