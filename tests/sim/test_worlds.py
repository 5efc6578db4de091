"""Worlds: the same for everyone whatever the threads and neighbours, what is refused, what diverges."""

from __future__ import annotations

import copy
import logging
import signal
import sys
import threading
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
from conftest import hover_thrust, make_system, mask, same

from multilift_marl import make_vec
from multilift_marl.rig.restitution import DAMPING, STIFFNESS
from multilift_marl.sim import World
from multilift_marl.sim.scene import build_spec

# Many at once


def fly(world: World, steps: int = 60, seed: int = 0, first: int = 0) -> dict[str, np.ndarray]:
    """Fly every environment by thrusts of its own and return all there is to know afterwards."""
    for step in range(first, first + steps):
        shares = [
            np.random.default_rng((seed, e, step)).uniform(0.9, 1.1, (world.num_drones, 4))
            for e in range(world.num_envs)
        ]
        world.step(hover_thrust(world) * shares)
    return world.state_dict()


def disturb(world: World) -> None:
    everyone = np.arange(world.num_envs)
    world.set_parameters(everyone > 0, payload_mass=world.system.payload_mass * (1 + 0.05 * everyone))
    world.hidden_loads.payload_force[:, 0] = 0.3 * everyone


def rows(saved: dict[str, np.ndarray], chosen) -> dict[str, np.ndarray]:
    return {key: array[chosen] for key, array in saved.items()}


@pytest.mark.parametrize("num_threads", [2, 3, 8])
def test_the_number_of_threads_changes_no_bit(num_drones, num_threads):
    system = make_system(num_drones)
    one, many = World(system, 5, 1), World(system, 5, num_threads)
    for world in (one, many):
        disturb(world)
    assert same(fly(one), fly(many))


class Slow:
    """Work of shards: some fail at once, the others take a while."""

    def __init__(self, world: World, failing: int, error: type[BaseException] = ZeroDivisionError):
        self.world, self.failing, self.error, self.done = world, failing, error, []

    def __call__(self, shard) -> None:
        number = self.world.shards.index(shard)
        if number == self.failing:
            raise self.error
        time.sleep(0.2 * number)
        self.done.append(number)


@pytest.mark.parametrize("failing", [0, 1])
def test_no_thread_runs_on_when_one_has_failed(failing):
    world = World(make_system(2), 4, 4)
    work = Slow(world, failing)
    with pytest.raises(ZeroDivisionError):
        world.run(work)
    assert sorted(work.done) == [number for number in range(4) if number != failing]


@pytest.mark.skipif(sys.platform == "win32", reason="signals")
def test_no_thread_runs_on_after_an_interrupt():
    world = World(make_system(2), 4, 4)
    work = Slow(world, -1)
    timer = threading.Timer(0.1, signal.pthread_kill, (threading.get_ident(), signal.SIGINT))
    timer.start()
    with pytest.raises(KeyboardInterrupt):
        world.run(work)
    assert sorted(work.done) == [0, 1, 2, 3]


def test_an_environment_does_not_feel_its_neighbours():
    system = make_system(4)
    alone, crowd = World(system, 1, 1), World(system, 5, 2)
    crowd.set_parameters(mask(5, 2, 3), payload_mass=np.full(5, 1.6))
    crowd.hidden_loads.payload_force[4] = [0, 1, 0]
    assert same(rows(fly(crowd), [0]), fly(alone))


def test_a_masked_reset_leaves_the_other_rows_alone():
    world = World(make_system(3), 5, 2)
    disturb(world)
    before = fly(world)
    world.reset(mask(5, 1, 3))
    after = world.state_dict()
    assert same(rows(after, [0, 2, 4]), rows(before, [0, 2, 4]))
    assert not same(rows(after, [1]), rows(before, [1]))


def test_a_masked_reset_is_a_fresh_start():
    system = make_system(3)
    world, fresh = World(system, 5, 2), World(system, 5, 2)
    disturb(world)
    fly(world)
    world.reset(mask(5, 1, 3))
    assert same(rows(fly(world, seed=1), [1, 3]), rows(fly(fresh, seed=1), [1, 3]))


def test_a_reset_restores_the_nominal_plant():
    world = World(make_system(2, **{"wind.velocity": [1, 0, 0]}), 3, 1)
    disturb(world)
    world.hidden_loads.wind[:] = [0, 5, 0]
    world.reset(mask(3, 2))
    assert world.hidden_loads.payload_mass[2] == world.system.payload_mass != world.hidden_loads.payload_mass[1]
    assert world.hidden_loads.payload_force[:, 0].tolist() == pytest.approx([0, 0.3, 0])
    assert world.hidden_loads.wind.tolist() == [[0, 5, 0], [0, 5, 0], [1, 0, 0]]


