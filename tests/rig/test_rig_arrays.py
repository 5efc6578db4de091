"""The numbers of a rig as compiled functions take them."""

from __future__ import annotations

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.mdp.initial_states import true_equilibrium


def arrays_of(record) -> list[np.ndarray]:
    """Return all arrays of a named tuple, those of named tuples in it too."""
    if isinstance(record, np.ndarray):
        return [record]
    return [array for field in record for array in arrays_of(field)] if isinstance(record, tuple) else []


def test_kernels_of_a_task_get_each_number_of_the_rig_once():
    vec = ml.make_vec(
        "hover",
        num_envs=1,
        num_threads=1,
        **{"cable.hook": [0.02, 0.01, -0.05], "cable.length": [1.0, 1.01, 1.02, 1.03]},
    )
    system = vec.world.system
    held = {id(array): array for array in arrays_of(vec.task.view)}.values()
    assert vec.task.rig is vec.world.rig
    for number in (system.anchors, system.hooks, system.cable_length, system.drone_mass, system.slots):
        assert sum(array.shape == number.shape and (array == number).all() for array in held) == 1


def test_loads_are_over_the_nominal_payload():
    vec = ml.make_vec("hover", num_envs=2, num_threads=1, **{"randomization.payload_mass": 0.3})
    _, info = vec.reset(seed=0)
    assert vec.world.rig.load == 1.0
    for env, mass in enumerate(info["randomization"]["payload_mass"].tolist()):
        true = true_equilibrium(vec.world.rig, vec.world.parameters, env)
        assert true.load == pytest.approx(mass / vec.world.system.payload_mass) and true.load != 1.0
