"""Cables against the second-order system that they are: the report's section 4.1, its table 1 and figures 8-14."""

from __future__ import annotations

import time
from collections.abc import Callable

import mujoco
import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.rig.vehicles import GRAVITY
from multilift_marl.sim.cables.massless import IMPEDANCE, limit_solref
from multilift_marl.sim.scene import set_options
from multilift_marl.sim.world import World
from multilift_marl.validation.chains import hanging_chain, inclined_chains, straight_chain, tested_stiffness
from multilift_marl.validation.experiment import Curve, Plot, Result, Row, relative

STIFFNESS, DAMPING = 1e5, 1e3  # [N/m], [N s/m]: the report's
_SECONDS, _TIMESTEP = 0.1, 5e-4  # [s] of elongation compared


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


def release(model: mujoco.MjModel, data: mujoco.MjData, seconds: float) -> np.ndarray:
    """Return the depth (T,) [m] below the start of a load that is let go, after every step."""
    steps = round(seconds / model.opt.timestep)
    depth = np.empty(steps)
    for i in range(steps):
        mujoco.mj_step(model, data)
        depth[i] = -data.qpos[2]
    return depth


def second_order(mass: float, stiffness: float, damping: float, t: np.ndarray) -> np.ndarray:
    """Return the depth (T,) of a mass let go on a spring and damper at natural length, m ẍ = m g - k x - c ẋ."""
    rest = mass * GRAVITY / stiffness
    roots = np.roots([1, damping / mass, stiffness / mass]).astype(complex)
    weights = np.linalg.solve(np.stack([np.ones(2), roots]), [-rest, 0])
    return rest + np.real(weights @ np.exp(roots[:, None] * t))


def single_cable(fast: bool) -> Result:
    """Report table 1 and figures 8-11: one cable, loads of 0.1-5 kg, both models."""
    result = Result()
    for mass in (0.1, 0.5, 1.0, 5.0):
        t = _TIMESTEP * np.arange(1, round(_SECONDS / _TIMESTEP) + 1)
        theory = second_order(mass, STIFFNESS, DAMPING, t)
        _compare_massless(result, f"single cable, {mass:g} kg", mass, 1, 0.0, t, theory, 0.06 if mass < 0.5 else 0.015)
        theory = straight_chain(mass, STIFFNESS, DAMPING, GRAVITY, t)
        _compare_chain(result, f"single chain, {mass:g} kg", mass, 1, 0.0, t, theory)
    return result


