"""The list of long tests names tests that there are."""

import re
from pathlib import Path

from conftest import LONG

TESTS = Path(__file__).parents[1]


def test_every_line_of_the_list_is_the_beginning_of_a_tests_name():
    assert list(LONG) == sorted(set(LONG)) and all(LONG)
    for line in LONG:
        file, test = re.fullmatch(r"(\S+\.py)::(\w+)(?:\[.+)?", line).groups()
        assert f"\ndef {test}(" in (TESTS / file).read_text(encoding="utf-8"), line
