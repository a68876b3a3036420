"""Datasets: records as named columns, SI inside."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.errors import DataError, Location


@dataclass(frozen=True)
class SetAside:
    """A record that takes no part, and why."""

    row: int
    record_id: str
    reason: str


@dataclass(frozen=True)
class Dataset:
    """Records as columns."""

    ids: tuple[str, ...]  # one a record, as written in the source
    channels: Mapping[str, Array]  # SI values by name (``arm.q1``, ``tracker.x``, ``gravity_z``), each of length N
    extra: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # columns that nothing asked for, kept as text
    rows: tuple[int, ...] = ()  # where each record stood in its source (from 1; a CSV's line)
    source: str = ""  # a file name or what made the records
    sha256: str = ""  # of the source's bytes; empty if there were none
    set_aside: tuple[SetAside, ...] = ()  # records left out on reading
    warnings: tuple[str, ...] = ()  # what a user should know before trusting the data

    @classmethod
    def of_rows(cls, channels: Sequence[str], rows: Sequence[Sequence[float]], source: str) -> Self:
        """Records that were kept as rows of SI values; they are called by their number."""
        columns = np.array(rows, dtype=float).reshape(len(rows), len(channels)).T
        content = {name: np.ascontiguousarray(column) for name, column in zip(channels, columns, strict=True)}
        return cls(tuple(str(i) for i in range(1, len(rows) + 1)), content, source=source)

    def __len__(self) -> int:
        return len(self.ids)

    def row(self, index: int) -> int:
        """Where a record stood in its source, from 1."""
        return self.rows[index] if self.rows else index + 1

    def where(self, index: int | None = None, field: str | None = None) -> Location:
        """The place of the dataset, or of one of its records, perhaps of a column, for an error."""
        return Location(self.source or None, row=None if index is None else self.row(index), field=field)

    def column(self, channel: str) -> Array:
        """One channel; a DataError if the dataset has none."""
        if channel not in self.channels:
            raise DataError(
                f"{self.source or 'the dataset'} has no values for {channel}; it has {', '.join(self.channels)}."
            )
        return self.channels[channel]

    def stacked(self, channels: Sequence[str]) -> Array:
        """Several channels as rows of a (channels x N) matrix."""
        if not channels:
            return np.zeros((0, len(self)))
        return np.ascontiguousarray(np.vstack([self.column(name) for name in channels]))

    def has(self, channel: str) -> bool:
        """Whether a channel is there."""
        return channel in self.channels

    def subset(self, chosen: Indices | Sequence[int]) -> Self:
        """Some records, in the order of ``chosen``."""
        index = np.asarray(chosen, dtype=np.intp)
        return replace(
            self,
            ids=tuple(self.ids[i] for i in index),
            channels={name: values[index] for name, values in self.channels.items()},
            extra={name: tuple(values[i] for i in index) for name, values in self.extra.items()},
            rows=tuple(self.rows[i] for i in index) if self.rows else (),
        )

    def without(self, faulty: Mapping[int, str]) -> Self:
        """All records but some (index to reason), which are listed as set aside."""
        if not faulty:
            return self
        kept = self.subset([i for i in range(len(self)) if i not in faulty])
        listed = tuple(SetAside(self.row(i), self.ids[i], reason) for i, reason in sorted(faulty.items()))
        return replace(kept, set_aside=self.set_aside + listed)
