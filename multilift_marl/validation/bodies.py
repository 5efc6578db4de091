"""Bodies, rotors and cables in motion against closed forms, and how the errors vanish with the time step."""

from __future__ import annotations

import mujoco
import numpy as np

from multilift_marl.config.load import load_config
from multilift_marl.config.system import GRAVITY, System
from multilift_marl.sim.world import World
from multilift_marl.validation.cables import hanging_load
from multilift_marl.validation.experiment import Curve, Plot, Result, Row, relative


def _system(num_drones: int, timestep: float = 0.004, **overrides) -> System:
    values = {"env.num_drones": num_drones, "sim.timestep": timestep, "sim.control_hz": 1 / timestep}
    return load_config("hover", values | {key.replace("__", "."): value for key, value in overrides.items()}).system


def swing(fast: bool) -> Result:
    """A load of 1 kg swings from 30° for 20 s: what the integrator takes of its energy, at several time steps."""
    result, plot = Result(), Plot("swing", "energy of a swinging load", "time [s]", "energy over the initial one")
    seconds = 5.0 if fast else 20.0
    losses = []
    for timestep in (4e-3, 2e-3, 1e-3):
        model = hanging_load(1.0, timestep)
        data = mujoco.MjData(model)
        start, height = np.deg2rad(30.0), 1.0 + GRAVITY / 1e5
        data.qpos[:] = height * np.sin(start), 0, 1.0 - height * np.cos(start)
        scale = GRAVITY * height * (1 - np.cos(start))
        energy = []
        for _ in range(round(seconds / timestep)):
            mujoco.mj_step(model, data)
            energy.append((0.5 * data.qvel @ data.qvel + GRAVITY * (data.qpos[2] - 1.0 + height)) / scale)
        energy = np.array(energy)
        period = round(2.0 / timestep)
        losses.append(1 - float(energy[-period:].mean()) / float(energy[:period].mean()))
        plot.curves.append(Curve(f"{1e3 * timestep:g} ms", timestep * np.arange(1, len(energy) + 1), energy))
        limit = 0.01 if timestep == 4e-3 else float("inf")
        quantity = f"energy lost in {seconds:g} s at {1e3 * timestep:g} ms, share"
        result.rows.append(Row("swinging load", quantity, 0.0, losses[-1], abs(losses[-1]), limit))
    order = float(np.log2((losses[0] - losses[1]) / (losses[1] - losses[2])))  # the cable's own damper also takes some
    quantity = "order in the time step of the numerical part, shortfall of 0.9"
    result.rows.append(Row("swinging load", quantity, 1.0, order, max(0.0, 0.9 - order), 0.0))
    result.plots.append(plot)
    return result


def slack_taut(fast: bool) -> Result:
    """A drone and a payload fly apart in free fall until their cable comes taut: momentum, and no pushing."""
    result = Result()
    plot = Plot("slack_taut", "a cable comes taut", "time [ms]", "tension [N]")
    for timestep in (1e-3, 2.5e-4):
        system = _system(1, timestep, payload__drag_area=0.0)
        world = World(system, 1, 1)
        world.state.drone_position[0, 0] = world.state.payload_position[0] + [0, 0, 0.9]
        world.state.drone_rotation[0, 0] = np.eye(3)
        world.state.drone_velocity[0, 0], world.state.payload_velocity[0] = [0, 0, 1.0], [0, 0, -1.0]
        world.state.rotor_speed[:] = system.vehicle.rotor_speed_min
        world.load(np.ones(1, bool))
        masses = np.array([system.vehicle.mass, system.payload_mass])
        before = masses @ [1.0, -1.0]
        tension, steps, drag = [], round(0.1 / timestep), np.asarray(system.vehicle.drag)[2]
        lift = 4 * system.vehicle.thrust_coefficient * system.vehicle.rotor_speed_min**2 * steps * timestep
        assert drag == 0  # along the body axis, so that weight and idle thrust are all that acts
        for _ in range(steps):
            world.step(np.zeros((1, 1, 4)))
            tension.append(world.state.cable_tension[0, 0])
        after = masses @ [world.state.drone_velocity[0, 0, 2], world.state.payload_velocity[0, 2]]
        expected = before - masses.sum() * GRAVITY * steps * timestep + lift
        error = abs(after - expected) / abs(expected)
        name = f"slack to taut, {1e3 * timestep:g} ms"
        quantity = "vertical momentum after it [kg m/s], relative error"
        result.rows.append(Row(name, quantity, expected, after, error, 1e-9))
        least = float(min(tension))
        result.rows.append(Row(name, "least tension [N]: it never pushes", 0.0, least, max(0.0, -least), 0.0))
        slack = float(max(tension[: round(0.03 / timestep)]))
        result.rows.append(Row(name, "largest tension while slack [N]", 0.0, slack, slack, 0.0))
        plot.curves.append(Curve(f"{1e3 * timestep:g} ms", 1e3 * timestep * np.arange(1, steps + 1), np.array(tension)))
    result.plots.append(plot)
    return result


