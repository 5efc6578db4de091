"""Cables that lean each in its own way: `cable.angle` and `cable.azimuth` are held at rest, or refused."""

from __future__ import annotations

import re
from math import cos, radians, sin, tan

import mujoco
import numpy as np
import pytest
from conftest import GRAVITY, floats, make, make_system, refuse_system, zeros

from multilift_marl.errors import ConfigError
from multilift_marl.math3d import mat_to_quat
from multilift_marl.rig.balance import formation_forces
from multilift_marl.rig.system import System
from multilift_marl.sim.scene import build_model

POINT = {"payload.shape": "point", "payload.mass": 0.7, "cable.length": 1.2}


def leans(system: System) -> tuple[np.ndarray, np.ndarray]:
    """Return angles from the vertical and azimuths (N,) [deg] of cables from anchors to hooks."""
    cable = system.cable_ends - system.anchors
    level = np.hypot(cable[:, 0], cable[:, 1])
    return np.rad2deg(np.arctan2(level, cable[:, 2])), np.rad2deg(np.arctan2(cable[:, 1], cable[:, 0]))


def turned(azimuth, expected) -> np.ndarray:
    """Return the differences of azimuths [deg] within ± 180."""
    return (np.asarray(azimuth) - expected + 180) % 360 - 180


def accelerations(system: System) -> np.ndarray:
    """Return how MuJoCo's bodies accelerate from rest under rotors that hold drones and cables."""
    model, layout = build_model(system)
    data = mujoco.MjData(model)
    data.qpos[: layout.payload_nq] = [0, 0, 5, 1, 0, 0, 0][: layout.payload_nq]
    for i, (slot, rotation) in enumerate(zip(system.slots, system.resting_rotation, strict=True)):
        data.qpos[layout.payload_nq + 7 * i :][:7] = [*(slot + [0, 0, 5]), *mat_to_quat(floats(rotation))]
        held = system.hook_force[i] + [0, 0, GRAVITY * system.vehicles[i].mass]
        data.xfrc_applied[layout.drone_bodies[i], :3] = held
    mujoco.mj_forward(model, data)
    return data.qacc


def test_two_drones_on_a_point_lean_unequally_and_share_the_load_as_by_hand():
    """The level parts of the tensions cancel, T1 sin 20° = T2 sin 40°, the upright ones carry the weight."""
    system = make_system(2, **POINT, **{"cable.angle": [20, 40]})
    tension = np.linalg.norm(system.formation_force, axis=1)
    weight = 0.7 * GRAVITY
    first = weight / (cos(radians(20)) + sin(radians(20)) / tan(radians(40)))
    np.testing.assert_allclose(tension, [first, first * sin(radians(20)) / sin(radians(40))], rtol=1e-9)
    np.testing.assert_allclose(leans(system)[0], [20, 40], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(system.slots, axis=1), 1.2 + tension / 1e5, rtol=1e-12)


def test_a_rod_off_its_middle_leans_as_its_shares_say_and_no_other_way():
    """Anchors 0.6 and 0.9 m beside the centre of mass carry 3/5 and 2/5: level parts cancel if tan a1 / tan a2 = 2/3.

    The anchors' height takes no part, since the level forces are opposite.
    """
    rod = {
        "payload.size": [1.6, 0.04, 0.04], "payload.mass": 0.6, "payload.center_of_mass": [0.15, 0, 0],
        "payload.anchors": [[0.75, 0, 0.025], [-0.75, 0, 0.025]],
    }  # fmt: skip
    second = np.rad2deg(np.arctan(1.5 * tan(radians(25))))
    system = make_system(2, **rod, **{"cable.angle": [25, second]})
    np.testing.assert_allclose(system.formation_force[:, 2], 0.6 * GRAVITY * np.array([0.6, 0.4]), rtol=1e-9)
    np.testing.assert_allclose(leans(system)[0], [25, second], atol=1e-9)
    refusal = refuse_system(2, **{key.replace(".", "__"): value for key, value in rod.items()}, cable__angle=[25, 20])
    assert re.match(r"cables that lean as cable\.angle and cable\.azimuth say cannot hold the payload level", refusal)


def test_three_cables_of_one_angle_share_a_point_by_the_sines_between_them():
    """Level forces along three azimuths cancel in proportion to the sines of the angles between the other two."""
    system = make_system(3, **POINT, **{"cable.angle": [35] * 3, "cable.azimuth": [0, 100, 200]})
    sines = np.sin(np.radians([100, 160, 100]))
    np.testing.assert_allclose(system.formation_force[:, 2], 0.7 * GRAVITY * sines / sines.sum(), rtol=1e-9)


