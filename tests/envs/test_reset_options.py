"""Fixed draws and given states: `reset(options=...)`."""

import numpy as np
import pytest
from conftest import ALL, JARGON, make, mask, same, zeros

from multilift_marl.envs import multilift_v0

DRAWN = {"randomization.observation_bias": 1.0, "randomization.action_delay": [0, 2], "randomization.vehicle_drag": 0.1}
TWO = mask(4, 1, 3)


def refused(vec, options, chosen=None) -> str:
    """Return the one sentence with which options are refused."""
    with pytest.raises(ValueError) as caught:
        vec.reset(mask=chosen, options=options)
    message = str(caught.value)
    assert not [word for word in JARGON if word in message], message
    return message


def fix(vec, chosen=None, **values):
    return vec.reset(seed=3, mask=chosen, options={"randomization": values})[1]["randomization"]


@pytest.mark.parametrize(
    ("name", "value", "expected"),
    [
        ("payload_mass", 1.6, [1.6, 1.6]),
        ("payload_mass", [1.2, 1.6], [1.2, 1.6]),
        ("payload_mass", [9.0, 1.2, 9.0, 1.6], [1.2, 1.6]),
        ("cable_length", [1.0, 1.1], [[1.0, 1.1]] * 2),
        ("vehicle_mass", 0.7, [[0.7, 0.7]] * 2),
        ("wind", [1.0, 2.0, 3.0], [[1.0, 2.0, 3.0]] * 2),
        ("payload_force", 0.0, [[0.0, 0.0, 0.0]] * 2),
        ("vehicle_drag", 1.5, [[1.5, 1.5]] * 2),
        ("action_delay", 2, [2, 2]),
        ("observation_bias", 0.0, np.zeros((2, 3, 4, 3))),
    ],
)
def test_a_fixed_draw_is_what_the_episode_has_and_the_rest_is_drawn(name, value, expected):
    vec, free = (make(num_drones=2, **DRAWN) for _ in range(2))
    before = vec.reset(seed=7)[1]["randomization"]
    free.reset(seed=7)
    told, drawn = fix(vec, TWO, **{name: value}), fix(free, TWO)
    assert same(told[name][TWO], np.array(expected, told[name].dtype))
    assert same(told[name][~TWO], before[name][~TWO])
    assert all(same(told[other], drawn[other]) for other in drawn if other != name)
    again = vec.reset(mask=TWO)[1]["randomization"]  # not kept for the next episode
    assert same(again, free.reset(mask=TWO)[1]["randomization"])


def test_the_physics_has_the_fixed_values():
    vec = make(num_drones=2)
    fix(vec, payload_mass=1.0, vehicle_mass=0.7, cable_length=[1.0, 1.2], wind=[1.0, 0, 0])
    batch, model = vec.world.shards[0].batch, vec.world.model
    masses = batch.expanded("body_mass")
    assert (masses[:, model.body("payload").id] == 1.0).all() and (masses[:, model.body("drone_1").id] == 0.7).all()
    assert (batch.expanded("tendon_range")[:, :, 1] == [1.0, 1.2]).all()
    assert (vec.world.hidden_loads.wind == [1.0, 0.0, 0.0]).all()


@pytest.mark.few_tasks
def test_an_episode_with_its_own_draw_fixed_is_the_same_episode(task, cables):
    first, second = make(task, **ALL, **cables), make(task, **ALL, **cables)
    observation, info = first.reset(seed=3)
    drawn = {name: values.copy() for name, values in info["randomization"].items()}
    again = second.reset(seed=3, options={"randomization": drawn})
    assert same((observation, info), again)
    for _ in range(5):
        assert same(first.step(zeros(first)), second.step(zeros(second)))


