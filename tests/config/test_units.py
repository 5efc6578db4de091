"""Units of the cables (`env.units=cable`): similar rigs of any size observe, act and fly alike."""

from __future__ import annotations

from math import sqrt

import numpy as np
import pytest
from conftest import bold_actions, make, refusal, slow

from multilift_marl.control.actions import ACTIONS
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.rig.presets import PRESETS

SIZE = 2.0
CORNERS = ((0.2, 0.15), (-0.2, 0.15), (-0.2, -0.15), (0.2, -0.15))
CABLE = {"env.units": "cable"}
LONG = {"cable.length": 2.0, "task_options.start_tilt": 5.0}


def similar_rig(size: float) -> dict[str, object]:
    """Return a rig like the standard one whose lengths are `size` times and times √size times as large.

    Masses are like volumes, forces like weights. Rotors turn √size times more slowly.
    """
    time, mass, vehicle = sqrt(size), size**3, PRESETS["falcon"]
    return {
        "sim.timestep": 0.004 * time, "sim.control_hz": 250.0 / time, "env.policy_hz": 50.0 / time,
        "env.episode_seconds": 8.0 * time, "cable.length": size, "cable.stiffness": 1e4 * mass / size,
        "cable.damping": 100.0 * mass / time, "payload.mass": 1.0 * mass,
        "payload.size": [0.4 * size, 0.3 * size, 0.1 * size],
        "payload.anchors": [[x * size, y * size, 0.05 * size] for x, y in CORNERS],
        "payload.drag_area": 0.1 * size**2,
        "vehicle.mass": vehicle.mass * mass, "vehicle.inertia": [moment * mass * size**2 for moment in vehicle.inertia],
        "vehicle.arm": vehicle.arm * size, "vehicle.thrust_coefficient": vehicle.thrust_coefficient * mass * time**2,
        "vehicle.torque_ratio": vehicle.torque_ratio * size,
        "vehicle.rotor_time_constant_up": vehicle.rotor_time_constant_up * time,
        "vehicle.rotor_time_constant_down": vehicle.rotor_time_constant_down * time,
        "vehicle.rotor_speed_min": vehicle.rotor_speed_min / time,
        "vehicle.rotor_thrust_max": vehicle.rotor_thrust_max * mass,
        "vehicle.drag": [drag * mass / time for drag in vehicle.drag],
        "vehicle.rotor_inertia": vehicle.rotor_inertia * mass * size**2,
        "control.reference_frequency": 6.0 / time, "control.reference_speed": 1.0 * time,
        "control.position_frequency": 4.0 / time, "control.attitude_frequency": 20.0 / time,
        "control.yaw_frequency": 8.0 / time,
        "randomization.payload_mass": 0.2, "randomization.payload_force": 1.5 * mass,
        "task_options.target_xy": 1.0 * size, "task_options.target_height": [4.0 * size, 5.0 * size],
        "task_options.start_radius": 0.5 * size, "task_options.start_speed": 0.3 * time,
    }  # fmt: skip


DEFAULT = "reference", "acc_rates", "ctbr"


@pytest.mark.parametrize(
    "action",
    [
        name if name in ("reference", "acc_rates", "ctbr") else slow(name)
        for name in ACTIONS
        if name != "planner_weights"
    ],
)  # tolerances are in SI units
def test_similar_rigs_observe_and_fly_alike(action):
    """A whole flight, twice as large: every number that drones observe is the same at every step."""
    teams = [make(num_envs=2, **CABLE, **similar_rig(size), **{"control.action": action}) for size in (1.0, SIZE)]
    small, large = (vec.reset(seed=2)[0] for vec in teams)
    np.testing.assert_allclose(large, small, atol=1e-6)
    before = teams[0].world.state.payload_position.copy()
    for k in range(100):
        actions = (0.02 if action in ("ctbm", "rotor") else 0.1) * bold_actions(teams[0], k)
        (small, *_, ended, _, _), (large, *_) = (vec.step(actions) for vec in teams)
        if ended.any():
            break
        np.testing.assert_allclose(large, small, atol=1e-3)
    assert k > 20
    assert np.linalg.norm(teams[0].world.state.payload_position - before, axis=1).min() > 0.05


def test_rigs_that_are_not_similar_observe_different_numbers():
    own = similar_rig(SIZE) | {"vehicle.rotor_time_constant_up": 0.033, "vehicle.rotor_time_constant_down": 0.033}
    teams = [make(num_envs=2, **CABLE, **rig) for rig in (similar_rig(1.0), own)]
    small, large = (vec.reset(seed=2)[0] for vec in teams)
    names = teams[0].observation_names
    differing = {names[i] for i in np.flatnonzero(np.abs(small - large).max(axis=(0, 1)) > 1e-6)}
    assert differing == {"rig_1"}


def test_with_cables_of_a_metre_units_are_those_of_si():
    teams = [make(num_envs=2, **{"env.units": units, "cable.length": 1.0}) for units in ("si", "cable")]
    (si, _), (cable, _) = (vec.reset(seed=0) for vec in teams)
    size = si.shape[-1]
    assert teams[1].observation_names == (*teams[0].observation_names, *(f"rig_{i}" for i in range(8)))
    np.testing.assert_array_equal(cable[..., :size], si)
    for k in range(20):
        si, cable = (vec.step(bold_actions(teams[0], k))[0] for vec in teams)
    np.testing.assert_array_equal(cable[..., :size], si)


def test_units_do_not_change_what_is_flown():
    """The centralised script knows the true state, and its actions are the same offsets in metres."""
    paths = []
    for units in ("si", "cable"):
        vec = make(num_envs=2, **{"env.units": units}, **LONG)
        policy = make_scripted("payload_geometric", vec)
        observation, _ = vec.reset(seed=1)
        path = []
        for _ in range(100):
            observation, *_ = vec.step(policy.act(observation))
            path.append(vec.world.state.drone_position.copy())
        paths.append(np.array(path))
    np.testing.assert_allclose(paths[1], paths[0], atol=1e-9)


def test_a_full_action_is_as_large_as_the_cables():
    vec = make(num_envs=1, **CABLE, **LONG)
    vec.reset(seed=0)
    action = np.zeros((1, 4, 4))
    action[..., 2] = 1.0
    vec.step(action)
    moved = vec.reference.command[0] - vec.task.goal.slots[0]
    np.testing.assert_allclose(
        moved, np.broadcast_to([0.0, 0.0, 2.0 * vec.config.control.max_offset], (4, 3)), atol=1e-12
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    "task", ["loss", *(pytest.param(name, marks=pytest.mark.slow) for name in ("track", "gate", "takeoff", "pose"))]
)
def test_every_task_has_them(task):
    vec = make(task, num_envs=2, num_drones=4, **CABLE)
    observation, _ = vec.reset(seed=0)
    assert observation.shape[-1] == len(vec.observation_names) and vec.observation_names[-1] == "rig_7"
    observation, *_ = vec.step(np.zeros((2, 4, 4)))
    assert np.isfinite(observation).all()


def test_the_rates_of_a_script_are_those_of_the_cables():
    """On short cables the gains of hold_ctbm are larger, and too large for the policy's rate sooner."""
    metre, short, cable = (
        make(num_envs=1, **{"control.action": "ctbm", "cable.length": length, "env.units": units})
        for length, units in ((1.0, "cable"), (0.7, "si"), (0.7, "cable"))
    )
    make_scripted("hold_ctbm", metre)
    make_scripted("hold_ctbm", short)
    assert "raise it to 53.8 or more" in refusal(make_scripted, "hold_ctbm", cable)
