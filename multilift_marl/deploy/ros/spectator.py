"""What those who only watch hear of a flight: bodies, target, tensions, path and stages, the newest of each.

Publishers never wait for a spectator: it asks for no message again (best effort).
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from multilift_marl.deploy.ros.bodies import Bodies, Source
from multilift_marl.deploy.ros.dds import Node
from multilift_marl.deploy.ros.messages import CABLES, INT32, NAMES, ODOMETRY, PATH, POSE, Topic
from multilift_marl.deploy.ros.types import (
    Motion,
    check_numbers,
    read_measurement,
    read_odometry,
    read_place,
    read_pose,
)

_MOST_POINTS = 100_000  # of a path


class Spectator:
    """Hears a flight on ROS 2 topics.

    Args:
        num_drones: of the team.
        node: subscribes.
        names: of the topics, a key of `messages.NAMES`.

    Attributes:
        bodies: positions and rotations of the drones and the payload; others than those of the report's drones, whose
            true poses are heard, also have velocities.
        target: position (3,) [m] and rotation (3, 3) of the payload's; None: not heard.
        tension: of the cables (N,) [N]; None: not heard.
        path: points (P, 3) [m] of the payload's planned path; none before it is heard.
        stages: of the drones (N,), see `stages.Stage`; -1: not heard.
    """

    def __init__(self, num_drones: int, node: Node, names: str = "multilift"):
        self._node, known = node, NAMES[names]

        def hear(topic: Topic, read: Any) -> Any:
            return node.subscription(topic._replace(reliable=False), read)

        kind, read = (POSE, _read_still) if known.is_report else (ODOMETRY, read_odometry)
        drones = [Topic(known.drone.format(known.first + i), kind) for i in range(num_drones)]
        sources: list[Source] = [hear(topic, partial(read_measurement, read)) for topic in drones]
        sources.append(hear(Topic(known.payload, ODOMETRY), partial(read_measurement, read_odometry)))
        self.bodies = Bodies(sources, 0.0)
        self._take_target = hear(Topic("/target", POSE), read_place)
        self._take_tension = hear(Topic("/cables", CABLES), partial(_read_tension, num_drones))
        self._take_path = hear(Topic("/path", PATH), _read_path)
        staged = range(num_drones) if known.is_report else ()
        self._take_stages = [
            hear(Topic(f"/state/state_drone_{i}", INT32), lambda message: message.data) for i in staged
        ]
        self.target: tuple[np.ndarray, np.ndarray] | None = None
        self.tension: np.ndarray | None = None
        self.path = np.zeros((0, 3))
        self.stages = np.full(num_drones, -1)

    def poll(self, now: float) -> None:
        """Take in what has come, at a time by this machine's clock [s]."""
        self._node.check_publishers()
        self.bodies.poll(now)
        for target in self._take_target():
            self.target = target
        for tension in self._take_tension():
            self.tension = tension
        for path in self._take_path():
            self.path = path
        for i, take in enumerate(self._take_stages):
            for stage in take():
                self.stages[i] = stage


def _read_still(message: Any) -> Motion:
    """Return the pose of a `PoseStamped`, with velocities of zero."""
    return *read_pose(message.pose), np.zeros(3), np.zeros(3)


def _read_tension(num_drones: int, message: Any) -> np.ndarray:
    """Return the efforts (N,) [N] of a `JointState`, a ValueError if they are not one for each cable."""
    tension = np.asarray(message.effort, float)
    check_numbers(tension)
    if len(tension) != num_drones:
        raise ValueError(f"{len(tension)} tensions are not those of {num_drones} cables")
    return tension


def _read_path(message: Any) -> np.ndarray:
    """Return the points (P, 3) of a `nav_msgs/Path`, a ValueError where numbers are none."""
    places = (pose.pose.position for pose in message.poses[:_MOST_POINTS])
    points = np.array([(place.x, place.y, place.z) for place in places]).reshape(-1, 3)
    check_numbers(points)
    return points
