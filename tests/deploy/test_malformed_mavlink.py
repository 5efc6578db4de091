"""MAVLink that is damaged, with a right checksum or a wrong one, and floods of it, to both links of a PX4."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator

import numpy as np
import pytest
from mutate import mutate

pytest.importorskip("pymavlink")  # of the px4 extra
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from fake_px4 import FIRST, HOST
from pymavlink.generator.mavcrc import x25crc

from multilift_marl.deploy.px4 import offboard
from multilift_marl.deploy.px4.link import SimulatorLink
from multilift_marl.deploy.px4.mavlink import MAVLink, mavlink
from multilift_marl.deploy.px4.offboard import OFFBOARD, OWN_PORT, PX4_PORT, OffboardLink
from multilift_marl.errors import FlightError

INDEX = FIRST + 9
PX4 = MAVLink(INDEX + 1, 1)


def sign(data: bytes) -> bytes:
    """Return the bytes of a message with the checksum that belongs to them, by pymavlink's own code."""
    body = data[1 : 10 + data[1]]
    crc = x25crc(body)
    crc.accumulate(bytes([mavlink.mavlink_map[int.from_bytes(data[7:10], "little")].crc_extra]))
    return data[:1] + body + crc.crc.to_bytes(2, "little")


def damage(rng: np.random.Generator, data: bytes) -> bytes:
    """Return a message whose content is damaged and whose checksum is right, or one that is damaged anywhere."""
    if rng.random() < 0.3:
        return mutate(rng, data)
    return sign(data[:10] + mutate(rng, data[10:-2], fixed=True) + data[-2:])


@pytest.fixture
def link() -> Iterator[OffboardLink]:
    link = OffboardLink(INDEX)
    yield link
    link.close()


@pytest.fixture
def px4() -> Iterator[socket.socket]:
    """PX4's end of the offboard link."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as end:
        end.bind((HOST, PX4_PORT + INDEX))
        end.connect((HOST, OWN_PORT + INDEX))
        yield end


def words_of_px4() -> list[bytes]:
    messages = [
        PX4.heartbeat_encode(2, mavlink.MAV_AUTOPILOT_PX4, 129, 6 << 16, 4),
        PX4.local_position_ned_encode(1000, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0),
        PX4.gps_global_origin_encode(473977420, 85455940, 488000, 0),
        PX4.command_ack_encode(400, 1),
        PX4.statustext_encode(4, b"Preflight Fail: \x1b[2Jcompass"),
        PX4.estimator_status_encode(0, 831, *[0.1] * 8),
    ]
    return [message.pack(PX4) for message in messages]


def test_no_message_ends_the_offboard_link(link, px4):
    rng, good = np.random.default_rng(0), words_of_px4()
    for k in range(1000):
        px4.send(damage(rng, good[k % len(good)]))
        if k % 20 == 0:
            link.poll()
            link.send_position(1_000_000, *np.zeros((3, 3)), 0.0)
        assert len(link.said) <= 10
    for data in good:
        px4.send(data)
    link.poll()
    assert link.armed and link.mode == OFFBOARD and link.time_us == 1_000_000
    assert link.position.tolist() == [1, 2, 3] and link.velocity.tolist() == [4, 5, 6]
    np.testing.assert_allclose(link.origin, [47.397742, 8.545594, 488.0])
    assert link.said[-2:] == ["command 400 refused (1)", "Preflight Fail: \\x1b[2Jcompass"]
    assert link._splitter.skipped > 1000


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_an_estimate_that_is_no_number_is_none(link, px4, value):
    px4.send(PX4.local_position_ned_encode(1000, 1.0, 2.0, 3.0, 4.0, 5.0, 6.0).pack(PX4))
    px4.send(PX4.local_position_ned_encode(1020, 1.0, 2.0, value, 4.0, 5.0, 6.0).pack(PX4))
    link.poll()
    assert link.time_us == 1_000_000 and link.position.tolist() == [1, 2, 3]


def test_no_message_ends_the_lockstep_but_by_name():
    """Each answer is damaged, and followed by a sound one, which is found."""
    link, rng, refused = SimulatorLink(INDEX, 0, timeout=5.0), np.random.default_rng(0), 0
    link._connection, peer = socket.socketpair()
    with peer:
        for k in range(1, 1001):
            time_us = 4000 * k
            good = PX4.hil_actuator_controls_encode(time_us, [0.1, 0.2, 0.3, 0.4, *[0.0] * 12], 129, 1).pack(PX4)
            peer.sendall(damage(rng, good) + bytes(300) + good)
            try:
                link.receive(time_us)
                assert (link.controls >= 0).all() and (link.controls <= 1).all()
            except FlightError as error:
                assert "sets motor" in str(error)
                refused += 1
        assert 10 < refused < 500
    link.close()


def test_a_datagram_larger_than_any_of_px4_is_left_out(link, px4):
    px4.send(words_of_px4()[0] * 1000)
    link.poll()
    assert link.left_out == 1 and not link.armed


def test_a_flood_that_does_not_end_ends_the_hearing(link):
    class Flood:
        heard = 0

        def recvfrom(self, size):
            self.heard += 1
            return words_of_px4()[0], (HOST, PX4_PORT + INDEX)

        def close(self):
            pass

    link._socket.close()
    link._socket = Flood()
    link.poll()
    assert link.armed and link._socket.heard == offboard._MOST


def test_others_than_px4_are_not_heard(link):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(words_of_px4()[0], (HOST, OWN_PORT + INDEX))
        link.poll()
    assert not link.armed and link.left_out == 1


def test_a_header_without_its_message_takes_nothing_from_the_next_datagram(link, px4):
    px4.send(words_of_px4()[0][:10])
    px4.send(words_of_px4()[0])
    link.poll()
    assert link.armed
