"""Drones that others fly as if they were PX4s or Crazyflies, by motions or attitudes; our controller in their place."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.action_interface import Call
from multilift_marl.control.controller import Controller
from multilift_marl.control.formation import Goal, Reference
from multilift_marl.control.geometric import fly, fly_rates
from multilift_marl.control.obstacle_margin import Surroundings
from multilift_marl.deploy.ros.answers import Answers, Take, Waiting
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER, is_landing, sink
from multilift_marl.deploy.ros.messages import Topic
from multilift_marl.deploy.ros.types import (
    ATTITUDE,
    RATES,
    TRAJECTORY,
    PX4Setpoint,
    px4_namespace,
    read_attitude,
    read_rates,
    read_trajectory,
)
from multilift_marl.kernels.jit import bind
from multilift_marl.rig.system import System
from multilift_marl.sim.state import SystemState
from multilift_marl.sim.world import World


def subscribe_px4(node: Node, system: System) -> list[Take]:
    """Return for each drone what takes the set-points of all kinds, with their stamps, in order."""
    return [_subscribe(node, i, 4 * each.rotor_thrust_max / each.mass) for i, each in enumerate(system.vehicles)]


def _subscribe(node: Node, drone: int, full_acceleration: float) -> Take:
    reads: dict[tuple[str, str], Callable[[Any], PX4Setpoint]] = {
        ("trajectory_setpoint", TRAJECTORY): read_trajectory,
        ("vehicle_attitude_setpoint_v1", ATTITUDE): partial(read_attitude, full_acceleration=full_acceleration),
        ("vehicle_rates_setpoint", RATES): read_rates,
    }
    sources = [
        node.subscription(Topic(f"{px4_namespace(drone)}/in/{name}", kind, False), partial(read_stamped, read))
        for (name, kind), read in reads.items()
    ]

    def take() -> list[tuple[int, PX4Setpoint]]:
        found = [each for source in sources for each in source()]
        # What asks for nothing does not count.
        asking = [each for each in found if each[1].rates is not None or np.isfinite(each[1][:3]).any()]
        return sorted(asking, key=lambda pair: pair[0])

    return take


def read_stamped(read: Callable[[Any], PX4Setpoint], message: Any) -> tuple[int, PX4Setpoint]:
    """Return the stamp [ns] of a set-point of PX4, and what `read` returns of it."""
    return 1000 * int(message.timestamp), read(message)


def write_reference(
    i: int, setpoint: PX4Setpoint, carried: np.ndarray, state: SystemState, reference: Reference, dt: float
) -> None:
    """Write the reference of drone i, and let the place of a moving set-point move on by `dt` [s].

    Args:
        i: the drone, in environment 0.
        setpoint: NaN for what is not to be controlled; its position is written.
        carried: acceleration (3,) where none is asked for [m/s²].
        state: of the drones.
        reference: written.
        dt: until the next call.
    """
    position, velocity, acceleration, yaw, yaw_rate = setpoint[:5]
    placed, moving = np.isfinite(position), np.isfinite(velocity)
    reference.acceleration[0, i] = np.where(np.isfinite(acceleration), acceleration, carried)
    still = np.where(placed, 0.0, state.drone_velocity[0, i])
    reference.velocity[0, i] = np.where(moving, velocity, still)
    reference.position[0, i] = np.where(placed, position, state.drone_position[0, i])
    position += dt * np.where(moving, velocity, 0.0)  # NaN stays NaN
    if np.isfinite(yaw):
        reference.yaw[0, i] = yaw
    reference.yaw_rate[0, i] = yaw_rate if np.isfinite(yaw_rate) else 0.0
    reference.jerk[0, i] = 0.0  # which PX4 ignores


class TopicAutopilots(Controller):
    """Set-points of PX4 or a Crazyflie in place of actions, for one environment; the newest of any kind counts.

    As PX4 does, it knows the drone alone: an acceleration that is asked for is that of its mass, and what its cable
    needs is the business of who flies it. Where none is asked for, the nominal force on the cable is held, which PX4's
    integral would find. Each axis has its own: NaN is not controlled. A drone without a fresh set-point holds the last
    place, or the one where it is if it was asked for none, and sinks later.

    Args:
        config: `control` has the gains.
        world: of one environment.
        take: the set-points of each drone, see `subscribe_px4` and `crazyswarm.read_full_state`.
        waiting: how steps wait for others; None: not at all.

    Attributes:
        answers: how old the set-points are.
    """

    def __init__(self, config: Config, world: World, take: Sequence[Take], waiting: Waiting | None = None):
        super().__init__(config, world)
        self.answers = Answers(take, 1.0 / config.env.policy_hz, waiting)
        alone = {name: np.zeros_like(getattr(self.gains, name)) for name in ("load_share", "drag")}
        self._drone_gains = self.gains._replace(**alone)
        self._setpoints: list[PX4Setpoint] = []
        self._thrust_by_rates = np.zeros_like(world.thrust)
        self._full_thrust = np.array([4 * vehicle.rotor_thrust_max for vehicle in world.system.vehicles])
        self._cable_force = np.zeros((1, world.num_drones, 3))  # of the task, live
        self._dt, self._step = 1.0 / config.sim.control_hz, 1.0 / config.env.policy_hz

    def bind(
        self, lo: int, hi: int, action: np.ndarray, goal: Goal, plan: Call | None = None,
        around: Surroundings | None = None,
    ) -> tuple[Call, tuple[Call, ...]]:  # fmt: skip
        """See `Controller.bind`; actions do not count."""
        self._cable_force = goal.cable_force
        state, none, thrust = self.world.state, np.zeros_like(goal.cable_force), self.world.thrust
        self._fly = bind(fly, lo, hi, state, self.reference, none, thrust, self._drone_gains, None)
        by_rates = state, self._setpoint, none, self._thrust_by_rates
        self._fly_rates = bind(fly_rates, lo, hi, *by_rates, self._drone_gains)
        return self._hear, (*(() if plan is None else (plan,)), self._follow, self._control)

    def start(self, e: int) -> None:
        """Hold the places where the drones are, until they hear otherwise."""
        super().start(e)
        self.answers.begin()
        self._setpoints = [self._stay(i) for i in range(self.world.num_drones)]

    def _stay(self, drone: int) -> PX4Setpoint:
        place, yaw = self.world.state.drone_position[0, drone].copy(), float(self.reference.yaw[0, drone])
        return PX4Setpoint(place, np.zeros(3), self._carried(drone), yaw, 0.0)

    def _hold(self, drone: int) -> PX4Setpoint:
        """Return the last place to hold, where the drone is on axes that none was asked for."""
        place, yaw = self._setpoints[drone].position, self._setpoints[drone].yaw
        here = self._stay(drone)
        return here._replace(position=np.where(np.isfinite(place), place, here.position), yaw=yaw)

    def _carried(self, drone: int) -> np.ndarray:
        """Return the acceleration [m/s²] that holds the nominal force on the cable."""
        return np.asarray(self._cable_force[0, drone] / self.world.system.drone_mass[drone])

    def _hear(self) -> None:
        """Take the newest set-points, once for each policy step; hold or land what hears none."""
        for i, newest in enumerate(self.answers.hear()):
            if newest is not None:
                self._setpoints[i] = newest
            if self.answers.age[i] > HOLD_AFTER:
                self._setpoints[i] = self._hold(i)
            sink(self._setpoints[i].position[None], is_landing(self.answers.age[i]), self._step)

    def _follow(self) -> None:
        """Write the references of a control tick, and let the places of moving set-points move on."""
        for i, setpoint in enumerate(self._setpoints):
            write_reference(i, setpoint, self._carried(i), self.state, self.reference, self._dt)

    def _control(self) -> None:
        """Write the thrusts of a control tick."""
        self._fly()
        asked = {i: each for i, each in enumerate(self._setpoints) if each.rates is not None}
        for i, setpoint in asked.items():
            self._setpoint.rates[0, i] = setpoint.rates
            self._setpoint.thrust[0, i] = setpoint.thrust * self._full_thrust[i]
        if asked:
            self._fly_rates()
            self.world.thrust[0, list(asked)] = self._thrust_by_rates[0, list(asked)]
