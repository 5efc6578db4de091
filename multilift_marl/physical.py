"""Constants of nature, as every part of the package takes them."""

from __future__ import annotations

GRAVITY = 9.81  # [m/s²]
AIR_DENSITY = 1.225  # [kg/m³] at sea level, 15 °C (ISA)
LIFT_SLOPE = 5.73  # [1/rad] of a blade's sections: 0.1 a degree (Leishman, Principles of Helicopter Aerodynamics, 3.2)
