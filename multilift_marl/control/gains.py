"""Nominal parameters and gains of a team's controllers, and those of one drone as its levels take them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from multilift_marl.errors import warn_once
from multilift_marl.kernels.jit import inlined
from multilift_marl.math3d import row
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.constants import make_rig
from multilift_marl.rig.system import System
from multilift_marl.schema.control import ControlConfig

POSITION_RATIO = 5.0  # attitude's natural frequency over position's, at least


class Gains(NamedTuple):
    """Nominal parameters and gains of each drone in a team; the plant may differ."""

    mass: np.ndarray
    """(N,) [kg]."""
    inertia: np.ndarray
    """(N, 3) [kg m²]."""
    k_p: np.ndarray
    """(N,) position gain [1/s²]."""
    k_v: np.ndarray
    """(N,) velocity gain [1/s]."""
    k_R: np.ndarray
    """(N, 3) attitude gains for unit inertia [1/s²]."""
    k_w: np.ndarray
    """(N, 3) rate gains for unit inertia [1/s]."""
    allocation: np.ndarray
    """(N, 4, 4) inverse allocation matrices."""
    thrust_min: np.ndarray
    """(N,) of one rotor [N]."""
    thrust_max: np.ndarray
    """(N,) [N]."""
    load_share: np.ndarray
    """(N,) mass of payload and cable that each drone carries [kg]."""
    drag: np.ndarray
    """(N, 3) linear drag along the body axes that is fed forward [kg/s]."""
    heading: np.ndarray
    """(N,) of a drone at rest, from the team's [rad]."""
    hooks: np.ndarray
    """(N, 3) where the cable is tied, from the centre of mass, body frame [m]."""
    hooked: bool
    """Whether any hook is off its centre of mass."""


class DroneGains(NamedTuple):
    """The same of one drone: numbers, and tuples of 3."""

    mass: float
    inertia: tuple[float, float, float]
    k_p: float
    k_v: float
    k_R: tuple[float, float, float]
    k_w: tuple[float, float, float]
    allocation: np.ndarray
    """(4, 4)."""
    thrust_min: float
    thrust_max: float
    load_share: float
    drag: tuple[float, float, float]


@inlined
def drone_gains(g, n):
    """Return the DroneGains of drone n."""
    return DroneGains(
        g.mass[n], row(g.inertia, n), g.k_p[n], g.k_v[n], row(g.k_R, n), row(g.k_w, n), g.allocation[n],
        g.thrust_min[n], g.thrust_max[n], g.load_share[n], row(g.drag, n),
    )  # fmt: skip


def make_gains(control: ControlConfig, system: System) -> Gains:
    """Return gains for natural frequencies and damping ratios.

    Attitude is no faster than the motors allow (0.7/τ of the slower lag), position and yaw no faster than attitude
    allows.
    """
    vehicles, rig = system.vehicles, make_rig(system)
    motors = np.array([0.7 / vehicle.rotor_time_constant for vehicle in vehicles])
    tilt = limited(control, "attitude_frequency", motors, "0.7 / motor lag")
    position = limited(control, "position_frequency", tilt / POSITION_RATIO, "1/5 of attitude's", "attitude_frequency")
    yaw = limited(control, "yaw_frequency", tilt, "attitude's", "attitude_frequency")
    frequency = np.stack([tilt, tilt, yaw], axis=1)
    return Gains(
        mass=rig.mass,
        inertia=np.array([vehicle.inertia for vehicle in vehicles], float),
        k_p=position**2,
        # s² + 2 ζ ω s + ω².
        k_v=2 * control.position_damping * position,
        k_R=frequency**2,
        k_w=2 * control.attitude_damping * frequency,
        allocation=rig.allocation,
        thrust_min=np.array([vehicle.thrust_coefficient * vehicle.rotor_speed_min**2 for vehicle in vehicles]),
        thrust_max=np.array([vehicle.rotor_thrust_max for vehicle in vehicles], float),
        load_share=rig.force[:, 2] / GRAVITY,
        drag=np.array([vehicle.drag for vehicle in vehicles], float) * control.drag_feedforward,
        heading=rig.heading,
        hooks=rig.hooks,
        hooked=rig.hooked,
    )


def limited(control: ControlConfig, name: str, bound: np.ndarray, what: str, *others: str) -> np.ndarray:
    """Return a frequency of `control`, at most its bound (N,) [rad/s]; a warning says where that is less than set.

    Args:
        control: where it is None, the bound is taken.
        name: of the frequency.
        bound: of each drone.
        what: the bound is, in words.
        others: names of what the bound depends on; nothing was set where these and `name` have their defaults.
    """
    frequency = getattr(control, name)
    if frequency is None:
        return bound
    used = np.minimum(frequency, bound)
    fields = ControlConfig.model_fields
    if used.min() < frequency and any(getattr(control, each) != fields[each].default for each in (name, *others)):
        warn_once("control", f"control.{name}={frequency:g} is above {what}: {used.min():.3g} rad/s is used; lower it")
    return used
