"""What a companion computer says to one PX4 by MAVLink over UDP, and what it hears: set-points, commands, its state."""

from __future__ import annotations

import socket
from typing import Any

import numpy as np

from multilift_marl.deploy.px4.launch import PX4_PORT
from multilift_marl.deploy.px4.link import HOST
from multilift_marl.deploy.px4.mavlink import MAVLink, Splitter, mavlink
from multilift_marl.errors import FlightError, shorten
from multilift_marl.math3d import mat_to_quat, quat_to_mat

OWN_PORT = 14540
OFFBOARD, LAND = (6, 0), (4, 6)  # main and sub mode of PX4
POSITION_MASK = mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
ACCELERATION_MASK = 0x3F | mavlink.POSITION_TARGET_TYPEMASK_YAW_RATE_IGNORE
ATTITUDE_MASK = (
    mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_ROLL_RATE_IGNORE | mavlink.ATTITUDE_TARGET_TYPEMASK_BODY_PITCH_RATE_IGNORE
)
RATES_MASK = mavlink.ATTITUDE_TARGET_TYPEMASK_ATTITUDE_IGNORE
_ROUNDING = 1e-3  # by which the length of a quaternion in single precision may be off
_LARGEST = 2048  # [bytes] of a datagram; PX4's fit into an Ethernet frame
_MOST = 256  # datagrams that are heard at once; PX4 sends some ten between two set-points
_CUSTOM = mavlink.MAV_MODE_FLAG_CUSTOM_MODE_ENABLED
_WANTED = frozenset(
    {
        mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_LOCAL_POSITION_NED,
        mavlink.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN, mavlink.MAVLINK_MSG_ID_COMMAND_ACK,
        mavlink.MAVLINK_MSG_ID_STATUSTEXT, mavlink.MAVLINK_MSG_ID_ESTIMATOR_STATUS,
        mavlink.MAVLINK_MSG_ID_ATTITUDE_QUATERNION,
    }
)  # fmt: skip


