"""Data files beside the pages of the documentation: tables with a head, linked from a page."""

import csv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DATA = ROOT / "docs" / "data"
FILES = sorted(DATA.glob("*.csv"))


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.name)
def test_a_data_file_is_a_table(path):
    with path.open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    assert rows and len(set(head)) == len(head)
    assert {len(row) for row in rows} == {len(head)}


def test_every_data_file_is_linked_from_a_page():
    pages = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "docs").rglob("*.md"))
    assert [path.name for path in FILES if f"data/{path.name})" not in pages] == []
