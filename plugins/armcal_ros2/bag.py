"""A recording: a folder of files, or one file."""

import re
import sqlite3
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal
from urllib.parse import quote

import numpy as np
import yaml
from armcal.base.settings import Settings
from armcal.io.plain_files import input_bytes, input_file, refuse

from armcal_ros2.mcap import McapFile
from armcal_ros2.message import MAX_BYTES, RawMessage, Topic, decompressed, message_types

_MOST_DELAYS = 4096
_FAR_S, _FEW = 10.0, 10
"""A stamp that is so far from the others, by the time of receipt, is wrong; after so many at the begin, the others."""
_ZERO, _SAME, _FAR = "the stamp zero", "the stamp of the one before", "a stamp far from those of others"
_EARLIER = "a stamp before that of an earlier one"
_MOST: Mapping[str, float] = MappingProxyType({_ZERO: 0.5, _SAME: 0.5, _FAR: 0.5, _EARLIER: 0.01})
"""A larger part of the messages, and times are not to be trusted."""
Clock = Literal["header", "receive"]


class TopicSettings(Settings):
    """A topic, and what its times are: stamps of its headers, or when the recorder received its messages."""

    topic: str | None = None
    stamps: Clock = "header"


class Stamps:
    """Times of one topic's messages, in order; those that cannot be are counted.

    Attributes:
        count: of messages.
        latest: the last time (s since 1970), None before the first.
    """

    def __init__(self, topic: str, clock: Clock) -> None:
        self.topic, self.count = topic, 0
        self.latest: float | None = None
        self._clock = clock
        self._left = Counter[str]()
        self._usual: float | None = None
        self._delays = array("d")

    def time(self, stamp: int, received: int) -> float | None:
        """Seconds since 1970 (arguments in ns); None where it is missing, repeated or before an earlier one."""
        self.count += 1
        chosen = stamp if self._clock == "header" else received
        time, delay = chosen / 1e9, (received - chosen) / 1e9
        fault = ""
        if not chosen:
            fault = _ZERO
        elif time == self.latest:
            fault = _SAME
        elif self._usual is not None and abs(delay - self._usual) > _FAR_S:
            if self._left[_FAR] < _FEW or self.count > 2 * _FEW:
                fault = _FAR
            else:
                self.latest = None  # the first were wrong, and these are right
        if not fault and self.latest is not None and time < self.latest:
            fault = _EARLIER
        if fault:
            self._left[fault] += 1
            return None
        self.latest, self._usual = time, delay
        if len(self._delays) < _MOST_DELAYS:
            self._delays.append(delay)
        return time

    @property
    def delay(self) -> float:
        """The median time from measurement to receipt, by both clocks (s); NaN before the first message."""
        return float(np.median(self._delays)) if self._delays else float("nan")

    def check(self, place: str) -> list[str]:
        """What was left out, sentences; times that are useless altogether are refused.

        Raises:
            DataError: stamps are zero, constant or backwards in too many messages.
        """
        for cause, count in self._left.items():
            if count > max(_MOST[cause] * self.count, 1):
                text = f"{count} of {self.count} messages of {self.topic} have {cause}, expected times of measurement."
                hint = f"Set stamps: receive for {self.topic}, or give each program that publishes a topic of its own."
                refuse(place, text, hint)
        listed = ", ".join(f"{count} with {cause}" for cause, count in self._left.items())
        return [f"of {self.count} messages of {self.topic} some were left out: {listed}."] if listed else []


def nanoseconds(stamp: Any) -> int:
    """The time of a header (ns since 1970)."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


MAGIC = b"SQLite format 3\0"
_ROWS = "SELECT topic_id, timestamp, CASE WHEN topic_id IN ({0}) THEN data END FROM messages ORDER BY id"
_HINT = "Give a recording of ROS 2: a folder with metadata.yaml, or a file .mcap or .db3."


class SqliteFile:
    """One file.

    Attributes:
        path: of the file.
        faults: what of it could not be read, known once all messages were asked for.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.faults: list[str] = []

    def messages(self, is_read: Callable[[Topic], bool]) -> Iterator[RawMessage]:
        """All messages in the order of the file; those that are not chosen have no data.

        Raises:
            DataError: it is no SQLite file of rosbag2.
        """
        self.faults = []
        with input_file(self.path, MAX_BYTES, "a recording") as file:
            if file.read(len(MAGIC)) != MAGIC:
                refuse(self.path, "found other content than that of an SQLite file.", _HINT)
        try:
            connection, topics = self._opened()
        except sqlite3.Error as fault:
            refuse(self.path, f"found no topics of a recording in it ({fault}).", _HINT)
        with closing(connection):
            chosen = ", ".join(str(int(key)) for key, topic in topics.items() if is_read(topic))
            count = 0
            try:
                for key, received, data in connection.execute(_ROWS.format(chosen)):
                    count += 1
                    if key in topics and isinstance(received, int) and isinstance(data, bytes | None):
                        yield RawMessage(topics[key], received, data)
            except (sqlite3.Error, MemoryError) as fault:  # memory: a length that is damaged
                self.faults.append(f"it is cut off or damaged after {count} messages ({fault}); these were read")

    def _opened(self) -> tuple[sqlite3.Connection, dict[int, Topic]]:
        """The file and its topics; where its journal cannot be used it is left aside.

        Raises:
            sqlite3.Error: it has no topics.
        """
        for more in ("", "&immutable=1"):
            connection = sqlite3.connect(f"file:{quote(str(self.path.absolute()))}?mode=ro{more}", uri=True)
            try:
                connection.execute("PRAGMA writable_schema = ON")  # or a file that is cut off is not even opened
                rows = connection.execute("SELECT id, name, type, serialization_format FROM topics").fetchall()
                connection.execute("SELECT count(*) FROM sqlite_master").fetchone()
            except sqlite3.Error:
                connection.close()
                if more:
                    raise
                continue
            if more:
                self.faults.append("its journal could not be used: the last messages may be missing")
            return connection, {key: Topic(*map(str, rest)) for key, *rest in rows}
        raise AssertionError("both ways are tried")


