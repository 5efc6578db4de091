"""The message types of ROS distributions, those of PX4 (px4_msgs) and of Crazyflies (Crazyswarm2) among them.

PX4's are those of v1.16: what a version adds or reorders, its own `px4_msgs` has, too, and both ends must agree.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from multilift_marl.math3d import mat_to_quat, quat_to_mat
from multilift_marl.physical import GRAVITY
from multilift_marl.sim.earth import swap_attitude, swap_enu_ned, swap_flu_frd, swap_yaw

VEHICLE_ODOMETRY, LOCAL_POSITION = "px4_msgs/msg/VehicleOdometry", "px4_msgs/msg/VehicleLocalPosition"
TRAJECTORY, ATTITUDE = "px4_msgs/msg/TrajectorySetpoint", "px4_msgs/msg/VehicleAttitudeSetpoint"
RATES, CONTROL_MODE = "px4_msgs/msg/VehicleRatesSetpoint", "px4_msgs/msg/OffboardControlMode"
FULL_STATE = "crazyflie_interfaces/msg/FullState"
NAMED_POSE, NAMED_POSES = (f"motion_capture_tracking_interfaces/msg/{name}" for name in ("NamedPose", "NamedPoseArray"))
WORLD = "world"
EXACT = 1e-12  # variance of what is known exactly: of a micrometre, so that matrices have inverses
_LARGEST = 1e6  # of numbers that are measured or asked for [m, m/s, m/s², rad/s]
_LATEST = (2**31 - 3600) * 10**9  # [ns] an hour before the last stamp of ROS 2, so that answers have one
_NED, _BODY_FRD = 1, 3  # of VehicleOdometry's frames: the pose's, also the velocity's; the velocity's
_FIELDS = {
    VEHICLE_ODOMETRY: """uint64 timestamp
        uint64 timestamp_sample
        uint8 pose_frame
        float32[3] position
        float32[4] q
        uint8 velocity_frame
        float32[3] velocity
        float32[3] angular_velocity
        float32[3] position_variance
        float32[3] orientation_variance
        float32[3] velocity_variance
        uint8 reset_counter
        int8 quality""",
    LOCAL_POSITION: "\n".join([
        "uint64 timestamp", "uint64 timestamp_sample",
        *(f"bool {name}_valid" for name in ("xy", "z", "v_xy", "v_z")), *(f"float32 {axis}" for axis in "xyz"),
        "float32[2] delta_xy", "uint8 xy_reset_counter", "float32 delta_z", "uint8 z_reset_counter",
        *(f"float32 v{axis}" for axis in "xyz"), "float32 z_deriv", "float32[2] delta_vxy", "uint8 vxy_reset_counter",
        "float32 delta_vz", "uint8 vz_reset_counter", *(f"float32 a{axis}" for axis in "xyz"), "float32 heading",
        "float32 heading_var", "float32 unaided_heading", "float32 delta_heading", "uint8 heading_reset_counter",
        "bool heading_good_for_control", "float32 tilt_var", "bool xy_global", "bool z_global", "uint64 ref_timestamp",
        "float64 ref_lat", "float64 ref_lon", "float32 ref_alt", "bool dist_bottom_valid", "float32 dist_bottom",
        "float32 dist_bottom_var", "float32 delta_dist_bottom", "uint8 dist_bottom_reset_counter",
        "uint8 dist_bottom_sensor_bitfield", *(f"float32 {name}" for name in ("eph", "epv", "evh", "evv")),
        "bool dead_reckoning",
        *(f"float32 {name}" for name in ("vxy_max", "vz_max", "hagl_min", "hagl_max_z", "hagl_max_xy")),
    ]),
    TRAJECTORY: """uint64 timestamp
        float32[3] position
        float32[3] velocity
        float32[3] acceleration
        float32[3] jerk
        float32 yaw
        float32 yawspeed""",
    ATTITUDE: """uint64 timestamp
        float32 yaw_sp_move_rate
        float32[4] q_d
        float32[3] thrust_body""",
    RATES: """uint64 timestamp
        float32 roll
        float32 pitch
        float32 yaw
        float32[3] thrust_body
        bool reset_integral""",
    CONTROL_MODE: """uint64 timestamp
        bool position
        bool velocity
        bool acceleration
        bool attitude
        bool body_rate
        bool thrust_and_torque
        bool direct_actuator""",
    FULL_STATE: """std_msgs/Header header
        geometry_msgs/Pose pose
        geometry_msgs/Twist twist
        geometry_msgs/Vector3 acc""",
    NAMED_POSE: """string name
        geometry_msgs/Pose pose""",
    NAMED_POSES: """std_msgs/Header header
        NamedPose[] poses""",
}  # fmt: skip


@cache
def typestore(distribution: Stores) -> Typestore:
    """Return the types of a ROS distribution, with those of PX4 and of Crazyflies."""
    store = get_typestore(distribution)
    for kind, fields in _FIELDS.items():
        store.register(get_types_from_msg("\n".join(line.strip() for line in fields.splitlines()), kind))
    return store


def px4_namespace(drone: int) -> str:
    """Return the beginning of the topics of a drone's PX4, as its uXRCE-DDS client names them in simulation."""
    return "/fmu" if drone == 0 else f"/px4_{drone}/fmu"


