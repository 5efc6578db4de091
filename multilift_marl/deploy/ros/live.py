"""A live simulation on ROS 2 topics: what it publishes, and the set-points that it takes."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

from multilift_marl.deploy.ros.autopilots import TopicAutopilots
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.failsafe import HOLD_AFTER, is_landing, sink
from multilift_marl.deploy.ros.messages import NAMES, FlightMessages, setpoint_topics
from multilift_marl.deploy.ros.types import read_place
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.errors import ConfigError
from multilift_marl.policies.baselines import make_scripted
from multilift_marl.policies.policy import Policy

Stamped = tuple[int, np.ndarray, np.ndarray]
"""Stamp [ns], place and attitude of a set-point."""


class Waiting(NamedTuple):
    """How a simulation waits for the set-points of others."""

    wait: Callable[[float], bool]
    """Waits for something new for some seconds at most, and says whether there is, see `Node.wait`."""
    asked: Callable[[], int]
    """Returns the stamp of the state that was published last [ns]; older set-points answer an older one."""
    patience: float
    """[s] of real time in each step."""
    first: float
    """[s] for the first ones of an episode."""


class SetPoints:
    """Set-points of others for each drone, in place of a policy: places, of which actions are made.

    A drone without a fresh one holds the last one, and sinks later, down to the ground.

    Args:
        vec: one environment, of the action interface `reference`.
        take: for each drone, the call that returns what has come: stamp [ns], place and attitude, see `read_stamped`.
        waiting: how steps wait for others; None: not at all.

    Attributes:
        age: of each drone's last set-point (N,) [s], infinite before the first.
        late: steps in which a drone had none that was fresh (N,).
    """

    def __init__(self, vec: MultiliftVec, take: list[Callable[[], list[Stamped]]], waiting: Waiting | None = None):
        if vec.config.control.action != "reference":
            raise ConfigError(
                f"set-points are places, for control.action=reference, not {vec.config.control.action}; change it"
            )
        self._vec, self._take, self._waiting = vec, take, waiting
        self._place = np.zeros((vec.num_drones, 3))
        self._yaw = np.zeros(vec.num_drones)
        self._answered = np.zeros(vec.num_drones, bool)
        self._kept: list[list[Stamped]] = [[] for _ in take]
        self._patient = True
        self.age = np.full(vec.num_drones, np.inf)
        self.late = np.zeros(vec.num_drones, int)

    def reset(self, mask: np.ndarray | None = None) -> None:
        """Hold where the drones are; what has come before, but for answers to the last state, does not count."""
        asked = np.inf if self._waiting is None else self._waiting.asked()
        self._kept = [[each for each in take() if each[0] >= asked] for take in self._take]
        self._place[:] = self._vec.world.state.drone_position[0]
        self._yaw[:] = self._vec.task.goal.drone_yaw[0] + self._vec.world.system.heading
        self.age[:], self._patient = np.inf, True

    def act(self, observation: np.ndarray) -> np.ndarray:
        """Return the actions (1, N, 4) whose references are the set-points, as far as offsets go."""
        dt = self._vec.task.dt
        self.age += dt
        self._answered[:] = False
        self._read()
        if self._waiting is not None:
            self._wait(self._waiting)
        self.late += self.age > HOLD_AFTER
        sink(self._place, is_landing(self.age), dt)
        return self._actions()

    def _wait(self, waiting: Waiting) -> None:
        """Wait for answers to the last state: of all drones for the first, then of those that had one lately."""
        first = self._patient and not np.isfinite(self.age).all()
        self._patient = False
        end = time.monotonic() + (waiting.first if first else waiting.patience)
        while (~self._answered & (first | (self.age <= HOLD_AFTER))).any():
            if (rest := end - time.monotonic()) <= 0.0 or not waiting.wait(rest):
                return
            self._read()

    def _read(self) -> None:
        """Take over what has come."""
        asked = 0 if self._waiting is None else self._waiting.asked()
        for n, take in enumerate(self._take):
            came, self._kept[n] = [*self._kept[n], *take()], []
            for stamp, place, rotation in came:
                self._place[n], self.age[n] = place, 0.0
                self._yaw[n] = np.arctan2(rotation[1, 0], rotation[0, 0])
                self._answered[n] |= stamp == 0 or stamp >= asked

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


def read_stamped(message: Any) -> Stamped:
    """Return stamp [ns], place (3,) and attitude (3, 3) of a `PoseStamped`; a stamp of 0 is none."""
    stamp = message.header.stamp
    return (stamp.sec * 10**9 + stamp.nanosec, *read_place(message))


def subscribe_places(node: Node, names: str, num_drones: int) -> list[Callable[[], list[Stamped]]]:
    """Return for each drone what takes its set-points, see `SetPoints`."""
    topics = [setpoint_topics(NAMES[names], i)[0]._replace(reliable=False) for i in range(num_drones)]
    return [node.subscription(topic, read_stamped) for topic in topics]


class LivePublisher:
    """Publishes environment 0 of one batch after another, on the same topics, and hears set-points for them.

    Args:
        node: publishes.
        names: of the topics, a key of `messages.NAMES`.
        acts: whether actions fly the drones, and are published.

    Attributes:
        time_ns: of the state that was published last [ns].
    """

    def __init__(self, node: Node, names: str, acts: bool = True):
        self._node, self._names, self._acts = node, names, acts
        self._publish: dict[str, Callable[[Any], None]] = {}
        self._vec: MultiliftVec | None = None
        self._take: list[Callable[[], list[Stamped]]] = []
        self.time_ns = 0

    def subscribe(self, num_drones: int) -> None:
        """Hear set-points for the drones from now on."""
        self._take = subscribe_places(self._node, self._names, num_drones)

    def set_points(self, vec: MultiliftVec, patience: float, first: float) -> SetPoints:
        """Return what flies an environment by what is heard; steps wait for it, see `Waiting`."""
        return SetPoints(vec, self._take, Waiting(self._node.wait, lambda: self.time_ns, patience, first))

    def send(self, vec: MultiliftVec, time_ns: int, landing: np.ndarray | None = None) -> None:
        """Publish the state as it is, at a time [ns]; `landing` are the drones (N,) whose set-points are lost."""
        if vec is not self._vec:
            self._vec, self._messages = vec, FlightMessages(vec, self._node.store, self._names, self._acts)
            for topic in self._messages.topics():
                if topic.name not in self._publish:
                    self._publish[topic.name] = self._node.publisher(topic)
        if landing is not None:
            self._messages.landing = landing
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
        policy: of these environments; None: set-points of others, on /drone_<i>/setpoint or as PX4s hear them.

    Attributes:
        time_ns: of the simulation, over all episodes [ns].
        setpoints: of others, where there is no policy.
    """

    def __init__(self, vec: MultiliftVec, node: Node, names: str = "multilift", policy: Policy | None = None):
        self._vec = vec
        by_motion = policy is None and NAMES[names].is_report
        self._publisher = LivePublisher(node, names, acts=not by_motion)
        self.setpoints: SetPoints | TopicAutopilots | None = None
        if by_motion:
            self.setpoints = TopicAutopilots(vec.config, vec.world, node)
            vec.use_controller(self.setpoints)
            policy = make_scripted("formation", vec)  # whose actions do not count
        elif policy is None:
            self.setpoints = policy = SetPoints(vec, subscribe_places(node, names, vec.num_drones))
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
        landing = None if self.setpoints is None else is_landing(self.setpoints.age)
        self._publisher.send(self._vec, self.time_ns, landing)
