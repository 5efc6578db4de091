"""Formulas of controllers and references, each worked out again with NumPy or by differences in time."""

from __future__ import annotations

import numpy as np
import pytest
from plain_kernels import plain, record, turned

from multilift_marl.control import action_interface, actions, formation, full_state, setpoints
from multilift_marl.control.formation import Goal, Reference, Smoothing
from multilift_marl.control.gains import Gains
from multilift_marl.sim.state import SystemState

G = 9.81
ANCHORS = np.array([[0.3, 0.1, 0.08], [-0.25, 0.15, 0.05]])
SLOTS = np.array([[0.9, 0.4, 1.0], [-0.8, 0.5, 1.1]])
HOOKS = np.array([[0.03, -0.05, -0.07], [-0.04, 0.02, -0.06]])


def rotation_z(yaw: float) -> np.ndarray:
    return turned([0, 0, 1], yaw)


def fill(arrays, seed: int = 0):
    """Fill all arrays of a named tuple with numbers of which no two are alike."""
    rng = np.random.default_rng(seed)
    for array in arrays:
        array[:] = rng.normal(size=array.shape)
    return arrays


def make_rig(hooked: bool = True):
    return record(
        anchors=ANCHORS, slots=SLOTS, azimuth=np.array([0.4, 2.6]), heading=np.array([0.2, -0.5]), hooked=hooked,
        hooks=HOOKS, mass=np.array([0.6, 0.8]), force=np.array([[1.0, 0.5, 3.4], [-0.9, 0.4, 3.2]]), is_point=False,
    )  # fmt: skip


def make_goal(yaw: float = 0.7, tilt: float = 0.3) -> Goal:
    goal = Goal.zeros(1, 2)
    goal.position[0] = [0.5, -0.4, 1.6]
    goal.rotation[0] = rotation_z(yaw) @ turned([1, 0, 0], tilt) @ turned([0, 1, 0], -0.2)
    return goal


def standing(force: np.ndarray, yaw: float) -> np.ndarray:
    """Return the attitude whose z axis is along a force and whose y axis is square to the heading."""
    z = force / np.linalg.norm(force)
    y = np.cross(z, [np.cos(yaw), np.sin(yaw), 0.0])
    y /= np.linalg.norm(y)
    return np.stack([np.cross(y, z), y, z], axis=1)


# The formation


def test_a_formation_has_its_anchors_by_the_attitude_and_its_cables_by_the_heading():
    goal, rig, turn = make_goal(), make_rig(), rotation_z(0.7)
    plain(formation.place_formation)(0, goal, rig)
    assert goal.yaw[0] == pytest.approx(0.7) and goal.drone_yaw[0] == pytest.approx(0.7)
    for n in range(2):
        slot = goal.position[0] + goal.rotation[0] @ ANCHORS[n] + turn @ (SLOTS[n] - ANCHORS[n])
        np.testing.assert_allclose(goal.slots[0, n], slot, atol=1e-12)
        np.testing.assert_allclose(goal.cable_force[0, n], turn @ rig.force[n], atol=1e-12)
        azimuth = 0.7 + rig.azimuth[n]
        np.testing.assert_allclose(goal.slot_frame[0, n], [np.cos(azimuth), np.sin(azimuth)], atol=1e-12)


@pytest.mark.parametrize("yaw", [0.7, -1.9])
def test_hooks_stay_where_they_are_as_a_team_takes_another_heading(yaw):
    goal, rig = make_goal(), make_rig()
    plain(formation.place_formation)(0, goal, rig)
    before = [np.array(plain(formation.goal_hook)(0, n, goal, rig)) for n in range(2)]
    for n in range(2):
        force = goal.cable_force[0, n] + [0, 0, rig.mass[n] * G]
        arm = standing(force, 0.7 + rig.heading[n]) @ HOOKS[n]
        np.testing.assert_allclose(before[n], goal.slots[0, n] + arm, atol=1e-12)
        np.testing.assert_allclose(plain(formation.goal_arm)(0, n, goal, rig, 0.7), arm, atol=1e-12)
    plain(formation.set_heading)(0, yaw, goal, rig)
    assert goal.drone_yaw[0] == yaw
    for n in range(2):
        np.testing.assert_allclose(plain(formation.goal_hook)(0, n, goal, rig), before[n], atol=1e-12)
    assert plain(formation.hook_arm)(0, (0.0, 0.0, 1.0), 0.3, make_rig(hooked=False)) == (0.0, 0.0, 0.0)


