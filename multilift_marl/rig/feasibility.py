"""Conditions of any system, before anything is simulated: it can hover, drones keep apart, time steps resolve it.

Limits of time steps are dimensionless: how far something goes within a step, in units of what the step can resolve.
There masses, moments of inertia, lengths and stiffnesses are the least that `randomization` draws, loads the largest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from multilift_marl.config.schema import RandomizationConfig, SystemConfig
from multilift_marl.errors import ConfigError
from multilift_marl.math3d import thrust_frame
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import AIR_DENSITY, GRAVITY, Vehicle, check_rotors, describe_team

MIN_THRUST_TO_WEIGHT = 1.18
MAX_BENDING = 500.0  # [-] rate of bending in physics steps: substeps are as short as its inverse
MAX_WIND = 60.0  # [m/s] mean wind and gusts together; bodies diverge at 100 m/s
MAX_THRUST = 50.0  # [-] of a drone over its weight
MAX_LOAD = 100.0  # [-] hidden force over weight of the payload
MAX_SPIN_UP = 50.0  # [rad/s] by which one physics step may change a body rate; rates diverge at 500 rad/s
MAX_NUTATION = 200.0  # [rad/s] of a drone, also about twice its yaw rate when two rotors stop at once
MAX_SWING = 100.0  # [rad/s] of a payload at rest between its cables: five times the tension is as fast as diverges
MAX_STRAIN = 0.1  # [-] of a resting cable; cables diverge at 0.2
MAX_LIGHTNESS = 100.0  # [-] time step over the period of a chain's nodes, across their links, which substeps resolve
MIN_LENGTH = 0.15  # [-] of a cable less its hook's distance from the centre of the drone, over the span of that
_OWN_SPEED = 3.0  # [m/s] of a payload through the air, beside the wind's


def check_possible(system: System, ranges: RandomizationConfig) -> None:
    """Refuse what cannot fly, the heaviest payload and the heaviest and weakest drones included.

    Raises:
        ConfigError: why not, and what to change.
    """
    n, vehicles, heaviest = system.num_drones, system.vehicles, 1 + ranges.payload_mass
    if system.air.wash or system.air.ground_effect:
        for vehicle in vehicles:
            check_rotors(vehicle)
    if system.air.turbulence and not system.wind[:2].any() and not ranges.wind:
        raise ConfigError(
            "wind.turbulence is as strong as the horizontal mean wind, and there is none; set wind.velocity or "
            "randomization.wind, or switch wind.turbulence off"
        )
    thrust = 4 * np.array([vehicle.rotor_thrust_max for vehicle in vehicles])
    if thrust.sum() < MIN_THRUST_TO_WEIGHT * system.weight:
        lifted = "payload, drones and cables" if system.cable_mass.any() else "payload and drones"
        raise ConfigError(
            f"{describe_team(vehicles)} lift {thrust.sum():.1f} N, less than {MIN_THRUST_TO_WEIGHT} × the weight of "
            f"{lifted}, {system.weight:.1f} N; lower payload.mass ({system.payload_mass:g} kg) or add drones"
        )
    cable_weight = system.hook_force - system.formation_force
    own = (1 + ranges.vehicle_mass) * GRAVITY * system.drone_mass[:, None] * [0, 0, 1]
    hover = np.linalg.norm(heaviest * system.formation_force + cable_weight + own, axis=1)
    thrust *= 1 - ranges.vehicle_thrust_coefficient
    if np.any(hover > thrust):
        i = int(np.argmax(hover - thrust))
        varied = ranges.vehicle_mass or ranges.vehicle_thrust_coefficient
        cure = "randomization.vehicle_mass, randomization.vehicle_thrust_coefficient, " if varied else ""
        raise ConfigError(
            f"drone {i} would need {hover[i]:.1f} N of its {thrust[i]:.1f} N to hover under the heaviest payload; "
            f"lower {cure}payload.mass, randomization.payload_mass or cable.angle, or share the load by payload.anchors"
        )
    if system.hooks.any():
        _check_hooks(system, ranges)
    tight = heaviest * system.resting_tension
    if np.any(tight >= system.breaking_load):
        i = int(np.argmax(tight - system.breaking_load))
        raise ConfigError(
            f"cable {i} would break at rest: {tight[i]:.1f} N under the heaviest payload, but cable.breaking_load is "
            f"{system.breaking_load[i]:g} N; raise it or lower payload.mass"
        )
    shortest = (1 - ranges.cable_length) * system.cable_length
    if (fastest := system.bending_rate(shortest)) * system.timestep > MAX_BENDING:
        undamped = replace(system, bending_damping=0 * system.bending_damping)
        name = "bending_stiffness" if undamped.bending_rate(shortest) == fastest else "bending_damping"
        lower = "randomization.cable_length, " if ranges.cable_length else ""
        raise ConfigError(
            f"cable.{name}={getattr(system, name).max():g} is too stiff for links so light; lower it, {lower}or "
            "cable.segments, or raise cable.density"
        )
    if n > 1:
        _check_separation(system, ranges)


def _check_separation(system: System, ranges: RandomizationConfig) -> None:
    """Refuse drones that rest too close, nominally or with the lightest payload on the shortest and stiffest cables."""
    strain = np.linalg.norm(system.formation_force, axis=1) / (system.cable_stiffness * system.cable_length)
    least = strain * (1 - ranges.payload_mass) / ((1 + ranges.cable_stiffness) * (1 - ranges.cable_length))
    shorter = 1 - (1 - ranges.cable_length) * (1 + least) / (1 + strain)
    for verb, share in (("would", 0.0 * shorter), ("may", shorter)):
        slots = system.slots - share[:, None] * (system.cable_ends - system.anchors)
        apart = np.linalg.norm(slots[:, None] - slots[None], axis=-1) + 1e9 * np.eye(system.num_drones)
        i, j = (int(k) for k in np.unravel_index(np.argmin(apart - system.min_separation), apart.shape))
        if apart[i, j] < system.min_separation[i, j]:
            lower = "lower randomization.cable_length, " if verb == "may" and ranges.cable_length else ""
            raise ConfigError(
                f"neighbouring drones {i} and {j} {verb} rest {apart[i, j]:.2f} m apart, closer than the separation "
                f"limit of {system.min_separation[i, j]:.2f} m; {lower}spread payload.anchors or raise cable.length or "
                "cable.angle"
            )


def check_fixed(system: System, ranges: RandomizationConfig, fixed: Mapping[str, np.ndarray]) -> None:
    """Refuse masses and rotors fixed for episodes with which a team could not lift what it carries.

    The limit is the configuration's, or the worst that it draws anyway where that is less.

    Args:
        system, ranges: the configured ones.
        fixed: `payload_mass` (K,) [kg], `vehicle_mass` (K, N) [kg] and `vehicle_thrust_coefficient` (K, N) [-] of K
            episodes, or some of them; other names do not count.

    Raises:
        ConfigError: naming what is fixed.
    """
    culprits = [name for name in ("payload_mass", "vehicle_mass", "vehicle_thrust_coefficient") if name in fixed]
    if not culprits:
        return
    worst = _lift(
        system, (1 + ranges.payload_mass) * system.payload_mass, (1 + ranges.vehicle_mass) * system.drone_mass,
        1 - ranges.vehicle_thrust_coefficient,
    )  # fmt: skip
    thrust, weight = np.broadcast_arrays(*_lift(system, **{name: fixed[name] for name in culprits}))
    limit = min(MIN_THRUST_TO_WEIGHT, worst[0] / worst[1])
    short = np.flatnonzero(thrust < limit * weight * (1 - 1e-9))
    if len(short):
        least = short[0]
        raise ConfigError(
            f"with the {' and '.join(culprits)} that reset is to fix, {describe_team(system.vehicles)} lift "
            f"{thrust[least]:.1f} N, less than {limit:.3g} × their weight with the payload, {weight[least]:.1f} N; "
            "fix lighter bodies or stronger rotors"
        )


def _lift(
    system: System, payload_mass: np.ndarray | float | None = None, vehicle_mass: np.ndarray | None = None,
    vehicle_thrust_coefficient: np.ndarray | float = 1.0,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the thrust and the weight [N] of a team, nominal where nothing else is given."""
    payload = system.payload_mass if payload_mass is None else payload_mass
    drones = system.drone_mass if vehicle_mass is None else vehicle_mass
    thrust = 4 * np.array([vehicle.rotor_thrust_max for vehicle in system.vehicles]) * vehicle_thrust_coefficient
    return thrust.sum(axis=-1), GRAVITY * (payload + drones.sum(axis=-1) + system.cable_mass.sum())


