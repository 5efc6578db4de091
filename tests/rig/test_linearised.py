"""The linearised team at rest: against the simulator's own accelerations, by hand, and within what is drawn."""

from __future__ import annotations

import re

import mujoco
import numpy as np
import pytest
from conftest import GRAVITY, floats, make_system, refuse_system

from multilift_marl.math3d import mat_to_quat
from multilift_marl.rig.linearised import fastest_swing, swing_stiffness
from multilift_marl.rig.system import System
from multilift_marl.schema.sections import RandomizationConfig
from multilift_marl.sim.scene import build_model

FIXED = RandomizationConfig()
ROD = {"payload.size": [1.6, 0.04, 0.04], "payload.mass": 0.6, "payload.anchors": [[0.75, 0, 0.025], [-0.75, 0, 0.025]]}
HOOK = {"cable.hook": [0.0, 0.0, -0.05]}
POINT = {"payload.shape": "point", "cable.length": 1.5}


def simulated_rates(system: System) -> np.ndarray:
    """Return the rates of all modes [rad/s], fastest first, from how the simulator accelerates bodies moved from rest.

    Rotors hold every drone by the force and moment that it needs at rest.
    """
    model, layout = build_model(system)
    data = mujoco.MjData(model)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    rest = np.zeros(model.nq)
    rest[: layout.payload_nq] = [0, 0, 5, 1, 0, 0, 0][: layout.payload_nq]
    for i, (slot, rotation) in enumerate(zip(system.slots, system.resting_rotation, strict=True)):
        rest[layout.payload_nq + 7 * i :][:7] = [*(slot + [0, 0, 5]), *mat_to_quat(floats(rotation))]
        held = system.hook_force[i]
        body = layout.drone_bodies[i]
        data.xfrc_applied[body, :3] = held + [0, 0, GRAVITY * system.vehicles[i].mass]
        data.xfrc_applied[body, 3:] = np.cross(rotation @ system.hooks[i], held)

    def accelerations(moved: np.ndarray) -> np.ndarray:
        data.qpos[:] = rest
        mujoco.mj_integratePos(model, data.qpos, moved, 1.0)
        mujoco.mj_forward(model, data)
        return data.qacc.copy()

    assert np.abs(accelerations(np.zeros(model.nv))).max() < 1e-9
    steps = 1e-6 * np.eye(model.nv)
    slope = np.array([(accelerations(step) - accelerations(-step)) / 2e-6 for step in steps])
    return np.sqrt(np.abs(np.sort(np.linalg.eigvals(-slope).real)[::-1]))


def rates(system: System, stiff: bool) -> np.ndarray:
    """Return the rates [rad/s] by `swing_stiffness`, fastest first, with the cables' own stiffness if `stiff`."""
    n, stiffness = system.num_drones, swing_stiffness(system)
    masses = [np.full(3, system.payload_mass), system.payload_inertia]
    turn = np.eye(6 + 6 * n)
    for i, vehicle in enumerate(system.vehicles):
        masses += [np.full(3, vehicle.mass), np.array(vehicle.inertia)]
        turn[9 + 6 * i : 12 + 6 * i, 9 + 6 * i : 12 + 6 * i] = system.resting_rotation[i]
        along = np.zeros(6 + 6 * n)
        direction = system.hook_force[i] / np.linalg.norm(system.hook_force[i])
        hook = system.resting_rotation[i] @ system.hooks[i]
        along[:6] = [*-direction, *-np.cross(system.anchors[i], direction)]
        along[6 + 6 * i : 12 + 6 * i] = [*direction, *np.cross(hook, direction)]
        stiffness = stiffness + stiff * system.cable_stiffness[i] * np.outer(along, along)
    mass = np.concatenate(masses)
    moving = np.arange(len(mass)) if system.payload_shape != "point" else np.r_[:3, 6 : len(mass)]
    scaled = (turn.T @ stiffness @ turn / np.sqrt(np.outer(mass, mass)))[np.ix_(moving, moving)]
    return np.sqrt(np.abs(np.linalg.eigvalsh(scaled)[::-1]))


