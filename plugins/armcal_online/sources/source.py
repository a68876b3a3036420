"""What a source of records is, and one record as it came, before anything is made of it."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

AtEnd = Literal["stop", "wait"]  # what a file's end means: there is no more, or more may come
POLL_S = 0.05  # how often a file is looked at again


@dataclass(frozen=True)
class Place:
    """Where a record came from: the file in its source, the row in that, and when (unix seconds, our clock)."""

    source_key: str = ""
    row: int = 0
    arrived: float = field(default_factory=lambda: time.time())


@dataclass(frozen=True)
class Incoming:
    """One record as it came.

    Attributes:
        channels: SI numbers by channel (``arm.q1``, ``tracker.x``, ``gravity_z``, ``time``); NaN where a value is
            missing, infinite as given.
    """

    record_id: str  # its id; the row where its source gives none
    channels: Mapping[str, float]
    labels: Mapping[str, str]  # text columns that no channel claims (a socket's name)
    arrived: float  # unix seconds, by our clock
    source_key: str = ""  # the file within the source, or empty
    source_row: int = 0  # the row in it, from 1 (the line in a text file)
    fault: str = ""  # why it could not be read, a sentence; there are no channels then

    def as_dict(self) -> dict[str, Any]:
        """As JSON: floats exactly, those that are not finite as ``nan``, ``inf`` and ``-inf``."""
        return {
            "id": self.record_id,
            "channels": {name: value if math.isfinite(value) else str(value) for name, value in self.channels.items()},
            "labels": dict(self.labels),
            "arrived": self.arrived,
            "key": self.source_key,
            "row": self.source_row,
            "fault": self.fault,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Incoming:
        """The record that ``as_dict`` wrote.

        Raises:
            KeyError, TypeError, ValueError: it is no such record.
        """
        return cls(
            record_id=str(content["id"]),
            channels={name: float(value) for name, value in content["channels"].items()},
            labels={name: str(text) for name, text in content["labels"].items()},
            arrived=float(content["arrived"]),
            source_key=str(content["key"]),
            source_row=int(content["row"]),
            fault=str(content["fault"]),
        )


class Source(Protocol):
    """Records, one at a time.

    Attributes:
        keeps_records: whether what is not taken stays in it (a file), or is lost (a stream).
    """

    @property
    def keeps_records(self) -> bool:
        """See above."""

    @property
    def ended(self) -> bool:
        """Whether there will never be another record."""

    def incoming(self, wait_s: float) -> Incoming | None:
        """The next record; None if there is none within the wait. Whatever it reads, it never raises."""

    def resume(self, positions: Mapping[str, int]) -> None:
        """Pass over what was taken before: the last row taken, by file. Nothing for a stream, which begins anew."""
        return

    def close(self) -> None:
        """Let go of files and sockets, if there are any."""
        return


def key_of(name: str) -> str:
    """A file's name as a key that can be written: names need not be UTF-8."""
    return name.encode("utf-8", "backslashreplace").decode("utf-8")


def wait_until(deadline: float) -> bool:
    """Sleep for a moment; whether the deadline (monotonic seconds) is still to come."""
    left = deadline - time.monotonic()
    if left <= 0:
        return False
    time.sleep(min(POLL_S, left))
    return True