def _check_hooks(system: System, ranges: RandomizationConfig) -> None:
    """Refuse hooks so far from a drone's centre that its rotors could not hold their moment."""
    heaviest, weakest = 1 + ranges.payload_mass, 1 - ranges.vehicle_thrust_coefficient
    cable_forces = heaviest * system.formation_force + system.hook_force - system.formation_force
    for i, vehicle in enumerate(system.vehicles):
        force = cable_forces[i] + [0, 0, (1 + ranges.vehicle_mass) * vehicle.mass * GRAVITY]
        cable_force = np.reshape(thrust_frame(tuple(force), 0.0), (3, 3)).T @ cable_forces[i]
        wrench = [np.linalg.norm(force), *np.cross(system.hooks[i], cable_force)]
        rotors = np.linalg.solve(vehicle.allocation, wrench)
        least = vehicle.thrust_coefficient * vehicle.rotor_speed_min**2
        most = weakest * vehicle.rotor_thrust_max
        if rotors.min() < least or rotors.max() > most:
            raise ConfigError(
                f"drone {i} would need {rotors.min():.2f} to {rotors.max():.2f} N of its rotors to hold the pull at "
                f"cable.hook {system.hooks[i].tolist()}, but they give {least:.2f} to "
                f"{most:.2f} N; move the hook nearer to the centre of mass"
            )


