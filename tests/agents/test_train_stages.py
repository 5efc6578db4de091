"""A staged curriculum (`train.stages`): environments change by frames or by success, and resume bit for bit."""

from pathlib import Path

import numpy as np
import pytest
import torch
from conftest import make_trainer, refusal
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from multilift_marl.agents.checkpoint import load_checkpoint, save_checkpoint
from multilift_marl.agents.curriculum import Curriculum
from multilift_marl.agents.evaluator import Evaluator
from multilift_marl.agents.logging import read_metrics
from multilift_marl.agents.trainer import resume_run
from multilift_marl.config.load import build_config, load_config
from multilift_marl.errors import CheckpointError
from multilift_marl.rig.resolve import resolve_system

PICTURE = Path(__file__).parents[2] / "docs" / "images" / "errors.png"
BATCH = 8 * 16  # frames of an iteration of SMALL
LIGHT, LONG = {"payload.mass": 0.8}, {"payload.mass": 1.0, "env.episode_seconds": 0.4}


def stages(*untils):
    """Return a curriculum of one or two stages."""
    pairs = zip((LIGHT, LONG), untils, strict=False)
    return {"train.stages": [{"overrides": change, "until": until} for change, until in pairs]}


def mass(trainer):
    return trainer.env.vec.world.system.payload_mass


def advance(trainer, success=None):
    trainer.step()
    trainer._advance(success)


def test_frames_lead_from_stage_to_stage_and_to_the_training_s_own_environment(tmp_path):
    trainer = make_trainer(tmp_path, **stages({"frames": 2 * BATCH}, {"frames": 2 * BATCH + 1}), seed=3)
    own, seen = resolve_system(trainer.config).payload_mass, []
    for _ in range(4):
        seen.append((trainer.curriculum.values()["stage"], mass(trainer), trainer.env.vec.max_steps))
        advance(trainer)
    assert seen == [(1, 0.8, 25), (1, 0.8, 25), (2, 1.0, 20), (3, own, 25)]
    assert trainer.curriculum.began == 3 and not trainer.curriculum.is_over(10**9, 1.0)
    assert {trainer.curriculum.purpose, 0, 3} == {5, 0, 3}  # no stage repeats the episodes of another, nor the noise


def test_success_in_the_stage_s_environment_ends_it_and_evaluation_stays_on_the_own_one(tmp_path, monkeypatch):
    trainer = make_trainer(tmp_path, **stages({"success": 0.5}, {"frames": 10**6, "success": 0.9}))
    flown, measured = [], trainer.evaluator._fly

    def fly(make_policy, block, environment=None):
        flown.append((block, None if environment is None else environment.payload.mass))
        found = measured(make_policy, block, environment)
        if environment is not None:
            found["success_rate"] = np.array([True, True, False])
        return found

    monkeypatch.setattr(trainer.evaluator, "_fly", fly)
    values = trainer.evaluate()
    assert flown == [(0, None), (1, 0.8)] and values["eval/stage_success_rate"] == pytest.approx(2 / 3)
    trainer._advance(values["eval/stage_success_rate"])
    assert trainer.curriculum.number == 1 and mass(trainer) == 1.0
    trainer._advance(trainer.evaluate()["eval/stage_success_rate"])  # 2/3 < 0.9
    trainer._advance(None)
    assert trainer.curriculum.number == 1
    trainer._advance(0.9)
    assert trainer.curriculum.number == 2 and "eval/stage_success_rate" not in trainer.evaluate()


def test_without_stages_nothing_is_another(tmp_path):
    trainer = make_trainer(tmp_path)
    assert trainer.curriculum.values() == trainer.curriculum.state() == {} and trainer.curriculum.purpose == 0
    assert "stage" not in trainer._learning_state()


@pytest.mark.slow
def test_it_resumes_bit_for_bit_where_a_stage_begins_and_in_its_middle(tmp_path):
    found = []
    for halt in (None, 1, 2):
        trainer = make_trainer(tmp_path, **stages({"frames": BATCH}, {"frames": 3 * BATCH}))
        for k in range(1, 5):
            advance(trainer)
            if k == halt:
                trainer.save("last")
                trainer = resume_run(trainer.folder, {})
                assert trainer.curriculum.number == 1
        networks = (trainer.learner.actor, trainer.learner.critic)
        found.append({f"{i}.{name}": tensor.clone() for i, net in enumerate(networks)
                      for name, tensor in net.state_dict().items()} | trainer.rollouts.get_state())  # fmt: skip
        found[-1]["returns"] = torch.from_numpy(trainer.episodes.returns)
    for again in found[1:]:
        assert [name for name in again if not torch.equal(found[0][name], again[name])] == []


@pytest.mark.slow
def test_workers_go_through_the_same_stages(tmp_path):
    pytest.importorskip("ray")
    found = []
    for workers in (0, 1):
        more = {"train.workers": workers, "train.ray": "local"}
        trainer = make_trainer(tmp_path, **stages({"frames": BATCH}), **more)
        for _ in range(3):
            advance(trainer)
        assert trainer.curriculum.number == 1
        found.append(trainer.learner.actor.state_dict() | trainer.rollouts.get_state())
        trainer.rollouts.close()
    assert [name for name in found[0] if not torch.equal(found[0][name], found[1][name])] == []


