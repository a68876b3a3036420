"""Logs of several arms' motors: columns in a robot's own order, in motor radians. [Bergstrom2016]"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, NoReturn

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.settings import InputPath
from armcal.base.units import from_unit
from armcal.errors import DataError, Location
from armcal.measure.checks import check_dataset, layout_of
from armcal.measure.missing import with_absent
from armcal.measure.reader import ReadRequest

from armcal_dualarm.log_columns import LogColumns
from armcal_dualarm.log_table import LogTable, read_table
from armcal_dualarm.still import Rest, rests

_FULL_TURN = 2 * math.pi


class TwoArmLogSettings(LogColumns):
    """Which file, and what its columns are: see ``LogColumns``."""

    path: InputPath


@dataclass(frozen=True)
class _Log:
    """What was read: joints from the base, all arms one after the other (channels x N; rad)."""

    table: LogTable
    channels: tuple[str, ...]
    joints: Array
    time: Array | None


class TwoArmLogReader:
    """The reader ``two_arm_log``: channels such as ``left.q1``, from the base; ids are lines."""

    Settings: ClassVar[type[TwoArmLogSettings]] = TwoArmLogSettings
    EXAMPLE: ClassVar[Mapping[str, object]] = {
        "path": "/no/such/folder/two_arms.log",
        "arms": {"arm": {"columns": [1, 2], "order": [2, 1], "gear_ratios": [100, -100]}},
    }

    EXAMPLE_SOURCE: ClassVar[Mapping[str, object]] = {
        "files": {"motors.log": "-20,10\n-45,30\n60,-60\n"},
        "path": "motors.log",
        "channels": {"arm.q1": (0.1, 0.3, -0.6), "arm.q2": (0.2, 0.45, -0.6)},
    }

    def __init__(self, settings: TwoArmLogSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """The log in SI; ``rows`` are lines, those of a rest's first row.

        Raises:
            DataError: with file, line and column.
        """
        arms = {name: self._arm(request, name) for name in self._settings.arms}
        log = self._log(arms)
        self._refuse_turns(log, {w.channel for w in request.wanted if w.dimension == "angle" and not w.is_endless})
        dataset = with_absent(self._dataset(log), request.wanted)
        names = dict(zip(log.channels, log.table.names, strict=False))
        return check_dataset(dataset, layout_of(request.wanted, dataset, names, {}, by_line=True))

    def _arm(self, request: ReadRequest, name: str) -> Arm:
        if name not in request.arms:
            self._refuse(f"no arm is called {name!r}; the arms are {', '.join(request.arms)}.", "Correct the name.")
        arm, count = request.arms[name], len(self._settings.arms[name].columns)
        if count != len(arm.commanded):
            text = f"found {count} columns for the arm {name}, which has {len(arm.commanded)} joints."
            self._refuse(text, f"Give arms: {{{name}: {{columns: [...]}}}} a column for each joint.")
        return arm

    def _log(self, arms: Mapping[str, Arm]) -> _Log:
        s = self._settings
        numbers = [column for name in arms for column in s.arms[name].from_base]
        times = [] if s.time is None else [s.time]
        table = read_table(s.path, s.delimiter, [*numbers, *times], list(s.labels.values()))
        ratios = np.concatenate([s.arms[name].ratios for name in arms])
        channels = tuple(f"{name}.{joint}" for name, arm in arms.items() for joint in arm.commanded)
        time = from_unit(table.numbers[len(numbers)], s.time_unit) if times else None
        return _Log(table, channels, table.numbers[: len(numbers)] / ratios[:, None], time)

    def _refuse_turns(self, log: _Log, turning: set[str]) -> None:
        """Angles of joints beyond a turn: wrong ratios, or other units."""
        for channel, name, values in zip(log.channels, log.table.names, log.joints, strict=False):
            over = np.flatnonzero((np.abs(values) > _FULL_TURN * (1 + 1e-9)) & np.isfinite(values))
            if channel in turning and over.size:
                first = int(over[0])
                text = f"{channel} would stand at {values[first]:.6g} rad there, more than one turn (2 pi rad)."
                hint = "Check order and gear_ratios, both from the base, and that the log is in radians."
                self._refuse(text, hint, log.table.lines[first], name)

    def _dataset(self, log: _Log) -> Dataset:
        """All rows, or the rests among them."""
        s, table = self._settings, log.table
        still = [Rest(i, i + 1) for i in range(len(table.lines))]
        warnings: tuple[str, ...] = ()
        if s.still is not None:
            still = rests(log.joints, table.texts, log.time, s.still)
            if not still:
                text = f"found no moment at which no joint moves by more than {np.degrees(s.still.spread):.3g} deg."
                self._refuse(text, "Give a wider spread_deg or a shorter window under still.")
            used = sum(rest.stop - rest.start for rest in still)
            rows = f"{used} of {len(table.lines)} rows"
            warnings = (f"{s.path}: the log was reduced to {len(still)} still moments, the means of {rows}.",)
        starts = np.array([rest.start for rest in still])
        channels = {name: _means(values, still) for name, values in zip(log.channels, log.joints, strict=True)}
        if log.time is not None:
            channels["time"] = _means(log.time, still)
        lines = tuple(table.lines[i] for i in starts)
        texts = {name: tuple(cells[i] for i in starts) for name, cells in zip(s.labels, table.texts, strict=True)}
        ids = tuple(map(str, lines))
        return Dataset(ids, channels, texts, lines, str(s.path), table.sha256, warnings=warnings)

    def _refuse(self, message: str, hint: str, line: int | None = None, column: str | None = None) -> NoReturn:
        raise DataError(message, where=Location(str(self._settings.path), line=line, field=column), hint=hint)


def _means(values: Array, still: list[Rest]) -> Array:
    return np.array([values[rest.start : rest.stop].mean() for rest in still])