@pytest.mark.parametrize(
    "num_drones, overrides",
    [
        (4, {"cable.angle": [20, 30, 25, 28]}),
        (4, {"cable.angle": [0, 30, 10, 30]}),
        (3, {"cable.angle": [20, 30, 40], "cable.model": "chain", "cable.segments": 3}),
        (6, {"cable.angle": [20, 30, 40, 25, 35, 10], "payload.center_of_mass": [0.03, -0.02, 0.01]}),
        (4, {"cable.angle": [25] * 4, "cable.azimuth": [30, 150, 210, -30]}),
        (4, {"cable.azimuth": [30, 150, 210, -30]}),
        (3, POINT | {"cable.angle": [35, 35, 35], "cable.azimuth": [0, 100, 200]}),
        (2, {"cable.angle": [20, 40], "cable.hook": [0, 0, -0.04]} | POINT),
    ],
    ids=str,
)
def test_a_team_rests_where_the_keys_say_and_stays_there(num_drones, overrides):
    """By hand: forces along the cables carry the weight and exert no moment; MuJoCo's bodies stay where they are."""
    system = make_system(num_drones, **overrides)
    cable, force = system.cable_ends - system.anchors, system.formation_force
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, system.payload_mass * GRAVITY], atol=1e-9)
    np.testing.assert_allclose(np.cross(system.anchors, force).sum(axis=0), 0, atol=1e-9)
    angle, azimuth = leans(system)
    if overrides.get("cable.model") != "chain":  # which sags: its lowest link leans so
        np.testing.assert_allclose(np.cross(cable, force), 0, atol=1e-9)
        assert np.abs(accelerations(system)[:3]).max() < 1e-8 or system.hooks.any()
    else:
        angle = np.rad2deg(np.arctan2(np.hypot(force[:, 0], force[:, 1]), force[:, 2]))
    if "cable.angle" in overrides:
        np.testing.assert_allclose(angle, overrides["cable.angle"], atol=1e-6)
    if "cable.azimuth" in overrides:
        np.testing.assert_allclose(turned(azimuth, overrides["cable.azimuth"]), 0, atol=1e-6)


@pytest.mark.parametrize(
    "overrides",
    [{"cable.angle": [20, 30, 25, 28]}, {"cable.angle": [25] * 4, "cable.azimuth": [30, 150, 210, -30]}],
    ids=str,
)
def test_a_team_that_flies_comes_to_rest_where_the_keys_say(overrides):
    known = {"randomization.payload_force": 0.0, "randomization.payload_mass": 0.0, "env.episode_seconds": 12.0}
    vec = make("hover", num_envs=2, **overrides, **known)
    vec.reset(seed=4)
    for _ in range(vec.max_steps - 1):
        vec.step(zeros(vec))
    assert not vec.ended.any()
    state, system = vec.world.state, vec.world.system
    for e in range(2):
        rotation = state.payload_rotation[e]
        np.testing.assert_allclose(rotation[2, 2], 1.0, atol=1e-4)
        cable = (state.drone_position[e] - state.payload_position[e]) @ rotation - system.anchors
        angle = np.rad2deg(np.arctan2(np.hypot(cable[:, 0], cable[:, 1]), cable[:, 2]))
        np.testing.assert_allclose(angle, overrides["cable.angle"], atol=0.2)
        if "cable.azimuth" in overrides:
            azimuth = np.rad2deg(np.arctan2(cable[:, 1], cable[:, 0]))
            np.testing.assert_allclose(turned(azimuth, overrides["cable.azimuth"]), 0, atol=0.5)


def test_one_number_is_approached_and_a_list_of_it_is_held():
    """A load off the middle of its anchors cannot hang by cables of one angle towards their corners; others turn."""
    off = {"payload.center_of_mass": [0.1, 0.05, 0.0]}
    one, held = make_system(4, **off), make_system(4, **off, **{"cable.angle": [30] * 4})
    assert np.ptp(leans(one)[0]) > 0.5
    np.testing.assert_allclose(leans(held)[0], 30, atol=1e-6)
    np.testing.assert_allclose(np.cross(held.anchors, held.formation_force).sum(axis=0), 0, atol=1e-9)


