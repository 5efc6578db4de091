"""Payloads that hang unstable between drones that hold their places: the sign of the stiffness, and the warning."""

from __future__ import annotations

import logging
import re

import numpy as np
import pytest
from conftest import GRAVITY, make, make_system, zeros

import multilift_marl as ml
from multilift_marl.config.load import build_config, config_dir
from multilift_marl.control.gains import make_gains
from multilift_marl.errors import warn_once
from multilift_marl.rig.linearised import divergence_rate, warn_of_instability
from multilift_marl.schema.control import ControlConfig
from multilift_marl.schema.sections import RandomizationConfig

FIXED = RandomizationConfig()
HALF = 0.3  # [m] of the height of a box


def rod(height: float) -> dict[str, object]:
    """Return a rod below two drones, its anchors `height` [m] above its axis."""
    anchors = [[0.75, 0, height], [-0.75, 0, height]]
    return {"payload.size": [1.6, 0.04, 0.04], "payload.mass": 0.6, "payload.anchors": anchors}


def box(above: float) -> dict[str, object]:
    """Return a box held at the corners of its floor, its centre of mass `above` [m] the middle."""
    corners = [[x, y, -HALF] for x, y in ((0.25, 0.2), (-0.25, 0.2), (-0.25, -0.2), (0.25, -0.2))]
    size = [0.55, 0.45, 2 * HALF]
    return {"payload.size": size, "payload.anchors": corners, "payload.center_of_mass": [0.0, 0.0, above]}


def frequencies(system, **control) -> np.ndarray:
    return np.sqrt(make_gains(ControlConfig(**control), system).k_p)


def said(caplog) -> list[str]:
    return [message for message in map(logging.LogRecord.getMessage, caplog.records) if " hang" in message]


@pytest.mark.parametrize("height", [-0.005, -0.01, -0.025])
def test_a_rod_hung_below_its_axis_turns_over_as_an_inverted_pendulum(height):
    """About its length nothing but gravity acts: the rate is √(m g h / J) with J about the line of the anchors.

    The cables' ends move across them by h per turn, which resists by T/L h² each, 4 N in 1 m: less than a thousandth.
    """
    system = make_system(2, **rod(height))
    about = 0.6 / 12 * 2 * 0.04**2
    assert divergence_rate(system, frequencies(system)) == pytest.approx(
        np.sqrt(0.6 * GRAVITY * -height / about), rel=0.02
    )


@pytest.mark.parametrize("height", [0.0, 0.005, 0.025])
def test_a_rod_hung_at_or_above_its_axis_does_not(height):
    system = make_system(2, **rod(height))
    assert divergence_rate(system, frequencies(system)) < 0.01


@pytest.mark.parametrize("above", [-0.29, -0.2, -0.1, 0.0, 0.2])
def test_a_box_on_its_floor_falls_in_flight_where_its_stiffness_is_negative(above):
    """Drones that hold their places by 16/s² m each give way, so that a high load tips between four cables, too."""
    vec = make("hover", num_envs=2, **box(above), **{"randomization.payload_force": 0.0})
    system = vec.world.system
    vec.reset(seed=0)
    tilt = np.zeros(2)
    for _ in range(200):
        vec.step(zeros(vec))
        tilt = np.rad2deg(np.arccos(np.clip(vec.world.state.payload_rotation[:, 2, 2], -1, 1)))
        if vec.ended.any():
            break
    falls = divergence_rate(system, np.full(4, 4.0)) > 0
    assert falls == (above > -0.15)
    assert (tilt > 45).any() if falls else (tilt < 10).all()


def test_stiffer_loops_hold_a_higher_load():
    system = make_system(4, **box(-0.15))
    soft, stiff = (divergence_rate(system, np.full(4, frequency)) for frequency in (2.0, 8.0))
    assert soft > 1.0 and stiff == 0.0


