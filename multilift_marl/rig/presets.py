"""Quadrotors with the numbers of real ones, each with its source."""

from __future__ import annotations

import numpy as np

from multilift_marl.physical import GRAVITY
from multilift_marl.rig.vehicle import Vehicle

# Solidity of all presets: assumed, since none of their sources states it: that of two blades as wide as 0.16 R.
# docs/air.md says how much hangs on it.

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
# 2509.14126), whose episodes draw 0.119 to 0.14 N (commit 4bcf7e6; 0.105 to 0.15 N at 02d5761). Motor lag: assumed.
# 0.15/4 s is a value that viktorlorentz/crazyMARL keeps as a comment (crazymarl/configs/multi_quad_config.py, commit
# 1b10731); it lies between CrazyS, 0.0125 s up and 0.025 s down, the numbers of RotorS' hummingbird, and those for
# which this controller is too slow: 0.15 s of CrazyMARL at 02d5761 and of arplaboratory/learning-to-fly, and 0.145 s of
# `crazyflie_id`, identified. docs/vehicles.md says what the choice does. Idle speed: stated by none of them, assumed
# zero. Rotor radius: utiasDSL/gym-pybullet-drones, gym_pybullet_drones/assets/cf2x.urdf, here and below. Rotor inertia:
# drone-models (see below), cf2x_P250.
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

# PX4/PX4-gazebo-models, models/x500_base/model.sdf (body; rotors at (± 0.174, ± 0.174, 0.06) m), models/x500/model.sdf
# (rotors' numbers); PX4's default vehicle. Inertia: body and rotors, the rotors as points, about the centre of mass,
# which is 2 mm above the body's. No idle speed. Drag as above; rolling moment off, as above. Rotor inertia: of a bar of
# 16 g as long as the rotor's box, 0.279 m; there it is half as long.
_X500_ROTOR = 0.016076923076923075
_X500_MASS = 2.0 + 4 * _X500_ROTOR
_X500_ROLL = 0.02166666666666667 + 4 * _X500_ROTOR * (0.174**2 + 2.0 / _X500_MASS * 0.06**2)  # m_1 m_2 / m z²: z apart
_X500 = Vehicle(
    name="x500",
    mass=_X500_MASS,
    inertia=(_X500_ROLL, _X500_ROLL, 0.04000000000000001 + 8 * _X500_ROTOR * 0.174**2),
    arm=0.174 * 2**0.5,
    thrust_coefficient=8.54858e-6,
    torque_ratio=0.016,
    rotor_time_constant_up=0.0125,
    rotor_time_constant_down=0.025,
    rotor_speed_min=0.0,
    rotor_thrust_max=8.54858e-6 * 1000.0**2,
    drag=_rotor_drag(_X500_MASS, 8.54858e-6, 8.06428e-5),
    rotor_radius=0.2792307692307692 / 2,
    rotor_inertia=_X500_ROTOR * (0.2792307692307692**2 + 0.016923076923076923**2) / 12,
)

PRESETS: dict[str, Vehicle] = {
    vehicle.name: vehicle for vehicle in (_FALCON, _CRAZYFLIE, _CRAZYFLIE_ID, _HUMMINGBIRD, _IRIS, _X500)
}