def make_header(store: Typestore, time_ns: int) -> Any:
    """Return a header of a time, in the world."""
    stamp = store.types["builtin_interfaces/msg/Time"](sec=time_ns // 10**9, nanosec=time_ns % 10**9)
    return store.types["std_msgs/msg/Header"](stamp=stamp, frame_id=WORLD)


def level(yaw: float) -> np.ndarray:
    """Return the rotation (3, 3) of a level body with a heading from east [rad]."""
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def make_pose(store: Typestore, position: np.ndarray, rotation: np.ndarray) -> Any:
    """Return a pose."""
    # ROS has the real part last.
    w, x, y, z = mat_to_quat(tuple(rotation.ravel()))
    return store.types["geometry_msgs/msg/Pose"](
        position=store.types["geometry_msgs/msg/Point"](*(float(number) for number in position)),
        orientation=store.types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
    )


def stamp_ns(stamp: Any) -> int:
    """Return a `builtin_interfaces/Time` in nanoseconds."""
    return int(stamp.sec) * 10**9 + int(stamp.nanosec)


def check_numbers(*arrays: Any, missing: bool = False) -> None:
    """Refuse, by a ValueError, what nobody measures or asks for: NaN, unless it stands for `missing`, or over 1e6."""
    for array in arrays:
        numbers = np.asarray(array, float)
        sound = (np.abs(numbers) <= _LARGEST) | (missing & np.isnan(numbers))
        if not sound.all():
            raise ValueError(f"a number is {numbers[~sound].flat[0]:g}")


Motion = tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]
"""Position and rotation (body to world), velocity (world), angular velocity (body); ENU, FLU."""


def read_measurement(read: Callable[[Any], Motion], message: Any) -> tuple[int, Motion]:
    """Return when a motion was measured [ns], and what `read` returns of it.

    Raises:
        ValueError: numbers that are none, or a time that a header of ROS 2 cannot have.
    """
    motion = read(message)
    check_numbers(*motion)
    time_ns = stamp_ns(message.header.stamp) if hasattr(message, "header") else 1000 * int(message.timestamp)
    if not 0 <= time_ns < _LATEST:
        raise ValueError(f"the stamp is {time_ns * 1e-9:g} s")
    return time_ns, motion


