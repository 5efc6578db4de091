"""Lists of lists and of sections: what is refused in them is named with its place."""

from __future__ import annotations

import pytest
from conftest import refusal

from multilift_marl.config.load import load_config
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
