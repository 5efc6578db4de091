"""What the validation module compares with: closed forms, trajectories and maps, each checked on its own."""

from dataclasses import replace

import numpy as np
import pytest

from multilift_marl.config.load import load_config
from multilift_marl.sim.air import AIR_DENSITY
from multilift_marl.validation import flight, symmetry
from multilift_marl.validation.cables import bounce, second_order
from multilift_marl.validation.experiment import make_config
from multilift_marl.validation.symmetry import make_team

PLAN = flight.make_plan((0.1, 0.1))


@pytest.fixture(params=["report4", "falcon4"])
def system(request):
    return load_config(f"rigs/{request.param}").system


def test_second_order_system_solves_its_equation():
    t = np.linspace(0, 0.05, 20001)
    for mass, stiffness, damping in ((1.0, 1e5, 1e3), (10.0, 1e5, 1e3), (0.1, 1e5, 1e3)):
        x = second_order(mass, stiffness, damping, t)
        v = np.gradient(x, t)
        residual = mass * np.gradient(v, t) + damping * v + stiffness * x - mass * 9.81
        assert np.abs(residual[5:-5]).max() < 0.02 * mass * 9.81
        assert abs(x[0]) < 1e-15


def test_bounce_solves_its_equation():
    system = make_config(1, 1e-3).system
    mass = 1 / (1 / system.vehicle.mass + 1 / system.payload_mass)
    k, c, x, v, h = system.cable_stiffness[0], system.cable_damping[0], 0.0, 2.0, 1e-8
    while k * x + c * v > 0:
        middle = x + 0.5 * h * v, v - 0.5 * h * (k * x + c * v) / mass
        x, v = x + h * middle[1], v - h * (k * middle[0] + c * middle[1]) / mass
    assert bounce(system, 2.0) == pytest.approx(v, rel=1e-4)


def test_load_path_is_smooth_and_consistent(system):
    h, time = 1e-4, np.linspace(0.5, PLAN.edges[-1] - 0.5, 200)
    p, v, a = flight.load_path(system, PLAN, time)
    before, after = (flight.load_path(system, PLAN, time + side * h) for side in (-1, 1))
    np.testing.assert_allclose((after[0] - before[0]) / (2 * h), v, atol=1e-5)
    np.testing.assert_allclose((after[1] - before[1]) / (2 * h), a, atol=1e-5)
    np.testing.assert_allclose(np.linalg.norm(p[:, :2], axis=1), flight.RADIUS, rtol=1e-12)


def test_circles_have_their_rates_with_yaw_along_them(system):
    for name, rate in (("slow circle", 0.2), ("fast circle", 0.4)):
        time = np.linspace(0, PLAN.edges[-1], 3000)
        time = time[PLAN.during(name, time)]
        planned = flight.make_trajectory(system, PLAN, time)
        velocity = flight.load_path(system, PLAN, time)[1]
        np.testing.assert_allclose(np.linalg.norm(velocity, axis=1), 5.0 * rate, rtol=1e-9)
        np.testing.assert_allclose(planned.yaw_rate, rate, rtol=1e-9)
        heading = np.stack([np.cos(planned.yaw), np.sin(planned.yaw), 0 * planned.yaw], axis=1)
        np.testing.assert_allclose(heading, velocity / (5.0 * rate), atol=1e-9)


def test_references_are_derivatives_of_each_other(system):
    h, time = 1e-3, np.linspace(2.5, PLAN.edges[-1] - 0.5, 300)
    planned = flight.make_trajectory(system, PLAN, time)
    before, after = (flight.make_trajectory(system, PLAN, time + side * h) for side in (-1, 1))
    for name, rate in (("position", "velocity"), ("velocity", "acceleration"), ("acceleration", "jerk")):
        slope = (getattr(after, name) - getattr(before, name)) / (2 * h)
        np.testing.assert_allclose(slope, getattr(planned, rate), atol=2e-3)


def test_cables_are_slack_until_they_are_to_tighten(system):
    time = np.linspace(0, PLAN.start("tighten"), 500)[:-1]
    planned = flight.make_trajectory(system, PLAN, time)
    distance = np.linalg.norm(planned.position - planned.payload[:, None] - system.anchors, axis=2)
    assert np.all(distance < system.cable_length + 1e-12) and np.all(planned.cable_force == 0)
    ground, places = flight.on_the_ground(system)
    assert ground == pytest.approx(system.payload_size[2] / 2) and np.all(places[:, 2] > 0)
    np.testing.assert_allclose(planned.position[0], places)


def test_cable_forces_carry_the_load_against_its_drag(system):
    time = np.array([PLAN.start("fast circle") + 0.5])
    planned = flight.make_trajectory(system, PLAN, time)
    _, v, a = (part[0] for part in flight.load_path(system, PLAN, time))
    drag = 0.5 * AIR_DENSITY * system.payload_drag_area * np.linalg.norm(v) * v
    total = system.payload_mass * (a + [0, 0, 9.81]) + drag
    np.testing.assert_allclose(planned.cable_force[0].sum(axis=0), total, atol=1e-9)
    np.testing.assert_allclose(np.cross(system.anchors, planned.cable_force[0]).sum(axis=0), 0, atol=1e-9)
    cable = planned.position[0] - planned.payload[0] - system.anchors
    np.testing.assert_allclose(np.cross(cable, planned.cable_force[0]), 0, atol=1e-9)


def test_maps_of_teams_undo_themselves():
    team = make_team("massless")
    turned = symmetry.turned(symmetry.turned(team, 0.7), -0.7)
    renumbered = symmetry.renumbered(symmetry.renumbered(team, np.array([1, 2, 3, 0])), np.array([3, 0, 1, 2]))
    for twin in (turned, symmetry.mirrored(symmetry.mirrored(team)), renumbered):
        for name in ("anchors", "length", "wind", "force", "target", "position", "rotation", "velocity", "rates"):
            np.testing.assert_allclose(getattr(twin, name), getattr(team, name), atol=1e-12, err_msg=name)


def test_a_team_that_is_no_twin_differs():
    team = make_team("massless")
    first, _ = symmetry.fly_home(team, 0.5)
    other, _ = symmetry.fly_home(replace(team, force=team.force + [1e-3, 0, 0]), 0.5)
    assert np.abs(other - first).max() > 1e-6
    assert np.abs(first[:, :, 1]).max() > 0.1  # it does not fly in the mirror's plane
