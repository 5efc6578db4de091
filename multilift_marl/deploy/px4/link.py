"""The lockstep between the simulation and one PX4: sensors there, actuators back, stamped with the same time.

PX4's `simulator_mavlink` connects to TCP port 4560 + i. HIL_SENSOR sets its clock; it answers every one with
HIL_ACTUATOR_CONTROLS of the same time. Until the first answer, while it starts, messages go without waiting for it.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from multilift_marl.deploy.px4.mavlink import MAVLink, Splitter, mavlink
from multilift_marl.errors import FlightError
from multilift_marl.sensing.sensors import SIZES, Sensors
from multilift_marl.sim.earth import Site, altitude_at, swap_enu_ned, swap_flu_frd

HOST = "127.0.0.1"
PORT = 4560
IMU, MAGNETOMETER, BAROMETER = 0x3F, 0x1C0, 0x1A00  # bits of HIL_SENSOR's `fields_updated`
ARMED, LOCKSTEP = 128, 1  # bits of HIL_ACTUATOR_CONTROLS' mode and flags
_START_WAIT = 0.02  # [s] for an answer while PX4 starts
_WANTED = frozenset({mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS})


class SimulatorLink:
    """The simulation's side of one PX4.

    Args:
        index: of PX4's instance.
        drone: that it flies.
        timeout: [s] of real time for PX4 to connect, and to answer.

    Attributes:
        controls: last ones of the four motors, 0 to 1, all 0 while disarmed.
        armed: as PX4 said last.
        answered: whether PX4 has answered, so that every message is waited for.
        faults: answers with another time than what was sent.
    """

    def __init__(self, index: int, drone: int, timeout: float):
        self.index, self.drone = index, drone
        self.controls = np.zeros(4)
        self.armed = self.answered = False
        self.faults = 0
        self._timeout, self._asked = timeout, 0.0
        self._answered_us = -1  # the latest time of an answer that came late
        self._mavlink = MAVLink(srcSystem=1, srcComponent=1)
        self._splitter = Splitter(_WANTED)
        self._connection: socket.socket | None = None
        self._server = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
        # Or the port stays taken for a minute after a flight (TIME_WAIT).
        self._server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            self._server.bind((HOST, PORT + index))
        except OSError as error:
            self._server.close()
            raise FlightError(
                f"port {PORT + index} of PX4 {index} is taken ({error.strerror}); end the other simulation"
            ) from None
        self._server.listen(1)

    def accept(self, check: Callable[[], None]) -> None:
        """Wait for PX4 to connect.

        Args:
            check: called while waiting; raises where PX4 has ended.

        Raises:
            FlightError: it did not within the time-out.
        """
        self._server.settimeout(0.2)
        end = time.monotonic() + self._timeout
        while self._connection is None:
            check()
            try:
                self._connection, _ = self._server.accept()
            except TimeoutError:
                if time.monotonic() > end:
                    raise FlightError(
                        f"PX4 {self.index} did not connect to port {PORT + self.index} within {self._timeout:g} s"
                    ) from None
        # Nagle's algorithm would hold small messages back until the last one is acknowledged, and lockstep with it.
        self._connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, time_us: int, sensors: Sensors, site: Site) -> None:
        """Send what the sensors of the drone in environment 0 have delivered at this tick.

        Args:
            time_us: of the simulation [us].
            sensors: of the team.
            site: where the world is.
        """
        self._asked = self._asked or time.monotonic()  # kernels may have been compiled since it connected
        fresh = sensors.readings.fresh[0]
        force, rates, field, pressure = (
            swap_flu_frd(sensors.specific_force[0, self.drone]),
            swap_flu_frd(sensors.body_rates[0, self.drone]),
            # 1 µT = 0.01 G.
            swap_flu_frd(sensors.magnetic_field[0, self.drone]) * 0.01,  # [G]
            float(sensors.pressure[0, self.drone]),
        )
        updated = IMU | (MAGNETOMETER if fresh[_MAG] else 0) | (BAROMETER if fresh[_BARO] else 0)
        # Pa to hPa; then differential pressure (no airspeed sensor), altitude by the standard atmosphere,
        # temperature in °C.
        data = self._mavlink.hil_sensor_encode(
            time_us, *force, *rates, *field, pressure / 100, 0.0, float(altitude_at(pressure)), 20.0, updated
        ).pack(self._mavlink)
        if fresh[_GPS]:
            data += self._position(time_us, sensors, site)
        self._write(data)

    def _position(self, time_us: int, sensors: Sensors, site: Site) -> bytes:
        """Return HIL_GPS: degrees in 1e-7, millimetres, centimetres per second."""
        latitude, longitude, altitude = site.to_geodetic(sensors.position[0, self.drone])
        north, east, down = swap_enu_ned(sensors.velocity[0, self.drone])
        # From north, clockwise.
        course = np.degrees(np.arctan2(east, north)) % 360
        message = self._mavlink.hil_gps_encode(
            time_us, 6, round(latitude * 1e7), round(longitude * 1e7), round(altitude * 1e3), 1, 2,
            min(round(100 * float(np.hypot(north, east))), 65534), round(100 * north), round(100 * east),
            round(100 * down), round(100 * course) % 36000, 20,
        )  # fmt: skip
        return bytes(message.pack(self._mavlink))

    def receive(self, time_us: int) -> None:
        """Wait for the answer to what was sent at `time_us`; before the first answer only shortly.

        Answers to what was sent before then come late, and in order: while they come, they are waited for.

        Raises:
            FlightError: no answer within the time-out, one whose controls are no numbers, or the connection has ended.
        """
        deadline = time.monotonic() + (self._timeout if self.answered else _START_WAIT)
        while (left := deadline - time.monotonic()) > 0:
            for message in self._read(left):
                self._take(message)
                if message.time_usec == time_us:
                    return
                # A later time than was sent: lockstep has failed.
                self.faults += message.time_usec > time_us
                if self._answered_us < message.time_usec < time_us:
                    self._answered_us, deadline = message.time_usec, time.monotonic() + self._timeout
        if self.answered or time.monotonic() > self._asked + self._timeout:
            raise FlightError(f"PX4 {self.index} did not answer within {self._timeout:g} s at {time_us * 1e-6:.3f} s")

    def _take(self, message: Any) -> None:
        """Take an answer: what it sets the motors to."""
        self.answered, self.armed = True, bool(message.mode & ARMED)
        # Disarmed motors stand, whatever the message says.
        controls = np.array(message.controls[:4]) if self.armed else np.zeros(4)
        if not np.isfinite(controls).all():
            motor = int(np.argmin(np.isfinite(controls)))
            raise FlightError(
                f"PX4 {self.index} sets motor {motor} to {controls[motor]} at {message.time_usec * 1e-6:.3f} s; see "
                "its log (log=true) for what failed before"
            )
        self.controls[:] = np.clip(controls, 0.0, 1.0)

    def _read(self, timeout: float) -> list[Any]:
        assert self._connection is not None
        self._connection.settimeout(timeout)
        try:
            data = self._connection.recv(65536)
        except TimeoutError:
            return []
        except OSError as error:
            raise self._ended(error.strerror or "reset") from None
        if not data:
            raise self._ended("closed")
        return self._splitter.split(data)

    def _write(self, data: bytes) -> None:
        assert self._connection is not None
        self._connection.settimeout(self._timeout)
        try:
            self._connection.sendall(data)
        except OSError as error:
            raise self._ended(error.strerror or "no room") from None

    def _ended(self, why: str) -> FlightError:
        return FlightError(f"PX4 {self.index} has ended the connection ({why})")

    def close(self) -> None:
        """Close connection and port."""
        if self._connection is not None:
            self._connection.close()
        self._server.close()


_MAG, _BARO, _GPS = (list(SIZES).index(name) for name in ("magnetometer", "barometer", "position"))
