"""SQLite files of ``rosbag2``, row by row as they were written: a damaged file gives what comes before the damage."""

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing
from pathlib import Path
from urllib.parse import quote

from armcal.io.plain_files import input_file, refuse

from armcal_ros2.message import MAX_BYTES, RawMessage, Topic

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
