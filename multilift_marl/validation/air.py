"""Turbulence, gusts, rotor wash, inflow and ground effect against their formulas (docs/air.md)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from multilift_marl.kernels.jit import kernel
from multilift_marl.physical import AIR_DENSITY, GRAVITY, LIFT_SLOPE
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicle import Vehicle
from multilift_marl.sim.air import GROWTH, SPREADING, ground_gain, make_air, wash_at
from multilift_marl.sim.gusts import advance_turbulence, dryden, start_turbulence, turbulence
from multilift_marl.sim.state import Air
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Plot, Result, Row, make_config, ms

WIND = 5.0  # [m/s] along x; also the airspeed
COMPONENTS = ("u", "v", "w")


def sample_turbulence(height: float, timestep: float, steps: int, series: int, every: int = 1) -> np.ndarray:
    """Return independent series of turbulence at a height [m] in a wind of `WIND` (series, steps, 3) [m/s].

    Args:
        height: [m].
        timestep: [s].
        steps: kept of each series.
        series: how many.
        every: time steps between those kept.
    """
    air = Air.zeros(series, 0)
    air.generator[:] = np.random.SeedSequence(1).generate_state(series, np.uint64)
    out = np.zeros((series, steps, 3))
    _sample(air, float(height), float(timestep), every, out)
    return out


@kernel
def _sample(air, height, timestep, every, out):
    across, upward, long, high = dryden(height, WIND)
    for e in range(out.shape[0]):
        start_turbulence(e, air)
        for i in range(out.shape[1]):
            out[e, i] = turbulence(e, air, across, upward, (WIND, 0.0, 0.0))
            for _ in range(every):
                advance_turbulence(e, air, timestep * WIND / long, timestep * WIND / high)


def _scale(component: str, height: float) -> tuple[float, float]:
    """Return intensity [m/s] and time scale L/V [s] of a component."""
    across, upward, long, high = dryden(height, WIND)
    return (upward, high / WIND) if component == "w" else (across, long / WIND)


def correlation(component: str, height: float, lag: float | np.ndarray) -> np.ndarray:
    """Return the closed form of a component's autocorrelation [m²/s²] at a time lag [s]: that of its spectrum."""
    sigma, seconds = _scale(component, height)
    a = np.abs(lag) / seconds
    return sigma**2 * np.exp(-a) * (1.0 if component == "u" else 1 - a / 2)


def spectrum(component: str, height: float, frequency: np.ndarray) -> np.ndarray:
    """Return MIL-F-8785C's one-sided spectral density of a component [m²/s² per Hz] at a frequency [Hz]."""
    sigma, seconds = _scale(component, height)
    # Each integrates to σ² over the positive frequencies.
    x = (2 * np.pi * frequency * seconds) ** 2
    shape = 2 / (1 + x) if component == "u" else (1 + 3 * x) / (1 + x) ** 2
    return 2 * sigma**2 * seconds * shape


def turbulence_spectra(fast: bool) -> Result:
    """Dryden turbulence at 3 and 30 m: variance at two time steps, autocorrelation and spectrum of each component."""
    result = Result()
    for height in (3.0, 30.0):
        for timestep in (4e-3, 1e-3):
            samples = sample_turbulence(height, timestep, 2, 4000 if fast else 20000, every=round(0.2 / timestep))
            for i, name in enumerate(COMPONENTS):
                for lag in (0.0, 0.2):
                    theory = float(correlation(name, height, lag))
                    found = float((samples[:, 1 if lag == 0.0 else 0, i] * samples[:, 1, i]).mean())
                    error = abs(found - theory) / float(correlation(name, height, 0.0))
                    quantity = f"autocorrelation of {name} at {lag:g} s [m²/s²], error over the variance"
                    label = f"turbulence, {height:g} m, {ms(timestep)}"
                    result.rows.append(Row(label, quantity, theory, found, error, 0.1 if fast else 0.045))
        _add_spectra(result, height, fast)
    series = sample_turbulence(3.0, 0.004, 5000, 1)[0]
    plot = Plot("turbulence", "turbulence at 3 m in a wind of 5 m/s", "time [s]", "velocity [m/s]")
    for i, name in enumerate(COMPONENTS):
        plot.add(name, 0.004 * np.arange(len(series)), series[:, i])
    result.plots.append(plot)
    return result


