"""Hidden parameters: their distributions, always from nominal, and that the physics follows them."""

from math import exp

import numpy as np
import pytest
from conftest import (
    ALL,
    GRAVITY,
    SHARES,
    bold_actions,
    free_world,
    hover_thrust,
    make,
    make_system,
    mask,
    refuse_system,
    same,
    steady,
    zeros,
)

import multilift_marl as ml
from multilift_marl.math3d import axis_angle
from multilift_marl.sim import World
from multilift_marl.sim.parameters import nominal_parameters

MODELS = pytest.mark.parametrize("model", ["massless", "chain"])
EVERYONE = np.ones(2, bool)


@pytest.fixture(scope="module")
def draws():
    """The draws of 12 episodes in a row of 100 environments, (1200, ...) each, and their nominal values."""
    vec = make(num_envs=100, num_drones=3, **ALL)
    kept = [vec.reset()[1]["randomization"] for _ in range(12)]
    return {name: np.concatenate([draw[name] for draw in kept]) for name in kept[0]}, nominal_parameters(
        vec.world.system, 1
    )


@pytest.mark.parametrize("name", SHARES)
def test_factors_are_uniform_about_the_nominal_value_in_every_episode(draws, name):
    values, nominal = draws[0][name], getattr(draws[1], name)
    share = (values / nominal - 1) / SHARES[name]
    assert np.abs(share).max() <= 1 + 1e-9
    for episode in np.split(share, 12):  # the last episodes are spread like the first ones: nothing compounds
        assert episode.min() < -0.9 and episode.max() > 0.9
    assert share.mean() == pytest.approx(0, abs=4 / np.sqrt(3 * share.size))
    assert share.var() == pytest.approx(1 / 3, rel=0.1)
    if share.ndim == 2:  # drones differ
        assert abs(np.corrcoef(share.T) - np.eye(3)).max() < 0.12


def test_center_of_mass_and_wind_are_uniform(draws):
    shift = draws[0]["payload_center_of_mass"] / [0.03, 0.02, 0.01]
    assert np.abs(shift).max() <= 1 and shift.min() < -0.98 and shift.max() > 0.98
    np.testing.assert_allclose(shift.var(axis=0), 1 / 3, rtol=0.1)
    wind = draws[0]["wind"]
    speed, direction = np.linalg.norm(wind, axis=1) / 4.0, np.arctan2(wind[:, 1], wind[:, 0]) / np.pi
    assert (wind[:, 2] == 0).all() and 0.98 < speed.max() <= 1 and speed.mean() == pytest.approx(0.5, abs=0.03)
    assert direction.mean() == pytest.approx(0, abs=0.07) and direction.var() == pytest.approx(1 / 3, rel=0.1)


def test_no_draw_follows_another(draws):
    columns = [values.reshape(len(values), -1) for values in draws[0].values()]
    together = np.concatenate([column[:, column.std(axis=0) > 0] for column in columns], axis=1)
    correlation = np.corrcoef(together.T) - np.eye(together.shape[1])
    assert np.abs(correlation).max() < 0.13


def test_other_draws_stay_what_they_are_without(draws):
    plain, more = make(num_drones=3), make(num_drones=3, **ALL)
    for _ in range(2):
        info, varied = plain.reset(seed=4)[1]["randomization"], more.reset(seed=4)[1]["randomization"]
        assert same(info["payload_mass"], varied["payload_mass"])
        assert same(info["payload_force"], varied["payload_force"])
        assert same(plain.task.goal, more.task.goal)
    narrow = make(num_drones=3, **(ALL | {"randomization.cable_length": 0.0, "randomization.wind": 0.0}))
    narrow = narrow.reset(seed=4)[1]["randomization"]
    assert same(narrow["vehicle_mass"], varied["vehicle_mass"])
    assert (narrow["cable_length"] == 1.0).all() and not narrow["wind"].any()


@pytest.mark.few_tasks
def test_info_holds_the_draw_at_reset_and_at_every_step(task, cables):
    vec = make(task, **ALL, **cables)
    drawn = vec.reset()[1]["randomization"]
    info = vec.step(zeros(vec))[4]
    assert same(drawn, info["randomization"])
    assert same(drawn["vehicle_mass"], vec.world.parameters.vehicle_mass)
    assert same(drawn["payload_force"], vec.world.hidden_loads.payload_force)
    with pytest.raises(ValueError, match="read-only"):
        drawn["vehicle_mass"][0] = 1
    again = vec.reset(mask=mask(4, 1))[1]["randomization"]
    assert same(drawn["vehicle_mass"][[0, 2, 3]], again["vehicle_mass"][[0, 2, 3]])
    assert (drawn["vehicle_mass"][1] != again["vehicle_mass"][1]).all()


