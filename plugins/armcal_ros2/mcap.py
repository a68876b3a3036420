"""MCAP files, record by record as they were written: no index is needed, so a file that was cut off gives what it has.

Every record states its length, and messages that nobody asked for are passed over without being read. [MCAP]
"""

import os
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO

from armcal.io.plain_files import input_file, refuse

from armcal_ros2.message import MAX_BYTES, RawMessage, Topic, decompressed

MAGIC = b"\x89MCAP0\r\n"
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK, _DATA_END = 0x03, 0x04, 0x05, 0x06, 0x0F
_MAX_CHUNK_BYTES = 64 * 1024**2  # Larger compressed chunks would take too much memory; recorders write 1 to 4 MiB
_LONGEST_TEXT_BYTES = 1 << 20
_HEAD = struct.Struct("<BQ")
_CHUNK_HEAD = struct.Struct("<QQQI")
_MESSAGE_HEAD = struct.Struct("<HIQQ")


class _CutOffError(Exception):
    """A record is not whole."""


class McapFile:
    """One file.

    Attributes:
        path: of the file.
        faults: what of it could not be read, known once all messages were asked for.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._schemas: dict[int, str] = {}
        self._topics: dict[int, Topic] = {}
        self.faults: list[str] = []

    def messages(self, is_read: Callable[[Topic], bool]) -> Iterator[RawMessage]:
        """All messages in the order of the file; those that are not chosen have no data.

        Raises:
            DataError: it is no MCAP file.
        """
        self.faults = []
        with input_file(self.path, MAX_BYTES, "a recording") as file:
            if file.read(len(MAGIC)) != MAGIC:
                refuse(self.path, "found other content than that of an MCAP file.", "Give a recording of ROS 2.")
            size = os.fstat(file.fileno()).st_size
            at = file.tell()
            try:
                for code, at, stop in _records(file, size):
                    if code == _DATA_END:
                        return
                    if code == _CHUNK:
                        yield from self._chunk(file, at, stop, size, is_read)
                    else:
                        yield from self._record(file, code, stop, is_read)
            except (_CutOffError, struct.error, UnicodeDecodeError, OSError):
                self.faults.append(f"it is cut off or damaged at byte {at} of {size}; what comes before was read")
            else:
                self.faults.append("it has no end: its recorder was killed; what it wrote was read")

    def _chunk(
        self, file: BinaryIO, at: int, stop: int, size: int, is_read: Callable[[Topic], bool]
    ) -> Iterator[RawMessage]:
        """What a chunk holds, as far as it is there; compressed ones are taken into memory."""
        _, _, unpacked_bytes, _ = _CHUNK_HEAD.unpack(file.read(_CHUNK_HEAD.size))
        compression = _text(file)
        (packed_bytes,) = struct.unpack("<Q", file.read(8))
        inside: BinaryIO = file
        end = min(file.tell() + packed_bytes, size)
        is_whole = True
        if compression:
            if max(unpacked_bytes, packed_bytes) > _MAX_CHUNK_BYTES or compression not in ("lz4", "zstd"):
                self.faults.append(f"a chunk of {unpacked_bytes} bytes ({compression}) at byte {at} was left out")
                return
            inside = unpacked = decompressed(file.read(end - file.tell()), compression)
            end = len(unpacked.getbuffer())
            is_whole = end == unpacked_bytes
        try:
            for code, _, until in _records(inside, end):
                yield from self._record(inside, code, until, is_read)
        except (_CutOffError, struct.error, UnicodeDecodeError):
            is_whole = False
        if not is_whole and stop <= size:
            self.faults.append(f"the chunk at byte {at} is damaged; what comes before in it was read")

    def _record(self, file: BinaryIO, code: int, stop: int, is_read: Callable[[Topic], bool]) -> Iterator[RawMessage]:
        """A schema or a channel is kept, a message handed out."""
        if code == _MESSAGE:
            channel, _, received, _ = _MESSAGE_HEAD.unpack(file.read(_MESSAGE_HEAD.size))
            topic, length = self._topics.get(channel), stop - file.tell()
            if length < 0:
                raise _CutOffError
            if topic is not None:
                yield RawMessage(topic, received, file.read(length) if is_read(topic) else None)
        elif code == _SCHEMA:
            (schema,) = struct.unpack("<H", file.read(2))
            self._schemas[schema] = _text(file)
        elif code == _CHANNEL:
            channel, schema = struct.unpack("<HH", file.read(4))
            self._topics[channel] = Topic(_text(file), self._schemas.get(schema, ""), _text(file))


def _records(file: BinaryIO, end: int) -> Iterator[tuple[int, int, int]]:
    """The code of each record, where it begins and where it stops; chunks may go on beyond the end.

    Raises:
        _CutOffError: the last record is not whole, or none.
    """
    at = file.tell()
    while at < end:
        head = file.read(_HEAD.size)
        if len(head) < _HEAD.size:
            raise _CutOffError
        code, length = _HEAD.unpack(head)
        stop = at + _HEAD.size + length
        if not code or (stop > end and code != _CHUNK):
            raise _CutOffError
        yield code, at, stop
        if stop > end:
            raise _CutOffError
        file.seek(stop)
        at = stop


def _text(file: BinaryIO) -> str:
    (length,) = struct.unpack("<I", file.read(4))
    content = file.read(min(length, _LONGEST_TEXT_BYTES))
    if len(content) != length:
        raise _CutOffError
    return content.decode()
