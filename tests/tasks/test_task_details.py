"""What single tasks observe, note and count, each by its definition, on both sides of its limits."""

from __future__ import annotations

import numpy as np
import pytest
from plain_kernels import plain, record, turned

from multilift_marl.deploy.ros.failsafe import is_landing, sink
from multilift_marl.mdp.failures import LOAD_GROUND, ignore
from multilift_marl.sim.state import SystemState
from multilift_marl.tasks import gate, land, loss, pose, recover, takeoff, track

# Pose


@pytest.mark.parametrize("stage, time, good, noted", [
    (0, 4.98, 2.0, None), (0, 5.0, 2.0, True), (0, 5.0, 1.97, False), (1, 10.0, 2.0, True), (2, 11.0, 1.0, True),
    (2, 11.0, 0.97, False), (2, 10.98, 1.0, None),
])  # fmt: skip
def test_a_target_is_reached_if_the_payload_is_held_as_its_time_ends(stage, time, good, noted):
    settings = record(hold=5.0, length=11.0, success_seconds=2.0)  # the last target has a second
    own = record(plan=record(stage=np.array([stage])), reached=np.full((1, 3), 9))
    view = record(settings=settings, own=own, time=np.array([time]), good_time=np.array([good]), dt=0.02)
    plain(pose.note_reached)(0, view)
    assert own.reached[0, stage] == (9 if noted is None else noted)
    left = plain(pose.time_left)(0, 0, view)
    assert left == pytest.approx((5.0 * (stage + 1) - time) / 5.0)


def test_the_plan_is_observed_from_the_target():
    first, second = turned([1, 2, 3], 0.5), turned([0.3, -1, 0.4], 0.9)
    goal = record(position=np.array([[1.0, 2.0, 3.0]]), rotation=first[None])
    planned = record(position=np.array([[1.4, 1.5, 3.3]]), velocity=np.array([[0.1, 0.2, 0.3]]), rotation=second[None])
    view = record(goal=goal, planned=planned)
    np.testing.assert_allclose(plain(pose.planned_position)(0, 0, view), [0.4, -0.5, 0.3])
    np.testing.assert_allclose(plain(pose.planned_velocity)(0, 0, view), [0.1, 0.2, 0.3])
    vector = np.array(plain(pose.planned_rotation)(0, 0, view))
    np.testing.assert_allclose(turned(vector, np.linalg.norm(vector)) @ first, second, atol=1e-12)


# Recover, loss


@pytest.mark.parametrize("time, grace, left", [(0.0, 3.0, 1.0), (1.2, 3.0, 0.6), (3.5, 3.0, 0.0), (0.1, 0.0, 0.0)])
def test_grace_is_observed_as_the_share_that_is_left(time, grace, left):
    view = record(
        time=np.array([time]), settings=record(grace=grace), own=record(peak_tension=np.array([2.0])),
        mask=record(ignored=np.array([7]), lost=np.array([[False]])), resting_tension=np.array([4.0]),
        state=record(cable_tension=np.array([[12.0]])),
    )  # fmt: skip
    assert plain(recover.grace)(0, 0, view) == pytest.approx(left)
    plain(recover.end_grace)(0, view)
    assert view.mask.ignored[0] == (0 if time > grace else 7)
    assert view.own.peak_tension[0] == 3.0


def lost_team(time: float, snap: bool = False):
    own = record(
        who=np.array([2]), when=np.array([1.5]), known=np.array([[True, False, True]]), known_who=np.array([[2, 2, 2]]),
        known_when=np.array([[1.7, 9.0, 1.6]]), unsure=np.array([[False, False, True]]), peak_tension=np.array([2.4]),
        counted_tension=np.array([2.0]),
    )  # fmt: skip
    return record(
        own=own, time=np.array([time]), settings=record(snap=snap, tension=3.0, offsets=np.full((3, 3, 3), 0.3)),
        mask=record(lost=np.zeros((1, 3), bool)), disturbances=record(motors_off=np.zeros((1, 3), bool)),
        state=record(cable_broken=np.zeros((1, 3), bool), cable_tension=np.array([[2.0, 9.0, 8.0]])),
        rig=record(azimuth=np.array([0.3, 2.4, -1.9])), resting_tension=np.array([2.0, 3.0, 1.0]),
    )  # fmt: skip


