"""Cables against the second-order system that they are: the report's section 4.1, its table 1 and figures 8-14."""

from __future__ import annotations

import time

import mujoco
import numpy as np

from multilift_marl.config.system import GRAVITY
from multilift_marl.sim.cables import IMPEDANCE, limit_solref
from multilift_marl.sim.scene import set_options
from multilift_marl.validation.experiment import Curve, Plot, Result, Row, relative

STIFFNESS, DAMPING = 1e5, 1e3  # [N/m], [N s/m]: the report's
_SECONDS = 0.1  # of elongation compared


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


def release(model: mujoco.MjModel, seconds: float) -> tuple[np.ndarray, np.ndarray]:
    """Return time (T,) and depth (T,) below the start of a load that is let go."""
    data = mujoco.MjData(model)
    steps = round(seconds / model.opt.timestep)
    depth = np.empty(steps)
    for i in range(steps):
        mujoco.mj_step(model, data)
        depth[i] = -data.qpos[2]
    return model.opt.timestep * np.arange(1, steps + 1), depth


def second_order(mass: float, stiffness: float, damping: float, t: np.ndarray) -> np.ndarray:
    """Return the depth (T,) of a mass let go on a spring and damper at natural length, m ẍ = m g - k x - c ẋ."""
    rest = mass * GRAVITY / stiffness
    roots = np.roots([1, damping / mass, stiffness / mass]).astype(complex)
    weights = np.linalg.solve(np.stack([np.ones(2), roots]), [-rest, 0])
    return rest + np.real(weights @ np.exp(roots[:, None] * t))


def single_cable(fast: bool) -> Result:
    """Report table 1 and figures 8-11: one cable, loads of 0.1-5 kg."""
    result = Result()
    for mass in (0.1, 0.5, 1.0, 5.0):
        result = _compare(result, f"single cable, {mass:g} kg", mass, 1, 0.0, 0.06 if mass < 0.5 else 0.015)
    return result


def six_cables(fast: bool) -> Result:
    """Report figures 12-14: six cables 30° from the vertical, loads of 6-60 kg, with the real-time factor."""
    result = Result()
    for mass in (6.0, 30.0, 60.0):
        result = _compare(result, f"six cables, {mass:g} kg", mass, 6, np.pi / 6, 0.015)
    model = hanging_load(30.0, 1e-3, 6, np.pi / 6)
    data, steps = mujoco.MjData(model), 2_000 if fast else 20_000
    mujoco.mj_step(model, data, 100)
    start = time.perf_counter()
    mujoco.mj_step(model, data, steps)
    factor = steps * model.opt.timestep / (time.perf_counter() - start)
    quantity = "real-time factor on one core at 1 ms, shortfall of 200"
    result.rows.append(Row("six cables, 30 kg", quantity, 200, factor, max(0, 200 - factor), 0))
    return result


def _compare(result: Result, name: str, mass: float, cables: int, angle: float, limit: float) -> Result:
    """Add static stiffness, and elongation over the first 100 ms, of one load."""
    stiffness = cables * STIFFNESS * np.cos(angle) ** 2  # of the vertical motion; small depths
    damping = cables * DAMPING * np.cos(angle) ** 2
    model = hanging_load(mass, 5e-4, cables, angle)
    t, depth = release(model, 2.0)
    # Static: from the true geometry of the stretched cables, as depth is not small against 0.01 %.
    data = mujoco.MjData(model)
    data.qpos[2] = -depth[-1]
    mujoco.mj_forward(model, data)
    stretch = data.ten_length[0] - 1.0
    upright = (np.cos(angle) + depth[-1]) / data.ten_length[0]
    tested = mass * GRAVITY / cables / upright / stretch
    result.rows.append(
        Row(name, "static stiffness [N/m], relative error", STIFFNESS, tested, relative(tested, STIFFNESS), 1e-4)
    )
    early = t <= _SECONDS
    theory, rest = second_order(mass, stiffness, damping, t[early]), mass * GRAVITY / stiffness
    error = (depth[early] - theory) / rest
    rms, largest = float(np.sqrt(np.mean(error**2))), float(np.abs(error).max())
    result.rows.append(Row(name, "elongation over 100 ms, RMS over the static stretch", 0.0, rms, rms, limit))
    result.rows.append(Row(name, "the same, largest (for information)", 0.0, largest, largest, float("inf")))
    curves = [
        Curve("simulated, 0.5 ms", 1e3 * t[early], 1e6 * depth[early]),
        Curve("second-order system", 1e3 * t[early], 1e6 * theory, theory=True),
    ]
    slug = name.replace(", ", "_").replace(" ", "_").replace(".", "_")
    result.plots.append(Plot(slug, name, "time [ms]", "depth [µm]", curves))
    return result


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
