"""Cables against the second-order system that they are (the report's section 4.1), and in teams: snatch and statics."""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from typing import NamedTuple

import mujoco
import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.config.load import load_config
from multilift_marl.physical import GRAVITY
from multilift_marl.rig.system import System
from multilift_marl.sim.cables.massless import IMPEDANCE, limit_solref
from multilift_marl.sim.scene import set_options
from multilift_marl.sim.world import World
from multilift_marl.validation.chains import hanging_chain, inclined_chains, straight_chain, tested_stiffness
from multilift_marl.validation.experiment import Plot, Result, Row, make_config, ms
from multilift_marl.validation.symmetry import controller

STIFFNESS = 1e5  # [N/m], the report's
DAMPING = 1e3  # [N s/m], the report's
_SECONDS = 0.1  # [s] of elongation compared
_TIMESTEP = 5e-4  # [s]
_TIMES = _TIMESTEP * np.arange(1, round(_SECONDS / _TIMESTEP) + 1)
_CLOSING = 2.0  # [m/s] at which drone and payload part
_SLACK = 0.1  # [m] left when they start
_FREE = {"payload__drag_area": 0.0, "vehicle__rotor_speed_min": 0.0}
_OFF_CENTRE = {
    "payload__anchors": [[0.27, 0.22, 0.08], [0.27, -0.22, 0.08], [-0.27, 0.0, 0.08]],
    "payload__size": [0.6, 0.5, 0.15],
    "payload__center_of_mass": [0.05, 0.03, 0.0],
}


class Load(NamedTuple):
    """A load below fixed anchors."""

    name: str
    mass: float
    """[kg]"""
    cables: int = 1
    angle: float = 0.0
    """Of the cables from the vertical [rad]."""

    @property
    def rest(self) -> float:
        """Static depth, as far as it is small [m]."""
        return self.mass * GRAVITY / (self.cables * STIFFNESS * np.cos(self.angle) ** 2)


def hanging_load(mass: float, timestep: float, cables: int = 1, angle: float = 0.0) -> mujoco.MjModel:
    """Return a load below fixed anchors on massless cables of 1 m at their natural length.

    Args:
        mass: of the load [kg].
        timestep: [s].
        cables: evenly spaced about the vertical.
        angle: of the cables from the vertical [rad].
    """
    spec = mujoco.MjSpec()
    set_options(spec, timestep)
    load = spec.worldbody.add_body(name="load")
    load.mass, load.inertia, load.explicitinertial = mass, [0.1 * mass] * 3, True
    for axis in np.eye(3):
        load.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
    load.add_site(name="load")
    for i in range(cables):
        azimuth = 2 * np.pi * i / cables
        flat = np.sin(angle)
        anchor = [flat * np.cos(azimuth), flat * np.sin(azimuth), np.cos(angle)]
        spec.worldbody.add_site(name=f"anchor_{i}", pos=anchor)
        cable = spec.add_tendon(name=f"cable_{i}", limited=True, range=[0, 1.0])
        cable.wrap_site(f"anchor_{i}")
        cable.wrap_site("load")
        cable.solimp_limit = [IMPEDANCE, IMPEDANCE, 0.001, 0.5, 2]
    model = spec.compile()
    ones = np.ones(cables)
    model.tendon_solref_lim[:] = limit_solref(STIFFNESS * ones, DAMPING * ones, model.tendon_invweight0)
    return model


def second_order(mass: float, stiffness: float, damping: float, t: np.ndarray) -> np.ndarray:
    """Return the depth (T,) of a mass let go on a spring and damper at natural length, m ẍ = m g - k x - c ẋ."""
    rest = mass * GRAVITY / stiffness
    roots = np.roots([1, damping / mass, stiffness / mass]).astype(complex)
    # x = rest + Σ w e^(root t) with x = ẋ = 0 at first.
    weights = np.linalg.solve(np.stack([np.ones(2), roots]), [-rest, 0])
    return rest + np.real(weights @ np.exp(roots[:, None] * t))


