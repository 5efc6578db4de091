"""What drones tell each other: who hears whom, when, how far; and the payload that they fit to it."""

from functools import partial

import numpy as np
import pytest
from conftest import make, make_trainer

from multilift_marl.config.load import load_config
from multilift_marl.errors import ConfigError
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.schema.sections import EnvConfig
from multilift_marl.sensing.communication import (
    NEVER,
    Broadcast,
    exchange_messages,
    make_links,
    make_messages,
    update_shared_estimate,
)

OTHERS = ~np.eye(5, dtype=bool)


def talk(steps, envs=1, position=None, **settings):
    """Return ages (steps, E, 5, 5) in teams that tell the number of the step and who they are."""
    links = make_links(EnvConfig(**settings), np.linspace(0, 5, 5))
    messages = make_messages(envs, 5, links.delay)
    messages.generator[:] = np.arange(envs) + 1
    position = np.zeros((envs, 5, 3)) if position is None else position
    ages = []
    for step in range(steps):
        told = np.zeros((envs, 5, 3))
        told[..., 0], told[..., 1] = step, np.arange(5)
        sent = Broadcast(position, told, np.ones((envs, 5), bool))
        exchange_messages(0, envs, sent, links, messages, False)
        ages.append(messages.age.copy())
        fresh = messages.age < NEVER
        # Ages are true, and nothing comes from the future.
        assert (messages.heard[..., 0] == step - messages.age)[fresh].all()
        assert (messages.heard[..., 1] == np.arange(5))[fresh].all()
    return np.array(ages)


def test_neighbours_stand_beside_each_other():
    azimuth = np.array([0.0, 2.0, -2.0, 1.0, -1.0])  # in order: 2, 4, 0, 3, 1
    hears = make_links(EnvConfig(communication="neighbours"), azimuth).partners
    assert [np.flatnonzero(row).tolist() for row in hears] == [[3, 4], [2, 3], [1, 4], [0, 1], [0, 2]]
    assert (make_links(EnvConfig(communication="all"), azimuth).partners == OTHERS).all()
    assert make_links(EnvConfig(communication="neighbours"), np.zeros(2)).partners.sum() == 2


@pytest.mark.parametrize("delay", [0, 1, 4])
def test_messages_come_after_the_delay(delay):
    ages = talk(8, communication="all", communication_delay=delay)[:, 0, OTHERS]
    assert (ages[:delay] == NEVER).all() and (ages[delay:] == delay).all()


def test_as_many_messages_are_lost_as_stated():
    ages = talk(2000, envs=4, communication="all", communication_delay=2, communication_loss=0.3)[10:, :, OTHERS]
    assert (ages == 2).mean() == pytest.approx(0.7, abs=0.01)
    assert (ages == 3).mean() == pytest.approx(0.7 * 0.3, abs=0.01)  # losses are independent
    assert (talk(20, communication="all", communication_loss=1.0) == NEVER).all()


def test_who_is_too_far_away_is_not_heard():
    position = np.zeros((1, 5, 3))
    position[0, :, 0] = [0.0, 1.0, 2.0, 3.0, 10.0]
    ages = talk(4, communication="all", communication_range=2.5, position=position)
    hears = (ages[-1, 0] < NEVER).astype(int)
    assert hears.tolist() == [[0, 1, 1, 0, 0], [1, 0, 1, 1, 0], [1, 1, 0, 1, 0], [0, 1, 1, 0, 0], [0] * 5]


def fit(vec, place, turned, known):
    """Return position and attitude of the payload as drone 0 fits it to the true anchors of the drones it knows."""
    view, sensing = vec.task.view, vec._sensing._load_sensing
    sensing.bind(view.planned, view.rig, view.resting_tension, True)(0, 1)
    anchors = place + view.rig.anchors @ turned.T
    sensing._anchor[0] = sensing._messages.heard[0] = anchors
    sensing._messages.age[0] = np.where(known, 0, NEVER)
    scene = sensing._scene(view.planned, view.rig, view.resting_tension)
    update_shared_estimate(0, 1, scene, sensing._messages, sensing.load, True)
    return sensing.load.position[0, 0], sensing.load.rotation[0, 0]


