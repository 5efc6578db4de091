"""Set-points that others say as if each PX4 had its own bridge to ROS 2: passed on to the PX4s by MAVLink."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.control.action_interface import Call
from multilift_marl.control.formation import Goal
from multilift_marl.control.obstacle_margin import Surroundings
from multilift_marl.deploy.px4.team import AutopilotTeam
from multilift_marl.deploy.ros.answers import Take, Waiting
from multilift_marl.deploy.ros.autopilots import TopicAutopilots
from multilift_marl.sim.world import World


class ForwardedSetpoints(TopicAutopilots):
    """Drones under PX4 that others fly; what is lost is held, then landed, see `TopicAutopilots`.

    Args:
        config, world, take, waiting: see `TopicAutopilots`.
        team: the autopilots, which have boarded the world.
    """

    def __init__(self, config: Config, world: World, take: Sequence[Take], waiting: Waiting, team: AutopilotTeam):
        super().__init__(config, world, take, waiting)
        self._team = team

    def bind(
        self, lo: int, hi: int, action: np.ndarray, goal: Goal, plan: Call | None = None,
        around: Surroundings | None = None,
    ) -> tuple[Call, tuple[Call, ...]]:  # fmt: skip
        """See `Controller.bind`; the autopilots fly in place of the last call."""
        hear, steps = super().bind(lo, hi, action, goal, plan, around)
        return hear, (*steps[:-1], self._tick)

    def _tick(self) -> None:
        self._team.tick(self.world, self._send)

    def _send(self, i: int) -> None:
        setpoint = self._setpoints[i]
        if setpoint.rates is not None:
            self._team.send_rates(i, setpoint.rates, setpoint.thrust * self._full_thrust[i])
            return
        if setpoint.attitude is not None:
            self._team.send_attitude(i, setpoint.attitude, setpoint.thrust, setpoint.yaw_rate)
            return
        # Where no acceleration is asked for, what holds the cable.
        acceleration = np.where(np.isfinite(setpoint.acceleration), setpoint.acceleration, self._carried(i))
        self._team.send_motion(i, setpoint.position, setpoint.velocity, acceleration, setpoint.yaw)
