"""What drones know of the payload, by the levels of `env.sensing`; and that they know no more."""

import copy

import numpy as np
import pytest
from conftest import make, same

from multilift_marl.config.load import load_config
from multilift_marl.deploy.ros.checks import check_flyable
from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import fitting_scripts, make_scripted
from multilift_marl.sensing.load_filter import alpha_beta
from multilift_marl.sim.state import SystemState

LEVELS = ("mocap", "rtk", "onboard", "blind")
REST = ("gate", "pose", "recover", "loss", "land", "takeoff")


def observe(vec):
    """Return the observation of the first environment, measured anew with the same random numbers."""
    sensing = vec._sensing
    vec._first_sense(0, 1)
    vec.task.stages["observe"](0, 1)
    return vec.task.observation[0].copy(), sensing


def settled(level, **settings):
    """Return one team in flight, with its generators kept."""
    vec = make(num_envs=1, **{"env.sensing": level, **settings})
    vec.reset(seed=2)
    for _ in range(30):
        vec.step(np.full((1, 4, 4), 0.2))
    return vec


@pytest.mark.parametrize("talk", ["none", "all"])
def test_until_a_cable_has_been_taut_the_payload_is_where_it_is_planned(talk):
    """On the ground, before take-off: a slack cable points nowhere, and nothing is to be integrated."""
    vec = make("takeoff", 4, **{"env.sensing": "onboard", "env.communication": talk})
    vec.reset(seed=1)
    known, taut = vec.task.view.payload_estimate, np.zeros((4, 4), bool)
    for _ in range(400):
        heard = taut.any(axis=1, keepdims=True) if talk == "all" else taut
        unknown = np.broadcast_to(~heard, (4, 4))
        planned = np.broadcast_to(vec.task.planned.position[:, None], (4, 4, 3))
        np.testing.assert_array_equal(known.position[unknown], planned[unknown])
        assert (vec.task.view.estimated_errors.position_integral[unknown] == 0).all()
        vec.step(np.zeros((4, 4, 4)))
        taut |= vec.world.state.cable_tension > 0
    assert taut.all()  # and then it is measured
    away = np.linalg.norm(known.position - vec.world.state.payload_position[:, None], axis=-1)
    assert away.max() < 0.1


def changed(vec, change):
    """Return which drones (N,) observe another thing after `change(state)`, sensors' noise being the same."""
    before = observe(copy.copy(vec))[0]
    twin = copy.copy(vec)
    change(twin.world.state)
    return np.abs(observe(twin)[0] - before).max(axis=1) > 1e-9


def move_payload(state: SystemState):
    state.payload_position[0] += (0.03, -0.02, 0.01)


def test_who_sees_the_payload():
    assert changed(settled("mocap"), move_payload).all()
    assert changed(settled("rtk"), move_payload).all()
    assert changed(settled("onboard"), move_payload).all()  # by the own cable
    assert not changed(settled("blind"), move_payload).any()


def test_who_feels_a_tension():
    def pull(state):
        state.cable_tension[0, 1] *= 1.1

    assert not changed(settled("mocap"), pull).any()
    assert not changed(settled("rtk"), pull).any()
    assert changed(settled("onboard"), pull).tolist() == [False, True, False, False]
    assert not changed(settled("blind"), pull).any()


@pytest.mark.parametrize("level", LEVELS)
def test_nobody_knows_where_the_others_are(level):
    vec = settled(level)

    def move(state):
        state.drone_position[0, 2] += 0.05
        state.drone_velocity[0, 2] += 0.1

    assert not np.delete(changed(vec, move), 2).any()


def test_only_cameras_see_the_payload_turn():
    def turn(state):
        c, s = np.cos(0.1), np.sin(0.1)
        state.payload_rotation[0] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ state.payload_rotation[0]

    part = [i for i, name in enumerate(settled("mocap").observation_names) if "payload_rotation_error" in name]
    for level, knows in (("mocap", True), ("rtk", True), ("onboard", False), ("blind", False)):
        vec = settled(level)
        before, twin = observe(copy.copy(vec))[0], copy.copy(vec)
        turn(twin.world.state)
        assert (np.abs(observe(twin)[0] - before)[:, part].max() > 1e-3) == knows, level


def test_levels_are_as_exact_as_stated():
    for level, low, high in (
        ("mocap", 5e-4, 4e-3),
        ("rtk", 5e-4, 4e-3),
        ("onboard", 5e-3, 0.05),
        ("blind", 0.01, 0.15),
    ):
        vec = make(num_envs=32, **{"env.sensing": level})
        vec.reset(seed=1)
        for _ in range(150):
            vec.step(np.zeros((32, 4, 4)))
        off = vec.task.view.payload_estimate.position - vec.world.state.payload_position[:, None]
        rms = np.sqrt((off**2).sum(-1).mean())
        assert low < rms < high, (level, rms)
        assert off.shape[1] == (1 if level in ("mocap", "rtk") else 4)