@pytest.mark.parametrize("model", ["massless", "chain"])
def test_an_episode_starts_from_the_given_state(model):
    settings = {"cable.model": model, "randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}
    first, second = (make(num_drones=3, **settings) for _ in range(2))
    first.reset(seed=1)
    second.reset(seed=2)
    for _ in range(10):
        first.step(zeros(first))
    names = ("payload_position", "payload_rotation", "drone_position", "drone_rotation", "drone_velocity",
             "payload_velocity", "payload_body_rates", "drone_body_rates", "rotor_speed")  # fmt: skip
    given = {name: getattr(first.world.state, name).copy() for name in names}
    goals = second.task.goal.position.copy()
    second.reset(seed=2, options={"state": given})
    for name in names:
        assert same(getattr(second.world.state, name), given[name]), name
    assert same(second.task.goal.position, goals)  # the target is as drawn
    second.step(zeros(second))
    moved = second.world.state.payload_position - given["payload_position"]
    np.testing.assert_allclose(moved, 0.02 * given["payload_velocity"], atol=5e-3)


def test_one_state_serves_all_and_rows_serve_each():
    vec = make(num_drones=2)
    vec.reset(seed=1)
    speed = np.array([0.1, 0.2, 0.3])
    vec.reset(seed=1, mask=TWO, options={"state": {"payload_velocity": speed}})
    assert same(vec.world.state.payload_velocity[TWO], np.tile(speed, (2, 1)))
    rows = np.arange(6.0).reshape(2, 3) / 20
    vec.reset(seed=1, mask=TWO, options={"state": {"payload_velocity": rows}})
    assert same(vec.world.state.payload_velocity[TWO], rows)
    full = np.arange(12.0).reshape(4, 3) / 40
    vec.reset(seed=1, mask=TWO, options={"state": {"payload_velocity": full}})
    assert same(vec.world.state.payload_velocity[TWO], full[TWO])
    assert not same(vec.world.state.payload_velocity[~TWO], full[~TWO])


def test_a_cable_may_be_given_broken_where_that_is_no_failure():
    vec = make(num_drones=2)
    message = refused(vec, {"state": {"cable_broken": [True, False]}})
    assert "cable_broken" in message
    vec.task.mask.lost[:, 0] = True
    vec.reset(options={"state": {"cable_broken": [True, False]}})
    assert vec.world.state.cable_broken.tolist() == [[True, False]] * 4
    vec.step(zeros(vec))
    assert (vec.world.state.cable_tension[:, 0] == 0).all() and (vec.world.state.cable_tension[:, 1] > 0).all()


ODD = np.diag([1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"randomisation": {}}, "did you mean 'randomization'"),
        ({"state": 3}, "must be a dict"),
        ({"randomization": {"payload_mas": 1.0}}, "did you mean 'payload_mass'"),
        ({"randomization": {"payload_mass": -1.0}}, "payload_mass must be positive"),
        ({"randomization": {"payload_mass": np.nan}}, "NaN or infinite"),
        ({"randomization": {"payload_mass": [1.0, 2.0, 3.0]}}, "has shape (3,), expected"),
        ({"randomization": {"payload_mass": "heavy"}}, "must hold numbers"),
        (
            {"randomization": {"payload_mass": 100.0}},
            "payload_mass that reset is to fix, 2 × falcon lift 40.0 N",
        ),
        ({"randomization": {"vehicle_mass": [0.7, 5.0]}}, "with the vehicle_mass that reset is to fix"),
        ({"randomization": {"payload_drag": 2.0}}, "set randomization.payload_drag above 0"),
        ({"randomization": {"action_delay": 3}}, "must be from 0 to 2"),
        ({"randomization": {"action_delay": 0.5}}, "whole numbers"),
        ({"state": {"payload_speed": 1.0}}, "unknown field 'payload_speed'"),
        ({"state": {"payload_position": [0.0, 0.0]}}, "has shape (2,), expected (4, 3)"),
        ({"state": {"payload_position": 1.0}}, "has shape ()"),
        ({"state": {"payload_velocity": [0, 0, np.inf]}}, "NaN or infinite"),
        ({"state": {"payload_rotation": 2 * np.eye(3)}}, "rotation matrices"),
        ({"state": {"drone_rotation": [ODD, ODD]}}, "rotation matrices"),
        ({"state": {"rotor_speed": -np.ones((2, 4))}}, "not be negative"),
        ({"state": {"cable_tension": [1.0, 1.0]}}, "follows from"),
        ({"state": {"payload_velocity": [0, 0, 1e300]}}, "is 1e+300 m/s long, more than 60 m/s"),
        ({"state": {"drone_velocity": [[0, 36, 48.1], [0, 0, 0]]}}, "is 60.1 m/s long, more than 60 m/s"),
        ({"state": {"payload_body_rates": [1e9, 0, 0]}}, "is 1e+09 rad/s long, more than 100 rad/s"),
        ({"state": {"drone_body_rates": [[0, 0, -1e9], [0, 0, 0]]}}, "more than 100 rad/s"),
        ({"state": {"payload_position": [1e300, 0, 0]}}, "is 1e+300 m long, more than 10000 m"),
        ({"state": {"rotor_speed": np.array([[1e3] * 4, [1e9] * 4])}}, "'rotor_speed' of drone_1 is 1e+09 rad/s, more"),
        ({"randomization": {"payload_mass": 1e-9}}, "'payload_mass' is 1e-09, not within 0.01 and 100 times"),
        ({"randomization": {"payload_inertia": 1e-9}}, "'payload_inertia' is 1e-09, not within 0.01 and 100"),
        ({"randomization": {"cable_length": [1.0, 1e9]}}, "'cable_length' is 1e+09, not within 0.01 and 100"),
        ({"randomization": {"cable_stiffness": 1e300}}, "'cable_stiffness' is 1e+300, not within"),
        ({"randomization": {"vehicle_drag": 1e300}}, "'vehicle_drag' is 1e+300, not within 0 and 100"),
        ({"randomization": {"vehicle_mass": [0.7, 0.01]}}, "a drone lifts more than 50 × its weight"),
        ({"randomization": {"wind": [0, 1e300, 0]}}, "'wind' holds 1e+300 m/s, more than 60"),
        ({"randomization": {"payload_force": [0, 0, 1e300]}}, "'payload_force' holds 1e+300 N, more than"),
        ({"randomization": {"observation_bias": 1e300}}, "'observation_bias' holds 1e+300 in its units, more than 100"),
        ({"state": {"payload_position": [0.0, 0.0, 0.5]}}, "stretches cable"),
        ({"state": {"drone_position": [[0, 0, 9.0], [0, 0, 9.1]]}}, "stretches cable 0 of environment 0"),
    ],
)
def test_options_that_cannot_be_are_refused(options, words):
    vec = make(num_drones=2, **{**DRAWN, "task_options.target_height": [1.9, 2.0]})
    vec.reset(seed=5)
    assert words in refused(vec, options)