@pytest.mark.parametrize("snap", [False, True])
@pytest.mark.parametrize("time", [1.49, 1.5, 2.0])
def test_motors_stop_when_their_time_has_come(time, snap):
    view = lost_team(time, snap)
    plain(loss.stop_motors)(0, view)
    gone = [False, False, time >= 1.5]
    assert view.mask.lost[0].tolist() == view.disturbances.motors_off[0].tolist() == gone
    assert view.state.cable_broken[0].tolist() == [False, False, gone[2] and snap]
    assert view.own.peak_tension[0] == (3.0 if gone[2] else 8.0)  # 9/3; a lost drone's cable does not count


def test_tension_costs_what_it_rises_above_three_quarters_of_the_limit():
    view = lost_team(2.0)
    for before, peak, cost in ((2.0, 2.4, (2.4 - 2.25) / 3.0), (2.5, 2.8, 0.1), (1.0, 2.2, 0.0), (2.8, 2.8, 0.0)):
        view.own.counted_tension[0], view.own.peak_tension[0] = before, peak
        assert plain(loss.snatch)(0, view) == pytest.approx(cost)


def test_a_loss_is_observed_by_those_who_know_of_it():
    view = lost_team(2.2)
    view.mask.lost[0, 2] = True
    assert [plain(loss.lost)(0, n, view) for n in range(3)] == [0.0, 0.0, 1.0]
    assert plain(loss.team_lost)(0, 0, view) == 1.0
    angle = -1.9 - 0.3
    np.testing.assert_allclose(plain(loss.lost_direction)(0, 0, view), [np.cos(angle), np.sin(angle)])
    assert plain(loss.lost_direction)(0, 1, view) == (0.0, 0.0)
    assert plain(loss.lost_direction)(0, 2, view) == (1.0, 0.0)  # unsure of the side
    np.testing.assert_allclose(plain(loss.lost_azimuth)(0, 0, view), [np.cos(-1.9), np.sin(-1.9)])
    # within 0.9 s drones give way: 0.2 m outward, 0.2 m down and 0.5 m more towards the lost one
    found = plain(loss.planned_offset)(0, 0, view)
    np.testing.assert_allclose(found, [0.2, 0.0, -(0.2 + 0.5 * np.cos(-2.2))], atol=1e-12)
    assert plain(loss.planned_offset)(0, 1, view) == (0.0, 0.0, 0.0)
    for time, share in ((1.7 + 2.5, 0.5), (1.7 + 1.75, 0.25**2 * 2.5), (1.7 + 4.0, 1.0), (9.0, 1.0)):
        view.time[0] = time
        np.testing.assert_allclose(plain(loss.planned_offset)(0, 0, view), [0.3 * share] * 3, atol=1e-12)
    for time, share in ((1.5 + 1.0, 0.25), (1.5 + 4.0, 1.0), (20.0, 1.0)):
        view.time[0] = time
        assert plain(loss.progress)(0, 0, view) == pytest.approx(share)


# Take-off and landing


@pytest.mark.parametrize("time, left", [(0.0, 4.1), (3.0, 1.1), (6.1, -2.0), (9.0, -4.0)])
def test_the_time_to_the_lift_is_observed(time, left):
    view = record(
        time=np.array([time]), goal=record(velocity=np.array([[0.1, 0.2, 0.3]])), own=record(peak=np.array([1.8])),
        settings=record(lift=(4.1, 2.5)),
    )  # fmt: skip
    assert plain(takeoff.time_to_lift)(0, 0, view) == pytest.approx(left)
    assert plain(takeoff.climb_rate)(0, 0, view) == 0.3
    for peak, cost in ((1.8, 0.3), (1.5, 0.0), (2.7, 1.0)):
        view.own.peak[0] = peak
        assert plain(takeoff.snatch)(0, view) == pytest.approx(cost)
    plain(takeoff.forget_peak)(0, view)
    assert view.own.peak[0] == 0.0


