"""Results that are remembered by the values of arguments."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import make_system

from multilift_marl.navigation.formation_shapes import make_shapes
from multilift_marl.remember import _MOST, remember
from multilift_marl.schema.yaml_text import parse_yaml


def counting():
    calls = []

    @remember
    def total(values, factor=1.0):
        calls.append(factor)
        return factor * np.sum(values)

    return total, calls


def test_equal_arguments_are_computed_once_and_others_anew():
    total, calls = counting()
    values = np.array([1.0, 2.0])
    assert total(values) == total(values.copy()) == 3.0
    assert len(calls) == 1
    values[1] = 5.0  # the same array, other values
    assert total(values) == 6.0
    assert total(values, factor=2.0) == 12.0
    assert total(values.astype(np.float32), factor=2.0) == 12.0
    assert len(calls) == 4


def test_the_results_used_longest_ago_are_forgotten():
    total, calls = counting()
    for i in range(_MOST):
        total(i)
    total(0)
    total(_MOST)  # in place of 1
    assert len(calls) == _MOST + 1
    total(0)
    assert len(calls) == _MOST + 1
    total(1)
    assert len(calls) == _MOST + 2


def test_errors_are_not_remembered():
    @remember
    def inverse(value):
        return 1 / value.pop()

    for _ in range(2):
        given = [0]
        with pytest.raises(ZeroDivisionError):
            inverse(given)
        assert given == []  # it was called


def test_an_equal_team_shares_what_its_rig_leads_to_and_another_does_not():
    assert make_shapes(make_system(2)) is make_shapes(make_system(2))
    assert make_shapes(make_system(2)) is not make_shapes(make_system(2, **{"cable.length": 1.1}))


def test_what_is_read_from_yaml_may_be_changed():
    text = "a: {b: [1, 2]}"
    first = parse_yaml(text)
    first["a"]["b"].append(3)
    assert parse_yaml(text) == {"a": {"b": [1, 2]}}
