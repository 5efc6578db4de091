"""Files that a configuration names run where the user names them, or trusts: no stranger's policy brings code along."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
from conftest import SMALL, refusal

import multilift_marl as ml
from multilift_marl import _ray, plugins
from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint
from multilift_marl.agents.trainer import new_run
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.cli.export import main as export
from multilift_marl.cli.train import main as train
from multilift_marl.config.load import build_config, load_config
from multilift_marl.deploy.ros.__main__ import main as ros
from multilift_marl.errors import CheckpointError, ConfigError
from multilift_marl.trust import review
from multilift_marl.viewer.__main__ import make_session

SHIPPED = Path(plugins.__file__).parent / "policies" / "hover.pt"
SHORT = ["episodes=1", "env.episode_seconds=0.1", "env.num_threads=1", "baseline=none"]
HELPER = """
from pathlib import Path
import numpy as np
Path({mark!r}).write_text("ran")

class Zero:
    def __init__(self, vec):
        self.size = vec.action_size, vec.observation_size
    def matrix(self):
        return np.zeros(self.size, np.float32)
    def act(self, observation):
        return np.zeros((*observation.shape[:-1], self.size[0]))
    def reset(self, mask):
        pass
"""


@pytest.fixture
def stranger(tmp_path, monkeypatch, registries):
    """Return a stranger's folder, in which helper.py leaves the file `ran` when it runs; be elsewhere."""
    folder, here = tmp_path / "theirs", tmp_path / "here"
    folder.mkdir()
    here.mkdir()
    (folder / "helper.py").write_text(HELPER.format(mark=str(folder / "ran")))
    monkeypatch.chdir(here)
    return folder


def save_policy(folder, change):
    """Return a stranger's checkpoint, whose stored configuration has `change`."""
    content = load_checkpoint(SHIPPED)
    build = content["config"]
    for dotted, value in change.items():
        *sections, key = dotted.split(".")
        place = build
        for section in sections:
            place = place.setdefault(section, {})
        place[key] = value
    save_checkpoint(folder / "policy.pt", content)
    return folder / "policy.pt"


def spellings(folder, here):
    """Return ways to write the same file, and others that could be found as one."""
    (here / "link.py").symlink_to(folder / "helper.py")
    return [str(folder / "helper.py"), "../theirs/helper.py", f"{here}/../theirs/helper.py", "link.py", "link"]


def test_a_strangers_policy_does_not_run_what_it_names(stranger, tmp_path):
    for reference in spellings(stranger, tmp_path / "here"):
        for change in (
            {"import": [reference]},
            {"train.overrides": {"import": reference}},
            {"train.rigs": [{"import": [reference]}]},
        ):
            policy = save_policy(stranger, change)
            message = refusal(ml.load_policy, policy)
            assert message.startswith(f"{policy} has import={reference}, which was not run: ")
            assert message.endswith(
                f"name it yourself by import={reference}, or give trust=true; in Python import it first, or use "
                "load_config or load_policy(..., trust=True)"
            )
            assert not (stranger / "ran").exists()


@pytest.mark.parametrize("name", ["helper", "antigravity", "this.that"])
def test_a_module_by_name_is_not_run_from_the_folder_nor_from_python(stranger, monkeypatch, name):
    monkeypatch.chdir(stranger)
    sys.modules.pop(name, None)
    assert f"has import={name}, which was not run" in refusal(ml.load_policy, save_policy(stranger, {"import": [name]}))
    assert not (stranger / "ran").exists() and name not in sys.modules


def test_what_the_user_names_or_trusts_runs(stranger, capsys):
    policy = save_policy(stranger, {"import": [str(stranger / "helper.py")]})
    assert evaluate([f"policy={policy}", *SHORT]) == 2
    assert "which was not run" in capsys.readouterr().err
    assert evaluate([f"policy={policy}", *SHORT, "trust=false"]) == 2
    assert not (stranger / "ran").exists()
    assert evaluate([f"policy={policy}", *SHORT, "trust=true"]) == 0
    (stranger / "ran").unlink()
    plugins.named.clear()
    del sys.modules["helper"]
    assert evaluate([f"policy={policy}", f"import={stranger / 'helper.py'}", *SHORT]) == 0
    assert (stranger / "ran").exists()


