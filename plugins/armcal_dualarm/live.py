"""The joint stream ``two_arm_log``: motors' angles as they are logged, reading by reading or rest by rest."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from armcal.base.units import from_unit
from armcal.devices.clock import Clock
from armcal.devices.joint_stream import JointSample, JointStream
from armcal.devices.line_source import Begin, FileLines, LineSource, SourceName, open_lines
from armcal.devices.rest_stream import RestStream
from armcal.errors import ConfigError, DataError
from typing_extensions import override

from armcal_dualarm.live_still import LiveRests, Rows
from armcal_dualarm.live_table import LiveTable, Row
from armcal_dualarm.log_columns import LogColumns

_MOST_REASONS = 100


class TwoArmStreamSettings(LogColumns):
    """Where lines come from, and what their columns are: see ``LogColumns``.

    ``source`` is ``-`` (standard input), ``udp:PORT``, ``udp:HOST:PORT`` or a file that grows; ``begin`` says where a
    file is read from.
    """

    source: SourceName
    begin: Begin = "end"


class TwoArmLogStream(JointStream, RestStream):
    """Readings, or with ``still`` the means of rests. See ``armcal.devices.joint_stream.JointStream``."""

    Settings: ClassVar[type[TwoArmStreamSettings]] = TwoArmStreamSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "source": "udp:0",
        "arms": {"arm": {"columns": [1, 2], "order": [2, 1], "gear_ratios": [100, -100]}},
    }

    def __init__(self, settings: TwoArmStreamSettings) -> None:
        self._settings = settings
        self._source: LineSource | None = None
        self._table: LiveTable | None = None
        self._rests: LiveRests | None = None
        self._clock: Clock | None = None
        self._channels: tuple[str, ...] = ()
        self._ratios = np.ones(0)
        self._refused: Counter[str] = Counter()

    @property
    @override
    def gives_rests(self) -> bool:
        return self._settings.still is not None

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return dict(self._refused)

    @property
    @override
    def ended(self) -> bool:
        return self._source is None or self._source.ended

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        s = self._settings
        names = tuple(dict.fromkeys(channel.partition(".")[0] for channel in channels))
        _check(s, names, channels)
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

    @override
    def close(self) -> None:
        if self._source is not None:
            self._source.close()
        self._source = None

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

    def _refuse(self, reason: str) -> None:
        known = reason in self._refused or len(self._refused) < _MOST_REASONS
        self._refused[reason if known else "other reasons"] += 1


def _check(settings: TwoArmStreamSettings, names: Sequence[str], channels: Sequence[str]) -> None:
    """Refuse other arms, or other numbers of joints."""
    hint = "Give bench: {joints: {arms: {NAME: {columns: [...]}}}} a column for each joint of each arm."
    unknown = [name for name in settings.arms if name not in names]
    if unknown:
        raise ConfigError(
            f"bench.joints.arms: no arm is called {unknown[0]!r}; the arms are {', '.join(names)}.", hint=hint
        )
    for name in names:
        count = sum(channel.partition(".")[0] == name for channel in channels)
        columns = len(settings.arms[name].columns) if name in settings.arms else 0
        if columns != count:
            raise ConfigError(
                f"bench.joints.arms: found {columns} columns for the arm {name}, which has {count} joints.", hint=hint
            )
