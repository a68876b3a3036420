"""One entry of a journal as a line of text that tells whether it is whole and in its place.

A frame is a header of 35 characters, ``sequence length crc`` in 16, 8 and 8 hexadecimal digits with a space after
each, JSON of that length, and a line end. The CRC-32 goes over sequence, length and JSON, and starts from the CRC of
the frame before: a frame that is lost, repeated or out of place does not check, and neither does any after it.
"""

import json
import re
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

HEADER_BYTES = 35
DEEPEST = 100
_HEADER = re.compile(rb"([0-9a-f]{16}) ([0-9a-f]{8}) ([0-9a-f]{8}) ")


@dataclass(frozen=True)
class Frame:
    """A frame that checks: its payload, its CRC, and the byte after it."""

    sequence: int
    payload: Mapping[str, Any]
    crc: int
    end: int


class FrameError(ValueError):
    """There is no whole frame here, or not the one that belongs here; the text says why."""


def payload_of(content: Mapping[str, Any]) -> bytes:
    """Compact JSON on one line; floats read back bit for bit, tuples as lists.

    Raises:
        ValueError: not finite, nested too deeply, or a key that is no text.
        TypeError: something that is not JSON.
    """
    _check(content, DEEPEST)
    return json.dumps(content, allow_nan=False, separators=(",", ":")).encode("ascii")


def encode_frame(sequence: int, payload: bytes, previous_crc: int) -> tuple[bytes, int]:
    crc = _crc(sequence, payload, previous_crc)
    return b"%016x %08x %08x %b\n" % (sequence, len(payload), crc, payload), crc


def decode_frame(data: bytes, offset: int, sequence: int | None, previous_crc: int) -> Frame:
    """The frame that begins at a byte; any sequence number where ``sequence`` is None.

    Raises:
        FrameError: it does not check.
    """
    match = _HEADER.match(data, offset)
    if not match:
        raise FrameError("found no header of an entry, expected three hexadecimal numbers of 16, 8 and 8 digits")
    number, length, crc = (int(digits, 16) for digits in match.groups())
    start, end = offset + HEADER_BYTES, offset + HEADER_BYTES + length
    if end >= len(data):
        raise FrameError(f"found {len(data) - start} bytes of an entry, expected {length} and a line end")
    if data[end : end + 1] != b"\n":
        raise FrameError(f"found no line end after the {length} bytes of an entry")
    if sequence is not None and number != sequence:
        raise FrameError(f"found entry {number}, expected {sequence}: entries are lost, repeated or out of order")
    expected = _crc(number, data[start:end], previous_crc)
    if crc != expected:
        raise FrameError(f"found checksum {crc:08x}, expected {expected:08x}: it or the entry before it is another")
    return Frame(number, _mapping(data[start:end]), crc, end + 1)


def promised_end(data: bytes, offset: int) -> int | None:
    """Where the header at a byte says that its entry's line end stands; None if there is no header."""
    match = _HEADER.match(data, offset)
    return offset + HEADER_BYTES + int(match[2], 16) if match else None


def was_acknowledged(line: bytes) -> bool:
    """Whether a line without its end looks like a whole entry that was made durable before the next was written."""
    match = _HEADER.match(line)
    if not match or len(line) != HEADER_BYTES + int(match[2], 16):
        return False
    try:
        return "note" not in _mapping(line[HEADER_BYTES:])
    except FrameError:
        return False


def _crc(sequence: int, payload: bytes, previous_crc: int) -> int:
    return zlib.crc32(payload, zlib.crc32(b"%016x %08x " % (sequence, len(payload)), previous_crc))


def _mapping(payload: bytes) -> Mapping[str, Any]:
    try:
        content = json.loads(payload)
    except (ValueError, RecursionError) as fault:
        raise FrameError(f"found an entry that is not JSON ({fault})") from fault
    if not isinstance(content, dict) or not isinstance(content.get("kind"), str):
        raise FrameError("found an entry without a kind")
    return content


def _check(content: Any, depth: int) -> None:
    """What json would change silently, or could write and not read."""
    if depth < 0:
        raise ValueError(f"found content nested more than {DEEPEST} deep.")
    if isinstance(content, Mapping):
        for key, value in content.items():
            if not isinstance(key, str):
                raise ValueError(f"found the key {key!r}, expected text.")
            _check(value, depth - 1)
    elif isinstance(content, (list, tuple)):
        for value in content:
            _check(value, depth - 1)
