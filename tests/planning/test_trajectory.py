"""The planned way from pose to pose: its motion, its pulls, its courses; drones and cables stay apart on it."""

from __future__ import annotations

from functools import partial
from itertools import combinations
from math import cos, pi

import numpy as np
import pytest
from conftest import floats, make

import multilift_marl as ml
from multilift_marl.math3d import rotation_vector, segment_distance
from multilift_marl.planning.trajectory import ACCEPT_ACCELERATION, CANDIDATES, hold_plan_pose


def test_the_way_moves_as_its_velocities_say_and_ends_at_the_target():
    vec = make("pose", num_envs=4)
    vec.reset(seed=0)
    task, dt = vec.task, vec.task.control_dt
    advance_plan, planned, kept = partial(task.stages["plan"], 0, 4), task.planned, []
    for _ in range(1000):
        advance_plan()
        kept.append([array.copy() for array in (
            planned.position, planned.velocity, planned.acceleration, planned.jerk, planned.slots,
            planned.slot_velocity, planned.slot_acceleration, planned.slot_jerk, planned.rotation,
            planned.angular_velocity,
        )])  # fmt: skip
    position, velocity, acceleration, jerk, slots, slot_v, slot_a, slot_j, rotation, spin = (
        np.array(part) for part in zip(*kept, strict=True)
    )
    for lower, higher in ((position, velocity), (velocity, acceleration), (acceleration, jerk)):
        np.testing.assert_allclose((lower[2:] - lower[:-2]) / (2 * dt), higher[1:-1], atol=0.02)
    beside = slots - position[:, :, None]
    for lower, higher in ((beside, slot_v), (slot_v, slot_a), (slot_a, slot_j)):
        np.testing.assert_allclose(np.diff(lower, axis=0) / dt, higher[1:], atol=1e-6)
    turned = np.einsum("teij,tekj->teik", rotation[2:], rotation[:-2])
    for t in range(0, len(turned), 50):
        for e in range(4):
            rate = np.array(rotation_vector(floats(turned[t, e]))) / (2 * dt)
            np.testing.assert_allclose(rate, spin[t + 1, e], atol=0.01)
    np.testing.assert_allclose(planned.position, task.goal.position, atol=1e-12)
    np.testing.assert_allclose(planned.rotation, task.goal.rotation, atol=1e-12)
    np.testing.assert_allclose(planned.slots, task.goal.slots, atol=1e-9)
    for still in (
        planned.velocity,
        planned.angular_velocity,
        planned.slot_velocity,
        planned.slot_acceleration,
        planned.slot_jerk,
    ):
        assert (np.abs(still) < 1e-12).all()


@pytest.mark.parametrize("num_drones", [3, 4])
def test_pulls_of_the_way_give_the_payload_the_motion_of_the_way(num_drones):
    vec = make("pose", num_envs=4, num_drones=num_drones)
    vec.reset(seed=0)
    task, system = vec.task, vec.world.system
    advance_plan, planned = partial(task.stages["plan"], 0, 4), task.planned
    for _ in range(350):
        before = planned.angular_velocity.copy(), planned.rotation.copy()
        advance_plan()
    inertial = planned.acceleration[:, None] + planned.slot_acceleration
    cable_force = planned.cable_force + (system.hook_force[:, 2] / 9.81)[None, :, None] * inertial
    wanted = system.payload_mass * (planned.acceleration + [0, 0, 9.81])
    np.testing.assert_allclose(cable_force.sum(axis=1), wanted, atol=1e-8)
    arms = np.einsum("eij,nj->eni", planned.rotation, system.anchors)
    moment = np.cross(arms, cable_force).sum(axis=1)
    body = np.reshape(system.inertia_matrix, (3, 3))

    def momentum(rotation, spin):
        return np.einsum("eij,jk,elk,el->ei", rotation, body, rotation, spin)

    change = (momentum(planned.rotation, planned.angular_velocity) - momentum(before[1], before[0])) / task.control_dt
    np.testing.assert_allclose(moment, change, atol=0.01 * np.abs(change).max() + 1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["pose", "pose_falcon3"])
