"""Lists of lists and of sections: what is refused in them is named with its place."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.config.load import build_config, dump_config, load_config
from multilift_marl.schema.validate import validate
from multilift_marl.schema.values import Float, Section


class Pole(Section):
    height: Float


class Options(Section):
    poles: tuple[Pole, ...]
    middle: Pole = Pole(height=1.0)


def refuse_value(key, value) -> str:
    return refusal(load_config, "hover", {key: value})


def refuse_gap(*gaps) -> str:
    return refuse_value("scene.obstacles", [{"shape": "wall", "size": [0.1, 6, 3], "gaps": [*gaps]}])


@pytest.mark.parametrize(
    "key, value, place",
    [
        ("payload.anchors", [[0.1, 0.1, 0.1], [0.1, 0.1], [0, 0, 0], [0, 0, 0]], "payload.anchors[1]"),
        ("payload.anchors", [[0.1, 0.1, 0.1], 0.1, [0, 0, 0], [0, 0, 0]], "payload.anchors[1]"),
        ("scene.obstacles", [{"size": [1, 1, 1]}, {"position": [0, 0]}], "scene.obstacles[1].position"),
    ],
)
def test_a_wrong_list_is_named(key, value, place):
    assert refuse_value(key, value).startswith(f"{place} must be a list of 3 numbers, but is ")


@pytest.mark.parametrize("gap", [[], [0], [0, 1.2, 1], [0, 1.2, 1, 2, 3], 1.2, [[0, 1.2]], "wide"])
def test_a_gap_has_two_numbers_or_four(gap):
    assert refuse_gap([-2, 1], gap) == f"scene.obstacles[0].gaps[1] must be a list of 2 or 4 numbers, but is {gap!r}"


@pytest.mark.parametrize("gap, wrong", [([0, -1.2], -1.2), ([0, 1.2, -1, 2], -1), ([0, "wide", 1, 2], "wide")])
def test_a_wrong_number_of_a_gap_is_quoted(gap, wrong):
    message = refuse_gap(gap)
    assert message.startswith("scene.obstacles[0].gaps[0] must be ") and message.endswith(f"but is {wrong!r}")


@pytest.mark.parametrize(
    "values, place",
    [
        ({}, "poles"),
        ({"poles": [{"height": 1.0}, {}]}, "poles[1].height"),
        ({"poles": [], "middle": {}}, "middle.height"),
    ],
)
def test_an_option_without_a_default_is_asked_for(values, place):
    assert refusal(validate, Options, values, "task_options") == f"task_options.{place} is missing; give it a value"


SQUARE = [[0.2, 0.2, 0.0], [-0.2, 0.2, 0.0], [-0.2, -0.2, 0.0], [0.2, -0.2, 0.0]]


@pytest.mark.parametrize(
    "values",
    [
        {"payload.anchors": SQUARE},
        {"payload": {"anchors": SQUARE}},
        {"train.overrides": {"payload.anchors": SQUARE}},
        {"train.rigs": [{"payload": {"anchors": SQUARE}}]},
        {"task_options": {"start_tilt": 10.0}},
        {"env.num_drones": 4, "payload.mass": 1.25},
    ],
)
def test_arrays_are_taken_as_lists_are(values):
    def as_arrays(part):
        if isinstance(part, dict):
            return {key: as_arrays(each) for key, each in part.items()}
        if isinstance(part, list) and isinstance(part[0], dict):
            return [as_arrays(each) for each in part]
        return np.array(part) if isinstance(part, list) else np.array([part])[0]

    arrays, config = as_arrays(values), load_config("hover", values)
    for found in (load_config("hover", arrays), build_config(config.model_dump(), arrays)):
        assert found == config and dump_config(found) == dump_config(config)
    if "train.overrides" not in values and "train.rigs" not in values:
        assert ml.make_vec("hover", num_envs=1, **arrays).config.payload == config.payload


def test_a_list_that_holds_an_array_and_values_that_hold_one_are_taken():
    rows = [np.array(row) for row in SQUARE]
    assert load_config("hover", {"payload.anchors": rows}) == load_config("hover", {"payload.anchors": SQUARE})
    assert build_config({"payload": {"anchors": np.array(SQUARE)}}) == build_config({"payload": {"anchors": SQUARE}})
    assert "payload.anchors" in refusal(load_config, "hover", {"payload.anchors": np.zeros((4, 2))})


@pytest.mark.parametrize(
    "values",
    [{"import": {"mine.py"}}, {"train.residual": b"mine.py:Zero"}, {"payload": {"anchors": {(0.1, 0.1, 0.0)}}}],
)
def test_bytes_and_sets_are_no_values(values):
    assert "a configuration holds no " in refusal(load_config, "hover", values)
    nested = {"train": {"residual": values["train.residual"]}} if "train.residual" in values else values
    assert "a configuration holds no " in refusal(build_config, nested)
