"""A node from odometry and trajectory set-points of drones to attitudes, or body rates, and thrusts: eqs 25-32."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.disturbance import REJECTIONS, Disturbance, make_rejection, reset_estimate
from multilift_marl.control.formation import Reference
from multilift_marl.control.gains import make_gains
from multilift_marl.control.geometric import AttitudeCommand, command_attitude
from multilift_marl.deploy.ros.autopilots import read_stamped, write_reference
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER
from multilift_marl.deploy.ros.messages import NAMES, Topic, control_topics
from multilift_marl.deploy.ros.types import (
    ATTITUDE,
    RATES,
    VEHICLE_ODOMETRY,
    Motion,
    PX4Setpoint,
    attitude_setpoint,
    control_mode,
    px4_namespace,
    rates_setpoint,
    read_measurement,
    read_trajectory,
    read_vehicle_odometry,
)
from multilift_marl.errors import ConfigError
from multilift_marl.sim.state import SystemState

Say = Callable[[str], None]
Numbers = TypeVar("Numbers", bound=tuple[Any, ...])
FOLLOWING, HOLDING, SILENT = "following", "holding", "silent"
SILENT_AFTER = 0.5  # [s] without a set-point; then the fail-safe of who executes attitudes is to begin
_STALE = 1.0  # [s] between odometries, above which the integral does not go on
_FARTHEST = 1.0  # [m] of a place that is corrected at once; what is farther is approached
_FASTEST = 4.0  # [rad/s] of body rates, as PX4 limits them
_REMEMBERED = 1_000_000  # answers of which the latency is known


class DroneControl:
    """Position and velocity control of one drone that is measured elsewhere.

    Set-points are as PX4 gets them: their accelerations hold what the drone carries, so that the gains are those of
    the drone alone.

    Args:
        config: `control` has the gains, and `control.disturbance` may be `integral`.
        drone: its number.

    Attributes:
        desired: attitude (3, 3), of the last call.
        rates: (3,) at which to turn to it [rad/s].
        share: of the largest thrust, of the last call.
    """

    def __init__(self, config: Config, drone: int):
        system, control = config.system, config.control
        self._vehicle = system.vehicles[drone]
        gains = make_gains(control, system)
        alone = {name: np.zeros_like(getattr(gains, name)) for name in ("load_share", "drag")}
        self._gains = _of(drone, gains._replace(**alone))
        self._reject = None
        if control.disturbance != "none":
            rejection = make_rejection(control, system, gains, 1.0 / config.env.policy_hz)
            self._rejection = _of(drone, rejection._replace(gains=self._gains))
            self._reject = REJECTIONS[control.disturbance]
        self._state, self._reference = SystemState.zeros(1, 1), Reference.zeros(1, 1)
        self._disturbance, self._nominal = Disturbance.zeros(1, 1), np.zeros((1, 1, 3))
        self._command = AttitudeCommand(np.zeros((1, 1, 3, 3)), np.zeros((1, 1, 3)), np.zeros((1, 1)))
        # What holds the load up, without the formation's pull to the side.
        self.carried = np.array([0.0, 0.0, system.hook_force[drone, 2] / system.drone_mass[drone]])
        self.restart()

    def restart(self) -> None:
        """Forget the integral and the heading."""
        self._begins = True
        reset_estimate(0, self._state, self._disturbance)
        self._disturbance.cable_force[:] = 0.0

    def follow(self, motion: Motion, setpoint: PX4Setpoint, elapsed: float) -> None:
        """Compute attitude and thrust.

        Args:
            motion: of the drone.
            setpoint: where it is to be at that time.
            elapsed: since the last call [s].
        """
        state = self._state
        state.drone_position[0, 0], state.drone_rotation[0, 0], state.drone_velocity[0, 0] = motion[:3]
        if self._begins:
            self._reference.yaw[:] = np.arctan2(motion[1][1, 0], motion[1][0, 0])  # unless another is asked for
            self._begins = False
        off = setpoint.position - motion[0]
        far = max(float(np.linalg.norm(np.nan_to_num(off))), _FARTHEST)
        near = setpoint.position - (1.0 - _FARTHEST / far) * off
        write_reference(0, setpoint._replace(position=near), self.carried, state, self._reference, 0.0)
        self._reference.jerk[0, 0] = np.nan_to_num(setpoint.jerk)
        force = self._nominal
        if self._reject is not None:
            # Whether thrusts are at a limit is known of those that were asked for last.
            each = np.clip(self._command.thrust / 4, 0.0, self._vehicle.rotor_thrust_max)
            state.rotor_speed[:] = np.sqrt(each / self._vehicle.thrust_coefficient)[..., None]
            paced = self._rejection._replace(dt=elapsed if elapsed <= _STALE else 0.0)
            self._reject(0, 1, state, self._reference, self._nominal, self._disturbance, paced)
            force = self._disturbance.cable_force
        command_attitude(0, 1, state, self._reference, force, self._command, self._gains)
        rates = self._command.rates
        np.clip(rates, -_FASTEST, _FASTEST, out=rates)

    @property
    def desired(self) -> np.ndarray:
        """See above."""
        return self._command.attitude[0, 0]

    @property
    def rates(self) -> np.ndarray:
        """See above."""
        return self._command.rates[0, 0]

    @property
    def share(self) -> float:
        """See above."""
        return float(min(self._command.thrust[0, 0] / (4 * self._vehicle.rotor_thrust_max), 1.0))


class _Drone:
    """What a node knows of one drone."""

    def __init__(self, config: Config, drone: int, node: Node, names: str, by_rates: bool):
        self.control = DroneControl(config, drone)
        topic = Topic(f"{px4_namespace(drone)}/out/vehicle_odometry", VEHICLE_ODOMETRY, False)
        self.take_odometry = node.subscription(topic, partial(read_measurement, read_vehicle_odometry))
        asked = control_topics(NAMES[names], drone)[0]
        self.take_setpoints = node.subscription(asked._replace(reliable=False), partial(read_stamped, read_trajectory))
        command, mode = control_topics(NAMES[names], drone, by_rates)[1:]
        self.publish, self.publish_mode = node.publisher(command), node.publisher(mode)
        self.mode = SILENT
        self.measured: tuple[int, Motion] | None = None
        self.arrived = 0.0
        self.pending = False
        self.setpoint: tuple[int, PX4Setpoint] | None = None
        self.place = np.full(3, np.nan)  # of the last set-point, moved on
        self.heard_at = self.answered = -1  # [ns] by the odometry's clock


class GeometricControlNode:
    """Controls drones of PX4 by attitude or body rates, and thrust, one answer for each odometry.

    Set-points move on by their velocities to the time of the odometry. A drone without a fresh one holds the last
    place, and after 0.5 s nothing more is said of it: its autopilot has a fail-safe of its own.

    Args:
        config: the rig, its gains, and `control.disturbance`, none or integral.
        node: publishes and subscribes.
        names: of the topics, those of a workspace with PX4s.
        drones: which; None: all.
        patience: for the set-point that belongs to an odometry [s].
        by_rates: whether body rates are asked for in place of attitudes.
        say: called with what happens.

    Attributes:
        latency: from each odometry to its answer [s].

    Raises:
        ConfigError: what it cannot do.
    """

    def __init__(
        self, config: Config, node: Node, names: str = "report", drones: list[int] | None = None,
        patience: float = 0.0, by_rates: bool = False, say: Say = print,
    ):  # fmt: skip
        if not NAMES[names].is_report:
            raise ConfigError(f"role=geometric_control flies drones of PX4, of names=report, not of names={names}")
        if config.control.disturbance not in ("none", "integral"):
            raise ConfigError(
                f"role=geometric_control knows no rotor speeds, which control.disturbance={config.control.disturbance} "
                "needs; set integral or none"
            )
        count = config.env.num_drones
        chosen = range(count) if drones is None else drones
        if not chosen:
            raise ConfigError("drones=[] leaves nothing to control; give numbers of drones, or leave it out for all")
        if len(set(chosen)) < len(chosen):
            raise ConfigError(f"drones={list(chosen)} has a drone twice; give each once")
        if wrong := [drone for drone in chosen if not 0 <= drone < count]:
            raise ConfigError(f"drones={wrong} are none of this team, which has 0 to {count - 1}")
        self._drones = {i: _Drone(config, i, node, names, by_rates) for i in chosen}
        self._node, self._patience, self._by_rates, self._say = node, patience, by_rates, say
        self.latency = deque[float](maxlen=_REMEMBERED)
        self.steps = 0
        self._warm_up()

    def _warm_up(self) -> None:
        still = PX4Setpoint(np.zeros(3), np.zeros(3), np.zeros(3), 0.0)
        for drone in self._drones.values():
            drone.control.follow((np.zeros(3), np.eye(3), np.zeros(3), np.zeros(3)), still, 0.0)
            drone.control.restart()

    def spin(self, seconds: float) -> None:
        """Hear and control for some seconds of real time."""
        end = time.perf_counter() + seconds
        while (left := end - time.perf_counter()) > 0:
            self.spin_once(left)

    def spin_once(self, seconds: float) -> None:
        """Wait for something new, for some seconds at most, and do what is due."""
        self._node.wait(min(seconds, self._rest()))
        self._node.check_publishers()
        now = time.perf_counter()
        for i, drone in self._drones.items():
            self._hear(drone, now)
            if drone.pending and (self._is_answered(drone) or now >= drone.arrived + self._patience):
                drone.pending = False
                self._answer(i, drone)

    def _rest(self) -> float:
        """Return how long nothing is due [s]."""
        due = [drone.arrived + self._patience for drone in self._drones.values() if drone.pending]
        return max(min(due) - time.perf_counter(), 0.0) if due else 0.1

    @staticmethod
    def _hear(drone: _Drone, now: float) -> None:
        for time_ns, motion in drone.take_odometry():
            if not drone.pending:  # patience is counted from the oldest that waits
                drone.arrived = now
            drone.measured, drone.pending = (time_ns, motion), True
        for stamped in drone.take_setpoints():
            drone.setpoint = stamped
            drone.heard_at = -1 if drone.measured is None else drone.measured[0]

    @staticmethod
    def _is_answered(drone: _Drone) -> bool:
        """Whether the last set-point is that of the last odometry, or none is to be waited for."""
        assert drone.measured is not None
        return drone.mode != FOLLOWING or (drone.setpoint is not None and drone.setpoint[0] >= drone.measured[0])

    def _answer(self, i: int, drone: _Drone) -> None:
        assert drone.measured is not None
        time_ns, motion = drone.measured
        setpoint = self._present_setpoint(i, drone, time_ns)
        elapsed, drone.answered = 1e-9 * (time_ns - drone.answered) if drone.answered >= 0 else 0.0, time_ns
        if setpoint is None:
            return
        drone.control.follow(motion, setpoint, max(elapsed, 0.0))
        store, control = self._node.store, drone.control
        drone.publish_mode(control_mode(store, time_ns, RATES if self._by_rates else ATTITUDE))
        if self._by_rates:
            drone.publish(rates_setpoint(store, time_ns, control.rates, control.share))
        else:
            turning = 0.0 if np.isnan(setpoint.yaw_rate) else setpoint.yaw_rate
            drone.publish(attitude_setpoint(store, time_ns, control.desired, control.share, turning))
        self.latency.append(time.perf_counter() - drone.arrived)
        self.steps += 1

    def _present_setpoint(self, i: int, drone: _Drone, time_ns: int) -> PX4Setpoint | None:
        """Return where drone i is to be at the time of its odometry; None where nobody says so any more."""
        if drone.setpoint is None:
            return None
        if drone.heard_at < 0 or drone.heard_at > time_ns:  # it came first, or the clock was set back
            drone.heard_at = time_ns
        age = 1e-9 * (time_ns - drone.heard_at)
        stamp, setpoint = drone.setpoint
        mode = FOLLOWING if age <= HOLD_AFTER else HOLDING if age <= SILENT_AFTER else SILENT
        if mode != drone.mode:
            if mode != FOLLOWING or drone.mode == SILENT:
                self._say(f"drone {i}: {mode}" + ("" if mode == FOLLOWING else f", no set-point for {age:.2f} s"))
            if drone.mode == SILENT:
                drone.control.restart()
            drone.mode = mode
        if mode == SILENT:
            return None
        if mode == HOLDING:
            still = np.zeros(3)
            return setpoint._replace(
                position=drone.place, velocity=still, acceleration=drone.control.carried, yaw_rate=0.0, jerk=still
            )
        ahead = 1e-9 * (time_ns - stamp) if stamp else 0.0
        ahead = ahead if 0.0 <= ahead <= HOLD_AFTER else 0.0  # a clock of its own
        moved = np.where(np.isfinite(setpoint.velocity), setpoint.velocity, 0.0)
        drone.place = setpoint.position + ahead * moved
        return setpoint._replace(position=drone.place)


def _of(drone: int, numbers: Numbers) -> Numbers:
    """Return a tuple of arrays whose first axis is that of the drones for one of them."""
    return type(numbers)(*(each[drone : drone + 1] if isinstance(each, np.ndarray) else each for each in numbers))