def six_cables(fast: bool) -> Result:
    """Report figures 12-14: six cables 30° from the vertical, loads of 6-60 kg, both models, and how fast they are."""
    result, angle = Result(), np.pi / 6
    for mass in (6.0, 30.0, 60.0):
        t = _TIMESTEP * np.arange(1, round(_SECONDS / _TIMESTEP) + 1)
        upright = 6 * np.cos(angle) ** 2  # stiffness of the vertical motion over a cable's; small depths
        theory = second_order(mass, upright * STIFFNESS, upright * DAMPING, t)
        _compare_massless(result, f"six cables, {mass:g} kg", mass, 6, angle, t, theory, 0.015)
        theory = inclined_chains(mass, STIFFNESS, DAMPING, 6, angle, t)
        _compare_chain(result, f"six chains, {mass:g} kg", mass, 6, angle, t, theory)
    steps = 2_000 if fast else 20_000
    cables = hanging_load(30.0, 1e-3, 6, angle)
    data = mujoco.MjData(cables)
    _race(result, "six cables, 30 kg", lambda count: mujoco.mj_step(cables, data, count), steps, 200)
    world, thrust = hanging_chain(30.0, 1e-3, 6, angle)
    _race(result, "six chains, 30 kg", lambda count: world.step(thrust, count), steps // 10, 10)
    return result


def _compare_massless(
    result: Result, name: str, mass: float, cables: int, angle: float, t: np.ndarray, theory: np.ndarray, limit: float
) -> None:
    """Add static stiffness, and elongation over the times `t`, of one load on massless cables."""
    model = hanging_load(mass, _TIMESTEP, cables, angle)
    depth = release(model, mujoco.MjData(model), 2.0)
    # Static: from the true geometry of the stretched cables, as depth is not small against 0.01 %.
    data = mujoco.MjData(model)
    data.qpos[2] = -depth[-1]
    mujoco.mj_forward(model, data)
    stretch = data.ten_length[0] - 1.0
    upright = (np.cos(angle) + depth[-1]) / data.ten_length[0]
    tested = mass * GRAVITY / cables / upright / stretch
    rest = mass * GRAVITY / (cables * STIFFNESS * np.cos(angle) ** 2)
    _add(result, name, tested, depth[: len(t)], t, theory, rest, limit, "second-order system")


def _compare_chain(
    result: Result, name: str, mass: float, cables: int, angle: float, t: np.ndarray, theory: np.ndarray
) -> None:
    """Add the same of a load on chains."""
    world, thrust = hanging_chain(mass, _TIMESTEP, cables, angle)
    start, depth = world.state.payload_position[0, 2], np.empty(len(t))
    for i in range(len(t)):
        depth[i] = start - world.step(thrust).payload_position[0, 2]
    world, thrust = hanging_chain(mass, _TIMESTEP, cables, angle, cable__bending_damping=0.01)  # to come to rest
    world.step(thrust, round(2.0 / _TIMESTEP))
    rest = mass * GRAVITY / (cables * STIFFNESS * np.cos(angle) ** 2)
    _add(result, name, tested_stiffness(world), depth, t, theory, rest, 0.01, "its masses, springs and dampers")


def _add(
    result: Result, name: str, tested: float, depth: np.ndarray, t: np.ndarray, theory: np.ndarray, rest: float,
    limit: float, label: str,
) -> None:  # fmt: skip
    error = (depth - theory) / rest
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    result.rows += [
        Row(name, "static stiffness [N/m], relative error", STIFFNESS, tested, relative(tested, STIFFNESS), 1e-4),
        Row(name, "elongation over 100 ms, RMS over the static stretch", 0.0, rms, rms, limit),
        Row(name, "the same, largest (for information)", 0.0, largest, largest, float("inf")),
    ]
    curves = [
        Curve(f"simulated, {1e3 * _TIMESTEP:g} ms", 1e3 * t, 1e6 * depth),
        Curve(label, 1e3 * t, 1e6 * theory, theory=True),
    ]
    slug = name.replace(", ", "_").replace(" ", "_").replace(".", "_")
    result.plots.append(Plot(slug, name, "time [ms]", "depth [µm]", curves))


def _race(result: Result, name: str, step: Callable[[int], object], steps: int, least: float) -> None:
    """Add the real-time factor of stepping on one core, in processor time, the best of three."""
    step(100)
    taken = []
    for _ in range(3):
        start = time.thread_time()
        step(steps)
        taken.append(time.thread_time() - start)
    factor = steps * 1e-3 / min(taken)
    quantity = f"real-time factor on one core at 1 ms, shortfall of {least}"
    result.rows.append(Row(name, quantity, least, factor, max(0.0, least - factor), 0.0))


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
                fastest = max(fastest, float(np.abs(world.state.payload_velocity).max()))
            name = f"k = 1e6 N/m, {cable}, {1e3 * timestep:g} ms"
            warnings = int(world.shards[0].batch.warning[:, :, 1].sum()) + int(world.diverged.sum())
            result.rows.append(
                Row(name, "warnings of MuJoCo in 0.3 s after a push of 0.2 m/s", 0, warnings, warnings, 0)
            )
            quantity = "largest payload speed [m/s], excess over 0.25"
            result.rows.append(Row(name, quantity, 0.2, fastest, max(0.0, fastest - 0.25), 0.0))
    return result


def hover_thrust(world: World) -> np.ndarray:
    """Return rotor thrusts (E, N, 4) [N] that hold drones and nominal pulls of their cables in equilibrium."""
    system = world.system
    force = np.linalg.norm(system.hook_force + GRAVITY * system.drone_mass[:, None] * [0, 0, 1], axis=1)
    return np.broadcast_to(force[:, None] / 4, (world.num_envs, world.num_drones, 4)).copy()


def integrators(fast: bool) -> Result:
    """Report figure 4: a stiff chain under MuJoCo's usual integrators, which cannot hold it, and under `discrete`."""
    result, timestep = Result(), 1e-3
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
        error = relative(depth, theory)
        quantity, limit = "depth of 1 kg on 10 segments after 0.5 s at 1 ms [m], relative error", 1e-4
        if name != "discrete":  # the counter-example: it counts as shown if the error is beyond 5 %
            quantity, limit = "the same, how far its error stays below 5 %", 0.0
            error = max(0.0, 0.05 - error)
        result.rows.append(Row(f"integrator {name}", quantity, theory, depth, error, limit))
    return result


def _chain(timestep: float) -> mujoco.MjModel:
    """Return a load of 1 kg on 10 nodes with springs and dampers between them (report eqs 14-16)."""
    spec = mujoco.MjSpec()
    set_options(spec, timestep)
    above, count = spec.worldbody.add_site(name="top"), 10
    for i in range(count):
        node = spec.worldbody.add_body(name=f"node_{i}", pos=[0, 0, -(i + 1) / count])
        node.mass, node.inertia, node.explicitinertial = (1.0 if i == count - 1 else 0.005), [1e-6] * 3, True
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