def landed_team():
    state = SystemState.zeros(1, 2)
    state.payload_position[0], state.drone_position[0] = [0.52, -0.24, 0.1], [[1.2, -0.2, 0.6], [-0.3, -0.2, 0.6]]
    limits = record(payload_half=np.array([0.3, 0.2, 0.1]), payload_center=(0.0, 0.0, 0.0), payload_round=False)
    own = record(
        course=np.array([[0.5, -0.3, -1.4]]), touch=np.array([land.AIRBORNE]), speed=np.zeros(1),
        pull_fraction=np.array([0.25]),
    )  # fmt: skip
    settings = record(
        radius=0.1,
        speed=0.3,
        clearance=0.3,
        drone_half=0.1,
        settle=(4.8, 1.6),
        ground=record(cable_weight=np.array([0.5, 0.4])),
        origin=(0.0, 0.0),
    )
    state.cable_tension[0] = [0.5, 0.4]
    return record(
        state=state, limits=limits, own=own, settings=settings, mask=record(ignored=np.array([0])),
        time=np.array([5.0]), resting_tension=np.array([4.0, 5.0]), action=np.zeros((1, 2, 4)),
        goal=record(velocity=np.array([[1.0, 2, 3]])),
    )  # fmt: skip


def test_a_payload_lands_softly_on_its_pad_or_has_crashed():
    assert plain(land.off_pad)(0, landed_team()) == pytest.approx(np.hypot(0.02, 0.06))
    for height, speed, before, x, expected in (
        (0.1049, 0.29, 0.29, 0.52, land.LANDED), (0.1051, 0.29, 0.29, 0.52, land.AIRBORNE),
        (0.1, 0.31, 0.0, 0.52, land.CRASHED), (0.1, 0.0, 0.31, 0.52, land.CRASHED),
        (0.1, 0.1, 0.1, 0.581, land.CRASHED), (0.1, 0.1, 0.1, 0.579, land.LANDED),
    ):  # fmt: skip
        view = landed_team()
        view.state.payload_position[0, [0, 2]], view.own.speed[0] = [x, height], before
        view.state.payload_velocity[0] = [0.6 * speed, 0.0, -0.8 * speed]
        plain(land.see_touchdown)(0, view)
        assert view.own.touch[0] == expected and view.own.speed[0] == pytest.approx(speed)
        assert view.mask.ignored[0] == (ignore(LOAD_GROUND) if expected == land.LANDED else 0)


def test_a_payload_is_put_down_at_rest_with_slack_cables_and_clear_drones():
    assert plain(land.is_put_down)(0, landed_team())
    for change in (
        lambda v: v.state.cable_tension.__setitem__((0, 1), 0.41),
        lambda v: v.state.payload_velocity.__setitem__((0, 1), 0.021),
        lambda v: v.state.payload_position.__setitem__((0, 2), 0.106),
        lambda v: v.own.course.__setitem__((0, 1), -0.14),
        lambda v: v.state.drone_position.__setitem__((0, 0), [1.21, -0.2, 0.39]),
    ):
        view = landed_team()
        change(view)
        assert not plain(land.is_put_down)(0, view)


@pytest.mark.parametrize("place", [
    (0.3 + 0.24, 0.0, 0.2 + 0.32), (0.0, 0.2 + 0.24, 0.2 + 0.32), (-0.3 - 0.32, 0.0, 0.2 + 0.24), (0.0, 0.0, 0.2 + 0.4),
    (0.3 + 0.24, -0.2 - 0.24, 0.2 + np.sqrt(0.16 - 2 * 0.24**2)), (3.0, 0.0, 0.4),
])  # fmt: skip
def test_drones_are_clear_0_3_m_from_payload_and_ground_beyond_their_own_extent(place):
    for factor, clear in ((1.001, True), (0.999, False)):
        view = landed_team()
        near = np.clip(place, [-0.3, -0.2, 0.0], [0.3, 0.2, 0.2]) if place[0] < 2 else np.array([3.0, 0.0, 0.0])
        away = near + factor * (np.array(place) - near)  # 0.4 m from the payload, or above the ground
        view.state.drone_position[0, 0] = np.array([0.52, -0.24, 0.0]) + away
        assert plain(land._drone_clear)(0, 0, view) == clear


