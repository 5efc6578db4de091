"""Slack cables that go taut: the peak inside a physics step, at any time step."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import load, make_system, without_drag

from multilift_marl.sim import World
from multilift_marl.sim.cables.massless import snatch_peak
from multilift_marl.validation.chains import exponential


def exact_peak(speed, acceleration, mass, stiffness, damping) -> float:
    """Return the largest force of a spring and damper by the matrix exponential, until it lets go."""
    period = 2 * np.pi / np.sqrt(stiffness / mass)
    step = period * max(1.0, damping / np.sqrt(stiffness * mass)) * 1.5 / 20_000
    flow = np.array([[0.0, 1.0, 0.0], [-stiffness / mass, -damping / mass, acceleration], [0.0, 0.0, 0.0]])
    propagator, state, best = exponential(flow * step), np.array([0.0, speed, 1.0]), damping * speed
    for _ in range(20_000):
        state = propagator @ state
        force = stiffness * state[0] + damping * state[1]
        if force < 0:
            break
        best = max(best, force)
    return best


@pytest.mark.parametrize("seed", range(30))
def test_the_closed_form_is_the_largest_force_of_two_bodies_on_a_spring_and_damper(seed):
    rng = np.random.default_rng(seed)
    mass, stiffness = 10 ** rng.uniform(-1.5, 1), 10 ** rng.uniform(2, 6)
    damping = 2 * 10 ** rng.uniform(-2, 1) * np.sqrt(stiffness * mass)
    case = 10 ** rng.uniform(-1, 1), rng.uniform(-15, 15), mass, stiffness, damping
    assert snatch_peak(*case) == pytest.approx(exact_peak(*case), rel=1e-5)


@pytest.mark.parametrize("speed", [1.0, 0.05])  # whose force is largest at once, and later
@pytest.mark.parametrize("damping", [200.0 * (1 - 1e-10), 200.0, 200.0 * (1 + 1e-10)])
def test_a_critically_damped_cable_has_a_peak_too(speed, damping):
    case = speed, 20.0, 0.5, 2e4, damping
    assert snatch_peak(*case) == pytest.approx(exact_peak(*case), rel=1e-4)


def thrown_apart(speed: float, timestep: float, tilt: float = 0.0, phase: float = 0.3, **cable) -> World:
    """Return a drone and its payload in free fall that have parted at `speed` [m/s] until the cable was taut."""
    shape = "box" if tilt else "point"
    values = {"payload.shape": shape, "sim.timestep": timestep, "sim.control_hz": 250}
    world = World(
        without_drag(make_system(1, **values, **{f"cable.{key}": value for key, value in cable.items()})), 1, 1
    )
    state, system = world.state, world.system
    along = np.array([np.sin(tilt), 0.0, np.cos(tilt)])
    state.payload_position[:], state.payload_rotation[:], state.drone_rotation[:] = [0, 0, 200], np.eye(3), np.eye(3)
    slack = 0.02 + phase * 4e-3 * speed
    state.drone_position[0, 0] = [0, 0, 200] + system.anchors[0] + along * (system.cable_length[0] - slack)
    state.payload_velocity[:], state.drone_velocity[:] = -0.5 * speed * along, 0.5 * speed * along
    state.rotor_speed[:] = 0.0
    load(world)
    world.hidden_loads.motors_off[:] = True
    world.step(np.zeros((1, 1, 4)), round((0.03 / speed + 0.05) / timestep))
    return world


@pytest.mark.parametrize("tilt", [0.0, 0.5])
@pytest.mark.parametrize("speed", [0.2, 1.0, 2.0, 5.0])
@pytest.mark.parametrize("timestep", [4e-3, 1e-3, 2.5e-4])
def test_the_recorded_peak_does_not_depend_on_the_time_step(speed, timestep, tilt):
    for phase in (0.0, 0.5, 0.9):
        world = thrown_apart(speed, timestep, tilt, phase)
        assert world.stats.tension_peak[0] == pytest.approx(1e3 * speed, rel=0.01)  # c v: it falls from there


def test_fine_steps_show_the_same_peak():
    seen = 0.0
    world = thrown_apart(1.0, 1e-5)
    assert world.stats.tension_peak[0] == pytest.approx(1000, rel=0.01)
    world = thrown_apart(1.0, 4e-3)
    seen = float(world.state.cable_tension.max())
    assert seen < 100  # means over steps of 4 ms


@pytest.mark.parametrize("breaking_load, breaks", [(900.0, True), (1100.0, False)])
@pytest.mark.parametrize("timestep", [4e-3, 1e-3])
def test_a_cable_breaks_by_the_peak(breaking_load, breaks, timestep):
    world = thrown_apart(1.0, timestep, breaking_load=breaking_load)
    assert bool(world.state.cable_broken[0, 0]) == breaks
