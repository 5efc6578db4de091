"""Training that starts from a policy (`train.init`): its weights and normalisation, for rigs and tasks that agree."""

from pathlib import Path

import pytest
import torch
import yaml
from conftest import SMALL, make_trainer, refusal

import multilift_marl as ml
from multilift_marl.agents import evaluator, policy
from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint
from multilift_marl.agents.initial import find_initial
from multilift_marl.agents.logging import read_metrics
from multilift_marl.agents.policy import strip_checkpoint
from multilift_marl.agents.trainer import resume_run
from multilift_marl.cli.train import main as train
from multilift_marl.envs.core import TRAINING_EVALUATION
from multilift_marl.errors import CheckpointError, ConfigError
from multilift_marl.evaluation.rollout import run_episodes
from multilift_marl.schema.files import pin_file
from multilift_marl.tasks.hover import Hover

SHIPPED = Path(policy.__file__).parents[1] / "policies"
HOVER = {"train.init": "hover", "train.residual": "formation_feedback"}


@pytest.fixture(scope="module")
def origin(tmp_path_factory):
    """Return the folder of a run of two iterations, whose policy is none that training begins with."""
    trainer = make_trainer(tmp_path_factory.mktemp("origin"), **{"train.learning_rate": 0.01, "seed": 7})
    for _ in range(2):
        trainer.step()
    trainer.save("best")
    return trainer.folder


def state(network):
    return {name: tensor.clone() for name, tensor in network.state_dict().items()}


def differing(one, other):
    assert one.keys() == other.keys()
    return [name for name in one if not torch.equal(one[name], other[name])]


@pytest.mark.parametrize("other", [{}, {"env.num_drones": 3, "payload.mass": 1.2}])
def test_it_starts_from_the_weights_and_statistics_of_a_shipped_policy(tmp_path, other):
    trainer = make_trainer(tmp_path, **HOVER, **other)
    assert differing(state(trainer.learner.actor), load_checkpoint(SHIPPED / "hover.pt")["actor"]) == []
    trainer.step()
    assert "team.net.0.weight" in differing(
        state(trainer.learner.actor), load_checkpoint(SHIPPED / "hover.pt")["actor"]
    )


def test_of_a_run_the_critic_is_taken_over_where_it_fits(tmp_path, origin):
    content = load_checkpoint(origin / "checkpoints" / "best.pt")
    trainer = make_trainer(tmp_path, **{"train.init": str(origin)})
    assert differing(state(trainer.learner.actor), content["actor"]) == []
    assert differing(state(trainer.learner.critic), content["critic"]) == []
    assert trainer.taken_over == "actor and critic"
    fresh = make_trainer(tmp_path)
    for other in ({"env.num_drones": 3}, {"train.algorithm": "ippo"}):  # whose critics see other numbers
        trainer = make_trainer(tmp_path, **{"train.init": str(origin)}, **other)
        assert differing(state(trainer.learner.actor), content["actor"]) == []
        assert trainer.taken_over == "actor; its critic is of another shape"
    strip_checkpoint(origin / "checkpoints" / "best.pt", tmp_path / "bare.pt")
    trainer = make_trainer(tmp_path, **{"train.init": str(tmp_path / "bare.pt")})
    assert differing(state(trainer.learner.critic), state(fresh.learner.critic)) == []  # the same seed's


def test_the_policy_is_pinned_by_its_content(tmp_path, origin, monkeypatch):
    best = origin / "checkpoints" / "best.pt"
    monkeypatch.chdir(origin.parent.parent)
    for name in (str(origin), str(best), f"{origin.parent.name}/{origin.name}"):
        trainer = make_trainer(tmp_path, **{"train.init": name})
        assert trainer.config.train.init == pin_file(str(best)) and "#sha256=" in trainer.config.train.init
        written = yaml.safe_load((trainer.folder / "config.yaml").read_text())
        assert written["train"]["init"] == trainer.config.train.init == trainer._content()["config"]["train"]["init"]
    file = tmp_path / "policy.pt"
    file.write_bytes(best.read_bytes())
    pinned = pin_file(str(file))
    save_checkpoint(file, load_checkpoint(best) | {"frames": 1})
    assert "has changed since" in refusal(make_trainer, tmp_path, **{"train.init": pinned})
    file.unlink()
    assert "is missing; put the file back" in refusal(make_trainer, tmp_path, **{"train.init": pinned})