def test_slackness_counts_tension_beyond_the_cables_own_weight_as_the_pull_fades():
    view = landed_team()
    view.state.cable_tension[0] = [0.5 + 2.0, 0.3]
    loose = (1 / (1 + (2.0 / 4.0 / 0.2) ** 2) + 1.0) / 2
    assert plain(land.slackness)(0, view, 0.2) == pytest.approx(0.75 * loose)
    assert plain(land.time_to_touch)(0, 0, view) == pytest.approx(6.4 - 5.0)
    assert plain(land.target_velocity)(0, 0, view) == (1.0, 2.0, 3.0)


# Gate and track


def test_gaps_are_observed_from_their_middles_and_edges():
    settings = record(
        x=np.array([-0.75, 0.75]), clear=np.array([0.3]), passed=0.9, level=1.3, drone=np.array([[0.2, 0.15, 0.06]])
    )
    own = record(gap_y=np.array([[0.1, -0.2]]), half_width=np.array([[0.5, 0.6]]))
    state = SystemState.zeros(1, 1)
    view = record(settings=settings, own=own, state=state, estimated=state, action=np.zeros((1, 1, 4)))
    state.drone_rotation[0, 0] = turned([0.1, 0.2, 1.0], 0.4)
    reach = np.abs(state.drone_rotation[0, 0, 1]) @ settings.drone[0]
    for x, gap in ((-1.0, 0), (0.2, 1), (1.2, None)):
        state.drone_position[0, 0] = [x, 0.25, 2.0]
        offset = plain(gate.gap_offset)(0, 0, view)
        room = 0.5 if gap is None else own.half_width[0, gap] - abs(0.25 - own.gap_y[0, gap]) - reach
        assert offset == pytest.approx((0.0, 0.0 if gap is None else 0.25 - own.gap_y[0, gap], 0.0))
        assert plain(gate.clearance)(0, 0, view) == pytest.approx(min(room, 0.5))
        assert plain(gate.gap_distance)(0, 0, view) == pytest.approx(x - settings.x[1 if gap is None else gap])
        lacking = max(0.05 - room, 0.0)
        assert plain(gate.passage)(0, view, 0.25) == pytest.approx(1 / (1 + (lacking / 0.25) ** 2))
    for x, gap in ((0.149, 0), (0.151, 1), (5.0, 1)):
        state.payload_position[0] = [x, 0.3, 1.5]
        assert plain(gate.payload_gap_width)(0, 0, view) == pytest.approx(2 * own.half_width[0, gap])
        expected = (x - settings.x[gap], 0.3 - own.gap_y[0, gap], 0.2)
        assert plain(gate.payload_gap_offset)(0, 0, view) == pytest.approx(expected)


def test_a_track_notes_its_worst_distance_and_pays_for_the_heading():
    view = record(
        own=record(worst=np.array([0.2])), errors=record(distance=np.array([0.3]), rotation=np.array([[9.0, 9.0, 0.5]]))
    )
    plain(track.update_max_error)(0, view)
    assert view.own.worst[0] == 0.3
    view.errors.distance[0] = 0.1
    plain(track.update_max_error)(0, view)
    assert view.own.worst[0] == 0.3
    assert plain(track.heading)(0, view, 0.25) == pytest.approx(0.2)


# Without news


def test_drones_without_news_sink_to_the_ground_at_most():
    places, late = np.array([[1.0, 2.0, 1.0], [0, 0, 0.1], [0, 0, -0.3], [0, 0, 2.0]]), np.array([1, 1, 1, 0], bool)
    sink(places, late, 0.5)
    np.testing.assert_allclose(places, [[1.0, 2.0, 0.8], [0, 0, 0], [0, 0, -0.3], [0, 0, 2.0]])
    assert is_landing(np.array([0.1, 2.0, 60.0, np.inf])).tolist()[-2:] == [True, False]
