"""A team's state as ROS 2 messages: what is published, under which names, and how it is filled in.

The world is `world` (ENU, REP 103), bodies are FLU. Twists are in the body's frame, as `nav_msgs/Odometry` has them.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from multilift_marl.envs.core import MultiliftVec
from multilift_marl.math3d import mat_to_quat
from multilift_marl.sim.scene import DRONE_COLOURS, PAYLOAD_COLOUR

WORLD = "world"
SYNC_EVERY = 0.05  # [s] of the report's clock
_CUBE, _SPHERE, _LINES = 1, 2, 5  # kinds of markers
_CABLES = 1000  # number of their marker
Sent = tuple[str, Any]
"""A topic and its message."""


class Topic(NamedTuple):
    """A topic."""

    name: str
    kind: str
    """Type of its messages."""
    reliable: bool = True
    latched: bool = False
    """Whether late subscribers get the last one."""


class Names(NamedTuple):
    """Names of topics; {} stands for a drone's number."""

    payload: str
    drone: str
    first: int
    """Number of the first drone."""
    odometry: bool
    """Whether drones have odometry, else poses."""


NAMES = {
    "multilift": Names("/payload/odom", "/drone_{}/odom", 0, True),
    "report": Names("/payload_odom", "/simulation/position_drone_{}", 1, False),
}
"""Ours, and those of the report's workspace (see docs/ros.md)."""


