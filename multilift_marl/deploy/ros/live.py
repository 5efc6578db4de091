"""A live simulation on ROS 2 topics: what it publishes, and the set-points that it takes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from multilift_marl.deploy.ros.answers import Answers, Take, Waiting
from multilift_marl.deploy.ros.autopilots import TopicAutopilots, subscribe_px4
from multilift_marl.deploy.ros.crazyswarm import read_full_state
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import is_landing, sink
from multilift_marl.deploy.ros.messages import NAMES, POSE, FlightMessages, Report, setpoint_topics
from multilift_marl.deploy.ros.stages import Stage
from multilift_marl.deploy.ros.types import read_place, stamp_ns
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.policies.policy import Policy


class SetPoints:
    """Set-points of others for each drone, in place of a policy: places, of which actions are made.

    A drone without a fresh one holds the last one, and sinks later, down to the ground.

    Args:
        vec: one environment, of the action interface `reference`.
        take: of each drone, its places and attitudes, see `read_stamped`.
        waiting: how steps wait for others; None: not at all.

    Attributes:
        answers: how old the set-points are.
    """

    def __init__(self, vec: MultiliftVec, take: Sequence[Take], waiting: Waiting | None = None):
        if vec.config.control.action != "reference":
            raise ConfigError(
                f"set-points are places, for control.action=reference, not {vec.config.control.action}; change it"
            )
        self._vec, self.answers = vec, Answers(take, vec.task.dt, waiting)
        self._place = np.zeros((vec.num_drones, 3))
        self._yaw = np.zeros(vec.num_drones)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Hold where the drones are; what has come before, but for answers to the last state, does not count."""
        self.answers.begin()
        self._place[:] = self._vec.world.state.drone_position[0]
        self._yaw[:] = self._vec.task.goal.drone_yaw[0] + self._vec.world.system.heading

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (1, N, 4) whose references are the set-points, as far as offsets go."""
        for n, newest in enumerate(self.answers.hear()):
            if newest is not None:
                self._place[n], rotation = newest
                self._yaw[n] = np.arctan2(rotation[1, 0], rotation[0, 0])
        sink(self._place, is_landing(self.answers.age), self._vec.task.dt)
        return self._actions()

    def _actions(self) -> np.ndarray:
        goal, control = self._vec.task.planned, self._vec.config.acting
        offset = self._place - goal.slots[0]
        c, s = goal.slot_frame[0].T
        turned = self._yaw - goal.drone_yaw[0] - self._vec.world.system.heading
        # To [-π, π), or a heading just past 180° would be a turn away.
        turned = np.remainder(turned + np.pi, 2 * np.pi) - np.pi
        # From the world into the slot frame, where actions are.
        numbers = [c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]]
        action = np.stack([*(number / control.max_offset for number in numbers), turned / control.max_yaw], axis=-1)
        return np.clip(action, -1, 1)[None].astype(np.float32)


class Idle:
    """A policy whose actions do not count: autopilots fly by the set-points of others."""

    def __init__(self, vec: MultiliftVec):
        self._action = np.zeros((1, vec.num_drones, vec.action_size), np.float32)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Do nothing."""

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return zeros (1, N, A)."""
        return self._action


def read_stamped(message: Any) -> tuple[int, tuple[np.ndarray, np.ndarray]]:
    """Return the stamp [ns] of a `PoseStamped`, 0 if it has none, with place (3,) and attitude (3, 3)."""
    return stamp_ns(message.header.stamp), read_place(message)


def subscribe_setpoints(node: Node, names: str, num_drones: int) -> list[Take]:
    """Return for each drone what takes its poses, see `SetPoints`, or full states, see `TopicAutopilots`."""
    topics = [setpoint_topics(NAMES[names], i)[0]._replace(reliable=False) for i in range(num_drones)]
    return [node.subscription(topic, read_stamped if topic.kind == POSE else read_full_state) for topic in topics]


class LivePublisher:
    """Publishes environment 0 of one batch after another, on the same topics.

    Args:
        node: publishes.
        names: of the topics, a key of `messages.NAMES`.
        acts: whether actions fly the drones, and are published.
        report: writes what autopilots know of their drones; None: the truth.
        syncs: whether the report's clock is published.

    Attributes:
        time_ns: of the state that was published last [ns].
    """

    def __init__(self, node: Node, names: str, acts: bool = True, report: Report | None = None, syncs: bool = True):
        self._node, self._names, self._given = node, names, (acts, report, syncs)
        self._publish: dict[str, Callable[[Any], None]] = {}
        self._vec: MultiliftVec | None = None
        self.time_ns = 0

    def send(self, vec: MultiliftVec, time_ns: int, stages: np.ndarray | None = None) -> None:
        """Publish the state as it is, at a time [ns]; `stages` (N,) of the drones are those of `messages.Stage`."""
        if vec is not self._vec:
            self._vec = vec
            self._messages = FlightMessages(vec, self._node.store, self._names, *self._given)
            for topic in self._messages.topics():
                if topic.name not in self._publish:
                    self._publish[topic.name] = self._node.publisher(topic)
        if stages is not None:
            self._messages.stages = stages
        self._node.check_publishers()
        self.time_ns = time_ns
        for name, message in self._messages.messages(time_ns):
            self._publish[name](message)


class LiveFlight:
    """Environment 0 on topics, episode after episode.

    Args:
        vec: one environment.
        node: publishes and subscribes.
        names: of the topics, a key of `messages.NAMES`.
        policy: of these environments; None: set-points of others, on /drone_<i>/setpoint, or as PX4s or
            Crazyflies hear them.
        syncs: whether the report's clock is published.

    Attributes:
        time_ns: of the simulation, over all episodes [ns].
        answers: of others, where there is no policy.
    """

    def __init__(
        self, vec: MultiliftVec, node: Node, names: str = "multilift", policy: Policy | None = None, syncs: bool = True
    ):
        self._vec = vec
        by_motion = policy is None and NAMES[names].setpoints != POSE
        self._publisher = LivePublisher(node, names, acts=not by_motion, syncs=syncs)
        self.answers: Answers | None = None
        if by_motion:
            is_px4 = NAMES[names].is_report
            take = subscribe_px4(node, vec.world.system) if is_px4 else subscribe_setpoints(node, names, vec.num_drones)
            autopilots = TopicAutopilots(vec.config, vec.world, take)
            vec.use_controller(autopilots)
            self.answers = autopilots.answers
            policy = Idle(vec)
        elif policy is None:
            policy = SetPoints(vec, subscribe_setpoints(node, names, vec.num_drones))
            self.answers = policy.answers
        self._policy: Policy = policy
        self.time_ns = 0

    def begin(self, seed: int) -> None:
        """Begin an episode, and publish its start."""
        self._observation, _ = self._vec.reset(seed=seed)
        self._policy.reset()
        self._send()

    def step(self) -> bool:
        """Make a policy step and publish; return whether the episode goes on.

        After its end the next one begins, a policy step later, and its start is published.
        """
        self._observation, _, terminated, truncated, _ = self._vec.step(self._policy.act(self._observation))
        self.time_ns += round(self._vec.task.dt * 1e9)
        self._send()
        if terminated[0] or truncated[0]:
            self._observation, _ = self._vec.reset()
            self._policy.reset()
            self.time_ns += round(self._vec.task.dt * 1e9)
            self._send()
            return False
        return True

    def _send(self) -> None:
        landing = np.zeros(self._vec.num_drones, bool) if self.answers is None else is_landing(self.answers.age)
        self._publisher.send(self._vec, self.time_ns, np.where(landing, Stage.LAND, Stage.TRAJECTORY))