@pytest.mark.parametrize("num_drones, overrides", [(2, ROD), (4, {}), (1, HOOK), (3, POINT)], ids=str)
def test_every_mode_of_swing_is_that_of_the_simulator(num_drones, overrides):
    """The fastest N modes are the stretching of N cables, which the simulator solves for implicitly."""
    system = make_system(num_drones, **overrides)
    simulated, expected = simulated_rates(system)[num_drones:], rates(system, stiff=True)[num_drones:]
    swings = expected > 0.5
    assert swings.sum() >= 3
    np.testing.assert_allclose(simulated[swings], expected[swings], rtol=2e-3)
    assert fastest_swing(system, FIXED).rate == pytest.approx(rates(system, stiff=False)[0], rel=1e-9)
    assert fastest_swing(system, FIXED).rate >= simulated[0] * (1 - 1e-6)


def test_a_rod_between_two_drones_turns_about_its_length_as_by_hand():
    system = make_system(2, **ROD)
    swing = fastest_swing(system, FIXED)
    about = 0.6 / 12 * 2 * 0.04**2
    assert swing.rate == pytest.approx(np.sqrt(0.6 * GRAVITY * 0.025 / about), rel=0.02)  # 30.3 rad/s
    assert (swing.body, swing.turns) == (0, True)


def test_a_drone_turns_about_a_hook_below_it_as_a_pendulum():
    """On a long cable, ω² = T h (1/J + h/m) of a body of moment J and mass m that hangs h below its centre."""
    drone = {
        "vehicle.inertia": [2e-4, 2e-4, 3e-4],
        "vehicle.rotor_inertia": 0.0,
        "payload.shape": "point",
        "payload.mass": 0.7,
        "cable.length": 50.0,
    }
    system = make_system(1, **drone, **{"cable.hook": [0, 0, -0.2]})
    swing = fastest_swing(system, FIXED)
    assert (swing.body, swing.turns) == (1, True)
    assert swing.rate == pytest.approx(np.sqrt(0.7 * GRAVITY * 0.2 / 2e-4), rel=2e-3)  # 82.9 rad/s
    message = refuse_system(1, **{k.replace(".", "__"): v for k, v in drone.items()}, cable__hook=[0, 0, -0.3])
    assert re.match(
        r"drone 0 turns to and fro about its cable\.hook \[0\.0, 0\.0, -0\.3\] at 111\.5 rad/s, .*; raise", message
    )


def test_the_fastest_swing_covers_all_that_is_drawn():
    ranges = RandomizationConfig(
        payload_mass=0.3,
        payload_inertia=0.4,
        payload_center_of_mass=(0.03, 0.02, 0.015),
        cable_length=0.2,
        vehicle_mass=0.1,
    )
    system = make_system(4, **HOOK)
    bound, rng = fastest_swing(system, ranges).rate, np.random.default_rng(0)
    drawn = []
    for _ in range(200):
        load, moments, length, light = 1 + rng.uniform(-1, 1, 4) * [0.3, 0.4, 0.2, 0.1]
        stiffness = swing_stiffness(system, load, length, rng.uniform(-1, 1, 3) * [0.03, 0.02, 0.015])
        mass = [np.full(3, load * system.payload_mass), load * moments * system.payload_inertia]
        for i, vehicle in enumerate(system.vehicles):
            turn = np.eye(6 + 6 * 4)
            turn[9 + 6 * i : 12 + 6 * i, 9 + 6 * i : 12 + 6 * i] = system.resting_rotation[i]
            stiffness = turn.T @ stiffness @ turn
            mass += [np.full(3, light * vehicle.mass), light * np.array(vehicle.inertia)]
        mass = np.concatenate(mass)
        drawn.append(np.sqrt(np.linalg.eigvalsh(stiffness / np.sqrt(np.outer(mass, mass)))[-1]))
    assert 0.8 * bound < max(drawn) <= bound
    assert max(drawn) > 1.1 * fastest_swing(system, FIXED).rate


