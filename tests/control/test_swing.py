"""The shift of set-points against the swing of a payload on two cables."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest
from conftest import load, make, same, zeros
from scipy.spatial.transform import Rotation

from multilift_marl.control.formation import Reference
from multilift_marl.control.swing import anchor_line, shift_with_swing


@pytest.mark.parametrize("yaw", [0.0, 0.7, -2.5])
@pytest.mark.parametrize("line", [(1.0, 0.0, 0.0), (0.6, 0.8, 0.0)])
def test_each_drone_moves_against_the_side_to_which_the_bottom_swings(yaw, line):
    angles = np.array([0.2, -0.4])  # what each of the two believes
    turned = Rotation.from_euler("z", yaw) * Rotation.from_rotvec(angles[:, None] * line)
    around = SimpleNamespace(payload_rotation=turned.as_matrix()[None], anchor_line=np.array(line))
    reference, before = Reference.zeros(1, 2), np.array([[1.0, 2.0, 3.0], [-4.0, 5.0, 6.0]])
    reference.command[0] = before
    shift_with_swing.py_func(0, 1, SimpleNamespace(around=around, reference=reference), 0.5)
    bottom = turned.apply([0.0, 0.0, -1.0])
    level = np.array([1.0, 1.0, 0.0])
    np.testing.assert_allclose(reference.command[0], before - 0.5 * bottom * level, atol=1e-12)


def test_a_turn_that_cables_hold_moves_nothing():
    turned = Rotation.from_euler("ZY", [0.7, 0.3]).as_matrix()  # about the line's normal
    around = SimpleNamespace(payload_rotation=turned[None, None], anchor_line=np.array([1.0, 0.0, 0.0]))
    reference = Reference.zeros(1, 2)
    shift_with_swing.py_func(0, 1, SimpleNamespace(around=around, reference=reference), 0.5)
    np.testing.assert_allclose(reference.command, 0.0, atol=1e-15)


@pytest.mark.parametrize(
    "anchors, line",
    [
        ([(0.3, 0.1, 0.08), (-0.3, 0.1, 0.08)], (1, 0, 0)),
        ([(0.0, -0.2, 0.0), (0.0, 0.2, 0.0)], (0, 1, 0)),
        ([(0.3, -0.4, 0.1), (-0.3, 0.4, 0.1), (0.0, 0.0, 0.1)], (0.6, -0.8, 0)),
        ([(0.3, 0.0, 0.0), (-0.3, 0.0, 0.0), (0.0, 0.01, 0.0)], (0, 0, 0)),
        ([(0.1, 0.2, 0.3)], (0, 0, 0)),
        ([(0.0, 0.0, 0.0)] * 4, (0, 0, 0)),
    ],
)
def test_the_line_is_that_of_all_anchors(anchors, line):
    np.testing.assert_allclose(anchor_line(np.array(anchors)), line, atol=1e-12)


def test_on_a_course_commands_move_as_drones_know_the_payload():
    """Where the goal moves, commands are made anew in each control step."""
    keys = {"control.obstacle_margin": 0.0, "control.payload_margin": 0.0, "control.sector_margin": 0.0}
    vec = make("navigate_senses", 1, 2, **keys, **{"control.swing_shift": 0.5})
    vec.reset(seed=0)
    state = vec.world.state
    for angle in (0.3, -0.2):
        state.payload_rotation[0] = Rotation.from_rotvec(angle * anchor_line(vec.world.system.anchors)).as_matrix()
        state.payload_body_rates[0] = 0.0
        load(vec.world)
        vec.step(zeros(vec))
        bottom = -state.payload_rotation[0, :, 2]
        assert abs(bottom[1]) > 0.05
        shifted = vec.reference.command[0] - vec.task.goal.slots[0]
        np.testing.assert_allclose(shifted, np.tile(-0.5 * bottom * [1.0, 1.0, 0.0], (2, 1)), atol=0.02)


def swung(shift: float, **rig) -> float:
    """Return how fast two falcons' payload still turns about the line 12 to 15 s after a push [rad/s]; zero actions."""
    keys = {"control.swing_shift": shift, "env.episode_seconds": 15.0, "task_options.start_radius": 0.0}
    vec, speed = make("hover", 1, 2, **keys, **rig), []
    vec.reset(seed=0)
    rates = vec.world.state.payload_body_rates
    rates[0] = 0.8 * anchor_line(vec.world.system.anchors)
    load(vec.world)
    for _ in range(vec.max_steps - 1):
        vec.step(zeros(vec))
        speed.append(rates[0] @ anchor_line(vec.world.system.anchors))
    return float(np.abs(speed[-150:]).max())


def test_the_shift_damps_the_swing_and_too_much_feeds_it():
    late = [swung(shift) for shift in (0.0, 0.06, 0.3)]
    np.testing.assert_allclose(late, [0.35, 0.12, 0.88], rtol=0.1)


def test_where_the_swing_dies_sooner_the_same_shift_prolongs_it():
    assert swung(0.06, **{"cable.length": 0.5}) > 2.0 * swung(0.0, **{"cable.length": 0.5})


def test_where_anchors_are_on_no_line_it_changes_nothing():
    first, second = (make("hover", 2, 3, **{"control.swing_shift": shift}) for shift in (0.0, 0.5))
    for vec in (first, second):
        vec.reset(seed=1)
        for _ in range(50):
            vec.step(0.3 * np.ones_like(zeros(vec)))
    assert same(first.world.state.payload_position, second.world.state.payload_position)
