"""Systems: which cannot be, and the standard rig of every team."""

from __future__ import annotations

import re

import numpy as np
import pytest
from conftest import GRAVITY, make_system, refusal, refuse_system, refuse_task

import multilift_marl as ml
from multilift_marl.errors import ConfigError
from multilift_marl.rig import balance
from multilift_marl.rig.balance import formation_forces, nonnegative_least_squares
from multilift_marl.rig.feasibility import MIN_THRUST_TO_WEIGHT
from multilift_marl.rig.presets import PRESETS

# What is refused

PLANE = [[0.25, 0.2, 0.08], [-0.25, 0.2, 0.08], [-0.25, -0.2, 0.08], [0.25, -0.2, 0.08]]


def test_anchors_out_of_reach():
    message = refuse_system(payload__anchors=[[5.0, 5.0, 0.08], *PLANE[1:]])
    assert re.match(r"payload\.anchors: anchor 0 is out of reach, 6\.\d\d m outside .*; move it", message)


def test_anchors_in_one_place_beside_the_centre_cannot_hold_level():
    message = refuse_system(payload__anchors=[[0.25, 0.2, 0.08]] * 4)
    assert re.match(r"payload\.anchors .* cannot hold the payload level: place them around", message)


@pytest.mark.parametrize(
    "payload",
    [{"payload.anchor_radius": 0.2}, {"payload.anchors": [[0.2, 0, 0.08]]}, {"payload.center_of_mass": [-0.1, 0, 0]}],
)
def test_one_drone_cannot_hold_level_beside_the_centre(payload):
    message = refuse_system(1, **payload)
    assert re.match(r"env\.num_drones=1 cannot hold the payload level by an anchor .*: raise env\.num_drones", message)


def test_anchors_on_one_side_would_need_a_cable_that_pushes():
    message = refuse_system(
        payload__anchors=[[0.25, 0.2, 0.08], [0.3, -0.2, 0.08], [0.28, 0.0, 0.08], [0.02, 0.0, 0.08]]
    )
    assert re.match(r"payload\.anchors: cable \d would have to push; move", message)


@pytest.mark.parametrize(
    "overrides",
    [
        {"cable.angle": 0, "payload.anchors": [[x / 5, y / 5, z] for x, y, z in PLANE]},
        {"payload.shape": "point", "cable.length": 0.3},
    ],
    ids=["parallel cables", "short cables"],
)
def test_neighbours_too_close_at_rest(overrides):
    message = refuse_system(**overrides)
    assert re.match(
        r"neighbouring drones \d+ and \d+ would rest 0\.\d\d m apart, closer than 1\.1 × .*0\.35 m; raise cable\.",
        message,
    )


@pytest.mark.parametrize(
    "drawn",
    [{"randomization.payload_mass": 0.3}, {"randomization.cable_stiffness": 0.3}, {"randomization.cable_length": 0.05}],
    ids=lambda drawn: next(iter(drawn)),
)
def test_neighbours_too_close_on_the_least_stretched_cables_that_are_drawn(drawn):
    fixed = dict.fromkeys(("payload_mass", "cable_stiffness", "cable_length"), 0.0)
    soft = {"payload.shape": "point", "payload.mass": 0.5, "cable.angle": 30, "cable.stiffness": 100.0}
    soft |= {f"randomization.{name}": value for name, value in fixed.items()}
    usual = make_system(2, **soft | {"cable.length": 1.0})
    stretch = np.linalg.norm(usual.slots[0] - usual.slots[1]) - 1.0  # the cables make a triangle of equal sides
    soft["cable.length"] = 0.386 - stretch
    system = make_system(2, **soft)
    assert np.isclose(np.linalg.norm(system.slots[0] - system.slots[1]), 0.386)
    assert re.match(r"neighbouring drones 0 and 1 may rest 0\.3\d m apart", refuse_system(2, **soft | drawn))


