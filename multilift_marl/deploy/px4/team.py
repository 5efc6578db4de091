"""N autopilots in lockstep with a world of one environment: sensors and set-points to them, rotor thrusts from them."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.action_interface import Call
from multilift_marl.control.autopilot import LoadFeedforward
from multilift_marl.control.controller import Controller
from multilift_marl.control.formation import Goal
from multilift_marl.control.obstacle_margin import Surroundings
from multilift_marl.deploy.px4.launch import Autopilots, rig_parameters
from multilift_marl.deploy.px4.link import SimulatorLink
from multilift_marl.deploy.px4.offboard import OFFBOARD, OffboardLink
from multilift_marl.errors import FlightError
from multilift_marl.math3d import heading
from multilift_marl.realtime import RealTime
from multilift_marl.rig.system import System
from multilift_marl.sensing.sensors import Sensors
from multilift_marl.sensing.suite import SensorSuite
from multilift_marl.sim.earth import Site, project_local, swap_attitude, swap_enu_ned, swap_flu_frd, swap_yaw
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World

SETPOINT_RATE = 50.0  # [Hz]
HEARTBEAT_RATE = 2.0  # [Hz]
_PAST = 250  # ticks whose true places are kept, for estimates that arrive late
READY_WITHIN = 60.0  # [s] of the simulation, until all are armed
_SETTLE = 10.0  # [s] of the simulation, at rest, before arming: estimators converge


class Settings(NamedTuple):
    """How autopilots are started and simulated."""

    build: Path | None = None
    """PX4's build folder; None where others start the autopilots."""
    first: int = 0
    """Instance of the first autopilot, whose number makes its ports; PX4's own start-up knows 0 to 9."""
    timeout: float = 30.0
    """[s] of real time, for PX4 to connect and to answer."""
    speed: float = 0.0
    """Largest real-time factor; 0 for as fast as it goes."""
    seed: int = 0
    """Of the sensors' errors."""
    log: bool = False
    """Whether they write flight logs."""
    parameters: Mapping[str, float] = MappingProxyType({})
    """Of PX4, beside and in place of ours."""
    suite: SensorSuite = SensorSuite()
    site: Site = Site()


