"""Consistent overhead byte stuffing: bytes without a zero, so that a zero can end a frame. [Cheshire1999]"""

from __future__ import annotations

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
