"""Formulas of the geometric controller and of autopilots, each worked out again with NumPy or by differences."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_system
from plain_kernels import plain, record
from test_control_formulas import HOOKS, G, fill, rotation_z, standing, team

from multilift_marl.control import geometric
from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.control.formation import Reference
from multilift_marl.math3d import thrust_frame


def test_desired_rates_are_the_derivative_of_the_desired_attitude():
    force, force_rate, yaw, yaw_rate, h = np.array([1.0, -2.0, 6.0]), np.array([3.0, 4.0, -5.0]), 0.7, 1.3, 1e-6
    frames = [
        np.reshape(plain(thrust_frame)(tuple(force + t * force_rate), yaw + t * yaw_rate), (3, 3)) for t in (-h, 0, h)
    ]
    skew = frames[1].T @ (frames[2] - frames[0]) / (2 * h)
    found = plain(geometric.desired_rates)(tuple(frames[1].ravel()), tuple(force), tuple(force_rate), yaw, yaw_rate)
    np.testing.assert_allclose(found, [skew[2, 1], skew[0, 2], skew[1, 0]], rtol=1e-6)


@pytest.mark.parametrize("tilt_rates", [None, np.array([[[0.3, -0.4, 9.0], [0.6, 0.2, 9.0]]])])
def test_flight_adds_feedback_what_is_fed_forward_and_the_cables_moment(tilt_rates):
    own, allocation = team()
    state, g, reference = own.state, own.gains, fill(Reference.zeros(1, 2), 4)
    rng = np.random.default_rng(9)
    state.drone_position[:] = reference.position + 0.1 * rng.normal(size=(1, 2, 3))
    state.drone_velocity[:] = reference.velocity + 0.1 * rng.normal(size=(1, 2, 3))
    state.drone_body_rates[:] = rng.normal(size=(1, 2, 3))
    for array in (reference.acceleration, reference.jerk, reference.yaw_rate):
        array *= 0.2
    plain(geometric.fly)(0, 1, state, reference, own.cable_force, own.thrust, g, tilt_rates)
    for n in range(2):
        rotation, rates, mass = state.drone_rotation[0, n], state.drone_body_rates[0, n], g.mass[n]
        error = state.drone_position[0, n] - reference.position[0, n]
        slip = state.drone_velocity[0, n] - reference.velocity[0, n]
        whole = mass + g.load_share[n]
        force = whole * reference.acceleration[0, n] - mass * (g.k_p[n] * error + g.k_v[n] * slip)
        force = force + own.cable_force[0, n] + [0, 0, mass * G]
        force += rotation @ (g.drag[n] * (rotation.T @ reference.velocity[0, n]))
        yaw, yaw_rate, h = reference.yaw[0, n], reference.yaw_rate[0, n], 1e-6
        desired = standing(force, yaw)
        change = whole * reference.jerk[0, n]
        skew = desired.T @ (standing(force + h * change, yaw + h * yaw_rate) - desired) / h
        wanted = np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
        if tilt_rates is not None:
            wanted[:2] = tilt_rates[0, n, :2]
        between_them = desired.T @ rotation
        e_r = 0.5 * np.array([(between_them - between_them.T)[i] for i in ((2, 1), (0, 2), (1, 0))])
        seen = between_them.T @ wanted
        inertia = g.inertia[n]
        torque = np.cross(rates, inertia * rates) - inertia * (
            g.k_R[n] * e_r + g.k_w[n] * (rates - seen) + np.cross(rates, seen)
        )
        held = own.cable_force[0, n] + g.load_share[n] * reference.acceleration[0, n]
        torque += np.cross(HOOKS[n], rotation.T @ held)
        rotors = allocation @ [force @ rotation[:, 2], *torque]
        np.testing.assert_allclose(np.clip(rotors, g.thrust_min[n], g.thrust_max[n]), rotors)
        np.testing.assert_allclose(own.thrust[0, n], rotors, rtol=1e-4)


def test_a_desired_force_keeps_a_tenth_of_the_weight_upward():
    d = record(mass=0.6, load_share=0.35, drag=(0.0, 0.0, 0.0))
    level, zero = tuple(np.eye(3).ravel()), (0.0, 0.0, 0.0)
    for feedback, expected in ((0.5, 0.6 * (G - 0.5)), (20.0, 0.06 * G)):
        force = plain(geometric.desired_force)((0.0, 0.0, feedback), zero, zero, zero, level, d)
        assert force == pytest.approx((0.0, 0.0, expected))


def test_rates_are_turned_by_their_gains_and_the_gyroscopic_torque():
    own, allocation = team()
    own.state.drone_body_rates[:], own.setpoint.rates[:] = np.random.default_rng(1).normal(size=(2, 1, 2, 3))
    own.setpoint.thrust[:] = [[9.0, 11.0]]
    plain(geometric.fly_rates)(0, 1, own.state, own.setpoint, own.cable_force, own.thrust, own.gains)
    for n in range(2):
        rates, inertia = own.state.drone_body_rates[0, n], own.gains.inertia[n]
        torque = np.cross(rates, inertia * rates) - inertia * own.gains.k_w[n] * (rates - own.setpoint.rates[0, n])
        torque += np.cross(HOOKS[n], own.state.drone_rotation[0, n].T @ own.cable_force[0, n])
        np.testing.assert_allclose(own.thrust[0, n], allocation @ [own.setpoint.thrust[0, n], *torque], rtol=1e-9)


@pytest.mark.parametrize("yaw", [0.0, 0.8, -2.1])
def test_autopilots_are_told_what_their_drones_carry_as_accelerations(yaw):
    system = make_system(4)
    system_drag = np.array(system.vehicle.drag)
    assert len(set(system_drag)) == 3
    velocity, acceleration, cable = np.array([1.5, -0.8, 0.4]), np.array([0.6, -1.1, 0.7]), np.array([0.5, -0.9, 3.5])
    found = LoadFeedforward(system).acceleration(2, velocity, acceleration, cable, yaw)
    drag = rotation_z(yaw) @ (system_drag * (rotation_z(yaw).T @ velocity))
    share = system.hook_force[2, 2] / G
    np.testing.assert_allclose(found, acceleration + (share * acceleration + cable + drag) / system.vehicle.mass)
