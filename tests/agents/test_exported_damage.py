"""Exported policies whose contract or network is not what it should be: one sentence, before anything flies."""

from __future__ import annotations

import hashlib
import json
import os
from pathlib import Path

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

import multilift_marl as ml
from multilift_marl._files import write_together
from multilift_marl.agents.contract import CONTRACT_FORMAT
from multilift_marl.agents.policy import ExportedPolicy
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.config.load import load_config
from multilift_marl.errors import CheckpointError, ConfigError
from multilift_marl.mdp.observations import observation_names
from multilift_marl.tasks import find_task

FLOAT, DOUBLE = TensorProto.FLOAT, TensorProto.DOUBLE
CONFIG = load_config("hover", {"env.num_drones": 2, "payload.mass": 0.7, "env.episode_seconds": 0.4})
NAMES = list(observation_names(CONFIG.control.action, find_task("hover").extra(CONFIG)))
ACTIONS = ["outward", "sideways", "up", "yaw"]
D, A, H = len(NAMES), 4, 3
WEIGHT = np.random.default_rng(0).normal(0, 0.02, (D, A)).astype(np.float32)


def contract(**changes) -> dict:
    """Return a contract of what `network` makes; changes are fields by dotted name."""
    made = {
        "format": CONTRACT_FORMAT,
        "network": {"file": "policy.onnx", "input": "observation", "output": "action", "memory": None, "opset": 18},
        "observation": {"names": NAMES},
        "action": {"numbers": [{"name": name} for name in ACTIONS]},
        "config": CONFIG.model_dump(mode="json"),
    }
    for path, value in changes.items():
        *parents, last = path.split(".")
        part = made
        for name in parents:
            part = part[name]
        part[last] = value
    return made


def network(
    nodes=None, weight=WEIGHT, given="observation", out="action", shape=("batch", "drones", D), kind=FLOAT, width=A,
    further=(), returned=(),
) -> bytes:  # fmt: skip
    """Return an ONNX network: action = tanh(observation W), or what is asked for in its place."""
    nodes = nodes or [helper.make_node("MatMul", [given, "w"], ["x"]), helper.make_node("Tanh", ["x"], [out])]
    graph = helper.make_graph(
        nodes, "policy",
        [helper.make_tensor_value_info(given, kind, shape), *further],
        [helper.make_tensor_value_info(out, kind, None if width is None else ("batch", "drones", width)), *returned],
        [numpy_helper.from_array(weight, "w")],
    )  # fmt: skip
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=9).SerializeToString()


def write(folder: Path, model: bytes | None = None, described=None) -> Path:
    (folder / "policy.onnx").write_bytes(network() if model is None else model)
    text = described if isinstance(described, str) else json.dumps(contract() if described is None else described)
    (folder / "policy.json").write_text(text)
    return folder / "policy.onnx"


def test_a_sound_one_flies(tmp_path):
    policy = ml.load_policy(write(tmp_path))
    observation = np.random.default_rng(1).normal(size=(3, 2, D)).astype(np.float32)
    np.testing.assert_allclose(policy.act(observation), np.tanh(observation @ WEIGHT), atol=1e-6)
    vec = ml.make_vec(CONFIG)
    assert tuple(NAMES) == vec.observation_names and tuple(ACTIONS) == vec.action_names