def test_what_may_be_drawn_may_be_fixed_and_no_more():
    vec = make(num_drones=2, **{"payload.mass": 2.1, "randomization.payload_mass": 0.2})  # lifts 2.2 kg with a reserve
    assert (fix(vec, payload_mass=2.52)["payload_mass"] == 2.52).all()
    assert "less than 1.09 ×" in refused(vec, {"randomization": {"payload_mass": [1.0, 1.0, 1.0, 2.6]}})
    refused(vec, {"randomization": {"payload_mass": [1.0, 2.6]}}, TWO)


def test_a_state_that_has_failed_is_refused_and_the_episode_must_be_reset():
    vec, calm = make(num_drones=2), make(num_drones=2)
    vec.reset(seed=5)
    calm.reset(seed=5)
    message = refused(
        vec, {"state": {"payload_position": [9.0, 0, 1.5], "drone_position": [[9, 0.2, 2.2], [9, -0.2, 2.2]]}}, TWO
    )
    assert "failure from the start (out_of_range)" in message
    assert same(vec.ended, TWO) and same(vec.episodes, calm.episodes)
    assert same(vec.reset(mask=TWO)[0][TWO], calm.reset(mask=TWO)[0][TWO])


def test_pettingzoo_passes_options_on_and_tells_the_draw():
    env = multilift_v0.parallel_env(num_drones=2)
    _, infos = env.reset(
        seed=1, options={"randomization": {"payload_mass": 0.8}, "state": {"payload_velocity": [0, 0, 0.1]}}
    )
    assert infos["drone_1"]["randomization.payload_mass"] == 0.8
    assert env.vec.world.state.payload_velocity[0].tolist() == [0, 0, 0.1]
    with pytest.raises(ValueError, match="payload_mass"):
        env.reset(options={"randomization": {"payload_mess": 1}})
    env.reset(options={"options": 1})  # PettingZoo's API test


@pytest.mark.parametrize(
    "options",
    [
        {"randomization": {"payload_mass": 0.01 * 0.7}},
        {"randomization": {"payload_inertia": 0.01}},
        {"randomization": {"vehicle_drag": 100.0}},
        {"randomization": {"cable_stiffness": [1e3, 1e7]}},
        {"state": {"payload_velocity": [0, 36.0, 48.0]}},
        {"state": {"drone_body_rates": [[0, 0, 100.0], [0, -100.0, 0]]}},
        {"state": {"payload_body_rates": [60.0, 0, 80.0]}},
    ],
)
def test_whatever_is_taken_stays_finite_to_the_learner(options):
    vec = make(num_drones=2, **DRAWN)
    observation, _ = vec.reset(seed=5, options=options)
    for _ in range(20):
        assert np.isfinite(observation).all() and np.isfinite(vec.state()).all()
        observation, reward, terminated, truncated, _ = vec.step(zeros(vec))
        assert np.isfinite(reward).all()
        if (terminated | truncated).any():
            break
