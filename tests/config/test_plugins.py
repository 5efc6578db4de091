"""Tasks, vehicles and policies of one's own: found by name, stored with a run, refused in one sentence."""

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from conftest import SMALL, make, refusal

import multilift_marl as ml
from multilift_marl import plugins
from multilift_marl.agents.checkpoint import load_checkpoint
from multilift_marl.agents.policy import ExportedPolicy
from multilift_marl.agents.trainer import new_run
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.cli.export import main as export
from multilift_marl.cli.train import main as train
from multilift_marl.config import load
from multilift_marl.config.load import build_config, load_config
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import CheckpointError
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.tasks import TASKS
from multilift_marl.tasks.hover import Hover
from multilift_marl.viewer.__main__ import make_session

ROOT = Path(__file__).parents[2]
PLUGIN = """
import numpy as np
import multilift_marl as ml
from multilift_marl.tasks.hover import Hover

@ml.register_task
class Near(Hover):
    name = "near"

ml.register_vehicle("heavy", preset="falcon", mass=0.7)

class Lean:
    def __init__(self, vec):
        self.count, self.size = np.zeros(vec.num_envs, int), vec.action_size
    def act(self, observation):
        self.count += 1
        return np.full((*observation.shape[:-1], self.size), 0.1)
    def reset(self, mask):
        self.count[mask] = 0
"""
SHORT = ["episodes=2", "env.episode_seconds=0.2", "env.num_threads=1"]


@pytest.fixture
def folder(tmp_path, monkeypatch, registries):
    """Enter a folder with a user's module `mine`."""
    (tmp_path / "mine.py").write_text(PLUGIN)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def arguments(values):
    return [f"{key}={value}" for key, value in values.items()]


# Modules


@pytest.mark.slow
def test_a_users_task_vehicle_and_policy_are_trained_and_judged_from_the_command_line(folder):
    small = SMALL | {"train.frames": 256, "eval.episodes": 2}
    assert train(["import=mine", "task=near", "vehicle.preset=heavy", *arguments(small)]) == 0
    run, elsewhere = next((folder / "runs").glob("near-*")), folder / "elsewhere"
    elsewhere.mkdir()
    command = [sys.executable, str(ROOT / "evaluate.py"), f"run={run}", f"baseline={folder / 'mine.py'}:Lean", *SHORT]
    done = subprocess.run(command, cwd=elsewhere, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    report = json.loads(next(run.glob("eval/*/metrics.json")).read_text())
    assert report["config"]["task"] == "near" and report["config"]["import"] == [str(folder / "mine.py")]
    assert {f"{folder / 'mine.py'}:Lean", "formation_integral"} <= set(report["baselines"])
    assert ml.load_policy(run).config.system.vehicle.mass == 0.7


@pytest.mark.slow
def test_a_run_says_which_module_it_misses_and_takes_it_from_where_it_is_now(folder, monkeypatch, capsys):
    config = load_config("hover", SMALL | {"import": "mine", "task": "near", "train.frames": 128, "eval.episodes": 1})
    trainer = new_run(config, "near", folder / "runs")
    trainer.save("last")
    run = trainer.folder
    (folder / "moved").mkdir()
    shutil.move(folder / "mine.py", folder / "moved" / "mine.py")
    for name in (TASKS, load.CONFIGS):
        del name["near"]
    del sys.modules["mine"]
    monkeypatch.setattr(plugins, "_imported", {})
    for command, extra in ((evaluate, SHORT), (train, []), (export, [])):
        key = "resume" if command is train else "run"
        capsys.readouterr()
        assert command([f"{key}={run}", *extra]) == 2
        message = f"error: import={folder / 'mine.py'} is missing; put the file back, or say where it is by import="
        assert capsys.readouterr().err.startswith(message)
    there = f"import={folder / 'moved' / 'mine.py'}"
    assert train([f"resume={run}", there]) == 0
    assert load_checkpoint(run / "checkpoints" / "last.pt")["config"]["import"] == [str(folder / "moved" / "mine.py")]
    assert evaluate([f"run={run}", there, "baseline=none", *SHORT]) == 0


def test_modules_come_by_name_by_file_and_from_packages_with_what_lies_beside_them(folder):
    package = folder / "kit"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "sizes.py").write_text("MASS = 0.8")
    (package / "fleet.py").write_text(
        "import multilift_marl as ml\nfrom . import sizes\nml.register_vehicle('kit', mass=sizes.MASS)"
    )
    (folder / "rig.yaml").write_text("import: mine\nvehicle: {preset: heavy}")
    for references, found in (
        ("mine", ["mine.py"]),
        (["mine", "mine.py", str(folder / "mine.py")], ["mine.py"]),
        ("kit.fleet", ["kit/fleet.py"]),
        (["kit/fleet.py", "mine"], ["kit/fleet.py", "mine.py"]),
        ("json", ["json"]),
    ):
        config = load_config("hover", {"import": references})
        assert list(getattr(config, "import")) == [
            str(folder / name) if name.endswith(".py") else name for name in found
        ]
    assert getattr(load_config("rig.yaml", {"import": "kit.fleet"}), "import") == tuple(
        str(folder / name) for name in ("mine.py", "kit/fleet.py")
    )
    assert build_config(config.model_dump()) == config


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ("def broken(:", r"import=broken.py cannot be imported: SyntaxError in broken.py, line 1 \(.+\)$"),
        ("\nimport nosuchlibrary", "ModuleNotFoundError in broken.py, line 2 .No module named 'nosuchlibrary'.$"),
        ("raise SystemExit(3)", "SystemExit in broken.py, line 1 .3.$"),
        (
            "import multilift_marl as ml\nml.register_vehicle('big', mas=1)",
            "ConfigError in broken.py, line 2 .unknown key 'vehicle.mas'; did you mean 'vehicle.mass'",
        ),
    ],
)
def test_a_module_that_fails_is_told_in_one_sentence(folder, capsys, source, message):
    (folder / "broken.py").write_text(source)
    assert train(["import=broken.py"]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert re.search(message, line), line


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        ({"import": "nosuch"}, "import=nosuch: there is no such module, neither in this folder nor installed"),
        ({"import": "nosuch.py"}, "import=nosuch.py is missing; put the file back"),
        ({"import": "json.py"}, "import=json.py has the name of another module"),
        ({"import": 3}, "import must be a"),
        ({"import": {"a": 1}}, "import must be a"),
    ],
)
def test_modules_that_cannot_be_are_refused(folder, overrides, message):
    if "another" in message:
        (folder / "json.py").write_text("")
    assert refusal(load_config, "hover", overrides).startswith(message)


