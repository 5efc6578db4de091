"""Task regroup: who leaves and joins, what that does to cables and slots, and what counts as success."""

import numpy as np
import pytest
from conftest import GRAVITY, make, refusal, same, zeros

from multilift_marl.policies.baselines import make_scripted

HEX = {"env.num_drones": 6}
SHORT = {"task_options.events": [1.0, 5.0], "task_options.success_seconds": 0.2}


def regroup(num_envs=8, **overrides):
    return make("regroup_senses", num_envs=num_envs, num_drones=6, **overrides)


def fly(vec, seconds, policy="formation_balanced"):
    """Fly, and yield after every step."""
    observation, _ = vec.reset(seed=3)
    script = make_scripted(policy, vec)
    for _ in range(round(seconds * vec.config.env.policy_hz)):
        observation, *_ = vec.step(script.act(observation))
        yield observation


def test_drones_leave_and_join_in_turn_at_the_drawn_times():
    vec = regroup(num_envs=64)
    vec.reset(seed=0)
    own = vec.task.own
    assert 0.3 < (~own.attached).any(axis=1).mean() < 0.7 and ((~own.attached).sum(axis=1) <= 1).all()
    assert (own.when[:, 0] >= 3.5).all() and (own.when[:, 0] <= 4.0).all() and np.ptp(own.when[:, 1]) > 0.4
    # Who is absent joins; where all carry, one leaves.
    assert (own.joins[:, 0] == (~own.attached).any(axis=1)).all() and (own.joins[:, 1] == ~own.joins[:, 0]).all()
    first = own.joins[:, 0]
    assert (own.who[first, 0] == (~own.attached[first]).argmax(axis=1)).all()
    assert (own.who[~first, 1] == own.who[~first, 0]).all() and len(set(own.who[~first, 0])) == 6


def test_those_without_a_cable_carry_nothing_and_the_others_all_of_it():
    vec = regroup(**{"randomization.payload_center_of_mass": [0, 0, 0]})
    for _ in fly(vec, 3.4):
        pass
    state, own, system = vec.world.state, vec.task.own, vec.world.system
    assert (state.cable_broken == ~own.attached).all() and (state.cable_tension[~own.attached] == 0).all()
    anchors = np.einsum("eij,nj->eni", state.payload_rotation, system.anchors) + state.payload_position[:, None]
    hooks = state.drone_position + np.einsum("enij,nj->eni", state.drone_rotation, system.hooks)
    along = (hooks - anchors) / np.linalg.norm(hooks - anchors, axis=-1, keepdims=True)
    lifted = (state.cable_tension[..., None] * along).sum(axis=1)[:, 2]
    np.testing.assert_allclose(lifted, GRAVITY * vec.world.parameters.payload_mass, rtol=0.03)


def test_a_drone_joins_as_soon_as_its_cable_reaches_it_and_not_before():
    vec = regroup(**SHORT | {"task_options.absent": 1.0})
    own, joined = vec.task.own, np.zeros(8, bool)
    for _ in fly(vec, 4.9):
        state, system = vec.world.state, vec.world.system
        anchors = np.einsum("eij,nj->eni", state.payload_rotation, system.anchors) + state.payload_position[:, None]
        gap = np.linalg.norm(state.drone_position - anchors, axis=-1)
        assert (gap[own.waiting] > vec.world.parameters.cable_length[own.waiting] - 0.01).all()
        new = own.attached.all(axis=1) & ~joined
        # From slack to taut without a snatch.
        assert (state.cable_tension[new, own.who[new, 0]] < 1.0).all()
        joined |= new
        assert (own.waiting.any(axis=1) | own.attached.all(axis=1) | (vec.task.time < own.when[:, 0])).all()
    assert joined.all() and (own.peak_tension < 10).all()


