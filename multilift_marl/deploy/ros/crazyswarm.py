"""Messages as Crazyswarm2 has them: poses of motion capture, odometry of its server, full-state set-points.

Topics, types and frames are those of IMRCLab/crazyswarm2 with its default server (backend=cpp) and of
IMRCLab/motion_capture_tracking; the world is `world` (ENU), bodies are FLU.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from rosbags.typesys.store import Typestore

from multilift_marl.deploy.ros.failsafe import HOLD_AFTER
from multilift_marl.deploy.ros.types import (
    FULL_STATE,
    NAMED_POSE,
    NAMED_POSES,
    Motion,
    PX4Setpoint,
    check_numbers,
    level,
    make_header,
    make_pose,
    read_odometry,
    read_pose,
    stamp_ns,
)

POSES_DEADLINE = 0.01  # [s] that the server asks of /poses; who offers none, or a longer one, is not heard by it


def named_poses(store: Typestore, time_ns: int, bodies: Mapping[str, Motion]) -> Any:
    """Return the poses of bodies, by name, as motion capture publishes them."""
    poses = [store.types[NAMED_POSE](name=name, pose=make_pose(store, *motion[:2])) for name, motion in bodies.items()]
    return store.types[NAMED_POSES](header=make_header(store, time_ns), poses=poses)


def server_odometry(store: Typestore, time_ns: int, motion: Motion) -> Any:
    """Return a drone's odometry as the server fills it in: velocity in the world, neither child frame nor body rates.

    The server names the drone itself as frame of this pose; here it is the world, in which the numbers are.
    """
    position, rotation, velocity, _ = motion
    new, unknown = store.types, np.zeros(36)
    twist = new["geometry_msgs/msg/Twist"](linear=_vector(store, velocity), angular=_vector(store, np.zeros(3)))
    pose = make_pose(store, position, rotation)
    return new["nav_msgs/msg/Odometry"](
        header=make_header(store, time_ns), child_frame_id="",
        pose=new["geometry_msgs/msg/PoseWithCovariance"](pose=pose, covariance=unknown),
        twist=new["geometry_msgs/msg/TwistWithCovariance"](twist=twist, covariance=unknown),
    )  # fmt: skip


class ServerOdometry:
    """Reads the odometry of one drone, with body rates by differences of its attitudes where the server has none.

    Odometry with a child frame is read as `nav_msgs/Odometry` means it, with velocity and body rates in that frame.
    """

    def __init__(self) -> None:
        self._before: tuple[int, np.ndarray] | None = None

    def __call__(self, message: Any) -> Motion:
        """Return the motion, NaN where numbers are none."""
        if message.child_frame_id:
            return read_odometry(message)
        position, rotation = read_pose(message.pose.pose)
        v = message.twist.twist.linear
        return position, rotation, np.array([v.x, v.y, v.z]), self._rates(stamp_ns(message.header.stamp), rotation)

    def _rates(self, time_ns: int, rotation: np.ndarray) -> np.ndarray:
        """Return the mean body rates (3,) [rad/s] since the last attitude, zero where that is too old."""
        before = self._before
        if np.isfinite(rotation).all():
            self._before = time_ns, rotation
        if before is None or not 0.0 < (elapsed := 1e-9 * (time_ns - before[0])) < HOLD_AFTER:
            return np.zeros(3)
        # The antisymmetric part of a small rotation is its vector.
        turned = before[1].T @ rotation
        return np.array([turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]) / (
            2.0 * elapsed
        )


def full_state(store: Typestore, time_ns: int, setpoint: PX4Setpoint) -> Any:
    """Return a `FullState` of a set-point: its motion, heading and how fast it turns, all finite.

    The attitude is level and turns about the vertical, as Crazyswarm2's own scripts have it: of the attitude, the
    firmware's controllers use the heading alone. The radio carries each number as 16 bits of 1/1000, up to 32.767.
    """
    turning = _vector(store, np.array([0.0, 0.0, setpoint.yaw_rate]))
    return store.types[FULL_STATE](
        header=make_header(store, time_ns), pose=make_pose(store, setpoint.position, level(setpoint.yaw)),
        twist=store.types["geometry_msgs/msg/Twist"](linear=_vector(store, setpoint.velocity), angular=turning),
        acc=_vector(store, setpoint.acceleration),
    )  # fmt: skip


def read_full_state(message: Any) -> tuple[int, PX4Setpoint]:
    """Return the stamp [ns] of a `FullState`, 0 if it has none, and what it asks for, as of PX4 but all finite.

    Of its body rates the one about z counts, as in the firmware's geometric controller (Lee).

    Raises:
        ValueError: numbers that are none.
    """
    position, rotation = read_pose(message.pose)
    linear, angular = message.twist.linear, message.twist.angular
    velocity, rates, acceleration = (np.array([v.x, v.y, v.z]) for v in (linear, angular, message.acc))
    check_numbers(position, rotation, velocity, rates, acceleration)
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    return stamp_ns(message.header.stamp), PX4Setpoint(position, velocity, acceleration, yaw, float(rates[2]))


def _vector(store: Typestore, vector: np.ndarray) -> Any:
    return store.types["geometry_msgs/msg/Vector3"](*(float(number) for number in vector))