def _add_spectra(result: Result, height: float, fast: bool) -> None:
    """Add the spectra at a height, averaged over third-octave bands, and their plot."""
    every = 5
    timestep = 0.004
    steps = 8192
    samples = sample_turbulence(height, timestep, steps, 40 if fast else 200, every)
    window = np.hanning(steps)[:, None]
    interval = every * timestep
    power = np.abs(np.fft.rfft(samples * window, axis=1)) ** 2
    # Periodogram, one-sided, over the mean square of the window.
    density = 2 * interval * power.mean(axis=0) / (window**2).sum()
    frequency = np.fft.rfftfreq(steps, interval)
    edges = np.geomspace(0.02, 5.0, 25)
    band = np.digitize(frequency, edges)

    def average(values: np.ndarray) -> np.ndarray:
        return np.array([values[band == j].mean() for j in range(1, len(edges))])

    title = f"turbulence at {height:g} m in a wind of 5 m/s"
    plot = Plot(
        f"turbulence_spectrum_{height:g}_m", title, "frequency [Hz]", "spectral density [m²/s² per Hz]", log="xy"
    )
    for i, name in enumerate(COMPONENTS):
        aliases = (spectrum(name, height, np.abs(frequency + k / interval)) for k in range(-20, 21))
        theory = average(sum(aliases, np.zeros_like(frequency)))  # as sampled
        found = average(density[:, i])
        error = float(np.abs(np.log(found / theory)).max())
        quantity = f"spectral density of {name}, 0.02-5 Hz, largest |log| of the ratio"
        result.check(f"turbulence, {height:g} m", quantity, error, 0.4 if fast else 0.2)
        plot.add(name, average(frequency), found)
        plot.add("" if i else "MIL-F-8785C, as sampled", average(frequency), theory, theory=True)
    result.plots.append(plot)


def _system(**values: Any) -> System:
    """Return a team of one drone on a long cable; values as wind__wash."""
    return make_config(1, cable__length=20.0, **values).system


def _apart(system: System) -> World:
    """Return a world of one drone at 102 m and its payload at 100 m on a long, slack cable, at rest."""
    world = World(system, 1, 1)
    world.state.payload_position[:] = [0, 0, 100]
    world.state.drone_position[:] = [0, 0, 102]
    world.state.drone_rotation[:] = np.eye(3)
    world.state.rotor_speed[:] = np.sqrt(system.vehicle.mass * GRAVITY / 4 / system.vehicle.thrust_coefficient)
    world.load(np.ones(1, bool))
    return world


def gust(fast: bool) -> Result:
    """A "1 - cosine" gust: its profile, and what it does to a drone with linear drag."""
    amplitude = np.array([2.0, -1.0, 0.5])
    start = 0.2
    rise = 0.5
    hold = 0.3
    seconds = 2.0
    system = _system(wind__gust=amplitude.tolist(), wind__gust_start=start, wind__gust_rise=rise, wind__gust_hold=hold)
    world = _apart(system)
    vehicle = system.vehicle
    h = system.timestep

    def profile(t: np.ndarray) -> np.ndarray:
        phase = np.clip(t - start, 0, rise) - np.clip(t - start - rise - hold, 0, rise)
        return 0.5 - 0.5 * np.cos(np.pi * phase / rise)

    t = h * np.arange(round(seconds / h))
    thrust = np.full((1, 1, 4), vehicle.mass * GRAVITY / 4)
    found = []
    speed = []
    for _ in t:
        world.step(thrust)
        found.append(world.air.gust[0].copy())
        speed.append(float(world.state.drone_velocity[0, 0, 0]))
    error = float(np.abs(np.array(found) - profile(t)[:, None] * amplitude).max())
    result = Result()
    result.check("gust", "largest error of its profile [m/s]", error, 1e-12)
    rate = vehicle.drag[0] / vehicle.mass
    fine = np.linspace(0, seconds, 200001)
    theory = rate * float(np.trapezoid(amplitude[0] * profile(fine) * np.exp(-rate * (seconds - fine)), fine))
    result.compare("gust", "speed of a drone after 2 s [m/s], relative error", theory, speed[-1], 0.005)
    plot = Plot("gust", "gust and what it does to a drone, along x", "time [s]", "velocity [m/s]")
    plot.add("air", t, np.array(found)[:, 0])
    plot.add("drone", t + h, np.array(speed))
    plot.add("1 - cosine", t, profile(t) * amplitude[0], theory=True)
    result.plots.append(plot)
    return result


