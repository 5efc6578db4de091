"""Rotors at their limits: what is kept of roll and pitch, and drones that come back from any attitude."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import floats, make, zeros

from multilift_marl.control.allocation import allocate
from multilift_marl.rig.presets import PRESETS
from multilift_marl.validation.bodies import attitudes, release_drones


def best_by_search(vehicle, thrust, torque, low, high):
    """Return share of roll and pitch and total thrust by brute force, first the largest, then the nearest."""
    inverse = np.linalg.inv(vehicle.allocation)
    for share in np.linspace(0, 1, 2001):  # of yaw that helps
        rotors = inverse @ [thrust, torque[0], torque[1], share * torque[2]]
        if (rotors >= low - 1e-3 * high).all() and (rotors <= high * (1 + 1e-3)).all():
            return 1.0, thrust

    def range_of_thrust(share):
        tilt = share * (inverse[:, 1] * torque[0] + inverse[:, 2] * torque[1])
        return ((low - tilt) / inverse[:, 0]).max(), ((high - tilt) / inverse[:, 0]).min()

    shares = [share for share in np.linspace(1, 0, 20001) if np.subtract(*range_of_thrust(share)) <= 1e-12]
    return shares[0], float(np.clip(thrust, *range_of_thrust(shares[0])))


@pytest.mark.slow
@pytest.mark.parametrize("name", PRESETS)
def test_roll_and_pitch_come_first_then_thrust(name):
    vehicle, rng = PRESETS[name], np.random.default_rng(3)
    inverse, high = np.ascontiguousarray(np.linalg.inv(vehicle.allocation)), vehicle.rotor_thrust_max
    for _ in range(12):
        thrust, torque = rng.uniform(0, 6) * high, rng.normal(0, 2 * high * vehicle.arm, 3)
        torque[2] *= 0.1
        share, total = best_by_search(vehicle, thrust, torque, 0.05 * high, high)
        wrench = vehicle.allocation @ allocate(thrust, floats(torque), inverse, 0.05 * high, high)
        np.testing.assert_allclose(wrench[1:3], share * torque[:2], atol=2e-4 * np.abs(torque).max())
        assert wrench[0] == pytest.approx(total, abs=1e-2 * high)
        assert -1e-9 <= wrench[3] / torque[2] <= 1 + 1e-9


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