def check_resolved(config: SystemConfig, system: System) -> None:
    """Refuse what the control step and the physics step cannot follow.

    Raises:
        ConfigError: what is too fast, and what to change.
    """
    ranges = config.randomization
    _check_controller(config, system)
    wind = _find_wind(config)
    for i, vehicle in enumerate(system.vehicles):
        try:
            _check_drone(vehicle, ranges, wind, system)
        except ConfigError as error:
            raise error if len(set(system.vehicles)) == 1 else ConfigError(f"drone {i}: {error}") from None
    _check_payload(ranges, wind, system)
    _check_cables(ranges, system)


def _check_controller(config: SystemConfig, system: System) -> None:
    """Refuse filters and gains that are unstable at the rate of control."""
    control, rate = config.control, config.sim.control_hz
    if control.reference_frequency > rate / 4:
        raise ConfigError(
            f"control.reference_frequency={control.reference_frequency:g} rad/s is more than a quarter of "
            f"sim.control_hz={rate:g}, at which its filter is no longer smooth; lower it or raise sim.control_hz"
        )
    attitude = control.attitude_frequency or max(0.7 / vehicle.rotor_time_constant for vehicle in system.vehicles)
    position = control.position_frequency or attitude / 5  # null: as fast as motors allow, see control/gains.py
    for loop, frequency in (("attitude", attitude), ("position", position)):
        damping = getattr(control, f"{loop}_damping")
        if 2 * damping * frequency > rate:
            raise ConfigError(
                f"control.{loop}_frequency={frequency:g} rad/s with control.{loop}_damping={damping:g} damps within "
                f"less than one step of sim.control_hz={rate:g}; lower one of them or raise sim.control_hz"
            )


