"""Scripts that hold slots by interfaces below references: one law, whatever they command."""

import numpy as np
import pytest
from conftest import level, make, refusal

import multilift_marl as ml
from multilift_marl.policies import tuned
from multilift_marl.policies.baselines import LINEAR, base_matrix, fitting_scripts, make_scripted
from multilift_marl.policies.hold import DAMPING, STIFFNESS
from multilift_marl.policies.tuned import tuned_policy
from multilift_marl.schema import training as train_schema

STILL = {"randomization.payload_mass": 0.0, "randomization.payload_force": 0.0}
IN_CABLES = {"env.units": "cable", "cable.length": 1.2}
HOLDING = {script.INTERFACE: name for name, script in LINEAR.items() if name.startswith("hold_")}


def make_holding(action, **settings):
    heading = "outward" if action == "rotor" else "target"
    vec = make(**{"num_envs": 24, "control.action": action, "control.heading": heading, **settings})
    return vec, make_scripted(HOLDING[action], vec)


def lean(vec) -> float:
    """Return the level part of drone 0's thrust axis at rest."""
    force = vec.world.system.hook_force[0] + np.array([0.0, 0.0, vec.world.system.vehicles[0].mass * 9.81])
    return float(np.hypot(*force[:2]) / np.linalg.norm(force))


@pytest.mark.parametrize("action", HOLDING)
def test_they_hold_the_payload_at_its_target(action):
    vec, script = make_holding(action)
    seen, _ = vec.reset(seed=1)
    for _ in range(vec.max_steps):
        before, seen = seen, vec.step(script.act(seen))[0]
        assert not vec.task.cause.any()
    assert vec.task.succeeded().all()
    assert np.abs(script.act(before) - script.act(seen)).max() < 0.02  # at rest, and in no limit cycle
    assert vec.task.errors.distance.mean() < 0.01


@pytest.mark.parametrize("action", ["velocity", "acceleration", "acc_rates", "ctbr", "ctbm"])
def test_a_drone_off_its_slot_begins_to_move_by_the_law(action):
    vec, script = make_holding(action, **{"num_envs": 1, "env.sensing": "ideal", "randomization.payload_force": 0.0})
    vec.reset(seed=1)
    seen = np.zeros((1, 4, vec.observation_size), np.float32)
    names = vec.observation_names
    seen[..., names.index("heading_0")] = 1.0  # at rest but for 5 cm outward
    seen[..., names.index("slot_error_0")] = 0.05
    if action in ("ctbr", "ctbm"):  # at rest drones lean outward, against their cables
        seen[..., names.index("thrust_axis_0")] = lean(vec)
    action_taken = script.act(seen)[0, 0]
    moving = {"velocity": 0, "acceleration": 0, "acc_rates": 0, "ctbr": 2, "ctbm": 2}[action]
    assert action_taken[moving] < -0.05  # inward, or its tilt that way
    rest = np.delete(action_taken, moving)
    assert np.abs(rest).max() < 1e-4
    if action == "acceleration":
        assert action_taken[0] * vec.config.control.max_acceleration == pytest.approx(-STIFFNESS * 0.05, rel=1e-5)
    if action == "velocity":
        expected = -STIFFNESS / DAMPING * 0.05
        assert action_taken[0] * vec.config.control.max_velocity == pytest.approx(expected, rel=1e-5)


def exerted(task, action, seen, **settings):
    """Return the change (4,) of thrust [N] and moments [N m] of drone 0 at rest by what `hold_<action>` does there."""
    heading = {"control.heading": "outward", "env.policy_hz": 250.0, "control.action": action}
    vec = make(task, num_envs=1, **heading, **settings, **STILL)
    script, names = make_scripted(HOLDING[action], vec), vec.observation_names
    wrenches = []
    for given in ({}, seen):
        vec.reset(seed=0)
        level(vec)
        vec.controller.start(0)
        observation = np.zeros((1, vec.num_drones, vec.observation_size), np.float32)
        rest = {"heading_0": 1.0, "thrust_axis_0": lean(vec)}
        for name, value in (rest | given).items():
            name = name.replace("turned", "body") if action == "rotor" else name
            observation[..., names.index(name)] = value
        acted = script.act(observation)
        assert np.abs(acted).max() < 1
        vec.step(acted)
        wrenches.append(vec.world.system.vehicles[0].allocation @ vec.world.thrust[0, 0])
    return wrenches[1] - wrenches[0]


SEEN = [{"velocity_2": -0.05}, {"turned_rates_0": 0.1}, {"turned_rates_1": 0.1}, {"turned_rates_2": 0.1}]
RIGS = {"falcon4": ("hover", {}), "in cables": ("hover", IN_CABLES), "crazyflie2": ("rigs/crazyflie2", {})}


@pytest.mark.parametrize("rig", RIGS)
@pytest.mark.parametrize("axis", range(4), ids=["thrust", "roll", "pitch", "yaw"])
def test_rotors_exert_what_the_moments_command(rig, axis):
    """By the rotors' commands themselves; those of crazyflie2 have twice the range below hover as above it."""
    task, settings = RIGS[rig]
    by_moments, by_rotors = (exerted(task, action, SEEN[axis], **settings) for action in ("ctbm", "rotor"))
    assert abs(by_moments[axis]) > 1e-7
    assert by_rotors[axis] == pytest.approx(by_moments[axis], rel=1e-3)


