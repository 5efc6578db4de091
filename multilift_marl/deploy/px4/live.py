"""The ROS 2 side of a flight by PX4: its topics, the set-points of others and their orders."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from multilift_marl.config.config import Config
from multilift_marl.deploy.px4.forwarded import ForwardedSetpoints
from multilift_marl.deploy.px4.team import AutopilotTeam
from multilift_marl.deploy.ros.answers import Answers, Waiting
from multilift_marl.deploy.ros.autopilots import subscribe_px4
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import LAND_AFTER
from multilift_marl.deploy.ros.live import LivePublisher, SetPoints, subscribe_setpoints
from multilift_marl.deploy.ros.messages import INT32, NAMES, Topic
from multilift_marl.deploy.ros.stages import Orders, Stage
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.policy import Policy


class LiveTeam(Orders):
    """Publishes a flight by PX4, and hears what others set and order.

    Args:
        config: of the flight.
        node: publishes and subscribes.
        names: of the topics, a key of `messages.NAMES`; drones of the report's publish what PX4 estimates.
        team: the autopilots.
        others: whether others fly the task.
        waiting: real time that steps wait for their set-points, and for the first ones [s].
        ordered: whether take-off and task wait for /state/command_drone_<i>.
        syncs: whether the report's clock is published.

    Attributes:
        answers: of others, once they fly the task.
    """

    def __init__(
        self, config: Config, node: Node, names: str, team: AutopilotTeam, others: bool,
        waiting: tuple[float, float], ordered: bool = False, syncs: bool = True,
    ):  # fmt: skip
        self._node, self._team, self._ordered = node, team, ordered
        count, is_report = config.env.num_drones, NAMES[names].is_report
        self._publisher = LivePublisher(node, names, acts=not (others and is_report), report=team.report, syncs=syncs)
        self._waiting = Waiting(node.wait, lambda: self._publisher.time_ns, *waiting)
        # Before the flight, so that peers are found by the time of its task.
        self._motions = subscribe_px4(node, config.system) if others and is_report else []
        self._places = subscribe_setpoints(node, names, count) if others and not is_report else []
        topics = [Topic(f"/state/command_drone_{i}", INT32) for i in range(count)]
        self._take_orders: list[Callable[[], list[Any]]] = [node.subscription(topic) for topic in topics]
        self._ordered_stages = np.full(count, Stage.INIT)
        self.answers: Answers | None = None

    def publish(self, vec: MultiliftVec, stage: Stage) -> None:
        """Publish the environment that is flown, with the time since the autopilots began."""
        self._publisher.send(vec, round(self._team.time * 1e9), np.full(vec.num_drones, stage))

    def bind_others(self, vec: MultiliftVec) -> Policy:
        """Let others fly an environment from now on, and return the policy of its steps."""
        if self._places:
            setpoints = SetPoints(vec, self._places, self._waiting)
            self.answers = setpoints.answers
            return setpoints
        forwarded = ForwardedSetpoints(vec.config, vec.world, self._motions, self._waiting, self._team)
        vec.use_controller(forwarded, self._team.report)
        forwarded.start(0)
        self.answers = forwarded.answers
        return make_scripted("formation", vec)  # whose actions do not count

    def may_begin(self, stage: Stage) -> bool:
        """See `Orders`: whether all drones have been ordered this stage, or a later one before the end."""
        self._hear_orders()
        return not self._ordered or bool(((self._ordered_stages >= stage) & (self._ordered_stages < Stage.END)).all())

    def why_to_land(self) -> str:
        """See `Orders`: a drone is ordered to end or to land, or hears no set-points any more."""
        self._hear_orders()
        if (ended := np.flatnonzero(self._ordered_stages >= Stage.END)).size:
            return f"/state/command_drone_{ended[0]} orders {int(self._ordered_stages[ended[0]])}"
        # The first ones have been waited for.
        if self.answers is not None and (lost := np.flatnonzero(self.answers.age > LAND_AFTER)).size:
            age = float(self.answers.age[lost[0]])
            since = f" for {age:.1f} s" if np.isfinite(age) else ""
            return f"no set-point of drone {lost[0]} has come{since}"
        return ""

    def _hear_orders(self) -> None:
        for i, take in enumerate(self._take_orders):
            for message in take():
                if message.data in tuple(Stage):
                    self._ordered_stages[i] = message.data