def test_nobody_leaves_while_another_one_waits_to_join():
    overrides = {
        "task_options.absent": 1.0,
        "task_options.events": [1.5, 2.2, 3.0, 4.0],
        "task_options.event_spread": 0.0,
    }
    vec = regroup(**overrides | {"env.episode_seconds": 9.0})
    own, left = vec.task.own, []
    for _ in fly(vec, 8.9):
        left.append((~own.attached).sum(axis=1).max())
    assert max(left) == 1 and (own.event == 4).all()


def test_the_slot_of_a_drone_that_leaves_sinks_within_two_seconds():
    vec = regroup(**SHORT | {"task_options.absent": 0.0, "task_options.event_spread": 0.0})
    goal, own, rates = vec.task.goal, vec.task.own, []
    heights = []
    for _ in fly(vec, 4.0):
        who = own.who[:, 0]
        heights.append(goal.slots[np.arange(8), who, 2] - goal.position[:, 2])
        rates.append(goal.slot_velocity[np.arange(8), who, 2])
    heights, rates, slot = np.array(heights), np.array(rates), vec.world.system.slots[0, 2]
    np.testing.assert_allclose(heights[20], slot, atol=1e-9)  # 0.84 s
    np.testing.assert_allclose(heights[-1], slot - 0.08 * vec.world.system.cable_length[0], atol=1e-9)
    np.testing.assert_allclose(rates[40], -0.04, atol=1e-9)
    np.testing.assert_allclose(np.diff(heights, axis=0)[40], -0.04 / 25, atol=1e-9)
    assert (goal.cable_force[np.arange(8), own.who[:, 0]] == 0).all() and (rates[-1] == 0).all()


def test_who_has_no_cable_takes_the_payload_to_be_where_it_is_planned():
    vec = regroup(**{"task_options.absent": 1.0})
    *_, observation = fly(vec, 2.0)
    names = vec.observation_names
    error = observation[..., names.index("payload_error_0") : names.index("payload_error_0") + 3]
    away = ~vec.task.own.attached
    assert (error[away] == 0).all() and (np.abs(error[~away]).max(axis=-1) > 0).all()
    assert (observation[..., names.index("attached_0")] == vec.task.own.attached).all()


def test_the_payload_is_to_be_held_before_each_event_and_by_all_who_were_to_join():
    vec = regroup(**SHORT | {"task_options.events": [3.0, 7.0], "env.episode_seconds": 10.0})
    for _ in fly(vec, 9.96):
        pass
    task = vec.task
    assert task.succeeded().sum() >= 6
    good = task.succeeded()
    for change in ((task.own.held, (slice(None), 0), False), (task.own.waiting, (slice(None), 2), True)):
        array, at, value = change
        before = array.copy()
        array[at] = value
        assert not task.succeeded().any()
        array[:] = before
    task.own.event[:] = 1
    assert not task.succeeded().any()
    task.own.event[:] = 2
    assert (task.succeeded() == good).all()
    task.own.peak_tension[:] = 21.0
    assert not task.succeeded().any()


def test_a_team_that_does_nothing_does_not_hold_it():
    vec = regroup(**SHORT | {"env.episode_seconds": 8.0})
    vec.reset(seed=3)
    for _ in range(199):
        vec.step(zeros(vec))
    assert not vec.task.succeeded().any() and not vec.task.own.held.all(axis=1).any()


def test_an_episode_does_not_depend_on_the_one_before():
    fresh, used = (regroup(**SHORT | {"task_options.absent": 0.0, "task_options.event_spread": 0.0}) for _ in range(2))
    used.reset(seed=3)
    for _ in range(40):  # slots are moving
        used.step(zeros(used))
    assert used.task.goal.slot_velocity.any()
    for vec in (fresh, used):
        vec.reset(seed=7)
        for _ in range(5):
            vec.step(zeros(vec))
    assert (fresh.world.state.drone_position == used.world.state.drone_position).all()