def test_in_python_a_policy_is_trusted_or_its_module_imported_before(stranger, monkeypatch):
    policy = save_policy(stranger, {"import": [str(stranger / "helper.py")]})
    refusal(ml.load_policy, policy)
    monkeypatch.syspath_prepend(stranger)
    import helper  # noqa: F401

    assert ml.load_policy(policy).config.task == "hover"
    del sys.modules["helper"]
    (stranger / "ran").unlink()
    assert ml.load_policy(policy, trust=True).config.task == "hover" and (stranger / "ran").exists()


def test_trust_ends_with_the_call_and_counts_for_what_was_named_there_alone(stranger):
    other = stranger / "other.py"
    other.write_text((stranger / "helper.py").read_text())
    ml.load_policy(save_policy(stranger, {"import": [str(stranger / "helper.py")]}), trust=True)
    ml.load_policy(save_policy(stranger, {"import": [str(stranger / "helper.py")]}))
    assert "other.py, which was not run" in refusal(ml.load_policy, save_policy(stranger, {"import": [str(other)]}))


@pytest.mark.slow
def test_an_exported_policy_does_not_run_what_its_contract_names(stranger, capsys):
    pytest.importorskip("onnxruntime")
    assert export(["run=hover", f"out={stranger}"]) == 0
    contract = json.loads((stranger / "policy.json").read_text())
    contract["config"]["import"] = [str(stranger / "helper.py")]
    (stranger / "policy.json").write_text(json.dumps(contract))
    policy = stranger / "policy.onnx"
    sentence = f"{policy} has import={stranger / 'helper.py'}, which was not run"
    assert refusal(ml.load_policy, policy).startswith(sentence)
    assert refusal(make_session, {"policy": str(policy)}).startswith(sentence)
    for command, arguments in ((evaluate, [*SHORT]), (ros, ["role=policy", "seconds=0.1"])):
        capsys.readouterr()
        assert command([f"policy={policy}", *arguments]) == 2
        assert capsys.readouterr().err.startswith(f"error: {sentence}")
    assert not (stranger / "ran").exists()


def test_a_strangers_run_does_not_run_what_it_names_and_goes_on_where_it_is_trusted(stranger, capsys):
    residual = f"{stranger / 'helper.py'}:Zero"
    values = SMALL | {"train.frames": 128, "eval.episodes": 1, "train.residual": residual}
    trainer = new_run(load_config("hover", values), "theirs", stranger)
    trainer.save("last")
    run = trainer.folder
    (stranger / "ran").unlink()
    plugins.named.clear()
    del sys.modules["helper"]
    ml.load_policy(run)  # a trained network needs no class
    capsys.readouterr()
    assert train([f"resume={run}"]) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {run / 'checkpoints' / 'last.pt'} has train.residual={residual}, which was not")
    assert f"import={stranger / 'helper.py'}, or give trust=true" in error
    assert train([f"config={run / 'config.yaml'}"]) == 2
    assert f"{run / 'config.yaml'} has train.residual={residual}" in capsys.readouterr().err
    assert f"has train.residual={residual}" in refusal(lambda: new_run(ml.load_policy(run).config, "mine", run))
    assert not (stranger / "ran").exists()
    assert train([f"resume={run}", "trust=true"]) == 0
    assert (stranger / "ran").exists()
    assert f"resume={run} import={stranger / 'helper.py'} train.frames=" in train_again(run, capsys)