def test_references_follow_a_third_order_filter_of_limited_reach():
    w, speed, dt = 4.0, 1.5, 0.004
    for gap in (np.array([0.1, -0.2, 0.3]), np.array([10.0, -20.0, 5.0])):
        reference = fill(Reference.zeros(1, 1))
        reference.command[:] = reference.position + gap
        reference.yaw[:], reference.command_yaw[:], reference.yaw_rate[:] = 3.0, -3.0, 0.4
        p, v, a = (array[0, 0].copy() for array in (reference.position, reference.velocity, reference.acceleration))
        plain(formation.smooth)(0, 1, reference, Smoothing(w, speed, dt))
        reach = 3 * speed / w
        short = gap * min(1.0, reach / np.linalg.norm(gap))
        jerk = w**3 * short - 3 * w**2 * v - 3 * w * a
        after = a + dt * jerk
        faster = v + dt * after
        np.testing.assert_allclose(reference.jerk[0, 0], jerk, rtol=1e-12)
        np.testing.assert_allclose(reference.acceleration[0, 0], after, rtol=1e-12)
        np.testing.assert_allclose(reference.velocity[0, 0], faster, rtol=1e-12)
        np.testing.assert_allclose(reference.position[0, 0], p + dt * faster, rtol=1e-12)
        rate = 0.4 + dt * (w**2 * (2 * np.pi - 6.0) - 2 * w * 0.4)  # the short way, across the back
        assert reference.yaw_rate[0, 0] == pytest.approx(rate) and reference.yaw[0, 0] == pytest.approx(3 + dt * rate)


@pytest.mark.parametrize("gap, counted", [(0.3, 0.3), (2.0, 1.0), (-2.0, -1.0)])
def test_a_heading_is_approached_no_faster_than_from_a_radian(gap, counted):
    reference = Reference.zeros(1, 1)
    reference.command_yaw[:] = gap
    plain(formation.smooth_yaw)(0, 0, reference, 3.0, 0.01)
    assert reference.yaw_rate[0, 0] == pytest.approx(0.01 * 9.0 * counted)


@pytest.mark.parametrize("angle", [-7.0, -np.pi, -3.0, 0.0, 3.0, np.pi, 3.2, 9.0, 100.0])
def test_angles_are_wrapped_to_the_half_open_turn(angle):
    found = plain(formation.wrap)(angle)
    assert -np.pi < found <= np.pi
    assert np.exp(1j * found) == pytest.approx(np.exp(1j * angle))


def moving_goal() -> tuple[Goal, Goal]:
    """Return a goal in motion, and where it is a control step later."""
    now = fill(Goal.zeros(1, 2), 3)
    later = Goal(*(array.copy() for array in now))
    later.slots[:] += 0.01 * np.random.default_rng(2).normal(size=later.slots.shape)
    later.drone_yaw[:] += 0.02
    for name in ("velocity", "acceleration", "jerk", "slot_velocity", "slot_acceleration", "slot_jerk"):
        getattr(later, name)[:] += 0.1
    later.drone_yaw_rate[:] += 0.3
    return now, later


