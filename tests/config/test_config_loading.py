"""Configurations: what wins over what, numbers as people write them, dumps and explanations."""

from __future__ import annotations

import re

import pytest
import yaml
from conftest import TASKS, refusal

from multilift_marl.config import precedence
from multilift_marl.config.config import Config
from multilift_marl.config.keys import explain
from multilift_marl.config.load import (
    CONFIGS,
    _locate,
    build_config,
    dump_config,
    list_configs,
    load_config,
    parse_overrides,
    register_config,
)  # fmt: skip
from multilift_marl.config.precedence import give_way
from multilift_marl.schema.values import Section


def test_defaults_lose_to_the_file_and_the_file_to_overrides(write):
    path = write("seed: 7\nenv:\n  num_drones: 3\n  num_envs: 5\n")
    config = load_config(path, {"env.num_envs": 9})
    assert (config.env.num_envs, config.env.num_drones, config.seed) == (9, 3, 7)
    assert config.sim.timestep == Config().sim.timestep


def test_an_override_leaves_its_neighbours_in_the_file_alone(write):
    config = load_config(
        write("randomization: {payload_mass: 0.1, payload_force: 1.0}"), {"randomization.payload_mass": 0}
    )
    assert (config.randomization.payload_mass, config.randomization.payload_force) == (0.0, 1.0)


@pytest.mark.parametrize("key", ["train.overrides", "task_options", "reward"])
def test_mappings_add_and_an_empty_one_empties(write, key):
    section, _, name = key.partition(".")
    path = write(f"{section}: " + (f"{{{name}: {{position: 2.0}}}}" if name else "{position: 2.0}"))

    def found(*arguments):
        values = load_config(path, parse_overrides(arguments)).model_dump()[section]
        values = values[name] if name else values
        return {key: value["weight"] if section == "reward" else value for key, value in values.items()}

    assert found() == {"position": 2.0}
    assert found(f"{key}={{precision: 1.0}}") == {"position": 2.0, "precision": 1.0}
    assert found(f"{key}={{}}") == {}
    assert found(f"{key}={{}}", f"{key}.level=3") == {"level": 3}


def test_an_empty_section_changes_nothing():
    assert load_config("hover", {"train": {}, "env": {}}) == load_config("hover")


def test_a_section_as_an_override_leaves_its_neighbours_in_the_file_alone():
    config = load_config("hover", {"randomization": {"payload_mass": 0.1}})
    assert (config.randomization.payload_mass, config.randomization.payload_force) == (0.1, 1.5)


def test_overriding_one_configuration_does_not_change_the_next():
    nested = {"env": {"num_envs": 5}}
    assert build_config(nested, {"env.num_envs": 9, "env.num_drones": 2}).env.num_envs == 9
    assert nested == {"env": {"num_envs": 5}}
    assert build_config(nested).env.num_envs == 5


def test_an_empty_file_is_the_defaults(write):
    assert load_config(write("")) == Config()


def test_a_configuration_cannot_be_changed_after_it_was_checked():
    with pytest.raises(ValueError, match="frozen"):
        load_config("hover").env.num_drones = 3


@pytest.mark.parametrize("name", list_configs())
def test_every_shipped_configuration_names_a_task_and_a_possible_system(name):
    config = load_config(name)
    assert config.task in TASKS
    assert config.system.num_drones == config.env.num_drones


@pytest.mark.parametrize(
    "text, key, value",
    [
        ("2e6", "train.frames", 2_000_000),
        ("1e3", "env.num_envs", 1000),
        ("3.0", "env.num_drones", 3),
        ("1e-3", "train.learning_rate", 1e-3),
        ("2e-3", "sim.timestep", 2e-3),
        ("[1e5, 2e5, 1e5, 2e5]", "cable.stiffness", (1e5, 2e5, 1e5, 2e5)),
        ("false", "task_options.anything", False),
    ],
)
def test_numbers_as_people_write_them(text, key, value):
    config = load_config("hover", parse_overrides([f"{key}={text}"]))
    section, name = key.split(".")
    found = config.task_options[name] if section == "task_options" else getattr(getattr(config, section), name)
    assert found == value
    assert type(found) is type(value)