@pytest.mark.parametrize("share, refused", [(1.09, True), (1.11, False)])
def test_drones_at_rest_keep_a_tenth_more_than_the_separation_limit(share, refused):
    """Two drones whose cables lean by the angle a from a point rest 2 (L + stretch) sin(a) apart."""
    stretched = 1.0 + 0.7 * GRAVITY / 2 / np.cos(np.arcsin(0.35 * share / 2)) / 1e5
    pair = {"cable.length": 1.0, "cable.angle": np.rad2deg(np.arcsin(0.35 * share / 2 / stretched))}
    pair |= {"payload.shape": "point", "payload.mass": 0.7, "randomization.payload_mass": 0.0}
    if refused:
        message = refuse_system(2, **{key.replace(".", "__"): value for key, value in pair.items()})
        assert re.match(
            r"neighbouring drones 0 and 1 would rest 0\.38 m apart, closer than 1\.1 × the separation", message
        )
    else:
        assert np.linalg.norm(np.subtract(*make_system(2, **pair).slots)) == pytest.approx(0.35 * share, rel=1e-6)


def heaviest(num_drones: int) -> float:
    """Return the payload mass at which the team's thrust is 1.18 times the weight of drones and payload."""
    vehicle = PRESETS["falcon"]
    lift = num_drones * 4 * vehicle.rotor_thrust_max
    return lift / (MIN_THRUST_TO_WEIGHT * GRAVITY) - num_drones * vehicle.mass


@pytest.mark.parametrize("count", [1, 4, 6])
def test_team_thrust_below_1_18_times_the_weight_is_refused(count):
    assert MIN_THRUST_TO_WEIGHT == 1.18
    make_system(count, **{"payload.mass": 0.999 * heaviest(count), "cable.angle": 10})
    message = refuse_system(count, payload__mass=1.001 * heaviest(count), cable__angle=10)
    assert re.match(rf"{count} × falcon lift {count * 20}\.0 N, less than 1\.18 × .*; lower payload\.mass", message)


def test_a_drone_that_could_not_hover_is_refused():
    assert re.match(
        r"drone \d would need .* to hover under the heaviest payload; lower payload\.mass",
        refuse_system(cable__angle=79),
    )


@pytest.mark.parametrize("names", [("vehicle_thrust_coefficient",), ("rotor_thrust_coefficient",),
                                   ("vehicle_thrust_coefficient", "rotor_thrust_coefficient")])  # fmt: skip
def test_a_drone_has_to_hover_by_its_weakest_rotors(names):
    """The share of the thrust that hovering takes: as much as rotors may lose, all draws together."""
    system = make_system(4)
    needed = np.linalg.norm(system.hook_force + system.drone_mass[:, None] * [0, 0, GRAVITY], axis=1).max()
    least = (needed / (4 * system.vehicle.rotor_thrust_max)) ** (1 / len(names))

    def drawn(share):
        return {"randomization__payload_mass": 0.0} | {f"randomization__{name}": 1 - share for name in names}

    make_system(4, **{key.replace("__", "."): value for key, value in drawn(1.001 * least).items()})
    said = refuse_system(4, **drawn(0.999 * least))
    assert f"lower {''.join(f'randomization.{name}, ' for name in names)}payload.mass" in said


def test_inertia_against_the_triangle_inequality():
    message = refuse_system(payload__inertia=[0.01, 0.01, 0.03])
    assert re.match(r"payload\.inertia \[0\.01, 0\.01, 0\.03\] is impossible: no moment may exceed the sum", message)


def test_a_flat_body_has_the_largest_possible_inertia():
    assert make_system(4, **{"payload.inertia": [0.01, 0.01, 0.02]}).payload_inertia.tolist() == [0.01, 0.01, 0.02]


def test_point_payload_has_no_place_for_anchors():
    message = refuse_system(payload__shape="point", payload__anchors=PLANE)
    assert re.match(r"payload\.anchors of a point payload must all be \[0, 0, 0\]; use payload\.shape=box", message)


@pytest.mark.parametrize("overrides", [{"sim.control_hz": 300}, {"sim.control_hz": 200}, {"sim.timestep": 0.003}])
def test_control_rate_that_is_no_whole_number_of_physics_steps(overrides):
    assert re.match(
        r"sim\.control_hz=\d+ must divide 1/sim\.timestep=[\d.]+ into whole steps", refuse_system(**overrides)
    )


@pytest.mark.parametrize("rate", [60, 300])
def test_policy_rate_that_is_no_whole_number_of_control_steps(rate):
    message = refuse_task(env__policy_hz=rate)
    assert re.match(rf"env\.policy_hz={rate} must divide sim\.control_hz=250 into whole steps", message)