def wash(fast: bool) -> Result:
    """The wash below a hovering drone: momentum theory at the rotors, momentum at any distance, nothing above."""
    system = _system(wind__wash=True)
    world = _apart(system)
    c = make_air(system)
    vehicle = system.vehicle
    thrust = vehicle.mass * GRAVITY
    result = Result()

    def velocity(x: float, y: float, depth: float) -> np.ndarray:
        return np.array(wash_at(0, (x, y, 102.0 - depth), 0.0, world.state, c))

    x, y = vehicle.rotor_positions[0][:2]
    induced = float(np.sqrt(thrust / 4 / (2 * AIR_DENSITY * np.pi * vehicle.rotor_radius**2)))
    quantity = "under a rotor, 2 v_i of momentum theory [m/s], relative error"
    result.compare("wash", quantity, 2 * induced, -velocity(x, y, 1e-6)[2], 1e-4)
    result.check("wash", "speed above the rotors [m/s]", float(np.linalg.norm(velocity(x, y, -0.5))), 0.0)
    for depth in (0.1, 0.5, 2.0, 8.0):
        half = vehicle.arm + 5 * max(vehicle.rotor_radius, SPREADING * depth)
        grid = np.linspace(-half, half, 101)
        flux = AIR_DENSITY * sum(velocity(x, y, depth)[2] ** 2 for x in grid for y in grid) * (grid[1] - grid[0]) ** 2
        result.compare("wash", f"momentum flux {depth:g} m below = thrust [N], relative error", thrust, flux, 2e-3)
    far = float(np.sqrt(thrust / (np.pi * AIR_DENSITY)) / (GROWTH * 20.0))
    quantity = "20 m below, one jet √(T/πρ)/b [m/s], relative error"
    result.compare("wash", quantity, far, -velocity(0.0, 0.0, 20.0)[2], 0.01)
    world.step(np.full((1, 1, 4), thrust / 4))
    square = (2.0 * GROWTH) ** 2 + system.payload_drag_area / np.pi  # of a Gaussian jet, averaged over the payload
    # Four jets, each an arm's length from the middle.
    squared = thrust / (AIR_DENSITY * np.pi * square) * np.exp(-(vehicle.arm**2) / square)
    pushed = 0.5 * AIR_DENSITY * system.payload_drag_area * squared / system.payload_mass
    found = -world.state.payload_velocity[0, 2] / system.timestep - GRAVITY
    result.compare("wash", "acceleration of a payload 2 m below [m/s²], relative error", pushed, found, 1e-3)
    title = "wash of a falcon that carries itself, through two opposite rotors"
    plot = Plot("wash", title, "distance from the middle [m]", "down [m/s]")
    across = np.linspace(-0.8, 0.8, 401)
    for depth in (0.3, 1.0, 2.0, 4.0):
        line = [-velocity(x / 2**0.5, x / 2**0.5, depth)[2] for x in across]
        plot.add(f"{depth:g} m below", across, np.array(line))
    result.plots.append(plot)
    return result


def blade_elements(vehicle: Vehicle, speed: float, climb: float, twist: float = -0.2) -> tuple[float, float]:
    """Return the thrust of a climbing rotor [N] and the velocity of the air through its disc [m/s].

    Elements along blades of constant chord, summed, and the momentum of the air that they drive, solved by bisection.

    Args:
        vehicle: whose rotor it is; in still air its thrust is b ω², by which the pitch of its blades is chosen.
        speed: of the rotor [rad/s].
        climb: velocity of the rotor through the air along its thrust [m/s].
        twist: of a blade from root to tip [rad]; the thrust does not depend on it.
    """
    share = (np.arange(2000) + 0.5) / 2000  # of the radius, where elements are
    tangential = speed * vehicle.rotor_radius * share
    chords = vehicle.rotor_solidity * np.pi * vehicle.rotor_radius  # of all blades [m]
    disc = 2 * AIR_DENSITY * np.pi * vehicle.rotor_radius**2
    still = vehicle.thrust_coefficient * speed**2

    def thrust(pitch: float, through: float) -> float:
        # Small angles: the air through the disc lowers the angle of attack by its ratio to the blade's speed.
        angle = pitch + twist * share - through / tangential
        lift = 0.5 * AIR_DENSITY * tangential**2 * chords * LIFT_SLOPE * angle
        return float(lift.mean() * vehicle.rotor_radius)

    pitch = _bisect(lambda angle: thrust(angle, np.sqrt(still / disc)) - still, -3.0, 3.0)
    through = _bisect(lambda w: disc * w * (w - climb) - thrust(pitch, w), max(0.5 * climb, 0.0), 100.0)
    return thrust(pitch, through), through


def _bisect(f: Callable[[float], float], low: float, high: float) -> float:
    """Return where f, which rises, is zero."""
    for _ in range(100):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if f(middle) < 0 else (low, middle)
    return low


