"""Quadrotors: presets with the numbers of real vehicles, each with its source, and one's own by configuration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

GRAVITY = 9.81  # [m/s²]
AIR_DENSITY = 1.225  # [kg/m³] at sea level, 15 °C (ISA)


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
    def spare_lift(self) -> float:
        """Largest thrust less the drone's own weight [N]."""
        return 4 * self.rotor_thrust_max - self.mass * GRAVITY

    @property
    def rotor_speed_max(self) -> float:
        """Rotor speed at the thrust limit [rad/s]."""
        return float(np.sqrt(self.rotor_thrust_max / self.thrust_coefficient))


# TU Delft multi-lift simulation (arXiv 2508.01522; Aerial-Manipulation-Lab/MARL_mav_ext). Mass, inertia and arm:
# assets/data/AMR/flycrane_data/flycrane.urdf, 0.6 kg body and four rotors of 4.2 g at (0.075, 0.075) m; its controllers
# take 0.6017 kg. Thrust, torque, lag, idle speed and rotor inertia: controllers/motor_model.py, whose speed limit of
# 2800 rad/s lies beyond any limit of thrust. Thrust limit: 5 N a rotor, 20 N in all; its controllers/indi.py and the
# environments clamp at 6.25 N. Drag per unit mass: Faessler et al., RA-L 3(2), 2018, table of identified coefficients.
# Rotor radius: half of the 0.127 m (5 inches) that the urdf calls a radius, since rotors 0.15 m apart would overlap.
_FALCON_MASS = 0.6 + 4 * 0.0042
_FALCON = Vehicle(
    name="falcon",
    mass=_FALCON_MASS,
    inertia=(1.64e-3, 1.84e-3, 3.0e-3),
    arm=0.106,
    thrust_coefficient=1.562522e-6,
    torque_ratio=3.4375e-8 / 1.562522e-6,
    rotor_time_constant_up=0.033,
    rotor_time_constant_down=0.033,
    rotor_speed_min=150.0,
    rotor_thrust_max=5.0,
    drag=(0.54 * _FALCON_MASS, 0.39 * _FALCON_MASS, 0.0),
    rotor_radius=0.0635,
    rotor_inertia=9.3575e-6,
)

# Mass, inertia, arm, torque ratio, no drag: IMRCLab/col-trans, sim/config/initialize.yaml. Its inertia is that of
# Förster, "System identification of the Crazyflie 2.0", ETH Zurich 2015, which is also where the thrust coefficient
# comes from (as quoted by gsilano/CrazyS, rotors_description/urdf/crazyflie2.xacro). Thrust limit: CrazyMARL (arXiv
# 2509.14126), whose episodes draw 0.105 to 0.15 N. Motor lag: assumed. 0.15/4 s is a value that
# viktorlorentz/crazyMARL keeps as a comment (crazymarl/configs/multi_quad_config.py); it lies between CrazyS, 0.0125 s
# up and 0.025 s down, the numbers of RotorS' hummingbird, and those for which this controller is too slow: 0.15 s, with
# which CrazyMARL and arplaboratory/learning-to-fly train, and 0.145 s of `crazyflie_id`, identified. docs/vehicles.md
# says what the choice does. Idle speed: stated by none of them, assumed zero. Rotor radius: utiasDSL/gym-pybullet-
# drones, gym_pybullet_drones/assets/cf2x.urdf; likewise below. Rotor inertia: drone-models (see below), cf2x_P250.
_CRAZYFLIE = Vehicle(
    name="crazyflie",
    mass=0.034,
    inertia=(16.571710e-6, 16.655602e-6, 29.261652e-6),
    arm=0.046,
    thrust_coefficient=1.28192e-8,
    torque_ratio=0.006,
    rotor_time_constant_up=0.15 / 4,
    rotor_time_constant_down=0.15 / 4,
    rotor_speed_min=0.0,
    rotor_thrust_max=0.14,
    drag=(0.0, 0.0, 0.0),
    rotor_radius=2.31348e-2,
    rotor_inertia=26.97e-9,
)