@pytest.mark.parametrize("leaps", [None, "slot", "heading"])
def test_a_reference_rides_with_its_slot_and_stays_where_the_slot_leaps(leaps):
    now, later = moving_goal()
    if leaps == "slot":
        later.slots[0, 0] += [0.2, 0.0, 0.0]
    if leaps == "heading":
        later.drone_yaw[:] += 0.5
    reference, before, smoothing = fill(Reference.zeros(1, 2), 1), Reference.zeros(1, 2), Smoothing(3.0, 2.0, 0.004)
    old = Reference(*(array.copy() for array in reference))
    plain(formation.to_goal_frame)(0, 1, reference, now, before)
    plain(formation.smooth_moving)(0, 1, reference, later, before, smoothing)
    expected = Reference(*(array.copy() for array in old))
    for n in range(2):
        stays = leaps == "heading" or (leaps == "slot" and n == 0)
        rides = now if not stays else later
        own = now.velocity[0] + now.slot_velocity[0, n], now.acceleration[0] + now.slot_acceleration[0, n]
        if stays:
            own = later.velocity[0] + later.slot_velocity[0, n], later.acceleration[0] + later.slot_acceleration[0, n]
        expected.position[0, n] += 0 if stays else later.slots[0, n] - now.slots[0, n]
        expected.velocity[0, n] -= own[0]
        expected.acceleration[0, n] -= own[1]
        expected.yaw[0, n] += 0 if stays else later.drone_yaw[0] - now.drone_yaw[0]
        expected.yaw_rate[0, n] -= rides.drone_yaw_rate[0]
    plain(formation.smooth)(0, 1, expected, smoothing)
    for n in range(2):
        expected.velocity[0, n] += later.velocity[0] + later.slot_velocity[0, n]
        expected.acceleration[0, n] += later.acceleration[0] + later.slot_acceleration[0, n]
        expected.jerk[0, n] += later.jerk[0] + later.slot_jerk[0, n]
        expected.yaw_rate[0, n] += later.drone_yaw_rate[0]
    for name, found, wanted in zip(Reference._fields, reference, expected, strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-10, err_msg=name)


@pytest.mark.parametrize("moved, turned_by, leapt", [
    (0.0799, 0.0, False), (0.0801, 0.0, True), (0.0, 0.199, False), (0.0, 0.201, True), (0.0, 2 * np.pi, False),
])  # fmt: skip
def test_a_slot_leaps_beyond_20_metres_and_50_radians_a_second(moved, turned_by, leapt):
    goal, before = Goal.zeros(1, 1), Reference.zeros(1, 1)
    goal.slots[0, 0] = moved * np.array([0.6, 0.0, -0.8])
    goal.drone_yaw[0] = turned_by
    assert plain(formation._has_leapt)(0, 0, goal, before, 0.004) == leapt


def test_a_reference_starts_with_its_drone():
    state, reference = SystemState.zeros(1, 1), fill(Reference.zeros(1, 1))
    state.drone_position[0, 0], state.drone_velocity[0, 0] = [1, 2, 3], [0.4, 0.5, 0.6]
    state.drone_rotation[0, 0] = standing(np.array([0.3, -0.2, 1.0]), 0.8)
    plain(formation.start_reference)(0, state, reference)
    assert reference.position[0, 0].tolist() == [1, 2, 3] and reference.velocity[0, 0].tolist() == [0.4, 0.5, 0.6]
    assert not reference.acceleration.any() and not reference.jerk.any() and reference.yaw_rate[0, 0] == 0
    assert reference.yaw[0, 0] == pytest.approx(0.8)


# Set-points below the position


def test_velocities_follow_a_second_order_filter():
    state, reference, w, dt = SystemState.zeros(1, 1), fill(Reference.zeros(1, 1)), 5.0, 0.004
    state.drone_position[0, 0], wanted = [1, 2, 3], record(velocity=np.array([[[0.3, -0.5, 0.9]]]))
    v, a, yaw = reference.velocity[0, 0].copy(), reference.acceleration[0, 0].copy(), reference.yaw[0, 0]
    plain(setpoints.smooth_velocity)(0, 1, state, reference, wanted, w, dt)
    jerk = w**2 * ([0.3, -0.5, 0.9] - v) - 2 * w * a
    np.testing.assert_allclose(reference.jerk[0, 0], jerk, rtol=1e-12)
    np.testing.assert_allclose(reference.acceleration[0, 0], a + dt * jerk, rtol=1e-12)
    np.testing.assert_allclose(reference.velocity[0, 0], v + dt * (a + dt * jerk), rtol=1e-12)
    assert reference.position[0, 0].tolist() == [1, 2, 3]
    assert reference.yaw[0, 0] == pytest.approx(yaw + dt * reference.yaw_rate[0, 0])


# Actions


