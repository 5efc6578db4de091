"""Rotors at their limits: what is kept of roll and pitch, and drones that come back from any attitude."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import floats, make, zeros
from scipy.optimize import linprog

from multilift_marl.control.allocation import allocate
from multilift_marl.rig.presets import PRESETS
from multilift_marl.validation.bodies import attitudes, release_drones


def best_wrench(vehicle, thrust, torque, low, high):
    """Return shares of roll and pitch, total thrust and share of yaw that three linear programs find, one by one."""
    total, roll, pitch, yaw = vehicle.allocation
    # Unknowns: four rotors, the share of roll and pitch, that of yaw, the distance from the commanded thrust.
    equal = [[*roll, -torque[0], 0, 0], [*pitch, -torque[1], 0, 0], [*yaw, 0, -torque[2], 0]]
    below, limits = [[*total, 0, 0, -1], [*-total, 0, 0, -1]], [(low, high)] * 4 + [(0, 1), (0, 1), (0, None)]

    def smallest(cost, bounds):
        found = linprog(cost, below, [thrust, -thrust], equal, [0, 0, 0], bounds, method="highs")
        assert found.status == 0
        return found

    share = smallest([0, 0, 0, 0, -1, 0, 0], limits).x[4]
    limits[4] = (share - 1e-9, 1)
    limits[6] = (0, smallest([0, 0, 0, 0, 0, 0, 1], limits).fun + 1e-8 * high)
    best = smallest([0, 0, 0, 0, 0, -1, 0], limits).x
    return share, float(total @ best[:4]), best[5]


@pytest.mark.parametrize("name", PRESETS)
def test_roll_and_pitch_come_first_then_thrust_then_yaw(name):
    vehicle, rng = PRESETS[name], np.random.default_rng(3)
    inverse, high = np.ascontiguousarray(np.linalg.inv(vehicle.allocation)), vehicle.rotor_thrust_max
    for _ in range(12):
        thrust, torque = rng.uniform(0, 5) * high, rng.normal(0, 1.2 * high * vehicle.arm, 3)
        torque[2] = rng.normal(0, 1.4) * np.abs(vehicle.allocation[3]).mean() * high
        share, total, turned = best_wrench(vehicle, thrust, torque, 0.05 * high, high)
        wrench = vehicle.allocation @ allocate(thrust, floats(torque), inverse, 0.05 * high, high)
        np.testing.assert_allclose(wrench[1:3], share * torque[:2], atol=1e-7 * np.abs(torque).max())
        assert wrench[0] == pytest.approx(total, abs=1e-6 * high)
        assert wrench[3] == pytest.approx(turned * torque[2], abs=1e-4 * abs(torque[2]))


@pytest.mark.parametrize("name", ["falcon", "hummingbird", "x500"])
def test_thrust_does_not_leap_where_rotors_begin_to_saturate(name):
    vehicle, rng = PRESETS[name], np.random.default_rng(1)
    inverse, high = np.ascontiguousarray(np.linalg.inv(vehicle.allocation)), vehicle.rotor_thrust_max
    thrusts = np.linspace(0, 5 * high, 2001)
    for _ in range(4):
        torque = rng.normal(0, 1.2 * high * vehicle.arm, 3)
        torque[2] = rng.normal(0, 2) * np.abs(vehicle.allocation[3]).mean() * high
        totals = [sum(allocate(thrust, floats(torque), inverse, 0.0, high)) for thrust in thrusts]
        assert np.abs(np.diff(totals)).max() < 1.001 * (thrusts[1] - thrusts[0])


@pytest.mark.parametrize("seed", range(5))
def test_what_the_rotors_can_do_is_done(seed):
    rng = np.random.default_rng(seed)
    for vehicle in PRESETS.values():
        inverse, high = np.ascontiguousarray(np.linalg.inv(vehicle.allocation)), vehicle.rotor_thrust_max
        for rotors in rng.uniform(0.0, high, (20, 4)):
            thrust, *torque = (vehicle.allocation @ rotors).tolist()
            np.testing.assert_allclose(allocate(thrust, floats(torque), inverse, 0.0, high), rotors, atol=1e-9 * high)


def test_at_full_thrust_and_beyond_all_of_a_small_torque_is_left():
    vehicle = PRESETS["falcon"]
    inverse, torque = np.ascontiguousarray(np.linalg.inv(vehicle.allocation)), (0.1, -0.05, 0.0)
    for factor in (1.0, 1.2, 3.0):
        wrench = vehicle.allocation @ allocate(factor * 20.0, torque, inverse, 0.0, 5.0)
        np.testing.assert_allclose(wrench[1:], torque, atol=1e-12)


@pytest.mark.parametrize("name, angle, most", [("crazyflie", 0, 0.3), ("falcon", 1, 3.0), ("falcon", 2, 5.7)])
def test_upside_down_drones_come_back_after_a_short_fall(name, angle, most):
    fall, lost = release_drones(name, attitudes(0))
    assert not lost.any() and 0.5 * most < fall[angle] < most


@pytest.mark.slow
@pytest.mark.parametrize("drones, success", [(4, 0.8), (2, 0.9)])
def test_crazyflies_recover_without_a_policy(drones, success):
    payload = {"payload.shape": "point", "payload.mass": 0.01} if drones == 2 else {"payload.mass": 0.02}
    any_tension = {"task_options.success_tension": None}  # the configuration's limit is of another cord and payload
    vec = make("recover", 100, drones, **{"vehicle.preset": "crazyflie", **payload, **any_tension})
    vec.reset(seed=0)
    over, good = np.zeros(100, bool), np.zeros(100, bool)
    while not over.all():
        *_, terminated, truncated, info = vec.step(np.where(over[:, None, None], 0.0, zeros(vec)))
        ended = terminated | truncated
        good |= ended & info["success"]
        over |= ended
        vec.reset(mask=ended)
    assert good.mean() >= success