class AutopilotTeam:
    """The autopilots of a rig's drones; a context that ends them.

    Args:
        system: the rig.
        dt: a tick, of all sensors the shortest period [s].
        settings: how they are started and simulated.

    Attributes:
        links, offboard: of each autopilot.
        heading: of each drone, from the team's (N,) [rad].
        autopilots: their processes; None where others started them.
        clock: that holds the simulation back.

    Raises:
        FlightError: a port is taken, or an autopilot does not start or connect.
    """

    def __init__(self, system: System, dt: float, settings: Settings):
        self.settings = settings
        self.links: list[SimulatorLink] = []
        self.offboard: list[OffboardLink] = []
        self.autopilots: Autopilots | None = None
        self._dt, self.clock = dt, RealTime(settings.speed)
        self._time_us, self._ticks = 1_000_000, 0
        self._thrust_max = np.array([vehicle.rotor_thrust_max for vehicle in system.vehicles])
        self._feedforward, self.heading = LoadFeedforward(system), system.heading
        self._sensors: Sensors | None = None
        self._places: deque[tuple[int, np.ndarray]] = deque(maxlen=_PAST)
        self._stack = ExitStack()
        # Whatever fails in here closes all that was opened before; `pop_all` keeps it open once nothing has failed.
        with ExitStack() as opened:
            opened.callback(self.close)
            for i in range(system.num_drones):
                self.links.append(SimulatorLink(settings.first + i, i, settings.timeout))
                self._stack.callback(self.links[i].close)
                self.offboard.append(OffboardLink(settings.first + i))
                self._stack.callback(self.offboard[i].close)
            # Processes after ports: each PX4 connects as soon as it runs.
            if settings.build is not None:
                own = [{**rig_parameters(system, i), **settings.parameters} for i in range(system.num_drones)]
                self.autopilots = self._stack.enter_context(
                    Autopilots(settings.build, own, settings.first, settings.log)
                )
            for link in self.links:
                link.accept(self._check)
            opened.pop_all()

    @property
    def time(self) -> float:
        """Of the simulation since the autopilots began [s]."""
        return self._ticks * self._dt

    @property
    def settled(self) -> bool:
        """Whether the estimators have had time to converge, so that arming begins."""
        return self.time > _SETTLE

    def board(self, world: World) -> None:
        """Fly the drones of another world from now on; sensors keep their errors and what they remember."""
        sensors = Sensors(self.settings.suite, world.state, self._dt, self.settings.site)
        if self._sensors is None:
            sensors.reset(0, np.random.SeedSequence(self.settings.seed))
        else:
            for own, before in zip(sensors.readings, self._sensors.readings, strict=True):
                own[:] = before
        self._sensors = sensors

    def tick(self, world: World, send: Callable[[int], None]) -> None:
        """Exchange sensors for rotor thrusts, once.

        Args:
            world: that has been boarded; its thrusts are written.
            send: called with each drone that a set-point is due for.

        Raises:
            FlightError: an autopilot does not answer, or has ended.
        """
        sensors = self._sensors
        assert sensors is not None
        # With the time that this tick's sensors are going to be stamped with.
        self._places.append((self._time_us + round(self._dt * 1e6), world.state.drone_position[0].copy()))
        # The first sample is that of `Sensors.reset`.
        if self._ticks:
            sensors.read()
        self._ticks += 1
        self._time_us += round(self._dt * 1e6)
        try:
            for link in self.links:
                # To all first, then from all: autopilots compute at the same time.
                link.send(self._time_us, sensors, self.settings.site)
            if self._is_due(SETPOINT_RATE):
                self._speak(send)
            for link in self.links:
                link.receive(self._time_us)
        except FlightError:
            # An autopilot that has ended is a better reason than the answer that did not come.
            self._check(1.0)
            raise
        for i, link in enumerate(self.links):
            world.thrust[0, i] = link.controls * self._thrust_max[i]
        self.clock.wait(self.time)

    def _is_due(self, rate: float) -> bool:
        return self._ticks % max(1, round(1 / (rate * self._dt))) == 0

    def _speak(self, send: Callable[[int], None]) -> None:
        for i, autopilot in enumerate(self.offboard):
            autopilot.poll()
            if self._is_due(HEARTBEAT_RATE):
                autopilot.heartbeat()
            # Places are sent in its local frame, of which it has to say first where that begins.
            if np.isfinite(autopilot.origin).all():
                send(i)

    def prepare(
        self, world: World, on_tick: Callable[[], None] = lambda: None, may_go: Callable[[], bool] = lambda: True
    ) -> None:
        """Let the autopilots start, converge at rest and arm, in offboard mode.

        Args:
            world: that has been boarded.
            on_tick: called after each tick.
            may_go: whether they are waited for no longer, once they are armed.

        Raises:
            FlightError: one was not armed in time, with what it said.
        """
        here = world.state.drone_position[0].copy()
        yaw = [heading(tuple(attitude.ravel())) for attitude in world.state.drone_rotation[0]]
        zero = np.zeros((len(here), 3))

        def stay(i: int) -> None:
            self.send(i, np.stack([here[i], zero[i], zero[i]]), zero[i], yaw[i])

        steps = world.system.control_interval
        while not (ready := all(each.armed and each.mode == OFFBOARD for each in self.offboard)) or not may_go():
            # Set-points go out all the while: PX4 accepts offboard mode only as long as they come.
            self.tick(world, stay)
            world.step(world.thrust, steps)
            on_tick()
            if self.settled and self._is_due(HEARTBEAT_RATE):
                for autopilot in self.offboard:
                    # First the mode: armed in another one, PX4 would not follow the set-points.
                    if autopilot.mode != OFFBOARD:
                        autopilot.set_mode(OFFBOARD)
                    elif not autopilot.armed:
                        autopilot.arm()
            if self.time > READY_WITHIN and not ready:
                late = next(each for each in self.offboard if not (each.armed and each.mode == OFFBOARD))
                said = "; ".join(late.said) or "it said nothing"
                raise FlightError(f"PX4 {late.index} was not armed within {READY_WITHIN:g} s: {said}")

    def send(self, i: int, motion: np.ndarray, cable_force: np.ndarray, yaw: float, place: bool = True) -> None:
        """Send a set-point to drone i, what it carries added to its acceleration.

        Args:
            i: the drone.
            motion: position, velocity, acceleration (3, 3), world frame.
            cable_force: nominal force of the drone on its cable (3,) [N], world frame.
            yaw: from east [rad].
            place: whether position and velocity count, too.
        """
        position, velocity, acceleration = motion
        thrust = self._feedforward.acceleration(i, velocity, acceleration, cable_force, yaw)
        if place:
            self.send_motion(i, position, velocity, thrust, yaw)
        else:
            self.offboard[i].send_acceleration(self._time_us, swap_enu_ned(thrust), float(swap_yaw(yaw)))

    def send_motion(
        self, i: int, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, yaw: float
    ) -> None:
        """Send position, velocity, acceleration (3,) as PX4 is to have them, and a heading from east, to drone i.

        NaN is not controlled.
        """
        # By way of latitude and longitude: PX4's local frame begins elsewhere, and has a projection of its own.
        local = project_local(self.settings.site.to_geodetic(np.nan_to_num(position)), self.offboard[i].origin)
        local = np.where(np.isfinite(swap_enu_ned(position)), local, np.nan)
        vectors = swap_enu_ned(np.stack([velocity, acceleration]))
        self.offboard[i].send_position(self._time_us, local, vectors[0], vectors[1], float(swap_yaw(yaw)))

    def send_attitude(self, i: int, attitude: np.ndarray, thrust: float, yaw_rate: float) -> None:
        """Send an attitude (3, 3), a thrust as a share of the largest, and a yaw rate [rad/s] to drone i."""
        turning = -yaw_rate if np.isfinite(yaw_rate) else 0.0
        self.offboard[i].send_attitude(self._time_us, swap_attitude(attitude), turning, thrust)

    def send_rates(self, i: int, rates: np.ndarray, thrust: float) -> None:
        """Send body rates [rad/s] and a total thrust [N] to drone i."""
        share = float(np.clip(thrust / (4 * self._thrust_max[i]), 0.0, 1.0))
        self.offboard[i].send_rates(self._time_us, swap_flu_frd(rates), share)

    def error(self) -> np.ndarray:
        """Return how far the drones were from where their autopilots believed to be (N,) [m], at their last report."""
        errors = []
        for i, each in enumerate(self.offboard):
            # Estimates arrive late: they are compared with where the drone was at their own time.
            _, places = min(self._places, key=lambda past: abs(past[0] - each.time_us))
            local = project_local(self.settings.site.to_geodetic(places[i]), each.origin)
            errors.append(np.linalg.norm(local - each.position))
        return np.array(errors)

    def report(self, state: SystemState) -> None:
        """Write where the autopilots believe their drones to be, and how they move, to a state of one environment."""
        for i, each in enumerate(self.offboard):
            if not np.isfinite(np.concatenate([each.origin, each.position, each.velocity])).all():
                continue
            shift = _world_origin(self.settings.site, *each.origin.tolist())
            velocity = swap_enu_ned(each.velocity)
            age = 1e-6 * (self._time_us - each.time_us)
            state.drone_position[0, i] = swap_enu_ned(each.position - shift) + age * velocity
            state.drone_velocity[0, i] = velocity
            state.drone_rotation[0, i] = swap_attitude(each.attitude)
            state.drone_body_rates[0, i] = swap_flu_frd(each.rates)

    def settle(self, world: World, seconds: float = 1.0) -> None:
        """Let the autopilots run without set-points, as after landing."""
        for _ in range(round(seconds / self._dt)):
            self.tick(world, lambda i: None)
            world.step(world.thrust, world.system.control_interval)

    def _check(self, seconds: float = 0.0) -> None:
        """Raise a FlightError that names an autopilot that has ended, or does so within some seconds."""
        if self.autopilots is not None:
            self.autopilots.check(seconds)

    def close(self) -> None:
        """End the autopilots and close all ports."""
        self._stack.close()

    def __enter__(self) -> AutopilotTeam:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


