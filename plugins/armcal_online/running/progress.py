"""How far a source has been taken: what a restart needs besides the estimate, and no rollback changes."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any
from zlib import crc32

from armcal_online.sources.source import THROUGH, Incoming

MAX_FILES = 2000
"""So many files are remembered one by one; of the others, that all up to a name were taken."""
RECENT = 256
"""So many records are remembered, so that one that is sent again counts once."""


class Progress:
    """Rows taken by file, the records taken last, and whether records are passed over.

    Attributes:
        records: how many records were journalled, from the beginning.
        paused: whether records are passed over.
    """

    def __init__(self) -> None:
        self.records = 0
        self.paused = False
        self._positions: dict[str, int] = {}
        self._through = ""
        self._recent: dict[str, int] = {}

    @property
    def positions(self) -> dict[str, int]:
        """The last row taken, by file; a key that begins with a slash says that all files up to a name were."""
        return {**self._positions, **({THROUGH + self._through: 0} if self._through else {})}

    def take(self, incoming: Incoming, sequence: int) -> None:
        """A record was journalled."""
        self.records += 1
        if incoming.source_key:
            key = incoming.source_key
            self._positions[key] = max(self._positions.get(key, 0), incoming.source_row)
            if len(self._positions) > MAX_FILES:
                first = min(self._positions)
                del self._positions[first]
                self._through = max(self._through, first)
        elif not incoming.fault:
            self._recent[_mark(incoming)] = sequence
            if len(self._recent) > RECENT:
                del self._recent[next(iter(self._recent))]

    def repeated(self, incoming: Incoming) -> int | None:
        """Under which sequence number the same record of a stream was taken not long ago."""
        return None if incoming.source_key or incoming.fault else self._recent.get(_mark(incoming))

    def as_dict(self) -> dict[str, Any]:
        """As JSON."""
        return {
            "records": self.records,
            "paused": self.paused,
            "positions": dict(self._positions),
            "through": self._through,
            "recent": dict(self._recent),
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Progress:
        """What ``as_dict`` wrote."""
        progress = cls()
        progress.records = int(content["records"])
        progress.paused = bool(content["paused"])
        progress._positions = dict(content["positions"])
        progress._through = str(content["through"])
        progress._recent = dict(content["recent"])
        return progress


def _mark(incoming: Incoming) -> str:
    """The same for two copies of a record, and different for any others."""
    content = incoming.as_dict()
    numbers = json.dumps([content["channels"], content["labels"]], sort_keys=True)
    return f"{crc32(numbers.encode()):08x} {incoming.record_id}"
