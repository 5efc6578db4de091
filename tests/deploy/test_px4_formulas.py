"""What flights by PX4 compute: the way to a task, how far estimates are off, the rig in its parameters."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from conftest import largest_motion, make_system
from plain_kernels import record

pytest.importorskip("pymavlink")  # of the px4 extra
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)

import multilift_marl as ml
from multilift_marl.deploy.px4 import __main__ as command
from multilift_marl.deploy.px4.flight import Flight, FlightResult, check_config
from multilift_marl.deploy.px4.launch import rig_parameters
from multilift_marl.deploy.px4.phases import Phase, find_failure
from multilift_marl.deploy.px4.team import AutopilotTeam
from multilift_marl.deploy.px4.ways import Goal, plan_way, read_goal
from multilift_marl.deploy.ros.stages import Orders, Stage
from multilift_marl.errors import FlightError
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.sim.earth import Site, project_local

HZ = 50.0


class Recorder:
    """A team that keeps what it is told."""

    heading = np.array([0.1, -0.2])

    def __init__(self):
        self.sent = []

    def tick(self, world, send):
        for drone in range(2):
            send(drone)

    def send(self, drone, motion, cable_force, yaw):
        self.sent.append((drone, motion.copy(), cable_force.copy(), yaw))


def rest_at(end: Goal, begin: Goal) -> tuple[np.ndarray, ...]:
    """Return motions (T, 2, 3, 3), cable forces (T, 2, 3) and headings (T, 2) of a team whose payload is there."""
    flight = Flight.__new__(Flight)
    flight.config, flight.team, flight.phases = record(sim=record(control_hz=HZ)), Recorder(), []
    watched: list = []
    flight.stage = Stage.GO_TO
    flight._watch = lambda vec, stage: watched.append(vec)
    rotation = np.tile(np.eye(3), (1, 2, 1, 1))
    places, whole = np.eye(3)[None, :2], np.zeros((1, 2), bool)
    state = record(drone_position=places, drone_rotation=rotation, cable_tension=np.ones((1, 2)), cable_broken=whole)
    system = record(control_interval=4, min_separation=np.full((2, 2), 0.5))
    stats = record(tension_peak=np.full(1, 9.0))  # of the phase before
    world = record(thrust=None, step=lambda *_: None, system=system, state=state, stats=stats)
    vec = record(world=world, task=record(dt=2 / HZ))
    assert flight._go(vec, begin, end, "way") is vec
    assert [each[0] for each in flight.team.sent[:4]] == [0, 1, 0, 1]
    (phase,) = flight.phases
    steps = len(flight.team.sent) // 4  # two ticks of two drones
    assert phase[:2] == ("way", pytest.approx(steps * 2 / HZ)) and phase.separation == 2**0.5
    assert watched == [vec] * steps and phase.tension == 1.0
    return tuple(np.array([each[k] for each in flight.team.sent]).reshape(-1, 2, *shape)
                 for k, shape in ((1, (3, 3)), (2, (3,)), (3, ())))  # fmt: skip


@pytest.mark.parametrize("turn, seconds", [(0.0, 0.0), (3.0, 6.0), (-3.0, 6.0), (4.0, (2 * np.pi - 4.0) / 0.5)])
def test_at_the_end_of_a_way_drones_rest_and_turn_to_where_they_are_to_face(turn, seconds):
    rng = np.random.default_rng(0)
    pose = (1.0, 2.0, 3.0, 0.7)
    begin = Goal(rng.normal(size=(2, 3)), rng.normal(size=(2, 3)), 0.4, pose)
    end = Goal(rng.normal(size=(2, 3)), rng.normal(size=(2, 3)), 0.4 + turn, pose)
    motion, force, headings = rest_at(end, begin)
    assert len(motion) == round((seconds + 2.0) * HZ)
    np.testing.assert_array_equal(motion[:, :, 0], np.tile(end.slots, (len(motion), 1, 1)))
    assert not motion[:, :, 1:].any()
    np.testing.assert_array_equal(force, np.tile(end.cable_force, (len(force), 1, 1)))
    shorter = (turn + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(headings[0], 0.4 + Recorder.heading, atol=1e-12)
    np.testing.assert_allclose(headings[-1], 0.4 + shorter + Recorder.heading, atol=1e-12)
    assert abs(np.diff(headings, axis=0)).max() * HZ < 0.5 * 35 / 16 + 1e-3


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        ({}, ""),
        ({"drone_position": np.array([[[0.0, 0.0, 1.0], [0.49, 0.0, 1.0]]])}, "drone_collision"),
        ({"cable_broken": np.array([[False, True]])}, "cable_broken"),
        ({"drone_rotation": np.tile(np.diag([1.0, 0.17, 0.17]), (1, 2, 1, 1))}, "tilt"),
    ],
)
def test_a_team_that_rests_fails_by(change, cause):
    places = np.array([[[0.0, 0.0, 1.0], [0.51, 0.0, 1.0]]])
    sound = {"drone_position": places, "cable_broken": np.zeros((1, 2), bool), "drone_rotation": np.eye(3)[None, None]}
    world = record(state=record(**sound | change), system=record(min_separation=np.full((2, 2), 0.5)))
    assert find_failure(world) == cause


@pytest.mark.parametrize("turn", [2.0, -2.0, 4.0])
def test_a_way_is_a_straight_line_on_which_the_team_turns_the_shorter_way_round(turn):
    config = ml.load_config("hover")
    begin = Goal(np.zeros((4, 3)), np.zeros((4, 3)), 0.0, (1.0, 2.0, 1.5, 0.4))
    end = begin._replace(pose=(-1.0, 3.0, 2.5, 0.4 + turn))
    seconds, options = plan_way(config, begin, end)
    (first, last), (start, arrival) = options["waypoints"], options["waypoint_times"]
    assert first == begin.pose and last[:3] == end.pose[:3] and start == 0.0
    assert last[3] - first[3] == pytest.approx((turn + np.pi) % (2 * np.pi) - np.pi)
    assert seconds == arrival + 2.0
    # as fast as the limits of payload and slots allow: from rest to rest least snap is this share of the way
    t = np.linspace(0, 1, 20_001)
    share = (35 * t**4 - 84 * t**5 + 70 * t**6 - 20 * t**7)[:, None]
    pose = first + share * np.subtract(last, first)
    fastest, hardest = largest_motion(pose, t * arrival, config.system.slots[:, :2])
    assert max(fastest / 1.0, hardest / 0.7) == pytest.approx(1.0, abs=0.01)
    assert plan_way(config, begin, begin) is None


@pytest.mark.slow
@pytest.mark.parametrize(
    "task, seed, drones",
    [
        ("track_circle", 4242, 4),
        ("track_circle", 4242, 6),
        ("track_circle", 1013, 4),
        ("pose", 1001, 4),
        ("track", 1002, 4),
    ],
)
def test_on_the_way_to_a_task_no_drone_comes_near_another(task, seed, drones):
    """The formation turns as a body: its drones stay as far from each other as they are at rest."""
    config = check_config(ml.load_config(task, {"env.num_drones": drones}))
    vec = ml.make_vec(config)
    vec.reset(seed=seed)
    end = read_goal(vec)
    begin = end._replace(pose=(0.0, 0.0, end.pose[2], 0.0))
    seconds, options = plan_way(config, begin, end)
    flight = Flight.__new__(Flight)
    flight._flown = config
    way = ml.make_vec(flight._part("track", seconds, options), **{"env.episode_seconds": seconds})
    observation, _ = way.reset(seed=seed)
    policy, least = make_scripted("formation_integral", way), np.inf
    truncated = np.zeros(1, bool)
    while not truncated[0]:
        observation, _, terminated, truncated, _ = way.step(policy.act(observation))
        assert not terminated[0]
        places = way.world.state.drone_position[0]
        apart = np.linalg.norm(places[:, None] - places, axis=-1) + 9 * np.eye(drones)
        least = min(least, (apart / np.where(np.eye(drones), 1.0, config.system.min_separation)).min())
    assert least > 1.0
    rest = np.linalg.norm(end.slots[:, None] - end.slots, axis=-1) + 9 * np.eye(drones)
    assert least > 0.8 * (rest / np.where(np.eye(drones), 1.0, config.system.min_separation)).min()
    np.testing.assert_allclose(read_goal(way).slots, end.slots, atol=2e-3)
    np.testing.assert_allclose(way.world.state.payload_position[0], end.pose[:3], atol=0.05)


@pytest.mark.slow
def test_what_stands_for_an_autopilots_delay_and_integral_is_not_added_to_its_own():
    flight = Flight(ml.load_config("hover_px4"), record(report=lambda state: None), 2000)
    for config in (flight.vec.config, flight._part("track", 1.0, {})):
        assert config.randomization.action_delay == (0, 0) and config.control.disturbance == "none"
        assert config.env.sensing == "rtk"
    ours = flight.config  # flown by our controller, from the same state
    assert ours.randomization.action_delay == (1, 3) and ours.control.disturbance == "integral"


def test_a_flights_own_take_off_and_landing_go_gently_through_a_margin_that_its_cables_have():
    flight = Flight(ml.load_config("hover"), record(report=lambda state: None), 2000)
    for task in ("takeoff", "land"):
        options = flight._part(task, 30.0, {}).task_options
        assert options["pace"] == 0.5 and options["margin"] == 0.05
    assert "margin" not in flight._part("track", 1.0, {}).task_options
    flight.config = record(system=record(cable_length=np.array([0.3, 0.2])))
    assert flight.margin == pytest.approx(0.04)


class Rehearsal(Flight):
    """A flight without autopilots: parts follow each other, and one of them may fail."""

    def __init__(self, cause: int, failing: str):
        self.config, self.failing, self.phases, self.did = record(task="hover"), failing, [], []
        self._task = self._landing = record(world=record(obstacles=()), task=None, failure_causes=("none", "ground"))
        self.team = record(offboard=[], settle=lambda world: self.did.append("disarmed"))
        self.cause, self._say, self._begun = cause, lambda text: None, {}
        self._orders, self._watch = Orders(), lambda vec, stage: None

    def part(self, name):
        self.did.append(name)
        self.phases.append(Phase(name, 1.0, 1.0, 1.0, 1.0))
        if name == self.failing:
            raise FlightError(f"{name} failed after 1.0 s: tilt")

    _make = _arm = _take_over = _part = lambda self, *_: record(world=record(obstacles=()))

    def _run(self, vec, observation, what, stage):
        self.part(what)

    def _go(self, vec, begin, end, what):
        self.part(what)
        return vec

    def _measure_task(self, *_):
        self.part("hover")
        return FlightResult({"failure_cause": np.array([self.cause])}, None, 0.0, 0.0)


WHOLE = ["take-off", "the way to the task", "hover", "the way back", "landing"]


@pytest.mark.parametrize(
    ("cause", "failing", "did", "ended"),
    [
        (0, "", [*WHOLE, "disarmed"], ""),
        (1, "", [*WHOLE[:3], "disarmed"], "task hover failed: ground"),
        (0, "the way back", WHOLE[:4], "the way back failed after 1.0 s: tilt"),
        (0, "landing", WHOLE, "landing failed after 1.0 s: tilt"),
    ],
)
def test_a_flight_that_fails_after_its_task_keeps_what_was_measured(monkeypatch, cause, failing, did, ended):
    monkeypatch.setattr("multilift_marl.deploy.px4.flight.read_goal", lambda vec: record(pose=(0.0, 0.0, 1.0, 0.0)))
    flight = Rehearsal(cause, failing)
    result = flight.fly(lambda vec: None)
    assert flight.did == did and result.ended == ended
    assert [phase.name for phase in result.phases] == [name for name in did if name != "disarmed"]
    for early in WHOLE[:2]:  # nothing has been measured yet
        with pytest.raises(FlightError, match=early):
            Rehearsal(0, early).fly(lambda vec: None)


def test_a_phase_holds_the_extremes_of_its_states():
    tilts = np.radians([[10.0, 20.0], [30.0, 5.0], [0.0, 0.0]])
    rotation = np.zeros((3, 1, 2, 3, 3))
    rotation[:, 0, :, 2, 2] = np.cos(tilts)
    places = [
        [[0.0, 0.0, 1.0], [3.0, 4.0, 1.0]],
        [[0.0, 0.0, 1.0], [0.0, 1.0, 1.0]],
        [[0.0, 0.0, 1.0], [0.0, 2.0, 1.0]],
    ]
    phase = Phase("way", 0.0, np.inf, 0.0, 0.0)
    for place, turned, tension, peak in zip(places, rotation, (3.0, 7.0, 4.0), (0.0, 9.0, 0.0), strict=True):
        state = record(
            drone_position=np.array([place]), drone_rotation=turned, cable_tension=np.array([[tension, 1.0]])
        )
        phase = phase.joined(state, peak, 0.1)
    assert phase == ("way", pytest.approx(0.3), pytest.approx(1.0), 9.0, pytest.approx(30.0))
    table = command.describe_phases([phase]).splitlines()
    assert len(table) == 2 and table[1].split() == ["way", "0.3", "1.00", "9.0", "30.0"]


def test_estimates_are_off_by_the_distance_from_where_the_drone_was_then():
    team, site = AutopilotTeam.__new__(AutopilotTeam), Site()
    places = [np.array([[1.0, -2.0, 3.0], [4.0, 5.0, 6.0]]) + 0.1 * k for k in range(3)]
    team._places, team.settings = list(zip((1000, 2000, 3000), places, strict=True)), record(site=site)
    origin = np.array([47.39, 8.54, 480.0])
    off, team.offboard = np.array([[0.3, 0.4, 0.0], [0.0, -0.5, 1.2]]), []
    for i, (time_us, k) in enumerate(((1900, 1), (3600, 2))):
        local = project_local(site.to_geodetic(places[k][i]), origin)
        team.offboard.append(record(time_us=time_us, origin=origin, position=local + off[i]))
    np.testing.assert_allclose(team.error(), [0.5, 1.3], atol=1e-6)


def test_where_drones_were_is_kept_with_the_time_that_their_sensors_were_sent_with():
    team, sent = AutopilotTeam.__new__(AutopilotTeam), []
    sensors, clock = record(read=lambda: None), record(wait=lambda time: None)
    link = record(send=lambda time_us, *_: sent.append(time_us), receive=lambda time_us: None, controls=np.zeros(4))
    team.settings, team._sensors, team.links, team.clock = record(site=Site()), sensors, [link], clock
    team._dt, team._time_us, team._ticks, team._places, team._thrust_max = 4e-3, 8000, 1, [], np.ones(1)
    team._is_due = lambda rate: False
    world = record(state=record(drone_position=np.zeros((1, 1, 3))), thrust=np.zeros((1, 1, 4)))
    for k in range(3):
        world.state.drone_position[:] = k
        team.tick(world, lambda i: None)
    assert sent == [time_us for time_us, _ in team._places] == [12_000, 16_000, 20_000]
    assert [place[0, 0] for _, place in team._places] == [0.0, 1.0, 2.0]


@pytest.mark.parametrize("preset", ["falcon", "iris"])
def test_gains_of_the_rate_loop_cross_over_at_one_frequency(preset):
    system = make_system(2, **{"vehicle.preset": preset, "payload.mass": 0.4})
    vehicle, values = system.vehicles[1], rig_parameters(system, 1)
    x, y = np.abs(vehicle.rotor_positions[0, :2])  # set-points of 1 about roll and pitch give one factor to both
    weakest = min(x, y)
    for name, lever, inertia in (("ROLL", y, vehicle.inertia[0]), ("PITCH", x, vehicle.inertia[1])):
        # By its normalisation, RMS over pairs, a set-point of 1 asks each rotor for 1/√2 of its thrust: [rad/s²]
        full = 4 * vehicle.rotor_thrust_max / np.sqrt(2) * weakest / inertia
        assert values[f"MC_{name}RATE_P"] * full == pytest.approx(18.5)
        assert values[f"MC_{name}RATE_I"] * full == pytest.approx(24.6)
        assert values[f"MC_{name}RATE_D"] * full == pytest.approx(0.37)
        assert lever >= weakest
    assert values["MPC_THR_HOVER"] == pytest.approx(vehicle.mass * 9.81 / (4 * vehicle.rotor_thrust_max))
    for k, (x, y, _) in enumerate(vehicle.rotor_positions):  # forward and right; positive turns counter-clockwise
        found = [values[f"CA_ROTOR{k}_{part}"] for part in ("PX", "PY", "KM")]
        np.testing.assert_allclose(found, [x, -y, -vehicle.rotor_spin[k] * vehicle.torque_ratio])
