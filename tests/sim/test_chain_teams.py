"""Teams on chains: flight, exact replay, divergence, refusals."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from conftest import hover_thrust, make, make_system, mask, refusal, same, zeros
from test_chain import CHAIN, calm, make_world

from multilift_marl.sim.scene import build_model

# In the environment


@pytest.mark.parametrize("num_drones", [1, 3, 4])
def test_the_formation_flies_on_chains(num_drones):
    vec = make(num_envs=3, num_drones=num_drones, **CHAIN)
    vec.reset(seed=0)
    for _ in range(100):
        _, reward, terminated, _, _ = vec.step(zeros(vec))
        assert not terminated.any()
    assert np.isfinite(reward).all() and calm(vec.world)
    assert vec.task.errors.distance.max() < 0.6


def test_unequal_cables_hang_and_fly():
    unequal = {
        "cable.length": (1.0, 1.2, 0.9), "cable.segments": (4, 10, 7), "cable.density": (0.05, 0.01, 0.02),
        "cable.stiffness": (1e5, 2e5, 5e4), "cable.damping": (1e3, 2e3, 5e2),
    }  # fmt: skip
    world = make_world(3, **{key.replace(".", "__"): value for key, value in unequal.items()})
    before = world.state.drone_position.copy()
    world.step(hover_thrust(world), 100)
    np.testing.assert_allclose(world.state.drone_position, before, atol=1e-8)
    np.testing.assert_allclose(world.state.cable_tension[0], world.system.resting_tension, rtol=1e-6)
    vec = make(num_envs=2, num_drones=3, **CHAIN, **unequal)
    vec.reset(seed=0)
    for _ in range(50):
        assert not vec.step(zeros(vec))[2].any()
    assert calm(vec.world)


def fly(vec, steps: int, first: int = 0):
    """Fly every environment by actions of its own and return all there is to know afterwards."""
    for step in range(first, first + steps):
        shape = (vec.num_drones, vec.action_size)
        envs = range(vec.first_env, vec.first_env + vec.num_envs)
        vec.step(np.stack([np.random.default_rng((e, step)).uniform(-1, 1, shape) for e in envs]))
    return vec.state_dict()


def test_neither_threads_nor_neighbours_change_a_bit():
    settings = {**CHAIN, "randomization.payload_mass": 0.3}
    one, two = make(num_envs=3, **settings), make(num_envs=3, num_threads=2, **settings)
    alone = make(num_envs=1, first_env=1, **settings)
    for vec in (one, two, alone):
        vec.reset(seed=0)
    saved, threaded, single = fly(one, 20), fly(two, 20), fly(alone, 20)
    assert same(saved, threaded)
    assert same({key: array[1:2] for key, array in saved.items()}, single)


@pytest.mark.parametrize("num_threads", [1, 2])
def test_a_saved_team_continues_bit_for_bit(num_threads):
    vec, other = make(num_envs=3, **CHAIN), make(num_envs=3, num_threads=num_threads, **CHAIN)
    vec.reset(seed=0)
    saved = fly(vec, 10)
    expected = fly(vec, 10, first=10)
    other.reset(seed=5)
    fly(other, 5)
    other.load_state_dict(saved)
    assert same(fly(other, 10, first=10), expected)


def test_a_mass_changed_in_flight_counts_from_the_next_step():
    world, other = make_world(3, 2), make_world(3, 2)
    thrust = hover_thrust(world)
    world.step(thrust, 10)
    world.set_parameters(mask(2, 1), payload_mass=np.full(2, 1.3))
    other.load_state_dict(world.state_dict())
    for each in (world, other):
        each.step(thrust, 10)
    assert same(world.state_dict(), other.state_dict())
    assert not same(world.state.payload_position[0], world.state.payload_position[1])


def test_a_masked_reset_is_a_fresh_start_and_leaves_the_others_alone():
    vec, fresh, longer = make(num_envs=3, **CHAIN), make(num_envs=3, **CHAIN), make(num_envs=3, **CHAIN)
    for each in (vec, fresh, longer):
        each.reset(seed=0)
    fly(vec, 5)
    vec.reset(seed=0, mask=mask(3, 1))
    fly(longer, 5)
    again, first, onward = fly(vec, 5), fly(fresh, 5), fly(longer, 5)
    worlds = [
        [{key: saved[key][i] for key in saved if key.startswith("world.")} for i in range(3)]
        for saved in (again, onward)
    ]
    assert same(worlds[0][0], worlds[1][0]) and same(worlds[0][2], worlds[1][2])
    assert not same(worlds[0][1], worlds[1][1])
    start = make(num_envs=3, **CHAIN)
    start.reset(seed=0)
    start.reset(seed=0, mask=mask(3, 1))
    assert same(fly(start, 5), first)


@pytest.mark.parametrize("force", [1e5, np.nan])
def test_a_diverged_team_spares_the_others_and_is_healed_by_a_reset(force):
    world, calm_one = make_world(3, 3), make_world(3, 3)
    thrust = hover_thrust(world) * np.linspace(0.98, 1.02, 3)[:, None, None]
    world.hidden_loads.payload_force[1] = force
    for each in (world, calm_one):
        each.step(thrust, 20)
    assert world.diverged.tolist() == [False, True, False]
    assert all(np.isfinite(array).all() for array in world.state)
    others = [0, 2]
    assert all(same(a[others], b[others]) for a, b in zip(world.state, calm_one.state, strict=True))
    world.reset(mask(3, 1))
    calm_one.reset(mask(3, 1))
    for each in (world, calm_one):
        each.step(thrust, 20)
    assert same(world.state_dict(), calm_one.state_dict())


def test_teams_start_with_their_cables_at_the_tension_of_rest():
    vec = make(num_envs=16, **CHAIN, **{"randomization.payload_mass": 0.3})
    vec.reset(seed=0)
    load = vec.world.hidden_loads.payload_mass / vec.world.system.payload_mass
    expected = vec.world.system.resting_tension * load[:, None]
    np.testing.assert_allclose(vec.world.state.cable_tension, expected, rtol=0.01)
    assert (vec.world.state.cable_tension == vec.world.state.cable_tension.clip(1)).all()


@pytest.mark.parametrize("shape", ["box", "point"])
def test_what_is_drawn_has_the_same_physics(shape):
    system, states = make_system(3, **CHAIN, **{"payload.shape": shape}), []
    for visuals in (False, True):
        model, _ = build_model(system, visuals)
        data = mujoco.MjData(model)
        data.qvel[:] = np.random.default_rng(0).uniform(-1, 1, model.nv)
        for _ in range(100):
            mujoco.mj_step(model, data)
        states.append(data.qpos.copy())
    assert same(*states)


@pytest.mark.parametrize(
    "key, value, complaint",
    [
        ("cable.model", "rope", "massless"),
        ("cable.segments", 1, "must be greater than or equal to 2"),
        ("cable.density", 0.0, "must be greater than 0"),
        ("cable.bending_stiffness", -1.0, "must be greater than or equal to 0"),
        ("cable.bending_damping", -1.0, "must be greater than or equal to 0"),
        ("cable.density", 1.5, "lift"),
        ("cable.bending_stiffness", 1e4, "must be from 0 to 1000 N m/rad"),
        ("cable.bending_damping", 0.1, "too stiff for links so light"),
    ],
)
def test_impossible_chains_are_refused(key, value, complaint):
    message = refusal(make_system, 4, **{**CHAIN, key: value})
    assert message.startswith(key) or key == "cable.density"
    assert complaint in message


@pytest.mark.parametrize(
    "rig",
    [
        {"vehicle.preset": "iris", "cable.angle": 45.0},
        {"env.num_drones": 8, "payload.shape": "cylinder", "payload.size": [0.5, 0.5, 0.2], "payload.mass": 0.5},
        {"cable.hook": [0.02, 0.0, -0.05], "cable.length": [0.8, 1.0, 1.0, 1.2]},
    ],
)
def test_heavy_chains_start_in_their_slots_and_stay_there(rig):
    """Their sag is centimetres: the force in a chain's middle is not along the line between its ends."""
    still = {f"task_options.start_{name}": 0.0 for name in ("radius", "tilt", "speed")}
    known = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}
    drones = rig.get("env.num_drones", 4)
    vec = make("hover", 1, drones, **still, **known, **{"cable.model": "chain", "cable.density": 0.1}, **rig)
    vec.reset(seed=0)
    state, goal = vec.world.state, vec.task.goal
    start = state.drone_position.copy()
    np.testing.assert_allclose(start, goal.slots, atol=1e-5)
    for _ in range(50):
        vec.step(np.zeros((1, vec.num_drones, vec.action_size), np.float32))
    assert np.abs(state.drone_position - start).max() < 1e-4
