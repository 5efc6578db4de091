"""The cards of the shipped policies are what the recorded results say."""

import hashlib
import json
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT / "results"))
import model_cards  # noqa: E402

NAMES = sorted(path.stem for path in (ROOT / "multilift_marl" / "policies").glob("*.pt"))


def read(name):
    return json.loads((ROOT / "docs" / "models" / f"{name}.json").read_text(encoding="utf-8"))


def test_every_shipped_policy_has_a_card_and_a_row():
    assert {path.stem for path in (ROOT / "docs" / "models").glob("*.json")} == set(NAMES)
    cards = [read(name) for name in NAMES]
    assert model_cards.page(cards) == model_cards.PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("name", NAMES)
def test_a_card_is_of_the_shipped_weights(name):
    card = read(name)
    weights = (ROOT / card["weights"]["file"]).read_bytes()
    assert card["weights"]["sha256"] == hashlib.sha256(weights).hexdigest()
    assert (ROOT / card["training"]["recipe"]).is_file()
    history = card["observations"]["history"]
    assert (
        sum(card["observations"]["components"].values()) * (history if isinstance(history, int) else len(history))
        == (card["observations"]["size"])
    )
    assert card["evaluation"] and card["limits"]


@pytest.mark.parametrize("name", ["hover", "recover_realistic"])
def test_a_card_is_what_the_script_writes(name):
    written = (ROOT / "docs" / "models" / f"{name}.json").read_text(encoding="utf-8")
    assert model_cards.write(model_cards.card(name)) == written


@pytest.mark.slow
def test_page_and_cards_are_what_the_script_writes(tmp_path):
    model_cards.main(tmp_path / "models.md")
    for path in (*(tmp_path / "models").iterdir(), tmp_path / "models.md"):
        kept = ROOT / "docs" / path.relative_to(tmp_path)
        assert path.read_text(encoding="utf-8") == kept.read_text(encoding="utf-8"), path.name