class OffboardLink:
    """The companion's side of one PX4.

    Args:
        index: of the instance.

    Attributes:
        armed, mode: as the last heartbeat said; mode is PX4's main and sub mode.
        position, velocity: as PX4 estimates them, in its local frame, NED [m, m/s]; NaN before the first.
        time_us: of that estimate, by PX4's clock [us].
        attitude, rates: (3, 3) from FRD to NED, and (3,) about FRD [rad/s], as it estimates them.
        origin: latitude, longitude [deg] and altitude [m] of that frame; NaN before PX4 has said.
        said: its last words, and which commands it refused.
        left_out: datagrams of others, or larger than PX4's.
    """

    def __init__(self, index: int):
        self.index = index
        self.armed = False
        self.mode = (0, 0)
        self.position, self.velocity, self.origin = (np.full(3, np.nan) for _ in range(3))
        self.time_us = 0
        self.attitude, self.rates = np.eye(3), np.zeros(3)
        self.said: list[str] = []
        self.left_out = 0
        self._system = index + 1
        self._address = (HOST, PX4_PORT + index)
        self._mavlink = MAVLink(srcSystem=self._system, srcComponent=mavlink.MAV_COMP_ID_ONBOARD_COMPUTER)
        self._splitter = Splitter(_WANTED)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            self._socket.bind((HOST, OWN_PORT + index))
        except OSError as error:
            self._socket.close()
            raise FlightError(
                f"port {OWN_PORT + index} of PX4 {index} is taken ({error.strerror}); end what listens there"
            ) from None
        self._socket.setblocking(False)

    def poll(self) -> None:
        """Take in what has arrived, of a flood of datagrams only the first; what others than PX4 sent is left out."""
        for _ in range(_MOST):
            try:
                data, sender = self._socket.recvfrom(65536)
            except (BlockingIOError, ConnectionRefusedError):
                return
            if sender != self._address or len(data) > _LARGEST:
                self.left_out += 1
                continue
            for message in self._splitter.split_datagram(data):
                if message.get_srcSystem() == self._system:
                    self._take(message)

    def _take(self, message: Any) -> None:
        kind = message.get_type()
        if kind == "HEARTBEAT" and message.autopilot == mavlink.MAV_AUTOPILOT_PX4:
            self.armed = bool(message.base_mode & mavlink.MAV_MODE_FLAG_SAFETY_ARMED)
            # PX4's union px4_custom_mode: bits 16 to 23 the main mode, 24 to 31 the sub mode.
            self.mode = (message.custom_mode >> 16 & 0xFF, message.custom_mode >> 24 & 0xFF)
        elif kind == "LOCAL_POSITION_NED":
            motion = np.array([message.x, message.y, message.z, message.vx, message.vy, message.vz])
            if np.isfinite(motion).all():
                self.time_us, self.position[:], self.velocity[:] = 1000 * message.time_boot_ms, motion[:3], motion[3:]
        elif kind == "ATTITUDE_QUATERNION":
            turned = np.array([message.q1, message.q2, message.q3, message.q4])
            rates = np.array([message.rollspeed, message.pitchspeed, message.yawspeed])
            if abs(np.linalg.norm(turned) - 1.0) < _ROUNDING and np.isfinite(rates).all():
                self.attitude, self.rates = np.array(quat_to_mat(*turned.tolist())).reshape(3, 3), rates
        elif kind == "GPS_GLOBAL_ORIGIN":
            self.origin[:] = message.latitude * 1e-7, message.longitude * 1e-7, message.altitude * 1e-3
        elif kind == "STATUSTEXT":
            self.said = [*self.said[-9:], shorten(message.text)]
        elif kind == "COMMAND_ACK" and message.result not in (
            mavlink.MAV_RESULT_ACCEPTED,
            mavlink.MAV_RESULT_IN_PROGRESS,
        ):
            self.said = [*self.said[-9:], f"command {message.command} refused ({message.result})"]

    def heartbeat(self) -> None:
        """Say that the companion is there."""
        self._send(
            self._mavlink.heartbeat_encode(
                mavlink.MAV_TYPE_ONBOARD_CONTROLLER, mavlink.MAV_AUTOPILOT_INVALID, 0, 0, mavlink.MAV_STATE_ACTIVE
            )
        )

    def send_position(
        self, time_us: int, position: np.ndarray, velocity: np.ndarray, acceleration: np.ndarray, yaw: float
    ) -> None:
        """Ask for a place, with the velocity and the acceleration that belong to it; NED, yaw from north [rad].

        NaN is not controlled.
        """
        numbers = np.concatenate([position, velocity, acceleration])
        free = ~np.isfinite(numbers)
        mask = POSITION_MASK | int((free << np.arange(9)).sum())
        if not np.isfinite(yaw):
            mask, yaw = mask | mavlink.POSITION_TARGET_TYPEMASK_YAW_IGNORE, 0.0
        self._send_target(time_us, mask, np.where(free, 0.0, numbers), yaw)

    def send_acceleration(self, time_us: int, acceleration: np.ndarray, yaw: float) -> None:
        """Ask for an acceleration, NED [m/s²], and a yaw from north [rad]."""
        self._send_target(time_us, ACCELERATION_MASK, np.concatenate([np.zeros(6), acceleration]), yaw)

    def _send_target(self, time_us: int, mask: int, numbers: np.ndarray, yaw: float) -> None:
        # time_boot_ms, which MAVLink has in milliseconds.
        self._send(
            self._mavlink.set_position_target_local_ned_encode(
                time_us // 1000, self._system, 1, mavlink.MAV_FRAME_LOCAL_NED, mask, *numbers.tolist(), yaw, 0.0
            )
        )

    def send_rates(self, time_us: int, rates: np.ndarray, thrust: float) -> None:
        """Ask for body rates, FRD [rad/s], and a collective thrust of 0 to 1."""
        # Ignored by RATES_MASK, but it has to be a rotation.
        quaternion = [1.0, 0.0, 0.0, 0.0]
        self._send(
            self._mavlink.set_attitude_target_encode(
                time_us // 1000, self._system, 1, RATES_MASK, quaternion, *rates.tolist(), thrust
            )
        )

    def send_attitude(self, time_us: int, attitude: np.ndarray, yaw_rate: float, thrust: float) -> None:
        """Ask for an attitude (3, 3) from FRD to NED, a rate about the vertical [rad/s], and a thrust of 0 to 1."""
        quaternion = mat_to_quat(tuple(attitude.ravel()))
        self._send(
            self._mavlink.set_attitude_target_encode(
                time_us // 1000, self._system, 1, ATTITUDE_MASK, quaternion, 0.0, 0.0, yaw_rate, thrust
            )
        )

    def set_mode(self, mode: tuple[int, int]) -> None:
        """Ask for a main and a sub mode."""
        self._command(mavlink.MAV_CMD_DO_SET_MODE, _CUSTOM, *mode)

    def arm(self, armed: bool = True, force: bool = False) -> None:
        """Ask PX4 to arm or to disarm."""
        # 21196 is MAVLink's magic number for "even if checks fail, even in flight".
        self._command(mavlink.MAV_CMD_COMPONENT_ARM_DISARM, float(armed), 21196.0 if force else 0.0)

    def _command(self, number: int, *values: float) -> None:
        padded = [*values, *[0.0] * (7 - len(values))]
        self._send(self._mavlink.command_long_encode(self._system, 1, number, 0, *padded))

    def _send(self, message: Any) -> None:
        try:
            self._socket.sendto(message.pack(self._mavlink), self._address)
        except (BlockingIOError, ConnectionRefusedError):
            pass  # PX4 does not listen yet, or no longer: its heartbeat tells

    def close(self) -> None:
        """Close the port."""
        self._socket.close()
