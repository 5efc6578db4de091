"""Rejection of unknown forces: the estimate against the truth, its dynamics and limits, stability with a payload."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest
from conftest import GRAVITY, load_script, make, refusal, same, zeros

import multilift_marl as ml
from multilift_marl.control.disturbance import Disturbance, make_rejection
from multilift_marl.control.gains import make_gains
from multilift_marl.control.setpoints import track_own_state
from multilift_marl.kernels.jit import bind, kernel_name

KINDS = ("integral", "indi")
RIGS = ("falcon4", "report4", "crazyflie2", "auto6")
bench = load_script("bench/disturbance")


def windy(kind: str, wind: float = 3.0, **overrides) -> bench.Flight:
    """Return one falcon with a payload of 1 g, in wind: all that pushes it is its own drag."""
    light = {"env.num_drones": 1, "payload.shape": "point", "payload.mass": 1e-3, "payload.drag_area": 0.0,
             "randomization.payload_force": 0.0}  # fmt: skip
    config = ml.load_config("hover", light | {"control.disturbance": kind} | overrides)
    flight = bench.Flight(config, np.ones(1))
    flight.world.hidden_loads.wind[:] = [wind, 0, 0]
    return flight


@pytest.mark.parametrize("kind", KINDS)
def test_the_estimate_is_the_drag_and_the_drone_stands_where_it_should(kind):
    flight = windy(kind)
    for _ in range(2500):
        flight.step()
    state = flight.world.state
    drag = state.drone_rotation[0, 0] @ (
        np.array(flight.system.vehicle.drag) * (state.drone_rotation[0, 0].T @ [3, 0, 0])
    )
    assert np.linalg.norm(drag) > 0.9
    np.testing.assert_allclose(flight.disturbance.force[0, 0], -drag, atol=0.01)
    assert np.linalg.norm(state.drone_position - flight.reference.position) < 5e-4


def test_indi_sees_a_force_through_a_first_order_filter_however_the_drone_moves():
    flight = windy("indi")
    state, w = flight.world.state, min(3.0, 4.0 / (1 + 1e-3 / flight.gains.mass))
    flight.reference.velocity[:], flight.reference.acceleration[:] = 0.0, 0.0
    filtered, largest = np.zeros(3), 0.0
    for k in range(500):
        flight.reference.position[0, 0, 1] = 0.3 * np.sin(2.0 * k * flight.dt)  # moves, untold by derivatives
        flight.step()
        air = state.drone_velocity[0, 0] - [3, 0, 0]
        rotation = state.drone_rotation[0, 0]
        push = -rotation @ (flight.system.vehicle.drag * (rotation.T @ air))
        filtered += (1 - exp(-w * flight.dt)) * (-push - filtered)
        error = np.linalg.norm(flight.disturbance.force[0, 0] - filtered)
        largest = max(largest, error)
    assert np.linalg.norm(filtered) > 0.9
    assert largest < 0.02 * np.linalg.norm(filtered)


def test_what_is_fed_forward_is_no_disturbance():
    flight = windy("indi", wind=0.0, **{"control.drag_feedforward": True})
    reference, t = flight.reference, 0.0
    largest = 0.0
    for _ in range(500):
        t += flight.dt
        reference.position[0, 0, 0], reference.velocity[0, 0, 0] = 1 - np.cos(t), np.sin(t)
        reference.acceleration[0, 0, 0], reference.jerk[0, 0, 0] = np.cos(t), -np.sin(t)
        flight.step()
        largest = max(largest, np.abs(flight.disturbance.force).max())
    assert flight.world.state.drone_velocity[0, 0, 0] > 0.8
    assert largest < 0.1 * flight.gains.mass  # of the 1 m/s² flown


def test_a_nominal_load_that_is_lifted_is_no_disturbance():
    flight = bench.Flight(ml.load_config("rigs/falcon4", {"control.disturbance": "indi"}), np.ones(1))
    reference, largest = flight.reference, 0.0
    for k in range(500):
        t = k * flight.dt
        reference.position[..., 2] = flight.slots[:, 2] + 1 - np.cos(t)  # accelerates by cos t
        reference.velocity[..., 2], reference.acceleration[..., 2] = np.sin(t), np.cos(t)
        reference.jerk[..., 2] = -np.sin(t)
        flight.step()
        largest = max(largest, np.abs(flight.disturbance.force[..., 2]).max())
    assert largest < 0.15 * flight.gains.load_share.max()  # of the 1 m/s² flown


@pytest.mark.parametrize("kind", KINDS)
def test_the_estimate_is_limited(kind):
    flight = windy(kind, wind=30.0, **{"control.disturbance_limit": 0.2})
    for _ in range(750):
        flight.step()
    assert np.linalg.norm(flight.disturbance.force) == pytest.approx(0.2 * flight.gains.mass * GRAVITY)
    assert not flight.world.diverged.any()


def test_the_integral_does_not_grow_while_rotors_are_at_their_limits():
    flight = windy("integral", wind=0.0)
    flight.reference.position[0, 0, 2] += 1.0
    for saturated, grows in ((True, False), (False, True)):
        before = flight.disturbance.force.copy()
        flight.world.state.rotor_speed[:] = flight.system.vehicle.rotor_speed_max if saturated else 1000.0
        flight.reject()
        assert (np.linalg.norm(flight.disturbance.force) > np.linalg.norm(before)) == grows
    # Within 1 % of the largest thrust of either limit, of one rotor.
    vehicle = flight.system.vehicle
    low, high = flight.gains.thrust_min[0], flight.gains.thrust_max[0]
    for thrust, grows in (
        (low + 0.008 * high, False),
        (low + 0.012 * high, True),
        (0.988 * high, True),
        (0.992 * high, False),
    ):
        before = flight.disturbance.force.copy()
        flight.world.state.rotor_speed[:] = 1000.0
        flight.world.state.rotor_speed[0, 0, 2] = np.sqrt(thrust / vehicle.thrust_coefficient)
        flight.reject()
        assert (np.linalg.norm(flight.disturbance.force) > np.linalg.norm(before)) == grows, thrust
    flight.reference.position[0, 0, 2] -= 2.0
    before = flight.disturbance.force.copy()
    flight.world.state.rotor_speed[:] = flight.system.vehicle.rotor_speed_max
    flight.reject()
    assert np.linalg.norm(flight.disturbance.force) < np.linalg.norm(before)  # but it shrinks


@pytest.mark.parametrize("kind", KINDS)
def test_the_bandwidth_leaves_room_for_load_and_position_loop(kind):
    def bandwidth(**overrides):
        config = ml.load_config("hover", {"control.disturbance": kind, **overrides})
        gains = make_gains(config.control, config.system)
        c = make_rejection(config.control, config.system, gains, 0.004)
        return c.gain / (gains.mass * gains.k_p) if kind == "integral" else -np.log(1 - c.share) / 0.004

    share = {"integral": 0.5, "indi": 1.0}[kind]
    assert bandwidth() == pytest.approx(4.0 * share * 0.6168 / (0.6168 + 0.35))
    assert bandwidth(**{"control.position_frequency": 2.0}) == pytest.approx(0.5 * bandwidth())
    assert bandwidth(**{"control.disturbance_frequency": 0.7}) == pytest.approx(0.7)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("rig", RIGS)
def test_a_swinging_payload_of_another_mass_comes_to_rest(rig, kind):
    decay = bench.swing_decay(ml.load_config(f"rigs/{rig}", {"control.disturbance": kind}), seconds=10.0)
    assert decay.min() > 0.07  # report4 damps its swing by no more without any rejection


@pytest.mark.slow
@pytest.mark.parametrize("rate", [0.2, 0.4])
@pytest.mark.parametrize("rig", ["falcon4", "report4"])
def test_drones_stay_within_3_cm_on_the_circle_in_wind_and_gusts(rig, rate):
    config = ml.load_config(f"rigs/{rig}", {"control.drag_feedforward": True, "control.disturbance": "indi"})
    drones, _ = bench.fly_cases(config, rate, seconds=6.0)
    assert drones.max() < 0.03


# In the environments


@pytest.mark.parametrize("kind", KINDS)
def test_the_formation_carries_an_unknown_payload_to_its_target(kind):
    distance = {}
    for name in ("none", kind):
        hidden = {"randomization.payload_mass": 0.2, "randomization.payload_force": 0.0}
        vec = make(num_envs=8, **{"control.disturbance": name, **hidden})
        vec.reset(seed=0)
        for _ in range(399):
            vec.step(zeros(vec))
        distance[name] = vec.task.errors.distance.max()
    assert distance[kind] < 0.005 < 0.04 < distance["none"]


@pytest.mark.parametrize("kind", KINDS)
def test_estimates_are_forgotten_at_a_reset_and_saved_with_the_rest(kind):
    options = {"control.disturbance": kind}
    vec, fresh = make(num_envs=3, **options), make(num_envs=3, num_threads=2, **options)
    vec.reset(seed=4)
    for _ in range(20):
        vec.step(zeros(vec))
    assert np.abs(vec.controller.disturbance.force).max() > 0.01
    saved = vec.state_dict()
    assert {f"disturbance.{field}" for field in Disturbance._fields} <= saved.keys()
    fresh.load_state_dict(saved)
    assert all(same(vec.step(zeros(vec)), fresh.step(zeros(fresh))) for _ in range(5))
    vec.reset(seed=4), fresh.reset(seed=4)
    again = make(num_envs=3, **options)
    again.reset(seed=4)
    assert all(same(vec.step(zeros(vec)), again.step(zeros(again))) for _ in range(5))


@pytest.mark.parametrize("moves", [False, True])
def test_all_else_of_a_control_step_is_done_before_the_estimate_and_thrusts_after_it(moves):
    named = {}
    for kind in ("none", "integral"):
        vec, action = make("hover", 1, 2, **{"control.disturbance": kind}), np.zeros((1, 2, 4))
        plan = bind(track_own_state, 0, 1, vec.world.state, vec.reference, 0.0) if moves else None
        _, calls = vec.controller.bind(0, 1, action, vec.task.goal, plan)
        named[kind] = [kernel_name(call) for call in calls]
    before, thrusts = named["none"][:-1], named["none"][-1]
    assert len(before) == (4 if moves else 1)
    assert named["integral"][:-2] == before and named["integral"][-1] == thrusts
    assert named["integral"][-2] not in named["none"]


def test_without_rejection_nothing_is_kept():
    vec = make(num_envs=1)
    assert vec.controller.disturbance is None
    assert not [key for key in vec.state_dict() if key.startswith("disturbance")]


@pytest.mark.parametrize("kind, action", [("indi", "ctbr"), ("indi", "rotor"), ("integral", "velocity")])
def test_a_rejection_with_nothing_to_correct_is_refused(kind, action):
    options = {"control.disturbance": kind, "control.action": action}
    message = refusal(ml.make_vec, "hover", num_envs=1, num_threads=1, **options)
    assert f"control.disturbance={kind} has nothing to correct with control.action={action}" in message
