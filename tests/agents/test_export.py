"""Exported policies: the policy's actions for any team, a contract that the simulation keeps, clear errors."""

import hashlib
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from conftest import make, slow

from multilift_marl.agents import export as export_module
from multilift_marl.agents.checkpoint import save_checkpoint
from multilift_marl.agents.export import _convert, export_policy, make_contract
from multilift_marl.agents.networks import Actor
from multilift_marl.agents.policy import LearnedPolicy, load_policy
from multilift_marl.cli.export import main as export
from multilift_marl.config.load import load_config
from multilift_marl.control.actions import ACTIONS
from multilift_marl.errors import CheckpointError, pip_install
from multilift_marl.mdp.observations import observation_names
from multilift_marl.tasks import find_task

ROOT = Path(__file__).parents[2]
SHORT = {"env.episode_seconds": 0.4, "train.hidden": [32, 32]}


def checkpoint(task="hover", **overrides):
    """Return what a policy needs of a checkpoint: random weights, as large as after training, and statistics."""
    config = load_config(task, SHORT | overrides)
    actions = [number.name for number in ACTIONS[config.control.action].numbers]
    names = observation_names(config.control.action, find_task(config.task).extra(config), config.env.ages)
    torch.manual_seed(0)
    base = 0.5 * torch.randn(len(actions), len(names)) * (torch.rand(len(actions), len(names)) < 0.05)
    actor = Actor(
        config.train.actor, len(names), len(actions), config.train.hidden, 0.3, base, asinh=config.train.asinh
    )
    spread = torch.logspace(-2, 1, len(names))
    actor.normalizer.update(spread * (torch.randn(1000, len(names)) + torch.randn(len(names))))
    with torch.no_grad():
        torch.nn.init.orthogonal_(actor.team.net[-1].weight)
    return {
        "config": config.model_dump(mode="json"), "actor": actor.state_dict(), "observation_names": list(names),
        "action_names": actions, "frames": 1234,
    }  # fmt: skip


def policy(task="hover", **overrides):
    return LearnedPolicy(checkpoint(task, **overrides), "the test")


@pytest.mark.parametrize(
    ("kind", "history", "asinh", "changes"),
    [
        ("local", 1, 0, False),
        ("set", 3, 20, False),
        *(
            pytest.param(*each, marks=pytest.mark.slow)
            for each in (
                ("local", 3, 0, False),
                ("local", (0, 2, 7), 0, True),
                ("local", 1, 20, False),
                ("set", 1, 0, False),
                ("attention", 1, 0, False),
            )
        ),
    ],
)
def test_the_network_acts_as_the_policy_for_any_teams(tmp_path, kind, history, asinh, changes):
    keys = {"train.actor": kind, "env.history": history, "train.asinh": asinh, "train.changes": changes}
    learned = policy(**keys)
    contract = export_policy(learned, tmp_path / "new" / "folder")
    file = tmp_path / "new" / "folder" / contract["network"]["file"]
    session = onnxruntime.InferenceSession(str(file), providers=["CPUExecutionProvider"])
    assert [(end.name, end.shape) for end in (*session.get_inputs(), *session.get_outputs())] == [
        ("observation", contract["observation"]["shape"]),
        ("action", contract["action"]["shape"]),
    ]
    normalizer = learned.actor.normalizer
    for teams, drones in [(1, 1), (1, 5), (2, 3), (7, 2), (64, 4), (3, 16)]:
        spread = torch.randn(teams, drones, len(learned.observation_names), generator=torch.manual_seed(drones))
        observation = (normalizer.shift + 1.5 * spread / normalizer.scale).numpy()
        (action,) = session.run(None, {"observation": observation})
        np.testing.assert_allclose(action, learned.act(observation), rtol=0, atol=1e-5)
        assert action.dtype == np.float32 and (np.abs(action) <= 1).all()
    assert 0.02 < (np.abs(action) == 1).mean() < 0.98  # some are clipped, and most are not
    assert contract["network"]["largest_difference"] <= 1e-5
    assert ("asinh(20 x" in contract["inside"]["normaliser"]) == bool(asinh)
    assert ("differs from the newest" in contract["inside"]["normaliser"]) == changes


