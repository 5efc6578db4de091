"""What a payload's motion asks of its team: closed forms, limits in the order in which they are exceeded, flights."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import GRAVITY, make, make_system

from multilift_marl.config.load import load_config
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.planning import waypoints
from multilift_marl.planning.feasibility import Margin, assess_path, find_violation
from multilift_marl.planning.minimum_snap import fit_minimum_snap
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.schema.sections import RandomizationConfig

NOTHING = RandomizationConfig()
RATES = {"control.action": "acc_rates", "control.max_acceleration": 25.0, "control.max_tilt_rate": 15.0}


def table_of(rows) -> np.ndarray:
    """Return a minimum-snap path through rows t, x, y, z, yaw as a spline."""
    rows = np.array(rows, float)
    spline = fit_minimum_snap(rows[:, 0], rows[:, 1:])
    t = np.linspace(0, rows[-1, 0], int(20 * rows[-1, 0]) + 1)
    return np.hstack([t[:, None], spline(t), spline(t, 1), spline(t, 2)])


def of(feasibility, name):
    return next(quantity for quantity in feasibility.quantities if quantity.name == name)


def test_at_rest_it_is_the_resting_team():
    system = make_system(4)
    found = assess_path(table_of([[0, 0, 0, 2, 0], [1, 0, 0, 2, 0]]), system, NOTHING)
    force = system.formation_force
    rest = np.linalg.norm(force + system.drone_mass[:, None] * [0, 0, GRAVITY], axis=1)
    np.testing.assert_allclose(of(found, "thrust").values, np.tile(rest, (len(found.times), 1)), rtol=1e-9)
    np.testing.assert_allclose(found.tension[0], system.resting_tension, rtol=1e-9)
    slots = system.slots
    apart = np.linalg.norm(slots[:, None] - slots[None], axis=-1) + np.where(np.eye(4), np.inf, 0)
    np.testing.assert_allclose(of(found, "distance").values[0], apart.min(axis=1), rtol=1e-6)
    low = 2 - system.payload_size[2] / 2 + system.payload_center[2]
    assert of(found, "height").values[0, 0] == pytest.approx(low)
    assert found.violation is None and [margin.quantity for margin in found.margins] == [
        "thrust", "tilt", "turning", "cable angle", "cable lift", "distance", "height"
    ]  # fmt: skip


def test_a_lift_adds_its_inertia_to_all_cables_alike():
    """Straight up, without drag, each of four cables takes a quarter of m a more, and the drones keep level with it."""
    system = make_system(4, **{"payload.drag_area": 0.0, "vehicle.drag": [0.0, 0.0, 0.0]})
    path = fit_minimum_snap(np.array([0.0, 2.0]), np.array([[0, 0, 2.0, 0], [0, 0, 4.0, 0]]))
    found = assess_path(table_of([[0, 0, 0, 2, 0], [2, 0, 0, 4, 0]]), system, NOTHING)
    acceleration = path(found.times, 2)[:, 2:3]
    force = system.formation_force + np.zeros((len(found.times), 4, 3))
    force[..., 2] += system.payload_mass * acceleration / 4
    np.testing.assert_allclose(found.tension[2:-2], np.linalg.norm(force, axis=-1)[2:-2], rtol=2e-3)
    np.testing.assert_allclose(of(found, "cable lift").values[2:-2], force[2:-2, :, 2], rtol=2e-3)
    assert acceleration.max() > 3


def test_a_payload_that_falls_slackens_its_cables():
    found = assess_path(table_of([[0, 0, 0, 9, 0], [2, 0, 0, 4, 0]]), make_system(4), NOTHING)
    least = {margin.quantity: margin for margin in found.margins}
    assert least["cable lift"].spare < 0 and found.violation is not None
    slower = assess_path(table_of([[0, 0, 0, 9, 0], [2.5, 0, 0, 4, 0]]), make_system(4), NOTHING)
    assert slower.violation is None


def test_what_episodes_draw_counts():
    table, system = table_of([[0, 0, 0, 2, 0], [2, 2, 0, 2, 0]]), make_system(4)
    plain = assess_path(table, system, NOTHING)
    heavy = assess_path(table, system, RandomizationConfig(payload_mass=0.2))
    weak = assess_path(table, system, RandomizationConfig(vehicle_thrust_coefficient=0.1))
    np.testing.assert_allclose(heavy.tension[0], 1.2 * plain.tension[0], rtol=1e-9)
    np.testing.assert_allclose(of(weak, "thrust").limits, 0.9 * of(plain, "thrust").limits)
    assert of(heavy, "thrust").values.max() > of(plain, "thrust").values.max()


@pytest.mark.parametrize(
    ("rows", "quantity", "drone"),
    [
        ([[0, 0, 0, 2, 0], [1, 3, 0, 2, 0]], "thrust", None),
        ([[0, 0, 0, 5, 0], [1.7, 0, 0, 2, 0]], "turning", None),
        ([[0, 0, 0, 1, 0], [2, 0, 0, -0.2, 0], [4, 0, 0, 1, 0]], "height", -1),
    ],
)
def test_the_first_limit_that_is_exceeded_is_named(rows, quantity, drone):
    system = make_system(4)
    found = assess_path(table_of(rows), system, NOTHING)
    first = found.violation
    assert first is not None and first.quantity == quantity and first.spare < 0
    assert drone is None or first.drone == drone
    assert first == find_violation(table_of(rows), system, NOTHING)
    assert f"at {first.time:.2f} s the {quantity} of" in str(first) and first.unit in str(first)
    for each in found.quantities:  # none is exceeded before
        earlier = found.times < first.time - 1e-9
        assert (each.spare()[earlier] >= 0).all()
    least = {margin.quantity: margin for margin in found.margins}
    assert isinstance(least[quantity], Margin) and least[quantity].spare <= first.spare


def test_bodies_on_one_cable_are_not_assessed_and_points_are():
    fast = table_of([[0, 0, 0, 2, 0], [1, 3, 0, 2, 0]])
    assert find_violation(fast, make_system(1), NOTHING) is None
    for count in (1, 3):
        point = make_system(count, **{"payload.shape": "point"})
        assert find_violation(fast, point, NOTHING) is not None
        assert ("distance" in {each.quantity for each in assess_path(fast, point, NOTHING).margins}) == (count > 1)


@pytest.mark.slow
@pytest.mark.parametrize(("seconds", "flies"), [(1.6, False), (1.8, True)])
def test_the_limits_are_where_flights_begin_to_fail(seconds, flies, monkeypatch):
    """Down by 2.5 m: what is refused policy=mpc cannot fly, and what is not it flies within a centimetre."""
    monkeypatch.setattr(waypoints, "find_violation", lambda *team: None)
    places, times = [[0, 0, 4], [0, 0, 1.5]], [0.0, seconds]
    options = {"path": "waypoints", "waypoints": places, "waypoint_times": times, "start_radius": 0.0, "rmse_from": 0.0}
    overrides = RATES | {f"task_options.{key}": value for key, value in options.items()}
    config = load_config("track", overrides | {"env.episode_seconds": 3.0, "env.num_threads": 1})
    flown = run_episodes(config, lambda vec: make_scripted("mpc", vec), 1, 77)
    assert (
        find_violation(table_of([[0, 0, 0, 4, 0], [seconds, 0, 0, 1.5, 0]]), config.system, NOTHING) is None
    ) == flies
    assert bool(flown["success_rate"][0] and flown["payload_rmse_m"][0] < 0.01) == flies


@pytest.mark.slow
@pytest.mark.parametrize("num_drones", [3, 4])
def test_a_flight_needs_what_was_planned(num_drones):
    """Tensions and rotor thrusts of a team under policy=mpc, which keeps to the path within millimetres."""
    places = [[0, 0, 1.5], [3, 1, 2, 0.5], [4, -2, 1.2, 1.0], [0, 0, 1.5]]
    options = {"path": "waypoints", "waypoints": places, "speed": 3.0, "acceleration": 4.0, "start_radius": 0.0}
    overrides = RATES | {f"task_options.{key}": value for key, value in options.items()}
    vec = make("track", num_envs=1, num_drones=num_drones, **overrides)
    observation, _ = vec.reset(seed=0)
    policy = make_scripted("mpc", vec)
    planned = assess_path(vec.task.settings.table, vec.world.system, load_config("track").randomization)
    thrust = of(planned, "thrust").values
    lift = np.array([vehicle.thrust_coefficient for vehicle in vec.world.system.vehicles])
    for _ in range(round(planned.times[-1] / vec.task.dt)):
        observation, *_ = vec.step(policy.act(observation))
        state, t = vec.world.state, vec.task.time[0]
        if t < 1.0 or t > planned.times[-1]:
            continue
        for n in range(num_drones):
            tension = np.interp(t, planned.times, planned.tension[:, n])
            assert state.cable_tension[0, n] == pytest.approx(tension, abs=0.25)
            total = lift[n] * (state.rotor_speed[0, n] ** 2).sum()
            assert total == pytest.approx(np.interp(t, planned.times, thrust[:, n]), abs=0.5)
