"""Turbulence, gusts, rotor wash, ground effect and roll moments against their formulas (docs/air.md)."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from multilift_marl._jit import kernel
from multilift_marl.config.load import load_config
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import AIR_DENSITY, GRAVITY
from multilift_marl.sim.air import GROWTH, SPREADING, ground_gain, make_air, wash_at
from multilift_marl.sim.gusts import advance_turbulence, dryden, start_turbulence, turbulence
from multilift_marl.sim.state import Air
from multilift_marl.sim.world import World
from multilift_marl.validation.experiment import Curve, Plot, Result, Row, relative

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
    seeds = np.random.SeedSequence(1).generate_state(series, np.uint64)
    air.generator[:] = seeds
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


def correlation(component: str, height: float, lag: float | np.ndarray) -> np.ndarray:
    """Return the closed form of a component's autocorrelation [m²/s²] at a time lag [s]: that of its spectrum."""
    across, upward, long, high = dryden(height, WIND)
    sigma, length = (upward, high) if component == "w" else (across, long)
    a = np.abs(lag) * WIND / length
    return sigma**2 * np.exp(-a) * (1.0 if component == "u" else 1 - a / 2)


def spectrum(component: str, height: float, frequency: np.ndarray) -> np.ndarray:
    """Return MIL-F-8785C's one-sided spectral density of a component [m²/s² per Hz] at a frequency [Hz]."""
    across, upward, long, high = dryden(height, WIND)
    sigma, length = (upward, high) if component == "w" else (across, long)
    x = (2 * np.pi * frequency * length / WIND) ** 2
    shape = 2 / (1 + x) if component == "u" else (1 + 3 * x) / (1 + x) ** 2
    return 2 * sigma**2 * length / WIND * shape


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
                    label = f"turbulence, {height:g} m, {1e3 * timestep:g} ms"
                    result.rows.append(Row(label, quantity, theory, found, error, 0.1 if fast else 0.045))
        result.plots.append(_spectrum_rows(height, fast, result.rows))
    series = sample_turbulence(3.0, 0.004, 5000, 1)[0]
    plot = Plot("turbulence", "turbulence at 3 m in a wind of 5 m/s", "time [s]", "velocity [m/s]")
    plot.curves = [Curve(name, 0.004 * np.arange(len(series)), series[:, i]) for i, name in enumerate(COMPONENTS)]
    result.plots.append(plot)
    return result


def _spectrum_rows(height: float, fast: bool, rows: list[Row]) -> Plot:
    """Add rows for the spectra at a height, averaged over third-octave bands, and return their plot."""
    every, timestep, steps = 5, 0.004, 8192
    samples = sample_turbulence(height, timestep, steps, 40 if fast else 200, every)
    window, interval = np.hanning(steps)[:, None], every * timestep
    power = np.abs(np.fft.rfft(samples * window, axis=1)) ** 2
    density = 2 * interval * power.mean(axis=0) / (window**2).sum()
    frequency = np.fft.rfftfreq(steps, interval)
    edges = np.geomspace(0.02, 5.0, 25)
    band = np.digitize(frequency, edges)
    centre = np.array([frequency[band == i].mean() for i in range(1, len(edges))])
    plot = Plot(f"turbulence_spectrum_{height:g}_m", f"turbulence at {height:g} m in a wind of 5 m/s", "", "", log=True)
    plot.x_label, plot.y_label = "frequency [Hz]", "spectral density [m²/s² per Hz]"
    rate = 1 / interval
    for i, name in enumerate(COMPONENTS):
        aliases = (spectrum(name, height, np.abs(frequency + k * rate)) for k in range(-20, 21))
        folded = sum(aliases, np.zeros_like(frequency))  # as sampled
        found, theory = (
            np.array([values[band == j].mean() for j in range(1, len(edges))]) for values in (density[:, i], folded)
        )
        error = float(np.abs(np.log(found / theory)).max())
        quantity = f"spectral density of {name}, 0.02-5 Hz, largest |log| of the ratio"
        rows.append(Row(f"turbulence, {height:g} m", quantity, 0.0, error, error, 0.4 if fast else 0.2))
        plot.curves.append(Curve(name, centre, found))
        label = "MIL-F-8785C, as sampled" if i == 0 else "_"
        plot.curves.append(Curve(label, centre, theory, theory=True))
    return plot


