"""Task loss: who is lost and when, what that does, and what the others are told."""

from functools import partial

import numpy as np
import pytest
from conftest import GRAVITY, make, refusal, zeros

from multilift_marl.policies.baselines import make_scripted


def fly_past_the_loss(config: str = "loss", seconds: float = 5.0, **keywords):
    """Return environments, flown by formation_integral until all have lost a drone."""
    vec = make(config, **{"num_envs": 4, **keywords})
    observation, _ = vec.reset(seed=0)
    script = make_scripted("formation_integral", vec)
    for _ in range(round(50 * seconds)):
        observation, _, terminated, _, _ = vec.step(script.act(observation))
        assert not terminated.any()
    return vec, observation


def test_the_drawn_drone_is_lost_at_the_drawn_time():
    vec = make("loss", num_envs=64)
    vec.reset(seed=0)
    assert vec.task.own.when.min() >= 2 and vec.task.own.when.max() <= 4 and np.ptp(vec.task.own.when) > 1.5
    assert set(vec.task.own.who) == {0, 1, 2, 3}
    for step in range(1, 211):
        vec.step(zeros(vec))
        gone = vec.task.mask.lost.any(axis=1)
        assert (gone == (vec.task.own.when <= 0.02 * step + 1e-9)).all()
    assert (vec.task.mask.lost == vec.world.hidden_loads.motors_off).all()
    assert (vec.task.mask.lost.argmax(axis=1) == vec.task.own.who).all() and gone.all()


@pytest.mark.parametrize("num_drones", [4, 6])
def test_motors_stop_and_the_drone_hangs_on_its_cable(num_drones):
    vec, _ = fly_past_the_loss(num_drones=num_drones, seconds=9.0)
    state, world = vec.world.state, vec.world
    for e, n in enumerate(vec.task.own.who):
        assert world.state.rotor_speed[e, n].max() < 1e-6
        assert state.drone_position[e, n, 2] < state.payload_position[e, 2]
        assert state.cable_tension[e, n] == pytest.approx(world.system.vehicle.mass * GRAVITY, rel=0.3)
        others = np.delete(np.arange(num_drones), n)
        assert (state.drone_position[e, others, 2] > state.payload_position[e, 2]).all()


def test_with_a_snapped_cable_the_drone_is_gone():
    vec, _ = fly_past_the_loss("loss_snap")
    state = vec.world.state
    for e, n in enumerate(vec.task.own.who):
        assert state.cable_broken[e].tolist() == [i == n for i in range(4)]
        assert state.cable_tension[e, n] == 0 and state.drone_position[e, n, 2] < 0.5
    vec.reset()
    assert not state.cable_broken.any() and not vec.world.hidden_loads.motors_off.any() and not vec.task.mask.lost.any()
    vec.step(zeros(vec))
    assert (state.cable_tension > 0).all()


def test_the_action_of_a_lost_drone_is_ignored():
    vec, _ = fly_past_the_loss(seconds=5.0)
    other, _ = fly_past_the_loss(seconds=5.0)
    for step in range(25):
        action = zeros(vec)
        vec.step(action)
        for e, n in enumerate(other.task.own.who):
            action[e, n] = np.random.default_rng(step).uniform(-1, 1, 4)
        other.step(action)
    assert (vec.world.state.payload_position == other.world.state.payload_position).all()


def test_drones_are_told_who_is_lost():
    vec, observation = fly_past_the_loss()
    names, azimuth = vec.observation_names, vec.task.rig.azimuth
    lost, team = (observation[..., names.index(f"{name}_0")] for name in ("lost", "team_lost"))
    assert (lost == vec.task.mask.lost).all() and (team == 1).all()
    at = names.index("lost_direction_0")
    for e, n in enumerate(vec.task.own.who):
        expected = np.stack([np.cos(azimuth[n] - azimuth), np.sin(azimuth[n] - azimuth)], axis=1)
        np.testing.assert_allclose(observation[e, :, at : at + 2], expected, atol=1e-6)
    observation, _ = vec.reset()
    assert not observation[..., names.index("lost_0") :].any()


