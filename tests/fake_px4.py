"""A peer that speaks PX4's side of the protocol: lockstep over TCP, offboard over UDP. It flies by the sensors alone.

It checks what it hears (order and stamps of messages, fields in range) and notes what is wrong in `complaints`. It can
fall silent, vanish, send rubbish, and stamp its answers wrongly.
"""

from __future__ import annotations

import os
import socket
import threading
import time

import numpy as np

from multilift_marl.deploy.px4.link import PORT
from multilift_marl.deploy.px4.mavlink import MAVLink, Splitter, mavlink
from multilift_marl.deploy.px4.offboard import OWN_PORT, PX4_PORT
from multilift_marl.math3d import mat_to_quat, quat_to_mat
from multilift_marl.sim.earth import project_local

HOST = "127.0.0.1"
WORKER = int(os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw"))
FIRST = 100 + 20 * WORKER  # instances of this process, each with ports of its own
G = 9.80665
_SENSORS = frozenset({mavlink.MAVLINK_MSG_ID_HIL_SENSOR, mavlink.MAVLINK_MSG_ID_HIL_GPS})
_COMMANDS = frozenset(
    {mavlink.MAVLINK_MSG_ID_SET_POSITION_TARGET_LOCAL_NED, mavlink.MAVLINK_MSG_ID_COMMAND_LONG,
     mavlink.MAVLINK_MSG_ID_HEARTBEAT, mavlink.MAVLINK_MSG_ID_SET_ATTITUDE_TARGET}
)  # fmt: skip


def are_free(first: int = FIRST, count: int = 2) -> bool:
    """Return whether the ports can be listened to again."""
    for i in range(count):
        with socket.socket() as server:
            server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            server.bind(("127.0.0.1", PORT + first + i))
    return True


def cross(vector: np.ndarray) -> np.ndarray:
    x, y, z = vector
    return np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])


def turned(attitude: np.ndarray, vector: np.ndarray) -> np.ndarray:
    angle = np.linalg.norm(vector)
    k = cross(vector)
    return attitude @ (np.eye(3) + np.sinc(angle / np.pi) * k + 0.5 * np.sinc(angle / 2 / np.pi) ** 2 * k @ k)