def inflow(fast: bool) -> Result:
    """Thrust at constant rotor speed in a climb, from a drone's acceleration, against blade elements and momentum."""
    result = Result()
    caption = "Thrust at the rotor speed of hover over the speed of climb, or of air from above."
    title = "thrust in a climb"
    plot = Plot("inflow", title, "climb [m/s]", "thrust over thrust in still air", caption=caption)
    for preset in ("falcon", "hummingbird", "crazyflie_id"):
        still_drag = {"vehicle__drag": [0.0, 0.0, 0.0]}
        system = _system(vehicle__preset=preset, wind__inflow=True, **still_drag)
        vehicle = system.vehicle
        hover = vehicle.mass * GRAVITY
        speed = float(np.sqrt(hover / 4 / vehicle.thrust_coefficient))
        climbs = np.array([-2.0, -0.001, 0.001, 2.0, 4.0, 7.0])
        found = []
        for climb in climbs:
            world = _apart(system)
            world.state.drone_velocity[0, 0, 2] = climb
            world.load(np.ones(1, bool))
            world.step(np.full((1, 1, 4), hover / 4))
            gained = (world.state.drone_velocity[0, 0, 2] - climb) / system.timestep
            found.append(1 + gained / GRAVITY)
        theory = np.array([blade_elements(vehicle, speed, climb)[0] for climb in climbs]) / (hover / 4)
        for climb, expected, simulated in zip(climbs, theory, found, strict=True):
            if abs(climb) > 0.01:
                quantity = f"thrust in a climb of {climb:g} m/s over that at rest, relative error"
                result.compare(f"inflow, {preset}", quantity, float(expected), simulated, 1e-4)
        induced = np.sqrt(hover / 4 / (2 * AIR_DENSITY * np.pi * vehicle.rotor_radius**2))
        lift = vehicle.rotor_solidity * LIFT_SLOPE / 4
        slope = -lift / (4 * induced / (speed * vehicle.rotor_radius) + lift) / induced
        steepness = (found[2] - found[1]) / 0.002
        result.compare(f"inflow, {preset}", "slope at hover [s/m], relative error", float(slope), steepness, 1e-4)
        fine = np.linspace(-2.0, 7.0, 19)
        curve = np.array([blade_elements(vehicle, speed, climb)[0] for climb in fine]) / (hover / 4)
        plot.add(preset, climbs, np.array(found))
        plot.add("" if preset != "falcon" else "blade elements and momentum", fine, curve, theory=True)
    result.plots.append(plot)
    return result


def ground_effect(fast: bool) -> Result:
    """Thrust near the ground, from a drone's acceleration at constant rotor speed."""
    system = _system(wind__ground_effect=True)
    result = Result()
    vehicle, radius = system.vehicle, system.vehicle.rotor_radius
    squares = ((vehicle.rotor_positions - vehicle.rotor_positions[0]) ** 2).sum(axis=1)
    for ratio in (1.0, 2.0, 4.0, 8.0, 1000.0):
        world = _apart(system)
        height = ratio * radius
        world.state.payload_position[0] = [3.0, 0, 0.5]
        world.state.drone_position[0, 0] = [0, 0, height]
        world.load(np.ones(1, bool))
        world.step(np.full((1, 1, 4), vehicle.mass * GRAVITY / 4))
        gain = 1 + world.state.drone_velocity[0, 0, 2] / system.timestep / GRAVITY
        expected = float(1 / (1 - radius**2 / 2 * (height / (squares + 4 * height**2) ** 1.5).sum()))
        quantity = f"thrust over thrust far away at {ratio:g} rotor radii, relative error"
        result.compare("ground effect", quantity, expected, gain, 1e-6)
    lone = ground_gain(radius, 0, make_air(replace(system, vehicles=(replace(vehicle, arm=1e3),))))
    quantity = "one rotor alone at one radius, Cheeseman and Bennett, relative error"
    result.compare("ground effect", quantity, 1 / (1 - (1 / 4) ** 2), lone, 1e-9)
    heights = np.linspace(0.5, 8, 200)
    c = make_air(system)
    title = "thrust of a falcon near the ground"
    plot = Plot("ground_effect", title, "height over rotor radius", "thrust over far thrust")
    plot.add("four rotors", heights, np.array([ground_gain(z * radius, 0, c) for z in heights]))
    single = 1 / (1 - (1 / (4 * heights)) ** 2)
    plot.add("one rotor, Cheeseman and Bennett 1955", heights, single, theory=True)
    result.plots.append(plot)
    return result