@lru_cache(maxsize=64)
def _world_origin(site: Site, *origin: float) -> np.ndarray:
    """Return where the world begins in a PX4's local frame: over the metres of a flight they differ by that alone."""
    return project_local(site.to_geodetic(np.zeros(3)), np.array(origin))


ACTIONS = ("reference", "acceleration", "ctbr")
"""Action interfaces that PX4 has set-points for."""


class AutopilotController(Controller):
    """The action interface with autopilots in place of the geometric controller.

    Args:
        config: `control` says how actions become set-points.
        world: of one environment.
        team: the autopilots, which have boarded it.
    """

    def __init__(self, config: Config, world: World, team: AutopilotTeam):
        super().__init__(config, world)
        self._team, self._action = team, config.control.action

    def bind(
        self, lo: int, hi: int, action: np.ndarray, goal: Goal, plan: Call | None = None,
        around: Surroundings | None = None,
    ) -> tuple[Call, tuple[Call, ...]]:  # fmt: skip
        """See `Controller.bind`; the autopilots fly in place of the last call."""
        set_action, steps = super().bind(lo, hi, action, goal, plan, around)

        def send(i: int) -> None:
            own = self.reference
            if self._action == "ctbr":
                self._team.send_rates(i, self._setpoint.rates[0, i], self._setpoint.thrust[0, i])
            else:
                motion = np.stack([own.position[0, i], own.velocity[0, i], own.acceleration[0, i]])
                self._team.send(i, motion, goal.cable_force[0, i], own.yaw[0, i], self._action == "reference")

        def autopilots() -> None:
            self._team.tick(self.world, send)

        return set_action, (*steps[:-1], autopilots)