def test_the_stage_is_logged_and_announced(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(Evaluator, "draw_best", lambda evaluator, folder: PICTURE)
    trainer = make_trainer(tmp_path, **stages({"frames": BATCH}, {"frames": 2 * BATCH}), **{"train.frames": 3 * BATCH})
    assert trainer.run()
    rows = read_metrics(trainer.folder)
    assert [row["stage"] for row in rows] == ["1.0", "1.0", "2.0", "3.0"]
    events = EventAccumulator(str(trainer.folder)).Reload()
    assert [event.value for event in events.Scalars("curriculum/stage")] == [1, 1, 2, 3]
    shown = capsys.readouterr().out
    assert "stage 2 of 2: payload.mass=1.0, env.episode_seconds=0.4" in shown
    assert "all stages are over: training goes on in its own environment" in shown


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ([], "train.stages must not be empty"),
        ([{"overrides": {"payload.mas": 1.0}}], "stage 1 of train.stages: unknown key 'payload.mas'; did you mean"),
        ([{"overrides": {"payload.mass": 900.0}}], "stage 1 of train.stages: "),
        ([{"overrides": {"task_options.foo": 3}, "until": {"frames": 100}}], "stage 1 of train.stages: unknown key"),
        ([{"override": {}}], "unknown key 'train.stages[0].override'; did you mean 'train.stages[0].overrides'?"),
        ([{"until": {"frame": 1}}], "unknown key 'train.stages[0].until.frame'; did you mean"),
        ([{"until": {"success": 80}}], "train.stages[0].until.success must be less than or equal to 1, but is 80"),
        ([{"until": 5}], "train.stages[0].until must be a section"),
        ([{"overrides": LIGHT}, {"overrides": LONG}], "train.stages must say in stage 1 of 2 until when it lasts"),
        (
            [{"until": {"frames": 200}}, {"until": {"success": 0.5}}, {"until": {"frames": 100}}],
            "train.stages must have until.frames that increase from stage to stage, not 100 after 200",
        ),
        ([{"overrides": {"env": {"num_envs": 4}}}], "cannot hold 'env.num_envs'; set env.num_envs itself"),
        ([{"overrides": {"train.frames": 4}}], "cannot hold 'train.frames'; set train.frames itself"),
        ([{"overrides": {"env.history": 2}}], "number 50 of the observations is"),
        ([{"overrides": {"env.num_drones": 3}}], "stage 1 of train.stages has a global state of"),
    ],
)
def test_stages_that_cannot_be_are_refused_before_a_folder_is_made(tmp_path, given, said):
    message = refusal(make_trainer, tmp_path, **{"train.stages": given})
    assert said in message and not list(tmp_path.iterdir())


def test_what_is_typed_goes_before_what_a_recipe_s_stages_change(tmp_path):
    recipe = tmp_path / "mine.yaml"
    recipe.write_text("base: hover\ntrain:\n  stages: [{overrides: {payload.mass: 0.8, wind.speed: 1}}]\n")
    config = load_config(recipe, {"payload.mass": 1.2})
    assert config.train.stages[0].overrides == {"wind.speed": 1}
    assert load_config(recipe, {"train.stages": None}).train.stages is None


def test_files_and_modules_of_stages_are_treated_as_those_of_overrides(tmp_path, registries):
    (tmp_path / "drone.yaml").write_text("base: falcon\n")
    (tmp_path / "mine.yaml").write_text(
        "base: hover\ntrain: {stages: [{overrides: {vehicle.preset: drone.yaml}, until: {frames: 9}}]}\n"
    )
    preset = load_config(tmp_path / "mine.yaml").train.stages[0].overrides["vehicle.preset"]
    assert preset.startswith(f"{tmp_path / 'drone.yaml'}#sha256=")
    (tmp_path / "theirs.py").write_text("raise SystemExit('ran')")
    (tmp_path / "mine.yaml").write_text(
        "base: hover\ntrain: {stages: [{overrides: {import: %s}}]}\n" % (tmp_path / "theirs.py")
    )
    assert "trust=true" in refusal(load_config, tmp_path / "mine.yaml")


def test_a_damaged_stage_is_no_checkpoint(tmp_path):
    trainer = make_trainer(tmp_path, **stages({"frames": BATCH}))
    trainer.save("last")
    path = trainer.folder / "checkpoints" / "last.pt"
    content = load_checkpoint(path)
    for stage in (None, {"number": 2, "began": 0}, {"number": True, "began": 0}, {"number": 0}, 1):
        save_checkpoint(path, {**content, "stage": stage})
        with pytest.raises(CheckpointError, match="stage"):
            resume_run(trainer.folder, {})
    assert build_config(content["config"]).train.stages == trainer.config.train.stages


@pytest.mark.parametrize(
    "own, change, message",
    [
        ({}, {"planner.distributed": True}, "set planner.distributed=false"),
        ({}, {"planner.lead": 0.1}, "leave planner.lead out"),
        ({}, {"control.action": "acc_rates"}, "set control.action=planner_weights"),
        ({"train.algorithm": "mappo", "train.actor": "set"}, {"env.sensing": "onboard"}, "env.communication=all"),
        ({"train.algorithm": "ippo", "control.action": "reference", "train.residual": "formation_integral"},
         {"control.action": "velocity"}, "acts by control.action=reference"),
    ],
)  # fmt: skip
def test_every_stage_is_checked_as_the_training_s_own_environment(own, change, message):
    """The second one here."""
    both = [{"overrides": each, "until": {"frames": k}} for k, each in ((10, {"payload.mass": 0.8}), (20, change))]
    said = refusal(Curriculum, load_config("track_weights", own | {"train.stages": both}))
    assert said.startswith("stage 2 of train.stages: ") and message in said