def test_nothing_of_the_parameters_is_shown_to_the_drones(task, cables):
    vec = make(task, num_drones=3, **ALL, **cables)
    observation, _ = vec.reset(seed=1)
    for array in vec.world.parameters:
        array[:] = 2.0 * array + 0.1
    vec.task.stages["observe"](0, 4)
    assert same(observation, vec.task.observation)


def test_every_task_flies_with_everything_drawn_and_alike_alone(task, cables):
    batch = make(task, num_envs=4, num_drones=3, num_threads=2, **ALL, **cables)
    alone = make(task, num_envs=1, num_drones=3, first_env=2, **ALL, **cables)
    assert same(batch.reset(seed=5)[0][2], alone.reset(seed=5)[0][0])
    for step in range(40):
        action = 0.1 * bold_actions(batch, step)
        if batch.ended.any():
            break
        first, second = batch.step(action), alone.step(action[2:3])
        assert same(first[0][2], second[0][0]) and same(first[1][2], second[1][0])
    assert step > 5 and not batch.world.diverged.any()


@MODELS
def test_teams_hang_in_equilibrium_with_their_own_cables_and_vehicles(model):
    settings = {key: value for key, value in ALL.items() if "center" not in key and "wind" not in key}
    still = {"task_options.start_tilt": 0.0, "task_options.start_speed": 0.0, "randomization.payload_force": 0.0}
    vec = make(num_envs=6, num_drones=3, **{**settings, **still, "cable.model": model})
    vec.reset()
    world, p = vec.world, vec.world.parameters
    tension = np.linalg.norm(
        world.system.formation_force[0] + 0.5 * GRAVITY * world.system.cable_mass[0] * np.eye(3)[2]
    )
    expected = tension * p.payload_mass / world.system.payload_mass
    cable_weight = GRAVITY * world.system.cable_mass[0]
    tolerance = 1e-6 + 0.6 * cable_weight
    np.testing.assert_allclose(world.state.cable_tension, expected[:, None].repeat(3, 1), atol=tolerance)
    before = world.state.payload_position.copy()
    gain = world.system.vehicle.thrust_coefficient * p.vehicle_thrust_coefficient[..., None]
    thrust = gain * p.rotor_thrust_coefficient * world.state.rotor_speed**2
    np.testing.assert_allclose(thrust, thrust[..., :1].repeat(4, 2), rtol=1e-12)  # no moment
    lift = thrust.sum(axis=2) * world.state.drone_rotation[..., 2, 2]
    weight = GRAVITY * (
        p.payload_mass + p.vehicle_mass.sum(axis=1) + world.system.cable_mass[0] * p.cable_length.sum(1)
    )
    np.testing.assert_allclose(lift.sum(axis=1), weight, rtol=1e-9 if model == "massless" else 2e-3)
    commanded = world.system.vehicle.thrust_coefficient * world.state.rotor_speed**2
    world.step(commanded, 10)
    assert np.abs(world.state.payload_position - before).max() < 2e-4


@MODELS
def test_a_cable_stretches_by_its_own_stiffness_from_its_own_length(model):
    system = make_system(1, **{"cable.model": model, "cable.stiffness": 2000.0, "cable.damping": 40.0,
                               "payload.shape": "point", "payload.mass": 0.4, "vehicle.drag": (0, 0, 0)})  # fmt: skip
    world = World(system, 2, 1)
    length, stiffness, load = np.array([[1.0], [1.1]]), np.array([[2000.0], [3000.0]]), np.array([0.4, 0.6])
    world.set_parameters(EVERYONE, cable_length=length, cable_stiffness=stiffness, payload_mass=load)
    cable_mass = system.cable_mass[0] * length[:, 0]
    world.state.drone_position[:, 0] = world.state.payload_position + length * [0, 0, 1]
    world.load(EVERYONE)
    for _ in range(4000):
        cable_force = GRAVITY * (load + cable_mass + system.vehicle.mass)
        height = world.state.drone_position[:, 0, 2] - 2.5
        world.step(
            (cable_force - 20 * height - 12 * world.state.drone_velocity[:, 0, 2])[:, None, None].repeat(4, 2) / 4
        )
    stretch = world.state.drone_position[:, 0, 2] - world.state.payload_position[:, 2] - length[:, 0]
    own = cable_mass / 2 if model == "chain" else 0.0
    np.testing.assert_allclose(stretch, GRAVITY * (load + own) / stiffness[:, 0], rtol=1e-5)
    last = cable_mass if model == "chain" else 0.0
    np.testing.assert_allclose(world.state.cable_tension[:, 0], GRAVITY * (load + last), rtol=1e-5)