def _system(values: dict[str, Any]) -> System:
    return load_config("hover", {"env.num_drones": 1} | values).system


def _apart(system: System) -> World:
    """Return a world of one drone at 102 m and its payload at 100 m on a long, slack cable, at rest."""
    world = World(system, 1, 1)
    world.state.payload_position[:], world.state.drone_position[:] = [0, 0, 100], [0, 0, 102]
    world.state.drone_rotation[:] = np.eye(3)
    world.state.rotor_speed[:] = np.sqrt(system.vehicle.mass * GRAVITY / 4 / system.vehicle.thrust_coefficient)
    world.load(np.ones(1, bool))
    return world


def gust(fast: bool) -> Result:
    """A "1 - cosine" gust: its profile, and what it does to a drone with linear drag."""
    settings = {"wind.gust": [2.0, -1.0, 0.5], "wind.gust_start": 0.2, "wind.gust_rise": 0.5, "wind.gust_hold": 0.3}
    system = _system({"cable.length": 20.0} | settings)
    world, vehicle = _apart(system), system.vehicle
    amplitude, h, steps = np.array([2.0, -1.0, 0.5]), system.timestep, round(2.0 / system.timestep)
    t = h * np.arange(steps)
    phase = np.clip(t - 0.2, 0, 0.5) - np.clip(t - 0.2 - 0.5 - 0.3, 0, 0.5)
    share = 0.5 - 0.5 * np.cos(np.pi * phase / 0.5)
    thrust = np.full((1, 1, 4), vehicle.mass * GRAVITY / 4)
    found, speed = [], []
    for _ in range(steps):
        world.step(thrust)
        found.append(world.air.gust[0].copy())
        speed.append(world.state.drone_velocity[0, 0, 0])
    error = float(np.abs(np.array(found) - share[:, None] * amplitude).max())
    result = Result([Row("gust", "largest error of its profile [m/s]", 0.0, error, error, 1e-12)])
    rate = vehicle.drag[0] / vehicle.mass
    fine = np.linspace(0, 2.0, 200001)
    phase = np.clip(fine - 0.2, 0, 0.5) - np.clip(fine - 1.0, 0, 0.5)
    blown = amplitude[0] * (0.5 - 0.5 * np.cos(np.pi * phase / 0.5))
    theory = rate * np.trapezoid(blown * np.exp(-rate * (2.0 - fine)), fine)
    quantity = "speed of a drone after 2 s [m/s], relative error"
    result.rows.append(Row("gust", quantity, theory, speed[-1], relative(speed[-1], theory), 0.005))
    plot = Plot("gust", "gust and what it does to a drone, along x", "time [s]", "velocity [m/s]")
    plot.curves = [Curve("air", t, np.array(found)[:, 0]), Curve("drone", t + h, np.array(speed))]
    plot.curves.append(Curve("1 - cosine", t, share * amplitude[0], theory=True))
    result.plots.append(plot)
    return result


