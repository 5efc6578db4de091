"""Bodies, rotors and single drones in motion against closed forms, and how the errors vanish with the time step."""

from __future__ import annotations

import mujoco
import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.math3d import axis_angle, quat_to_mat
from multilift_marl.physical import AIR_DENSITY, GRAVITY
from multilift_marl.rig.presets import PRESETS
from multilift_marl.schema.control import ControlConfig
from multilift_marl.sim.contact import drone_half_size
from multilift_marl.sim.world import World
from multilift_marl.validation.cables import hanging_load
from multilift_marl.validation.experiment import Plot, Result, make_config, ms

STEPS = (4e-3, 2e-3, 1e-3)  # [s]
_START = 50.0  # [m] of altitude of a fall
_RELEASE_HEIGHT = 1000.0  # [m]
_RELEASE_SECONDS = 30.0
_KNOWN_ROLLS = (90.0, 179.0, 179.9)  # [deg]
_BACK = 0.05  # [m]


def free_fall(fast: bool) -> Result:
    """A drone and a payload fall for a second: without drag, with drag that slows the fall, and coasting sideways."""
    result = Result()
    seconds = 1.0
    cast = 5.0
    errors: dict[str, list[float]] = {"depth without drag": [], "speed with drag": [], "speed of a coasting drone": []}
    for timestep in STEPS:
        bare = _fall(timestep, seconds, 0.0, 0.0)
        dragged = _fall(timestep, seconds, 0.09, cast)
        system = dragged.system
        name = f"free fall, {ms(timestep)}"
        speed = float(-bare.state.payload_velocity[0, 2])
        result.compare(name, "speed without drag [m/s], relative error", GRAVITY * seconds, speed, 1e-12)
        depth = _START - float(bare.state.payload_position[0, 2])
        terminal = float(np.sqrt(system.payload_mass * GRAVITY / (0.5 * AIR_DENSITY * system.payload_drag_area)))
        # m v' = m g - ½ ρ C_d A v² from rest: v = v_t tanh(g t/v_t).
        falling = terminal * float(np.tanh(GRAVITY * seconds / terminal))
        # m v' = -d v along x, whatever the fall: the drag of a drone is linear.
        coasting = cast * float(np.exp(-system.vehicle.drag[0] / system.vehicle.mass * seconds))
        found = (
            ("depth without drag", "m", 0.5 * GRAVITY * seconds**2, depth),
            ("speed with drag", "m/s", falling, float(-dragged.state.payload_velocity[0, 2])),
            ("speed of a coasting drone", "m/s", coasting, float(dragged.state.drone_velocity[0, 0, 0])),
        )
        for quantity, unit, theory, simulated in found:
            error = result.compare(name, f"{quantity} [{unit}], relative error", theory, simulated, 0.005)
            errors[quantity].append(error)
    caption = "A falling payload and a coasting drone: errors after one second over the time step."
    plot = Plot("free_fall", "falling and coasting", "time step [ms]", "relative error", caption=caption, log="xy")
    for quantity, values in errors.items():
        result.order("free fall", quantity, values, STEPS)
        plot.add(quantity, 1e3 * np.array(STEPS), np.array(values))
    result.plots.append(plot)
    return result


def _fall(timestep: float, seconds: float, drag_area: float, cast: float) -> World:
    """Return a drone, thrown sideways at `cast` [m/s], and a payload after a fall, their cable slack, rotors still."""
    free = {"payload__drag_area": drag_area, "cable__length": 30.0, "vehicle__rotor_speed_min": 0.0}
    world = World(make_config(1, timestep, **free).system, 1, 1)
    state = world.state
    state.payload_position[0] = [0, 0, _START]
    state.drone_position[0, 0] = [5, 0, _START]
    state.drone_velocity[0, 0] = [cast, 0, 0]
    state.rotor_speed[:] = 0.0
    world.load(np.ones(1, bool))
    world.step(np.zeros((1, 1, 4)), round(seconds / timestep))
    return world