def test_a_network_whose_actions_are_not_numbers_is_not_taken_for_the_policy(tmp_path, monkeypatch):
    class Broken(onnxruntime.InferenceSession):
        def run(self, *arguments):
            return [np.full_like(output, np.nan) for output in super().run(*arguments)]

    monkeypatch.setattr(onnxruntime, "InferenceSession", Broken)
    with pytest.raises(CheckpointError, match="the test as an ONNX network differs by nan"):
        export_policy(policy(), tmp_path / "new")
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_a_network_may_differ_by_what_rounding_makes_of_it_and_by_no_more(tmp_path, monkeypatch):
    """Actions so steep that single precision is off by more than the tolerance of others."""
    content = checkpoint()
    for name, weight in content["actor"].items():
        if name.endswith("weight") and weight.ndim == 2:
            content["actor"][name] = 20.0 * weight
    steep = LearnedPolicy(content, "the test")
    assert export_policy(steep, tmp_path)["network"]["largest_difference"] > 1e-5
    last = max(name for name in content["actor"] if name.endswith("weight"))
    other = LearnedPolicy(content | {"actor": content["actor"] | {last: 1.01 * content["actor"][last]}}, "another")
    monkeypatch.setattr(export_module, "_convert", lambda policy, opset: _convert(other, opset))
    with pytest.raises(CheckpointError, match="where rounding makes"):
        export_policy(steep, tmp_path)