def train_again(run, capsys):
    """Return what the command says of a finished run."""
    capsys.readouterr()
    assert train([f"resume={run}"]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("key, own", [("train.residual", {}), ("train.dagger.teacher", {"train.algorithm": "dagger"})])
def test_a_class_that_is_not_the_users_is_not_called_though_it_is_imported(stranger, key, own):
    policy = save_policy(stranger, own | {key: "os:system"})
    config = ml.load_policy(policy).config
    message = refusal(lambda: new_run(config, "mine", stranger))
    assert message.startswith(f"{policy} has {key}=os:system, which was not run")


@pytest.mark.parametrize("base", [False, True])
def test_a_strangers_yaml_does_not_run_what_it_names(stranger, base):
    (stranger / "rig.yaml").write_text("import: helper\npayload: {mass: 1.1}")
    (stranger / "over.yaml").write_text("base: rig.yaml")
    file = stranger / ("over.yaml" if base else "rig.yaml")
    assert refusal(load_config, file).startswith(f"{stranger / 'rig.yaml'} has import={stranger / 'helper.py'}, which")
    assert refusal(ml.register_config, "rigs/theirs", file).startswith(f"{stranger / 'rig.yaml'} has import=")
    assert not (stranger / "ran").exists()
    assert load_config(file, {"import": str(stranger / "helper.py")}).payload.mass == 1.1
    assert load_config(file).payload.mass == 1.1  # named once
    plugins.named.clear()
    assert load_config(file, trust=True).payload.mass == 1.1


def test_a_vehicles_file_runs_nothing(stranger):
    (stranger / "heavy.yaml").write_text("import: helper\nmass: 0.7")
    message = refusal(lambda: load_config("hover", {"vehicle.preset": str(stranger / "heavy.yaml")}).system)
    assert message.startswith("unknown key 'vehicle.import'") and not (stranger / "ran").exists()


def test_installed_plugins_stay(stranger, monkeypatch):
    site = stranger / "site"
    (site / "kit_lift").mkdir(parents=True)
    (site / "kit_lift" / "__init__.py").write_text("")
    (site / "kit_lift" / "fleet.py").write_text("import multilift_marl as ml\nml.register_vehicle('kit', mass=0.8)\n")
    info = site / "kit_lift-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: kit-lift\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[multilift_marl.tasks]\nfleet = kit_lift.fleet\n")
    monkeypatch.syspath_prepend(site)
    policy = save_policy(stranger, {"import": ["kit_lift.fleet"], "vehicle.preset": "kit"})
    assert ml.load_policy(policy).config.system.vehicle.mass == 0.8
    del sys.modules["kit_lift.fleet"], sys.modules["kit_lift"]
    plugins.named.clear()
    (Path.cwd() / "kit_lift").mkdir()
    (Path.cwd() / "kit_lift" / "__init__.py").write_text("raise SystemExit('not the installed one')")
    assert "has import=kit_lift.fleet, which was not run" in refusal(ml.load_policy, policy)


@pytest.mark.filterwarnings("ignore")  # of torch, at TorchScript
def test_torchscript_and_pickled_code_are_no_checkpoints(stranger):
    torch = pytest.importorskip("torch")

    class Evil:
        def __reduce__(self):
            return (exec, (f"open({str(stranger / 'ran')!r}, 'w')",))

    torch.jit.script(torch.nn.Linear(1, 1)).save(str(stranger / "script.pt"))
    torch.save({"format": "multilift_marl checkpoint 1", "config": Evil()}, stranger / "pickle.pt")
    for name in ("script", "pickle"):
        with pytest.raises(CheckpointError, match="holds more than tensors and numbers"):
            load_checkpoint(stranger / f"{name}.pt")
    assert not (stranger / "ran").exists()


def test_a_configuration_of_the_users_own_code_is_his(stranger):
    values = {"train": {"residual": f"{stranger / 'helper.py'}:Zero"}, "import": [str(stranger / "helper.py")]}
    assert build_config(values).train.residual.endswith(":Zero") and (stranger / "ran").exists()


def test_names_that_cannot_be_paths_are_told(stranger):
    for reference in ("~nobody-there/helper.py", "a\0b.py", "~\0/x.py", f"{'x' * 5000}.py"):
        assert "is missing; put the file back" in refusal(load_config, "hover", {"import": reference})
        assert "is missing; put the file back" in refusal(
            ml.load_policy, save_policy(stranger, {"import": [reference]})
        )
        assert ml.load_policy(save_policy(stranger, {"train.residual": f"{reference}:Zero"})).config.task == "hover"


@pytest.fixture
def joined(monkeypatch):
    """Return the addresses of the clusters that would be joined; none is."""
    addresses = []

    def connect(address, workers, key):
        addresses.append(address)
        raise ConfigError(f"would join {address}")

    monkeypatch.setattr(_ray, "connect", connect)
    return addresses