def test_the_task_that_is_missing_tells_how_to_bring_it(folder):
    message = refusal(MultiliftVec, build_config({"task": "near"}))
    assert message.startswith("unknown task 'near'; known: ") and message.endswith("; one's own needs import=<module>")


# Registering


def test_what_is_registered_has_a_name_of_its_own(folder):
    class Nameless(Hover):
        name = 3

    class Gate(Hover):
        name = "gate"

    for call, message in (
        (lambda: ml.register_task(Nameless), "is no task that could be registered"),
        (lambda: ml.register_task(3), "3 is no task that could be registered"),
        (lambda: ml.register_task(Gate), "a task of one's own cannot have the name 'gate'"),
        (lambda: ml.register_vehicle("iris", mass=1.0), "a vehicle of one's own cannot have the name 'iris'"),
        (lambda: ml.register_vehicle("mine", mass=-1.0), "vehicle.mass must be greater than 0"),
        (lambda: ml.register_vehicle("mine", mass=9.0), "cannot lift itself"),
        (lambda: ml.register_config("hover", {}), "a configuration of one's own cannot have the name 'hover'"),
        (lambda: ml.register_config("mine", "no.yaml"), "no configuration file"),
    ):
        assert message in refusal(call)


def test_a_task_brings_its_configuration_under_its_name(folder):
    class Far(Hover):
        name = "far"

    (folder / "far.yaml").write_text("task: far\nenv: {episode_seconds: 3.0}")
    ml.register_task(Far, folder / "far.yaml")
    assert load_config("far").env.episode_seconds == 3.0
    assert load_config("rigs/falcon3", {"task": "far"}).env.model_dump() == (
        load_config("far", {"env.num_drones": 3}).env.model_dump()
    )
    ml.register_config("rigs/mine", {"env": {"num_drones": 2}})
    assert load_config("rigs/mine", {"task": "track"}).control == load_config("track").control