@pytest.mark.slow
def test_files_say_nothing_of_the_machine_they_were_made_on(tmp_path):
    contract = export_policy(policy(), tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["policy.json", "policy.onnx"]
    assert json.loads((tmp_path / "policy.json").read_text()) == json.loads(json.dumps(contract))
    assert contract["network"]["sha256"] == hashlib.sha256((tmp_path / "policy.onnx").read_bytes()).hexdigest()
    for path in tmp_path.iterdir():
        for word in ("networks.py", str(ROOT), str(Path.home()) + os.sep):
            assert word.encode() not in path.read_bytes(), path.name


@pytest.mark.few_tasks
def test_the_contract_names_what_the_environment_tells(task):
    learned, vec = policy(task, **{"env.history": 2}), make(task, num_envs=1, **{"env.history": 2})
    contract = make_contract(learned)
    told = contract["observation"]
    size = told["step_size"]
    assert (told["steps"], told["ages"]) == (2, [0, 1])
    assert told["names"] == list(vec.observation_names) and told["shape"][-1] == vec.observation_size == 2 * size
    for part in told["components"]:
        names = [f"{part['name']}_{i}" for i in range(part["size"])]
        assert told["names"][part["first"] :][: part["size"]] == names
        assert told["names"][size + part["first"] :][: part["size"]] == [f"{name}@-1" for name in names]
        assert part["frame"] in (*contract["frames"], "-") and part["unit"] and part["meaning"]
    assert sum(part["size"] for part in told["components"]) == size
    assert [number["name"] for number in contract["action"]["numbers"]] == list(vec.action_names)
    assert contract["policy_hz"] == 1 / vec.task.dt
    assert contract["drones"]["trained"] == len(contract["formation"]) == learned.config.env.num_drones


@pytest.mark.slow
def test_the_document_explains_every_field(tmp_path):
    text = (ROOT / "docs" / "export.md").read_text()
    for name, value in export_policy(policy(), tmp_path).items():
        inner = isinstance(value, dict) and f"| `{name}` |" not in text
        for field in (f"{name}.{key}" for key in value) if inner else [name]:
            assert f"`{field}`" in text, field


def slot_body_rates(vec) -> np.ndarray:
    """Return the rates that drone 0 was set, about the axes that point outward and to the left of that."""
    yaw = np.arctan2(*vec.world.state.drone_rotation[0, 0, [1, 0], 0])
    turned = yaw - np.arctan2(*vec.task.goal.slot_frame[0, 0, ::-1])
    c, s = np.cos(turned), np.sin(turned)
    x, y, z = vec.controller._setpoint.rates[0, 0]
    return np.array([c * x - s * y, s * x + c * y, z])


READ = {
    ("reference", "up"): lambda vec: vec.reference.command[0, 0, 2] - vec.task.goal.slots[0, 0, 2],
    ("reference", "yaw"): lambda vec: vec.reference.command_yaw[0, 0] - vec.task.goal.yaw[0],
    ("velocity", "up"): lambda vec: vec.controller._setpoint.velocity[0, 0, 2],
    ("velocity", "yaw_rate"): lambda vec: vec.reference.yaw_rate[0, 0],
    ("acceleration", "up"): lambda vec: vec.reference.acceleration[0, 0, 2],
    ("acc_rates", "sideways_rate"): lambda vec: slot_body_rates(vec)[1],
    ("full_state", "jerk_up"): lambda vec: vec.reference.jerk[0, 0, 2],
    ("full_state", "force_up"): lambda vec: (
        (vec.controller._setpoint.cable_force - vec.task.goal.cable_force)[0, 0, 2]
        / np.linalg.norm(vec.task.goal.cable_force[0, 0])
    ),
    ("ctbr", "thrust"): lambda vec: vec.controller._setpoint.thrust[0, 0],
    ("ctbr", "outward_rate"): lambda vec: slot_body_rates(vec)[0],
    ("ctbr", "yaw_rate"): lambda vec: vec.controller._setpoint.rates[0, 0, 2],
    ("ctbm", "thrust"): lambda vec: vec.controller._setpoint.thrust[0, 0],
    ("rotor", "rotor_2"): lambda vec: vec.world.thrust[0, 0, 2],
}
FEW = (
    ("reference", "up"),
    ("reference", "yaw"),
    ("acc_rates", "sideways_rate"),
    ("ctbr", "thrust"),
    ("rotor", "rotor_2"),
)


def test_the_contract_says_what_a_one_stands_for():
    other = {"env.units": "cable", "cable.length": 0.5}
    told = make_contract(policy(**other))["observation"]
    scaled, plain = make(num_envs=4, **other), make(num_envs=4, **other | {"env.units": "si"})
    flown = []
    for vec in (scaled, plain):
        vec.reset(seed=0)
        for _ in range(10):
            seen, *_ = vec.step(np.zeros((4, 4, vec.action_size)))
        flown.append(dict(zip(vec.observation_names, seen.T, strict=True)))
    observed, expected = flown
    assert told["units"] == "cable"
    sizes = {}
    for part in told["components"]:
        for name in told["names"][part["first"] :][: part["size"]]:
            if part["name"] == "rig":
                assert part["unit_size"] == 1
                continue
            np.testing.assert_allclose(observed[name] * part["unit_size"], expected[name], rtol=1e-5, atol=1e-6)
            if np.abs(expected[name]).max() > 1e-4:
                sizes[part["unit"]] = part["unit_size"]
    assert sizes == pytest.approx({
        "m": 0.5, "m/s": 0.5**0.5, "m s": 0.5**1.5, "rad/s": 0.5**-0.5, "rad s": 0.5**0.5, "rad": 1, "-": 1
    })  # fmt: skip


@pytest.mark.parametrize("most", [100.0, 50.0])
def test_the_contract_says_that_weights_of_a_planner_are_factors(most):
    told = make_contract(policy("track", **{"control.action": "planner_weights", "control.max_weight": most}))["action"]
    assert len(told["numbers"]) == 13
    for number in told["numbers"]:
        ends = [number[f"at_{end}"] for end in ("minus_one", "zero", "one")]
        assert ends == pytest.approx([1 / most, 1.0, most], rel=1e-12)
        assert number["scale"] == "exponential" and "factor" in number["meaning"]
    others = make_contract(policy(**{"control.action": "ctbr"}))["action"]["numbers"]
    assert {number["scale"] for number in others} == {"linear"}


@pytest.mark.parametrize("units", ["si", pytest.param("cable", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("interface", "name"), [one if one in FEW else slow(*one) for one in READ])
def test_full_actions_are_what_the_contract_says(interface, name, units):
    other = {
        "env.units": units,
        "cable.length": 0.8,
        "control.action": interface,
        "control.max_offset": 0.3,
        "control.max_tilt_rate": 3.5,
        "cable.hook": [0.03, 0, 0],
    }
    numbers = make_contract(policy(**other))["action"]["numbers"]
    (number,) = [number for number in numbers if number["name"] == name]
    vec = make(num_envs=1, **other)
    for value, key in ((-1.0, "at_minus_one"), (0.0, "at_zero"), (1.0, "at_one")):
        vec.reset(seed=0)
        action = np.zeros((1, 4, vec.action_size))
        action[..., vec.action_names.index(name)] = value
        vec.step(action)
        said = number[key][0] if number["unit"] == "N" else number[key]
        assert READ[interface, name](vec) == pytest.approx(
            said, rel=1e-9 if number["frame"] != "slot body" else 1e-3, abs=1e-12
        ), key


def test_a_contract_that_this_version_cannot_keep_is_not_written():
    old = checkpoint()
    old["observation_names"][3] = "speed_0"
    with pytest.raises(CheckpointError, match=r"the test was trained with other observations .*; train again"):
        make_contract(LearnedPolicy(old, "the test"))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    """Return the folder of a policy that the command exported, in a process of its own, with nothing to complain."""
    folder = tmp_path_factory.mktemp("home")
    save_checkpoint(folder / "mine.pt", checkpoint())
    command = [sys.executable, "-W", "default", "-m", "multilift_marl.export", "run=mine.pt"]
    path = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, env=os.environ | path)
    assert done.returncode == 0 and done.stderr == "", done.stderr
    assert "mine.pt: hover, 50 numbers to 4 for each drone, 50 times a second\nwrote export/policy.onnx" in done.stdout
    return folder / "export"


def fly(folder):
    """Fly an exported policy by the example, where there is no torch."""
    example = str(ROOT / "examples" / "fly_exported.py")
    code = (
        f"import runpy, sys; sys.modules['torch'] = None; sys.argv = [{example!r}, {str(folder)!r}, '2']; "
        f"runpy.run_path({example!r}, run_name='__main__')"
    )
    path = {"PYTHONPATH": os.pathsep.join([str(ROOT), os.environ.get("PYTHONPATH", "")])}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, env=os.environ | path
    )


@pytest.mark.slow
def test_the_example_flies_without_torch(exported):
    done = fly(exported)
    assert done.stdout.startswith("hover: 2 episodes, success ") and done.stdout.endswith(" cm\n"), done.stderr
    assert len((ROOT / "examples" / "fly_exported.py").read_text().splitlines()) < 100


@pytest.mark.slow
def test_the_example_refuses_another_order_of_observations(exported, tmp_path):
    contract = json.loads((exported / "policy.json").read_text())
    names = contract["observation"]["names"]
    names[0], names[1] = names[1], names[0]
    (tmp_path / "policy.json").write_text(json.dumps(contract))
    (tmp_path / "policy.onnx").write_bytes((exported / "policy.onnx").read_bytes())
    expected = "error: observation 0 is slot_error_0, but slot_error_1 in the contract; export anew\n"
    assert fly(tmp_path).stderr == expected


@pytest.mark.slow
def test_the_operator_set_is_stated_and_can_be_an_older_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    save_checkpoint(tmp_path / "mine.pt", checkpoint())
    usual = export_policy(policy(), tmp_path / "usual")["network"]
    older = usual["opset"] - 1
    assert export(["run=mine.pt", "out=old", f"opset={older}"]) == 0
    made = json.loads((tmp_path / "old" / "policy.json").read_text())["network"]
    for stated, folder in ((usual, "usual"), (made, "old")):
        model = onnx.load(str(tmp_path / folder / "policy.onnx"))
        assert (stated["opset"], stated["ir_version"]) == (model.opset_import[0].version, model.ir_version)
        assert stated["ir_version"] == onnx.helper.find_min_ir_version_for(model.opset_import)
    assert made["opset"] == older and made["largest_difference"] <= 1e-5
    assert export(["run=mine.pt", "out=oldest", "opset=7"]) == 2
    assert capsys.readouterr().err.startswith("error: the network cannot be expressed by opset=7 of ONNX, only by ")
    assert not (tmp_path / "oldest" / "policy.onnx").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda model: setattr(model, "ir_version", 99), "has IR version 99 of ONNX, and onnxruntime"),
        (lambda model: setattr(model.opset_import[0], "version", 99), "has opset 99 of ONNX, and onnxruntime"),
    ],
)
def test_a_network_that_is_too_new_names_the_limit_and_the_cure(tmp_path, change, words):
    export_policy(policy(), tmp_path)
    model = onnx.load(str(tmp_path / "policy.onnx"))
    change(model)
    onnx.save(model, str(tmp_path / "policy.onnx"))
    with pytest.raises(CheckpointError, match=rf"{words} [\d.]+ reads up to \d+; upgrade onnxruntime, or .* opset=18$"):
        load_policy(tmp_path / "policy.onnx")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rn=hover"], "unknown key 'rn'; did you mean 'run'?"),
        (["run=hover", "payload.mass=1"], "a trained policy keeps its configuration: leave out payload.mass"),
        (["run=nowhere"], "no run folder nowhere: give the path of one, such as runs/<name>, or 'latest'\n"),
        (
            ["run=hovr"],
            "no run folder hovr: give the path of one, such as runs/<name>, or 'latest'; did you mean 'hover'?",
        ),
        (["run=mine.pt", "opset=3"], "opset must be from 7 to 100, but is 3"),
        (["run=mine.pt", "opset=new"], "opset must be a whole number, but is 'new'"),
        ([], "no run with a checkpoint in runs/: train one first"),
        (["run=text.pt"], "text.pt is truncated or no checkpoint at all"),
        (["run=mine.pt", "out=text.pt"], "cannot write into text.pt (File exists); give another folder by out="),
    ],
)
def test_errors_are_one_sentence(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "text.pt").write_text("no checkpoint")
    save_checkpoint(tmp_path / "mine.pt", checkpoint())
    assert export(arguments) == 2
    shown = capsys.readouterr().err
    assert shown.startswith(f"error: {message}") and shown.count("\n") == 1


def test_a_missing_extra_is_named(monkeypatch, capsys):
    monkeypatch.delitem(sys.modules, "multilift_marl.agents.export", raising=False)
    monkeypatch.setitem(sys.modules, "onnxscript", None)
    assert export(["run=hover"]) == 2
    assert capsys.readouterr().err == f"error: onnxscript is missing; {pip_install('export')}\n"


def test_a_contract_says_what_margins_the_drones_keep_beside_the_network():
    told = make_contract(policy("navigate_senses", **{"train.observe": None}))["action"]
    assert told["margins"] == {"drone": 0.4, "payload": 0.5, "sector": 0.1}
    assert "margins" not in make_contract(policy())["action"]


def test_a_contract_says_by_how_much_set_points_move_with_the_swing():
    told = make_contract(policy(**{"env.num_drones": 2, "control.swing_shift": 0.06}))["action"]
    assert told["swing_shift"] == 0.06 and "swing_shift" not in make_contract(policy())["action"]
