"""Pose: its targets, the planned way to them, its reward, its success and what it observes."""

from __future__ import annotations

from math import pi

import numpy as np
import pytest
from conftest import GRAVITY, bold_actions, make, refusal, same, zeros

import multilift_marl as ml
from multilift_marl.control.cable_forces import is_stable
from multilift_marl.control.gains import make_gains
from multilift_marl.planning.trajectory import attitude_of, set_goal_from_plan
from multilift_marl.policies.baselines import make_scripted

CALM = {"randomization.payload_mass": 0.0}


def flown(vec, steps, script="formation"):
    """Fly and yield after every step."""
    policy = make_scripted(script, vec)
    observation, _ = vec.reset(seed=0)
    policy.reset()
    for step in range(steps):
        observation, _, terminated, truncated, info = vec.step(policy.act(observation))
        yield step, info
        if (over := terminated | truncated).any():
            observation, _ = vec.reset(mask=over)


def test_targets_are_drawn_from_the_documented_ranges():
    vec = make("pose", num_envs=1000)
    vec.reset(seed=0)
    pose = vec.task.own.plan.pose
    assert pose.shape == (1000, 4, 6)
    assert np.abs(pose[..., :2]).max() <= 1 and pose[..., 2].min() >= 1 and pose[..., 2].max() <= 2
    assert np.ptp(pose[..., :2], axis=(0, 1)).min() > 1.95
    tilt = np.degrees(pose[:, 1:, 4:])
    assert 44 < np.abs(tilt).max() <= 45 and (pose[:, 0, 4:] == 0).all()
    assert 179 < np.degrees(np.abs(pose[..., 3])).max() <= 180
    np.testing.assert_allclose(tilt.std(), 45 / np.sqrt(3), rtol=0.03)
    easy = make("pose_easy", num_envs=200)
    easy.reset(seed=0)
    assert 19 < np.degrees(np.abs(easy.task.own.plan.pose[..., 4:])).max() <= 20


def test_the_attitude_has_the_heading_and_tilt_that_were_drawn():
    turned = np.reshape(attitude_of(0.7, 0.3, -0.4), (3, 3))
    np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
    assert np.arctan2(-turned[0, 1], turned[1, 1]) == pytest.approx(0.7)
    assert turned[2, 1] == pytest.approx(np.sin(0.3)) and -turned[2, 0] == pytest.approx(np.cos(0.3) * np.sin(-0.4))


def test_targets_lie_at_a_share_of_the_way_from_the_last_pose():
    pose = {}
    for share in (0, 0.5, 1):
        vec = make("pose", num_envs=100, **{"task_options.target_share": share})
        vec.reset(seed=0)
        pose[share] = vec.task.own.plan.pose
    default = make("pose", num_envs=100)
    default.reset(seed=0)
    assert same(pose[1], default.task.own.plan.pose)
    np.testing.assert_allclose(pose[0], np.repeat(pose[0][:, :1], 4, axis=1), rtol=0, atol=1e-12)
    drawn_first = (pose[0.5][:, 0] == pose[1][:, 0]).all(axis=1)  # the same start, and then the same draw
    way, half = (poses[drawn_first, 1] - poses[drawn_first, 0] for poses in (pose[1], pose[0.5]))
    assert drawn_first.mean() > 0.8
    way[:, 3], half[:, 3] = ((angle + pi) % (2 * pi) - pi for angle in (way[:, 3], half[:, 3]))
    same_draw = np.abs(half - way / 2).max(axis=1) < 1e-9  # another was drawn where a team cannot hold one of them
    assert same_draw.mean() > 0.7
    vec = make("pose", num_envs=1000, **{"task_options.target_share": [0.2, 0.6]})
    vec.reset(seed=0)
    assert 26.5 < np.degrees(np.abs(vec.task.own.plan.pose[:, 1, 4:])).max() <= 27  # 0.6 of 45, from a level start


def test_without_a_plan_the_same_targets_leap_and_drones_fly_to_their_slots():
    near = {f"task_options.target_{key}": value for key, value in (("xy", 0.2), ("yaw", 20.0), ("tilt", 5.0))}
    planned, leaping = (
        make("pose", num_envs=8, **CALM, **near, **{"task_options.plan": plan}) for plan in (True, False)
    )
    names = set(planned.observation_names) - set(leaping.observation_names)
    assert {name.rsplit("_", 1)[0] for name in names} == {"planned_position", "planned_velocity", "planned_rotation"}
    references = []
    for (step, _), _ in zip(flown(leaping, 150), flown(planned, 150), strict=True):
        for field in ("position", "rotation", "slots"):
            assert same(getattr(leaping.task.goal, field), getattr(planned.task.goal, field))
        references.append(np.linalg.norm(leaping.world.state.drone_position - leaping.task.goal.slots, axis=2))
        if step == 0:  # nothing but the filter of the references is between a drone and its slot
            assert same(leaping.task.planned.position, leaping.task.goal.position)
    assert references[0].mean() > 0.4 and references[-1].mean() < 0.1