def team(hooked: bool = True, heading: float = 0.9):
    """Return a team of two drones with all that interfaces use."""
    state, goal = SystemState.zeros(1, 2), make_goal()
    plain(formation.place_formation)(0, goal, make_rig())
    for n in range(2):
        state.drone_rotation[0, n] = standing(np.array([0.3, -0.2 - n, 3.0]), heading)
    allocation = np.linalg.inv(
        np.array([[1, 1, 1, 1], [0.1, 0.1, -0.1, -0.1], [-0.1, 0.1, 0.1, -0.1], [0.02, -0.02, 0.02, -0.02]])
    )
    gains = Gains(
        mass=np.array([0.6, 0.8]), inertia=np.array([[2e-3, 3e-3, 4e-3]] * 2), k_p=np.array([9.0, 8.0]),
        k_v=np.array([4.0, 5.0]), k_R=np.array([[90.0, 80.0, 20.0]] * 2), k_w=np.array([[12.0, 11.0, 6.0]] * 2),
        allocation=np.stack([allocation] * 2), thrust_min=np.array([0.1, 0.2]), thrust_max=np.array([6.0, 7.0]),
        load_share=np.array([0.35, 0.3]), drag=np.array([[0.3, 0.2, 0.1], [0.25, 0.15, 0.05]]),
        heading=np.array([0.2, -0.5]), hooks=HOOKS, hooked=hooked,
    )  # fmt: skip
    setpoint = setpoints.Setpoint.zeros(1, 2)
    own = action_interface.ControlContext(
        state, goal, Reference.zeros(1, 2), setpoint, goal.cable_force, np.zeros((1, 2, 4)), gains
    )
    return own, allocation


ACTION = np.array([[[0.3, -0.6, 0.8, 0.25, -0.35], [-0.2, 0.7, -0.5, -0.15, 0.45]]])


def slot_turn(own, n: int) -> np.ndarray:
    """Return the rotation from the slot frame of drone n into the world."""
    c, s = own.goal.slot_frame[0, n]
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def body_turn(own, n: int, heading: float = 0.9) -> np.ndarray:
    """Return the rotation from the slot body frame of drone n into its body."""
    c, s = own.goal.slot_frame[0, n]
    return rotation_z(np.arctan2(s, c) - heading)


def test_offsets_are_in_the_slot_frame_and_headings_from_the_drones_own():
    own, _ = team()
    plain(actions._command_offset)(0, 1, ACTION, own, 0.5, 0.8)
    for n in range(2):
        wanted = own.goal.slots[0, n] + 0.5 * slot_turn(own, n) @ ACTION[0, n, :3]
        np.testing.assert_allclose(own.reference.command[0, n], wanted, rtol=1e-12)
        yaw = own.goal.drone_yaw[0] + own.gains.heading[n] + 0.8 * ACTION[0, n, 3]
        assert own.reference.command_yaw[0, n] == pytest.approx(yaw)


def test_vectors_are_in_the_slot_frame_and_rates_in_the_slot_body_frame():
    own, _ = team()
    vector = np.zeros((1, 2, 3))
    plain(actions._command_vector)(0, 1, ACTION, own.goal, own.reference, vector, 2.0, 0.7)
    own.reference.yaw[:] = 0.9
    plain(actions._command_acc_rates)(0, 1, ACTION, own, 3.0, 2.5)
    for n in range(2):
        np.testing.assert_allclose(vector[0, n], 2.0 * slot_turn(own, n) @ ACTION[0, n, :3], rtol=1e-12)
        assert own.reference.yaw_rate[0, n] == pytest.approx(0.7 * ACTION[0, n, 3])
        found = own.reference.acceleration[0, n]
        np.testing.assert_allclose(found, 3.0 * slot_turn(own, n) @ ACTION[0, n, :3], rtol=1e-12)
        rates = body_turn(own, n) @ [*(2.5 * ACTION[0, n, 3:5]), 0.0]
        np.testing.assert_allclose(own.setpoint.rates[0, n], rates, atol=1e-12)
        assert own.reference.command_yaw[0, n] == pytest.approx(own.goal.drone_yaw[0] + own.gains.heading[n])
        there = plain(action_interface.from_slot_body)((0.3, 0.5, 0.7), 0.9, own.goal.slot_frame[0, n])
        np.testing.assert_allclose(there, body_turn(own, n) @ [0.3, 0.5, 0.7], atol=1e-12)
        back = plain(action_interface.to_slot_body)(there, 0.9, own.goal.slot_frame[0, n])
        np.testing.assert_allclose(back, [0.3, 0.5, 0.7], atol=1e-12)


