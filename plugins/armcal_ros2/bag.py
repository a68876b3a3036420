"""A recording: a folder of files, or one file."""

import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import yaml
from armcal.io.plain_files import input_bytes, refuse

from armcal_ros2.mcap import McapFile
from armcal_ros2.message import RawMessage, Topic, decompressed, message_types
from armcal_ros2.sqlite import SqliteFile

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