def static_teams(fast: bool) -> Result:
    """Symmetric teams at rest: tension m g/(N cos θ), and nothing moves for a second."""
    result = Result()
    for count in (2, 3, 4, 6, 8):
        system = _system(count)
        world = World(system, 1, 1)
        force = system.formation_force + [0, 0, system.vehicle.mass * GRAVITY]
        thrust = np.repeat(np.linalg.norm(force, axis=1)[None, :, None] / 4, 4, axis=2)
        for _ in range(50 if fast else 250):
            world.step(thrust)
        theory = system.payload_mass * GRAVITY / (count * np.cos(np.deg2rad(30)))
        tension = float(world.state.cable_tension[0].mean())
        name = f"{count} drones at rest"
        result.rows.append(Row(name, "tension [N], relative error", theory, tension, relative(tension, theory), 1e-6))
        speed = float(np.abs(world.state.payload_velocity).max())
        result.rows.append(Row(name, "payload speed [m/s]", 0.0, speed, speed, 1e-6))
    return result


def motor_lag(fast: bool) -> Result:
    """A step of the commanded thrust: rotor speed 1 - exp(-t/τ), at any time step."""
    result, plot = Result(), Plot("motor_lag", "step of the commanded rotor speed", "time [ms]", "rotor speed [rad/s]")
    for timestep in (4e-3, 1e-3):
        system = _system(4, timestep)
        world, vehicle = World(system, 1, 1), system.vehicle
        start, target = world.state.rotor_speed[0, 0, 0], 0.9 * vehicle.rotor_speed_max
        thrust = np.full((1, 4, 4), vehicle.thrust_coefficient * target**2)
        steps = round(0.1 / timestep)
        t = timestep * np.arange(1, steps + 1)
        speed = np.array([world.step(thrust).rotor_speed[0, 0, 0] for _ in range(steps)])
        theory = target + (start - target) * np.exp(-t / vehicle.rotor_time_constant)
        error = float(np.abs(speed - theory).max() / target)
        name = f"motor lag, {1e3 * timestep:g} ms"
        result.rows.append(Row(name, "rotor speed over 0.1 s, largest relative error", 0.0, error, error, 1e-9))
        plot.curves.append(Curve(f"{1e3 * timestep:g} ms", 1e3 * t, speed))
    plot.curves.append(Curve("1 - exp(-t/τ)", 1e3 * t, theory, theory=True))
    result.plots.append(plot)
    return result


def spin(fast: bool) -> Result:
    """A torque-free asymmetric body tumbles at 10 rad/s: angular momentum kept, the better the smaller the step."""
    result, errors = Result(), []
    for timestep in (4e-3, 2e-3, 1e-3):
        system = _system(4, timestep)
        world = World(system, 1, 1)
        world.state.drone_position[:] += [0, 0, 50.0]  # in free fall beside its team: cables would pull at once,
        world.state.payload_position[:] += [0, 0, 50.0]
        world.load(np.ones(1, bool))
        model = world.model
        data = mujoco.MjData(model)
        data.qpos[:] = world.qpos(0)
        model.tendon_limited[:] = 0  # so they are cut for this experiment
        dof = 6
        data.qvel[dof + 3 : dof + 6] = [10 / np.sqrt(3)] * 3
        inertia = np.asarray(system.vehicle.inertia)

        def momentum(data=data, inertia=inertia) -> np.ndarray:
            frame = np.zeros(9)
            mujoco.mju_quat2Mat(frame, data.qpos[10:14])
            return frame.reshape(3, 3) @ (inertia * data.qvel[9:12])

        before = momentum()
        for _ in range(round(1.0 / timestep)):
            mujoco.mj_step(model, data)
        after = momentum()
        errors.append(float(np.linalg.norm(after - before) / np.linalg.norm(before)))
        quantity = f"angular momentum lost in 1 s at {1e3 * timestep:g} ms, share"
        result.rows.append(Row("torque-free spin", quantity, 0.0, errors[-1], errors[-1], 0.02))
    order = float(np.log2(errors[0] / errors[2]) / 2)
    quantity = "order in the time step in which it vanishes, shortfall of 0.9"
    result.rows.append(Row("torque-free spin", quantity, 1.0, order, max(0.0, 0.9 - order), 0.0))
    return result
