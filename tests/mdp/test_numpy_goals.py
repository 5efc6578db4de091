"""Goals that a NumPy function places at the policy rate: where they are between, and what turns and leaps."""

import numpy as np
import pytest
from test_numpy_tasks import build, numpy_task

import multilift_marl as ml
from multilift_marl.envs.measured import MeasuredTeam
from multilift_marl.tasks.base import Kernels
from multilift_marl.tasks.hover import Hover


def sway(v):
    """Move 0.4 m to and fro along x."""
    phase, still = 2.0 * v.time, np.zeros_like(v.time)
    moved = np.stack([0.4 * np.sin(phase), still, still + 1.5], axis=1)
    velocity = np.stack([0.8 * np.cos(phase), still, still], axis=1)
    acceleration = np.stack([-1.6 * np.sin(phase), still, still], axis=1)
    return {"position": moved, "velocity": velocity, "acceleration": acceleration}


def test_a_goal_moves_and_references_move_along(registries):
    class Sway(Hover):
        name = "by_numpy"
        KERNELS = Kernels(plan=sway)

    ml.register_task(Sway)
    vec = build(3, 2, **{"env.episode_seconds": 3.0})
    vec.reset(seed=0)
    assert vec.task.goal.position == pytest.approx(np.tile([0.0, 0.0, 1.5], (3, 1)))
    assert vec.task.goal.velocity[:, 0] == pytest.approx(0.8)
    for name, placed in (("position", "slots"), ("velocity", "velocity"), ("acceleration", "acceleration")):
        goal = getattr(vec.task.goal, placed)
        getattr(vec.reference, name)[:] = goal if goal.ndim == 3 else goal[:, None]
    lag = []
    for step in range(1, 101):
        vec.step(np.zeros((3, vec.num_drones, vec.action_size)))
        assert vec.task.time == pytest.approx(step / 50)
        assert vec.task.goal.position[:, 0] == pytest.approx(0.4 * np.sin(2.0 * step / 50), abs=1e-12)
        errors = vec.world.state.payload_position - vec.task.goal.position
        assert vec.task.errors.position == pytest.approx(errors, abs=1e-12)
        lag.append(np.abs(vec.reference.position - vec.task.goal.slots).max())
    assert max(lag) < 2e-4  # [m]; those of a target that was held for each step would be 16 mm behind


def test_a_goal_turns_and_leaps(registries):
    def leap(v):
        quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
        after = v.time > 0.09
        place = np.where(after[:, None], [0.3, 0.0, 1.5], [0.0, 0.0, 1.5])
        return {"position": place, "rotation": np.where(after[:, None, None], quarter, np.eye(3))}

    ml.register_task(type("Leap", (Hover,), {"name": "by_numpy", "KERNELS": Kernels(plan=leap)}))
    vec = build(2)
    vec.reset(seed=0)
    for step in range(1, 8):
        vec.step(np.zeros((2, vec.num_drones, vec.action_size)))
        assert vec.task.goal.position[:, 0] == pytest.approx(0.3 * (step >= 5))
        assert vec.task.goal.yaw == pytest.approx(np.pi / 2 * (step >= 5))
    assert (vec.task.goal.velocity == 0.0).all()


def test_a_measured_team_observes_as_a_simulated_one(registries):
    numpy_task(KERNELS=Kernels(plan=sway))
    vec = build(1)
    team = MeasuredTeam(vec.config)

    def measured():
        return {name: array[0].copy() for name, array in vec.world.state._asdict().items()}

    vec.reset(seed=0)
    observation = team.begin(measured(), 0, (vec.task.goal.position[0], vec.task.goal.rotation[0]))
    for _ in range(5):
        assert np.array_equal(observation, vec.current()[0])
        action = np.full((1, vec.num_drones, vec.action_size), 0.1)
        team.command(action)
        vec.step(action)
        observation = team.observe(measured())
