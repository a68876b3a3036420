"""Frames on a serial line: COBS [Cheshire1999], then a zero. Inside: type, sequence, payload, CRC-32, little endian."""

import zlib
from typing import NamedTuple

MAX_PAYLOAD = 240
"""Bytes."""
DELIMITER = b"\0"

_AROUND = 6  # type, sequence and CRC
_LONGEST = MAX_PAYLOAD + _AROUND + 1  # bodies are shorter than a COBS block, which adds one byte


class Frame(NamedTuple):
    """What goes over the line in one piece.

    Attributes:
        kind: the message's type (0 to 255).
        sequence: which request it is, or answers (0 to 255).
        payload: at most ``MAX_PAYLOAD`` bytes.
    """

    kind: int
    sequence: int
    payload: bytes = b""


def encoded(frame: Frame) -> bytes:
    """The frame as it goes over the line, its delimiter included.

    Raises:
        ValueError: the payload is too long.
    """
    if len(frame.payload) > MAX_PAYLOAD:
        raise ValueError(f"found a payload of {len(frame.payload)} bytes, expected at most {MAX_PAYLOAD}")
    body = bytes((frame.kind, frame.sequence)) + frame.payload
    return cobs_encoded(body + zlib.crc32(body).to_bytes(4, "little")) + DELIMITER


def decoded(piece: bytes) -> Frame | None:
    """The frame that stood before a delimiter; None if it did not arrive whole."""
    if len(piece) > _LONGEST:
        return None
    body = cobs_decoded(piece)
    if body is None or len(body) < _AROUND or zlib.crc32(body[:-4]) != int.from_bytes(body[-4:], "little"):
        return None
    return Frame(body[0], body[1], body[2:-4])


class FrameDecoder:
    """Cuts a stream of bytes into frames; what does not decode is counted and dropped.

    Attributes:
        dropped: how many pieces were.
    """

    def __init__(self) -> None:
        self.dropped = 0
        self._rest = b""

    def feed(self, data: bytes) -> list[Frame]:
        """The frames that these bytes complete."""
        pieces = (self._rest + data).split(DELIMITER)
        rest = pieces.pop()
        self._rest = rest[: _LONGEST + 1]  # one byte too many is enough to know that it is too long
        frames: list[Frame] = []
        for piece in pieces:
            if not piece:
                continue  # a delimiter too many does no harm: hosts send one to end what was cut off
            frame = decoded(piece)
            if frame is None:
                self.dropped += 1
            else:
                frames.append(frame)
        return frames

    def forget(self) -> None:
        self._rest = b""


_LONGEST_BLOCK = 254


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