def test_a_full_state_is_beside_the_slots_and_moves_on_by_its_own_motion():
    """For three control steps without an action: Taylor's formula, in the slot frame, beside goals that move."""
    own, _ = team()
    goal, dt = own.goal, 0.004
    rng = np.random.default_rng(1)
    for name in ("velocity", "acceleration", "jerk"):
        getattr(goal, name)[:] = rng.normal(size=(1, 3))
        getattr(goal, f"slot_{name}")[:] = rng.normal(size=(1, 2, 3))
    goal.drone_yaw_rate[:] = 0.4
    action, scales = rng.uniform(-1, 1, (1, 2, 16)), rng.uniform(0.5, 3, 16)
    plain(full_state.command_full_state)(0, 1, action, own.setpoint.full_state, scales)
    for step in range(3):
        plain(full_state.follow_full_state)(0, 1, own, dt)
        t = step * dt
        for n in range(2):
            asked, turn = scales * action[0, n], slot_turn(own, n)
            p, v, a, j, f = asked[:15].reshape(5, 3)
            motion = (p + t * v + t**2 / 2 * a + t**3 / 6 * j, v + t * a + t**2 / 2 * j, a + t * j, j)
            for k, name in enumerate(("position", "velocity", "acceleration", "jerk")):
                slot = goal.slots[0, n] if k == 0 else getattr(goal, name)[0] + getattr(goal, f"slot_{name}")[0, n]
                np.testing.assert_allclose(getattr(own.reference, name)[0, n], slot + turn @ motion[k], rtol=1e-12)
            nominal = goal.cable_force[0, n]
            found = own.setpoint.cable_force[0, n]
            np.testing.assert_allclose(found, nominal + np.linalg.norm(nominal) * turn @ f, rtol=1e-12)
            assert own.reference.yaw[0, n] == pytest.approx(goal.drone_yaw[0] + own.gains.heading[n] + asked[15])
            assert own.reference.yaw_rate[0, n] == 0.4


def between(action: float, low: float, middle: float, high: float) -> float:
    return float(np.interp(action, [-1, 0, 1], [low, middle, high]))


def hover(own, n: int) -> float:
    return float(np.linalg.norm(own.cable_force[0, n] + [0, 0, own.gains.mass[n] * G]))


def test_thrust_is_between_the_rotors_limits_and_that_of_hovering():
    own, allocation = team()
    g = own.gains
    plain(actions._command_rates)(0, 1, ACTION, own, 2.0, 1.5)
    for n in range(2):
        total = between(ACTION[0, n, 0], 4 * g.thrust_min[n], hover(own, n), 4 * g.thrust_max[n])
        assert own.setpoint.thrust[0, n] == pytest.approx(total)
        rates = body_turn(own, n) @ (np.array([2.0, 2.0, 1.5]) * ACTION[0, n, 1:4])
        np.testing.assert_allclose(own.setpoint.rates[0, n], rates, atol=1e-12)
    plain(actions._command_moments)(0, 1, 0.1 * ACTION, own, 20.0)
    for n in range(2):
        total = between(0.1 * ACTION[0, n, 0], 4 * g.thrust_min[n], hover(own, n), 4 * g.thrust_max[n])
        moment = g.inertia[n] * (20.0 * body_turn(own, n) @ (0.1 * ACTION[0, n, 1:4]))
        moment += np.cross(HOOKS[n], own.state.drone_rotation[0, n].T @ own.cable_force[0, n])
        np.testing.assert_allclose(own.thrust[0, n], allocation @ [total, *moment], rtol=1e-9)


@pytest.mark.parametrize("hooked", [False, True])
def test_rotors_are_between_their_limits_and_their_own_thrust_at_rest(hooked):
    own, allocation = team(hooked)
    plain(actions._command_rotors)(0, 1, ACTION, own)
    for n in range(2):
        rest = np.full(4, hover(own, n) / 4)
        if hooked:
            force = own.cable_force[0, n] + [0, 0, own.gains.mass[n] * G]
            moment = np.cross(HOOKS[n], standing(force, 0.9).T @ own.cable_force[0, n])
            rest = allocation @ [hover(own, n), *moment]
        g = own.gains
        wanted = [between(ACTION[0, n, k], g.thrust_min[n], rest[k], g.thrust_max[n]) for k in range(4)]
        np.testing.assert_allclose(own.thrust[0, n], wanted, rtol=1e-9)


# The geometric controller