@pytest.mark.parametrize("threads", [(1, 1), (1, 2), (2, 1)], ids=str)
def test_a_saved_world_continues_bit_for_bit(threads):
    system = make_system(4)
    world, other = World(system, 5, threads[0]), World(system, 5, threads[1])
    disturb(world)
    saved = fly(world)
    expected = fly(world, first=60)
    other.load_state_dict(saved)
    assert same(fly(other, first=60), expected)


def test_the_record_keeps_the_extremes_of_tension():
    world = World(make_system(4), 1, 1)
    rest = world.state.cable_tension[0, 0]
    assert world.stats.tension_min[0] == world.stats.tension_max[0] == pytest.approx(rest)
    seen = [rest]
    for _ in range(50):
        seen += world.step(1.2 * hover_thrust(world)).cable_tension[0].tolist()
    assert (world.stats.tension_min[0], world.stats.tension_max[0]) == (min(seen), max(seen))
    assert world.stats.stretch_max[0] == pytest.approx(max(seen) / 1e5)


# What is refused, and what goes wrong


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
def test_thrust_that_is_not_finite_is_refused(wrong):
    world = World(make_system(2), 3, 1)
    thrust = hover_thrust(world)
    thrust[1, 0, 2] = wrong
    with pytest.raises(ValueError, match="thrust holds NaN or infinite values; give"):
        world.step(thrust)


@pytest.mark.parametrize("shape", [(3, 2), (2, 2, 4), (3, 2, 3), (1, 2, 4)])
def test_thrust_of_wrong_shape_is_refused(shape):
    with pytest.raises(ValueError, match=r"thrust has shape .*, expected \(3, 2, 4\)"):
        World(make_system(2), 3, 1).step(np.ones(shape))


@pytest.mark.parametrize("mass", [0.0, -1.0, np.nan, np.inf])
def test_impossible_payload_mass_is_refused(mass):
    world = World(make_system(2), 2, 1)
    with pytest.raises(ValueError, match="mass"):
        world.set_parameters(mask(2, 1), payload_mass=np.array([1.0, mass]))


@pytest.mark.parametrize("force", [1e5, 1e30, np.nan])
def test_a_diverged_simulation_keeps_sound_numbers_and_spares_the_others(force):
    system = make_system(4)
    world, calm = World(system, 5, 2), World(system, 5, 2)
    world.hidden_loads.payload_force[2] = force
    saved, expected = fly(world), fly(calm)
    others = [0, 1, 3, 4]
    assert world.diverged.tolist() == [False, False, True, False, False]
    assert same(rows(saved, others), rows(expected, others))
    assert all(np.isfinite(saved[key]).all() for key in saved if key.startswith("state."))


def test_coordinates_are_those_of_the_environment_whatever_its_thread():
    world = World(make_system(2), 5, 2)
    world.state.payload_position[:, 0] = np.arange(5.0)
    world.load(np.ones(5, bool))
    assert [world.qpos(e)[0] for e in range(5)] == [0, 1, 2, 3, 4]


def test_strong_damping_of_a_soft_cable_is_no_divergence():
    system = make_system(2, **{"payload.shape": "point", "payload.mass": 0.4, "cable.stiffness": 47.6})
    world = World(system, 1)
    world.reset()
    world.state.drone_velocity[0, :, 2] = 0.5
    world.load(mask(1, 0))
    world.step(hover_thrust(world))
    stretch = np.linalg.norm(world.state.drone_position[0] - world.state.payload_position[0], axis=-1) - 1.0
    assert world.state.cable_tension.min() > 5 * (47.6 * stretch).max()  # it is the damper's
    assert not world.diverged.any()


def test_reset_heals_a_diverged_simulation():
    system = make_system(4)
    world, fresh = World(system, 3, 1), World(system, 3, 1)
    world.hidden_loads.payload_force[1] = np.nan
    fly(world)
    world.reset(mask(3, 1))
    assert not world.diverged.any()
    assert same(rows(fly(world, seed=1), [1]), rows(fly(fresh, seed=1), [1]))
    world.check_warnings()
    assert not world.diverged.any()