def test_a_warning_says_how_fast_the_payload_falls_and_how_far_to_raise_its_anchors(caplog):
    caplog.set_level(logging.WARNING)
    warn_once.cache_clear()
    for num_drones, low in ((2, rod(-0.025)), (4, box(0.0))):
        caplog.clear()
        system = make_system(num_drones, **low)
        for _ in range(2):
            warn_of_instability(system, frequencies(system), FIXED)
        [message] = said(caplog)
        found = re.match(
            r"the payload hangs unstable where drones only hold their places, its error e times as large after "
            r"([\d.]+) s, as its centre of mass is too high above payload\.anchors; raise them or lower "
            r"payload\.center_of_mass by ([\d.]+) m, or let the policy balance it$",
            message,
        )
        assert float(found[1]) == pytest.approx(1 / divergence_rate(system, frequencies(system)), rel=0.05)
        rise = float(found[2])
        for share, stands in ((1.0, True), (0.95, False)):
            raised = [[x, y, z + share * rise] for x, y, z in low["payload.anchors"]]
            changed = make_system(num_drones, **low | {"payload.anchors": raised})
            assert (divergence_rate(changed, frequencies(changed)) < 0.1) == stands


def test_the_environment_warns_where_only_a_drawn_load_falls(caplog):
    caplog.set_level(logging.WARNING)
    warn_once.cache_clear()
    make("hover", num_envs=1, num_drones=2, **rod(0.015))
    assert not said(caplog)
    make("hover", num_envs=1, num_drones=2, **rod(0.015), **{"randomization.payload_center_of_mass": [0, 0, 0.02]})
    assert len(said(caplog)) == 1 and said(caplog)[0].startswith("the payload may hang unstable where")
    make("hover", num_envs=1, num_drones=2, **rod(-0.015))
    assert len(said(caplog)) == 2 and said(caplog)[1].startswith("the payload hangs unstable where")


@pytest.mark.parametrize("angle", [40, 50])
def test_cables_that_cross_over_the_middle_turn_the_payload_about_the_vertical(angle, caplog):
    """By hand, for each third: a turn moves an anchor by r across its cable, whose level force h has the length d.

    Cable and drone, held by m ω², resist by h/d and the force's arm by -r h: of turn and drone's shift the stiffness is
    [[(h/d) r² - r h, -(h/d) r], [-(h/d) r, h/d + m ω²]]; beyond the middle, d > r, the payload turns round.
    """
    caplog.set_level(logging.WARNING)
    warn_once.cache_clear()
    lean = {"cable.angle": [angle] * 3, "cable.azimuth": [180, 300, 60]}
    system = make_system(3, **{"payload.size": [0.6, 0.6, 0.1]}, **lean)
    radius, away = np.hypot(*system.anchors[0, :2]), np.hypot(*(system.slots - system.anchors)[0, :2])
    assert away > radius
    level = system.payload_mass * GRAVITY / 3 * np.tan(np.radians(angle))
    mass, across = system.vehicle.mass, level / away
    stiffness = [[across * radius**2 - radius * level, -across * radius], [-across * radius, across + mass * 16]]
    root = 1 / np.sqrt([system.payload_inertia[2] / 3, mass])
    expected = np.sqrt(-np.linalg.eigvalsh(np.array(stiffness) * np.outer(root, root))[0])
    assert divergence_rate(system, np.full(3, 4.0)) == pytest.approx(expected, rel=1e-3)
    warn_of_instability(system, np.full(3, 4.0), FIXED)
    [message] = said(caplog)
    assert "as its cables turn it away from rest; let cables lean outward" in message


def test_a_point_payload_has_nothing_to_fall_over():
    system = make_system(3, **{"payload.shape": "point"})
    assert divergence_rate(system, frequencies(system)) == 0.0


def test_no_shipped_configuration_falls():
    for path in sorted(config_dir().rglob("*.yaml")):
        config = ml.load_config(path.relative_to(config_dir()).with_suffix("").as_posix())
        for each in [config, *(build_config(config.model_dump(), rig) for rig in config.train.rigs)]:
            high = np.array([0, 0, each.randomization.payload_center_of_mass[2]])
            system, load = each.system, 1 + each.randomization.payload_mass
            assert divergence_rate(system, np.sqrt(make_gains(each.control, system).k_p), load, high) == 0.0, path