@MODELS
def test_going_back_to_nominal_leaves_nothing_behind(model):
    settings = {**ALL, "cable.model": model, "cable.breaking_load": 500.0}
    system = make_system(2, **settings)
    world, fresh = World(system, 2, 1), World(system, 2, 1)
    first = nominal_parameters(system, 2)
    rng = np.random.default_rng(0)
    for _ in range(3):
        values = {
            name: rng.uniform(-0.01, 0.01, array.shape)
            if "center" in name
            else array * rng.uniform(0.9, 1.1, array.shape)
            for name, array in first._asdict().items()
        }
        world.set_parameters(EVERYONE, **values)
    for each in (world, fresh):
        each.reset()
        each.step(hover_thrust(each), 25)
    np.testing.assert_allclose(world.state.drone_position, fresh.state.drone_position, atol=1e-12)
    assert same(world.parameters, nominal_parameters(system, 2))


def test_heavier_drones_fall_like_others_and_climb_by_their_own_mass():
    world = free_world(2, vehicle={"rotor_speed_min": 0.0})
    vehicle = world.system.vehicle
    mass = np.array([[vehicle.mass], [1.2 * vehicle.mass]])
    world.set_parameters(EVERYONE, vehicle_mass=mass)
    thrust = steady(world, 2.0)
    world.step(thrust, 50)
    expected = 0.2 * (8.0 / mass[:, 0] - GRAVITY)
    np.testing.assert_allclose(world.state.drone_velocity[:, 0, 2], expected, rtol=1e-9)
    np.testing.assert_allclose(world.state.payload_velocity[:, 2], -0.2 * GRAVITY, rtol=1e-9)
    turned = free_world(2)
    turned.set_parameters(EVERYONE, vehicle_mass=mass)
    turned.step(steady(turned, [1.5, 1.5, 1.6, 1.6]), 10)
    spin = turned.state.drone_body_rates[:, 0, 0]
    assert spin[0] / spin[1] == pytest.approx(1.2, rel=1e-9)


def test_thrust_follows_its_own_coefficient_and_lags_by_its_own_time_constant():
    settings = {"randomization.vehicle_thrust_coefficient": 0.2, "randomization.vehicle_rotor_time_constant": 0.5}
    world = free_world(2, **settings)
    vehicle = world.system.vehicle
    world.set_parameters(EVERYONE, vehicle_thrust_coefficient=np.array([[1.0], [1.15]]),
                         vehicle_rotor_time_constant=np.array([[1.0], [1.4]]))  # fmt: skip
    thrust = steady(world, 1.5)
    world.step(thrust, 10)
    expected = 0.04 * (6.0 * np.array([1.0, 1.15]) / vehicle.mass - GRAVITY)
    np.testing.assert_allclose(world.state.drone_velocity[:, 0, 2], expected, rtol=1e-9)
    first, goal = world.state.rotor_speed[0, 0, 0], np.sqrt(3.0 / vehicle.thrust_coefficient)
    world.step(np.full_like(thrust, 3.0), 5)
    lag = np.array([exp(-0.02 / (k * vehicle.rotor_time_constant_up)) for k in (1.0, 1.4)])
    np.testing.assert_allclose(world.state.rotor_speed[:, 0, 0], goal + (first - goal) * lag, rtol=1e-9)


def test_a_weak_rotor_turns_its_drone_by_the_thrust_that_it_lacks():
    world = free_world(2, **{"randomization.rotor_thrust_coefficient": 0.3})
    factors = np.ones((2, 1, 4))
    factors[1, 0] = 1.0, 0.8, 1.0, 1.0
    world.set_parameters(EVERYONE, rotor_thrust_coefficient=factors)
    vehicle = world.system.vehicle
    world.step(steady(world, 1.5))
    lever = np.array(vehicle.rotor_positions)[1]
    lacking = 0.2 * 1.5 * np.array([lever[1], -lever[0], vehicle.rotor_spin[1] * vehicle.torque_ratio])
    turned = world.state.drone_body_rates[:, 0]
    np.testing.assert_allclose(turned[0], 0.0, atol=1e-12)
    np.testing.assert_allclose(turned[1], -lacking / vehicle.inertia * world.system.timestep, rtol=1e-4)
    slower = world.state.drone_velocity[0, 0, 2] - world.state.drone_velocity[1, 0, 2]
    assert slower == pytest.approx(0.2 * 1.5 / vehicle.mass * world.system.timestep, rel=1e-6)


