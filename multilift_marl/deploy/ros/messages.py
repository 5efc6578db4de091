"""A team's state as ROS 2 messages: what is published, under which names, and how it is filled in.

The world is `world` (ENU, REP 103), bodies are FLU. Twists are in the body's frame, as `nav_msgs/Odometry` has them,
but for those of Crazyswarm2.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys.store import Typestore

from multilift_marl.deploy.ros.crazyswarm import POSES_DEADLINE, named_poses, server_odometry
from multilift_marl.deploy.ros.markers import MARKERS, Scene
from multilift_marl.deploy.ros.stages import Stage
from multilift_marl.deploy.ros.types import (
    ATTITUDE,
    CONTROL_MODE,
    EXACT,
    FULL_STATE,
    LOCAL_POSITION,
    NAMED_POSES,
    RATES,
    TRAJECTORY,
    VEHICLE_ODOMETRY,
    Motion,
    level,
    local_position,
    make_header,
    make_pose,
    px4_namespace,
    vehicle_odometry,
)
from multilift_marl.envs.core import MultiliftVec
from multilift_marl.sim.state import SystemState

ODOMETRY, POSE, BOOL = "nav_msgs/msg/Odometry", "geometry_msgs/msg/PoseStamped", "std_msgs/msg/Bool"
PATH, INT64, CABLES = "nav_msgs/msg/Path", "std_msgs/msg/Int64", "sensor_msgs/msg/JointState"
ACTION, INT32 = "std_msgs/msg/Float32MultiArray", "std_msgs/msg/Int32"
SYNC_EVERY = 0.05  # [s] of the report's clock
_COVARIANCE = np.diag(np.full(6, EXACT)).ravel()
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
    deadline: float = np.inf
    """[s] to the next message, that publishers offer."""


SYNC = Topic("/sync_time", INT64, False, True)


class Names(NamedTuple):
    """Names of topics; {} stands for a drone's number."""

    payload: str
    drone: str
    first: int
    """Number of the first drone."""
    setpoints: str
    """Type of the set-points: POSE, TRAJECTORY or FULL_STATE."""
    frame: str = "drone_{}"

    @property
    def is_report(self) -> bool:
        """Whether drones are as in the report's workspace: true poses beside the topics of a PX4."""
        return self.setpoints == TRAJECTORY


NAMES = {
    "multilift": Names("/payload/odom", "/drone_{}/odom", 0, POSE),
    "report": Names("/payload_odom", "/simulation/position_drone_{}", 1, TRAJECTORY),
    "crazyswarm2": Names("/payload/odom", "/cf{}/odom", 1, FULL_STATE, "cf{}"),
}
"""Ours, those of the report's workspace, and Crazyswarm2's (see docs/ros.md)."""
Report = Callable[[SystemState], None]
"""Writes what autopilots know of their drones to a state of one environment."""


def setpoint_topics(names: Names, drone: int) -> list[Topic]:
    """Return the topics by which others fly a drone."""
    if names.setpoints == FULL_STATE:
        return [Topic(f"/{names.frame.format(names.first + drone)}/cmd_full_state", FULL_STATE)]
    if not names.is_report:
        return [Topic(f"/drone_{drone}/setpoint", POSE)]
    topics = {"offboard_control_mode": CONTROL_MODE, "trajectory_setpoint": TRAJECTORY}
    return [Topic(f"{px4_namespace(drone)}/in/{name}", kind) for name, kind in topics.items()]


def control_topics(names: Names, drone: int, by_rates: bool = False) -> list[Topic]:
    """Return what a geometric-control node hears for a drone, then what it says: attitude or rates, PX4's mode."""
    name, kind = ("vehicle_rates_setpoint", RATES) if by_rates else ("vehicle_attitude_setpoint_v1", ATTITUDE)
    return [
        Topic(f"/drone_{names.first + drone}/trajectory_setpoint", TRAJECTORY),
        Topic(f"{px4_namespace(drone)}/in/{name}", kind),
        Topic(f"{px4_namespace(drone)}/in/offboard_control_mode", CONTROL_MODE),
    ]


def pose_stamped(store: Typestore, time_ns: int, position: np.ndarray, rotation: np.ndarray) -> Any:
    """Return a pose at a time, in the world."""
    return store.types[POSE](header=make_header(store, time_ns), pose=make_pose(store, position, rotation))


