"""`train.logger`: what TensorBoard, Weights & Biases and CSV files get of a training, read back."""

from __future__ import annotations

import sys
from importlib.machinery import ModuleSpec
from importlib.util import find_spec
from types import ModuleType, SimpleNamespace

import pytest
from conftest import make_trainer, refusal
from tensorboard.backend.event_processing.data_provider import MultiplexerDataProvider
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.backend.event_processing.plugin_event_multiplexer import EventMultiplexer
from tensorboard.context import RequestContext
from tensorboard.plugins.hparams import api_pb2, backend_context, list_session_groups

from multilift_marl.agents import loggers
from multilift_marl.agents.logging import RunLog, read_metrics
from multilift_marl.cli.train import main as train
from multilift_marl.config.load import load_config

SHORT = {"train.frames": 2 * 128, "eval.every": 1}


def trained(folder, logger):
    trainer = make_trainer(folder, **SHORT, **({} if logger is None else {"train.logger": logger}))
    assert trainer.run()
    return trainer.folder


def show_hparams(folder):
    """Return what TensorBoard's HParams tab shows of the run in a folder: its parameters and its metrics by tag."""
    multiplexer = EventMultiplexer().AddRunsFromDirectory(str(folder.parent))
    multiplexer.Reload()
    provider = MultiplexerDataProvider(multiplexer, str(folder.parent))
    context = backend_context.Context(SimpleNamespace(data_provider=provider))
    request = RequestContext()
    data = context.hparams_metadata(request, "")
    experiment = context.experiment_from_metadata(request, "", True, data, [])
    asked = api_pb2.ListSessionGroupsRequest(
        start_index=0, slice_size=9, allowed_statuses=[api_pb2.STATUS_SUCCESS], include_metrics=True,
        col_params=[
            api_pb2.ColParams(metric=info.name, include_in_result=True) for info in experiment.metric_infos
        ] + [api_pb2.ColParams(hparam=info.name, include_in_result=True) for info in experiment.hparam_infos],
    )  # fmt: skip
    (group,) = list_session_groups.Handler(request, context, "", asked).run().session_groups
    shown = {name: getattr(value, value.WhichOneof("kind")) for name, value in group.hparams.items()}
    return shown, {each.name.tag: each.value for each in group.metric_values}


@pytest.fixture(scope="module")
def usual(tmp_path_factory):
    return trained(tmp_path_factory.mktemp("usual"), None)


def test_tensorboard_is_the_default_and_shows_all_numbers_of_the_run(usual):
    events = EventAccumulator(str(usual))
    events.Reload()
    last = read_metrics(usual)[-1]
    scalars = {tag: events.Scalars(tag)[-1] for tag in events.Tags()["scalars"]}
    for tag, name in (("eval/return", "eval/return"), ("episodes/return", "return"), ("speed/fps", "fps")):
        if last.get(name):
            assert scalars[tag].value == pytest.approx(float(last[name]), rel=1e-6) and scalars[tag].step == 256
    assert "eval/success_rate" in scalars and "update/learning_rate" in scalars
    assert "configuration/text_summary" in events.Tags()["tensors"] and events.Tags()["images"] == ["flight"]
    assert {path.name for path in usual.iterdir() if path.is_dir()} == {"checkpoints"}


def test_the_hparams_tab_shows_hyperparameters_and_final_metrics(usual):
    shown, metrics = show_hparams(usual)
    config, last = load_config(str(usual / "config.yaml")), read_metrics(usual)[-1]
    assert shown["train.gamma"] == config.train.gamma and shown["train.algorithm"] == "mappo"
    assert shown["train.frames"] == 256 and shown["env.num_envs"] == config.env.num_envs and shown["task"] == "hover"
    assert shown["train.hidden"] == str(list(config.train.hidden)) and shown["control.action"] == "reference"
    assert set(metrics) == set(loggers._RESULTS)
    for tag, value in metrics.items():
        assert value == pytest.approx(float(last[tag]), rel=1e-6), tag


def test_all_hyperparameters_are_numbers_truth_values_or_texts():
    found = loggers.hyperparameters(load_config("hover", {"train.overrides": {"env.num_drones": 3}}))
    assert all(isinstance(value, (bool, int, float, str)) for value in found.values())
    assert found["train.overrides.env.num_drones"] == 3 and found["train.init"] == "None"