def motor_lag(fast: bool) -> Result:
    """A step of the commanded thrust: rotor speed 1 - exp(-t/τ), at any time step."""
    caption = "A step of the commanded rotor speed: exact at any time step."
    plot = Plot("motor_lag", "step of the commanded rotor speed", "time [ms]", "rotor speed [rad/s]", caption=caption)
    result = Result(plots=[plot])
    for timestep in STEPS:
        system = make_config(4, timestep).system
        world = World(system, 1, 1)
        vehicle = system.vehicle
        start = world.state.rotor_speed[0, 0, 0]
        target = 0.9 * vehicle.rotor_speed_max
        thrust = np.full((1, 4, 4), vehicle.thrust_coefficient * target**2)
        steps = round(0.1 / timestep)
        t = timestep * np.arange(1, steps + 1)
        speed = np.array([world.step(thrust).rotor_speed[0, 0, 0] for _ in range(steps)])
        theory = target + (start - target) * np.exp(-t / vehicle.rotor_time_constant)
        error = float(np.abs(speed - theory).max() / target)
        result.check(f"motor lag, {ms(timestep)}", "rotor speed over 0.1 s, largest relative error", error, 1e-9)
        plot.add(ms(timestep), 1e3 * t, speed)
    plot.add("1 - exp(-t/τ)", 1e3 * t, theory, theory=True)
    return result


def spin(fast: bool) -> Result:
    """A torque-free asymmetric body tumbles at 20 rad/s: energy and size of its angular momentum stay what they are.

    The momentum's direction sways by half a step's turn, because attitudes follow the rates at the ends of steps.
    """
    caption = "A tumbling drone: change of its angular momentum, which sways and does not drift."
    plot = Plot("spin", "torque-free tumbling", "time [s]", "angular momentum, relative change", caption=caption)
    result = Result(plots=[plot])
    errors = []
    seconds = 1.0 if fast else 10.0
    for timestep in STEPS:
        world = _fall(timestep, 0.0, 0.0, 0.0)
        state = world.state
        state.payload_position[0, 2] = state.drone_position[0, 0, 2] = _RELEASE_HEIGHT
        state.drone_body_rates[0, 0] = 20.0 * np.array([0.6, 0.48, 0.64])
        world.load(np.ones(1, bool))
        world.hidden_loads.motors_off[:] = True
        inertia = np.asarray(world.system.vehicle.inertia)
        kept = []
        energy = []
        for _ in range(round(seconds / timestep) + 1):
            own = inertia * state.drone_body_rates[0, 0]
            kept.append(state.drone_rotation[0, 0] @ own)
            energy.append(0.5 * float(own @ state.drone_body_rates[0, 0]))
            world.step(np.zeros((1, 1, 4)))
        size = np.linalg.norm(kept, axis=1)
        turned = np.linalg.norm(np.array(kept) - kept[0], axis=1) / size[0]
        errors.append(float(turned.max()))
        after = f"after {seconds:g} s at {ms(timestep)}, relative change"
        result.check("torque-free spin", f"energy {after}", abs(energy[-1] / energy[0] - 1), 1e-3)
        result.check("torque-free spin", f"size of the angular momentum {after}", abs(size[-1] / size[0] - 1), 1e-3)
        quantity = f"angular momentum within {seconds:g} s at {ms(timestep)}, largest relative change"
        result.check("torque-free spin", quantity, errors[-1], 0.03)
        shown = turned[: round(1.0 / timestep)]
        plot.add(ms(timestep), timestep * np.arange(len(shown)), shown)
    result.order("torque-free spin", "angular momentum", errors, STEPS)
    return result