def path(store: Typestore, time_ns: int, places: np.ndarray) -> Any:
    """Return a path of places (P, 3) [m] in the world."""
    poses = [pose_stamped(store, time_ns, place, np.eye(3)) for place in places]
    return store.types[PATH](header=make_header(store, time_ns), poses=poses)


class FlightMessages:
    """The messages of environment 0.

    Args:
        vec: the environments.
        store: types of a ROS distribution.
        names: a key of `NAMES`.
        acts: whether actions fly the drones, and are published.
        report: writes what autopilots say of themselves, with the report's names; None: the truth.
        syncs: whether the report's clock is published, which a clock node does otherwise.

    Attributes:
        frames: of the drones.
        stages: of the drones (N,), see `Stage`; of the report's names.
    """

    def __init__(
        self, vec: MultiliftVec, store: Typestore, names: str = "multilift", acts: bool = True,
        report: Report | None = None, syncs: bool = True,
    ):  # fmt: skip
        self._vec, self._store, self._types, self._names = vec, store, store.types, NAMES[names]
        drones = range(self._names.first, self._names.first + vec.num_drones)
        self._drones = [self._names.drone.format(i) for i in drones]
        self.frames = [self._names.frame.format(i) for i in drones]
        self._px4 = [px4_namespace(i) for i in range(vec.num_drones)]
        self.syncs = syncs
        self.stages = np.full(vec.num_drones, Stage.TRAJECTORY)
        self._autopilots = report
        self._known = SystemState(*(array.copy() for array in vec.world.state))
        self._synced, self._acts = -1, acts
        self._scene = Scene(vec, store, self.frames)

    def topics(self) -> list[Topic]:
        """Return what is published."""
        report = self._names.is_report
        topics = [
            Topic("/clock", "rosgraph_msgs/msg/Clock"),
            Topic("/target", POSE),
            Topic("/tf", "tf2_msgs/msg/TFMessage"),
            *(Topic(f"/{frame}/reference", POSE) for frame in self.frames),
            Topic("/cables", CABLES),
            Topic("/markers", MARKERS),
            Topic("/scene", MARKERS, latched=True),
            *(Topic(f"/{frame}/action", ACTION) for frame in self.frames if self._acts),
            Topic(self._names.payload, ODOMETRY, reliable=not report),
            *(Topic(name, POSE if report else ODOMETRY, reliable=not report) for name in self._drones),
        ]
        if self._names.setpoints == FULL_STATE:
            # As Crazyswarm2 sets motion_capture_tracking up.
            topics.append(Topic("/poses", NAMED_POSES, False, deadline=POSES_DEADLINE))
            topics += [Topic(f"/{frame}/pose", POSE) for frame in self.frames]
        if report:
            for i, px4 in enumerate(self._px4):
                topics.append(Topic(f"{px4}/out/vehicle_odometry", VEHICLE_ODOMETRY, False, True))  # as PX4 does
                topics.append(Topic(f"{px4}/out/vehicle_local_position", LOCAL_POSITION, False, True))
                topics.append(Topic(f"/state/state_drone_{i}", INT32))
            if self.syncs:
                topics.append(SYNC)
        return topics

    def messages(self, time_ns: int) -> Iterator[Sent]:
        """Return the messages of the state as it is, at a time since the start [ns]; what peers act on comes last."""
        state, goal, reference = self._vec.world.state, self._vec.task.goal, self._vec.reference
        store, header = self._store, make_header(self._store, time_ns)
        yield "/clock", self._new("rosgraph_msgs/msg/Clock", clock=header.stamp)
        yield "/target", pose_stamped(store, time_ns, goal.position[0], goal.rotation[0])
        payload: Motion = tuple(array[0] for array in state[:4])
        drones = self._drone_motions(state)
        frames = {"payload": payload} | dict(zip(self.frames, drones, strict=True))
        transforms = [self._transform(header, *pair) for pair in frames.items()]
        yield "/tf", self._new("tf2_msgs/msg/TFMessage", transforms=transforms)
        for i, frame in enumerate(self.frames):
            yaw = level(reference.yaw[0, i])
            yield f"/{frame}/reference", pose_stamped(store, time_ns, reference.position[0, i], yaw)
        yield "/cables", self._cables(header)
        yield "/markers", self._scene.cables(time_ns)
        if self._scene.is_due(time_ns):
            yield "/scene", self._scene.bodies(time_ns)
        if self._acts and self._vec.steps[0] > 0:
            for frame, action in zip(self.frames, self._vec.task.action[0], strict=True):
                yield f"/{frame}/action", self._action(action)
        if self._names.setpoints == FULL_STATE:
            yield "/poses", named_poses(store, time_ns, frames)
            for frame, motion in zip(self.frames, drones, strict=True):
                yield f"/{frame}/pose", pose_stamped(store, time_ns, *motion[:2])
        yield self._names.payload, self._odometry(header, "payload", payload)
        for name, frame, motion in zip(self._drones, self.frames, drones, strict=True):
            if self._names.is_report:
                yield name, pose_stamped(store, time_ns, *motion[:2])
            elif self._names.setpoints == FULL_STATE:
                yield name, server_odometry(store, time_ns, motion)
            else:
                yield name, self._odometry(header, frame, motion)
        if self._names.is_report:
            yield from self._report(time_ns, drones)

    def _drone_motions(self, state: SystemState) -> list[Motion]:
        rows = (state.drone_position, state.drone_rotation, state.drone_velocity, state.drone_body_rates)
        return [tuple(array[0, i] for array in rows) for i in range(len(self.frames))]

    def _report(self, time_ns: int, drones: list[Motion]) -> Iterator[Sent]:
        """Return what PX4s, the state machine and the clock of the report's workspace say."""
        if self._autopilots is not None:
            self._autopilots(self._known)
            drones = self._drone_motions(self._known)
        for i, (px4, motion) in enumerate(zip(self._px4, drones, strict=True)):
            yield f"/state/state_drone_{i}", self._new(INT32, data=int(self.stages[i]))
            yield f"{px4}/out/vehicle_local_position", local_position(self._store, time_ns, motion)
            yield f"{px4}/out/vehicle_odometry", vehicle_odometry(self._store, time_ns, motion)
        if self.syncs and time_ns // int(SYNC_EVERY * 1e9) > self._synced:
            self._synced = time_ns // int(SYNC_EVERY * 1e9)
            yield SYNC.name, self._new(INT64, data=time_ns // 1000)

    def _new(self, kind: str, **fields: Any) -> Any:
        return self._types[kind](**fields)

    def _vector(self, vector: np.ndarray, kind: str = "Vector3") -> Any:
        return self._new(f"geometry_msgs/msg/{kind}", **dict(zip("xyz", (float(v) for v in vector), strict=True)))

    def _transform(self, header: Any, frame: str, motion: Motion) -> Any:
        pose = make_pose(self._store, *motion[:2])
        return self._new(
            "geometry_msgs/msg/TransformStamped", header=header, child_frame_id=frame,
            transform=self._new(
                "geometry_msgs/msg/Transform", translation=self._vector(motion[0]), rotation=pose.orientation
            ),
        )  # fmt: skip

    def _odometry(self, header: Any, frame: str, motion: Motion) -> Any:
        position, rotation, velocity, rates = motion
        twist = self._new(
            "geometry_msgs/msg/Twist", linear=self._vector(rotation.T @ velocity), angular=self._vector(rates)
        )
        pose = make_pose(self._store, position, rotation)
        return self._new(
            ODOMETRY, header=header, child_frame_id=frame,
            pose=self._new("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=_COVARIANCE),
            twist=self._new("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=_COVARIANCE),
        )  # fmt: skip

    def _action(self, action: np.ndarray) -> Any:
        """Return a drone's last action (A,), in [-1, 1]; its numbers' names are the label of its dimension."""
        size, layout = len(action), "std_msgs/msg/MultiArrayLayout"
        label = ",".join(self._vec.action_names)
        dimension = self._new("std_msgs/msg/MultiArrayDimension", label=label, size=size, stride=size)
        return self._new(
            ACTION, layout=self._new(layout, dim=[dimension], data_offset=0), data=action.astype(np.float32)
        )

    def _cables(self, header: Any) -> Any:
        """Return tensions [N] as efforts, the distances of the cables' ends [m] as positions."""
        tension = self._vec.world.state.cable_tension[0].astype(float)
        ends = [self._vec.world.cable_points(0, n) for n in range(len(tension))]
        span = np.array([np.linalg.norm(points[-1] - points[0]) for points in ends])
        names = [f"cable_{n}" for n in range(len(tension))]
        return self._new(CABLES, header=header, name=names, position=span, velocity=np.zeros(0), effort=tension)
