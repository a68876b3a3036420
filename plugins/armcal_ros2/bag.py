"""A recording: a folder of files, or one file, as ``rosbags`` reads them."""

import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NamedTuple

import numpy as np
from armcal.base.settings import Settings
from armcal.io.plain_files import refuse
from armcal.plugins import library, said

JOINT_STATE = "sensor_msgs/msg/JointState"
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
_PURPOSE = "reading recordings of ROS 2"
_MOST_DELAYS = 4096
_ZERO, _SAME = "with the stamp zero", "with the stamp of the one before"
_EARLIER = "with a stamp before that of an earlier one"
# A larger part of the messages, and times are not to be trusted
_MOST: Mapping[str, float] = MappingProxyType({_ZERO: 0.5, _SAME: 0.5, _EARLIER: 0.01})
Clock = Literal["header", "receive"]


class Topic(NamedTuple):
    name: str
    type: str  # of its messages (``sensor_msgs/msg/JointState``)


class TopicSettings(Settings):
    """A topic, and what its times are: stamps of its headers, or when the recorder received its messages."""

    topic: str | None = None
    stamps: Clock = "header"


class Stamps:
    """Times of one topic's messages, in order; those that cannot be are counted."""

    def __init__(self, topic: str, clock: Clock) -> None:
        self.topic, self.count = topic, 0
        self._latest: float | None = None  # the last time (s since 1970)
        self._clock = clock
        self.faults = Counter[str]()  # why messages are left out
        self._delays = array("d")

    def time(self, stamp: int, received: int) -> float | None:
        """Seconds since 1970 (arguments in ns); None where it is missing, repeated or before an earlier one."""
        self.count += 1
        chosen = stamp if self._clock == "header" else received
        time, latest = chosen / 1e9, self._latest
        if not chosen or (latest is not None and time <= latest):
            self.faults[_ZERO if not chosen else _SAME if time == latest else _EARLIER] += 1
            return None
        self._latest = time
        if len(self._delays) < _MOST_DELAYS:
            self._delays.append((received - chosen) / 1e9)
        return time

    @property
    def delay(self) -> float:
        """The median time from measurement to receipt, by both clocks (s); NaN before the first message."""
        return float(np.median(self._delays)) if self._delays else float("nan")

    def check(self, place: str) -> list[str]:
        """What was left out, sentences; refused if stamps are zero, constant or backwards in too many messages."""
        for cause, most in _MOST.items():
            if (count := self.faults[cause]) > max(most * self.count, 1):
                what = cause.removeprefix("with ")
                text = f"{count} of {self.count} messages of {self.topic} have {what}, expected times of measurement."
                hint = f"Set stamps: receive for {self.topic}, or give each program that publishes a topic of its own."
                refuse(place, text, hint)
        listed = ", ".join(f"{count} {cause}" for cause, count in self.faults.most_common())
        return [f"of {self.count} messages of {self.topic} some were left out: {listed}."] if listed else []


def nanoseconds(stamp: Any) -> int:
    """The time of a header (ns since 1970)."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


_METADATA = "metadata.yaml"
_KINDS = (".mcap", ".db3")
_EXPECTED = "Give a recording of ROS 2: a folder with metadata.yaml, or a file .mcap or .db3."
_RECOVER = (
    "If its recorder was killed: mcap recover FILE.mcap -o NEW.mcap makes a whole file of what it wrote, ros2 bag "
    "reindex FOLDER the metadata.yaml."
)


class Bag:
    """A recording (folder or file); ``rosbags`` reads its messages from the files whenever they are asked for."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.topics = Counter[Topic]()  # how many messages each has; complete once messages were asked for
        self.remarks: list[str] = []  # what of it is missing or could not be read, sentences
        self._files = [path]
        if not path.exists():
            refuse(path, "there is no such file or folder.", "Check the spelling and the directory.")
        if not path.is_dir() and path.suffix not in _KINDS:
            hint = "Convert it with rosbags-convert." if path.suffix == ".bag" else _EXPECTED
            refuse(path, f"found the ending {path.suffix or 'none'}, expected .mcap or .db3.", hint)
        for journal in path.glob("*.db3-wal"):
            if journal.stat().st_size:
                self._remark(
                    f"{journal.name} holds messages that are not read: its recorder was killed. To have them, run "
                    f"sqlite3 {journal.name.removesuffix('-wal')} 'pragma wal_checkpoint(truncate)'."
                )
        if path.is_dir() and not (path / _METADATA).exists():  # which names its files
            files = [file for file in path.iterdir() if file.suffix in _KINDS]
            if not files:
                refuse(path, f"found no {_METADATA} and no file .mcap or .db3 in it.", _EXPECTED)
            self._files = sorted(files, key=lambda file: [int(n) for n in re.findall(r"\d+", file.name)])
            self._remark(f"{_METADATA} is missing: the recorder was killed, or the file was not copied.")

    def messages(self, is_read: Callable[[Topic], bool]) -> Iterator[tuple[Topic, int, bytes, Any]]:
        """The messages of chosen topics, of each file by their time: when they were received (ns since 1970), their
        bytes, and what rosbags made of them.
        """
        rosbag2, typesys = (library(f"rosbags.{name}", _PURPOSE) for name in ("rosbag2", "typesys"))
        types, unread = typesys.get_typestore(typesys.Stores.LATEST), Counter[Topic]()
        self.topics.clear()
        for file in self._files:
            count = 0
            try:
                with rosbag2.Reader(file) as reader:
                    topics = {one.id: Topic(one.topic, one.msgtype) for one in reader.connections}
                    self.topics.update({topics[one.id]: one.msgcount for one in reader.connections})
                    chosen = [one for one in reader.connections if is_read(topics[one.id])]
                    for connection, received, data in reader.messages(chosen) if chosen else ():
                        count += 1
                        try:
                            content = types.deserialize_cdr(data, connection.msgtype)
                        except Exception:  # damaged bytes or a type that is not standard
                            unread[topics[connection.id]] += 1
                            continue
                        yield topics[connection.id], received, bytes(data), content
            except Exception as fault:  # of damaged files rosbags has no one error
                text = f"it is cut off, damaged or no recording, after {count} messages ({said(fault)})."
                refuse(file, text, f"{_EXPECTED} {_RECOVER}")
        for topic, lost in unread.items():
            self._remark(f"{lost} messages of {topic.name} ({topic.type}) could not be decoded: left out.")

    def _remark(self, text: str) -> None:
        if text not in self.remarks:
            self.remarks.append(text)
