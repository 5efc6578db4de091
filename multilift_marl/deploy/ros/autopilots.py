"""Drones that others fly as if they were PX4s, by trajectory and attitude set-points; our controller in PX4's place."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.action_interface import Call
from multilift_marl.control.controller import Controller
from multilift_marl.control.formation import Goal
from multilift_marl.control.geometric import fly
from multilift_marl.deploy.ros.dds import Node, Take
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER, is_landing, sink
from multilift_marl.deploy.ros.messages import Topic
from multilift_marl.deploy.ros.types import (
    ATTITUDE,
    TRAJECTORY,
    PX4Setpoint,
    px4_namespace,
    read_attitude,
    read_trajectory,
)
from multilift_marl.kernels.jit import bind
from multilift_marl.sim.world import World


class TopicAutopilots(Controller):
    """Set-points of PX4 in place of actions, for one environment; the newest of either kind counts.

    As PX4 does, it knows the drone alone: an acceleration that is asked for is that of its mass, and what its cable
    needs is the business of who flies it. Where none is asked for, the nominal force on the cable is held, which PX4's
    integral would find. Each axis has its own: NaN is not controlled. A drone without a fresh set-point holds the last
    place, or the one where it is if it was asked for none, and sinks later.

    Args:
        config: `control` has the gains.
        world: of one environment.
        node: to subscribe with.

    Attributes:
        age: of each drone's last set-point (N,) [s], infinite before the first.
        late: policy steps in which a drone had none that was fresh (N,).
    """

    def __init__(self, config: Config, world: World, node: Node):
        super().__init__(config, world)
        system, drones = world.system, range(world.num_drones)
        self._full = [4 * each.rotor_thrust_max / each.mass for each in system.vehicles]
        self._sources = [self._subscribe(node, i) for i in drones]
        alone = {name: np.zeros_like(getattr(self.gains, name)) for name in ("load_share", "drag")}
        self._drone_gains = self.gains._replace(**alone)
        self._setpoints: list[PX4Setpoint] = []
        self._cable_force = np.zeros((1, len(drones), 3))  # of the task, live
        self._dt, self._step = 1.0 / config.sim.control_hz, 1.0 / config.env.policy_hz
        self.age, self.late = np.full(len(drones), np.inf), np.zeros(len(drones), int)

    def _subscribe(self, node: Node, drone: int) -> list[Take]:
        """Return what takes the set-points of either kind, each with its time [us]."""
        reads: dict[tuple[str, str], Callable[[Any], PX4Setpoint]] = {
            ("trajectory_setpoint", TRAJECTORY): read_trajectory,
            ("vehicle_attitude_setpoint_v1", ATTITUDE): partial(read_attitude, full_acceleration=self._full[drone]),
        }
        return [
            node.subscription(Topic(f"{px4_namespace(drone)}/in/{name}", kind, False), partial(_read_at, read))
            for (name, kind), read in reads.items()
        ]

    def bind(
        self, lo: int, hi: int, action: np.ndarray, goal: Goal, plan: Call | None = None
    ) -> tuple[Call, tuple[Call, ...]]:
        """See `Controller.bind`; actions do not count."""
        self._cable_force = goal.cable_force
        own = self.world.state, self.reference, np.zeros_like(goal.cable_force), self.world.thrust
        fly_alone = bind(fly, lo, hi, *own, self._drone_gains, None)
        return self._hear, (*(() if plan is None else (plan,)), self._follow, fly_alone)

    def start(self, e: int) -> None:
        """Hold the places where the drones are, until they hear otherwise."""
        super().start(e)
        self.age[:] = np.inf
        self._setpoints = [self._stay(i) for i in range(len(self.age))]

    def _stay(self, drone: int) -> PX4Setpoint:
        place, yaw = self.world.state.drone_position[0, drone].copy(), float(self.reference.yaw[0, drone])
        return PX4Setpoint(place, np.zeros(3), self._carried(drone), yaw)

    def _hold(self, drone: int) -> PX4Setpoint:
        """Return the last place to hold, where the drone is on axes that none was asked for."""
        place, _, _, yaw = self._setpoints[drone]
        here = self._stay(drone)
        return here._replace(position=np.where(np.isfinite(place), place, here.position), yaw=yaw)

    def _carried(self, drone: int) -> np.ndarray:
        """Return the acceleration [m/s²] that holds the nominal force on the cable."""
        return np.asarray(self._cable_force[0, drone] / self.world.system.drone_mass[drone])

    def _hear(self) -> None:
        """Take the newest set-points, once for each policy step; hold or land what hears none."""
        for i, sources in enumerate(self._sources):
            self.age[i] += self._step
            found = [each for take in sources for each in take()]
            for _, setpoint in sorted(found, key=lambda pair: pair[0]):
                if np.isfinite(setpoint[:3]).any():
                    self._setpoints[i], self.age[i] = setpoint, 0.0
            if self.age[i] > HOLD_AFTER:
                self.late[i] += 1
                self._setpoints[i] = self._hold(i)
            sink(self._setpoints[i].position[None], is_landing(self.age[i]), self._step)

    def _follow(self) -> None:
        """Write the references of a control tick, and let the places of moving set-points move on."""
        state, own = self.world.state, self.reference
        for i, (position, velocity, acceleration, yaw) in enumerate(self._setpoints):
            placed, moving = np.isfinite(position), np.isfinite(velocity)
            own.acceleration[0, i] = np.where(np.isfinite(acceleration), acceleration, self._carried(i))
            still = np.where(placed, 0.0, state.drone_velocity[0, i])
            own.velocity[0, i] = np.where(moving, velocity, still)
            own.position[0, i] = np.where(placed, position, state.drone_position[0, i])
            position += self._dt * np.where(moving, velocity, 0.0)  # NaN stays NaN
            if np.isfinite(yaw):
                own.yaw[0, i] = yaw
        own.jerk[:] = own.yaw_rate[:] = 0.0


def _read_at(read: Callable[[Any], PX4Setpoint], message: Any) -> tuple[int, PX4Setpoint]:
    """Return the time [us] of a set-point and what `read` returns of it."""
    return message.timestamp, read(message)
