"""A rig in a task that is not its own: the task's configuration under the rig's system."""

import json
import re

import pytest
from conftest import EXAMPLES, refusal

import multilift_marl as ml
from multilift_marl.agents.policy import load_policy
from multilift_marl.cli.evaluate import Options, _build
from multilift_marl.cli.evaluate import main as evaluate
from multilift_marl.command import split_options
from multilift_marl.config.load import build_config, choose_config, load_config

RECIPES = [("rigs/falcon3", "pose", "pose_falcon3"), ("rigs/crazyflie2", "recover", "recover_crazymarl")]


@pytest.mark.parametrize(("rig", "task", "recipe"), RECIPES)
def test_a_rig_in_another_task_is_as_in_the_recipe_for_both(rig, task, recipe):
    both, shipped = load_config(rig, {"task": task}), load_config(recipe)
    for section in ("env", "sim", "vehicle", "payload", "cable", "control", "wind", "randomization"):
        assert getattr(both, section) == getattr(shipped, section), section


def test_a_rig_in_another_task_is_the_tasks_configuration_under_the_rigs_system(write):
    both, task, rig = load_config("rigs/auto6", {"task": "track"}), load_config("track"), load_config("rigs/auto6")
    for section in ("train", "eval", "task_options", "reward", "randomization"):
        assert getattr(both, section) == getattr(task, section), section
    for section in ("vehicle", "payload", "cable"):
        assert getattr(both, section) == getattr(rig, section), section
    assert (both.env.num_drones, both.env.episode_seconds) == (6, task.env.episode_seconds)
    assert (both.control.max_offset, both.control.position_frequency) == (0.6, 3.0)
    assert load_config("rigs/auto6", {"task": "track", "control.max_offset": 0.9}).control.max_offset == 0.9
    assert load_config("rigs/auto6", {"task": "hover"}) == rig
    mine = write("env: {num_drones: 3}\npayload: {mass: 1.0}")
    assert load_config(mine, {"task": "hover"}) == load_config("hover", {"env.num_drones": 3, "payload.mass": 1.0})


def test_a_task_alone_is_its_configuration(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert evaluate(["policy=formation", "task=track", "baseline=none", "episodes=2", "env.episode_seconds=0.2"]) == 0
    report = json.loads(next(tmp_path.glob("runs/formation-track/eval/*/metrics.json")).read_text())
    assert report["config"]["train"] == load_config("track").model_dump(mode="json")["train"]


def test_a_configuration_states_only_what_differs_from_its_bases(tmp_path):
    (tmp_path / "heavy.yaml").write_text("payload: {mass: 2.0}\nenv: {episode_seconds: 3.0}\ntask: hover\n")
    (tmp_path / "own.yaml").write_text("base: [pose, heavy.yaml]\ncontrol: {max_offset: 0.2}\n")
    config = load_config(tmp_path / "own.yaml")
    assert (config.task, config.payload.mass, config.control.max_offset) == ("pose", 2.0, 0.2)
    assert config.env.episode_seconds == 12.0  # of a base with another task the system counts alone
    assert config.train == load_config("pose").train


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("base: own.yaml\n", "is based on own.yaml, which is based on it"),
        ("base: [third.yaml]\n", "is based on own.yaml, which is based on it"),
        ("base: hoover\n", "no configuration named 'hoover'"),
        ("base: 3\n", "must be the name of a configuration or a list of names, but is 3"),
    ],
)
def test_bases_that_cannot_be_are_refused(tmp_path, content, complaint):
    (tmp_path / "own.yaml").write_text(content)
    (tmp_path / "third.yaml").write_text("base: own.yaml\n")
    assert complaint in refusal(load_config, tmp_path / "own.yaml")


def test_a_base_that_leads_back_is_refused_however_its_path_is_written(tmp_path, monkeypatch, registries):
    folder = tmp_path / "d"
    folder.mkdir()
    (tmp_path / "link").symlink_to(folder)
    monkeypatch.chdir(tmp_path)
    (folder / "third.yaml").write_text("base: ./own.yaml\n")
    for base in ("../d/own.yaml", "./own.yaml", "../link/own.yaml", str(folder / "own.yaml"), "../d/third.yaml"):
        (folder / "own.yaml").write_text(f"base: {base}\n")
        for name in ("d/own.yaml", "d/../d/own.yaml", folder / "own.yaml", "link/own.yaml"):
            assert re.search(r"is based on \S+, which is based on it", refusal(load_config, name)), (base, name)
    (folder / "own.yaml").write_text("payload: {mass: 2.0}\n")
    ml.register_config("mine", "d/own.yaml")
    (folder / "own.yaml").write_text("base: mine\n")
    for name in ("mine", "d/own.yaml"):
        assert "own.yaml is based on mine, which is based on it" in refusal(load_config, name)


@pytest.mark.parametrize("policy", ["hover", "hover_ctbr"])
def test_a_trained_policy_brings_its_system_into_another_task(registries, policy):
    own = load_policy(policy).config
    values = {"import": str(EXAMPLES / "new_task.py"), "task": "lift", "env.num_threads": 0}
    flown, recipe = choose_config(None, own, values), load_config(policy, values)
    for section in ("env", "randomization", "task_options", "reward", "train", "payload", "cable", "control"):
        assert getattr(flown, section) == getattr(recipe, section), section
    assert flown.task_options["start_radius"] == 0.1 and flown.env.episode_seconds == 6.0
    evaluated = _build(*split_options(Options, {"run": policy, "baseline": "none", **values}))[0]
    assert evaluated == flown
    assert choose_config(None, own, {"task": own.task}) == own
    longer = build_config(own.model_dump(), {"env.history": 3, "env.policy_hz": 25})
    assert choose_config(None, longer, {"task": "track"}).env.history == 3  # what its network takes