def read_place(message: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and rotation (3, 3) of a `PoseStamped`, a ValueError where numbers are none."""
    place = read_pose(message.pose)
    check_numbers(*place)
    return place


def read_pose(pose: Any) -> tuple[np.ndarray, np.ndarray]:
    """Return position (3,) and rotation (3, 3) of a `geometry_msgs/Pose`, NaN where its quaternion is none."""
    p, q = pose.position, pose.orientation
    return np.array([p.x, p.y, p.z]), _rotation(q.w, q.x, q.y, q.z)


def read_odometry(message: Any) -> Motion:
    """Return what a `nav_msgs/Odometry` says."""
    position, rotation = read_pose(message.pose.pose)
    v, w = message.twist.twist.linear, message.twist.twist.angular
    return position, rotation, rotation @ [v.x, v.y, v.z], np.array([w.x, w.y, w.z])


def read_vehicle_odometry(message: Any) -> Motion:
    """Return what PX4's `VehicleOdometry` says; NaN where its frames have no north."""
    rotation = swap_attitude(_rotation(*(float(number) for number in message.q)))
    velocity = np.asarray(message.velocity, float)
    if message.velocity_frame == _BODY_FRD:
        velocity = rotation @ swap_flu_frd(velocity)
    else:
        velocity = swap_enu_ned(velocity) if message.velocity_frame == _NED else np.full(3, np.nan)
    position = swap_enu_ned(message.position) if message.pose_frame == _NED else np.full(3, np.nan)
    return position, rotation, velocity, swap_flu_frd(message.angular_velocity)


def vehicle_odometry(store: Typestore, time_ns: int, motion: Motion) -> Any:
    """Return PX4's `VehicleOdometry` of a motion."""
    position, rotation, velocity, rates = motion
    exact = np.full(3, EXACT, np.float32)
    return store.types[VEHICLE_ODOMETRY](
        timestamp=time_ns // 1000, timestamp_sample=time_ns // 1000, pose_frame=_NED,
        position=_single(swap_enu_ned(position)), q=_single(_quaternion(swap_attitude(rotation))), velocity_frame=_NED,
        velocity=_single(swap_enu_ned(velocity)), angular_velocity=_single(swap_flu_frd(rates)),
        position_variance=exact, orientation_variance=exact, velocity_variance=exact, reset_counter=0, quality=0,
    )  # fmt: skip


def local_position(store: Typestore, time_ns: int, motion: Motion) -> Any:
    """Return PX4's `VehicleLocalPosition` of a motion; what no one knows is zero."""
    kind = store.types[LOCAL_POSITION]
    empty = {"bool": False, "float32": 0.0, "float64": 0.0}
    values: dict[str, Any] = {}
    for line in _FIELDS[LOCAL_POSITION].splitlines():
        base, name = line.split()
        values[name] = np.zeros(2, np.float32) if base.endswith("]") else empty.get(base, 0)
    values |= {f"{name}_valid": True for name in ("xy", "z", "v_xy", "v_z")}
    values |= dict(zip("xyz", swap_enu_ned(motion[0]).tolist(), strict=True))
    values |= dict(zip(("vx", "vy", "vz"), swap_enu_ned(motion[2]).tolist(), strict=True))
    values |= {"heading": float(swap_yaw(_yaw(motion[1]))), "heading_good_for_control": True}
    return kind(**values | {"timestamp": time_ns // 1000, "timestamp_sample": time_ns // 1000})


NONE = np.full(3, np.nan)


class PX4Setpoint(NamedTuple):
    """A set-point of PX4 in ENU and FLU; NaN for what is not to be controlled."""

    position: np.ndarray
    """(3,) [m]."""
    velocity: np.ndarray
    """(3,) [m/s]."""
    acceleration: np.ndarray
    """(3,) [m/s²]."""
    yaw: float
    """From east [rad]."""
    yaw_rate: float = np.nan
    """[rad/s]."""
    attitude: np.ndarray | None = None
    """(3, 3) of one of attitude and thrust, of which the acceleration follows."""
    thrust: float = np.nan
    """Of that one, or of one of body rates, 0 to 1 of the largest."""
    jerk: np.ndarray = NONE
    """(3,) [m/s³]."""
    rates: np.ndarray | None = None
    """(3,) of one of body rates and thrust, FLU [rad/s]."""


def trajectory_setpoint(store: Typestore, time_ns: int, setpoint: PX4Setpoint) -> Any:
    """Return PX4's `TrajectorySetpoint` of a set-point's motion, heading, how fast it turns, and jerk."""
    position, velocity, acceleration, jerk = (
        _single(swap_enu_ned(vector))
        for vector in (setpoint.position, setpoint.velocity, setpoint.acceleration, setpoint.jerk)
    )
    return store.types[TRAJECTORY](
        timestamp=time_ns // 1000, position=position, velocity=velocity, acceleration=acceleration, jerk=jerk,
        yaw=float(swap_yaw(setpoint.yaw)), yawspeed=-float(setpoint.yaw_rate),
    )  # fmt: skip


def read_trajectory(message: Any) -> PX4Setpoint:
    """Return what a `TrajectorySetpoint` asks for, a ValueError where numbers are none."""
    vectors = np.stack([message.position, message.velocity, message.acceleration, message.jerk])
    check_numbers(vectors, message.yaw, message.yawspeed, missing=True)
    position, velocity, acceleration, jerk = swap_enu_ned(vectors)
    yaw, turning = float(swap_yaw(message.yaw)), -float(message.yawspeed)
    return PX4Setpoint(position, velocity, acceleration, yaw, turning, jerk=jerk)


def read_attitude(message: Any, full_acceleration: float) -> PX4Setpoint:
    """Return the acceleration and the heading that a `VehicleAttitudeSetpoint` asks for.

    Args:
        message: of an attitude and a thrust of 0 to 1.
        full_acceleration: thrust of 1 over the mass [m/s²].

    Raises:
        ValueError: numbers that are none.
    """
    rotation, none = swap_attitude(_rotation(*(float(number) for number in message.q_d))), np.full(3, np.nan)
    check_numbers(rotation, message.thrust_body[2])
    check_numbers(message.yaw_sp_move_rate, missing=True)
    # FRD: a thrust upward is negative.
    thrust = float(np.clip(-float(message.thrust_body[2]), 0.0, 1.0))
    acceleration = thrust * full_acceleration * rotation[:, 2] - [0.0, 0.0, GRAVITY]
    turning = -float(message.yaw_sp_move_rate)
    return PX4Setpoint(none, none, acceleration, _yaw(rotation), turning, rotation, thrust)


def read_rates(message: Any) -> PX4Setpoint:
    """Return what a `VehicleRatesSetpoint` asks for, a ValueError where numbers are none."""
    rates = np.array([message.roll, message.pitch, message.yaw], float)
    check_numbers(rates, message.thrust_body[2])
    thrust = float(np.clip(-float(message.thrust_body[2]), 0.0, 1.0))
    return PX4Setpoint(NONE.copy(), NONE, NONE, np.nan, thrust=thrust, rates=swap_flu_frd(rates))


def rates_setpoint(store: Typestore, time_ns: int, rates: np.ndarray, thrust: float) -> Any:
    """Return PX4's `VehicleRatesSetpoint` of body rates (3,) FLU [rad/s], and a share of the largest thrust."""
    roll, pitch, yaw = swap_flu_frd(rates).tolist()
    return store.types[RATES](
        timestamp=time_ns // 1000, roll=roll, pitch=pitch, yaw=yaw, thrust_body=_single([0.0, 0.0, -thrust]),
        reset_integral=False,
    )  # fmt: skip


def attitude_setpoint(store: Typestore, time_ns: int, rotation: np.ndarray, thrust: float, yaw_rate: float) -> Any:
    """Return PX4's `VehicleAttitudeSetpoint` of an attitude (3, 3), a share of the largest thrust, and a yaw rate."""
    return store.types[ATTITUDE](
        timestamp=time_ns // 1000, yaw_sp_move_rate=-yaw_rate, q_d=_single(_quaternion(swap_attitude(rotation))),
        thrust_body=_single([0.0, 0.0, -thrust]),
    )  # fmt: skip


def control_mode(store: Typestore, time_ns: int, kind: str = TRAJECTORY) -> Any:
    """Return PX4's `OffboardControlMode` that goes with a kind of set-points: TRAJECTORY, ATTITUDE, RATES."""
    moves = kind == TRAJECTORY
    return store.types[CONTROL_MODE](
        timestamp=time_ns // 1000, position=moves, velocity=moves, acceleration=moves, attitude=kind == ATTITUDE,
        body_rate=kind == RATES, thrust_and_torque=False, direct_actuator=False,
    )  # fmt: skip


def _yaw(rotation: np.ndarray) -> float:
    return float(np.arctan2(rotation[1, 0], rotation[0, 0]))


def _single(numbers: Any) -> np.ndarray:
    return np.asarray(numbers, np.float32)


def _quaternion(rotation: np.ndarray) -> tuple[float, ...]:
    return tuple(mat_to_quat(tuple(rotation.ravel())))


def _rotation(w: float, x: float, y: float, z: float) -> np.ndarray:
    """Return the rotation of a quaternion, of unit length or nearly; NaN if it is none."""
    if not 0.9 < w * w + x * x + y * y + z * z < 1.1:
        return np.full((3, 3), np.nan)
    return np.array(quat_to_mat(w, x, y, z)).reshape(3, 3)