def test_episode_shorter_than_a_step():
    assert re.match(
        r"env\.episode_seconds=0\.001 is shorter than one step; raise it", refuse_task(env__episode_seconds=1e-3)
    )


def test_start_that_always_fails_names_the_failure_and_the_cure():
    block = {"shape": "box", "size": [9, 9, 3], "position": [0, 0, 2]}
    vec = ml.make_vec("hover", num_envs=1, num_threads=1, **{"scene.obstacles": [block]})
    message = refusal(vec.reset)
    assert re.match(
        r"no start of task hover is free of failure \(obstacle_collision\).*, narrow the start ranges in task_options",
        message,
    )


# The standard rig


@pytest.mark.parametrize("shape", ["box", "point"])
@pytest.mark.parametrize("num_drones", [1, 2, 3, 4, 5, 6, 16, 64])
def test_standard_rig_scales_with_the_team(num_drones, shape):
    system = make_system(num_drones, **{"payload.shape": shape})
    assert system.payload_mass == pytest.approx(0.35 * num_drones)
    apart = np.linalg.norm(system.slots[:, None] - system.slots[None], axis=-1)[~np.eye(num_drones, dtype=bool)]
    assert (apart >= 0.6 - 1e-6).all()


@pytest.mark.parametrize("num_drones", [2, 3, 4, 6])
def test_cables_of_the_standard_rig_stand_at_their_angle(num_drones):
    force = make_system(num_drones, **{"cable.angle": 25}).formation_force
    np.testing.assert_allclose(np.hypot(force[:, 0], force[:, 1]) / force[:, 2], np.tan(np.deg2rad(25)), rtol=1e-9)


def test_box_inertia_is_that_of_a_uniform_box():
    system = make_system(4, **{"payload.mass": 1.2, "payload.size": [0.6, 0.4, 0.2]})
    np.testing.assert_allclose(system.payload_inertia, [0.1 * (0.16 + 0.04), 0.1 * (0.36 + 0.04), 0.1 * (0.36 + 0.16)])


@pytest.mark.parametrize("seed", range(4))
def test_formation_forces_balance_weight_and_moments_of_any_anchors(seed):
    rng = np.random.default_rng(seed)
    around = np.linspace(0, 2 * np.pi, 5, endpoint=False) + rng.uniform(-0.2, 0.2, 5)
    anchors = np.stack([0.4 * np.cos(around), 0.3 * np.sin(around), rng.uniform(-0.1, 0.1, 5)], axis=1)
    force = formation_forces(anchors, 20.0, np.deg2rad(30), point=False, strength=np.ones(5))
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, 20], atol=1e-9)
    np.testing.assert_allclose(np.cross(anchors, force).sum(axis=0), 0, atol=1e-9)


# Loads off the middle of their anchors


def shares_by_hand(anchors: np.ndarray, weight: float, least: float, rng: np.random.Generator) -> np.ndarray:
    """Return vertical forces that balance, at least `least`, by projections in turn (Dykstra's), from anywhere."""
    balance = np.stack([np.ones(len(anchors)), anchors[:, 0], anchors[:, 1]])
    back, load = np.linalg.pinv(balance), np.array([weight, 0.0, 0.0])
    force = np.full(len(anchors), weight / len(anchors))
    kept = np.zeros(len(anchors))
    for _ in range(20_000):
        level = force + back @ (load - balance @ force)
        force = np.maximum(level + kept, least)
        kept = level + kept - force
    return force


@pytest.mark.parametrize("center", [[0.14, 0.112, 0.0], [0.2, 0.16, 0.0], [-0.21, 0.17, -0.03]])
def test_a_load_that_hangs_well_within_its_anchors_is_carried_by_all_cables(center):
    system = make_system(4, **{"payload.center_of_mass": center})
    weight, force, anchors = GRAVITY * 1.4, system.formation_force, system.anchors
    np.testing.assert_allclose(force.sum(axis=0), [0, 0, weight], atol=1e-9)
    np.testing.assert_allclose(np.cross(anchors, force).sum(axis=0), 0, atol=1e-9)
    assert force[:, 2].min() > 0.045 * weight / 4
    assert np.rad2deg(np.arctan2(np.hypot(force[:, 0], force[:, 1]), force[:, 2])).max() < 35.0
    nearest = shares_by_hand(anchors, weight, 0.05 * weight / 4, np.random.default_rng(0))
    np.testing.assert_allclose(force[:, 2], nearest, atol=0.02 * weight)