def test_exponents_in_a_file(write):
    config = load_config(write("train:\n  frames: 2e6\n  learning_rate: 1e-3\n"))
    assert (config.train.frames, config.train.learning_rate) == (2_000_000, 1e-3)


@pytest.mark.parametrize(
    "overrides",
    [
        {},
        {"cable.length": [1.0, 1.1, 1.2, 1.3], "wind.velocity": [1, 0, 0], "reward.position": 2},
        {"payload.shape": "point", "payload.mass": 0.1 + 0.2, "task_options.target_xy": 0.5, "train.hidden": [32]},
    ],
    ids=["plain", "lists", "point"],
)
def test_a_resolved_dump_loads_back_equal(write, overrides):
    config = load_config("hover", overrides)
    assert load_config(write(dump_config(config))) == config


def leaves(section: type[Section], prefix: str = ""):
    for name, field in section.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            yield from leaves(field.annotation, f"{prefix}{name}.")
        else:
            yield prefix + name, field.description


@pytest.mark.parametrize("key, description", list(leaves(Config)))
def test_explain_lists_every_key_with_its_description(key, description):
    assert description
    assert re.search(rf"^  {re.escape(key)}[ .].* {re.escape(description)}$", explain(), re.MULTILINE)


def test_a_dump_holds_every_key_that_explain_lists():
    resolved = yaml.safe_load(dump_config(Config()))
    for key, _ in leaves(Config):
        node = resolved
        for part in key.split("."):
            node = node[part]


@pytest.mark.parametrize(
    "name, typed, overrides",
    [
        ("hover", {}, {"reward.precision": 1.0, "randomization.cable_length": 0.1}),
        ("hover", {"reward.precision": 0.1}, {"randomization.cable_length": 0.1}),
        ("hover", {"reward": {"precision": 0.1}}, {"randomization.cable_length": 0.1}),
        ("hover", {"reward.precision.weight": 0.1}, {"randomization.cable_length": 0.1}),
        ("hover", {"reward.precision.margin": 0.1}, {"reward.precision": 1.0, "randomization.cable_length": 0.1}),
        ("hover", {"reward": {}, "randomization": {"cable_length": 0.2}}, {}),
        ("hover", {"train.overrides": {"reward.precision": 2.0}, "reward.precision": 3.0},
         {"reward.precision": 2.0, "randomization.cable_length": 0.1}),
        ("loss_realistic", {"reward.attitude": 2.0, "env.episode_seconds": 9.0, "task_options.loss_time": [1, 2]},
         {"reward.attitude.margin": 40.0, "reward.snatch": -50.0}),
        ("loss_realistic", {"reward.attitude.margin": 20.0, "env.episode_seconds": 9.0, "task_options": {}},
         {"reward.attitude.weight": 1.0, "reward.snatch": -50.0}),
    ],
)  # fmt: skip
def test_what_is_typed_goes_before_what_a_recipe_changes_in_training(name, typed, overrides):
    found = load_config(name, typed).train.overrides
    assert {**found} == overrides


def test_so_does_what_a_file_says_before_its_bases_and_a_rig_before_the_task(tmp_path):
    (tmp_path / "mine.yaml").write_text("base: hover\nreward: {precision: 0.1}\n", encoding="utf-8")
    assert load_config(tmp_path / "mine.yaml").train.overrides == {"randomization.cable_length": 0.1}
    (tmp_path / "rig.yaml").write_text("task: pose\nwind: {velocity: [3, 0, 0]}\n", encoding="utf-8")
    register_config("calm", {"task": "calm", "train": {"overrides": {"wind.velocity": [0, 0, 0], "wind.wash": True}}})
    try:
        assert load_config(tmp_path / "rig.yaml", {"task": "calm"}).train.overrides == {"wind.wash": True}
    finally:
        del CONFIGS["calm"]


WRITTEN = {"wind.wash": False}, {"wind": {"wash": False}}, {"wind": {"wash": False, "gust": 0}}