class FlightMessages:
    """The messages of environment 0.

    Args:
        vec: the environments.
        store: types of a ROS distribution.
        names: a key of `NAMES`.

    Attributes:
        frames: of the drones.
    """

    def __init__(self, vec: MultiliftVec, store: Typestore, names: str = "multilift"):
        self._vec, self._types, self._names = vec, store.types, NAMES[names]
        self._report = names == "report"
        drones = range(self._names.first, self._names.first + vec.num_drones)
        self._drones = [self._names.drone.format(i) for i in drones]
        self.frames = [f"drone_{i}" for i in drones]
        self._synced = -1

    def topics(self) -> list[Topic]:
        """Return what is published."""
        kind = "nav_msgs/msg/Odometry" if self._names.odometry else "geometry_msgs/msg/PoseStamped"
        topics = [
            Topic("/clock", "rosgraph_msgs/msg/Clock"),
            Topic("/tf", "tf2_msgs/msg/TFMessage"),
            Topic(self._names.payload, "nav_msgs/msg/Odometry", reliable=not self._report),
            *(Topic(name, kind, reliable=not self._report) for name in self._drones),
            Topic("/target", "geometry_msgs/msg/PoseStamped"),
            *(Topic(f"/{frame}/reference", "geometry_msgs/msg/PoseStamped") for frame in self.frames),
            Topic("/cables", "sensor_msgs/msg/JointState"),
            Topic("/markers", "visualization_msgs/msg/MarkerArray"),
        ]
        return topics + [Topic("/sync_time", "std_msgs/msg/Int64", False, True)] * self._report

    def messages(self, time_ns: int) -> Iterator[Sent]:
        """Return the messages of the state as it is, at a time since the start [ns]."""
        state, goal, reference = self._vec.world.state, self._vec.task.goal, self._vec.reference
        header = self._header(time_ns)
        yield "/clock", self._new("rosgraph_msgs/msg/Clock", clock=header.stamp)
        bodies = [("payload", *(array[0] for array in state[:4]))]
        for i, frame in enumerate(self.frames):
            rows = (state.drone_position, state.drone_rotation, state.drone_velocity, state.drone_body_rates)
            bodies.append((frame, *(array[0, i] for array in rows)))
        transforms = [
            self._new(
                "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=frame,
                transform=self._new(
                    "geometry_msgs/msg/Transform", translation=self._vector(position),
                    rotation=self._quaternion(rotation),
                ),
            )
            for frame, position, rotation, _, _ in bodies
        ]  # fmt: skip
        yield "/tf", self._new("tf2_msgs/msg/TFMessage", transforms=transforms)
        yield self._names.payload, self._odometry(header, *bodies[0])
        for name, body in zip(self._drones, bodies[1:], strict=True):
            if self._names.odometry:
                yield name, self._odometry(header, *body)
            else:
                yield name, self._pose_stamped(header, body[1], body[2])
        yield "/target", self._pose_stamped(header, goal.position[0], goal.rotation[0])
        for i, frame in enumerate(self.frames):
            yaw = reference.yaw[0, i]
            c, s = np.cos(yaw), np.sin(yaw)
            level = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            yield f"/{frame}/reference", self._pose_stamped(header, reference.position[0, i], level)
        yield "/cables", self._cables(header)
        yield "/markers", self._markers(header)
        if self._report and time_ns // int(SYNC_EVERY * 1e9) > self._synced:
            self._synced = time_ns // int(SYNC_EVERY * 1e9)
            yield "/sync_time", self._new("std_msgs/msg/Int64", data=time_ns // 1000)

    def _new(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _header(self, time_ns: int) -> Any:
        stamp = self._new("builtin_interfaces/msg/Time", sec=time_ns // 10**9, nanosec=time_ns % 10**9)
        return self._new("std_msgs/msg/Header", stamp=stamp, frame_id=WORLD)

    def _vector(self, vector: np.ndarray, kind: str = "Vector3") -> Any:
        return self._new(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", (float(v) for v in vector), strict=True)))

    def _quaternion(self, rotation: np.ndarray) -> Any:
        w, x, y, z = mat_to_quat(tuple(rotation.ravel()))
        return self._new("geometry_msgs/msg/Quaternion", x=x, y=y, z=z, w=w)

    def _pose(self, position: np.ndarray, rotation: np.ndarray) -> Any:
        place = self._vector(position, "Point")
        return self._new("geometry_msgs/msg/Pose", position=place, orientation=self._quaternion(rotation))

    def _pose_stamped(self, header: Any, position: np.ndarray, rotation: np.ndarray) -> Any:
        return self._new("geometry_msgs/msg/PoseStamped", header=header, pose=self._pose(position, rotation))

    def _odometry(
        self, header: Any, frame: str, position: np.ndarray, rotation: np.ndarray, velocity: np.ndarray,
        rates: np.ndarray,
    ) -> Any:  # fmt: skip
        twist = self._new(
            "geometry_msgs/msg/Twist", linear=self._vector(rotation.T @ velocity), angular=self._vector(rates)
        )
        return self._new(
            "nav_msgs/msg/Odometry", header=header, child_frame_id=frame,
            pose=self._new(
                "geometry_msgs/msg/PoseWithCovariance", pose=self._pose(position, rotation), covariance=np.zeros(36)
            ),
            twist=self._new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
        )  # fmt: skip

    def _cables(self, header: Any) -> Any:
        """Return tensions [N] as efforts, the distances of the cables' ends [m] as positions."""
        tension = self._vec.world.state.cable_tension[0].astype(float)
        ends = [self._vec.world.cable_points(0, n) for n in range(len(tension))]
        span = np.array([np.linalg.norm(points[-1] - points[0]) for points in ends])
        names = [f"cable_{n}" for n in range(len(tension))]
        return self._new(
            "sensor_msgs/msg/JointState", header=header, name=names, position=span, velocity=np.zeros(0), effort=tension
        )

    def _markers(self, header: Any) -> Any:
        state, system = self._vec.world.state, self._vec.world.system
        size = np.array(system.payload_size) if system.payload_shape != "point" else np.full(3, 0.08)
        markers = [self._marker(header, 0, state.payload_position[0], state.payload_rotation[0], size)]
        for n, vehicle in enumerate(system.vehicles):
            flat = np.array([vehicle.span, vehicle.span, 0.25 * vehicle.span])
            markers.append(self._marker(header, 1 + n, state.drone_position[0, n], state.drone_rotation[0, n], flat))
        lines = self._marker(header, _CABLES, np.zeros(3), np.eye(3), np.array([0.01, 0.0, 0.0]))
        for n in range(self._vec.num_drones):
            points = self._vec.world.cable_points(0, n)
            for a, b in zip(points, points[1:], strict=False):
                lines.points += [self._vector(a, "Point"), self._vector(b, "Point")]
        return self._new("visualization_msgs/msg/MarkerArray", markers=[*markers, lines])

    def _marker(self, header: Any, number: int, position: np.ndarray, rotation: np.ndarray, size: np.ndarray) -> Any:
        kind, colour = _SPHERE, DRONE_COLOURS[(number - 1) % len(DRONE_COLOURS)]
        if number == 0:
            kind, colour = _CUBE, PAYLOAD_COLOUR
        elif number == _CABLES:
            kind, colour = _LINES, (0.1, 0.1, 0.1, 1)
        red, green, blue = (float(part) for part in colour[:3])
        return self._new(
            "visualization_msgs/msg/Marker", header=header, ns="team", id=number, type=kind, action=0,
            pose=self._pose(position, rotation), scale=self._vector(size),
            color=self._new("std_msgs/msg/ColorRGBA", r=red, g=green, b=blue, a=1.0),
            lifetime=self._new("builtin_interfaces/msg/Duration", sec=0, nanosec=0), frame_locked=False, points=[],
            colors=[], texture_resource="",
            texture=self._new("sensor_msgs/msg/CompressedImage", header=header, format="", data=np.zeros(0, np.uint8)),
            uv_coordinates=[], text="", mesh_resource="",
            mesh_file=self._new("visualization_msgs/msg/MeshFile", filename="", data=np.zeros(0, np.uint8)),
            mesh_use_embedded_materials=False,
        )  # fmt: skip
