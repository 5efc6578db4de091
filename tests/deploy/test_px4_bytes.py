"""PX4's bytes: streams that are split, damaged and random, and one that was recorded."""

from __future__ import annotations

import base64
import sys
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("pymavlink")  # of the px4 extra
if sys.platform == "win32":
    pytest.skip("PX4 flies on Linux and macOS alone", allow_module_level=True)
from fake_px4 import FIRST

from multilift_marl.deploy.px4.mavlink import MAVLink, Splitter, mavlink
from multilift_marl.deploy.px4.offboard import OFFBOARD, OffboardLink
from multilift_marl.sim.earth import Site

RECORDED = Path(__file__).with_name("px4_stream.txt")


def test_a_stream_is_cut_into_messages_wherever_it_is_split():
    sender = MAVLink(1, 1)
    sent = [sender.hil_actuator_controls_encode(k, [0.1 * k] * 16, 128, 1) for k in range(5)]
    other = sender.heartbeat_encode(2, 12, 0, 0, 4)
    stream = b"rubbish" + b"".join(message.pack(sender) + other.pack(sender) for message in sent) + b"\xfd\x03"
    wanted = {mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS}
    for size in (1, 2, 7, 50, 1000):
        splitter = Splitter(wanted)
        heard = [m for k in range(0, len(stream), size) for m in splitter.split(stream[k : k + size])]
        assert [message.time_usec for message in heard] == list(range(5))
        assert splitter.skipped == 7


def test_what_is_damaged_is_skipped_and_no_more():
    sender, rng = MAVLink(1, 1), np.random.default_rng(0)
    messages = [sender.hil_actuator_controls_encode(k, [0.5] * 16, 128, 1).pack(sender) for k in range(50)]
    damaged = set(rng.choice(50, 20, replace=False).tolist())
    for k in damaged:
        data = bytearray(messages[k])
        data[rng.integers(12, len(data))] ^= 1 << int(rng.integers(8))
        messages[k] = bytes(data)
    splitter = Splitter({mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS})
    heard = {message.time_usec for message in splitter.split(b"".join(messages) + bytes(400))}
    assert heard == set(range(50)) - damaged


def test_random_bytes_neither_hang_nor_raise():
    rng = np.random.default_rng(0)
    splitter = Splitter({mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS})
    for _ in range(200):
        data = rng.integers(0, 256, rng.integers(0, 600)).astype(np.uint8)
        data[rng.random(len(data)) < 0.1] = 0xFD
        assert splitter.split(data.tobytes()) == []


@pytest.mark.parametrize("size", [1, 5, 64, 10_000])
def test_what_px4_itself_said_is_understood(size):
    """To the simulator: two messages of the start, two answers before arming, three in flight; then to another."""
    to_simulator, to_companion = map(base64.b64decode, RECORDED.read_text().partition("\n")[2].split("\n\n"))
    splitter = Splitter({mavlink.MAVLINK_MSG_ID_HIL_ACTUATOR_CONTROLS})
    cut = [to_simulator[k : k + size] for k in range(0, len(to_simulator), size)]
    answers = [message for part in cut for message in splitter.split(part)]
    assert splitter.skipped == 0
    assert [bool(answer.mode & 128) for answer in answers] == [False, False, True, True, True]
    assert np.diff([answer.time_usec for answer in answers]).tolist()[2:] == [4000, 4000]
    assert all(0.1 < control < 0.9 for answer in answers[2:] for control in answer.controls[:4])
    assert all(answer.flags & 1 for answer in answers)  # lockstep

    link = OffboardLink(FIRST + 9)
    try:
        link._system = 6  # that of instance 5, which it is a record of
        for k in range(0, len(to_companion), size):
            for message in link._splitter.split(to_companion[k : k + size]):
                assert message.get_srcSystem() == 6
                link._take(message)
        assert link._splitter.skipped == 0
        assert link.armed and link.mode == OFFBOARD
        site = Site()
        np.testing.assert_allclose(link.origin[:2], [site.latitude, site.longitude], atol=2e-5)
        assert np.isfinite(link.position).all() and link.time_us > 12_000_000
    finally:
        link.close()
