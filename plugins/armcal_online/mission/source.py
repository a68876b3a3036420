"""A mission's records as a source that the power may be cut off from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from typing_extensions import override

from armcal_online.sources.source import Incoming, Source

SOURCE_KEY = "mission"


class PowerCutError(Exception):
    """The power is gone: nothing is finished, nothing more is written."""


def as_incoming(records: Dataset, times: Array, began: float) -> tuple[Incoming, ...]:
    """Records as they arrive, by the mission's clock (times in s since it began)."""
    names = list(records.channels)
    columns = [records.channels[name].tolist() for name in names]
    labels = list(records.extra)
    return tuple(
        Incoming(
            record_id=records.ids[i],
            channels={name: column[i] for name, column in zip(names, columns, strict=True)},
            labels={name: records.extra[name][i] for name in labels},
            arrived=began + float(times[i]),
            source_key=SOURCE_KEY,
            source_row=i + 1,
        )
        for i in range(len(records))
    )


class MissionSource(Source):
    """Records one after another; see ``Source``. After row ``cut`` the power goes."""

    keeps_records = True

    def __init__(self, records: Sequence[Incoming], cut: int | None = None) -> None:
        self._records = records
        self._cut = cut
        self._next = 0

    @property
    @override
    def ended(self) -> bool:
        return self._next >= len(self._records) and self._cut is None

    @override
    def resume(self, positions: Mapping[str, int]) -> None:
        self._next = positions.get(SOURCE_KEY, 0)

    @override
    def incoming(self, wait_s: float) -> Incoming | None:
        """Raises:
        PowerCutError: it is time.
        """
        if self._cut is not None and self._next >= self._cut:
            raise PowerCutError
        if self._next >= len(self._records):
            return None
        self._next += 1
        return self._records[self._next - 1]