def test_single_rotors_change_no_other_draw_and_follow_their_width():
    widths = {"randomization.vehicle_mass": 0.1, "randomization.wind": 2.0, "randomization.action_delay": (0, 3)}
    plain = make("hover", num_envs=64, num_drones=3, **widths)
    own = make("hover", num_envs=64, num_drones=3, **widths, **{"randomization.rotor_thrust_coefficient": 0.2})
    before, drawn = (vec.reset(seed=3)[1]["randomization"] for vec in (plain, own))
    factors = drawn.pop("rotor_thrust_coefficient")
    assert factors.shape == (64, 3, 4) and len(np.unique(factors)) == factors.size
    assert 0.8 <= factors.min() < 0.81 and 1.19 < factors.max() <= 1.2 and factors.mean() == pytest.approx(1, abs=0.02)
    for name, array in before.items():
        np.testing.assert_array_equal(drawn[name], array, err_msg=name)


def test_drag_of_drone_and_payload_follow_their_factors():
    settings = {"randomization.vehicle_drag": 0.5, "randomization.payload_drag": 0.5}
    world = free_world(3, drag=True, **settings)
    everyone = np.ones(3, bool)
    factors = np.array([1.0, 1.4, 0.0])
    world.set_parameters(everyone, vehicle_drag=factors[:, None], payload_drag=factors)
    world.state.payload_velocity[:] = world.state.drone_velocity[:] = [5.0, 0.0, 0.0]
    world.load(everyone)
    world.step(steady(world, world.system.vehicle.mass * GRAVITY / 4))
    lost, drone = 5.0 - world.state.payload_velocity[:, 0], 5.0 - world.state.drone_velocity[:, 0, 0]
    assert lost[2] == 0 and drone[2] == 0
    assert lost[1] / lost[0] == pytest.approx(1.4, rel=1e-9) and drone[1] / drone[0] == pytest.approx(1.4, rel=1e-9)


@MODELS
def test_a_payload_falls_and_turns_about_its_own_centre_of_mass_with_its_own_inertia(model):
    shift = np.array([0.05, -0.02, 0.01])
    system = make_system(1, **{"cable.model": model, "cable.length": 20.0, "payload.drag_area": 0.0,
                               "cable.density": 1e-9, "randomization.payload_center_of_mass": (0.1, 0.1, 0.1),
                               "sim.timestep": 0.001})  # fmt: skip
    world = World(system, 2, 1)
    world.set_parameters(EVERYONE, payload_center_of_mass=np.array([[0.0] * 3, shift]),
                         payload_inertia=np.array([1.0, 1.5]))  # fmt: skip
    world.state.payload_position[:], world.state.drone_position[:] = [0, 0, 100], [0, 0, 102]
    rates = np.array([0.0, 0.0, 2.0])
    world.state.payload_body_rates[:] = rates
    world.load(EVERYONE)
    start = world.state.payload_position[1] + shift
    speed = np.cross(rates, shift)  # of the centre of mass
    world.step(np.zeros((2, 1, 4)), 100)
    middle = world.state.payload_position[1] + world.state.payload_rotation[1] @ shift
    fallen = start + 0.1 * speed + [0, 0, -0.5 * GRAVITY * 0.1**2]
    np.testing.assert_allclose(middle, fallen, atol=1e-3)
    np.testing.assert_allclose(world.state.payload_position[0], [0, 0, 100 - 0.5 * GRAVITY * 0.01], atol=1e-3)