def test_every_load_within_its_anchors_has_shares_and_none_without():
    """A load is held if it lies in the anchors' convex hull, drawn in towards their middle by the least shares."""
    rng, held = np.random.default_rng(3), 0
    for _ in range(300):
        around = np.sort(rng.uniform(0, 2 * np.pi, 6))
        ring = np.stack([0.4 * np.cos(around), 0.4 * np.sin(around), np.full(6, 0.08)], axis=1)
        anchors = ring - [*rng.uniform(-0.4, 0.4, 2), 0.0]
        shrunk = 0.05 * anchors[:, :2].mean(axis=0) + 0.95 * anchors[:, :2]
        edges = np.roll(shrunk, -1, axis=0) - shrunk
        inside = (edges[:, 1] * shrunk[:, 0] - edges[:, 0] * shrunk[:, 1]).min()  # > 0: the origin is left of all
        if abs(inside) < 1e-4:
            continue
        try:
            force = formation_forces(anchors, 20.0, np.deg2rad(30), point=False, strength=np.ones(6))
        except ConfigError as error:
            assert inside < 0 and "would have to push" in str(error)
            continue
        held += 1
        np.testing.assert_allclose(np.cross(anchors, force).sum(axis=0), 0, atol=1e-9)
        assert force[:, 2].min() > 0
    assert held > 100


def test_non_negative_least_squares_meets_its_conditions():
    """x ≥ 0, no error that a larger x would lower, and none left along what is positive (Karush, Kuhn and Tucker)."""
    rng, bound = np.random.default_rng(0), 0
    for _ in range(100):
        matrix, target = rng.normal(size=(8, 6)), rng.normal(size=8)
        x = nonnegative_least_squares(matrix, target)
        slope = matrix.T @ (target - matrix @ x)
        assert x.min() >= 0 and slope.max() < 1e-8
        np.testing.assert_allclose(slope[x > 0], 0, atol=1e-8)
        bound += (x == 0).any()
    assert bound > 50


@pytest.mark.parametrize(
    ("force", "pull"),
    [
        ([0.0, 0.3, 1.0], True),
        ([0.0, 0.3, 1e-4], False),  # too little of its share
        ([1e-9, 0.0, 1e-4], False),  # likewise, upright
        ([0.0, 300.0, 1.0], False),  # too flat
    ],
)
def test_every_cable_is_to_pull_and_to_stand(force, pull):
    forces = np.array([[0.0, -0.3, 1.0], force])
    assert balance._all_pull(forces, np.ones(2)) is pull


# A ring of anchors of one's own


@pytest.mark.parametrize("n", [3, 4, 6])
def test_anchors_lie_on_a_ring_of_the_radius_that_is_asked_for(n):
    system = make_system(n, **{"payload.anchor_radius": 0.55})
    azimuth = 2 * np.pi * np.arange(n) / n
    np.testing.assert_allclose(
        system.anchors[:, :2], 0.55 * np.stack([np.cos(azimuth), np.sin(azimuth)], 1), atol=1e-12
    )
    np.testing.assert_allclose(system.payload_size, [1.1, 1.1, 0.15])
    given = make_system(n, **{"payload.anchor_radius": 0.3, "payload.size": [0.9, 0.8, 0.2]})
    np.testing.assert_allclose(np.linalg.norm(given.anchors[:, :2], axis=1), 0.3)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ({"payload__size": [1.2, 1.0, 0.1]}, "payload.anchor_radius=0.55 lies outside a payload of 1 m"),
        ({"payload__anchors": PLANE}, "payload.anchor_radius is for anchors on a ring"),
        ({"payload__shape": "point"}, "payload.anchor_radius is for anchors on a ring"),
    ],
)
def test_a_ring_that_cannot_be_is_refused(overrides, said):
    assert said in refuse_system(payload__anchor_radius=0.55, **overrides)
