"""Cables between drones and payload: how they come taut, and what they carry at rest."""

from __future__ import annotations

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.rig.system import System
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.world import World
from multilift_marl.validation.asymmetric_team import controller
from multilift_marl.validation.bodies import make_config
from multilift_marl.validation.experiment import Curve, Plot, Result, Row, ms, order_row, relative

_CLOSING = 2.0  # [m/s] at which drone and payload part
_SLACK = 0.1  # [m] left when they start
_FREE = {"payload__drag_area": 0.0, "vehicle__rotor_speed_min": 0.0}
_TRIANGLE = [[0.27, 0.22, 0.08], [0.27, -0.22, 0.08], [-0.27, 0.0, 0.08]]
_OFF = {"payload__anchors": _TRIANGLE, "payload__size": [0.6, 0.5, 0.15]}
_OFF_MIDDLE = [0.05, 0.03, 0.0]  # [m] of the centre of mass


def slack_taut(fast: bool) -> Result:
    """A drone and a payload fly apart in free fall until their cable comes taut: momentum, pulls, and energy.

    With the report's damping they hardly part again; on a cable with next to none they bounce back, and what is missing
    of their energy is the integrator's.
    """
    caption = "A cable comes taut between a drone and a payload that part at 2 m/s: tension at three time steps."
    plot = Plot("slack_taut", "a cable comes taut", "time [ms]", "tension [N]", caption=caption)
    result = Result(plots=[plot])
    after, all_steps = [], (1e-3, 2.5e-4, 6.25e-5)
    for timestep in all_steps:
        system = make_config(1, timestep, **_FREE).system
        tension, velocity = _part(system)
        steps = len(tension)
        masses = np.array([system.vehicle.mass, system.payload_mass])
        name = f"slack to taut, {ms(timestep)}"
        expected = masses @ [0.5 * _CLOSING, -0.5 * _CLOSING] - masses.sum() * GRAVITY * steps * timestep
        found = float(masses @ velocity)
        quantity = "vertical momentum after it [kg m/s], relative error"
        result.rows.append(Row(name, quantity, expected, found, relative(found, expected), 1e-9))
        least = float(tension.min())
        result.rows.append(Row(name, "least tension [N]: it never pushes", 0.0, least, max(0.0, -least), 0.0))
        slack = float(tension[: round(0.95 * _SLACK / _CLOSING / timestep)].max())
        result.rows.append(Row(name, "largest tension while slack [N]", 0.0, slack, slack, 0.0))
        theory = bounce(system, _CLOSING)
        after.append(abs(velocity[0] - velocity[1] - theory) / _CLOSING)
        quantity = "speed of parting after it [m/s], error over that before"
        limit = 0.02 if timestep < 1e-3 else float("inf")  # the whole event takes 1 ms
        result.rows.append(Row(name, quantity, theory, float(velocity[0] - velocity[1]), after[-1], limit))
        time = 1e3 * timestep * np.arange(1, steps + 1)
        around = (time > 48.0) & (time < 57.0)
        plot.curves.append(Curve(ms(timestep), time[around], tension[around]))
    result.rows.append(order_row("slack to taut", "speed of parting", after, all_steps))
    return _dissipation(result)


def _dissipation(result: Result) -> Result:
    """Add what the integrator takes of the energy of an elastic bounce, over the time step."""
    steps, lost = (1e-3, 2.5e-4, 6.25e-5, 1.5625e-5), []
    caption = (
        "An elastic bounce off a taut cable, k = 1e5 N/m: the energy that the integrator takes, over the time step."
    )
    plot = Plot("dissipation", "numerical dissipation of a bounce", "time step [ms]", "share of the energy lost")
    plot.caption, plot.log = caption, True
    for timestep in steps:
        system = make_config(1, timestep, cable__damping=1e-6, **_FREE).system
        velocity = _part(system)[1]
        lost.append(1 - float((velocity[0] - velocity[1]) / _CLOSING) ** 2)
        quantity = f"share of the energy lost at {ms(timestep)}"
        result.rows.append(Row("elastic bounce", quantity, 0.0, lost[-1], abs(lost[-1]), float("inf")))
    result.rows.append(order_row("elastic bounce", "energy lost", lost[1:], steps[1:]))
    plot.curves.append(Curve("simulated", 1e3 * np.array(steps), np.array(lost)))
    result.plots.append(plot)
    return result


