"""The scripted team `payload_geometric`: what it asks for, and how well it flies any team."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import OFF_CENTRE, level, make, refusal

import multilift_marl as ml
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import LINEAR, SCRIPTED, base_matrix, make_scripted
from multilift_marl.policies.payload_geometric import PayloadGains, PayloadGeometric


def asked(displace, gains=None, **overrides) -> np.ndarray:
    """Return the offsets (N, 3) [m], world frame, asked of a team at rest at its target after displace(vec)."""
    vec = make(num_envs=1, **overrides)
    observation, _ = vec.reset(seed=0)
    level(vec)
    vec.task.errors.position_integral[:] = vec.task.errors.rotation_integral[:] = 0
    displace(vec)
    action = PayloadGeometric(vec, gains).act(observation)[0, :, :3] * vec.config.control.max_offset
    c, s = np.moveaxis(vec.task.goal.slot_frame[0], -1, 0)
    return np.stack([c * action[:, 0] - s * action[:, 1], s * action[:, 0] + c * action[:, 1], action[:, 2]], axis=-1)


@pytest.mark.parametrize("overrides", [{}, {"cable.model": "chain"}, {"payload.shape": "point"}])
def test_at_rest_at_the_target_it_asks_for_the_formation(overrides):
    np.testing.assert_allclose(asked(lambda vec: None, **overrides), 0, atol=1e-9)


def test_a_force_is_asked_for_by_lean_and_stretch_as_statics_say():
    """Gain 1 on a height error of 10 cm: four vertical cables pull by m/40 more, m/40/(m_d k_p) up."""

    def lower(vec):
        vec.world.state.payload_position[0, 2] -= 0.1

    gains = PayloadGains((0.0, 0.0, 1.0), (0.0,) * 3, (0.0,) * 3, 0.0, 0.0, 0.0, 0.0)
    offset = asked(lower, gains, **{"cable.angle": 0.0, "cable.length": 1.0})
    system = make(num_envs=1).world.system
    more = system.payload_mass * 0.1 / 4
    expected = more / (16 * system.vehicle.mass) + more / 1e5
    np.testing.assert_allclose(offset, np.broadcast_to([0, 0, expected], (4, 3)), atol=1e-6)


def test_it_leans_against_a_displacement_and_lifts_the_low_side():
    def aside(vec):
        vec.task.errors.position_integral[0] = [0.05, 0.0, 0.0]

    def rolled(vec):
        vec.task.errors.rotation_integral[0] = [0.1, 0.0, 0.0]  # its left side, +y, is too high

    offset = asked(aside)
    assert (offset[:, 0] < -0.01).all()
    offset, left = asked(rolled), make(num_envs=1).world.system.anchors[:, 1] > 0
    assert (offset[left, 2] < 0).all() and (offset[~left, 2] > 0).all()


def test_it_needs_the_observations_of_all_its_environments():
    vec = make(num_envs=3)
    observation, _ = vec.reset()
    with pytest.raises(ValueError, match="reads the state of its 3 environments of 4 drones"):
        make_scripted("payload_geometric", vec).act(observation[:2])


def test_its_lead_starts_anew_with_every_episode():
    vec = make(num_envs=2)
    observation, _ = vec.reset(seed=0)
    first, second = (make_scripted("payload_geometric", vec) for _ in range(2))
    expected = first.act(observation)
    vec.world.state.payload_position[:] += 0.05
    first.act(observation)
    vec.world.state.payload_position[:] -= 0.05
    first.reset(np.array([True, False]))
    again = first.act(observation)
    np.testing.assert_array_equal(again[0], expected[0])
    assert (again[1] != expected[1]).any()
    np.testing.assert_array_equal(second.act(observation), expected)


@pytest.mark.slow
def test_it_is_no_base_of_a_residual():
    others = {"payload_geometric", "formation_route", "formation_repelled", "formation_filed"}
    others |= {"formation_adaptive", "formation_balanced"}
    assert set(LINEAR) == {name for name in SCRIPTED if not name.startswith("mpc")} - others
    for name in LINEAR:
        task = {"formation_narrow": "gate", "formation_redistributed": "loss"}.get(name, "track")
        vec = make(task, num_envs=1, **{"control.action": LINEAR[name].INTERFACE, "control.heading": "outward"})
        assert base_matrix(name, vec).shape == (vec.action_size, vec.observation_size)
    message = refusal(ml.load_config, "hover", {"train.residual": "payload_geometric"})
    assert "train.residual" in message and "formation_integral" in message


@pytest.mark.slow
@pytest.mark.parametrize("config", ["hover", "pose"])
def test_it_holds_attitude_and_earns_better_than_the_integral_formation(config):
    flights = {
        name: run_episodes(ml.load_config(config), lambda vec, name=name: make_scripted(name, vec), 48, seed=3)
        for name in ("formation_integral", "payload_geometric")
    }
    theirs, ours = flights["formation_integral"], flights["payload_geometric"]
    both = (theirs["failure_cause"] == 0) & (ours["failure_cause"] == 0)
    assert both.mean() > 0.85
    theirs, ours = ({name: values[both] for name, values in flight.items()} for flight in (theirs, ours))
    angle = "payload_attitude_error_deg"
    assert ours[angle].mean() < 0.7 * theirs[angle].mean()
    assert (ours["return"] > theirs["return"]).mean() > 0.7


@pytest.mark.slow
@pytest.mark.parametrize(
    "num_drones, overrides",
    [
        (1, {"payload.shape": "point"}),
        (2, {"payload.shape": "point"}),
        (3, {}),
        (4, {"cable.model": "chain"}),
        (4, {"payload.anchors": OFF_CENTRE}),
        (6, {}),
    ],
    ids=["point 1", "point 2", "box 3", "chain", "off-centre anchors", "box 6"],
)
def test_it_succeeds_with_any_team(num_drones, overrides):
    config = ml.load_config("hover", {"env.num_drones": num_drones, **overrides})
    flight = run_episodes(config, lambda vec: make_scripted("payload_geometric", vec), 16, seed=1)
    assert not flight["failure_cause"].any()
    assert flight["success_rate"].mean() >= 0.85


@pytest.mark.parametrize("num_drones", [1, 2])
def test_boxes_that_cannot_be_held_level_do_not_upset_it(num_drones):
    config = ml.load_config("hover", {"env.num_drones": num_drones})
    flight = run_episodes(config, lambda vec: make_scripted("payload_geometric", vec), 16, seed=1)
    assert not flight["failure_cause"].any()
    assert flight["payload_position_error_m"].mean() < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("task", ["takeoff", "land"])
def test_it_leaves_slack_cables_to_the_formation(task):
    vec = make(task, num_envs=4)
    script = make_scripted("payload_geometric", vec)
    observation, _ = vec.reset(seed=0)
    script.reset()
    held = 0
    for _ in range(vec.max_steps):
        action = script.act(observation)
        slack = np.linalg.norm(vec.task.goal.cable_force, axis=-1).max(axis=1) < 1e-9
        assert np.isfinite(action).all() and not action[slack].any()
        held += slack.sum()
        observation, _, terminated, truncated, _ = vec.step(action)
        if terminated.any() or truncated.all():
            break
    assert held > 0