def _find_wind(config: SystemConfig) -> float:
    """Return the largest speed of the air [m/s], turbulence aside; a ConfigError if it is too large."""
    wind = float(np.linalg.norm(config.wind.velocity) + np.linalg.norm(config.wind.gust)) + config.randomization.wind
    if wind > MAX_WIND:
        raise ConfigError(
            f"wind.velocity, randomization.wind and wind.gust add up to {wind:g} m/s, more than {MAX_WIND:g} m/s; "
            "lower them"
        )
    return wind


def _check_drone(vehicle: Vehicle, ranges: RandomizationConfig, wind: float, system: System) -> None:
    """Refuse a drone that its rotors or the air would throw about within a physics step."""
    step, lightest = system.timestep, vehicle.mass * (1 - ranges.vehicle_mass)
    strongest = vehicle.rotor_thrust_max * (1 + ranges.vehicle_thrust_coefficient)
    inertia = np.array(vehicle.inertia) * (1 - ranges.vehicle_mass)
    if 4 * strongest > MAX_THRUST * lightest * GRAVITY:
        raise ConfigError(
            f"vehicle.rotor_thrust_max={vehicle.rotor_thrust_max:g} N lifts more than {MAX_THRUST:g} × the weight of a "
            f"drone of vehicle.mass={vehicle.mass:g} kg; lower the thrust or raise the mass"
        )
    drag = max(vehicle.drag) * (1 + ranges.vehicle_drag)
    if drag * step > lightest:
        raise ConfigError(
            f"vehicle.drag of {max(vehicle.drag):g} kg/s stops a drone of vehicle.mass={vehicle.mass:g} kg within less "
            f"than sim.timestep={step:g} s; lower the drag or the time step, or raise the mass"
        )
    arm = np.abs(vehicle.rotor_positions).sum(axis=0) / 2
    torque = 2 * strongest * np.array([arm[1], arm[0], vehicle.torque_ratio])
    spin_up = (torque / inertia).max() * step
    if spin_up > MAX_SPIN_UP:
        raise ConfigError(
            f"its rotors turn a drone of vehicle.inertia {list(vehicle.inertia)} kg m² by {spin_up:.3g} rad/s faster "
            f"within sim.timestep={step:g} s, more than {MAX_SPIN_UP:g} rad/s; raise vehicle.inertia, or lower "
            "vehicle.rotor_thrust_max, vehicle.arm or vehicle.torque_ratio"
        )
    gyroscopic = 2 * vehicle.rotor_inertia * vehicle.rotor_speed_max / inertia.min()
    if gyroscopic * step > 1 or gyroscopic > MAX_NUTATION:
        fast = f"sim.timestep={step:g} s resolves" if gyroscopic * step > 1 else f"{MAX_NUTATION:g} rad/s"
        raise ConfigError(
            f"rotors of vehicle.rotor_inertia={vehicle.rotor_inertia:g} kg m² at {vehicle.rotor_speed_max:.3g} rad/s "
            f"let a drone of vehicle.inertia {list(vehicle.inertia)} kg m² nutate at {gyroscopic:.3g} rad/s, faster "
            f"than {fast}; lower vehicle.rotor_inertia or raise vehicle.thrust_coefficient"
        )
    rolling = 4 * vehicle.rolling_moment * vehicle.rotor_speed_max + abs(system.air.roll_moment)
    spin_up = rolling * (wind + _OWN_SPEED) / inertia.min() * step
    if spin_up > MAX_SPIN_UP:
        raise ConfigError(
            f"vehicle.rolling_moment and wind.roll_moment turn a drone by {spin_up:.3g} rad/s faster within "
            f"sim.timestep={step:g} s at {wind + _OWN_SPEED:g} m/s, more than {MAX_SPIN_UP:g} rad/s; lower them"
        )