@pytest.mark.parametrize("num_threads", [1, 2])
def test_divergence_writes_no_file_and_nothing_to_the_screen(tmp_path, monkeypatch, capfd, caplog, num_threads):
    monkeypatch.chdir(tmp_path)
    caplog.set_level(logging.DEBUG, "multilift_marl.mujoco")
    world = World(make_system(4), 4, num_threads)
    world.hidden_loads.payload_force[[0, 3]] = np.nan
    world.step(hover_thrust(world), 5)
    assert world.diverged.tolist() == [True, False, False, True]
    assert "simulation is unstable" in caplog.text
    assert capfd.readouterr() == ("", "")
    assert list(Path.cwd().iterdir()) == []


# The solver


def step_once(model, start, solver: int, tolerance: float, iterations: int) -> np.ndarray:
    data = copy.copy(start)
    model.opt.solver, model.opt.tolerance, model.opt.iterations = solver, tolerance, iterations
    mujoco.mj_step(model, data)
    return data.qvel.copy()


@pytest.mark.slow
@pytest.mark.parametrize(
    "preset, num_drones",
    [("hover", 4), ("recover_crazymarl", 3), ("loss", 4), ("takeoff", 8), ("takeoff", 16), ("track_auto6", 6)],
)
def test_solvers_find_what_newtons_method_finds(preset, num_drones):
    vec = make_vec(preset, num_envs=4, num_threads=1, num_drones=num_drones)
    model, batch = copy.copy(vec.world.model), vec.world.shards[0].batch
    limits, solvers = (model.opt.tolerance, model.opt.iterations), batch.expand("opt.solver")
    rng, data, far, slack, touching, gradients = np.random.default_rng(0), mujoco.MjData(model), [], 0, 0, 0
    vec.reset(seed=0)
    action = np.zeros((4, num_drones, vec.action_size))
    for _ in range(80):
        action = np.clip(0.9 * action + 0.5 * rng.normal(size=action.shape), -1, 1)
        _, _, terminated, truncated, _ = vec.step(action)
        if (ended := terminated | truncated).any():
            vec.reset(mask=ended)
        for e in range(4):
            for name in ("qpos", "qvel", "qfrc_applied", "qacc_warmstart"):
                getattr(data, name)[:] = batch.bind(name)[e]
            exact = step_once(model, data, mujoco.mjtSolver.mjSOL_NEWTON, 1e-14, 200)
            used = int(np.ravel(solvers)[e])
            far.append(np.abs(step_once(model, data, used, *limits) - exact).max())
            mujoco.mj_forward(model, data)
            # Newton's method wherever bodies touch; conjugate gradients are faster where none are near.
            assert used == mujoco.mjtSolver.mjSOL_NEWTON or not data.ncon
            gradients += used == mujoco.mjtSolver.mjSOL_CG
            touching = max(touching, data.ncon)
            slack += data.nefc - 4 * data.ncon < num_drones
    assert np.max(far) < 5e-8  # [m/s], [rad/s]
    assert gradients > 0 or preset == "takeoff"
    assert np.median(far) < 1e-10
    assert touching >= num_drones if preset == "takeoff" else slack > 0


# Contact


def falls(model) -> tuple[np.ndarray, int]:
    """Return where all bodies of a team are in each of 250 steps without thrust, and how many contacts there were."""
    data, motion, contacts = mujoco.MjData(model), [], 0
    for _ in range(250):
        mujoco.mj_step(model, data)
        motion.append(np.concatenate([data.qpos, data.qvel]))
        contacts += data.ncon
    return np.array(motion), contacts


@pytest.mark.parametrize(
    "overrides",
    [{}, {"payload.shape": "point"}, {"payload.shape": "cylinder"}, {"cable.hook": [0.0, 0.0, -0.05]},
     {"cable.model": "chain"}],
)  # fmt: skip
def test_contact_by_pairs_is_that_of_mujocos_own_search(overrides):
    spec = build_spec(make_system(3, **overrides))
    for pair in spec.pairs:
        pair.solreffriction = [0.0, 0.0]  # geoms have none of their own
    paired, contacts = falls(spec.compile())
    for pair in list(spec.pairs):
        spec.delete(pair)
    for geom in spec.geoms:
        geom.contype = geom.conaffinity = int(geom.name != "")
        geom.solref = [-STIFFNESS, -DAMPING]
    spec.option.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_SPRING | mujoco.mjtDisableBit.mjDSBL_DAMPER)
    searched, _ = falls(spec.compile())
    assert contacts > 100
    np.testing.assert_array_equal(paired, searched)