def turn(vector):
    """Return the matrix exponential of a rotation vector."""
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    term, whole = np.eye(3), np.eye(3)
    for k in range(1, 20):
        term = term @ cross / k
        whole = whole + term
    return whole


def angle(matrix):
    return np.arccos(np.clip((np.trace(matrix, axis1=-2, axis2=-1) - 1) / 2, -1, 1))


@pytest.mark.parametrize("known", [*(pytest.param(each, marks=pytest.mark.slow) for each in (4, 3, 2)), 1])
def test_the_fit_is_the_least_squares_that_it_claims(known):
    """No pose nearby fits better to anchors of 2 cm and an attitude of 0.1 rad about the planned one."""
    vec = make(num_envs=1, **{"env.sensing": "onboard", "env.communication": "all"})
    vec.reset(seed=1)
    planned, arms = vec.task.view.planned.rotation[0], vec.task.view.rig.anchors
    place, turned = np.array([0.1, -0.2, 1.3]), turn((0.2, -0.1, 0.15)) @ planned
    position, rotation = fit(vec, place, turned, np.arange(4) < known)

    def cost(move, spin):
        attitude = turn(spin) @ rotation
        off = (place + arms @ turned.T - position - move - arms @ attitude.T)[:known]
        return (off**2).sum() / 0.02**2 + (angle(attitude @ planned.T) / 0.1) ** 2

    best = cost(np.zeros(3), np.zeros(3))
    for i in range(3):
        for sign in (1, -1):
            step = 1e-3 * sign * np.eye(3)[i]
            assert cost(step, np.zeros(3)) > best and cost(np.zeros(3), step) > best
    if known == 4:
        assert angle(rotation @ turned.T) < 0.5 * angle(planned @ turned.T)


def test_talking_drones_agree_on_the_payload():
    apart, off = {}, {}
    for kind in ("none", "neighbours", "all"):
        vec = make(num_envs=32, **{"env.sensing": "onboard", "env.communication": kind})
        seen, _ = vec.reset(seed=1)
        script = make_scripted("formation_integral", vec)
        for _ in range(200):
            seen, *_ = vec.step(script.act(seen))
        load, state = vec.task.view.payload_estimate, vec.world.state
        apart[kind] = load.position.std(axis=1).mean()
        off[kind] = np.sqrt(((load.position - state.payload_position[:, None]) ** 2).sum(-1).mean())
    assert apart["all"] < 0.3 * apart["none"] and apart["neighbours"] < 0.8 * apart["none"], apart
    assert off["all"] < 0.7 * off["none"], off


@pytest.mark.slow
def test_talking_teams_hold_the_payload_more_level():
    angle = {}
    for kind in ("none", "all"):
        settings = {"env.sensing": "onboard", "env.communication": kind, "env.communication_loss": 0.2}
        episodes = run_episodes(
            load_config("hover", settings), partial(make_scripted, "formation_integral"), 64, seed=5
        )
        angle[kind] = episodes["payload_attitude_error_deg"].mean()
    assert angle["all"] < 0.75 * angle["none"]


def test_drones_have_talked_before_an_episode():
    vec = make(num_envs=2, **{"env.sensing": "onboard", "env.communication": "all", "env.communication_delay": 3})
    vec.reset(seed=0)
    messages = vec._sensing._load_sensing._messages
    off = ~np.eye(4, dtype=bool)
    assert (messages.age[:, off] == 0).all()
    np.testing.assert_array_equal(messages.heard[:, 0, 1], vec._sensing._load_sensing._anchor[:, 1])
    ages = []
    for _ in range(10):
        vec.step(np.zeros((2, 4, 4)))
        ages.append(messages.age[0, 0, 1])
    assert ages == [1, 2, 3, 3, 3, 3, 3, 3, 3, 3]
    vec.reset(mask=np.array([True, False]))
    assert (messages.age[0, off] == 0).all() and (messages.age[1, off] == 3).all()