def test_csv_files_hold_the_numbers_and_go_on_after_the_checkpoint(tmp_path):
    log = RunLog(tmp_path, logger="csv")
    log.write_hyperparameters({"train.gamma": 0.5})
    log.write_text("configuration", "task: hover\n", 0)
    for iteration in range(4):
        log.write({"iteration": iteration, "frames": 8 * iteration}, {"eval/return": 0.1 + iteration, "fps": 3.0})
    log.close()
    log = RunLog(tmp_path, iteration=1, frames=8, logger="csv")
    log.write({"iteration": 2, "frames": 16}, {"eval/return": 7.0})
    log.close()
    csv = tmp_path / "csv"
    assert (csv / "scalars" / "eval" / "return.csv").read_text().split() == ["0,0.1", "8,1.1", "16,7.0"]
    assert (csv / "scalars" / "speed" / "fps.csv").read_text().split() == ["0,3.0", "8,3.0"]
    assert next((csv / "texts").glob("hparams*")).read_text() == "train.gamma: 0.5"
    assert not list(tmp_path.glob("events*"))


class FakeWandB(ModuleType):
    """Weights & Biases, as far as TorchRL's logger calls it."""

    Error = type("Error", (Exception,), {})
    Image = staticmethod(lambda path: f"image {path}")

    def __init__(self):
        super().__init__("wandb")
        self.__spec__, self.runs, self.problem = ModuleSpec("wandb", None), [], None

    def init(self, **settings):
        if self.problem:
            raise self.Error(self.problem)
        run = SimpleNamespace(settings=settings, config={}, rows=[], ended=False, id=settings["id"])
        run.config = SimpleNamespace(values={}, update=lambda values, **_: run.config.values.update(values))
        run.define_metric = lambda *_, **__: None
        run.log = lambda values, **_: run.rows.append(values)
        run.finish = lambda: setattr(run, "ended", True)
        self.runs.append(run)
        return run


@pytest.fixture
def wandb(monkeypatch):
    from torchrl.record.loggers import wandb as module

    fake = FakeWandB()
    monkeypatch.setitem(sys.modules, "wandb", fake)
    monkeypatch.setattr(module, "_has_wandb", True)
    return fake


@pytest.mark.slow
def test_a_run_of_wandb_gets_parameters_and_numbers_and_goes_on_where_it_is_resumed(tmp_path, wandb):
    folder = trained(tmp_path, "wandb")
    (run,) = wandb.runs
    assert run.settings["name"] == run.settings["id"] == folder.name and run.settings["resume"] == "allow"
    assert run.settings["dir"] == str(folder) and run.ended and not list(folder.glob("events*"))
    assert run.config.values["train.frames"] == 256 and "task: hover" in run.config.values["configuration"]
    rows = [row for row in run.rows if "eval/return" in row]
    expected = [(int(row["frames"]), float(row["eval/return"])) for row in read_metrics(folder)]
    assert [(row["eval/step"], row["eval/return"]) for row in rows] == expected
    assert "final/gained" in rows[-1] and any("pictures/flight" in row for row in run.rows)
    RunLog(folder, iteration=1, frames=128, logger="wandb").close()
    assert wandb.runs[1].settings["id"] == folder.name


def test_a_wandb_that_refuses_is_told_with_the_way_out(tmp_path, wandb):
    wandb.problem = "api_key not configured (no-tty). call wandb.login(key=[your_api_key])."
    text = refusal(RunLog, tmp_path, logger="wandb")
    assert text == (
        "train.logger=wandb cannot begin a run (api_key not configured (no-tty)); log in by wandb login, or set "
        "WANDB_MODE=offline in the environment"
    )


@pytest.mark.parametrize("name", ["wandb", "tensorboard"])
def test_a_package_that_is_missing_is_told_before_there_is_a_folder(tmp_path, capsys, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(loggers, "find_spec", lambda package: None if package == name else find_spec(package))
    assert train(["config=hover", f"train.logger={name}", "env.num_envs=2"]) == 2
    told = f"train.logger={name} needs the package {name}: pip install {name}, or set train.logger=csv"
    assert told in capsys.readouterr().err and not list(tmp_path.iterdir())


def test_wandb_works_without_a_network(tmp_path, monkeypatch):
    pytest.importorskip("wandb")
    monkeypatch.setenv("WANDB_MODE", "offline")
    folder = trained(tmp_path, "wandb")
    assert list(folder.glob("wandb/offline-run-*/*.wandb"))
