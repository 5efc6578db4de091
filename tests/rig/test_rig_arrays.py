"""The numbers of a rig as compiled functions take them."""

from __future__ import annotations

import numpy as np

import multilift_marl as ml


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