def _check_payload(ranges: RandomizationConfig, wind: float, system: System) -> None:
    """Refuse a payload that air, hidden force or cables would throw about within a physics step."""
    step, lightest = system.timestep, system.payload_mass * (1 - ranges.payload_mass)
    if ranges.payload_force > MAX_LOAD * lightest * GRAVITY:
        raise ConfigError(
            f"randomization.payload_force={ranges.payload_force:g} N is more than {MAX_LOAD:g} × the weight of the "
            f"lightest payload, {lightest * GRAVITY:.3g} N; lower it or raise payload.mass"
        )
    drag = 0.5 * AIR_DENSITY * system.payload_drag_area * (1 + ranges.payload_drag)
    if drag * (wind + _OWN_SPEED) * step > lightest:
        raise ConfigError(
            f"payload.drag_area={system.payload_drag_area:g} m² stops the lightest payload, {lightest:g} kg, within "
            f"less than sim.timestep={step:g} s at {wind + _OWN_SPEED:g} m/s; lower the area, the wind or the time "
            "step, or raise payload.mass"
        )
    if system.payload_shape == "point":
        return
    least = system.payload_inertia.min() * (1 - ranges.payload_mass) * (1 - ranges.payload_inertia)
    reach = np.linalg.norm(system.anchors, axis=1)
    stiffest = (1 + ranges.payload_mass) * float(reach @ np.linalg.norm(system.formation_force, axis=1))
    swing = np.sqrt(stiffest / least)
    if swing * step > 1 or swing > MAX_SWING:
        fast = f"sim.timestep={step:g} s resolves" if swing * step > 1 else f"{MAX_SWING:g} rad/s"
        raise ConfigError(
            f"a payload whose least moment of inertia is {least:.3g} kg m² turns to and fro between its cables at "
            f"{swing:.3g} rad/s, faster than {fast}; raise payload.inertia or payload.size"
            + (", or lower sim.timestep" if swing < MAX_SWING else "")
        )


def _check_cables(ranges: RandomizationConfig, system: System) -> None:
    """Refuse cables too soft, too short or, of chains, too light."""
    tension = np.linalg.norm((1 + ranges.payload_mass) * system.formation_force, axis=1)
    shortest = (1 - ranges.cable_length) * system.cable_length
    strain = tension / ((1 - ranges.cable_stiffness) * system.cable_stiffness * shortest)
    if np.any(strain > MAX_STRAIN):
        i = int(np.argmax(strain))
        raise ConfigError(
            f"cable {i} would stretch by {100 * strain[i]:.3g} % at rest under the heaviest payload, more than "
            f"{100 * MAX_STRAIN:g} %; raise cable.stiffness={system.cable_stiffness[i]:g} N/m or lower payload.mass"
        )
    least = MIN_LENGTH * np.array([vehicle.span for vehicle in system.vehicles]) + np.linalg.norm(system.hooks, axis=1)
    if np.any(shortest < least):
        i = int(np.argmin(shortest - least))
        raise ConfigError(
            f"cable {i} may be {shortest[i]:.3g} m long, less than {least[i]:.3g} m, {MIN_LENGTH:g} × the span of its "
            "drone and the distance of cable.hook; raise cable.length or lower randomization.cable_length"
        )
    if not system.cable_mass.any():
        return
    node, link = system.cable_mass / (system.cable_segments - 1), shortest / system.cable_segments
    lightness = system.timestep * np.sqrt(tension / (node * link * shortest / system.cable_length))
    if np.any(lightness > MAX_LIGHTNESS):
        i = int(np.argmax(lightness))
        raise ConfigError(
            f"nodes of {node[i]:.3g} kg in chain {i} are too light for sim.timestep={system.timestep:g} s; raise "
            "cable.density, or lower cable.segments or sim.timestep"
        )