def wash(fast: bool) -> Result:
    """The wash below a hovering drone: momentum theory at the rotors, momentum at any distance, nothing above."""
    system = _system({"cable.length": 20.0, "wind.wash": True})
    world, c, vehicle = _apart(system), make_air(system), system.vehicle
    thrust, result = vehicle.mass * GRAVITY, Result()

    def speed(x: float, depth: float) -> float:
        return -wash_at(0, (x, 0.0, 102.0 - depth), 0.0, world.state, c)[2]

    rotor = vehicle.rotor_positions[0]
    induced = np.sqrt(thrust / 4 / (2 * AIR_DENSITY * np.pi * vehicle.rotor_radius**2))
    below = wash_at(0, (rotor[0], rotor[1], 102.0 - 1e-6), 0.0, world.state, c)
    quantity = "under a rotor, 2 v_i of momentum theory [m/s], relative error"
    result.rows.append(Row("wash", quantity, 2 * induced, -below[2], relative(-below[2], 2 * induced), 1e-4))
    above = wash_at(0, (rotor[0], rotor[1], 102.5), 0.0, world.state, c)
    size = float(np.linalg.norm(above))
    result.rows.append(Row("wash", "speed above the rotors [m/s]", 0.0, size, size, 0.0))
    for depth in (0.1, 0.5, 2.0, 8.0):
        half = vehicle.arm + 5 * max(vehicle.rotor_radius, SPREADING * depth)
        grid = np.linspace(-half, half, 101)
        squares = [wash_at(0, (x, y, 102 - depth), 0.0, world.state, c)[2] ** 2 for x in grid for y in grid]
        flux = AIR_DENSITY * sum(squares) * (grid[1] - grid[0]) ** 2
        quantity = f"momentum flux {depth:g} m below = thrust [N], relative error"
        result.rows.append(Row("wash", quantity, thrust, flux, relative(flux, thrust), 2e-3))
    far = np.sqrt(thrust / (np.pi * AIR_DENSITY)) / (GROWTH * 20.0)
    quantity = "20 m below, one jet √(T/πρ)/b [m/s], relative error"
    result.rows.append(Row("wash", quantity, far, speed(0.0, 20.0), relative(speed(0.0, 20.0), far), 0.01))
    world.step(np.full((1, 1, 4), thrust / 4))
    square = (2.0 * GROWTH) ** 2 + system.payload_drag_area / np.pi  # of a Gaussian jet, averaged over the payload
    squared = thrust / (AIR_DENSITY * np.pi * square) * np.exp(-(vehicle.arm**2) / square)
    pushed = 0.5 * AIR_DENSITY * system.payload_drag_area * squared / system.payload_mass
    found = -world.state.payload_velocity[0, 2] / system.timestep - GRAVITY
    quantity = "acceleration of a payload 2 m below [m/s²], relative error"
    result.rows.append(Row("wash", quantity, pushed, found, relative(found, pushed), 1e-3))
    across = np.linspace(-0.8, 0.8, 401)
    plot = Plot("wash", "wash of a falcon that carries itself, through two opposite rotors", "", "down [m/s]")
    plot.x_label = "distance from the middle [m]"
    for depth in (0.3, 1.0, 2.0, 4.0):
        line = [wash_at(0, (x / 2**0.5, x / 2**0.5, 102 - depth), 0.0, world.state, c)[2] for x in across]
        plot.curves.append(Curve(f"{depth:g} m below", across, -np.array(line)))
    result.plots.append(plot)
    return result


def ground_effect(fast: bool) -> Result:
    """Thrust near the ground, from a drone's acceleration at constant rotor speed."""
    system = _system({"cable.length": 20.0, "wind.ground_effect": True})
    vehicle, result, radius = system.vehicle, Result(), system.vehicle.rotor_radius
    squares = ((vehicle.rotor_positions - vehicle.rotor_positions[0]) ** 2).sum(axis=1)
    thrust = vehicle.mass * GRAVITY

    def theory(z: float) -> float:
        return float(1 / (1 - radius**2 / 2 * (z / (squares + 4 * z**2) ** 1.5).sum()))

    for ratio in (1.0, 2.0, 4.0, 8.0, 1000.0):
        world, height = _apart(system), ratio * radius
        world.state.payload_position[0] = [3.0, 0, 0.5]
        world.state.drone_position[0, 0] = [0, 0, height]
        world.load(np.ones(1, bool))
        world.step(np.full((1, 1, 4), thrust / 4))
        gain = 1 + world.state.drone_velocity[0, 0, 2] / system.timestep / GRAVITY
        expected = theory(height)
        quantity = f"thrust over thrust far away at {ratio:g} rotor radii, relative error"
        result.rows.append(Row("ground effect", quantity, expected, gain, relative(gain, expected), 1e-6))
    single = 1 / (1 - (1 / 4) ** 2)
    lone = ground_gain(radius, 0, make_air(replace(system, vehicles=(replace(vehicle, arm=1e3),))))
    quantity = "one rotor alone at one radius, Cheeseman and Bennett, relative error"
    result.rows.append(Row("ground effect", quantity, single, lone, relative(lone, single), 1e-9))
    heights = np.linspace(0.5, 8, 200)
    c = make_air(system)
    plot = Plot(
        "ground_effect", "thrust of a falcon near the ground", "height over rotor radius", "thrust over far thrust"
    )
    plot.curves = [
        Curve("four rotors", heights, np.array([ground_gain(z * radius, 0, c) for z in heights])),
        Curve("one rotor, Cheeseman and Bennett 1955", heights, 1 / (1 - (1 / (4 * heights)) ** 2), theory=True),
    ]
    result.plots.append(plot)
    return result