def judge_held(degrees=0.0, speed=0.0, body_rate=0.0, tension=1.0, **options):
    """Return success of a payload that is held for 2 s after a loss, at its target, tilted and moving like this."""
    still = {"start_radius": 0.0, "start_speed": 0.0} | options
    vec = make("loss_6", num_envs=1, **{f"task_options.{key}": value for key, value in still.items()})
    vec.reset(seed=0)
    state, task, angle = vec.world.state, vec.task, np.radians(degrees)
    turned = [[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]]
    state.payload_rotation[0], task.goal.rotation[0] = turned, np.eye(3)
    state.payload_velocity[0], state.payload_body_rates[0] = [speed, 0, 0], [0, body_rate, 0]
    state.cable_tension[0] = tension * vec.world.system.resting_tension
    task.stages["measure"](0, 1)
    task.stages["plan"](0, 1)
    score = partial(task.stages["reward"], 0, 1)
    for _ in range(101):
        score()
    task.mask.lost[0, 0] = True
    return bool(task.succeeded()[0])


@pytest.mark.parametrize(
    ("held", "option"),
    [
        ({"degrees": 17.0}, {"success_angle": 50.0}),
        ({"speed": 0.3}, {"success_speed": 0.4}),
        ({"body_rate": 1.0}, {"success_body_rate": 1.5}),
        ({"tension": 90.0}, {"success_tension": 100.0}),
    ],
    ids=["attitude", "speed", "body rate", "tension"],
)
def test_success_asks_for(held, option):
    assert judge_held()
    assert not judge_held(**held)
    assert judge_held(**held, **option)


def test_the_snatch_of_the_lost_drone_itself_does_not_count():
    vec, _ = fly_past_the_loss()
    resting = vec.world.system.resting_tension
    vec.world.state.cable_tension[np.arange(4), vec.task.own.who] = 1e6
    before = vec.task.own.peak_tension.copy()
    vec.task.stages["plan"](0, 4)
    assert (vec.task.own.peak_tension == before).all() and (before > 2).all()
    vec.world.state.cable_tension[:, :] = 500 * resting
    vec.task.stages["plan"](0, 4)
    np.testing.assert_allclose(vec.task.own.peak_tension, 500)
    vec.reset()
    assert not vec.task.own.peak_tension.any()


def test_the_reward_counts_what_a_snatch_adds_to_the_largest_tension():
    vec = make("loss", num_envs=8, **{"reward.snatch": -2.0})
    observation, _ = vec.reset(seed=0)
    script, column = make_scripted("formation_integral", vec), vec.reward_terms.index("snatch")
    paid, peak = np.zeros(8), np.zeros(8)
    for _ in range(250):
        observation, _, terminated, _, _ = vec.step(script.act(observation))
        assert not terminated.any()
        paid += vec.task.terms[:, column]
        peak = np.maximum(peak, vec.task.own.peak_tension)
    limit = vec.task.options.success_tension
    assert peak.max() > 0.75 * limit  # it stays where it is, and the falling drone snatches
    np.testing.assert_allclose(paid, -2.0 * np.maximum(peak - 0.75 * limit, 0.0) / limit, atol=1e-12)


def test_one_drone_cannot_lose_itself():
    assert "raise env.num_drones" in refusal(make, "loss", num_drones=1)
    message = refusal(make, "loss", **{"payload.shape": "point"})
    assert message.startswith("payload.shape=point does not tilt") and "set task_options.broadcast=true" in message
    make("loss", **{"payload.shape": "point", "task_options.broadcast": True})
    for task in ("loss", "recover"):
        message = refusal(make, task, **{"task_options.target_height": (2.0, 1.5)})
        assert "task_options.target_height" in message and "must list the lower one first" in message
    assert "must list the earlier one first" in refusal(make, "loss", **{"task_options.loss_time": (4.0, 2.0)})
    keys = {"env.sensing": "onboard", "task_options.loss_time": (1.0, 3.0)}
    assert "too early for drones that notice a loss by their own cables" in refusal(make, "loss", **keys)