def test_a_strangers_run_does_not_choose_the_cluster_that_is_joined(stranger, capsys, joined):
    trainer = new_run(load_config("hover", SMALL), "theirs", stranger)
    trainer.save("last")
    last = trainer.folder / "checkpoints" / "last.pt"
    content = load_checkpoint(last)
    content["config"]["train"] |= {"ray": "10.1.2.3:6379"}
    save_checkpoint(last, content)
    resume = [f"resume={trainer.folder}", "train.workers=1"]
    sentence = f"{last} has train.ray=10.1.2.3:6379, which was not joined: what workers there return may be anybody's"
    assert train(resume) == 2 and joined == []
    error = capsys.readouterr().err
    assert error.startswith(f"error: {sentence}")
    assert error.endswith("name it yourself by train.ray=10.1.2.3:6379, or give trust=true\n")
    config = ml.load_policy(last).config  # its policy flies
    assert refusal(lambda: new_run(ml.make_vec(config, **{"train.workers": 1}).config, "mine")).startswith(sentence)
    assert train([*resume, "train.ray=local"]) == 2 and joined == ["local"]
    assert train([*resume, "trust=true"]) == 2 and joined == ["local", "10.1.2.3:6379"]
    plugins.named.clear()
    assert train([*resume, "train.ray=10.1.2.3:6379"]) == 2 and joined[2:] == ["10.1.2.3:6379"]
    assert train(resume) == 2 and joined[3:] == ["10.1.2.3:6379"]  # named once


@pytest.mark.parametrize("base", [False, True])
def test_a_strangers_yaml_does_not_choose_the_cluster_that_is_joined(stranger, base, joined):
    (stranger / "rig.yaml").write_text("train: {ray: '10.4.5.6:6379'}")
    (stranger / "over.yaml").write_text("base: rig.yaml\ntrain: {workers: 1}")
    file = stranger / ("over.yaml" if base else "rig.yaml")
    values = SMALL | {"train.workers": 1}
    message = refusal(lambda: new_run(load_config(file, values), "mine"))
    assert (
        message.startswith(f"{stranger / 'rig.yaml'} has train.ray=10.4.5.6:6379, which was not joined") and not joined
    )
    for more, trust in ({"train": {"ray": "10.4.5.6:6379"}}, False), ({}, True):
        plugins.named.clear()
        config = load_config(file, values | more, trust=trust)
        assert refusal(new_run, config, "mine") == "would join 10.4.5.6:6379"


@pytest.mark.slow
def test_the_policy_of_a_stranger_runs_nothing_in_a_process_of_its_own(stranger):
    policy = save_policy(stranger, {"import": [str(stranger / "helper.py")]})
    code = "from multilift_marl.cli.evaluate import main; raise SystemExit(main())"
    done = subprocess.run(
        [sys.executable, "-c", code, f"policy={policy}", *SHORT], capture_output=True, text=True, cwd=stranger
    )
    assert done.returncode == 2 and done.stderr.count("\n") == 1 and "which was not run" in done.stderr
    assert not (stranger / "ran").exists()


@pytest.mark.parametrize(
    "key, make_value",
    [
        ("import", lambda code: {code}),
        ("import", lambda code: [code.encode()]),
        ("import", lambda code: code.encode()),
        ("train.residual", lambda code: f"{code}:Zero".encode()),
        ("train.ray", lambda code: b"10.1.2.3:6379"),
        ("train.overrides", lambda code: {b"import": code}),
        ("train.rigs", lambda code: [{"import": {code}}]),
        ("train.dagger.teacher", lambda code: f"{code}:Zero".encode()),
    ],
)
def test_what_no_configuration_holds_is_refused_before_anything_runs(stranger, key, make_value):
    policy = save_policy(stranger, {key: make_value(str(stranger / "helper.py"))})
    with pytest.raises(CheckpointError) as caught:
        config = ml.load_policy(policy).config
        build_config(config.model_dump(), {"env.num_envs": 1})  # as commands do
    assert str(caught.value).startswith(f"{policy} holds no policy (config.{key}")
    assert not (stranger / "ran").exists()


def test_review_refuses_what_it_does_not_know():
    endless: dict = {}
    endless["reward"] = endless
    for values, words in (
        ({"import": {"a.py"}}, "config.import is of type set"),
        ({"train": {"ray": b"host:1"}}, "config.train.ray is of type bytes"),
        ({"train": {b"ray": "host:1"}}, "config.train has the key b'ray', which is no text"),
        ({"import": [type("Text", (str,), {})("a.py")]}, "config.import.0 is of type Text"),
        (endless, "config is nested more than 30 deep"),
    ):
        assert words in refusal(review, values, "a.pt")
    review({"payload": {"mass": 1.0, "shape": None, "anchors": ((0, 1),)}, "sim": {"contact": True}}, "a.pt")