@pytest.mark.parametrize("hz", [125, 250])
def test_an_absent_drone_waits_at_its_lowered_slot_from_the_start(hz):
    vec = regroup(num_envs=32, **{"task_options.absent": 1.0, "sim.control_hz": hz})
    vec.reset(seed=0)
    away, slots = ~vec.task.own.attached, vec.task.goal.slots.copy()
    before = vec.reference.position.copy()
    vec.step(zeros(vec))
    np.testing.assert_allclose(vec.task.goal.slots, slots, atol=1e-9)
    assert np.abs(vec.reference.position - before)[away].max() < 0.02
    assert away.sum() == 32


def test_who_is_absent_faces_where_its_place_has_it_face():
    vec = regroup(num_envs=8, **{"task_options.absent": 1.0, "control.heading": "outward"})
    vec.reset(seed=0)
    heading = np.arctan2(vec.world.state.drone_rotation[..., 1, 0], vec.world.state.drone_rotation[..., 0, 0])
    expected = vec.task.goal.yaw[:, None] + vec.world.system.slot_azimuth
    away = ~vec.task.own.attached
    np.testing.assert_allclose(np.exp(1j * heading[away]), np.exp(1j * expected[away]), atol=1e-6)


def test_starts_that_are_drawn_again_leave_no_cable_broken():
    vec = regroup(num_envs=64, **{"task_options.start_tilt": 90.0})
    vec.reset(seed=0)
    assert (vec.world.state.cable_broken == ~vec.task.own.attached).all()
    assert (vec.world.state.cable_broken.sum(axis=1) <= 1).all()


@pytest.mark.parametrize("absent", [0.0, 1.0])
def test_a_given_state_does_not_say_who_is_absent(absent):
    """Events follow the draw: a drone that is absent by the state alone would never join."""
    vec = regroup(num_envs=1, **{"task_options.absent": absent})
    vec.reset(seed=0)
    drawn = vec.world.state.cable_broken.copy()
    assert drawn.sum() == absent
    vec.reset(seed=0, options={"state": {"cable_broken": drawn}})
    before = vec.state_dict()
    vec.reset(seed=0)
    assert same(vec.state_dict(), before)
    with pytest.raises(ValueError, match="leave it out: who is absent is drawn, with the probability"):
        vec.reset(seed=0, options={"state": {"cable_broken": np.roll(drawn, 1) | ~drawn.any()}})


def test_who_joins_knows_its_anchor_while_its_slot_rises():
    vec = regroup(num_envs=32, **SHORT | {"task_options.absent": 1.0, "task_options.event_spread": 0.0})
    lengths = []
    for observation in fly(vec, 3.0):
        own, names = vec.task.own, vec.observation_names
        taut = own.attached & (own.slack > 0.01) & (vec.world.state.cable_tension > 0.5)
        told = observation[..., names.index("cable_0") : names.index("cable_0") + 3]
        lengths.append(np.linalg.norm(told[taut], axis=-1))
    # The nominal length, which the cable has, once the estimate has followed.
    assert np.concatenate(lengths).size > 50 and abs(np.median(np.concatenate(lengths)) - 1.0) < 0.005


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"cable.model": "chain"}, "task regroup has no chains; set cable.model=massless"),
        ({"task_options.events": [4.0, 4.3]}, "must rise by more than task_options.event_spread=0.5"),
        ({"task_options.events": [-1.0, 4.0]}, "task_options.events"),
        ({"task_options.events": [0.5, 4.0]}, "must leave task_options.success_seconds=1 before the first"),
        ({"cable.breaking_load": 100.0}, "cables of task regroup do not break"),
    ],
)
def test_what_cannot_be_is_refused(overrides, said):
    assert said in refusal(regroup, **overrides)


@pytest.mark.parametrize("own", [{}, {"payload.anchor_radius": None}])
@pytest.mark.parametrize("drones", [1, 2])
def test_one_drone_or_two_are_too_few(own, drones):
    message = refusal(make, "regroup", num_drones=drones, **own)
    assert "payload.anchors [" not in message and "raise env.num_drones" in message