class FakePX4(threading.Thread):
    """One autopilot in a thread; everything in NED and FRD.

    Args:
        index: of the instance.
        parameters: what PX4 would be given, see `rig_parameters`, with "mass", "inertia" and "thrust" of the vehicle.
        silent_after: answers before it says nothing more; None: it never falls silent.
        vanish_after: answers before it closes the connection.
        slow: answers before which it takes 50 ms each, while it starts.
        controls: of its motors once it is armed, in place of those by which it flies.
        rubbish: bytes that it sends before every answer.
        stamp: added to the time of its answers [us].
        refuses: to arm, and says why.
    """

    def __init__(
        self, index: int, parameters: dict, silent_after: int | None = None, vanish_after: int | None = None,
        rubbish: bytes = b"", stamp: int = 0, refuses: str = "", slow: int = 0, controls: list[float] | None = None,
    ):  # fmt: skip
        super().__init__(daemon=True)
        self.index, self.parameters = index, parameters
        self.silent_after, self.vanish_after, self.rubbish, self.stamp = silent_after, vanish_after, rubbish, stamp
        self.refuses, self.slow, self.controls = refuses, slow, controls
        self.complaints: list[str] = []
        self.setpoints: list = []
        self.commands: list[int] = []
        self.answers = 0
        self.times: list[int] = []
        self.armed = self.offboard = False
        self._position = self._velocity = self._origin = None
        self._attitude, self._rates = np.eye(3), np.zeros(3)
        self._sensed = 0
        self._end = threading.Event()
        self._mavlink = MAVLink(index + 1, 1)
        p = parameters
        x, y = ([p[f"CA_ROTOR{k}_P{axis}"] for k in range(4)] for axis in "XY")
        moment = [p[f"CA_ROTOR{k}_KM"] for k in range(4)]
        thrust = p["thrust"]
        allocation = thrust * np.array([np.ones(4), -np.array(y), np.array(x), moment])  # up, roll, pitch, yaw of FRD
        self._mixer = np.linalg.inv(allocation)

    def run(self) -> None:
        """Connect, and answer until the connection ends."""
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        self._udp.bind((HOST, PX4_PORT + self.index))
        self._udp.setblocking(False)
        splitter, commands = Splitter(_SENSORS), Splitter(_COMMANDS)
        with self._udp, self._connect() as connection:
            while not self._end.is_set():
                try:
                    data = connection.recv(65536)
                except TimeoutError:
                    continue
                except OSError:
                    return
                if not data:
                    return
                for message in splitter.split(data):
                    if message.get_type() == "HIL_GPS":
                        self._take_place(message)
                        continue
                    self._take_sensors(message)
                    try:
                        while True:
                            for command in commands.split(self._udp.recv(65536)):
                                self._take_command(command)
                    except BlockingIOError:
                        pass
                    if not self._answer(connection, message):
                        return

    def end(self) -> None:
        """End the thread."""
        self._end.set()
        self.join(5)

    def _connect(self) -> socket.socket:
        while not self._end.is_set():
            try:
                connection = socket.create_connection((HOST, PORT + self.index), timeout=0.2)
                connection.settimeout(0.2)
                return connection
            except OSError:
                time.sleep(0.02)
        return socket.socket()

    def _answer(self, connection: socket.socket, sensors) -> bool:
        self._sensed += 1
        if self._sensed < 12:  # it starts
            return True
        if self.vanish_after is not None and self.answers >= self.vanish_after:
            return False
        if self.silent_after is not None and self.answers >= self.silent_after:
            return True
        if self.answers < self.slow:
            time.sleep(0.05)
        motors = self._fly() if self.controls is None else self.controls
        controls = [*(motors if self.armed else np.zeros(4)), *[0.0] * 12]
        message = self._mavlink.hil_actuator_controls_encode(
            sensors.time_usec + self.stamp, [float(c) for c in controls], 129 if self.armed else 1, 1
        )
        connection.sendall(self.rubbish + message.pack(self._mavlink))
        self.answers += 1
        if self.answers % 25 == 0:
            self._report(sensors.time_usec)
        if self.answers % 5 == 0 and self._origin is not None:
            self._report_motion(sensors.time_usec)
        return True

    def _report(self, time_us: int) -> None:
        mode = (6 << 16) if self.offboard else (1 << 16)
        base = 1 | (mavlink.MAV_MODE_FLAG_SAFETY_ARMED if self.armed else 0)
        messages = [self._mavlink.heartbeat_encode(2, mavlink.MAV_AUTOPILOT_PX4, base, mode, 4)]
        if self._origin is not None:
            latitude, longitude, altitude = self._origin
            messages.append(
                self._mavlink.gps_global_origin_encode(
                    round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3), time_us
                )
            )
        self._say(messages)

    def _report_motion(self, time_us: int) -> None:
        attitude = mat_to_quat(tuple(self._attitude.ravel()))
        self._say(
            [
                self._mavlink.local_position_ned_encode(time_us // 1000, *self._position, *self._velocity),
                self._mavlink.attitude_quaternion_encode(time_us // 1000, *attitude, *self._rates),
            ]
        )

    def _say(self, messages: list) -> None:
        for message in messages:
            self._udp.sendto(message.pack(self._mavlink), (HOST, OWN_PORT + self.index))

    # What it hears

    def _take_place(self, message) -> None:
        geodetic = np.array([message.lat * 1e-7, message.lon * 1e-7, message.alt * 1e-3])
        velocity = np.array([message.vn, message.ve, message.vd]) * 0.01
        if message.fix_type < 3 or message.satellites_visible < 6:
            self.complaints.append("no fix")
        if self._origin is None:
            self._origin, self._position, self._velocity = geodetic, np.zeros(3), velocity
        off = project_local(geodetic, self._origin) - self._position
        self._position = self._position + 0.02 * off
        self._velocity = self._velocity + 0.02 * (velocity - self._velocity)

    def _take_sensors(self, message) -> None:
        if self.times and message.time_usec <= self.times[-1]:
            self.complaints.append(f"time went from {self.times[-1]} to {message.time_usec}")
        dt = (message.time_usec - self.times[-1]) * 1e-6 if self.times else 0.0
        self.times.append(message.time_usec)
        if message.id != 0 or message.fields_updated & 0x3F != 0x3F:
            self.complaints.append(f"id {message.id}, fields {message.fields_updated:#x}")
        if not 300 < message.abs_pressure < 1100:
            self.complaints.append(f"pressure of {message.abs_pressure} hPa")
        force = np.array([message.xacc, message.yacc, message.zacc])
        field = np.array([message.xmag, message.ymag, message.zmag])
        if not 0.2 < np.linalg.norm(field) < 0.7:
            self.complaints.append(f"field of {np.linalg.norm(field)} G")
        if len(self.times) == 1:  # level and north from gravity and the field, less its declination
            down = -force / np.linalg.norm(force)
            east = np.cross(down, field)
            east /= np.linalg.norm(east)
            level = np.stack([np.cross(east, down), east, down])
            angle = np.radians(3.3)
            self._attitude = np.array(
                [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]]
            ) @ level  # fmt: skip
        rates = np.array([message.xgyro, message.ygyro, message.zgyro])
        self._rates = rates
        self._attitude = turned(self._attitude, dt * rates)
        if self._position is not None:
            acceleration = self._attitude @ force + [0, 0, G]
            self._position = self._position + dt * self._velocity
            self._velocity = self._velocity + dt * acceleration

    def _take_command(self, message) -> None:
        kind = message.get_type()
        if kind == "COMMAND_LONG":
            self.commands.append(message.command)
            result = mavlink.MAV_RESULT_ACCEPTED
            if message.command == mavlink.MAV_CMD_DO_SET_MODE:
                self.offboard = (message.param2, message.param3) == (6.0, 0.0)
            elif message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM and self.refuses:
                result = mavlink.MAV_RESULT_DENIED
                text = self._mavlink.statustext_encode(4, self.refuses.encode())
                self._udp.sendto(text.pack(self._mavlink), (HOST, OWN_PORT + self.index))
            elif message.command == mavlink.MAV_CMD_COMPONENT_ARM_DISARM:
                self.armed = bool(message.param1)
            acknowledged = self._mavlink.command_ack_encode(message.command, result)
            self._udp.sendto(acknowledged.pack(self._mavlink), (HOST, OWN_PORT + self.index))
        elif kind == "SET_ATTITUDE_TARGET":
            self.setpoints.append(message)
        elif kind == "SET_POSITION_TARGET_LOCAL_NED":
            if message.target_system != self.index + 1 or message.coordinate_frame != 1:
                self.complaints.append(f"set-point for {message.target_system} in frame {message.coordinate_frame}")
            self.setpoints.append(message)

    # How it flies: a geometric controller of its own

    def _fly(self) -> np.ndarray:
        if not self.setpoints or self._position is None:
            return np.full(4, 0.05)
        sp, p = self.setpoints[-1], self.parameters
        if sp.get_type() == "SET_ATTITUDE_TARGET" and not sp.type_mask & 128:
            desired = np.array(quat_to_mat(*sp.q)).reshape(3, 3)
            return self._turn(desired, 4 * p["thrust"] * sp.thrust)
        if sp.get_type() == "SET_ATTITUDE_TARGET":
            wanted = np.array([sp.body_roll_rate, sp.body_pitch_rate, sp.body_yaw_rate])
            torque = np.array(p["inertia"]) * 22.0 * (wanted - self._rates)
            return np.clip(self._mixer @ [4 * p["thrust"] * sp.thrust, *torque], 0.0, 1.0)
        place, velocity = np.array([sp.x, sp.y, sp.z]), np.array([sp.vx, sp.vy, sp.vz])
        acceleration = np.array([sp.afx, sp.afy, sp.afz])
        if sp.type_mask & 1:  # an acceleration alone
            place, velocity = self._position, self._velocity
        wanted = 6.0 * (place - self._position) + 4.0 * (velocity - self._velocity) + acceleration - [0, 0, G]
        force = p["mass"] * wanted
        down = -force / np.linalg.norm(force)
        forward = np.array([np.cos(sp.yaw), np.sin(sp.yaw), 0.0])
        right = np.cross(down, forward)
        right /= np.linalg.norm(right)
        desired = np.stack([np.cross(right, down), right, down], axis=1)
        return self._turn(desired, max(-force @ self._attitude[:, 2], 0.0))

    def _turn(self, desired: np.ndarray, lift: float) -> np.ndarray:
        """Return the motors that turn the drone to an attitude, at a total thrust [N]."""
        error = 0.5 * (desired.T @ self._attitude - self._attitude.T @ desired)
        attitude = np.array([error[2, 1], error[0, 2], error[1, 0]])
        inertia = np.array(self.parameters["inertia"])
        torque = inertia * (-150.0 * attitude - 22.0 * self._rates) * [1, 1, 0.3]
        return np.clip(self._mixer @ [lift, *torque], 0.0, 1.0)
