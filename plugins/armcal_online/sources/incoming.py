"""One record as it came from a source, before anything is made of it."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Place:
    """Where a record came from: when it arrived (unix seconds, our clock), the file in its source, the row in that."""

    arrived: float
    source_key: str = ""
    row: int = 0


@dataclass(frozen=True)
class Incoming:
    """One record as it came.

    Attributes:
        record_id: its id; the row where its source gives none.
        channels: SI numbers by channel (``arm.q1``, ``tracker.x``, ``gravity_z``, ``time``); NaN where a value is
            missing, infinite as given.
        labels: text columns that no channel claims (a socket's name).
        arrived: unix seconds, by our clock.
        source_key: the file within the source, or empty.
        source_row: the row in it, from 1 (the line in a text file).
        fault: why it could not be read, a sentence; there are no channels then.
    """

    record_id: str
    channels: Mapping[str, float]
    labels: Mapping[str, str]
    arrived: float
    source_key: str = ""
    source_row: int = 0
    fault: str = ""

    @property
    def place(self) -> Place:
        """Where it came from."""
        return Place(self.arrived, self.source_key, self.source_row)

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