def test_a_longer_cable_than_known_deceives_the_drone_that_measures_it():
    vec = make(num_envs=32, **{"env.sensing": "onboard", "randomization.cable_length": 0.2})
    vec.reset(seed=0, options={"randomization": {"cable_length": [[1.0, 1.15, 1.0, 1.0]] * 32}})
    state, view, system = vec.world.state, vec.task.view, vec.world.system
    anchors = state.payload_position[:, None] + np.einsum("eij,nj->eni", state.payload_rotation, system.anchors)
    cable = anchors - state.drone_position
    along = cable / np.linalg.norm(cable, axis=-1, keepdims=True)
    planned = np.einsum("eij,nj->eni", view.goal.rotation, system.anchors)
    expected = state.drone_position + 1.0 * along - planned  # it knows of one metre
    np.testing.assert_allclose(view.payload_estimate.position.mean(axis=0), expected.mean(axis=0), atol=0.02)
    off = view.payload_estimate.position - state.payload_position[:, None]
    assert (off[:, 1, 2] - off[:, [0, 2, 3], 2].mean(axis=1)).mean() > 0.08  # it takes the payload for higher


def test_measured_tension_is_observed_where_it_is_measured():
    vec = make(num_envs=64, **{"env.sensing": "onboard"})
    assert vec.observation_names[-1] == "measured_tension_0"
    seen, _ = vec.reset(seed=0)
    true = vec.world.state.cable_tension / vec.world.system.resting_tension - 1
    gap = seen[..., -1] - true
    assert 0.015 < gap.std() < 0.03  # offsets of 2 %, noise of 1 %
    for level in ("mocap", "blind", "ideal"):
        assert "measured_tension_0" not in make(num_envs=1, **{"env.sensing": level}).observation_names


def test_gains_of_the_alpha_beta_filter_are_those_of_its_riccati_equation():
    dt, push, noise = 0.02, 2.0, 5e-3
    a, g = np.array([[1.0, dt], [0.0, 1.0]]), np.array([[dt**2 / 2], [dt]])
    p = np.eye(2)
    for _ in range(20_000):
        p = a @ p @ a.T + push**2 * g @ g.T
        k = p[:, :1] / (p[0, 0] + noise**2)
        p = p - k @ p[:1]
    alpha, beta = alpha_beta(push, noise, dt)
    assert alpha == pytest.approx(k[0, 0], rel=1e-6) and beta / dt == pytest.approx(k[1, 0], rel=1e-6)


@pytest.mark.parametrize("level", LEVELS)
def test_critic_reward_and_success_know_the_truth(level):
    vec, clear = (make(num_envs=2, **own) for own in ({"env.sensing": level}, {}))
    vec.reset(seed=5), clear.reset(seed=5)
    np.testing.assert_array_equal(vec.state()[:, :6], clear.state()[:, :6])  # error and velocity of the payload
    vec.step(np.zeros((2, 4, 4)))
    true = vec.world.state.payload_position - vec.task.goal.position
    np.testing.assert_allclose(vec.task.errors.position, true, atol=1e-15)


LINKS = {"env.communication": "neighbours", "env.communication_loss": 0.3, "env.communication_delay": 2,
         "env.communication_range": 2.0}  # fmt: skip


@pytest.mark.parametrize(("level", "links"), [*((level, {}) for level in LEVELS), ("onboard", LINKS)])
def test_results_depend_on_neither_threads_nor_company_and_resume(level, links):
    settings = {"env.sensing": level, "randomization.action_delay": [0, 2]} | links
    alone = make(num_envs=1, first_env=3, **settings)
    crowd = make(num_envs=5, num_threads=2, **settings)
    alone.reset(seed=7), crowd.reset(seed=7)
    rng = np.random.default_rng(0)
    for step in range(40):
        action = rng.uniform(-0.3, 0.3, (5, 4, 4))
        one, many = alone.step(action[3:4]), crowd.step(action)
        np.testing.assert_array_equal(one[0][0], many[0][3])
        if step == 20:
            saved = make(num_envs=5, **settings)
            saved.load_state_dict(crowd.state_dict())
        elif step > 20:
            assert same(saved.step(action)[0], many[0])