@pytest.mark.slow
def test_without_a_plan_a_team_half_a_turn_from_its_target_holds_still():
    """Its cables pull the other way there: fed forward as at the target, they would draw the drones together."""
    level = {"task_options.plan": False, "task_options.target_tilt": 0.0, "control.action": "acc_rates"}
    vec = make("pose", num_envs=32, **CALM, **level)
    vec.reset(seed=0)
    state, goal = vec.world.state, vec.task.goal
    before, action = state.drone_position.copy(), np.zeros((32, 4, vec.action_size))
    for _ in range(25):
        vec.step(action)
    assert (np.abs(vec.task.errors.angle) > 2).any()
    assert np.abs(state.drone_position - before).max() < 2e-3
    heading = np.arctan2(-state.payload_rotation[:, 0, 1], state.payload_rotation[:, 1, 1])
    azimuth = heading[:, None] + vec.task.rig.azimuth
    np.testing.assert_allclose(goal.slot_frame, np.stack((np.cos(azimuth), np.sin(azimuth)), axis=2), atol=1e-3)


def test_a_new_target_comes_every_four_seconds_and_is_not_seen_before():
    vec = make("pose", num_envs=2)
    told = vec.observation_names.index("payload_error_0")
    other = make("pose", num_envs=2)
    seen = []
    for step, _ in flown(vec, 450):
        target = vec.task.goal.position.copy()
        stage = step // 200  # the steps up to and at 4.00 s belong to the first
        np.testing.assert_allclose(target, vec.task.own.plan.pose[:, 1 + stage, :3], atol=1e-12)
        seen.append(vec.task.observation.copy())
    other.reset(seed=0)
    other.task.own.plan.pose[:, 2:, :5] += 0.1
    for step in range(200):
        other.step(zeros(other))
        assert same(other.task.observation, seen[step])
    other.step(zeros(other))
    assert not same(other.task.observation[..., told], seen[200][..., told])


def test_the_payload_settles_at_every_target():
    vec = ml.make_vec("pose_falcon3", num_envs=300, num_threads=1)
    vec.reset(seed=5)
    task, gains = vec.task, make_gains(vec.config.control, vec.world.system)
    np.testing.assert_allclose(task.settings.holdable.stiffness, 0.5 * gains.mass * gains.k_p)
    for stage in (1, 2, 3):
        for e in range(300):
            set_goal_from_plan(e, stage, task.own.plan, task.goal, task.rig)
            assert is_stable(e, task.goal, task.rig, task.settings.holdable.stiffness)
    assert not all(is_stable(e, task.goal, task.rig, np.full(3, 0.5)) for e in range(300))


def test_drones_are_above_a_tilted_payload():
    vec = ml.make_vec("pose_falcon3", num_envs=256, num_threads=1)
    vec.reset(seed=0)
    above = vec.task.goal.slots[..., 2] - vec.task.goal.position[:, None, 2]
    assert 0.15 < above.min() < 0.25  # some of them are as low as they may be


def test_success_needs_the_last_second_of_every_target():
    vec, good = make("pose_easy", num_envs=48, **{"task_options.success_distance": 0.03}), []
    for step, info in flown(vec, 600, "formation"):
        good.append((vec.task.errors.distance <= 0.03) & (vec.task.errors.angle <= np.radians(5)))
        assert step == 599 or not info["success"].any()
    good = np.array(good).reshape(3, 200, 48)
    expected = good[:, 150:].all(axis=(0, 1))
    assert 0 < expected.sum() < 48
    assert same(info["success"], expected)


@pytest.mark.parametrize("seconds", [2.24, 2.25, 10 / 3, 3.015])
def test_targets_may_change_between_two_policy_steps(seconds):
    """Each is marked in the last step that belongs to it, wherever in the step the next one begins."""
    near = {"success_distance": 1.0, "success_angle": 60, "target_xy": 0.05, "target_tilt": 0, "target_yaw": 2}
    options = near | {
        "success_seconds": 0.5,
        "way_seconds": 1.5,
        "target_seconds": seconds,
        "target_height": [1.5, 1.5],
    }
    vec = make("pose", 2, **{f"task_options.{key}": value for key, value in options.items()})
    *_, (_, info) = flown(vec, vec.max_steps)
    assert info["success"].all()


@pytest.mark.slow
def test_the_best_script_solves_nine_of_ten_easy_episodes():
    for script in ("formation_integral", "payload_geometric"):
        vec = make("pose_easy", num_envs=64)
        for _, info in flown(vec, vec.max_steps, script):
            assert not info["failure"].any()
        assert info["success"].mean() >= 0.9