_METADATA = "metadata.yaml"
_KINDS: Mapping[str, type[McapFile | SqliteFile]] = MappingProxyType({".mcap": McapFile, ".db3": SqliteFile})
_ZSTD = b"\x28\xb5\x2f\xfd"
_EXPECTED = "Give a recording of ROS 2: a folder with metadata.yaml, or a file .mcap or .db3."


class Bag:
    """A recording, whose messages are read from its files whenever they are asked for.

    Attributes:
        path: the folder or the file.
        remarks: what of it is missing or could not be read, sentences; complete once all messages were asked for.

    Raises:
        DataError: it is none.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.remarks: list[str] = []
        self._files = [_KINDS[file.suffix](file) for file in self._found()]

    def messages(self, is_read: Callable[[Topic], bool]) -> Iterator[RawMessage]:
        """All messages in the order of the files; those that are not chosen have no data.

        Raises:
            DataError: a file is no recording.
        """
        for file in self._files:
            for message in file.messages(is_read):
                data = message.data
                # a message of CDR begins with a zero; recorders may compress each message by itself
                if data is not None and bytes(data[:4]) == _ZSTD:
                    message = message._replace(data=decompressed(data, "zstd").getvalue())
                yield message
            for fault in file.faults:
                self._remark(f"{file.path.name}: {fault}.")

    def decoded(self, is_read: Callable[[Topic], bool]) -> Iterator[tuple[RawMessage, Any]]:
        """As ``messages``, with those that are chosen as objects of rosbags; None for the others.

        Raises:
            DataError: a file is no recording.
            PluginError: rosbags is not there.
        """
        types, unread = message_types(), Counter[Topic]()
        for message in self.messages(is_read):
            content = None
            if message.data is not None:
                try:
                    content = types.deserialize_cdr(message.data, message.topic.type)
                except Exception:  # damaged bytes or a type that is not standard: rosbags has no one error for it
                    unread[message.topic] += 1
                    continue
            yield message, content
        for topic, count in unread.items():
            self._remark(f"{count} messages of {topic.name} ({topic.type}) could not be decoded: left out.")

    def _remark(self, text: str) -> None:
        if text not in self.remarks:
            self.remarks.append(text)

    def _found(self) -> list[Path]:
        """The files in their order: that of metadata.yaml, else that of the numbers in their names."""
        if not self.path.is_dir():
            if not self.path.exists():
                refuse(self.path, "there is no such file or folder.", "Check the spelling and the directory.")
            if self.path.suffix not in _KINDS:
                hint = "Convert it with rosbags-convert." if self.path.suffix == ".bag" else _EXPECTED
                refuse(self.path, f"found the ending {self.path.suffix or 'none'}, expected .mcap or .db3.", hint)
            return [self.path]

        def natural(path: Path) -> list[tuple[int, str]]:
            parts = re.split(r"(\d+)", path.name)
            return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]

        there = sorted((file for file in self.path.iterdir() if file.suffix in _KINDS), key=natural)
        listed = self._listed()
        missing = [name for name in listed if not (self.path / name).exists()]
        if missing:
            self.remarks.append(f"{_METADATA} lists {missing[0]}, which is not there ({len(missing)} such files).")
        if not there:
            packed = any(file.suffix == ".zstd" for file in self.path.iterdir())
            hint = "Decompress its files: zstd -d --rm *.zstd" if packed else _EXPECTED
            refuse(self.path, "found no file .mcap or .db3 in it.", hint)
        order = {name: place for place, name in enumerate(listed)}
        return sorted(there, key=lambda file: order.get(file.name, len(order)))

    def _listed(self) -> list[str]:
        path = self.path / _METADATA
        if not path.exists():
            self.remarks.append(f"{_METADATA} is missing: the recorder was killed, or the file was not copied.")
            return []
        try:
            content = yaml.safe_load(input_bytes(path, 1 << 24, "what a recorder wrote"))
            names = content["rosbag2_bagfile_information"]["relative_file_paths"]
            return [Path(str(name)).name for name in names]
        except (yaml.YAMLError, KeyError, TypeError, ValueError):
            self.remarks.append(f"{_METADATA} is damaged: files are taken in the order of their names.")
            return []
