"""How fast bytes from a servo board are read, against the line that brings them."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from armcal.devices.framed import Frame, FrameDecoder, encoded

from benchmarks.report import Row

BAUD = 115_200
_BITS_A_BYTE = 10
_MESSAGES = 20_000
_AT_ONCE = 64
"""Bytes that a USB adapter hands over in one piece."""


def run() -> Iterator[Row]:
    """Frames of the serial link."""
    random = np.random.default_rng(0)
    contents = [random.bytes(int(n)) for n in random.integers(4, 32, _MESSAGES)]
    framed = b"".join(encoded(Frame(0x91, i % 256, content)) for i, content in enumerate(contents))
    yield _row("frames with a CRC", framed, FrameDecoder)


def _row(work: str, stream: bytes, decoder: Callable[[], Any]) -> Row:
    made, found = decoder(), 0
    began = time.perf_counter()
    for at in range(0, len(stream), _AT_ONCE):
        found += len(made.feed(stream[at : at + _AT_ONCE]))
    seconds = time.perf_counter() - began
    note = f"{found} of {_MESSAGES} messages, {len(stream) / seconds / 1e6:.1f} MB/s"
    return Row("links", work, seconds, f"the line, {BAUD} baud", len(stream) * _BITS_A_BYTE / BAUD, note)