@pytest.mark.parametrize(
    "num_drones, overrides",
    [
        (4, {"cable.angle": [25, 35, 25, 25], "cable.azimuth": [30, 150, 210, -30]}),
        (4, {"cable.azimuth": [0, 140, 220, 320]}),
        (4, {"cable.azimuth": 0}),
        (2, {"cable.angle": [20, 40]}),
        (1, {"cable.angle": [30]}),
        (1, {"cable.azimuth": 30}),
        (3, POINT | {"cable.angle": [30, 30, 30], "cable.azimuth": [0, 100, 150]}),
        (3, POINT | {"cable.azimuth": [0, 30, 60]}),
    ],
    ids=str,
)
def test_what_cannot_balance_is_refused_with_the_nearest_that_can(num_drones, overrides):
    said = refuse_system(num_drones, **{key.replace(".", "__"): value for key, value in overrides.items()})
    lists = re.match(
        r"cables that lean as cable\.angle and cable\.azimuth say cannot hold the payload level, whatever their "
        r"tensions; the nearest that can have cable\.angle=\[(.*)\] and cable\.azimuth=\[(.*)\]$",
        said,
    ).groups()
    angle, azimuth = ([float(number) for number in numbers.split(",")] for numbers in lists)
    system = make_system(num_drones, **overrides | {"cable.angle": angle, "cable.azimuth": azimuth})
    np.testing.assert_allclose(leans(system)[0], angle, atol=0.1)
    assert np.abs(np.sin(np.radians(angle)) * turned(leans(system)[1], azimuth)).max() < 0.1


def test_any_team_that_balances_may_be_asked_for_by_its_leans():
    """Teams of up to ten whose shares differ thirtyfold: their own angles and azimuths are held, by other tensions."""
    rng, held = np.random.default_rng(0), 0
    for _ in range(150):
        n, weight = int(rng.integers(3, 11)), 20.0
        around = np.linspace(0, 2 * np.pi, n, endpoint=False) + rng.uniform(-0.2, 0.2, n)
        anchors = np.stack([0.4 * np.cos(around), 0.3 * np.sin(around), rng.uniform(-0.1, 0.1, n)], axis=1)
        strength = rng.uniform(0.1, 3.0, n)
        try:
            force = formation_forces(anchors, weight, rng.uniform(0.2, 0.7), False, strength / strength.mean())
        except ConfigError:
            continue
        angle = np.arctan2(np.hypot(force[:, 0], force[:, 1]), force[:, 2])
        azimuth = np.arctan2(force[:, 1], force[:, 0])
        again = formation_forces(anchors, weight, angle, False, np.ones(n), azimuth)
        along = np.cross(force, again) / np.linalg.norm(force, axis=1)[:, None] / np.linalg.norm(again, axis=1)[:, None]
        assert np.linalg.norm(along, axis=1).max() < np.radians(0.2)
        np.testing.assert_allclose(again.sum(axis=0), [0, 0, weight], atol=1e-8)
        np.testing.assert_allclose(np.cross(anchors, again).sum(axis=0), 0, atol=1e-8)
        held += 1
    assert held > 100


def test_a_list_has_one_value_for_each_drone_in_range():
    assert refuse_system(cable__angle=[20, 30]).startswith("cable.angle lists 2 values for env.num_drones=4: give one")
    assert refuse_system(cable__azimuth=[20, 30]).startswith("cable.azimuth lists 2 values for env.num_drones=4")
    assert refuse_system(cable__angle=[20, 30, 30, 80]).startswith("cable.angle must be less than 80, but is 80")
    assert refuse_system(cable__azimuth=[400, 0, 0, 0]).startswith("cable.azimuth must be from -360 to 360 deg")


def test_a_list_of_small_angles_is_taken_for_radians(caplog):
    make_system(2, **{"cable.angle": [0.5, 0.5]})
    assert "cable.angle=0.5 is in degrees and almost vertical; if that is in rad, give 28.65" in caplog.text


def test_the_lead_counts_the_height_of_unequal_cables():
    """A cable of 1.2 m at 20° and one at 40° reach up 1.2 (cos 20° + cos 40°)/2 in the mean."""
    from multilift_marl.policies.formation import FormationLead

    even = FormationLead(make("track", num_drones=3))
    assert even._height == 1.0 * cos(radians(30))
    unequal = FormationLead(make("track", num_drones=3, **{"cable.angle": [20, 30, 40]}))
    assert unequal._height == pytest.approx((cos(radians(20)) + cos(radians(30)) + cos(radians(40))) / 3, rel=1e-12)
