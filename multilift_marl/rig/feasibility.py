"""Conditions of any system, before anything is simulated: it can hover, and time steps resolve it.

Limits of time steps are dimensionless: how far something goes within a step, in units of what the step can resolve.
There masses, moments of inertia, lengths and stiffnesses are the least that `randomization` draws, loads the largest.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from multilift_marl.errors import ConfigError, RigError
from multilift_marl.math3d import thrust_frame
from multilift_marl.physical import AIR_DENSITY, GRAVITY
from multilift_marl.rig.linearised import fastest_swing
from multilift_marl.rig.plausible import MAX_THRUST, unit_hint
from multilift_marl.rig.restitution import contact_law
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicle import Vehicle
from multilift_marl.rig.vehicles import check_rotors, describe_team
from multilift_marl.schema.sections import RandomizationConfig, SystemConfig

MIN_THRUST_TO_WEIGHT = 1.18
MAX_BENDING = 500.0  # [-] rate of bending in physics steps: substeps are as short as its inverse
MAX_WIND = 60.0  # [m/s] mean wind and gusts together; bodies diverge at 100 m/s
MAX_LOAD = 100.0  # [-] hidden force over weight of the payload
MAX_SPIN_UP = 50.0  # [rad/s] by which one physics step may change a body rate; rates diverge at 500 rad/s
MAX_NUTATION = 200.0  # [rad/s] of a drone by its rotors' momentum, and of its yaw rate when two of them stop at once
MAX_SWING = 100.0  # [rad/s] of a team at rest between its cables: five times the tension is as fast as diverges
MAX_STRAIN = 0.1  # [-] of a resting cable; cables diverge at 0.2
MAX_LIGHTNESS = 100.0  # [-] time step over the period of a chain's nodes, across their links, which substeps resolve
BOUNCING = 2.0  # [m/s] at which bodies that bounce must not pass through each other
MIN_LENGTH = 0.15  # [-] of a cable less its hook's distance from the centre of the drone, over the span of that
_OWN_SPEED = 3.0  # [m/s] of a payload through the air, beside the wind's


def check_possible(system: System, ranges: RandomizationConfig) -> None:
    """Refuse what cannot fly, the heaviest payload and the heaviest and weakest drones included.

    Raises:
        ConfigError: why not, and what to change.
    """
    vehicles, heaviest = system.vehicles, 1 + ranges.payload_mass
    if system.air.wash or system.air.ground_effect:
        for vehicle in vehicles:
            check_rotors(vehicle)
    _check_turbulence(system, ranges)
    thrust = 4 * np.array([vehicle.rotor_thrust_max for vehicle in vehicles])
    if thrust.sum() < MIN_THRUST_TO_WEIGHT * system.weight:
        lifted = "payload, drones and cables" if system.cable_mass.any() else "payload and drones"
        # The hint supposes a payload that would take 70 % of all thrust: a mistaken unit shows against it.
        load = system.payload_mass
        hint = unit_hint(load, "kg", load + (0.7 * thrust.sum() - system.weight) / GRAVITY, 30.0)
        raise ConfigError(
            f"{describe_team(vehicles)} lift {thrust.sum():.1f} N, less than {MIN_THRUST_TO_WEIGHT} × the weight of "
            f"{lifted}, {system.weight:.1f} N; lower payload.mass ({load:g} kg) or add drones{hint}"
        )
    cable_weight = system.hook_force - system.formation_force
    own = (1 + ranges.vehicle_mass) * GRAVITY * system.drone_mass[:, None] * [0, 0, 1]
    # As vectors: a leaning cable takes thrust beside what it lifts.
    hover = np.linalg.norm(heaviest * system.formation_force + cable_weight + own, axis=1)
    # The weakest rotors under the heaviest drone; `cable_weight` does not vary with the payload.
    thrust *= ranges.weakest_rotor
    if np.any(hover > thrust):
        i = int(np.argmax(hover - thrust))
        drawn = ("vehicle_mass", "vehicle_thrust_coefficient", "rotor_thrust_coefficient")
        cure = "".join(f"randomization.{name}, " for name in drawn if getattr(ranges, name))
        raise RigError(
            f"drone {i} would need {hover[i]:.1f} N of its {thrust[i]:.1f} N to hover under the heaviest payload; "
            f"lower {cure}payload.mass, randomization.payload_mass or cable.angle, or share the load by "
            "payload.anchors",
            drones=[i],
        )
    if system.hooks.any():
        _check_hooks(system, ranges)
    tight = heaviest * system.resting_tension
    if np.any(tight >= system.breaking_load):
        i = int(np.argmax(tight - system.breaking_load))
        raise RigError(
            f"cable {i} would break at rest: {tight[i]:.1f} N under the heaviest payload, but cable.breaking_load is "
            f"{system.breaking_load[i]:g} N; raise it or lower payload.mass",
            anchors=[i],
        )
    shortest = (1 - ranges.cable_length) * system.cable_length
    if (fastest := system.bending_rate(shortest)) * system.timestep > MAX_BENDING:
        # Which of the two it is: without damping the rate is that of the stiffness.
        undamped = replace(system, bending_damping=0 * system.bending_damping)
        name = "bending_stiffness" if undamped.bending_rate(shortest) == fastest else "bending_damping"
        lower = "randomization.cable_length, " if ranges.cable_length else ""
        raise ConfigError(
            f"cable.{name}={getattr(system, name).max():g} is too stiff for links so light; lower it, {lower}or "
            "cable.segments, or raise cable.density"
        )


def _check_turbulence(system: System, ranges: RandomizationConfig) -> None:
    """Refuse turbulence whose strength nothing says, and a strength without turbulence."""
    air = system.air
    if air.turbulence and air.turbulence_speed is None and not system.wind[:2].any() and not ranges.wind:
        raise ConfigError(
            "wind.turbulence is as strong as the horizontal mean wind, and there is none; set wind.turbulence_speed, "
            "wind.velocity or randomization.wind, or switch wind.turbulence off"
        )
    if air.turbulence_speed is not None and not air.turbulence:
        raise ConfigError(
            f"wind.turbulence_speed={air.turbulence_speed:g} m/s means nothing with wind.turbulence=false; set it to "
            "null, or wind.turbulence=true"
        )


def check_fixed(system: System, ranges: RandomizationConfig, fixed: Mapping[str, np.ndarray]) -> None:
    """Refuse masses and rotors fixed for episodes with which a team could not lift what it carries.

    The limit is the configuration's, or the worst that it draws anyway where that is less.

    Args:
        system, ranges: the configured ones.
        fixed: `payload_mass` (K,) [kg], `vehicle_mass` (K, N) [kg], `vehicle_thrust_coefficient` (K, N) [-] and
            `rotor_thrust_coefficient` (K, N, 4) [-] of K episodes, or some of them; other names do not count.

    Raises:
        ConfigError: naming what is fixed.
    """
    names = ("payload_mass", "vehicle_mass", "vehicle_thrust_coefficient", "rotor_thrust_coefficient")
    culprits = [name for name in names if name in fixed]
    if not culprits:
        return
    worst = _lift(
        system, (1 + ranges.payload_mass) * system.payload_mass, (1 + ranges.vehicle_mass) * system.drone_mass,
        ranges.weakest_rotor,
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
    vehicle_thrust_coefficient: np.ndarray | float = 1.0, rotor_thrust_coefficient: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Return the thrust and the weight [N] of a team, nominal where nothing else is given.

    A drone that does not turn has all rotors at the thrust of its weakest one.
    """
    payload = system.payload_mass if payload_mass is None else payload_mass
    drones = system.drone_mass if vehicle_mass is None else vehicle_mass
    thrust = 4 * np.array([vehicle.rotor_thrust_max for vehicle in system.vehicles]) * vehicle_thrust_coefficient
    if rotor_thrust_coefficient is not None:
        thrust = thrust * rotor_thrust_coefficient.min(axis=-1)
    return thrust.sum(axis=-1), GRAVITY * (payload + drones.sum(axis=-1) + system.cable_mass.sum())


