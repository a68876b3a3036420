"""The framed protocol between a host and a servo board, version 1, for the host; docs/link_protocol.md specifies it.

Frames on a serial line: COBS [Cheshire1999], then a zero. Inside: type, sequence, payload, CRC-32, little endian.
"""

import struct
import zlib
from collections.abc import Iterable, Sequence
from enum import IntEnum, IntFlag
from typing import NamedTuple

VERSION = 1
MAX_PAYLOAD = 240  # bytes
DELIMITER = b"\0"

_AROUND = 6  # type, sequence and CRC
_LONGEST = MAX_PAYLOAD + _AROUND + 1  # bodies are shorter than a COBS block, which adds one byte
_LONGEST_BLOCK = 254


class Kind(IntEnum):
    """Types of frames; a reply has the request's plus ``REPLY``, but for ``REFUSED``."""

    HELLO = 0x01
    TAKE = 0x02
    WRITE = 0x10
    READ = 0x11
    SET = 0x12
    BEAT = 0x20
    GUARD = 0x21
    REPLY = 0x80
    REFUSED = 0xFF


class Flag(IntFlag):
    """What a board says of itself in every reply."""

    TOOK_OVER = 1
    GUARDED = 2
    STUCK = 4


class Code(IntEnum):
    """Why a request is refused."""

    UNKNOWN_TYPE = 1
    BAD_PAYLOAD = 2
    NO_ADDRESS = 3
    NO_DATA = 4
    TOOK_OVER = 5
    WRONG_BOOTS = 6
    STUCK = 7


class Frame(NamedTuple):
    kind: int  # the message's type (0 to 255)
    sequence: int  # which request it is, or answers (0 to 255)
    payload: bytes = b""  # at most ``MAX_PAYLOAD`` bytes


def encoded(frame: Frame) -> bytes:
    """The frame as it goes over the line, its delimiter included."""
    if len(frame.payload) > MAX_PAYLOAD:
        raise ValueError(f"found a payload of {len(frame.payload)} bytes, expected at most {MAX_PAYLOAD}")
    body = bytes((frame.kind, frame.sequence)) + frame.payload
    return cobs_encoded(body + zlib.crc32(body).to_bytes(4, "little")) + DELIMITER


class FrameDecoder:
    """Cuts a stream of bytes into frames; what does not decode is counted in ``dropped``."""

    def __init__(self) -> None:
        self.dropped = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that these bytes complete."""
        *pieces, rest = (self._rest + data).split(DELIMITER)
        self._rest = rest[: _LONGEST + 1]  # one byte too many is enough to know that it is too long
        frames: list[Frame] = []
        for piece in filter(None, pieces):  # a delimiter too many does no harm: hosts send one to end what was cut off
            body = (cobs_decoded(piece) if len(piece) <= _LONGEST else None) or b""
            if len(body) < _AROUND or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
                self.dropped += 1
            else:
                frames.append(Frame(body[0], body[1], body[2:-4]))
        return frames


def cobs_encoded(data: bytes) -> bytes:
    """The bytes without zeros; no delimiter is added."""
    parts: list[bytes] = []
    pieces = data.split(b"\0")
    for piece in pieces:
        start, length = 0, len(piece)
        while length - start >= _LONGEST_BLOCK:
            parts += (b"\xff", piece[start : start + _LONGEST_BLOCK])
            start += _LONGEST_BLOCK
        parts += (bytes((length - start + 1,)), piece[start:])
    if pieces[-1] and len(pieces[-1]) % _LONGEST_BLOCK == 0:
        del parts[-2:]  # a full block at the very end needs no empty one after it
    return b"".join(parts)


def cobs_decoded(data: bytes) -> bytes | None:
    """What was encoded; None if these bytes are not COBS."""
    if not data or 0 in data:
        return None
    parts: list[bytes] = []
    start, length = 0, len(data)
    while start < length:
        code = data[start]
        end = start + code
        if end > length:
            return None
        parts.append(data[start + 1 : end])
        if code != _LONGEST_BLOCK + 1 and end < length:
            parts.append(b"\0")
        start = end
    return b"".join(parts)


class Reply(NamedTuple):
    boots: int  # how often the board has started
    flags: Flag
    content: bytes


def read_reply(payload: bytes) -> Reply:
    if len(payload) < 5:
        raise ValueError("the reply is shorter than its head")
    boots, flags = struct.unpack_from("<IB", payload)
    return Reply(boots, Flag(flags), payload[5:])


class Greeting(NamedTuple):
    version: int
    oscillator_hz: int  # 0 where the board does not know it
    board_id: str
    firmware: str


def read_greeting(content: bytes) -> Greeting:
    if len(content) < 6 or len(content) < 6 + content[5]:
        raise ValueError("the greeting is too short")
    version, oscillator_hz, length = struct.unpack_from("<BIB", content)
    texts = content[6 : 6 + length].decode(errors="replace"), content[6 + length :].decode(errors="replace")
    return Greeting(version, oscillator_hz, *texts)


def read_refusal(content: bytes) -> tuple[int, int]:
    """The code, and the index of what failed: a byte of WRITE, a target of SET."""
    if len(content) != 3:
        raise ValueError(f"found {len(content)} bytes, expected 3")
    return content[1], content[2]


def set_payload(targets: Iterable[tuple[int, int, int, int]]) -> bytes:
    """Of address, channel, ON and OFF: what the two registers hold, full-on and full-off bits included."""
    return b"".join(struct.pack("<BBHH", *target) for target in targets)


def guard_payload(after_ms: int, channels: Sequence[tuple[int, int, int]], waypoints: Sequence[Sequence[int]]) -> bytes:
    """Of address, channel and the greatest rate (sixteenths of a count per second) of all that the board drives after a
    silence; each waypoint has their counts (OFF minus ON), in this order.
    """
    packed = b"".join(struct.pack("<BBH", *channel) for channel in channels)
    counts = [count for waypoint in waypoints for count in waypoint]
    head, tail = struct.pack("<HB", after_ms, len(channels)), struct.pack(f"<B{len(counts)}H", len(waypoints), *counts)
    return head + packed + tail