def test_nobody_is_told_of_a_loss_and_all_notice_it():
    vec = make("loss", num_envs=48)
    assert not vec.task.options.broadcast
    observation, _ = vec.reset(seed=0)
    script, own = make_scripted("formation_redistributed", vec), vec.task.own
    at = [i for i, name in enumerate(vec.observation_names) if name.startswith(("team_lost", "planned_offset"))]
    for step in range(1, 230):
        observation, _, terminated, _, _ = vec.step(script.act(observation))
        before = 0.02 * step < own.when
        assert not own.known[before].any() and (observation[before][..., at] == 0).all()  # no false alarm
        if terminated.any():
            vec.reset(mask=terminated)
    aware = own.known.any(axis=1) & vec.task.mask.lost.any(axis=1)
    assert aware.mean() > 0.9
    assert (own.known_who[aware] == own.who[aware, None]).all()  # all of them know who it is
    late = own.known_when[aware] - own.when[aware, None]
    assert 0.1 < late.min() and late.max() < 0.3


def test_drones_that_talk_to_nobody_notice_a_loss_by_their_own_cables():
    vec = make("loss", num_envs=48, **{"env.sensing": "onboard"})
    observation, _ = vec.reset(seed=0)
    script, own = make_scripted("formation_redistributed", vec), vec.task.own
    at = [i for i, name in enumerate(vec.observation_names) if name.startswith(("team_lost", "planned_offset"))]
    rest, change, rated = vec.task.view.resting_tension, np.full((48, 4), np.nan), np.ones(48, bool)
    held = np.zeros((48, 4))
    for step in range(1, 240):
        observation, _, terminated, _, _ = vec.step(script.act(observation))
        since = 0.02 * step - own.when
        rated &= ~terminated
        assert not own.known[since < 0].any() and (observation[since < 0][..., at] == 0).all()  # no false alarm
        tension = vec.world.state.cable_tension / rest
        held = np.where((since < 0)[:, None], tension, held)
        change = np.where((abs(since - 0.06) < 0.011)[:, None], tension - held, change)
        if terminated.any():
            vec.reset(mask=terminated)
    others = rated[:, None] & ~vec.task.mask.lost
    late = (own.known_when - own.when[:, None])[others]
    assert rated.sum() > 30 and own.known[others].all()
    assert 0.02 < late.min() and np.quantile(late, 0.95) < 0.15
    sure = others & ~own.unsure
    assert sure.sum() > 50 and (own.known_who == own.who[:, None])[sure].mean() > 0.97
    # Motors have nearly stopped after 0.06 s: tensions have changed by what `expect_changes` tells.
    expected = vec.task.settings.changes[own.who][..., 0]
    assert np.abs(change - expected)[others & np.isfinite(change)].mean() < 0.06


def test_a_neighbour_and_its_mirror_image_cannot_be_told_apart_by_a_cable():
    changes = make("loss", num_envs=1, **{"env.sensing": "onboard"}).task.settings.changes
    (tension, climb), (opposite, rise) = changes[1, 0], changes[2, 0]
    assert changes[3, 0] == pytest.approx([tension, climb], abs=0.03)
    assert tension > 0.2 and climb < -0.1 and opposite < -0.4 and rise > 0.1


def test_what_two_drones_feel_is_a_spring_board():
    """A rod that loses one of two cables: the change is that of one bar on one cable, solved by hand."""
    vec = make("loss", num_envs=1, num_drones=2)
    system, mass = vec.world.system, vec.controller.gains.mass[0]
    (arm, other), (force, lost) = system.anchors, system.formation_force
    along = force / np.linalg.norm(force)
    inertia = np.reshape(system.inertia_matrix, (3, 3))

    def accelerate(tension):  # of the anchor that is left, along its cable
        total = tension * along - lost
        spin = np.linalg.solve(inertia, np.cross(arm, tension * along) - np.cross(other, lost))
        return along @ (total / system.payload_mass + np.cross(spin, arm))

    slack, one = accelerate(0.0), accelerate(1.0) - accelerate(0.0)
    tension = -slack / (one + 1 / mass)  # the drone accelerates by -tension / mass
    assert vec.task.settings.changes[1, 0, 0] == pytest.approx(tension / np.linalg.norm(force), rel=1e-9)


def test_where_it_is_broadcast_a_loss_is_known_at_once():
    vec = make("loss_6", num_envs=16)
    assert vec.task.options.broadcast
    fly = make_scripted("formation_redistributed", vec)
    observation, _ = vec.reset(seed=0)
    for _ in range(210):
        observation, *_ = vec.step(fly.act(observation))
        assert (vec.task.own.known == vec.task.mask.lost.any(axis=1)[:, None]).all()
    assert (vec.task.own.known_when == vec.task.own.when[:, None]).all()
