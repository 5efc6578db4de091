"""The cards of the shipped policies are what the recorded results say."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "results"))
import model_cards  # noqa: E402

PAGE = (ROOT / "docs" / "models.md").read_text(encoding="utf-8")


def test_every_shipped_policy_has_a_card():
    names = sorted(path.stem for path in model_cards.POLICIES.glob("*.pt"))
    assert [line[3:] for line in PAGE.splitlines() if line.startswith("## ")] == names


@pytest.mark.parametrize("name", ["hover", "recover_realistic"])
def test_a_card_is_what_the_script_writes(name):
    assert model_cards.card(name) in PAGE


@pytest.mark.slow
def test_the_page_is_what_the_script_writes():
    assert model_cards.page() == PAGE
