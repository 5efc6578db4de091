"""The batched core: what thousands of starts, and their hidden parameters, are like."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from conftest import CABLES, COMMON, TASKS, make, slow, zeros

from multilift_marl.sim.cables.massless import limit_solref
from multilift_marl.tasks import find_task

STARTS = [(model, task) for model, task in product(CABLES, TASKS) if model == "massless" or find_task(task).CHAINS]
STARTS = [start if start[1] in COMMON else slow(start) for start in STARTS]
MASSLESS = pytest.mark.parametrize("starts", STARTS[: len(TASKS)], indirect=True, ids="-".join)  # draws know no cables


@pytest.fixture(scope="module", params=STARTS, ids="-".join)
def starts(request):
    """Return a batch that collects, over four resets, what four thousand starts are like, of chains eight hundred."""
    model, task = request.param
    hidden = {"randomization.payload_mass": 0.2, "randomization.payload_force": 1.5}
    vec = make(task, num_envs=1000 if model == "massless" else 200, num_drones=4, **hidden, **CABLES[model])
    kept = {name: [] for name in ("cause", "stretch", "mass", "force", "position")}
    for _ in range(4):
        observation, _ = vec.reset()
        vec.task.stages["measure"](0, vec.num_envs)
        kept["cause"].append(vec.task.cause.copy())
        kept["stretch"].append(vec.world.stats.stretch_max.copy())
        kept["mass"].append(vec.world.hidden_loads.payload_mass / vec.world.system.payload_mass - 1)
        kept["force"].append(vec.world.hidden_loads.payload_force.copy())
        kept["position"].append(vec.task.errors.distance.copy())
        assert np.isfinite(observation).all() and np.isfinite(vec.state()).all()
    return vec, {name: np.array(arrays) for name, arrays in kept.items()}


def test_no_start_is_a_failure(starts):
    vec, kept = starts
    assert not kept["cause"].any()
    *_, terminated, _, _ = vec.step(zeros(vec))
    assert not terminated.any()


def test_no_start_stretches_a_cable_beyond_its_load(starts):
    vec, kept = starts
    system, heavier = vec.world.system, 1 + vec.config.randomization.payload_mass
    at_rest = (system.resting_tension / (system.cable_stiffness * system.cable_length)).max()
    assert kept["stretch"].max() <= heavier * at_rest * (1 + 1e-6)


@MASSLESS
def test_payload_mass_is_drawn_uniformly_about_the_nominal_one_every_time(starts):
    vec, kept = starts
    width, mass = vec.config.randomization.payload_mass, kept["mass"]
    assert width > 0 and np.abs(mass).max() <= width + 1e-12
    assert (np.ptp(mass, axis=1) > 1.98 * width).all()
    np.testing.assert_allclose(mass.std(axis=1), width / np.sqrt(3), rtol=0.05)
    np.testing.assert_allclose(np.corrcoef(mass) - np.eye(4), 0, atol=0.08)


@MASSLESS
def test_payload_force_is_horizontal_and_uniform_in_strength_and_direction(starts):
    vec, kept = starts
    width, force = vec.config.randomization.payload_force, kept["force"].reshape(-1, 3)
    strength = np.linalg.norm(force, axis=1)
    assert strength.max() <= width + 1e-12
    assert (force[:, 2] == 0).all()
    np.testing.assert_allclose(np.quantile(strength, [0.25, 0.5, 0.75]), width * np.array([0.25, 0.5, 0.75]), rtol=0.05)
    np.testing.assert_allclose(force[:, :2].mean(axis=0), 0, atol=0.03 * width)


def test_inertia_and_cables_follow_the_payload_mass(starts):
    vec, _ = starts
    world, body = vec.world, vec.world.layout.payload_body
    for shard in world.shards:
        mass = world.hidden_loads.payload_mass[shard.lo : shard.hi]
        np.testing.assert_array_equal(shard.batch.expanded("body_mass")[:, body], mass)
        inertia = shard.batch.expanded("body_inertia")[:, body]
        np.testing.assert_allclose(
            inertia / mass[:, None],
            np.broadcast_to(world.system.payload_inertia, inertia.shape) / world.system.payload_mass,
        )
        if world.system.cable_model == "chain":  # is springs and dampers, whatever hangs on it
            continue
        inverse_weight = shard.batch.expanded("tendon_invweight0")
        expected_weight = 1 / mass[:, None] + 1 / world.system.vehicle.mass
        assert (inverse_weight > 0.99 * expected_weight).all()
        expected = limit_solref(world.system.cable_stiffness, world.system.cable_damping, inverse_weight)
        np.testing.assert_allclose(shard.batch.expanded("tendon_solref_lim"), expected)


def test_hidden_parameters_can_be_switched_off(task, cables):
    vec = make(task, **{"randomization.payload_mass": 0, "randomization.payload_force": 0}, **cables)
    vec.reset()
    assert (vec.world.hidden_loads.payload_mass == vec.world.system.payload_mass).all()
    assert (vec.world.hidden_loads.payload_force == 0).all()