def test_noise_on_top_of_sensors_is_refused():
    with pytest.raises(ConfigError, match="sensing=mocap has noise of its own"):
        make(num_envs=1, **{"env.sensing": "mocap", "randomization.observation_noise": "standard"})


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("task", ["hover", "track", *(pytest.param(name, marks=pytest.mark.slow) for name in REST)])
def test_every_task_flies_by_sensors(level, task):
    told = {"task_options.broadcast": True} if task == "loss" else {}
    vec = make(task=task, num_envs=4, **{"env.sensing": level, **told})
    seen, _ = vec.reset(seed=0)
    for _ in range(10):
        seen, reward, terminated, _, _ = vec.step(np.zeros((4, 4, 4)))
        vec.reset(mask=terminated)
    assert np.isfinite(seen).all() and np.isfinite(reward).all()


def test_a_slack_cable_points_nowhere():
    vec = settled("onboard")
    before = vec.task.view.payload_estimate.position.copy()
    vec.world.state.cable_tension[0, 1] = 0.0
    vec._sensing._load_sensing.bind(vec.task.view.planned, vec.task.view.rig, vec.task.view.resting_tension, False)(
        0, 1
    )
    load = vec.task.view.payload_estimate
    np.testing.assert_allclose(load.position[0, 1], before[0, 1] + 0.02 * load.velocity[0, 1], atol=1e-12)
    assert np.abs(load.position[0, 0] - before[0, 0] - 0.02 * load.velocity[0, 0]).max() > 1e-6


@pytest.mark.parametrize("level", ["onboard", "blind"])
def test_a_goal_that_leaps_is_no_motion_of_the_payload(level):
    vec = settled(level)
    speed = np.abs(vec.task.view.payload_estimate.velocity).max()
    turned = np.array([[0.94, 0.0, 0.342], [0.0, 1.0, 0.0], [-0.342, 0.0, 0.94]])
    vec.task.place_goal(0, vec.task.goal.position[0], turned)
    vec.step(np.full((1, 4, 4), 0.2))
    assert np.abs(vec.task.view.payload_estimate.velocity).max() < speed + 0.3


def test_who_can_neither_see_a_tilt_nor_feel_a_leap_must_be_told_of_a_loss():
    make("loss", num_envs=1, **{"env.sensing": "onboard"})
    for level, drones in (("blind", 4), ("onboard", 6)):
        with pytest.raises(ConfigError, match="set task_options"):
            make("loss", num_envs=1, num_drones=drones, **{"env.sensing": level})


def test_the_true_state_is_no_ones_to_read():
    vec = make(num_envs=1, **{"env.sensing": "mocap"})
    with pytest.raises(ConfigError, match="payload_geometric reads the true state"):
        make_scripted("payload_geometric", vec)
    assert "payload_geometric" not in fitting_scripts(vec)


def test_teams_that_are_measured_have_no_simulated_sensors():
    team = MeasuredTeam(load_config("hover", {"env.sensing": "mocap"}))
    assert team.config.env.sensing == "ideal" and team.controller.state is team.world.state
    with pytest.raises(ConfigError, match="nobody measures the cables' tension"):
        check_flyable(load_config("hover", {"env.sensing": "onboard"}))


def test_with_rtk_drones_know_themselves_as_by_onboard_sensors():
    known = {}
    for level in ("rtk", "onboard"):
        vec = make(num_envs=8, **{"env.sensing": level})
        vec.reset(seed=3)
        vec.step(np.zeros((8, 4, 4)))
        known[level] = vec.controller.state.drone_position.copy()
    assert same(known["rtk"], known["onboard"])


def test_what_another_reports_is_what_drones_know():
    vec = make(num_envs=1, **{"env.sensing": "rtk"})

    def report(state):
        for name in ("drone_position", "drone_velocity", "drone_rotation", "drone_body_rates"):
            getattr(state, name)[:] = getattr(vec.world.state, name)
        state.drone_position[:] += (0.01, -0.02, 0.03)

    vec.use_controller(vec.controller, report)
    vec.reset(seed=2)
    for _ in range(30):
        vec.step(np.zeros((1, 4, 4)))
    off = vec.controller.state.drone_position - vec.world.state.drone_position
    np.testing.assert_allclose(off, np.broadcast_to((0.01, -0.02, 0.03), off.shape), atol=1e-12)
    before = observe(vec)[0]
    report(vec.controller.state)
    vec.controller.state.drone_position[:] += 0.05
    assert np.abs(observe(vec)[0] - before).max(axis=1).min() > 0.04  # which is also what they observe


def test_conditions_go_below_any_task():
    assert load_config("hover_px4").env.sensing == "rtk"
    config = load_config("hover_realistic")
    assert config.task == "hover" and config.env.sensing == "mocap" and config.randomization.cable_length == 0.2
    assert config.randomization.payload_force == 1.5 and config.wind.turbulence  # the task's own stays