@MODELS
@pytest.mark.parametrize("load", ["force", "wind"])
def test_force_and_wind_act_at_the_true_centre_of_mass(model, load):
    """The payload does not start to turn, and its centre of mass accelerates by force over mass."""
    shift, h = np.array([0.08, -0.05, 0.03]), 1e-3
    system = make_system(1, **{"cable.model": model, "cable.length": 20.0, "cable.density": 1e-9, "sim.timestep": h,
                               "payload.drag_area": 0.1 if load == "wind" else 0.0,
                               "randomization.payload_center_of_mass": (0.1, 0.1, 0.1)})  # fmt: skip
    world = World(system, 1, 1)
    one, turn = np.ones(1, bool), np.reshape(axis_angle((0.6, 0.0, 0.8), 0.7), (3, 3))
    world.set_parameters(one, payload_center_of_mass=shift[None])
    world.state.payload_position[:], world.state.drone_position[:] = [0, 0, 100], [0, 0, 102]
    world.state.payload_rotation[:] = turn
    world.load(one)
    force = np.array([0.0, 4.0, 1.0])
    if load == "force":
        world.hidden_loads.payload_force[:] = force
    else:
        world.hidden_loads.wind[:] = np.sqrt(2 / (1.225 * system.payload_drag_area * np.linalg.norm(force))) * force
    world.step(np.zeros((1, 1, 4)), 20)
    state = world.state
    middle = state.payload_velocity[0] + state.payload_rotation[0] @ np.cross(state.payload_body_rates[0], shift)
    expected = 20 * h * (force / system.payload_mass - [0, 0, GRAVITY])
    loose = 0.08 * np.abs(expected).max() if load == "wind" else 1e-5  # drag changes as the payload gains speed
    np.testing.assert_allclose(middle, expected, atol=loose)
    np.testing.assert_allclose(state.payload_body_rates[0], 0, atol=2e-5)  # about the origin: 0.3


def test_drag_of_a_turning_payload_is_that_of_its_true_centre_of_mass():
    shift, rates = np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 3.0])
    overrides = {"randomization.payload_center_of_mass": (0.1, 0.1, 0.1), "cable.length": 20.0, "sim.timestep": 5e-4}
    world = World(make_system(1, **overrides), 1, 1)
    world.set_parameters(np.ones(1, bool), payload_center_of_mass=shift[None])
    world.state.payload_position[:], world.state.drone_position[:] = [0, 0, 100], [0, 0, 102]
    world.state.payload_body_rates[:], world.state.payload_velocity[:] = rates, [0, 2.0, 0]
    world.load(np.ones(1, bool))
    world.step(np.zeros((1, 1, 4)))
    gained = world.state.payload_velocity[0, 1] + rates[2] * shift[0] - 2.3
    drag = 0.5 * 1.225 * world.system.payload_drag_area * 2.3**2 / world.system.payload_mass
    assert gained == pytest.approx(-5e-4 * drag, rel=2e-2)
    assert world.state.payload_body_rates[0, 2] == pytest.approx(3.0, abs=1e-6)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"randomization.payload_inertia": 0.1, "payload.shape": "point"}, "needs a payload with extent"),
        ({"randomization.action_delay": [3, 1]}, "shorter delay first"),
        ({"randomization.observation_noise": "loud"}, "none, standard"),
        ({"randomization.action_delay": 1.5}, "whole number"),
        ({"randomization.vehicle_mass": 0.9, "randomization.vehicle_thrust_coefficient": 0.6}, "vehicle_mass"),
        ({"randomization.vehicle_mas": 0.1}, "vehicle_mass"),
        ({"randomization.wind": -1}, "randomization.wind"),
    ],
)
def test_ranges_that_cannot_be_are_refused(settings, words):
    assert words in refuse_system(4, **settings)


def test_rotors_hold_the_cable_at_its_hook_from_the_start():
    """Their speeds at a start give the force and the moment that a cable beside the centre of mass asks for."""
    vec = ml.make_vec("hover", **{"env.num_envs": 1, "env.num_drones": 3, "cable.hook": [0.02, -0.01, -0.03]})
    vec.reset(seed=0)
    state, system = vec.world.state, vec.world.system
    for n, vehicle in enumerate(system.vehicles):
        rotation = state.drone_rotation[0, n]
        low, high = (vec.world.cable_points(0, n)[i] for i in (0, -1))
        pull = state.cable_tension[0, n] * (high - low) / np.linalg.norm(high - low)  # of the drone on its cable
        wrench = vehicle.allocation @ (vehicle.thrust_coefficient * state.rotor_speed[0, n] ** 2)
        hold = rotation.T @ (pull + [0.0, 0.0, vehicle.mass * 9.80665])
        assert wrench[0] == pytest.approx(hold[2], rel=0.01) and abs(hold[:2]).max() < 0.02 * hold[2]
        np.testing.assert_allclose(wrench[1:3], np.cross(system.hooks[n], rotation.T @ pull)[:2], atol=2e-3)