def test_who_has_nothing_to_say_at_the_start_is_not_heard_then():
    """A drone without a cable: what it would say is where no anchor is."""
    overrides = {"env.sensing": "onboard", "env.communication": "all", "task_options.absent": 1.0}
    vec = make("regroup", 8, **overrides)
    vec.reset(seed=1)
    messages, each = vec._sensing._load_sensing._messages, np.arange(8)
    away = vec.task.own.attached.argmin(axis=1)
    hears = np.ones((8, 4), bool)
    hears[each, away] = False
    heard = messages.age[each, :, away] == 0
    assert not heard[hears].any()
    others = ~np.eye(4, dtype=bool) & vec.task.own.attached[:, None]
    assert (messages.age[others] == 0).all()


@pytest.mark.parametrize(
    "links",
    [{"delay": 25}, {"delay": 10}, {"loss": 0.9}, {"loss": 1.0}, {"delay": 5, "loss": 0.7}, {"range": 0.0}],
    ids=lambda links: "-".join(f"{key}{value:g}" for key, value in links.items()),
)
@pytest.mark.parametrize("kind", [pytest.param("neighbours", marks=pytest.mark.slow), "all"])
def test_late_and_lost_messages_do_no_harm(kind, links):
    """Up to the worst that is allowed: no estimate leaves the payload, and the team holds it."""
    settings = {f"env.communication_{key}": value for key, value in links.items()}
    vec = make(num_envs=16, **{"env.sensing": "onboard", "env.communication": kind, **settings})
    seen, _ = vec.reset(seed=1)
    script = make_scripted("formation_integral", vec)
    for _ in range(300):
        seen, _, terminated, _, _ = vec.step(script.act(seen))
        assert not terminated.any()
    load, state = vec.task.view.payload_estimate, vec.world.state
    assert np.abs(load.velocity - state.payload_velocity[:, None]).max() < 0.5
    assert np.abs(load.position - state.payload_position[:, None]).max() < 0.15


@pytest.mark.parametrize("level", ["ideal", "mocap", "blind"])
def test_communication_needs_something_to_tell(level):
    with pytest.raises(ConfigError, match=f"what they measure with env.sensing=onboard, not {level}; set env"):
        make(num_envs=1, **{"env.sensing": level, "env.communication": "all"})


def test_news_that_nobody_would_use_are_refused():
    with pytest.raises(ConfigError, match=r"delay=26 is 0\.52 s, but nothing older than 0\.5 s is"):
        make(num_envs=1, **{"env.sensing": "onboard", "env.communication": "all", "env.communication_delay": 26})


def test_drones_notice_a_loss_by_what_their_neighbours_tell():
    keys = {"env.sensing": "onboard", "env.communication": "neighbours", "task_options.loss_time": [1.0, 1.0]}
    vec = make("loss", num_envs=4, **keys)
    vec.reset(seed=0)
    for _ in range(90):
        vec.step(0 * vec.task.action)
    others = vec.task.own.known & ~vec.task.mask.lost
    assert others.sum(axis=1).tolist() == [3] * 4
    assert (np.where(others, vec.task.own.known_who, vec.task.own.who[:, None]) == vec.task.own.who[:, None]).all()


@pytest.mark.parametrize("settings", [{"env.communication": "none", "num_drones": 5}, {"env.sensing": "blind"}])
def test_a_loss_that_cannot_be_noticed_has_to_be_announced(settings):
    known = {"env.sensing": "onboard", "env.communication": "neighbours", "task_options.broadcast": False}
    make("loss", num_envs=1, **known)
    with pytest.raises(ConfigError, match=r"does not show the payload's tilt|communicate what they measure"):
        make("loss", **({"num_envs": 1} | known | settings))


@pytest.mark.parametrize("kind", ["set", "attention"])
def test_networks_of_teams_that_do_not_talk_are_refused(tmp_path, kind):
    with pytest.raises(ConfigError, match=rf"train\.actor={kind} lets drones know .* set these, or train\.actor=local"):
        make_trainer(tmp_path, **{"train.actor": kind, "env.sensing": "onboard"})
    make_trainer(tmp_path, **{"train.actor": kind, "env.sensing": "onboard", "env.communication": "all"})
