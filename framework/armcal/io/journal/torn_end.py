"""The end of a file that was being appended to when the power failed, told from damage."""

from __future__ import annotations

import re
from contextlib import suppress

from armcal.io.journal.frames import FrameError, decode_frame, promised_end, was_acknowledged

SECTOR = 512
_NULS = re.compile(rb"\x00+")


def is_torn(data: bytes, offset: int, follows: int) -> bool:
    """Whether bytes that are no frame are what a power loss leaves of entries that were not yet durable.

    Appending leaves a line without its end, or a hole: what was never written of a sector reads as zeros, and text has
    none. An entry that is acknowledged is durable, and all before it: where one stands behind a hole, it is damage.

    Args:
        data: the bytes of the newest segment.
        offset: where they cease to check.
        follows: the CRC that the frame there starts from.
    """
    end = data.find(b"\n", offset)
    hole = _hole(data, offset, len(data) if end < 0 else end)
    if hole is not None:
        later = data[offset:].removesuffix(b"\n").split(b"\n")[1:-1]
        return not any(map(was_acknowledged, later)) and not _is_flipped(data, offset, hole, follows)
    promised = promised_end(data, offset)
    return end < 0 and (promised is None or promised >= len(data))


def _hole(data: bytes, offset: int, line_end: int) -> range | None:
    """Zeros up to a border of a sector or the end of the file."""
    runs = (range(*run.span()) for run in _NULS.finditer(data, offset, line_end))
    return next((run for run in runs if run.stop % SECTOR == 0 or run.stop == len(data)), None)


def _is_flipped(data: bytes, offset: int, hole: range, follows: int) -> bool:
    """Whether a single zero is a character that lost its only bit: then the entry was whole once."""
    if len(hole) > 1:
        return False
    for bit in range(8):
        mended = data[: hole.start] + bytes([1 << bit]) + data[hole.stop :]
        with suppress(FrameError):
            decode_frame(mended, offset, None, follows)
            return True
    return False