def test_drones_and_cables_stay_apart_and_no_drone_leans_far_on_the_way(name):
    vec = ml.make_vec(name, num_envs=64, num_threads=1)
    vec.reset(seed=0)
    task, system, weight = vec.task, vec.world.system, 9.81 * vec.world.system.vehicles[0].mass
    advance_plan, planned, pairs = (
        partial(task.stages["plan"], 0, 64),
        task.planned,
        list(combinations(range(vec.num_drones), 2)),
    )
    drones, cables, upright = 9.0, 9.0, 1.0
    for step in range(3000):
        advance_plan()
        if step % 10:
            continue
        feet = planned.position[:, None] + np.einsum("eij,nj->eni", planned.rotation, system.anchors)
        for i, j in pairs:
            drones = min(drones, np.linalg.norm(planned.slots[:, i] - planned.slots[:, j], axis=-1).min())
            for e in range(64):
                ends = (floats(line[e, n]) for n in (i, j) for line in (feet, planned.slots))
                cables = min(cables, segment_distance(*ends))
        inertial = planned.acceleration[:, None] + planned.slot_acceleration
        share = (system.hook_force[:, 2] / 9.81)[None, :, None] * inertial
        thrust = planned.cable_force + share + weight / 9.81 * inertial + [0.0, 0.0, weight]
        upright = min(upright, (thrust[..., 2] / np.linalg.norm(thrust, axis=-1)).min())
    assert drones > system.min_separation.max()
    assert cables > 0.12
    assert upright > cos(pi / 4)


@pytest.mark.slow
def test_ways_that_would_swing_a_drone_about_take_another_course():
    vec = ml.make_vec("pose_falcon3", num_envs=512, num_threads=1)
    vec.reset(seed=0)
    task, plan = vec.task, vec.task.own.plan
    usual = plan.course[..., 1:] == CANDIDATES[0][1:]
    turned = np.diff(plan.pose[..., 3], axis=1)
    assert 0.9 < usual.all(axis=-1).mean() < 0.99
    np.testing.assert_allclose(np.exp(1j * plan.course[..., 0]), np.exp(1j * turned), atol=1e-9)
    longer = np.abs(plan.course[..., 0]) > pi
    assert longer.any() and not (longer & usual.all(axis=-1)).any()

    def hardest():
        """Return the largest acceleration of a slot on each way (512, 3) [m/s²]."""
        task.time[:], plan.stage[:] = 0.0, 0
        for e in range(512):
            hold_plan_pose(e, 0, plan, task.planned, task.rig)
        advance_plan, most = partial(task.stages["plan"], 0, 512), np.zeros((512, 3))
        for step in range(3000):
            advance_plan()
            size = np.linalg.norm(task.planned.acceleration[:, None] + task.planned.slot_acceleration, axis=-1).max(
                axis=1
            )
            if step % 1000 > 2:  # a new way's slots take a step or two to be where they should
                most[:, step // 1000] = np.maximum(most[:, step // 1000], size)
        return most

    chosen = hardest()
    plan.course[..., 0] = (turned + pi) % (2 * pi) - pi
    plan.course[..., 1:] = CANDIDATES[0][1:]
    before = hardest()
    kept = usual.all(axis=-1)
    np.testing.assert_allclose(chosen[kept], before[kept], atol=1e-6)
    assert (before[kept] < 1.05 * ACCEPT_ACCELERATION).mean() > 0.98
    assert (chosen[~kept] < before[~kept]).mean() > 0.95
    assert np.sort(chosen, axis=None)[-20:].mean() < 0.85 * np.sort(before, axis=None)[-20:].mean()


@pytest.mark.slow
def test_drones_and_cables_stay_apart_on_every_course():
    vec = ml.make_vec("pose", num_envs=1000, num_threads=1)
    vec.reset(seed=0)
    task, system, plan = vec.task, vec.world.system, vec.task.own.plan
    ways = np.argwhere((plan.course[..., 1:] != CANDIDATES[0][1:]).any(axis=-1))
    assert len(ways) > 60
    advance_plan, planned, limits = partial(task.stages["plan"], 0, 1000), task.planned, task.limits
    for step in range(3000):
        advance_plan()
        if step % 25:
            continue
        feet = planned.position[:, None] + np.einsum("eij,nj->eni", planned.rotation, system.anchors)
        for e in ways[ways[:, 1] == step // 1000, 0]:
            for i, j in combinations(range(4), 2):
                assert np.linalg.norm(planned.slots[e, i] - planned.slots[e, j]) > limits.separation[i, j]
                ends = (floats(line[e, n]) for n in (i, j) for line in (feet, planned.slots))
                assert segment_distance(*ends) > limits.cables[i, j]