@pytest.mark.parametrize("typed", WRITTEN)
@pytest.mark.parametrize("filed", [{"wind.wash": True}, {"wind": {"wash": True}}, {"wind": {"wash": True, "gust": 1}}])
def test_the_last_of_two_overrides_counts_however_each_is_written(write, typed, filed):
    """Sections and dotted keys: values are applied in turn, so that none may be left of what was overridden."""
    file = write(yaml.safe_dump({"base": "loss", "train": {"overrides": filed}}))
    found = load_config(file, {"train.overrides": typed}).train.overrides
    numbers = [(name, value) for name, value in precedence.leaves(found) if name.startswith("wind.")]
    assert numbers[-1] == ("wind.gust", 0) if "gust" in str(typed) else ("wind.wash", False) in numbers
    assert len({name for name, _ in numbers}) == len(numbers) and ("wind.wash", True) not in numbers


def test_a_terms_weight_may_be_overridden_in_either_form():
    filed = {"train": {"overrides": {"reward.precision.weight": 7.0, "reward.precision.margin": 0.1}}}
    for typed in ({"reward.precision": 5.0}, {"reward": {"precision": 5.0}}, {"reward.precision.weight": 5.0}):
        found = dict(
            precedence.leaves(build_config({"task": "hover", **filed}, {"train.overrides": typed}).train.overrides)
        )
        assert found == {"reward.precision.weight": 5.0, "reward.precision.margin": 0.1}


def test_rigs_of_training_have_what_is_typed():
    usual, typed = load_config("pose_generalist"), load_config("pose_generalist", {"cable.length": 0.6})
    assert len(typed.train.rigs) == len(usual.train.rigs) > 1
    assert any("cable.length" in rig for rig in usual.train.rigs)
    for mine, its in zip(typed.train.rigs, usual.train.rigs, strict=True):
        assert mine == {key: value for key, value in its.items() if key != "cable.length"}


def test_so_is_what_a_run_is_resumed_with():
    stored = load_config("hover", {"train.overrides": {"env.num_threads": 3}}).model_dump()
    config = build_config(give_way(stored, {"env.num_threads": 2}), {"env.num_threads": 2})
    assert build_config(config.model_dump(), config.train.overrides).env.num_threads == 2
    assert config.train.overrides == {"reward.precision": 1.0, "randomization.cable_length": 0.1}


def test_an_empty_section_asks_for_what_it_drops_alone():
    stored = {"train": {"overrides": {"randomization.cable_length": 0.1, "reward.precision": 1.0, "reward": {"a": 1}}}}
    kept = give_way(stored, {"randomization": {}, "wind": {}, "task_options": {}})
    assert kept == stored
    assert give_way(stored, {"reward": {}})["train"]["overrides"] == {"randomization.cable_length": 0.1}


def test_what_lies_beside_a_yaml_file_goes_before_all_else(tmp_path, registries):
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    for package in (theirs, theirs / "pack", theirs / "pack" / "sub"):
        package.mkdir(exist_ok=True)
        (package / "__init__.py").write_text("")
        (package / "part.py").write_text("")
    (theirs / "__init__.py").unlink()
    (theirs / "part").write_text("no module")
    for reference, found in (
        ("part", "part.py"),
        ("pack", "pack/__init__.py"),
        ("pack.part", "pack/part.py"),
        ("pack.sub", "pack/sub/__init__.py"),
        ("pack/part.py", "pack/part.py"),
        ("./pack", "pack/__init__.py"),
        (["pack.sub.part", "json", "mine"], "pack/sub/part.py"),
    ):
        first = str(theirs / found)
        expected = [first, "json", "mine"] if isinstance(reference, list) else first
        for place in (
            lambda name: {"import": name},
            lambda name: {"train": {"overrides": {"import": name}}},
            lambda name: {"train": {"rigs": [{"import": name}]}},
            lambda name: {"train": {"stages": [{"overrides": {"import": name}}]}},
        ):
            assert _locate(place(reference), theirs) == place(expected)
    (theirs / "rig.yaml").write_text("import: pack.part")
    assert "was not run" in refusal(load_config, theirs / "rig.yaml")
    assert getattr(load_config(theirs / "rig.yaml", trust=True), "import") == (str(theirs / "pack" / "part.py"),)