def test_drones_may_differ():
    mixed = {"control.action": "rotor", "control.heading": "outward", "vehicle.preset": ["falcon", "hummingbird"]}
    vec = make(num_envs=2, num_drones=2, **mixed)
    seen, _ = vec.reset(seed=0)
    assert make_scripted("hold_rotor", vec).act(seen).shape == (2, 2, 4)


@pytest.mark.parametrize("action", ["ctbm", "rotor"])
def test_where_the_script_alone_holds_the_attitude_a_slow_policy_is_refused(action):
    slow = make(num_envs=1, **{"control.action": action, "control.heading": "outward", "env.policy_hz": 25.0})
    assert fitting_scripts(slow) == []
    message = refusal(make_scripted, f"hold_{action}", slow)
    assert f"hold_{action} holds" in message and "env.policy_hz=25 is too slow for that; raise it to 45" in message


@pytest.mark.parametrize("action", HOLDING)
def test_a_turned_drone_turns_back(action):
    if action in ("acc_rates", "full_state"):  # their yaw is that at rest
        return
    vec, script = make_holding(action, num_envs=1)
    seen = np.zeros((1, 4, vec.observation_size), np.float32)
    seen[..., vec.observation_names.index("heading_0")] = np.cos(0.3)
    seen[..., vec.observation_names.index("heading_1")] = np.sin(0.3)
    acted = script.act(seen)
    assert ((acted @ vec.world.system.vehicle.allocation[3] if action == "rotor" else acted[..., -1]) < 0).all()


def test_each_fits_its_interface_alone():
    for action, name in HOLDING.items():
        assert fitting_scripts(make_holding(action, num_envs=1)[0]) == [name]
    assert not set(fitting_scripts(make(num_envs=1))) & set(HOLDING.values())
    rotor = make(num_envs=1, **{"control.action": "rotor"})
    assert fitting_scripts(rotor) == []
    assert "set control.heading=outward" in refusal(make_scripted, "hold_rotor", rotor)
    vec = make(num_envs=1, **{"control.action": "ctbr"})
    assert "take hold_ctbr" in refusal(make_scripted, "formation_integral", vec)


OWN = """
from multilift_marl.policies.hold import HoldAcceleration

class Mine(HoldAcceleration):
    GAINS = (("slot_error", 0, 0, -3.0),)

class Wrong:
    def __init__(self, vec): pass
    def act(self, observation): return observation
    def reset(self, mask=None): pass
"""


def test_ones_own_script_can_be_corrected(registries, tmp_path):
    (tmp_path / "mine.py").write_text(OWN, encoding="utf-8")
    name = f"{tmp_path / 'mine.py'}:Mine"
    config = ml.load_config("hover", {"control.action": "acceleration", "train.residual": name, "env.num_envs": 1})
    vec = ml.make_vec(config)
    matrix = base_matrix(config.train.residual, vec)
    assert matrix.shape == (4, vec.observation_size) and matrix.dtype == np.float32
    assert matrix[0, vec.observation_names.index("slot_error_0")] == pytest.approx(-1.0)  # of 3 m/s²
    wrong = f"{tmp_path / 'mine.py'}:Wrong"
    assert "needs a method matrix()" in refusal(base_matrix, wrong, vec)
    assert "must be formation" in refusal(ml.load_config, "hover", {"train.residual": "hold_everything"})


def test_base_policies_by_tuned_gains_have_names(monkeypatch, tmp_path):
    assert tuple(LINEAR) == train_schema.BASE_POLICIES and len(train_schema.TUNED) == 24
    monkeypatch.chdir(tmp_path)
    for name in train_schema.TUNED:
        kind = tuned_policy(name)
        assert kind.GAINS and kind.__doc__ and getattr(tuned, kind.__name__) is kind
        assert not set(kind.__bases__) - set(LINEAR.values())
        for former in (f"results/searched.py:{kind.__name__}", f"results/searched_gate.py:{kind.__name__}"):
            assert ml.load_config("hover", {"train.residual": former}).train.residual == name
    (tmp_path / "results").mkdir()
    (tmp_path / "results" / "searched.py").write_text(OWN, encoding="utf-8")
    own = "results/searched.py:TrackFollow"  # a user's own file stays that
    assert ml.load_config("hover", {"train.residual": own}).train.residual == own
    message = refusal(ml.load_config, "hover", {"train.residual": "hover_realistc"})
    assert message.endswith("did you mean 'hover_realistic'?, but is 'hover_realistc'")


def test_tuned_gains_act_by_name():
    vec = ml.make_vec("hover", num_envs=1, num_threads=1)
    matrix = base_matrix("hover_realistic", vec)
    names = vec.observation_names
    assert matrix[0, names.index("payload_error_integral_0")] == pytest.approx(-0.677 / vec.config.control.max_offset)
    assert "cannot fly control.action=reference" in refusal(base_matrix, "track_agile", vec)
