"""Drones that face outward (`control.heading`): what that changes, and what it must not."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make, make_system, slow, zeros

from multilift_marl.policies.baselines import make_scripted

OUTWARD = {"control.heading": "outward"}
CALM = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}
AT_REST = {f"task_options.start_{name}": 0.0 for name in ("radius", "speed", "tilt")}
ROUND = {"payload.shape": "cylinder", "vehicle.inertia": [0.002, 0.002, 0.003], "vehicle.drag": [0.3, 0.3, 0.0]}
"""A rig that is the same after a third of a turn, of drones that fly alike in all directions."""


def turned(vec, rest) -> np.ndarray:
    """Return the drones' headings (E, N) from `rest` (N,) in the team [rad]."""
    rotation, team = vec.world.state.drone_rotation, vec.task.planned.drone_yaw[:, None]
    yaw = np.arctan2(-rotation[..., 0, 1], rotation[..., 1, 1]) - team - rest
    return np.remainder(yaw + np.pi, 2 * np.pi) - np.pi


def fly(vec, policy, steps: int) -> np.ndarray:
    """Return the payload's path (steps, E, 3)."""
    observation, _ = vec.reset(seed=3)
    path = []
    for _ in range(steps):
        observation, *_ = vec.step(policy.act(observation))
        path.append(vec.world.state.payload_position.copy())
    return np.array(path)


@pytest.mark.parametrize("task", ["hover", slow("recover"), slow("takeoff"), "track", "pose"])
def test_drones_start_outward_and_come_back_to_it(task):
    vec = make(task, num_drones=5, **OUTWARD)
    azimuth = vec.world.system.slot_azimuth
    assert len(set(np.round(azimuth, 6))) == 5
    vec.reset(seed=3)
    if task != "recover":  # where drones start tilted by up to a right angle
        assert np.abs(turned(vec, azimuth)).max() < 0.05
    for _ in range(150):
        vec.step(zeros(vec))
    assert np.abs(turned(vec, azimuth)).max() < 0.05


def test_drones_face_as_the_target_does_by_default():
    vec = make(num_drones=5)
    vec.reset(seed=0)
    assert not vec.world.system.heading.any()
    assert np.abs(turned(vec, 0.0)).max() < 0.05


def test_a_full_yaw_action_turns_from_outward():
    vec = make(num_envs=1, **OUTWARD, **CALM)
    vec.reset(seed=0)
    action = zeros(vec)
    action[..., 3] = 1.0
    for _ in range(150):
        vec.step(action)
    np.testing.assert_allclose(turned(vec, vec.world.system.slot_azimuth), vec.config.control.max_yaw, atol=0.03)


@pytest.mark.parametrize("num_drones, apart", [(2, 1e-6), (3, 5e-3)])
def test_the_heading_of_isotropic_drones_does_not_change_the_flight(num_drones, apart):
    """With two drones one is turned by 180°, which leaves its rotors where they were; with three, other rotors lag."""
    flown = []
    for heading in ("target", "outward"):
        vec = make(num_envs=2, num_drones=num_drones, **ROUND, **{"control.heading": heading})
        flown.append(fly(vec, make_scripted("formation_feedback", vec), 200))
    assert np.linalg.norm(flown[0][0] - flown[0][-1], axis=-1).min() > 0.1  # they move
    np.testing.assert_allclose(flown[1], flown[0], atol=apart)


@pytest.mark.parametrize("heading", ["target", "outward"])
def test_the_same_rotor_thrusts_mean_the_same_to_drones_that_face_outward(heading):
    """All drones of a symmetric team act alike: facing outward they observe alike, however long they fly."""
    vec = make(num_envs=1, num_drones=3, **ROUND, **CALM, **AT_REST, **{
        "control.action": "rotor", "control.heading": heading
    })  # fmt: skip
    observation, _ = vec.reset(seed=0)
    names = vec.observation_names
    shared = [i for i, name in enumerate(names) if not name.startswith(("slot_direction", "previous_action"))]
    action = zeros(vec)
    for k in range(25):
        action[..., :] = 0.02 * np.array([1.0, 0.6, -1.0, -0.4]) * (-1) ** (k // 2)
        observation, _, terminated, *_ = vec.step(action)
    assert not terminated.any()
    rates = observation[0, :, [names.index(f"body_rates_{axis}") for axis in range(3)]]
    assert np.abs(rates).max() > 1e-3
    apart = np.abs(observation[0][:, shared] - observation[0][:1, shared]).max()
    if heading == "outward":
        assert apart < 1e-5
    else:
        assert apart > 1e-2


def test_a_drone_above_the_middle_has_no_outward():
    assert make_system(1, **OUTWARD).heading == 0.0
