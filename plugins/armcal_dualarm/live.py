"""The joint stream ``two_arm_log``: motors' angles as they are logged, reading by reading or rest by rest."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.base.units import from_unit
from armcal.devices.clock import Clock
from armcal.devices.line_source import Begin, FileLines, LineJointStream, SourceName, open_lines
from armcal.devices.live import JointSample, RestStream
from armcal.errors import ConfigError, DataError
from armcal.measure.rests import LiveRests, Rows
from armcal.measure.tables import delimiter_of, line_text, number_of
from typing_extensions import override

from armcal_dualarm.log_reader import Column, LogColumns, cells_of, is_header, place_of


class TwoArmStreamSettings(LogColumns):
    """Where lines come from, and what their columns are: see ``LogColumns``.

    ``source`` is ``-`` (standard input), ``udp:PORT``, ``udp:HOST:PORT`` or a file that grows; ``begin`` says where a
    file is read from.
    """

    source: SourceName
    begin: Begin = "end"


@dataclass(frozen=True)
class Row:
    """Chosen cells of a row: numbers (NaN where empty) and texts."""

    numbers: Array
    texts: tuple[str, ...]


@dataclass(frozen=True)
class _Form:
    """What the first row has shown; ``header`` is empty if it held numbers."""

    delimiter: str
    header: tuple[str, ...]
    count: int
    places: tuple[int, ...]


class LiveTable:
    """Reads rows as ``log_reader.read_columns`` does.

    Args:
        source: what the log is called in messages.
        delimiter: or ``auto``.
        numbers, texts: the columns to read.
    """

    def __init__(self, source: Path, delimiter: str, numbers: Sequence[Column], texts: Sequence[Column]) -> None:
        self._source, self._delimiter = source, delimiter
        self._numbers, self._texts = list(numbers), list(texts)
        self._form: _Form | None = None

    def row(self, line: bytes) -> Row | None:
        """The row in a line; None for a blank one, or the header.

        Raises:
            DataError: it cannot be read.
        """
        text = line_text(line, self._source).removeprefix("\ufeff")
        if not text.strip():
            return None
        if self._form is None:
            delimiter = delimiter_of(text) if self._delimiter == "auto" else self._delimiter
            cells = cells_of(text, delimiter)
            header = tuple(cells) if is_header(cells, self._numbers, self._texts) else ()
            places = [place_of(self._source, None, header, len(cells), c) for c in (*self._numbers, *self._texts)]
            self._form = _Form(delimiter, header, len(cells), tuple(places))
        form = self._form
        cells = cells_of(text, form.delimiter)
        if form.header and tuple(cells) == form.header:
            return None
        if len(cells) != form.count:
            raise DataError(f"found {len(cells)} cells, expected {form.count} as in the first row.")
        chosen = [cells[place] for place in form.places]
        count = len(self._numbers)
        named = zip(chosen[:count], self._numbers, strict=True)
        numbers = [number_of(self._source, None, cell, f"column {name}") for cell, name in named]
        return Row(np.array(numbers), tuple(chosen[count:]))


class TwoArmLogStream(LineJointStream, RestStream):
    """Readings, or with ``still`` the means of rests. See ``armcal.devices.live.JointStream``."""

    Settings: ClassVar[type[TwoArmStreamSettings]] = TwoArmStreamSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "source": "udp:0",
        "arms": {"arm": {"columns": [1, 2], "order": [2, 1], "gear_ratios": [100, -100]}},
    }

    def __init__(self, settings: TwoArmStreamSettings) -> None:
        super().__init__()
        self._settings = settings
        self._table: LiveTable | None = None
        self._rests: LiveRests | None = None
        self._clock: Clock | None = None
        self._channels: tuple[str, ...] = ()
        self._ratios = np.ones(0)

    @property
    @override
    def gives_rests(self) -> bool:
        return self._settings.still is not None

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        s = self._settings
        names = tuple(dict.fromkeys(channel.partition(".")[0] for channel in channels))
        hint = "Give bench: {joints: {arms: {NAME: {columns: [...]}}}} a column for each joint of each arm."
        if unknown := [name for name in s.arms if name not in names]:
            raise ConfigError(
                f"bench.joints.arms: no arm is called {unknown[0]!r}; the arms are {', '.join(names)}.", hint=hint
            )
        for name in names:
            count = sum(channel.partition(".")[0] == name for channel in channels)
            columns = len(s.arms[name].columns) if name in s.arms else 0
            if columns != count:
                raise ConfigError(
                    f"bench.joints.arms: found {columns} columns for the arm {name}, which has {count} joints.",
                    hint=hint,
                )
        self._channels = channels
        self._ratios = np.concatenate([s.arms[name].ratios for name in names])
        columns = [column for name in names for column in s.arms[name].from_base]
        columns += [] if s.time is None else [s.time]
        self._table = LiveTable(Path(s.source), s.delimiter, columns, list(s.labels.values()))
        self._rests = None if s.still is None else LiveRests(s.still)
        self._source, self._clock = open_lines(s.source, s.begin), clock
        if s.begin == "end" and isinstance(self._source, FileLines) and self._source.header is not None:
            self._row(self._source.header)
            self._refused.clear()

    @override
    def samples(self) -> list[JointSample]:
        if self._source is None:
            return []
        rows = [row for line in self._source.lines() if (row := self._row(line)) is not None]
        if not rows:
            return []
        table, count, s = np.array([row.numbers for row in rows]).T, len(self._channels), self._settings
        time = None if s.time is None else from_unit(table[count], s.time_unit)
        texts = tuple(tuple(row.texts[i] for row in rows) for i in range(len(s.labels)))
        whole = Rows(table[:count] / self._ratios[:, None], time, texts)
        if self._rests is None:
            return self._samples([whole.part(i, i + 1) for i in range(len(whole))])
        return self._samples(self._rests.add(whole))

    @override
    def lasting(self) -> list[JointSample]:
        return [] if self._rests is None else self._samples(self._rests.lasting())

    def _row(self, line: bytes | None) -> Row | None:
        assert self._table is not None
        try:
            if line is None:
                raise DataError("it is too long.")
            return self._table.row(line)
        except DataError as fault:
            self._refuse(fault.message.rstrip("."))
            return None

    def _samples(self, parts: Sequence[Rows]) -> list[JointSample]:
        """The mean of each part."""
        now = self._clock.now() if self._clock else 0.0
        samples = []
        for rows in parts:
            angles = dict(zip(self._channels, rows.joints.mean(axis=1).tolist(), strict=True))
            lacking = next((channel for channel, angle in angles.items() if not np.isfinite(angle)), None)
            if lacking is not None:
                self._refuse(f"it has no reading of {lacking}")
                continue
            stamp = None if rows.time is None else float(rows.time.mean())
            labels = {name: cells[0] for name, cells in zip(self._settings.labels, rows.texts, strict=True)}
            samples.append(JointSample(now, stamp, angles, labels))
        return samples