CONTRACTS = {
    "no config": ({"config": None}, "config: Input should be a valid dictionary"),
    "config in a list": ({"config": []}, "config: Input should be a valid dictionary"),
    "names are one word": ({"observation.names": "abc"}, "observation.names: Input should be a valid list"),
    "names are numbers": ({"observation.names": [1.5] * D}, "observation.names.0: Input should be a valid string"),
    "no names": ({"observation.names": []}, "observation.names: List should have at least 1 item"),
    "no numbers": ({"action.numbers": None}, "action.numbers: Input should be a valid list"),
    "numbers without names": ({"action.numbers": [{}] * 4}, "action.numbers.0.name: Field required"),
    "numbers are names": ({"action.numbers": ACTIONS}, "action.numbers.0: Input should be a valid dictionary"),
    "no network": ({"network": 3}, "network: Input should be a valid dictionary"),
    "memory is a number": ({"network.memory": 3}, "network.memory: Input should be a valid dictionary"),
    "memory of a word": (
        {"network.memory": {"input": "m", "output": "n", "size": "3"}}, "network.memory.size: Input should be",
    ),
    "observation is nothing": ({"observation": None}, "observation: Input should be a valid dictionary"),
    "other names": ({"network.input": "obs"}, "takes observation, but its contract says obs"),
    "other output": ({"network.output": "act"}, "returns action, but its contract says act"),
    "fewer observations": (
        {"observation.names": NAMES[:-1]}, rf"shape \['batch', 'drones', {D}\], but its contract says float32 and "
        rf"\(batch, drones, {D - 1}\)",
    ),
    "more actions": ({"action.numbers": [{"name": name} for name in "abcde"]}, r"and \(batch, drones, 5\)"),
    "memory that the network lacks": (
        {"network.memory": {"input": "m", "output": "n", "size": H}}, "a memory of 3 numbers, its contract train.gru=0",
    ),
    "memory that the contract lacks": ({"config": CONFIG.model_dump(mode="json") | {
        "train": CONFIG.train.model_dump(mode="json") | {"gru": 4}}}, "a memory of 0 numbers, its contract"),
}  # fmt: skip


@pytest.mark.parametrize("case", CONTRACTS)
def test_a_contract_that_is_wrong_is_one_sentence(case, tmp_path):
    changes, words = CONTRACTS[case]
    with pytest.raises(CheckpointError, match=words) as error:
        ml.load_policy(write(tmp_path, described=contract(**changes)))
    assert "\n" not in str(error.value) and str(error.value).endswith("run=<run>")


@pytest.mark.parametrize("text", ["[" * 100_000, '{"a": ' * 100_000, "\x00", "[]", "null", '"text"', "NaN", "1e999"])
def test_text_that_is_no_contract_is_one_sentence(text, tmp_path):
    with pytest.raises(CheckpointError, match=r"policy\.json (is no contract|was not written)") as error:
        ml.load_policy(write(tmp_path, described=text))
    assert "\n" not in str(error.value)


def value_of(name, kind=FLOAT, shape=("batch", "drones", H)):
    return helper.make_tensor_value_info(name, kind, shape)


def nodes_of(*described) -> list:
    return [helper.make_node(kind, given, made, **rest) for kind, given, made, rest in described]


NETWORKS = {
    "a weight of NaN": (network(weight=np.where(np.arange(A) == 1, np.nan, WEIGHT).astype(np.float32)), "not finite"),
    "a division by zero": (
        network(nodes_of(("MatMul", ["observation", "w"], ["x"], {}), ("Reciprocal", ["x"], ["action"], {}))),
        "not finite",
    ),
    "a node that fails": (
        network(
            nodes_of(
                ("MatMul", ["observation", "w"], ["x"], {}),
                ("Constant", [], ["s"], {"value": numpy_helper.from_array(np.array([7, 7, 7]))}),
                ("Reshape", ["x", "s"], ["action"], {}),
            ),
            width=None,
        ),
        "shape|fails in onnxruntime",
    ),
    "a node that fails for some teams": (
        network(
            nodes_of(
                ("MatMul", ["observation", "w"], ["x"], {}),
                ("Constant", [], ["s"], {"value": numpy_helper.from_array(np.array([1, 1, A]))}),
                ("Reshape", ["x", "s"], ["action"], {}),
            )
        ),
        "fails in onnxruntime",
    ),
    "teams of one size": (network(shape=(2, 2, D)), "fails in onnxruntime"),
    "another width": (network(weight=WEIGHT[:, :3], width=3), r"shape \['batch', 'drones', 3\]"),
    "another width of input": (network(weight=WEIGHT[:7], shape=("b", "n", 7)), r"shape \['b', 'n', 7\]"),
    "double precision": (network(weight=WEIGHT.astype(float), kind=DOUBLE), r"type tensor\(double\)"),
    "two dimensions": (network(shape=("batch", D), width=None), "takes observation of type"),
    "another name": (network(given="obs"), "takes obs, but its contract says observation"),
    "another output": (network(out="mean"), "returns mean, but its contract says action"),
    "a further input": (network(further=[value_of("memory")]), "takes observation, memory, but"),
    "nothing": (b"", "is truncated or no ONNX network"),
    "rubbish": (b"\xff" * 1000, "is truncated or no ONNX network"),
}