def swing(fast: bool) -> Result:
    """A load of 1 kg swings from 30° for 20 s: its period, and what the integrator takes of its energy."""
    caption = "A load swings from 30°: its energy, averaged over a swing, of which integrator and damper take a little."
    plot = Plot("swing", "energy of a swinging load", "time [s]", "mean energy over the initial one", caption=caption)
    result = Result(plots=[plot])
    seconds = 5.0 if fast else 20.0
    start = np.deg2rad(30.0)
    # Stretched as it hangs at rest, by m g/k.
    length = 1.0 + GRAVITY / 1e5
    # Exact for any amplitude: 2π √(L/g)/agm(1, cos(θ/2)), agm being the arithmetic-geometric mean (Gauss).
    period = 2 * np.pi * np.sqrt(length / GRAVITY) / _mean(1.0, np.cos(start / 2))
    losses = []
    for timestep in STEPS:
        time, angle, energy = _swing(timestep, seconds, start, length)
        swing_steps = round(period / timestep)
        mean = np.convolve(energy, np.full(swing_steps, 1 / swing_steps), mode="valid")
        plot.add(ms(timestep), time[swing_steps // 2 :][: len(mean)], mean)
        window = round(2.0 / timestep)
        losses.append(1 - float(energy[-window:].mean()) / float(energy[:window].mean()))
        limit = 0.01 if timestep == 4e-3 else np.inf
        result.check("swinging load", f"energy lost in {seconds:g} s at {ms(timestep)}, share", losses[-1], limit)
        # Once in each period it passes the vertical from the same side; the moment is interpolated between steps.
        down = np.flatnonzero((angle[:-1] > 0) & (angle[1:] <= 0))
        crossing = time[down] + timestep * angle[down] / (angle[down] - angle[down + 1])
        found = float(np.diff(crossing).mean())
        result.compare("swinging load", f"period at {ms(timestep)} [s], relative error", period, found, 1e-3)
    # The cable's own damper takes some of the energy too, so the numerical part shows in the differences.
    shares = (losses[0] - losses[1], losses[1] - losses[2])
    result.order("swinging load", "numerical part of the energy lost", shares, STEPS[:2])
    return result


def _swing(timestep: float, seconds: float, start: float, length: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return times (T,) [s], angle (T,) [rad] and energy over the initial one (T,) of a swinging load of 1 kg."""
    model = hanging_load(1.0, timestep)
    data = mujoco.MjData(model)
    data.qpos[:] = length * np.sin(start), 0, 1.0 - length * np.cos(start)
    scale = GRAVITY * length * (1 - np.cos(start))
    angle = []
    energy = []
    for _ in range(round(seconds / timestep)):
        mujoco.mj_step(model, data)
        angle.append(np.arctan2(data.qpos[0], 1.0 - data.qpos[2]))
        energy.append((0.5 * data.qvel @ data.qvel + GRAVITY * (data.qpos[2] - 1.0 + length)) / scale)
    return timestep * np.arange(1, len(energy) + 1), np.array(angle), np.array(energy)


def _mean(a: float, b: float) -> float:
    """Return the arithmetic-geometric mean, of which the period of a pendulum is made."""
    while abs(a - b) > 1e-15 * a:
        a, b = 0.5 * (a + b), float(np.sqrt(a * b))
    return a


def ground(fast: bool) -> Result:
    """A payload and drones, dropped tilted with their rotors still, come to rest on the ground and stay there."""
    caption = "Dropped from 30 cm with tilts of 10°: heights of payload and one drone above their resting heights."
    plot = Plot("ground", "coming to rest on the ground", "time [s]", "height [m]", caption=caption)
    result = Result(plots=[plot])
    for timestep in (4e-3, 1e-3):
        system = make_config(4, timestep, vehicle__rotor_speed_min=0.0).system
        world = World(system, 1, 1)
        state = world.state
        half = drone_half_size(system.vehicle)[2]
        frame = np.zeros(9)
        # A turn by 10° about x: quaternions have half the angle.
        mujoco.mju_quat2Mat(frame, np.array([np.cos(np.deg2rad(5)), np.sin(np.deg2rad(5)), 0, 0]))
        state.payload_position[0] = [0, 0, system.payload_size[2] / 2 + 0.3]
        outward = system.slots[:, :2] / np.linalg.norm(system.slots[:, :2], axis=1, keepdims=True)
        state.drone_position[0, :, :2] = system.anchors[:, :2] + 0.6 * outward
        state.drone_position[0, :, 2] = half + 0.3
        state.payload_rotation[:] = state.drone_rotation[:] = frame.reshape(3, 3)
        state.rotor_speed[:] = 0.0
        world.load(np.ones(1, bool))
        rest = np.array([system.payload_size[2] / 2] + [half] * 4)
        thrust = np.zeros((1, 4, 4))
        heights = []
        for _ in range(round(3.0 / timestep)):
            world.step(thrust)
            heights.append(np.array([state.payload_position[0, 2], *state.drone_position[0, :, 2]]) - rest)
        where = np.concatenate([state.payload_position, state.drone_position[0]])
        world.step(thrust, round(5.0 / timestep))
        later = np.concatenate([state.payload_position, state.drone_position[0]])
        name = f"on the ground, {ms(timestep)}"
        sunk = float(np.abs(heights[-1]).max())
        result.check(name, "height over that of rigid contact 3 s after the drop [m]", sunk, 1e-3)
        result.check(name, "motion in the 5 s that follow [m]", float(np.abs(later - where).max()), 1e-6)
        shown = round(1.0 / timestep)
        time = timestep * np.arange(1, shown + 1)
        for label, column in (("payload", 0), ("drone 0", 1)):
            plot.add(f"{label}, {ms(timestep)}", time, np.array(heights)[:shown, column])
    return result


def release(fast: bool) -> Result:
    """Drones of every preset are let go at rest at their references, rotors at hover speed, in random attitudes."""
    result = Result()
    for preset in PRESETS:
        name = f"release, {preset}"
        fall, lost = release_drones(preset, attitudes(30 if fast else 1000))
        quantity = f"drones not back within {100 * _BACK:g} cm after {_RELEASE_SECONDS:g} s, of {len(lost)}"
        result.check(name, quantity, int(lost.sum()), 0)
        for angle, depth in zip(_KNOWN_ROLLS, fall, strict=False):
            result.check(name, f"fall from {angle:g}° of roll [m] (for information)", float(depth))
        deepest = float(fall[len(_KNOWN_ROLLS) :].max())
        result.check(name, "largest fall from random attitudes [m] (for information)", deepest)
    return result


def attitudes(count: int) -> np.ndarray:
    """Return known rolls, then `count` attitudes uniform over all rotations (K, 3, 3)."""
    known = [np.reshape(axis_angle((1.0, 0.0, 0.0), float(np.deg2rad(angle))), (3, 3)) for angle in _KNOWN_ROLLS]
    quaternions = np.random.default_rng(0).normal(size=(count, 4))
    return np.stack([*known, *(np.reshape(quat_to_mat(*q.tolist()), (3, 3)) for q in quaternions)])


def release_drones(preset: str, start: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far each drone fell (K,) [m], and whether it is not back at its reference (K,)."""
    count = len(start)
    light = {"env.num_drones": 1, "vehicle.preset": preset, "payload.mass": 1e-3, "randomization.payload_force": 0.0}
    system = load_config("hover", light).system
    world = World(system, count, 1)
    gains = make_gains(ControlConfig(), system)
    reference = Reference.zeros(count, 1)
    state = world.state
    reference.position[:] = [0.0, 0.0, _RELEASE_HEIGHT]
    # Out of the way; the cable is broken below, so that the drone flies alone.
    state.payload_position[:] = [0.0, 50.0, 0.0]
    state.drone_position[:] = reference.position
    state.drone_rotation[:, 0] = start
    state.rotor_speed[:] = np.sqrt(system.drone_mass[0] * GRAVITY / 4 / system.vehicle.thrust_coefficient)
    world.load(np.ones(count, bool))
    world.break_cables(np.ones((count, 1), bool))
    lowest = np.full(count, _RELEASE_HEIGHT)
    no_force = np.zeros((count, 1, 3))
    for _ in range(round(_RELEASE_SECONDS / system.timestep)):
        fly(0, count, state, reference, no_force, world.thrust, gains)
        world.step(world.thrust)
        lowest = np.minimum(lowest, state.drone_position[:, 0, 2])
    away = np.linalg.norm(state.drone_position - reference.position, axis=-1)[:, 0]
    # `not a < b`, so that NaN counts as lost.
    return _RELEASE_HEIGHT - lowest, ~(away < _BACK)