# Identified from flights of a Crazyflie 2.x with L250 propellers: learnsyslab/drone-models,
# drone_models/data/params.toml, section cf2x_L250 (read in the copy Synetic-Labs/drone-models): mass, J, L (per axis),
# thrust2torque, rotor_dyn_coef_simple 6.8867 s⁻¹ for either direction, thrust_min, thrust_max, drag_matrix,
# prop_inertia (of which it says "seems off"; its other propellers have 27 and 39e-9). Its prop_radius is 0.02355 m,
# marked to be checked. Its thrust
# 2.45829e-10 r² - 5.3822e-7 r newtons at r rev/min has a linear part that b ω² has not: b is chosen such that both
# agree at hover, 1986 rad/s.
_CRAZYFLIE_ID_THRUST = 1.982941e-8
_CRAZYFLIE_ID = Vehicle(
    name="crazyflie_id",
    mass=0.0319,
    inertia=(16.8e-6, 16.8e-6, 29.8e-6),
    arm=0.03253 * 2**0.5,
    thrust_coefficient=_CRAZYFLIE_ID_THRUST,
    torque_ratio=0.007350862856566459,
    rotor_time_constant_up=1 / 6.886705423469015,
    rotor_time_constant_down=1 / 6.886705423469015,
    rotor_speed_min=(0.012817578393224994 / _CRAZYFLIE_ID_THRUST) ** 0.5,
    rotor_thrust_max=0.12,
    drag=(0.01471782, 0.01471782, 0.01277641),
    rotor_radius=2.31348e-2,
    rotor_inertia=34.52e-9,
)


def _rotor_drag(mass: float, thrust_coefficient: float, coefficient: float) -> tuple[float, float, float]:
    """Return RotorS' drag of four rotors, coefficient · ω · v across the rotor's axis, at hover speed [kg/s]."""
    hover = np.sqrt(mass * GRAVITY / 4 / thrust_coefficient)
    return (float(4 * hover * coefficient), float(4 * hover * coefficient), 0.0)


# ethz-asl/rotors_simulator, rotors_description/urdf/hummingbird.xacro: body and rotors, + layout, the front rotor turns
# clockwise (its reaction torque is counter-clockwise). Inertia as its controller takes it for all of 0.716 kg. No idle
# speed. Drag of the rotors linear in their speed, taken at hover; the rolling moment (1e-6) is off: its sign there does
# not follow the rotor's, see docs/air.md. Rotor inertia: of its cuboid, 9 g and 15 mm wide, but 2 R long; there it is
# R long, which makes it a quarter of that (and ten times as heavy, because Gazebo turns it at a tenth of its speed).
_HUMMINGBIRD_MASS = 0.68 + 4 * 0.009
_HUMMINGBIRD = Vehicle(
    name="hummingbird",
    mass=_HUMMINGBIRD_MASS,
    inertia=(0.007, 0.007, 0.012),
    arm=0.17,
    thrust_coefficient=8.54858e-6,
    torque_ratio=0.016,
    rotor_time_constant_up=0.0125,
    rotor_time_constant_down=0.025,
    rotor_speed_min=0.0,
    rotor_thrust_max=8.54858e-6 * 838.0**2,
    drag=_rotor_drag(_HUMMINGBIRD_MASS, 8.54858e-6, 8.06428e-5),
    rotor_radius=0.1,
    rotor_inertia=0.009 * (0.2**2 + 0.015**2) / 12,
    rotor_azimuth=(0.0, float(np.pi / 2), float(np.pi), float(3 * np.pi / 2)),
)

# PX4/PX4-SITL_gazebo-classic, models/iris/iris.sdf.jinja: body 1.5 kg, rotors 5 g each, IMU 15 g, GPS 10 g. Its front
# rotors stand at (0.13, ± 0.22) m, its back ones at (-0.13, ± 0.20) m; symmetric here, at 0.21 m, so that equal thrusts
# balance. Pegasus' iris has the same b and speed limit (PegasusSimulator, .../thrusters/quadratic_thrust_curve.py), no
# lag and another torque, 1e-6 ω² N m, three times as large. No idle speed. Drag as above. Rotor inertia: a tenth of its
# izz, which is ten times too large because Gazebo turns it at a tenth of its speed.
_IRIS_MASS = 1.5 + 4 * 0.005 + 0.015 + 0.01
_IRIS_FRONT = float(np.arctan2(0.21, 0.13))
_IRIS = Vehicle(
    name="iris",
    mass=_IRIS_MASS,
    inertia=(0.029125, 0.029125, 0.055225),
    arm=float(np.hypot(0.13, 0.21)),
    thrust_coefficient=5.84e-6,
    torque_ratio=0.06,
    rotor_time_constant_up=0.0125,
    rotor_time_constant_down=0.025,
    rotor_speed_min=0.0,
    rotor_thrust_max=5.84e-6 * 1100.0**2,
    drag=_rotor_drag(_IRIS_MASS, 5.84e-6, 1.75e-4),
    rotor_radius=0.128,
    rotor_inertia=2.74004e-4 / 10,
    rotor_azimuth=(_IRIS_FRONT, float(np.pi) - _IRIS_FRONT, float(np.pi) + _IRIS_FRONT, float(2 * np.pi) - _IRIS_FRONT),
)

PRESETS: dict[str, Vehicle] = {
    vehicle.name: vehicle for vehicle in (_FALCON, _CRAZYFLIE, _CRAZYFLIE_ID, _HUMMINGBIRD, _IRIS)
}