def single_cable(fast: bool) -> Result:
    """Report table 1 and figures 8-11: one cable, loads of 0.1-5 kg, both models."""
    result = Result()
    for mass in (0.1, 0.5, 1.0, 5.0):
        theory = second_order(mass, STIFFNESS, DAMPING, _TIMES)
        _add_massless(result, Load(f"single cable, {mass:g} kg", mass), theory, 0.06 if mass < 0.5 else 0.015)
        theory = straight_chain(mass, STIFFNESS, DAMPING, GRAVITY, _TIMES)
        _add_chain(result, Load(f"single chain, {mass:g} kg", mass), theory)
    return result


def six_cables(fast: bool) -> Result:
    """Report figures 12-14: six cables 30° from the vertical, loads of 6-60 kg, both models, and how fast they are."""
    result = Result()
    angle = np.pi / 6
    for mass in (6.0, 30.0, 60.0):
        upright = 6 * np.cos(angle) ** 2  # stiffness of the vertical motion over a cable's; small depths
        theory = second_order(mass, upright * STIFFNESS, upright * DAMPING, _TIMES)
        _add_massless(result, Load(f"six cables, {mass:g} kg", mass, 6, angle), theory, 0.015)
        theory = inclined_chains(mass, STIFFNESS, DAMPING, 6, angle, _TIMES)
        _add_chain(result, Load(f"six chains, {mass:g} kg", mass, 6, angle), theory)
    steps = 2_000 if fast else 20_000
    cables = hanging_load(30.0, 1e-3, 6, angle)
    data = mujoco.MjData(cables)
    _race(result, "six cables, 30 kg", lambda count: mujoco.mj_step(cables, data, count), steps, 200)
    world, thrust = hanging_chain(30.0, 1e-3, 6, angle)
    _race(result, "six chains, 30 kg", lambda count: world.step(thrust, count), steps // 10, 10)
    return result


def _add_massless(result: Result, load: Load, theory: np.ndarray, limit: float) -> None:
    """Add static stiffness and elongation over `_TIMES` of a load on massless cables."""
    model = hanging_load(load.mass, _TIMESTEP, load.cables, load.angle)
    data = mujoco.MjData(model)
    depth = []
    for _ in range(round(2.0 / _TIMESTEP)):
        mujoco.mj_step(model, data)
        depth.append(-float(data.qpos[2]))
    # Static: from the true geometry of the stretched cables, as depth is not small against 0.01 %.
    rest = mujoco.MjData(model)
    rest.qpos[2] = -depth[-1]
    mujoco.mj_forward(model, rest)
    upright = (np.cos(load.angle) + depth[-1]) / rest.ten_length[0]
    tested = load.mass * GRAVITY / load.cables / upright / (rest.ten_length[0] - 1.0)
    result.compare(load.name, "static stiffness [N/m], relative error", STIFFNESS, tested, 1e-4)
    _add_elongation(result, load, np.array(depth[: len(_TIMES)]), theory, limit)


def _add_chain(result: Result, load: Load, theory: np.ndarray) -> None:
    """Add the same of a load on chains."""
    world, thrust = hanging_chain(load.mass, _TIMESTEP, load.cables, load.angle)
    start = world.state.payload_position[0, 2]
    depth = np.array([start - world.step(thrust).payload_position[0, 2] for _ in _TIMES])
    resting, thrust = hanging_chain(load.mass, _TIMESTEP, load.cables, load.angle, cable__bending_damping=0.01)
    resting.step(thrust, round(2.0 / _TIMESTEP))
    tested = tested_stiffness(resting)
    result.compare(load.name, "static stiffness [N/m], relative error", STIFFNESS, tested, 1e-4)
    _add_elongation(result, load, depth, theory, 0.01)


def _add_elongation(result: Result, load: Load, depth: np.ndarray, theory: np.ndarray, limit: float) -> None:
    error = (depth - theory) / load.rest
    rms = float(np.sqrt(np.mean(error**2)))
    result.check(load.name, "elongation over 100 ms, RMS over the static stretch", rms, limit)
    result.check(load.name, "the same, largest (for information)", float(np.abs(error).max()))
    plot = Plot(re.sub(r"\W+", "_", load.name), load.name, "time [ms]", "depth [µm]")
    plot.add(f"simulated, {ms(_TIMESTEP)}", 1e3 * _TIMES, 1e6 * depth)
    label = "its masses, springs and dampers" if "chain" in load.name else "second-order system"
    plot.add(label, 1e3 * _TIMES, 1e6 * theory, theory=True)
    result.plots.append(plot)


def _race(result: Result, name: str, step: Callable[[int], object], steps: int, least: float) -> None:
    """Add the real-time factor of stepping on one core, in processor time, the best of three."""
    step(100)
    taken = []
    for _ in range(3):
        start = time.thread_time()
        step(steps)
        taken.append(time.thread_time() - start)
    factor = steps * 1e-3 / min(taken)
    result.at_least(name, f"real-time factor on one core at 1 ms, shortfall of {least}", least, factor)


def stiff_cables(fast: bool) -> Result:
    """Six drones under ten times the report's stiffness and damping, at steps up to 5 ms: no warning, no jolt."""
    result = Result()
    for cable in ("massless", "chain"):
        for timestep in (5e-4, 1e-3, 2e-3, 5e-3):
            values = {"env.num_drones": 6, "cable.model": cable, "cable.stiffness": 1e6, "cable.damping": 1e4}
            config = load_config("hover", values | {"sim.timestep": timestep, "sim.control_hz": 100})
            world = World(config.system, 1, 1)
            thrust = hover_thrust(world)
            world.state.payload_velocity[0] = [0.2, 0, 0]
            world.load(np.ones(1, bool))
            fastest = 0.0
            for _ in range(round(0.3 / timestep)):
                world.step(thrust)
                fastest = float(np.maximum(fastest, np.abs(world.state.payload_velocity).max()))
            name = f"k = 1e6 N/m, {cable}, {ms(timestep)}"
            warnings = int(world.shards[0].batch.warning[:, :, 1].sum()) + int(world.diverged.sum())
            result.check(name, "warnings of MuJoCo in 0.3 s after a push of 0.2 m/s", warnings, 0)
            result.at_most(name, "largest payload speed [m/s], excess over 0.25", 0.2, fastest, fastest - 0.25)
    return result


def hover_thrust(world: World) -> np.ndarray:
    """Return rotor thrusts (E, N, 4) [N] that hold drones and nominal forces of their cables in equilibrium."""
    system = world.system
    force = np.linalg.norm(system.hook_force + GRAVITY * system.drone_mass[:, None] * [0, 0, 1], axis=1)
    return np.broadcast_to(force[:, None] / 4, (world.num_envs, world.num_drones, 4)).copy()


def integrators(fast: bool) -> Result:
    """Report figure 4: a stiff chain under MuJoCo's usual integrators, which cannot hold it, and under `discrete`."""
    result = Result()
    timestep = 1e-3
    model = _chain(timestep)
    below = [float(model.body_mass[-count:].sum()) for count in range(1, model.nbody)]  # hanging on each segment
    theory = GRAVITY * sum(below) / (len(below) * STIFFNESS)
    for name in ("discrete", "implicitfast", "implicit", "Euler", "RK4"):
        model.opt.integrator = getattr(mujoco.mjtIntegrator, f"mjINT_{name.upper()}")
        data = mujoco.MjData(model)
        for _ in range(round(0.5 / timestep)):
            mujoco.mj_step(model, data)
            if not np.abs(data.qvel).max() < 1e3:
                break
        depth = float(np.nan_to_num(-data.qpos[-1], nan=1e6, posinf=1e6, neginf=1e6))
        if name == "discrete":
            quantity = "depth of 1 kg on 10 segments after 0.5 s at 1 ms [m], relative error"
            result.compare(f"integrator {name}", quantity, theory, depth, 1e-4)
        else:  # the counter-example: it counts as shown if the error is beyond 5 %
            excess = 0.05 - abs(depth - theory) / theory
            result.at_most(f"integrator {name}", "the same, how far its error stays below 5 %", theory, depth, excess)
    return result


def _chain(timestep: float) -> mujoco.MjModel:
    """Return a load of 1 kg on 10 nodes with springs and dampers between them (report eqs 14-16)."""
    spec = mujoco.MjSpec()
    set_options(spec, timestep)
    above = spec.worldbody.add_site(name="top")
    count = 10
    for i in range(count):
        node = spec.worldbody.add_body(name=f"node_{i}", pos=[0, 0, -(i + 1) / count])
        node.mass = 1.0 if i == count - 1 else 0.005
        node.inertia = [1e-6] * 3
        node.explicitinertial = True
        for axis in np.eye(3):
            node.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        below = node.add_site(name=f"site_{i}")
        segment = spec.add_tendon(
            stiffness=[count * STIFFNESS, 0, 0], damping=[count * DAMPING, 0, 0], springlength=[0, 1 / count]
        )
        segment.wrap_site(above.name)
        segment.wrap_site(below.name)
        above = below
    return spec.compile()


def slack_taut(fast: bool) -> Result:
    """A drone and a payload fly apart in free fall until their cable comes taut: momentum, tension, and energy.

    With the report's damping they hardly part again; on a cable with next to none they bounce back, and what is missing
    of their energy is the integrator's.
    """
    caption = "A cable comes taut between a drone and a payload that part at 2 m/s: tension at three time steps."
    plot = Plot("slack_taut", "a cable comes taut", "time [ms]", "tension [N]", caption=caption)
    result = Result(plots=[plot])
    after = []
    all_steps = (1e-3, 2.5e-4, 6.25e-5)
    for timestep in all_steps:
        system = make_config(1, timestep, **_FREE).system
        tension, velocity = _part(system)
        masses = np.array([system.vehicle.mass, system.payload_mass])
        name = f"slack to taut, {ms(timestep)}"
        expected = masses @ [0.5 * _CLOSING, -0.5 * _CLOSING] - masses.sum() * GRAVITY * len(tension) * timestep
        found = float(masses @ velocity)
        result.compare(name, "vertical momentum after it [kg m/s], relative error", expected, found, 1e-9)
        least = float(tension.min())
        result.at_most(name, "least tension [N]: it never pushes", 0.0, least, -least)
        slack = float(tension[: round(0.95 * _SLACK / _CLOSING / timestep)].max())
        result.check(name, "largest tension while slack [N]", slack, 0.0)
        theory = bounce(system, _CLOSING)
        parting = float(velocity[0] - velocity[1])
        after.append(abs(parting - theory) / _CLOSING)
        quantity = "speed of parting after it [m/s], error over that before"
        limit = 0.02 if timestep < 1e-3 else np.inf  # the whole event takes 1 ms
        result.rows.append(Row(name, quantity, theory, parting, after[-1], limit))
        instant = 1e3 * timestep * np.arange(1, len(tension) + 1)
        around = (instant > 48.0) & (instant < 57.0)
        plot.add(ms(timestep), instant[around], tension[around])
    result.order("slack to taut", "speed of parting", after, all_steps)
    _add_dissipation(result)
    return result


def _add_dissipation(result: Result) -> None:
    """Add what the integrator takes of the energy of an elastic bounce, over the time step."""
    steps = (1e-3, 2.5e-4, 6.25e-5, 1.5625e-5)
    lost = []
    for timestep in steps:
        velocity = _part(make_config(1, timestep, cable__damping=1e-6, **_FREE).system)[1]
        lost.append(1 - float((velocity[0] - velocity[1]) / _CLOSING) ** 2)
        result.check("elastic bounce", f"share of the energy lost at {ms(timestep)}", lost[-1])
    result.order("elastic bounce", "energy lost", lost[1:], steps[1:])
    plot = Plot(
        "dissipation", "numerical dissipation of a bounce", "time step [ms]", "share of the energy lost", log="xy",
        caption="An elastic bounce off a taut cable, k = 1e5 N/m: the energy that the integrator takes, over the time "
        "step.",
    )  # fmt: skip
    plot.add("simulated", 1e3 * np.array(steps), np.array(lost))
    result.plots.append(plot)


def _part(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Let a drone and a payload, free of all but weight, part until after their cable came taut.

    Returns:
        Tensions (T,) [N] of all steps, and the vertical speeds (2,) of drone and payload at the end [m/s].
    """
    world = World(system, 1, 1)
    state = world.state
    state.payload_position[0, 2] = 20.0
    state.drone_position[0, 0] = state.payload_position[0] + system.anchors[0]
    state.drone_position[0, 0, 2] += system.cable_length[0] - _SLACK
    state.drone_rotation[0, 0] = np.eye(3)
    state.drone_velocity[0, 0] = [0, 0, 0.5 * _CLOSING]
    state.payload_velocity[0] = [0, 0, -0.5 * _CLOSING]
    state.rotor_speed[:] = 0.0
    world.load(np.ones(1, bool))
    thrust = np.zeros((1, 1, 4))
    tension = [float(world.step(thrust).cable_tension[0, 0]) for _ in range(round(0.08 / system.timestep))]
    return np.array(tension), np.array([state.drone_velocity[0, 0, 2], state.payload_velocity[0, 2]])


def bounce(system: System, speed: float) -> float:
    """Return the relative speed of two bodies as they leave a spring and damper that they stretch at `speed`.

    μ ẍ + c ẋ + k x = 0 from x = 0, ẋ = speed, until k x + c ẋ = 0; more damped than critically.
    """
    m = system.vehicle.mass
    p = system.payload_mass
    k = system.cable_stiffness[0]
    c = system.cable_damping[0]
    slow, fast = np.roots([m * p / (m + p), c, k])[::-1]
    # (k + c s) e^(s t) = (k + c f) e^(f t), with the slow and the fast root s and f.
    leave = np.log((k + c * fast) / (k + c * slow)) / (slow - fast)
    return float(speed * (slow * np.exp(slow * leave) - fast * np.exp(fast * leave)) / (slow - fast))


def static_teams(fast: bool) -> Result:
    """Teams that have settled: tension m g/(N cos θ) if symmetric, by the law of the lever if not."""
    caption = "Teams settle from 5 cm off their place with slack cables: error of the worst tension."
    plot = Plot("static_teams", "settling", "time [s]", "tension, relative error", caption=caption, log="y")
    result = Result(plots=[plot])
    steps = (4e-3,) if fast else (4e-3, 2e-3)
    for count in range(2, 9):
        for timestep in steps:
            config = make_config(count, timestep)
            theory = np.full(count, config.system.payload_mass * GRAVITY / (count * np.cos(np.deg2rad(30))))
            _settle(result, f"{count} drones at rest", config, theory, 8.0)
    for timestep in steps:
        config = make_config(3, timestep, **_OFF_CENTRE)
        system = config.system
        levers = np.stack([np.ones(3), *system.anchors[:, :2].T])  # all at one height: sideways forces turn nothing
        upright = np.linalg.solve(levers, [system.payload_mass * GRAVITY, 0, 0])
        cable = system.slots - system.anchors
        theory = upright * np.linalg.norm(cable, axis=1) / cable[:, 2]
        _settle(result, "payload off-centre by 6 cm", config, theory, 25.0)  # it swings on
    return result


def _settle(result: Result, name: str, config: Config, theory: np.ndarray, seconds: float) -> None:
    """Add the tensions (N,) of a team that has had some seconds to settle from a start with slack cables."""
    world = World(config.system, 1, 1)
    timestep = config.sim.timestep
    state = world.state
    target = state.payload_position[0].copy()
    state.drone_position[0] -= [0, 0, 0.03]
    state.payload_position[0] += [0, 0, 0.02]
    world.load(np.ones(1, bool))
    steer = controller(config, world, target)
    error = []
    for _ in range(round(seconds / timestep)):
        steer()
        world.step(world.thrust)
        error.append(np.abs(state.cable_tension[0] / theory - 1).max())
    worst = int(np.abs(state.cable_tension[0] / theory - 1).argmax())
    quantity = "tension [N], largest relative error"
    tension = float(state.cable_tension[0, worst])
    result.compare(f"{name}, {ms(timestep)}", quantity, float(theory[worst]), tension, 1e-6)
    if timestep == 4e-3 and not name.startswith(("3", "5", "6", "7")):
        result.plots[0].add(name, timestep * np.arange(1, len(error) + 1), np.maximum(error, 1e-16))