def _part(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Let a drone and a payload, free of all but weight, part until after their cable came taut.

    Returns:
        Tensions (T,) [N] of all steps, and the vertical speeds (2,) of drone and payload at the end [m/s].
    """
    world = World(system, 1, 1)
    state, anchor = world.state, system.anchors[0]
    state.payload_position[0, 2] = 20.0
    state.drone_position[0, 0] = state.payload_position[0] + anchor + [0, 0, system.cable_length[0] - _SLACK]
    state.drone_rotation[0, 0] = np.eye(3)
    state.drone_velocity[0, 0], state.payload_velocity[0] = [0, 0, 0.5 * _CLOSING], [0, 0, -0.5 * _CLOSING]
    state.rotor_speed[:] = 0.0
    world.load(np.ones(1, bool))
    thrust = np.zeros((1, 1, 4))
    tension = [float(world.step(thrust).cable_tension[0, 0]) for _ in range(round(0.08 / system.timestep))]
    return np.array(tension), np.array([state.drone_velocity[0, 0, 2], state.payload_velocity[0, 2]])


def bounce(system: System, speed: float) -> float:
    """Return the relative speed at which two bodies leave a pull-only spring and damper that they stretch at `speed`.

    μ ẍ + c ẋ + k x = 0 from x = 0, ẋ = speed, until k x + c ẋ = 0; more damped than critically.
    """
    m, p = system.vehicle.mass, system.payload_mass
    k, c = system.cable_stiffness[0], system.cable_damping[0]
    slow, fast = np.roots([m * p / (m + p), c, k])[::-1]
    leave = np.log((k + c * fast) / (k + c * slow)) / (slow - fast)
    return float(speed * (slow * np.exp(slow * leave) - fast * np.exp(fast * leave)) / (slow - fast))


def static_teams(fast: bool) -> Result:
    """Teams that have settled: tension m g/(N cos θ) if symmetric, by the law of the lever if not."""
    caption = "Teams settle from 5 cm off their place with slack cables: error of the worst tension."
    plot = Plot("static_teams", "settling", "time [s]", "tension, relative error", caption=caption, semilog=True)
    result, steps = Result(plots=[plot]), (4e-3,) if fast else (4e-3, 2e-3)
    for count in range(2, 9):
        for timestep in steps:
            config = make_config(count, timestep)
            system = config.system
            theory = np.full(count, system.payload_mass * GRAVITY / (count * np.cos(np.deg2rad(30))))
            _settle(result, f"{count} drones at rest", config, theory, 8.0)
    for timestep in steps:
        config = make_config(3, timestep, payload__center_of_mass=_OFF_MIDDLE, **_OFF)
        system = config.system
        levers = np.stack([np.ones(3), *system.anchors[:, :2].T])  # all at one height: sideways pulls turn nothing
        upright = np.linalg.solve(levers, [system.payload_mass * GRAVITY, 0, 0])
        cable = system.slots - system.anchors
        theory = upright * np.linalg.norm(cable, axis=1) / cable[:, 2]
        _settle(result, "payload off-centre by 6 cm", config, theory, 25.0)  # it swings on
    return result


def _settle(result: Result, name: str, config: Config, theory: np.ndarray, seconds: float) -> None:
    """Add the tensions (N,) of a team that has had some seconds to settle from a start with slack cables."""
    world, timestep = World(config.system, 1, 1), config.sim.timestep
    state = world.state
    target = state.payload_position[0].copy()
    state.drone_position[0] -= [0, 0, 0.03]
    state.payload_position[0] += [0, 0, 0.02]
    world.load(np.ones(1, bool))
    steer, error = controller(config, world, target), []
    for _ in range(round(seconds / timestep)):
        steer()
        world.step(world.thrust)
        error.append(np.abs(state.cable_tension[0] / theory - 1).max())
    worst = int(np.abs(state.cable_tension[0] / theory - 1).argmax())
    name = f"{name}, {ms(timestep)}"
    tension = state.cable_tension[0, worst]
    result.rows.append(Row(name, "tension [N], largest relative error", theory[worst], tension, error[-1], 1e-6))
    if timestep == 4e-3 and not name.startswith(("3", "5", "6", "7")):
        time = timestep * np.arange(1, len(error) + 1)
        result.plots[0].curves.append(Curve(name.split(",")[0], time, np.maximum(error, 1e-16)))
