"""The written example of a new task works, and is short; a task's target may jump."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import make

from multilift_marl.config.load import build_config
from multilift_marl.control.formation import place_formation
from multilift_marl.kernels import inlined
from multilift_marl.math3d import add, matmul, matrow, put, putmat, rot_z, row
from multilift_marl.tasks import TASKS
from multilift_marl.tasks.base import Kernels
from multilift_marl.tasks.hover import Hover

EXAMPLE = Path(__file__).parents[2] / "examples" / "new_task.py"


@pytest.mark.slow
def test_a_new_task_takes_sixty_lines(tmp_path):
    assert len(EXAMPLE.read_text().splitlines()) <= 60
    done = subprocess.run([sys.executable, EXAMPLE], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "100% of 64 teams lifted their payload\n", done.stderr


LEAPT_AT = 50  # policy steps


@inlined
def leap(e, v):
    """Let the target leap after a second."""
    if abs(v.time[e] - LEAPT_AT * v.dt) < 0.5 * v.control_dt:
        put(v.goal.position[e], add(row(v.goal.position, e), (0.8, 0.0, 0.6)))
        putmat(v.goal.rotation[e], matmul(rot_z(0.5), matrow(v.goal.rotation, e)))
        place_formation(e, v.goal, v.rig)


class Leaping(Hover):
    """Hover about a target that is elsewhere, and turned, from one moment on."""

    name = "leaping"

    KERNELS = Kernels(plan=leap)


@pytest.mark.parametrize("disturbance", ["none", "integral"])
def test_a_target_that_leaps_is_flown_to_like_any_far_one(disturbance, monkeypatch):
    monkeypatch.setitem(TASKS, "leaping", Leaping)
    calm = {f"task_options.start_{name}": 0 for name in ("radius", "speed", "tilt")}
    config = build_config({"task": "leaping"}, {"control.disturbance": disturbance, **calm})
    vec = make(config, num_envs=2)
    error = [name.startswith("payload_error_") and "integral" not in name for name in vec.observation_names]
    (before, _), fastest = vec.reset(seed=0), 0.0
    for step in range(1, 400):
        seen, _, terminated, _, info = vec.step(np.zeros((2, 4, 4)))
        assert not terminated.any(), (step, vec.failure_causes[info["failure_cause"].max()])
        state, errors = vec.world.state, vec.task.errors
        fastest = max(fastest, np.linalg.norm(state.drone_velocity, axis=-1).max())
        if step == LEAPT_AT:  # told, measured and commanded in the same step
            np.testing.assert_allclose(errors.distance, 1.0, atol=0.1)
            told = np.linalg.norm((seen - before)[..., error], axis=-1)
            np.testing.assert_allclose(told, 1.0, atol=0.2)
            np.testing.assert_array_equal(vec.reference.command, vec.task.goal.slots)
        before = seen
    assert fastest < 1.5 * vec.config.control.reference_speed
    assert errors.distance.max() < 0.1 and errors.angle.max() < 0.1
