"""Rotors at their limits: what is kept of roll and pitch, and drones that come back from any attitude."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import floats, load, make, make_system, zeros

from multilift_marl.config.schema import ControlConfig
from multilift_marl.config.vehicles import PRESETS
from multilift_marl.control.allocation import allocate
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import fly
from multilift_marl.math3d import axis_angle
from multilift_marl.sim import World

# Largest fall [m] that any attitude may cost: about twice what was measured, see docs/control.md
FALL = {"falcon": 12.0, "crazyflie": 3.0, "crazyflie_id": 4.0, "hummingbird": 12.0, "iris": 12.0}


def best_by_search(vehicle, thrust, torque, low, high):
    """Return share of roll and pitch and total thrust by brute force: the first as large, the second as near as can be."""
    inverse = np.linalg.inv(vehicle.allocation)

    def range_of_thrust(share):
        tilt = share * (inverse[:, 1] * torque[0] + inverse[:, 2] * torque[1])
        return ((low - tilt) / inverse[:, 0]).max(), ((high - tilt) / inverse[:, 0]).min()

    shares = [share for share in np.linspace(1, 0, 20001) if np.subtract(*range_of_thrust(share)) <= 1e-12]
    return shares[0], float(np.clip(thrust, *range_of_thrust(shares[0])))


@pytest.mark.parametrize("name", PRESETS)
def test_roll_and_pitch_come_first_then_thrust(name):
    vehicle, rng = PRESETS[name], np.random.default_rng(3)
    inverse, high = np.ascontiguousarray(np.linalg.inv(vehicle.allocation)), vehicle.rotor_thrust_max
    for _ in range(40):
        thrust, torque = rng.uniform(0, 6) * high, rng.normal(0, 2 * high * vehicle.arm, 3)
        torque[2] *= 0.1
        share, total = best_by_search(vehicle, thrust, torque, 0.05 * high, high)
        wrench = vehicle.allocation @ allocate(thrust, floats(torque), inverse, 0.05 * high, high)
        np.testing.assert_allclose(wrench[1:3], share * torque[:2], atol=2e-4 * np.abs(torque).max())
        assert wrench[0] == pytest.approx(total, abs=2e-3 * high)
        assert -1e-9 <= wrench[3] / torque[2] <= 1 + 1e-9


def test_at_full_thrust_and_beyond_all_of_a_small_torque_is_left():
    vehicle = PRESETS["falcon"]
    inverse, torque = np.ascontiguousarray(np.linalg.inv(vehicle.allocation)), (0.1, -0.05, 0.0)
    for factor in (1.0, 1.2, 3.0):
        wrench = vehicle.allocation @ allocate(factor * 20.0, torque, inverse, 0.0, 5.0)
        np.testing.assert_allclose(wrench[1:], torque, atol=1e-12)


def releases(count: int, seed: int) -> np.ndarray:
    """Return random attitudes (count, 3, 3), upside down to the last hundredth of a degree among them."""
    rng, known = np.random.default_rng(seed), [(np.pi * angle / 180) for angle in (90.0, 135.0, 179.0, 179.9, 179.99)]
    attitudes = [axis_angle(floats(axis), angle) for angle, axis in product(known, np.eye(3)[:2])]
    for _ in range(count - len(attitudes)):
        q = rng.normal(size=4)
        q /= np.linalg.norm(q)
        sine = np.linalg.norm(q[1:])
        attitudes.append(axis_angle(floats(q[1:] / sine), float(2 * np.arctan2(sine, q[0]))))
    return np.reshape(attitudes, (count, 3, 3))


@pytest.mark.parametrize("name", PRESETS)
def test_from_any_attitude_at_rest_a_drone_comes_back(name):
    count, seconds = 1000, 16.0
    system = make_system(1, **{"vehicle.preset": name, "payload.mass": 1e-3})
    world, gains = World(system, count, 1), make_gains(ControlConfig(), system)
    hover = np.tile([0.0, 0.0, 100.0], (count, 1, 1))
    world.state.payload_position[:] = [0, 50, 0]
    world.state.drone_position[:] = hover
    world.state.drone_rotation[:, 0] = releases(count, 0)
    world.state.rotor_speed[:] = np.sqrt(system.drone_mass[0] * 9.81 / 4 / system.vehicle.thrust_coefficient)
    load(world)
    world.break_cables(np.ones((count, 1), bool))
    reference = Reference.zeros(count, 1)
    reference.position[:] = hover
    lowest = np.full(count, 100.0)
    for _ in range(round(seconds * 250)):
        fly(0, count, world.state, reference, np.zeros((count, 1, 3)), world.thrust, gains)
        world.step(world.thrust)
        lowest = np.minimum(lowest, world.state.drone_position[:, 0, 2])
    print(name, "largest fall", 100 - lowest.min(), "of the known", 100 - lowest[:10:2])
    assert np.abs(world.state.drone_position - hover).max() < 0.05
    assert 100 - lowest.min() < FALL[name]


@pytest.mark.parametrize("drones, success", [(4, 0.8), (2, 0.9)])
def test_crazyflies_recover_without_a_policy(drones, success):
    payload = {"payload.shape": "point", "payload.mass": 0.01} if drones == 2 else {"payload.mass": 0.02}
    vec = make("recover", 100, drones, **{"vehicle.preset": "crazyflie", **payload})
    vec.reset(seed=0)
    over, good = np.zeros(100, bool), np.zeros(100, bool)
    while not over.all():
        *_, terminated, truncated, info = vec.step(np.where(over[:, None, None], 0.0, zeros(vec)))
        ended = terminated | truncated
        good |= ended & info["success"]
        over |= ended
        vec.reset(mask=ended)
    assert good.mean() >= success