@pytest.mark.parametrize("case", NETWORKS)
def test_a_network_that_is_wrong_is_one_sentence(case, tmp_path):
    model, words = NETWORKS[case]
    with pytest.raises(CheckpointError, match=words) as error:
        ml.load_policy(write(tmp_path, model))
    assert "\n" not in str(error.value) and str(error.value).startswith(str(tmp_path))


def test_a_network_of_another_export_than_its_contract_is_refused(tmp_path):
    digest = hashlib.sha256(network()).hexdigest()
    described = contract(**{"network.sha256": digest})
    assert ExportedPolicy(write(tmp_path, network(), described)).config.task == "hover"
    path = write(tmp_path, network(weight=2 * WEIGHT), described)
    with pytest.raises(CheckpointError) as caught:
        ml.load_policy(path)
    message = f"{path} and policy.json beside it are of different exports; export the policy again"
    assert str(caught.value).startswith(message)


def test_files_that_belong_together_are_renamed_when_all_are_written(tmp_path, monkeypatch):
    network_file, contract_file = tmp_path / "policy.onnx", tmp_path / "policy.json"
    write_together({network_file: b"old", contract_file: b"old"})
    fsync, calls = os.fsync, []

    def fail(file):
        calls.append(file)
        if len(calls) == 2:
            raise OSError("no space left")
        fsync(file)

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(OSError, match="no space left"):
        write_together({network_file: b"new", contract_file: b"new"})
    assert network_file.read_bytes() == contract_file.read_bytes() == b"old" and len(list(tmp_path.iterdir())) == 2


def test_a_network_that_fails_in_flight_is_one_sentence(tmp_path, capsys):
    """It has no action for some observations: 0 / 0 where the payload is off its target."""
    step = nodes_of(
        ("MatMul", ["observation", "w"], ["x"], {}),
        ("Sign", ["x"], ["s"], {}),
        ("Abs", ["s"], ["t"], {}),
        ("Sub", ["one", "t"], ["u"], {}),
        ("Div", ["u", "u"], ["action"], {}),
    )
    step.insert(0, helper.make_node("Constant", [], ["one"], value=numpy_helper.from_array(np.ones(1, np.float32))))
    path = write(tmp_path, network(step))
    policy = ml.load_policy(path)
    assert (policy.act(np.zeros((1, 2, D))) == 1).all()
    with pytest.raises(CheckpointError, match="returns action that is not finite"):
        policy.act(np.ones((1, 2, D)))
    with pytest.raises(ValueError, match="observes a number that is not finite"):
        policy.act(np.full((1, 2, D), np.nan))
    assert evaluate([f"policy={path}", "baseline=none", "episodes=1", f"out={tmp_path / 'out'}"]) == 2
    error = capsys.readouterr().err
    assert "returns action that is not finite" in error and error.count("\n") == 1


def test_contracts_that_are_damaged_anywhere_never_end_in_another_error(tmp_path):
    """Each of 300 has one part replaced by something of another type."""
    rng, others = np.random.default_rng(0), [None, 3, -1.5, "text", [], {}, [[]], {"a": 1}, True, "nan", [None], 10**30]
    path, outcomes = write(tmp_path), set()
    for _ in range(300):
        described = contract()
        part = described
        while True:
            keys = list(part) if isinstance(part, dict) else list(range(len(part)))
            key = keys[rng.integers(len(keys))]
            if not isinstance(part[key], dict | list) or not part[key] or rng.random() < 0.3:
                break
            part = part[key]
        part[key] = others[rng.integers(len(others))]
        write(tmp_path, described=described)
        try:
            ExportedPolicy(path)
            outcomes.add("flies")
        except (CheckpointError, ConfigError) as error:
            assert "\n" not in str(error), str(error)
            outcomes.add(type(error).__name__)
    assert outcomes == {"flies", "CheckpointError", "ConfigError"}
    assert onnx.load(path).graph.name == "policy"
