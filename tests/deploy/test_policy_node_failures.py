"""What the policy node does about what is late, lost, wrong, far away or not wanted; on a clock of the test's own."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import multilift_marl as ml
from multilift_marl.envs.core import EVALUATION, MultiliftVec
from multilift_marl.policies.baselines import make_scripted

pytest.importorskip("rosbags")  # of the ros extra
pytest.importorskip("cyclonedds")
from ros_wire import Wire

from multilift_marl.deploy.ros import policy_node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER, LAND_AFTER, SINK
from multilift_marl.deploy.ros.messages import BOOL, FlightMessages, pose_stamped
from multilift_marl.deploy.ros.policy_node import FLYING, HOLDING, LANDING, READY, WAITING, PolicyNode
from multilift_marl.deploy.ros.types import read_pose

ODOMETRY = ("/drone_0/odom", "/drone_1/odom", "/payload/odom")
UPSIDE_DOWN = np.diag([1.0, -1.0, -1.0])


class Bench:
    """A node on a wire, the team that it hears, which stays where it is put, and the clock on the wall."""

    def __init__(self, monkeypatch, make_policy: Any = None, names: str = "multilift", **changes: Any):
        self.now, self.said, self.wire = 100.0, [], Wire()
        monkeypatch.setattr(policy_node.time, "perf_counter", lambda: self.now)
        node = {key: changes.pop(key) for key in ("start",) if key in changes}
        values = {"env.num_envs": 1, "env.num_threads": 1, "env.num_drones": 2, "payload.mass": 0.7, **changes}
        config = ml.load_config("hover", values)
        self.vec = MultiliftVec(config, EVALUATION)
        self.vec.reset(seed=5)
        make_policy = make_policy or (lambda team: make_scripted("formation", team))
        self.node = PolicyNode(config, make_policy, self.wire, names, 5, say=self.said.append, **node)
        self.messages = FlightMessages(self.vec, self.wire.store, names)
        self.time_ns = 0

    def send(self, *topics: str, late: float = 0.0) -> None:
        """Publish the state on some topics, stamped as if measured `late` seconds ago."""
        for topic, message in self.messages.messages(self.time_ns - round(late * 1e9)):
            if topic in topics:
                self.wire.queues[topic].append(message)

    def tell(self, name: str, position, rotation=None) -> None:
        rotation = self.vec.task.goal.rotation[0] if rotation is None else rotation
        self.wire.queues[name].append(pose_stamped(self.wire.store, self.time_ns, np.asarray(position), rotation))

    def pass_by(self, seconds: float = 0.02, silent: tuple[str, ...] = ()) -> None:
        """Let time pass; publish the state but for the topics that are silent; and let the node do its part."""
        self.now += seconds
        self.time_ns += round(seconds * 1e9)
        for topic, message in self.messages.messages(self.time_ns):
            if "*" not in silent and topic not in silent:
                self.wire.queues[topic].append(message)
        self.node.spin_once(1.0)

    def fly(self, steps: int = 10) -> None:
        for _ in range(steps):
            self.pass_by()
        assert self.node.mode == FLYING

    def places(self) -> np.ndarray:
        return np.array([read_pose(self.wire.sent[f"/drone_{n}/setpoint"][-1].pose)[0] for n in range(2)])


def test_nothing_is_published_before_all_is_heard(monkeypatch):
    bench = Bench(monkeypatch)
    for _ in range(200):
        bench.pass_by(silent=("/drone_1/odom",))
    assert bench.node.mode == WAITING and not bench.wire.sent["/drone_0/setpoint"]
    assert bench.said == ["waiting: nothing is heard of drone 1"] * 2  # each 2 s
    bench.pass_by()
    assert bench.node.mode == FLYING
    np.testing.assert_allclose(bench.places(), bench.vec.task.goal.slots[0], atol=1e-12)


def test_what_was_heard_but_is_no_measurement_is_said(monkeypatch):
    bench = Bench(monkeypatch)
    bench.vec.world.state.payload_velocity[:] = np.nan
    for _ in range(150):
        bench.pass_by()
    assert bench.said[-1] == (
        "waiting: nothing is heard of the payload (messages came, but none was finite and newer than the last)"
    )


def test_what_is_wrong_on_other_topics_is_not_said_of_a_silent_drone(monkeypatch):
    bench = Bench(monkeypatch)
    bench.node._node.reader.left_out.update(["/fly", "/target", "/drone_0/odom"])
    for _ in range(150):
        bench.pass_by(silent=("/drone_1/odom",))
    assert bench.said[-1] == "waiting: nothing is heard of drone 1"
    bench.node._node.reader.left_out.update(["/drone_1/odom"])
    for _ in range(150):
        bench.pass_by(silent=("/drone_1/odom",))
    assert bench.said[-1].startswith("waiting: nothing is heard of drone 1 (messages came")


@pytest.mark.parametrize("lost", ["/payload/odom", "/drone_1/odom", "*"])
def test_what_is_lost_is_held_then_landed(monkeypatch, lost):
    bench = Bench(monkeypatch)
    bench.fly()
    flown, held = bench.node.steps, bench.places()
    for _ in range(round(HOLD_AFTER / 0.02)):
        bench.pass_by(silent=(lost,))
    assert bench.node.mode == FLYING and bench.node.steps == flown  # waits
    bench.pass_by(silent=(lost,))
    assert bench.node.mode == HOLDING
    sent = len(bench.wire.sent["/drone_0/setpoint"])
    for _ in range(50):
        bench.pass_by(silent=(lost,))
    stamps = [message.header.stamp for message in bench.wire.sent["/drone_0/setpoint"][sent:]]
    assert len(stamps) == 50 and len({(stamp.sec, stamp.nanosec) for stamp in stamps}) == 50  # peers hear on
    np.testing.assert_array_equal(bench.places(), held)
    bench.pass_by()  # and back
    assert bench.node.mode == FLYING and bench.node.steps == flown + 1
    for _ in range(round(LAND_AFTER / 0.02) + 1):
        bench.pass_by(silent=(lost,))
    assert bench.node.mode == LANDING
    for _ in range(50):
        bench.pass_by()  # heard again: it lands all the same
    assert bench.node.mode == LANDING and not bench.node.landed
    np.testing.assert_allclose(bench.places()[:, 2], held[:, 2] - 1.0 * SINK, atol=0.03)
    for _ in range(1000):
        bench.pass_by()
    np.testing.assert_allclose(bench.places()[:, 2], 0.0, atol=1e-9)
    assert bench.node.landed
    what = {"/payload/odom": "the payload", "/drone_1/odom": "drone 1", "*": "drone 0 and drone 1 and the payload"}
    assert f"holding: nothing new is heard of {what[lost]}" in bench.said


def test_drones_sink_as_fast_however_often_others_are_heard(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    held = bench.places()
    for _ in range(round((LAND_AFTER + 1.0) / 0.004)):
        bench.pass_by(0.004, ("/payload/odom",))
    np.testing.assert_allclose(bench.places()[:, 2], held[:, 2] - SINK * 1.0, atol=0.03)


def test_rubbish_and_old_news_do_not_count(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    flown = bench.node.steps
    old = dict(bench.messages.messages(bench.time_ns))["/drone_0/odom"]
    for _ in range(20):
        bench.pass_by(silent=("/drone_0/odom",))
        bad = dict(bench.messages.messages(bench.time_ns))["/drone_0/odom"]
        bad.pose.pose.orientation.w = np.nan
        far = dict(bench.messages.messages(bench.time_ns))["/drone_0/odom"]
        far.twist.twist.linear.x = np.inf
        bench.wire.queues["/drone_0/odom"] += [bad, old, far]
    assert bench.node.mode == HOLDING and bench.node.steps == flown


def test_clocks_that_leap_cost_some_messages_and_no_flight(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    bench.pass_by(silent=("/payload/odom",))
    bench.send("/payload/odom", late=-5.0)  # one message of the future
    bench.pass_by(silent=("/payload/odom",))
    flown = bench.node.steps
    bench.fly(20)
    assert flown + 14 <= bench.node.steps <= flown + 20
    bench.time_ns = 0  # all clocks are set back
    flown = bench.node.steps
    bench.fly(20)
    assert flown + 14 <= bench.node.steps <= flown + 20
    assert not any("holding" in text for text in bench.said)


@pytest.mark.parametrize("period", [0.004, 1 / 120, 0.01, 0.0199, 0.02, 0.0201])
def test_the_rate_is_the_policys_or_that_of_slower_odometry(monkeypatch, period):
    bench = Bench(monkeypatch)
    for _ in range(round(4 / period)):
        bench.pass_by(period)
    assert bench.node.steps == pytest.approx(min(200, 4 / period) if period < 0.0199 else 4 / period, abs=3)


@pytest.mark.parametrize("phases", [(0.0, 0.0067, 0.0134), (0.0, 0.002, 0.018)])
@pytest.mark.parametrize("transport", [0.0, 0.012, 0.03])
def test_bodies_need_not_be_measured_at_the_same_time(monkeypatch, phases, transport):
    """Each body at 50 Hz with a phase of its own, the payload later in transport."""
    bench = Bench(monkeypatch)
    due = list(phases)
    bench.tell("/target", bench.vec.task.goal.position[0])
    for tick in range(2000):
        bench.now, bench.time_ns = 100.0 + 1e-3 * tick, 1_000_000 * tick
        for body, topic in enumerate(ODOMETRY):
            if 1e-3 * tick >= due[body]:
                due[body] += 0.02
                bench.send(topic, late=transport if body == 2 else 0.0)
        bench.node.spin_once(1.0)
    assert bench.node.mode == FLYING and bench.node.steps == pytest.approx(100, abs=3)


def test_after_an_outage_steps_do_not_come_in_a_burst(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    for _ in range(10):
        bench.pass_by(silent=("*",))
    steps = []
    for _ in range(20):
        bench.now += 0.02
        bench.time_ns += 20_000_000
        for topic in ODOMETRY:  # each message wakes the node
            bench.send(topic)
            before = bench.node.steps
            bench.node.spin_once(1.0)
            steps.append(bench.node.steps - before)
    assert [sum(steps[k : k + 3]) for k in range(0, 60, 3)] == [1] * 20 and steps[2::3] == [1] * 20


def test_a_glitch_is_waited_out_and_a_team_put_elsewhere_begins_anew(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    flown, target = bench.node.steps, bench.node.team.task.goal.position[0].copy()
    bench.vec.world.state.drone_position[0, 0] += [0.0, 0.0, 2.0]
    bench.pass_by()
    assert bench.node.steps == flown and bench.node.mode == FLYING
    bench.vec.world.state.drone_position[0, 0] -= [0.0, 0.0, 2.0]
    bench.pass_by()
    assert bench.node.steps == flown + 1
    bench.vec.reset(seed=77)
    bench.vec.world.state.payload_position[0] += 0.3
    bench.vec.world.state.drone_position[0] += 0.3
    for _ in range(6):
        bench.pass_by(silent=("/target",))
    assert bench.node.mode == FLYING and bench.node.steps == flown + 3
    np.testing.assert_allclose(bench.node.team.reference.position[0], bench.vec.world.state.drone_position[0], atol=0.1)
    np.testing.assert_array_equal(bench.node.team.task.goal.position[0], target)


def test_a_team_put_where_the_task_fails_is_held_and_landed(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    held, sent = bench.places(), len(bench.wire.sent["/drone_0/setpoint"])
    state = bench.vec.world.state
    state.drone_position[0, 0] = state.drone_position[0, 1] + [0.1, 0.0, 0.0]
    for _ in range(14):
        bench.pass_by()
    assert bench.node.mode == HOLDING
    np.testing.assert_array_equal(bench.places(), held)
    assert bench.said[-1] == "holding: the task has failed where the team is, drone_collision"
    for _ in range(100):
        bench.pass_by()
    assert bench.node.mode == LANDING and bench.places()[0, 2] < held[0, 2]
    assert len(bench.wire.sent["/drone_0/setpoint"]) > sent + 90


def test_targets_of_others_move_the_team_and_distant_ones_do_not(monkeypatch):
    bench = Bench(monkeypatch, **{"env.history": 2})
    for _ in range(120):
        bench.pass_by(silent=("/target",))
    assert bench.node.mode == WAITING and bench.said[-1] == "waiting: no /target is heard"
    slots = bench.vec.task.goal.slots[0].copy()
    target = bench.vec.task.goal.position[0] + [0.2, -0.1, 0.1]
    bench.tell("/target", target)
    bench.pass_by(silent=("/target",))
    assert bench.node.mode == FLYING
    np.testing.assert_allclose(bench.places(), slots + [0.2, -0.1, 0.1], atol=1e-9)
    observation = bench.node.team.current()[0]
    np.testing.assert_array_equal(*np.split(observation, 2, axis=-1))  # of one target
    bench.tell("/target", target + [0.0, 0.0, 0.3])
    bench.pass_by(silent=("/target",))
    bench.pass_by(silent=("/target",))
    np.testing.assert_allclose(bench.places(), slots + [0.2, -0.1, 0.4], atol=1e-9)
    bench.tell("/target", target + [0.0, 0.0, 4.0])
    bench.tell("/target", target, np.full((3, 3), np.nan))
    bench.pass_by(silent=("/target",))
    bench.pass_by(silent=("/target",))
    assert bench.node.mode == FLYING
    np.testing.assert_allclose(bench.places(), slots + [0.2, -0.1, 0.4], atol=1e-9)
    assert "m away is not taken: 3 m is the most" in bench.said[-1]


def test_a_task_that_has_failed_ends_in_landing_and_one_that_cannot_begin_waits(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    bench.vec.world.state.drone_rotation[0, 1] = UPSIDE_DOWN
    bench.pass_by()
    assert bench.node.mode == LANDING and bench.said[-1] == "landing: the task has failed, tilt"

    bench = Bench(monkeypatch)
    bench.vec.world.state.drone_rotation[0, 1] = UPSIDE_DOWN
    for _ in range(110):
        bench.pass_by()
    assert bench.node.mode == WAITING and not bench.wire.sent["/drone_0/setpoint"]
    assert bench.said[-1] == "waiting: the task has failed where the team is, tilt"
    bench.vec.world.state.drone_rotation[0, 1] = np.eye(3)
    bench.pass_by()
    assert bench.node.mode == FLYING


def test_a_policy_that_fails_ends_in_landing(monkeypatch):
    class Fails:
        steps = 0

        def act(self, observation):
            self.steps += 1
            return np.full((1, 2, 4), np.nan if self.steps > 10 else 0.0)

        def reset(self, mask=None):
            pass

    bench = Bench(monkeypatch, lambda team: Fails())
    for _ in range(30):
        bench.pass_by()
    assert bench.node.mode == LANDING and "the policy has failed (ValueError: action of drone_0" in bench.said[-1]


def fail(*_, **__):
    raise ZeroDivisionError("of the task's own")


@pytest.mark.parametrize("part", ["observe", "advance"])
def test_a_task_whose_own_functions_fail_ends_in_landing(monkeypatch, part):
    bench = Bench(monkeypatch, names="report" if part == "advance" else "multilift")
    bench.fly()
    monkeypatch.setattr(bench.node.team, part, fail)
    bench.pass_by()
    assert bench.node.mode == LANDING
    assert bench.said[-1] == "landing: the task has failed (ZeroDivisionError: of the task's own)"
    bench.pass_by()


def test_a_task_that_fails_when_it_begins_anew_ends_in_landing(monkeypatch):
    bench = Bench(monkeypatch)
    bench.fly()
    held = bench.places()
    monkeypatch.setattr(bench.node.team, "begin", fail)
    bench.vec.world.state.drone_position[0] += 3.0
    bench.vec.world.state.payload_position[0] += 3.0
    for _ in range(60):
        bench.pass_by()
    assert "landing: the task has failed (ZeroDivisionError: of the task's own)" in bench.said
    assert (bench.places()[:, 2] < held[:, 2]).all()


def test_what_fails_before_the_flight_is_a_reason_to_wait(monkeypatch):
    bench = Bench(monkeypatch)
    monkeypatch.setattr(bench.node.team, "begin", fail)
    for _ in range(150):
        bench.pass_by()
    assert bench.node.mode == WAITING
    assert bench.said[-1] == "waiting: the task has failed (ZeroDivisionError: of the task's own)"


def test_it_begins_and_ends_when_it_is_told(monkeypatch):
    bench = Bench(monkeypatch, start="topic")
    for _ in range(50):
        bench.pass_by()
    assert bench.node.mode == READY and bench.node.steps == 0
    np.testing.assert_allclose(bench.places(), bench.vec.world.state.drone_position[0], atol=1e-9)  # where they are
    new = bench.wire.store.types[BOOL]
    bench.wire.queues["/fly"].append(new(data=True))
    bench.fly()
    bench.wire.queues["/fly"].append(new(data=False))
    bench.pass_by()
    assert bench.node.mode == LANDING and bench.said[-1] == "landing: false on /fly"


def test_ctrl_c_is_followed_by_landing(monkeypatch):
    bench = Bench(monkeypatch)
    bench.node.land("Ctrl-C")
    assert bench.node.landed  # it never flew
    bench.fly()
    bench.node.land("Ctrl-C")
    assert bench.node.mode == LANDING and not bench.node.landed


def test_px4_hears_its_heartbeat_with_times_that_go_on(monkeypatch):
    bench = Bench(monkeypatch, names="report")
    bench.fly()
    for _ in range(50):
        bench.pass_by(silent=("*",))
    stamps = [message.timestamp for message in bench.wire.sent["/px4_1/fmu/in/offboard_control_mode"]]
    assert len(stamps) > 40 and bench.node.mode == HOLDING
    assert max(np.diff(stamps)) < 300_000 and stamps[-1] == pytest.approx(bench.time_ns / 1000, abs=1000)
    setpoint = bench.wire.sent["/px4_1/fmu/in/trajectory_setpoint"][-1]
    assert setpoint.velocity.tolist() == [0, 0, 0] and setpoint.acceleration[2] < -1  # which carries the cable
