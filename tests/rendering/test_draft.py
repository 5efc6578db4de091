"""Rigs that are refused, drawn all the same: where everything is, what is red, and what is said."""

from __future__ import annotations

import re
import urllib.request

import numpy as np
import pytest
from conftest import refusal
from test_rendering import needs_gl, picture

import multilift_marl as ml
from multilift_marl.errors import ConfigError
from multilift_marl.rendering import Draft, Stage
from multilift_marl.rendering.draft import CONFLICT_COLOUR
from multilift_marl.viewer.__main__ import main, make_session
from multilift_marl.viewer.draft import DraftSession

CORNERS = [[0.25, 0.2, 0.08], [-0.25, 0.2, 0.08], [-0.25, -0.2, 0.08], [0.25, -0.2, 0.08]]
BESIDE = [[0.25, 0.2, 0.08], [0.3, -0.2, 0.08], [0.28, 0.0, 0.08], [0.02, 0.0, 0.08]]
CLOSE = {"payload.shape": "point", "cable.length": 0.3}
REFUSED = {  # what is refused, the drones and the anchors that are red; where several are alike, how many drones
    "too close": ({"cable.angle": 0, "payload.size": [0.2, 0.15, 0.1]}, 2, set()),
    "too close chains": (CLOSE | {"cable.model": "chain"}, 2, set()),
    "anchor away": ({"payload.anchors": [[2.0, 1.0, 0.08], *CORNERS[1:]]}, set(), {0}),
    "two anchors away": ({"payload.anchors": [*CORNERS[:2], [-9, 0, 0.08], [0, -9, 0.08]]}, set(), {2, 3}),
    "would push": ({"payload.anchors": BESIDE}, {2}, {2}),
    "no balance": ({"payload.anchors": [CORNERS[0]] * 4}, set(), {0, 1, 2, 3}),
    "lean": ({"cable.azimuth": [0, 140, 220, 320]}, {0, 1, 2, 3}, set()),
    "overloaded drone": ({"cable.angle": 79}, 1, set()),
    "cable breaks": ({"cable.breaking_load": [1.0, 50.0, 50.0, 50.0]}, set(), {0}),
    "hook": ({"cable.hook": [[0, 0, 0], [0, 0, 0], [0.5, 0, 0], [0, 0, 0]]}, {2}, set()),
    "too heavy": ({"payload.mass": 50}, set(), set()),
}


def reds(stage: Stage, prefix: str) -> set[int]:
    """Return which of the drawn drones or anchors are red."""
    model, red = stage.model, np.float32(CONFLICT_COLOUR[:3])
    if prefix == "anchor":
        return {i for i in range(4) if np.allclose(model.site(f"payload/anchor_{i}").rgba[:3], red)}
    coloured = {model.body(int(body)).name for body, rgba in zip(model.geom_bodyid, model.geom_rgba, strict=True)
                if rgba[3] > 0 and np.allclose(rgba[:3], red)}  # fmt: skip
    return {i for i in range(4) if f"drone_{i}" in coloured}


@pytest.mark.parametrize("overrides, drones, anchors", REFUSED.values(), ids=REFUSED)
def test_what_conflicts_is_red_and_everything_is_where_it_would_rest(overrides, drones, anchors):
    config = ml.load_config("hover", overrides)
    draft = Draft(config)
    assert str(draft.conflict) == refusal(lambda: ml.load_config("hover", overrides).system)
    stage = Stage(draft)
    stage.update(0)
    red = reds(stage, "drone")
    assert red == set(draft.conflict.drones) and drones in (red, len(red))
    assert reds(stage, "anchor") == anchors
    payload = stage.data.body("payload").xpos
    for i, slot in enumerate(draft.world.system.slots):
        np.testing.assert_allclose(stage.data.body(f"drone_{i}").xpos - payload, slot, atol=1e-12)
    target = stage.model.geom_bodyid == stage.model.body("target").id
    assert (stage.model.geom_rgba[target, 3] == 0).all()
    assert stage.data.site_xpos[:, 2].min() > 0  # anchors and hooks are above the ground


def test_drones_too_close_are_drawn_as_close_as_is_said():
    draft = Draft(ml.load_config("hover", CLOSE))
    first, second = draft.world.state.drone_position[0][list(draft.conflict.drones)]
    assert f"rest {np.linalg.norm(first - second):.2f} m apart" in str(draft.conflict)


def test_a_rig_that_can_be_has_no_draft_and_numbers_that_go_together_in_no_way_are_refused():
    with pytest.raises(ValueError, match="can be"):
        Draft(ml.load_config("hover"))
    with pytest.raises(ConfigError, match=r"cable\.length lists 2 values"):
        Draft(ml.load_config("hover", {"cable.length": [1.0, 1.0]}))


@needs_gl
def test_a_picture_of_a_refused_rig_shows_the_conflict():
    def red(frame):
        return ((frame[..., 0] > 150) & (frame[..., 1] < 60) & (frame[..., 2] < 60)).sum()

    frame = picture(Draft(ml.load_config("hover", CLOSE)))
    assert red(frame) > 50
    assert red(picture(Draft(ml.load_config("hover", {"payload.mass": 50})))) == 0


def test_the_page_shows_a_refused_rig_and_why():
    pytest.importorskip("viser")
    from multilift_marl.viewer.page import Page, _group

    session, port = make_session({"task": "hover", "port": 0, "payload.shape": "point", "cable.length": 0.3})
    assert isinstance(session, DraftSession)
    page = Page(session, port)
    try:
        text = page.controls["status"].content
        assert set(page.controls) == {"status"}
        first, second = re.match(r"neighbouring drones (\d) and (\d) would rest 0\.21 m", session.reason).groups()
        assert text == f"**This rig is refused:** {session.reason}  \nred: drone {first}, drone {second}"
        colours = np.vstack([colour for *_, colour in _group(page._stage.scene).values()])
        assert np.isclose(colours[:, :3], CONFLICT_COLOUR[:3], atol=0.01).all(axis=1).sum() >= 2
        session.advance(1.0)
        page.draw()
    finally:
        page.close()


def test_the_command_prints_the_refusal_serves_the_picture_and_reports_failure(capsys, monkeypatch):
    pytest.importorskip("viser")
    from multilift_marl.viewer.page import Page

    served = []

    def run(page):
        page.draw()
        with urllib.request.urlopen(page.address, timeout=30) as answer:
            served.append(answer.status)
        raise KeyboardInterrupt

    monkeypatch.setattr(Page, "run", run)
    assert main(["payload.shape=point", "cable.length=0.3", "port=0"]) == 2
    said = capsys.readouterr()
    assert served == [200] and "see what conflicts at http://127.0.0.1:" in said.out
    assert said.err == f"error: {refusal(lambda: ml.load_config('hover', CLOSE).system)}\n"


@pytest.mark.parametrize(
    "values, message",
    [
        ({"cable.length": [1.0, 1.0]}, r"cable\.length lists 2 values"),
        ({"policy": "formatio"}, "unknown policy"),
    ],
)
def test_what_has_no_picture_is_refused_as_before(values, message):
    with pytest.raises(ConfigError, match=message):
        make_session({"task": "hover", **values})