@pytest.mark.parametrize("form", ["mapping", "file"])
def test_a_tasks_configuration_is_of_that_task_without_saying_so_and_of_no_other(folder, form):
    class Far(Hover):
        name = "far"

    def source(values):
        (folder / "sub").mkdir(exist_ok=True)
        (folder / "sub" / "far.yaml").write_text(json.dumps(values))
        return values if form == "mapping" else "sub/far.yaml"

    (folder / "sub" / "heavy.yaml").parent.mkdir()
    (folder / "sub" / "heavy.yaml").write_text("payload: {mass: 2.0}")
    base = {"base": str(folder / "sub" / "heavy.yaml") if form == "mapping" else "heavy.yaml"}
    long = {"env": {"episode_seconds": 3.0}}
    for values, mass in ((long, None), (long | base, 2.0), (long | {"task": "far"} | base, 2.0)):
        ml.register_task(Far, source(values))
        config = load_config("far")
        assert (config.task, config.env.episode_seconds, config.payload.mass) == ("far", 3.0, mass)
    ml.register_task(Far, source(long | {"base": "track"}))
    config = load_config("far")
    assert (config.task, config.env.episode_seconds) == ("far", 3.0)
    assert config.train == build_config({}).train  # of a base with another task the system counts alone
    assert refusal(ml.register_task, Far, source(long | {"task": "hover"})).endswith(
        "is of task=hover, not of the task 'far' that it is registered with; leave out its key task"
    )
    assert load_config("far").env.episode_seconds == 3.0


# Vehicles


def test_a_vehicle_comes_from_a_file_alone_in_mixed_teams_and_beside_a_rig(folder):
    file = folder / "fleet" / "stout.yaml"
    file.parent.mkdir()
    file.write_text("preset: iris\nmass: 1.4\nrotor_azimuth: [45, 135, 225, 315]\n")
    named = ml.register_vehicle("stout", preset="iris", mass=1.4, rotor_azimuth=[45, 135, 225, 315])
    for preset in ("fleet/stout.yaml", str(file), "stout"):
        assert load_config("hover", {"vehicle.preset": preset}).system.vehicle == named
    team = load_config("hover", {"vehicle.preset": ["falcon", "fleet/stout.yaml"], "env.num_drones": 2}).system
    assert [vehicle.name for vehicle in team.vehicles] == ["falcon", "stout"]
    (folder / "fleet" / "rig.yaml").write_text("vehicle: {preset: stout.yaml, arm: 0.3}")
    vehicle = load_config("fleet/rig.yaml").system.vehicle
    assert (vehicle.mass, vehicle.arm, vehicle.name) == (1.4, 0.3, "stout")


def test_a_vehicles_file_that_is_missing_changed_or_wrong_is_told(folder):
    file = folder / "stout.yaml"
    file.write_text("mass: 0.7")
    config = load_config("hover", {"vehicle.preset": "stout.yaml"})
    file.write_text("mass: 0.8")
    assert "stout.yaml has changed since this configuration was made" in refusal(
        lambda: build_config(config.model_dump()).system
    )
    for content, message in (
        ("mas: 0.7", r"unknown key 'vehicle.mas' (in "),
        ("- 1", "holds list where fields of a vehicle, such as 'mass: 0.7', are expected"),
        ("preset: stout.yaml", "must be the name of a vehicle, not another file"),
        ("mass: 50", "cannot lift itself"),
    ):
        file.write_text(content)
        assert message in refusal(lambda: load_config("hover", {"vehicle.preset": "stout.yaml"}).system)
    assert "no.yaml is missing" in refusal(lambda: load_config("hover", {"vehicle.preset": "no.yaml"}).system)


# Policies


@pytest.mark.parametrize("action", ["reference", "rotor"])
def test_a_class_of_ones_own_flies_with_any_action_interface(folder, action):
    vec = make(num_envs=3, **{"control.action": action, "env.episode_seconds": 0.1})
    policy = make_scripted("mine:Lean", vec)
    observation, _ = vec.reset(seed=0)
    for _ in range(4):
        vec.step(policy.act(observation))
    policy.reset(np.array([False, True, False]))
    assert policy.policy.count.tolist() == [4, 0, 4]
    policy.reset()
    assert policy.policy.count.tolist() == [0, 0, 0]


def test_evaluation_and_viewer_fly_a_class_of_ones_own(folder):
    assert evaluate(["policy=mine:Lean", "control.action=acceleration", "baseline=none", *SHORT]) == 0
    report = json.loads(next(folder.glob("runs/mine.Lean-hover/eval/*/metrics.json")).read_text())
    assert report["config"]["control"]["action"] == "acceleration" and report["baselines"] == {}
    session, _ = make_session({"policy": "mine.py:Lean", "vehicle.preset": "heavy", "import": "mine"})
    assert session.policy == "mine.py:Lean" and {"formation", "mine.py:Lean"} <= set(session.policies)
    session.step()


