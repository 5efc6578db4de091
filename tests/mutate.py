"""Messages that are damaged, cut, spliced and filled with the numbers that break programs; the same every time."""

from __future__ import annotations

import struct

import numpy as np

SPECIAL = [
    *(struct.pack("<f", number) for number in (np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, 0.0)),
    *(struct.pack("<d", number) for number in (np.nan, np.inf, -np.inf, 1e308, -1e308, 1e30, 5e-324, 0.0)),
    *(bytes([byte]) * size for byte in (0x00, 0x7F, 0x80, 0xFF) for size in (1, 4, 8)),
    b"\xff\xff\xff\x7f", b"\x00\x00\x00\x80", b"\xff\xff\xff\xff\xff\xff\xff\x7f", b"\xc3\x28", b"\xed\xa0\x80",
]  # fmt: skip


def mutate(rng: np.random.Generator, data: bytes, fixed: bool = False) -> bytes:
    """Return bytes with one to four faults; of the same length if `fixed`."""
    changed, fixed = bytearray(data), fixed or rng.random() < 0.7
    for _ in range(rng.integers(1, 5)):
        kind, at = rng.integers(6), int(rng.integers(max(len(changed), 1)))
        if kind == 0 and changed:
            changed[at] ^= 1 << int(rng.integers(8))
        elif kind == 1 and changed:
            changed[at] = int(rng.integers(256))
        elif kind in (2, 3):
            value = SPECIAL[rng.integers(len(SPECIAL))]
            at -= at % len(value)  # where a number may be
            changed[at : at + len(value)] = value[: max(len(changed) - at, 0)] if fixed else value
        elif not fixed and kind == 4:
            del changed[at:]
        elif not fixed:
            changed[at:at] = rng.bytes(int(rng.integers(1, 40)))
    return bytes(changed)
