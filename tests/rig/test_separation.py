"""How far apart drones rest: what is refused and warned of, and that the change named is enough and hardly more."""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest
from conftest import make_system, refuse_system

import multilift_marl as ml
from multilift_marl.config.load import build_config, config_dir
from multilift_marl.errors import ConfigError, warn_once

SMALL_BOX = {"payload.size": [0.3, 0.2, 0.1], "cable.angle": 5}
POINT = {"payload.shape": "point", "payload.mass": 0.7}
TIGHT = {
    "parallel cables": (4, {"cable.angle": 0, "payload.size": [0.2, 0.15, 0.1]}),
    "short cables": (4, {"payload.shape": "point", "cable.length": 0.3}),
    "unequal lengths": (3, POINT | {"cable.length": [0.35, 0.4, 0.5]}),
    "unequal angles": (2, POINT | {"cable.angle": [8, 12], "cable.length": 1.0}),
    "azimuths": (3, POINT | {"cable.angle": 20, "cable.azimuth": [0, 60, 210], "cable.length": 0.9}),
    "drawn lengths": (2, POINT | {"cable.angle": 12, "cable.length": 1.0, "randomization.cable_length": 0.2}),
    "mixed": (4, {"vehicle.preset": ["falcon", "falcon", "hummingbird", "iris"], **SMALL_BOX}),
    "chains": (2, POINT | {"cable.model": "chain", "cable.angle": 8, "cable.length": 1.0}),
}
DRAWN = {"randomization__cable_length": 0.15, "randomization__payload_mass": 0.0}
NUMBER = r"(\[[\d., ]+\]|[\d.]+)"


def test_a_short_cable_beside_a_long_one_may_bring_drones_too_close():
    """Both are in one plane through the point, at angles of 3 and 3 deg: heights differ by what cables differ."""
    odd = POINT | {"cable.length": [1.0, 1.6], "cable.angle": 3}
    nominal = make_system(2, **odd)
    assert least_ratio(nominal) > 1.5
    message = refuse_system(2, **{key.replace(".", "__"): value for key, value in odd.items()}, **DRAWN)
    short, long = nominal.slots[0] * 1.15, nominal.slots[1] * 0.85  # from the point, but for a little stretch
    assert re.match(rf"neighbouring drones 0 and 1 may rest {np.linalg.norm(short - long):.2f} m apart", message)
    assert "lower randomization.cable_length" in message


def suggested(message: str) -> dict[str, object]:
    """Return the keys that a message says to raise, and their values."""
    found = re.findall(rf"cable\.(angle|length) to {NUMBER}", message)
    return {f"cable.{key}": eval(value) for key, value in found}


def least_ratio(system) -> float:
    """Return the least distance of two resting drones over its limit."""
    away = np.linalg.norm(system.slots[:, None] - system.slots[None], axis=-1)
    return (away / system.min_separation)[~np.eye(system.num_drones, dtype=bool)].min()


@pytest.mark.parametrize("num_drones, overrides", TIGHT.values(), ids=TIGHT)
def test_each_change_that_a_refusal_names_mends_it_and_little_less_does_not(num_drones, overrides):
    message = refuse_system(num_drones, **{key.replace(".", "__"): value for key, value in overrides.items()})
    assert re.match(r"neighbouring drones \d and \d (would|may) rest 0\.\d\d m apart, closer than 1\.1 × the", message)
    cures = suggested(message)
    assert cures, message
    for key, value in cures.items():
        make_system(num_drones, **overrides | {key: value})
        less = (0.985 * np.asarray(value)).tolist()  # three digits are named
        with pytest.raises(ConfigError, match="neighbouring drones"):
            make_system(num_drones, **overrides | {key: less})


def test_the_length_named_is_that_of_the_closed_form():
    """Four drones on a square about a point are √2 L sin 30° apart beside each other: 0.385 m at L = 0.5445 m."""
    cures = suggested(refuse_system(payload__shape="point", cable__length=0.3))
    assert cures["cable.length"] == pytest.approx(1.1 * 0.35 / (np.sqrt(2) * np.sin(np.radians(30))), abs=1e-3)
    assert cures["cable.angle"] == pytest.approx(np.rad2deg(np.arcsin(1.1 * 0.35 / np.sqrt(2) / 0.3)), abs=0.1)


def test_a_point_has_no_anchors_to_spread_and_a_box_has():
    assert "payload.anchors" not in refuse_system(payload__shape="point", cable__length=0.3)
    assert refuse_system(cable__angle=0, payload__size=[0.2, 0.15, 0.1]).endswith(", or spread payload.anchors")


def test_an_angle_at_which_drones_could_not_hover_is_not_named():
    """On cables of 0.2 m it would be 74°, where each holds 1 kg by 36 N, more than its drone's 20 N."""
    heavy = POINT | {"payload.mass": 2.0, "cable.length": 0.2}
    message = refuse_system(2, **{key.replace(".", "__"): value for key, value in heavy.items()})
    assert set(suggested(message)) == {"cable.length"}


def spare_warnings(caplog) -> list[str]:
    return [record.getMessage() for record in caplog.records if "which spares" in record.getMessage()]


@pytest.mark.parametrize("share, warned", [(1.11, True), (1.145, True), (1.155, False)])
def test_spare_separation_below_15_percent_warns_once_with_the_cure(caplog, share, warned):
    caplog.set_level(logging.WARNING)
    warn_once.cache_clear()
    pair = POINT | {"cable.angle": 30, "cable.length": 0.35 * share, "randomization.payload_mass": 0.0}
    ratio = least_ratio(make_system(2, **pair))
    assert ratio == pytest.approx(share, rel=1e-3)  # the cables make a triangle of equal sides
    make_system(2, **pair)
    said = spare_warnings(caplog)
    assert len(said) == warned
    if warned:
        assert re.match(
            rf"neighbouring drones 0 and 1 would rest 0\.\d\d m apart, which spares {100 * ratio - 100:.0f} % of the "
            r"separation limit of 0\.35 m, .*; raise cable\.angle to [\d.]+ or cable\.length to [\d.]+$",
            said[0],
        )
        for key, value in suggested(said[0]).items():
            make_system(2, **pair | {key: value})
        assert len(spare_warnings(caplog)) == 1


def test_no_shipped_configuration_warns_of_its_spare(caplog):
    caplog.set_level(logging.WARNING)
    warn_once.cache_clear()
    paths = sorted(config_dir().rglob("*.yaml"))
    assert len(paths) > 30
    for path in paths:
        config = ml.load_config(path.relative_to(config_dir()).with_suffix("").as_posix())
        for each in [config, *(build_config(config.model_dump(), rig) for rig in config.train.rigs)]:
            assert least_ratio(each.system) > 1.15
    assert not spare_warnings(caplog)
