"""What flights by PX4 compute: the way to a task, how far estimates are off, the rig in its parameters."""

from __future__ import annotations

import sys

import numpy as np
import pytest
from conftest import make_system
from plain_kernels import record

pytest.importorskip("pymavlink")  # of the px4 extra
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)

from multilift_marl.deploy.px4.flight import Flight, Goal
from multilift_marl.deploy.px4.launch import rig_parameters
from multilift_marl.deploy.px4.team import AutopilotTeam
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


def go(begin: Goal, end: Goal) -> tuple[np.ndarray, ...]:
    """Return motions (T, 2, 3, 3), cable forces (T, 2, 3) and headings (T, 2) of the way from one goal to another."""
    flight, world = Flight.__new__(Flight), record(thrust=None, step=lambda *_: None, system=record(control_interval=4))
    flight.config, flight.team = record(sim=record(control_hz=HZ)), Recorder()
    flight._go(world, begin, end)
    assert [each[0] for each in flight.team.sent[:4]] == [0, 1, 0, 1]
    return tuple(np.array([each[k] for each in flight.team.sent]).reshape(-1, 2, *shape)
                 for k, shape in ((1, (3, 3)), (2, (3,)), (3, ())))  # fmt: skip


@pytest.mark.parametrize("yaw, seconds", [(0.4, 4.0 / 0.8), (0.4 + 3.0, 3.0 / 0.5), (0.4 - 3.0, 6.0), (0.4 + 4.0, 5.0)])
def test_the_way_to_a_task_is_a_line_at_rest_at_both_ends(yaw, seconds):
    rng = np.random.default_rng(0)
    begin = Goal(rng.normal(size=(2, 3)), rng.normal(size=(2, 3)), 0.4, 1.0)
    way = np.array([[1.0, -2.0, 0.5], [2.4, 3.2, 0.0]])
    end = Goal(begin.slots + way, rng.normal(size=(2, 3)), yaw, 2.0)
    motion, force, headings = go(begin, end)
    assert len(motion) == round((seconds + 2.0) * HZ)
    place, velocity, acceleration = motion[:, :, 0], motion[:, :, 1], motion[:, :, 2]
    np.testing.assert_allclose(place[0], begin.slots)
    np.testing.assert_allclose(place[-1], end.slots)
    np.testing.assert_allclose(np.gradient(place, 1 / HZ, axis=0)[1:-1], velocity[1:-1], atol=2e-3)
    np.testing.assert_allclose(np.gradient(velocity, 1 / HZ, axis=0)[1:-1], acceleration[1:-1], atol=4e-3)
    share = (place[:, 0, 1] - begin.slots[0, 1]) / way[0, 1]
    np.testing.assert_allclose(place - begin.slots, share[:, None, None] * way, atol=1e-12)
    middle = round(seconds * HZ / 2)
    assert share[middle] == pytest.approx(0.5, abs=1e-9)
    np.testing.assert_allclose(force, begin.cable_force + share[:, None, None] * (end.cable_force - begin.cable_force))
    turn = (yaw - 0.4 + np.pi) % (2 * np.pi) - np.pi
    np.testing.assert_allclose(headings, 0.4 + share[:, None] * turn + Recorder.heading, atol=1e-12)


def test_a_short_way_takes_a_second():
    still = Goal(np.zeros((2, 3)), np.zeros((2, 3)), 0.0, 1.0)
    assert len(go(still, still)[0]) == round(3.0 * HZ)


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