@pytest.mark.parametrize(
    ("name", "source", "message"),
    [
        ("mine:Leen", "", "policy=mine:Leen: mine holds no class 'Leen'; did you mean 'Lean'?"),
        ("nosuch:Lean", "", "policy=nosuch: there is no such module"),
        ("other:", "", "policy=other: is not of the form module:Class"),
        (
            "other:P",
            "class P:\n    def __init__(self): pass",
            "policy other:P failed: TypeError (P.__init__() takes 1 ",
        ),
        ("other:P", "class P:\n    def __init__(self, vec): pass", "policy other:P has no method 'act'"),
        ("other:act", "return 0 * obs", "policy other:act.act must return finite floating point numbers (1, 4, 4)"),
        ("other:act", "return np.zeros((1, 4, 4), int)", "but returned int64 (1, 4, 4)"),
        ("other:act", "return np.full((1, 4, 4), np.nan)", "but returned some that are not finite"),
        ("other:act", "return obs[99]", "policy other:act.act failed: IndexError in other.py, line 4"),
    ],
)
def test_a_class_that_cannot_fly_is_told_in_one_sentence(folder, name, source, message):
    if name == "other:act":
        source = (
            f"import numpy as np\nclass act:\n    def __init__(self, vec): pass\n    def act(self, obs): {source}\n"
        )
        source += "    def reset(self, mask): pass\n"
    (folder / "other.py").write_text(source)
    vec = make(num_envs=1)
    observation, _ = vec.reset(seed=0)
    assert message in refusal(lambda: make_scripted(name, vec).act(observation))


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    pytest.importorskip("onnxruntime")
    out = tmp_path_factory.mktemp("export")
    assert export(["run=hover", f"out={out}"]) == 0
    return out / "policy.onnx"


@pytest.mark.slow
def test_an_exported_policy_flies_as_the_one_it_comes_from(exported, folder):
    policy, learned = ml.load_policy(exported), ml.load_policy("hover")
    config = load_config("hover", {"env.episode_seconds": 0.4, "env.num_threads": 1})
    flights = [run_episodes(config, each.bind, 3, seed=1)["return"] for each in (policy, learned)]
    np.testing.assert_allclose(*flights, atol=1e-4)
    assert policy.act(np.zeros((4, len(policy.observation_names)))).shape == (4, 4)
    assert policy.config == learned.config
    assert evaluate([f"policy={exported}", "baseline=hover", *SHORT]) == 0
    report = json.loads(next(folder.glob("runs/policy-hover/eval/*/metrics.json")).read_text())
    assert abs(report["paired"]["hover"]["return"]["mean"]) < 1e-3
    session, _ = make_session({"policy": str(exported)})
    assert session.policy == str(exported) and session.vec.task.name == "hover"


def test_an_exported_policy_that_does_not_fit_or_is_damaged_is_told(exported, folder, capsys):
    assert evaluate([f"policy={exported}", "config=track", "baseline=none", *SHORT]) == 2
    assert "was trained in task hover and cannot fly this track: number" in capsys.readouterr().err
    assert export([f"run={exported}"]) == 2
    assert "is exported already" in capsys.readouterr().err
    shutil.copy(exported, folder / "alone.onnx")
    shutil.copy(exported.with_suffix(".json"), folder / "torn.json")
    (folder / "torn.onnx").write_bytes(exported.read_bytes()[:1000])
    for name, message in (("no", "no exported policy"), ("alone", "no contract alone.json"), ("torn", "is truncated")):
        with pytest.raises(CheckpointError, match=message):
            ml.load_policy(folder / f"{name}.onnx")


def test_exported_policies_need_no_torch(exported):
    code = (
        f"import sys; sys.modules['torch'] = None\nfrom pathlib import Path\nimport {ExportedPolicy.__module__} as m\n"
    )
    code += f"print(m.ExportedPolicy(Path({str(exported)!r})).action_names[0])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "outward\n", done.stderr


@pytest.mark.parametrize("key", ["config", "task"])
def test_a_task_that_is_not_registered_is_named_where_it_is_asked_for(tmp_path, monkeypatch, capsys, registries, key):
    (tmp_path / "forgot.py").write_text(
        "from multilift_marl.tasks.hover import Hover\n\n\nclass Pole(Hover):\n    name = 'pole'\n"
    )
    monkeypatch.chdir(tmp_path)
    assert evaluate(["import=forgot.py", f"{key}=pole", "policy=formation"]) == 2
    assert "; class Pole of forgot.py is not registered: put @ml.register_task above it" in capsys.readouterr().err