def _check_hooks(system: System, ranges: RandomizationConfig) -> None:
    """Refuse hooks so far from a drone's centre that its rotors could not hold their moment."""
    heaviest, weakest = 1 + ranges.payload_mass, ranges.weakest_rotor
    cable_forces = heaviest * system.formation_force + system.hook_force - system.formation_force
    for i, vehicle in enumerate(system.vehicles):
        force = cable_forces[i] + [0, 0, (1 + ranges.vehicle_mass) * vehicle.mass * GRAVITY]
        cable_force = np.reshape(thrust_frame(tuple(force), float(system.heading[i])), (3, 3)).T @ cable_forces[i]
        # The rotors exert hook × P against the moment of the cable, hook × (-P).
        wrench = [np.linalg.norm(force), *np.cross(system.hooks[i], cable_force)]
        rotors = np.linalg.solve(vehicle.allocation, wrench)
        least = vehicle.thrust_coefficient * vehicle.rotor_speed_min**2
        most = weakest * vehicle.rotor_thrust_max
        if rotors.min() < least or rotors.max() > most:
            raise RigError(
                f"drone {i} would need {rotors.min():.2f} to {rotors.max():.2f} N of its rotors to hold the pull at "
                f"cable.hook {system.hooks[i].tolist()}, but they give {least:.2f} to "
                f"{most:.2f} N; move the hook nearer to the centre of mass{_hook_hint(system, i)}",
                drones=[i],
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
    _check_swing(ranges, system)
    _check_contact(system)


def _check_controller(config: SystemConfig, system: System) -> None:
    """Refuse filters and gains that are unstable at the rate of control."""
    control, rate = config.control, config.sim.control_hz
    if control.reference_frequency > rate / 4:
        raise ConfigError(
            f"control.reference_frequency={control.reference_frequency:g} rad/s is more than a quarter of "
            f"sim.control_hz={rate:g}, at which its filter is no longer smooth; lower it or raise sim.control_hz"
        )
    # No loop is faster than motors allow, whatever is set, see control/gains.py.
    motors = max(0.7 / vehicle.rotor_time_constant for vehicle in system.vehicles)
    attitude = min(control.attitude_frequency or motors, motors)
    position = min(control.position_frequency or motors, attitude / 5)
    for loop, frequency in (("attitude", attitude), ("position", position)):
        damping = getattr(control, f"{loop}_damping")
        # An explicit step h takes the share 2 ζ ω h from a velocity: beyond 1 that changes its sign.
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
    strongest = vehicle.rotor_thrust_max * ranges.strongest_rotor
    inertia = np.array(vehicle.inertia) * (1 - ranges.vehicle_mass)
    if 4 * strongest > MAX_THRUST * lightest * GRAVITY:
        raise ConfigError(
            f"vehicle.rotor_thrust_max={vehicle.rotor_thrust_max:g} N lifts more than {MAX_THRUST:g} × the weight of a "
            f"drone of vehicle.mass={vehicle.mass:g} kg; lower the thrust or raise the mass"
            + unit_hint(vehicle.rotor_thrust_max, "N", 3 * vehicle.mass * GRAVITY / 4)
        )
    drag = max(vehicle.drag) * (1 + ranges.vehicle_drag)
    if drag * step > lightest:
        raise ConfigError(
            f"vehicle.drag of {max(vehicle.drag):g} kg/s stops a drone of vehicle.mass={vehicle.mass:g} kg within less "
            f"than sim.timestep={step:g} s; lower the drag or the time step, or raise the mass"
        )
    # Rotors that damp the climb by c [kg/s] damp the roll by c a²/2, each a/√2 off the axis: c h is to be below m and
    # 2 J/a².
    least = min(lightest, 2 * inertia.min() / vehicle.arm**2)
    if system.inflow and vehicle.inflow_damping * ranges.strongest_rotor * step > least:
        raise ConfigError(
            f"inflow into rotors of vehicle.rotor_radius={vehicle.rotor_radius:g} m stops a drone of vehicle.mass="
            f"{vehicle.mass:g} kg and vehicle.inertia {list(vehicle.inertia)} kg m² within less than sim.timestep="
            f"{step:g} s; lower vehicle.rotor_solidity or the time step, or set wind.inflow=false"
        )
    # Rows of A: moments of all rotors at full thrust that turn it one way, the others idle.
    torque = strongest * np.maximum(vehicle.allocation, 0).sum(axis=1)[1:]  # of the rotors that turn it one way
    spin_up = (torque / inertia).max() * step
    if spin_up > MAX_SPIN_UP:
        raise ConfigError(
            f"its rotors turn a drone of vehicle.inertia {list(vehicle.inertia)} kg m² by {spin_up:.3g} rad/s faster "
            f"within sim.timestep={step:g} s, more than {MAX_SPIN_UP:g} rad/s; raise vehicle.inertia, or lower "
            "vehicle.rotor_thrust_max, vehicle.arm or vehicle.torque_ratio"
        )
    # Of two rotors of one sense at full speed, while the others stand.
    momentum = 2 * vehicle.rotor_inertia * vehicle.rotor_speed_max
    gyroscopic = momentum / min(np.sqrt(inertia[0] * inertia[1]), inertia[2])  # nutation; spin after two rotors stop
    if gyroscopic * step > 1 or gyroscopic > MAX_NUTATION:
        fast = f"sim.timestep={step:g} s resolves" if gyroscopic * step > 1 else f"{MAX_NUTATION:g} rad/s"
        raise ConfigError(
            f"rotors of vehicle.rotor_inertia={vehicle.rotor_inertia:g} kg m² at {vehicle.rotor_speed_max:.3g} rad/s "
            f"let a drone of vehicle.inertia {list(vehicle.inertia)} kg m² nutate or spin at {gyroscopic:.3g} rad/s, "
            f"faster than {fast}; lower vehicle.rotor_inertia or raise vehicle.thrust_coefficient"
            + unit_hint(vehicle.rotor_inertia, "kg m²", min(vehicle.inertia) / 400)
        )
    rolling = 2 * vehicle.rolling_moment * vehicle.rotor_speed_max  # two rotors turn one way, the others not
    moments = np.array([np.hypot(rolling, system.air.roll_moment), rolling])
    spin_up = (moments / inertia[:2]).max() * (wind + _OWN_SPEED) * step
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
    # ½ ρ C_d A |v| v: at a speed |v| it acts like a linear drag of |v| times that.
    drag = 0.5 * AIR_DENSITY * system.payload_drag_area * (1 + ranges.payload_drag)
    if drag * (wind + _OWN_SPEED) * step > lightest:
        hint = unit_hint(system.payload_drag_area, "m²", system.payload_size.max() ** 2, 100.0)
        raise ConfigError(
            f"payload.drag_area={system.payload_drag_area:g} m² stops the lightest payload, {lightest:g} kg, within "
            f"less than sim.timestep={step:g} s at {wind + _OWN_SPEED:g} m/s; lower the area, the wind or the time "
            f"step, or raise payload.mass{hint}"
        )


def _check_swing(ranges: RandomizationConfig, system: System) -> None:
    """Refuse a payload or a drone that turns between its cables faster than a physics step resolves."""
    swing = fastest_swing(system, ranges)
    if swing.rate * system.timestep <= 1 and swing.rate <= MAX_SWING:
        return
    step = system.timestep
    fast = f"sim.timestep={step:g} s resolves" if swing.rate * step > 1 else f"{MAX_SWING:g} rad/s"
    lower = "" if swing.rate > MAX_SWING else ", or lower sim.timestep"
    drone = swing.body - 1
    # Without any ranges: if that is slow enough, the ranges are to blame and not the rig.
    nominal = fastest_swing(system, RandomizationConfig()).rate
    if nominal * step <= 1 and nominal <= MAX_SWING:
        raise ConfigError(
            f"what randomization draws lets bodies turn between their cables at {swing.rate:.4g} rad/s, faster than "
            f"{fast}, nominally at {nominal:.4g} rad/s; lower randomization.payload_inertia, "
            f"randomization.payload_center_of_mass, randomization.payload_mass or randomization.cable_length{lower}"
        )
    if not swing.turns:
        body = "the payload" if drone < 0 else f"drone {drone}"
        moves, cure = f"{body} swings on its cable", "raise cable.length"
    elif drone < 0:
        inertia = ", ".join(f"{moment:.3g}" for moment in system.payload_inertia)
        moves = f"a payload of payload.inertia [{inertia}] kg m² turns to and fro between its cables"
        cure = "raise payload.inertia or payload.size"
    else:
        moves = f"drone {drone} turns to and fro about its cable.hook {system.hooks[drone].tolist()}"
        cure = "raise vehicle.inertia or move the hook nearer to the centre of mass"
    raise ConfigError(f"{moves} at {swing.rate:.4g} rad/s, faster than {fast}; {cure}{lower}")


def _hook_hint(system: System, i: int) -> str:
    """Return a hint at the unit of the hook of a drone, "" if it is near it."""
    away, span = float(np.linalg.norm(system.hooks[i])), system.vehicles[i].span
    return unit_hint(away, "m", 0.3 * span).replace("that", "cable.hook") if away > 3 * span else ""


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
            + _hook_hint(system, i)
        )
    if not system.cable_mass.any():
        return
    node, link = system.cable_mass / (system.cable_segments - 1), shortest / system.cable_segments
    # h √(T/(m l)), with mass m of a node and length l of a link of the shortest cable, which weighs less, too.
    lightness = system.timestep * np.sqrt(tension / (node * link * shortest / system.cable_length))
    if np.any(lightness > MAX_LIGHTNESS):
        i = int(np.argmax(lightness))
        raise ConfigError(
            f"nodes of {node[i]:.3g} kg in chain {i} are too light for sim.timestep={system.timestep:g} s; raise "
            "cable.density, or lower cable.segments or sim.timestep"
        )


def _check_contact(system: System) -> None:
    """Refuse a restitution so large that contact, soft enough to last for physics steps, lets bodies through."""
    stiffness, _ = contact_law(system.contact.restitution, system.timestep)
    # Of an undamped spring: ½ v² = ½ k x², over the mass.
    depth = BOUNCING / np.sqrt(stiffness)
    thinnest = min(system.payload_size.min() / 2, *(vehicle.half_size.min() for vehicle in system.vehicles))
    if system.contact.restitution > 0 and depth > thinnest:
        raise ConfigError(
            f"contact.restitution={system.contact.restitution:g} with sim.timestep={system.timestep:g} s makes contact "
            f"so soft that bodies which meet at {BOUNCING:g} m/s sink in by {1e3 * depth:.3g} mm, more than half the "
            f"thickness of the thinnest, {1e3 * thinnest:.3g} mm; lower one of them"
        )
