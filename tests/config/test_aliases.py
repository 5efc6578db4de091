"""`train.base_policy` is another name of `train.residual`, wherever that may stand."""

from __future__ import annotations

import pytest
from conftest import refusal

import multilift_marl as ml
from multilift_marl.config.load import build_config, parse_overrides
from multilift_marl.policies.baselines import base_matrix


@pytest.mark.parametrize(
    "given",
    [
        {"train.base_policy": "formation_integral"},
        {"train": {"base_policy": "formation_integral"}},
        parse_overrides(["train.base_policy=formation_integral"]),
    ],
)
def test_the_base_policy_may_be_given_by_either_name(given):
    assert ml.load_config("hover", given).train.residual == "formation_integral"
    assert build_config({}, given).train.residual == "formation_integral"
    assert "base_policy" not in ml.load_config("hover", given).train.model_dump()


def test_a_file_may_give_it_by_either_name_and_what_is_typed_beats_it(write):
    path = write("task: hover\ntrain: {base_policy: formation_gusts}\n", "mine.yaml")
    assert ml.load_config(path).train.residual == "formation_gusts"
    above = write(f"base: {path}\ntrain: {{residual: formation_integral}}\n", "above.yaml")
    assert ml.load_config(above).train.residual == "formation_integral"
    assert ml.load_config(above, {"train.base_policy": "formation"}).train.residual == "formation"


@pytest.mark.parametrize(
    "given",
    [
        {"train.base_policy": "formation", "train.residual": "formation"},
        {"train": {"base_policy": "formation", "residual": "formation_gusts"}},
    ],
)
def test_both_names_at_once_are_refused(given):
    assert refusal(ml.load_config, "hover", given) == (
        "train.base_policy and train.residual are two names of one key, and both are given; leave out one of them"
    )


def test_a_class_that_a_file_names_needs_trust_by_either_name(write):
    path = write("task: hover\ntrain: {base_policy: 'os:system'}\n", "theirs.yaml")
    vec = ml.make_vec("hover", num_envs=1, num_threads=1)
    config = ml.load_config(path)
    assert "train.residual=os:system, which was not run" in refusal(base_matrix, config.train.residual, vec)