def test_pose_pays_every_positive_weight_in_full_at_rest_at_the_goal():
    vec = make("pose", num_envs=1)
    vec.reset(seed=0)
    state, goal = vec.world.state, vec.task.goal
    state.payload_position[:], state.payload_rotation[:] = goal.position, goal.rotation
    state.payload_velocity[:], state.payload_body_rates[:] = 0, 0
    vec.task.stages["measure"](0, 1)
    vec.task.stages["reward"](0, 1)
    paid = dict(zip(vec.reward_terms, vec.task.terms[0], strict=True))
    assert paid == pytest.approx({name: max(term.weight, 0.0) for name, term in vec.task.REWARD.items()})


def test_formation_pays_the_mean_of_what_drones_off_their_slots_get():
    vec = make("pose", num_envs=16, **{"reward.formation": {"weight": 2.0, "margin": 0.4}})
    vec.reset(seed=0)
    for step in range(50):
        *_, terminated, truncated, info = vec.step(bold_actions(vec, step, hold=20))
        off = np.linalg.norm(vec.world.state.drone_position - vec.task.goal.slots, axis=2)
        expected = (2.0 / (1.0 + (off / 0.4) ** 2)).mean(axis=1)
        np.testing.assert_allclose(info["reward_terms"]["formation"], expected, atol=1e-12)
        if (over := terminated | truncated).any():
            vec.reset(mask=over)


def test_closeness_grows_from_its_margins_on_to_one_where_teams_fail():
    vec = make("pose", num_envs=64, **{"reward.closeness": {"weight": -2.0, "margin": [0.6, 0.9]}})
    limit = vec.task.limits.separation
    vec.reset(seed=0)
    seen = 0.0
    for step in range(150):
        *_, terminated, truncated, info = vec.step(bold_actions(vec, step, hold=20))
        drones, height = vec.world.state.drone_position, vec.world.state.payload_position[:, None, 2]
        expected = (np.maximum(0, 1 - (drones[..., 2] - height) / 0.9) ** 2).sum(axis=1)
        for n in range(vec.num_drones):
            for m in range(n):
                gap = np.linalg.norm(drones[:, n] - drones[:, m], axis=1) - limit[n, m]
                expected += np.maximum(0, 1 - gap / 0.6) ** 2
        np.testing.assert_allclose(info["reward_terms"]["closeness"], -2.0 * expected, atol=1e-12)
        seen = max(seen, expected.max())
        if (over := terminated | truncated).any():
            vec.reset(mask=over)
    assert seen > 0.5


@pytest.mark.parametrize(("rates", "excess"), [((0.0, 0.0, 2.0), 0.0), ((0.0, 4.0, 0.0), 1.0), ((3.0, 0.0, 4.0), 1.5)])
def test_spin_is_the_square_of_the_rate_beyond_its_margin(rates, excess):
    vec = make("pose", num_envs=1, **{"reward.spin": {"weight": -3.0, "margin": 2.0}})
    vec.reset(seed=0)
    vec.world.state.payload_body_rates[:] = rates
    vec.task.stages["reward"](0, 1)
    paid = dict(zip(vec.reward_terms, vec.task.terms[0], strict=True))
    assert paid["spin"] == pytest.approx(-3.0 * excess**2)


@pytest.mark.slow
def test_returns_rank_motors_off_holding_the_start_and_the_scripts():
    def score(script="formation", off=False, **options):
        vec = make("pose", num_envs=48, **{f"task_options.{key}": value for key, value in options.items()})
        if off:
            vec.controller.gains = vec.controller.gains._replace(thrust_min=np.zeros(4), thrust_max=np.zeros(4))
            vec._bind()
        policy, total, over = make_scripted(script, vec), np.zeros(48), np.zeros(48, bool)
        observation, _ = vec.reset(seed=0)
        for _ in range(vec.max_steps):
            observation, reward, terminated, truncated, _ = vec.step(policy.act(observation))
            total += np.where(over, 0, reward.mean(axis=1))
            over |= terminated | truncated
            if over.all():
                break
            if (terminated | truncated).any():
                vec.reset(mask=terminated | truncated)
        return total

    still = {"target_seconds": 1e6, "way_seconds": 9e5}  # a way that hardly begins
    off, hold, moved = score(off=True), score(**still), score(target_seconds=12.0)
    formation, integral, geometric = (score(name) for name in ("formation", "formation_integral", "payload_geometric"))
    assert off.mean() < 0.1 * hold.mean()
    assert hold.mean() < 0.6 * moved.mean()
    assert formation.mean() < integral.mean() < geometric.mean()