def test_a_file_is_found_beside_the_yaml_that_names_it(tmp_path, origin, monkeypatch):
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "begin.pt").write_bytes((origin / "checkpoints" / "best.pt").read_bytes())
    (tmp_path / "theirs" / "mine.yaml").write_text("base: hover\ntrain: {init: begin.pt}\n")
    monkeypatch.chdir(tmp_path)
    config = ml.load_config("theirs/mine.yaml")
    assert config.train.init == pin_file(str(tmp_path / "theirs" / "begin.pt"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"task": "pose"}, "in this pose: number 50 of the observations is nothing there and planned_position_0 here"),
        ({"env.history": 2}, "number 50 of the observations is nothing there and"),
        (
            {"control.action": "ctbr", "train.residual": "formation"},
            "control.action=reference there and control.action=ctbr here; set control.action=reference",
        ),
        ({"env.units": "cable"}, "env.units=si there and env.units=cable here; set env.units=si"),
        (
            {"control.max_offset": 0.4},
            "in units of control.max_offset=0.5 there and control.max_offset=0.4 here; set control.max_offset=0.5",
        ),
        ({"train.hidden": [64, 32]}, "train.hidden=[64, 64] there and train.hidden=[64, 32] here; set train.hidden="),
        ({"train.gru": 4}, "train.gru=0 there and train.gru=4 here; set train.gru=0"),
        (
            {"train.residual": "formation", "train.asinh": 5},
            "train.asinh=0.0 there and train.asinh=5.0 here; set train.asinh=0.0 train.residual=formation_feedback",
        ),
        (
            {"train.residual": "formation_integral"},
            "train.residual=formation_feedback there and train.residual=formation_integral here; set",
        ),
        ({"train.overrides": {"control.max_yaw": 0.2}}, "in units of control.max_yaw=0.5 there"),
        (
            {"train.observe": ["slot_error", "payload_error"]},
            'train.observe=null there and train.observe=["slot_error", "payload_error"] here; set train.observe=null',
        ),
    ],
)
def test_what_does_not_agree_is_refused_by_its_first_difference(tmp_path, change, said):
    message = refusal(make_trainer, tmp_path, **(HOVER | change))
    assert message.startswith("train.init=hover ") and said in message
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("hoover", "did you mean 'hover'?"),
        ("formation", "is a baseline and has no weights; set train.residual=formation"),
        ("hover_realistic", "is a baseline and has no weights; set train.residual=hover_realistic"),
        ("mine.py:Policy", "is a class and has no weights"),
        ("policy.onnx", "is an exported network, which cannot be trained; give the run or the checkpoint"),
        ("nowhere.pt", "nowhere.pt is missing"),
    ],
)
def test_what_is_no_trained_policy_is_refused(tmp_path, monkeypatch, name, said):
    monkeypatch.chdir(tmp_path)
    with pytest.raises((ConfigError, CheckpointError)) as caught:
        make_trainer(tmp_path, **{"train.init": name})
    assert said in str(caught.value) and "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_resumed_it_goes_on_bit_for_bit_without_the_file(tmp_path, origin):
    file = tmp_path / "begin.pt"
    file.write_bytes((origin / "checkpoints" / "best.pt").read_bytes())
    trainers = []
    for halt in (False, True):
        trainer = make_trainer(tmp_path, **{"train.init": str(file), "train.frames": 512})
        trainer.evaluate()
        trainer.step()
        if halt:
            trainer.save("last")
            file.unlink()
            trainer = resume_run(trainer.folder, {})
        trainer.step()
        trainers.append(trainer)
    for network in ("actor", "critic"):
        assert differing(*(state(getattr(trainer.learner, network)) for trainer in trainers)) == []
    gains = [trainer.evaluator.measure_gain(4) for trainer in trainers]
    assert gains[0] == gains[1]


class Nearby(Hover):
    """Another task, in which drones observe the same."""

    name = "nearby"


def test_another_task_agrees_where_drones_observe_and_act_alike(registries):
    ml.register_task(Nearby)
    config, initial = find_initial(ml.load_config("hover", HOVER | {"task": "nearby"}))
    initial.check([config])
    message = refusal(initial.check, [config, ml.load_config("hover", {"env.units": "cable"})])  # the second rig
    assert message.startswith("train.init=hover was trained with env.units=si there")


@pytest.mark.slow
def test_evaluations_compare_with_the_policy_that_it_began_with(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    settings = SMALL | HOVER | {"train.learning_rate": 1e-12, "train.critic_learning_rate": 1e-12, "train.frames": 256}
    assert train([f"{key}={value}" for key, value in settings.items()]) == 0
    shown = capsys.readouterr().out
    assert "starting from hover (actor; it holds no critic)" in shown
    before, learned = (next(line for line in shown.splitlines() if line.startswith(name))
                       for name in ("before: hover ", "learned "))  # fmt: skip
    assert before.split()[-3:] == learned.split()[-3:]
    [folder] = (tmp_path / "runs").iterdir()
    rows = read_metrics(folder)
    trained = ml.load_policy("hover")
    config = ml.load_config(folder / "config.yaml")
    for row, column, first in ((rows[0], "eval/return", 0), (rows[-1], "final/script_return", 3 * evaluator._BLOCK)):
        flown = run_episodes(config, trained.bind, 3, config.seed, TRAINING_EVALUATION, first=first)
        assert float(row[column]) == flown["return"].mean()


def test_a_strangers_policy_runs_no_code_and_needs_none_of_it(tmp_path, monkeypatch, registries):
    content = load_checkpoint(SHIPPED / "hover.pt")
    (tmp_path / "theirs.py").write_text("raise SystemExit('ran')")
    content["config"]["train"]["residual"] = f"{tmp_path / 'theirs.py'}:Base"
    save_checkpoint(tmp_path / "stranger.pt", content)
    start = {"train.init": str(tmp_path / "stranger.pt"), "train.residual": "formation_feedback"}
    trainer = make_trainer(tmp_path, **start)
    assert differing(state(trainer.learner.actor), content["actor"]) == []  # the same matrix, by another name
    content["config"]["import"] = [str(tmp_path / "theirs.py")]
    save_checkpoint(tmp_path / "stranger.pt", content)
    message = refusal(make_trainer, tmp_path, **start)
    assert "theirs.py" in message and "trust=true" in message