def test_a_centre_of_mass_that_is_drawn_shifts_the_load_to_the_cables_near_it():
    hook, drawn = {"cable.hook": [0.0, 0.0, -0.1]}, (0.2, 0.15, 0.0)
    bound = fastest_swing(make_system(4, **hook), RandomizationConfig(payload_center_of_mass=drawn)).rate
    there = fastest_swing(make_system(4, **hook, **{"payload.center_of_mass": drawn}), FIXED).rate
    assert bound == pytest.approx(there, rel=0.1)  # how far a load is shared otherwise is the formation's choice
    assert bound > 1.4 * fastest_swing(make_system(4, **hook), FIXED).rate


# Bounds of one axis by the numbers of that axis


@pytest.mark.parametrize(
    "inertia, rate",
    [([1e-4, 6e-3, 6e-3], 19.33), ([6e-3, 1e-4, 6e-3], 19.33), ([6e-3, 6e-3, 1e-4], 149.7)],
)
def test_nutation_is_by_the_moments_across_the_rotors_and_spin_by_that_about_them(inertia, rate):
    """Two rotors at full speed have 2 · 4e-6 kg m² · 1789 rad/s = 0.01431 N m s; limits are 1/Δt and 200 rad/s."""
    momentum = 2 * 4e-6 * np.sqrt(5.0 / 1.562522e-6)
    across, about = momentum / np.sqrt(inertia[0] * inertia[1]), momentum / inertia[2]
    assert max(across, about) == pytest.approx(rate, rel=0.05)
    scale = 200.0 / max(across, about)
    values = {"vehicle.inertia": inertia, "sim.timestep": 1e-3, "payload.shape": "point"}
    system = make_system(1, **values, **{"vehicle.rotor_inertia": 0.99 * scale * 4e-6})
    assert system.vehicle.inertia == tuple(inertia)
    message = refuse_system(
        1,
        vehicle__inertia=inertia,
        sim__timestep=1e-3,
        payload__shape="point",
        vehicle__rotor_inertia=1.01 * scale * 4e-6,
    )
    assert re.search(r"nutate or spin at 202 rad/s, faster than 200 rad/s; lower vehicle\.rotor_inertia", message)


def test_spin_up_is_by_the_torque_and_the_moment_of_each_axis():
    """Two rotors of 5 N at 0.075 m give 0.75 N m: within 4 ms 50 rad/s of 6.0e-5 kg m²; about yaw 0.22 N m do."""
    roll = 2 * 5.0 * 0.106 / np.sqrt(2) * 0.004 / 50
    yaw = 2 * 5.0 * 3.4375e-8 / 1.562522e-6 * 0.004 / 50
    slow = {"vehicle.rotor_inertia": 0.0, "payload.shape": "point"}
    for moments in ([1.02 * roll, 1.02 * roll, 1.02 * yaw + roll], [2 * roll, 2 * roll, 1.02 * yaw]):
        make_system(1, **{"vehicle.inertia": moments, **slow})
    for moments in ([0.98 * roll, roll, roll], [2 * roll, 2 * roll, 0.98 * yaw]):
        message = refuse_system(1, vehicle__inertia=moments, vehicle__rotor_inertia=0.0, payload__shape="point")
        assert re.search(r"by 51 rad/s faster within sim\.timestep=0\.004 s, more than 50 rad/s; raise", message)


def test_moments_of_the_air_are_compared_with_the_moment_of_inertia_about_their_axis():
    """2 N s · 3 m/s · 4 ms = 0.024 N m s about roll alone."""
    slow = {"vehicle.rotor_inertia": 0.0, "payload.shape": "point", "wind.roll_moment": 2.0}
    make_system(1, **{"vehicle.inertia": [0.024 / 49, 4e-4, 6e-4], **slow})
    make_system(1, **{"vehicle.inertia": [6e-4, 1.3e-4, 6e-4], **slow})
    message = refuse_system(
        1,
        vehicle__inertia=[0.024 / 51, 4e-4, 6e-4],
        vehicle__rotor_inertia=0.0,
        payload__shape="point",
        wind__roll_moment=2.0,
    )
    assert re.search(r"turn a drone by 51 rad/s faster within sim\.timestep=0\.004 s at 3 m/s", message)