def test_integrals_count_the_distance_from_the_way():
    vec, total = make("pose", num_envs=4, **CALM), 0.0
    for _ in flown(vec, 60):
        total = np.clip(total + vec.task.dt * (vec.world.state.payload_position - vec.task.planned.position), -0.5, 0.5)
    np.testing.assert_allclose(vec.task.errors.position_integral, total, atol=1e-12)
    assert vec.task.errors.distance.max() > 0.5 and np.abs(total).max() < 0.1


def test_observations_tell_where_the_way_is_and_how_much_time_is_left():
    vec = make("pose", num_envs=2)
    for _ in flown(vec, 230):
        pass
    goal, planned, names = vec.task.goal, vec.task.planned, vec.observation_names
    c, s = goal.slot_frame[..., 0], goal.slot_frame[..., 1]
    assert np.linalg.norm(planned.velocity, axis=1).min() > 0.1
    for name, (x, y, z) in (("position", (planned.position - goal.position).T), ("velocity", planned.velocity.T)):
        x, y, z = x[:, None], y[:, None], np.broadcast_to(z[:, None], c.shape)
        at, expected = names.index(f"planned_{name}_0"), np.stack([c * x + s * y, c * y - s * x, z], axis=-1)
        np.testing.assert_allclose(vec.task.observation[..., at : at + 3], expected, atol=1e-5)
    assert names[-1] == "time_left_0"
    np.testing.assert_allclose(vec.task.observation[..., -1], 1 - (230 - 200) / 200, atol=1e-6)
    np.testing.assert_allclose(vec.state()[:, -1], vec.task.observation[:, 0, -1])


@pytest.mark.parametrize("num_drones", [1, 2])
def test_teams_that_cannot_hold_a_tilt_get_level_targets(num_drones):
    vec = make("pose", num_envs=16, num_drones=num_drones)
    vec.reset(seed=0)
    assert (vec.task.own.plan.pose[..., 4:] == 0).all()
    assert np.abs(vec.task.own.plan.pose[..., 3]).max() > pi / 2


@pytest.mark.parametrize("hidden", [{}, {"vehicle_mass": 0.3}, {"vehicle_thrust_coefficient": 0.15}])
def test_targets_are_held_with_the_weakest_rotors_and_the_heaviest_drones(hidden):
    keys = {f"randomization.{key}": width for key, width in hidden.items()} | CALM
    vec = make("pose", num_envs=64, num_drones=4, **{"payload.mass": 2.2}, **keys)
    vec.reset(seed=0)
    task, worst = vec.task, 0.0
    mass = (1 + hidden.get("vehicle_mass", 0.0)) * vec.world.system.drone_mass
    for e in range(64):
        for stage in range(1, task.own.plan.pose.shape[1]):
            set_goal_from_plan(e, stage, task.own.plan, task.goal, task.rig)
            lifted = task.goal.cable_force[e] + GRAVITY * mass[:, None] * [0, 0, 1]
            worst = max(worst, np.linalg.norm(lifted, axis=1).max())
    most = 4 * vec.world.system.vehicles[0].rotor_thrust_max
    assert 0.5 * most < worst < 0.9 * (1 - hidden.get("vehicle_thrust_coefficient", 0.0)) * most


def test_a_point_payload_counts_as_turned_as_its_way_is():
    vec = make("pose", num_envs=4, **{"payload.shape": "point"})
    for _ in flown(vec, 200):
        pass
    assert vec.task.errors.angle.max() < 1e-9


def test_impossible_options_are_refused():
    assert "way_seconds=5 must not exceed" in refusal(ml.make_vec, "pose", **{"task_options.way_seconds": 5.0})
    assert "lower one first" in refusal(ml.make_vec, "pose", **{"task_options.target_height": [2.0, 1.0]})
    assert "from 0 to 1" in refusal(ml.make_vec, "pose", **{"task_options.target_share": [0, 1.1]})
    assert "before it begins" in refusal(ml.make_vec, "pose", **{"task_options.target_share": [0.5, 0.2]})
    low = {"task_options.target_height": [0.1, 0.1]}
    assert "can hold hardly any" in refusal(lambda: make("pose", num_envs=1, **low).reset())


def test_errors_count_in_the_last_second_of_every_target_alone():
    """Three targets of 4 s, the last one cut off after 3.5 s; times are ends of steps."""
    options = {"task_options.target_seconds": 4.0, "task_options.success_seconds": 1.0}
    task = ml.make_vec("pose", num_envs=1, **options, **{"env.episode_seconds": 11.5}).task
    counted = [k / 50 for k in range(1, 576) if task.in_error_window(k / 50, 11.5)]
    windows = [(3.0, 4.0), (7.0, 8.0), (10.5, 11.5)]
    assert counted == [k / 50 for k in range(1, 576) if any(a < k / 50 <= b for a, b in windows)]
    assert task.success_windows() == tuple(windows)
