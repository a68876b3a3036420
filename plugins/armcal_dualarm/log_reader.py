"""Logs of several arms' motors: columns in a robot's own order, in motor radians. [Bergstrom2016]"""

import math
from collections.abc import Mapping
from typing import ClassVar, NoReturn

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath
from armcal.base.units import from_unit
from armcal.errors import DataError, Location
from armcal.measure.checks import check_dataset, layout_of
from armcal.measure.missing import with_absent
from armcal.measure.reader import ReadRequest
from armcal.measure.rests import Rest, rests

from armcal_dualarm.log_columns import LogColumns
from armcal_dualarm.log_table import LogTable, read_table

_FULL_TURN = 2 * math.pi


class TwoArmLogSettings(LogColumns):
    """Which file, and what its columns are: see ``LogColumns``."""

    path: InputPath


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
        s, path = self._settings, self._settings.path
        for name, arm in s.arms.items():
            if name not in request.arms:
                self._refuse(f"no arm is called {name!r}; the arms are {', '.join(request.arms)}.", "Correct the name.")
            if len(arm.columns) != (joints := len(request.arms[name].commanded)):
                text = f"found {len(arm.columns)} columns for the arm {name}, which has {joints} joints."
                self._refuse(text, f"Give arms: {{{name}: {{columns: [...]}}}} a column for each joint.")
        channels = [f"{name}.{joint}" for name in s.arms for joint in request.arms[name].commanded]
        numbers = [column for arm in s.arms.values() for column in arm.from_base]
        times = [] if s.time is None else [s.time]
        table = read_table(path, s.delimiter, [*numbers, *times], list(s.labels.values()))
        ratios = np.concatenate([arm.ratios for arm in s.arms.values()])
        joint_angles = table.numbers[: len(numbers)] / ratios[:, None]
        values = dict(zip(channels, joint_angles, strict=True))
        names = dict(zip(channels, table.names, strict=False))
        turning = {w.channel for w in request.channels if w.dimension == "angle" and not w.is_endless}
        for channel, row in values.items():
            over = np.flatnonzero((np.abs(row) > _FULL_TURN * (1 + 1e-9)) & np.isfinite(row))
            if channel in turning and over.size:  # wrong ratios, or other units
                first = int(over[0])
                text = f"{channel} would stand at {row[first]:.6g} rad there, more than one turn (2 pi rad)."
                hint = "Check order and gear_ratios, both from the base, and that the log is in radians."
                self._refuse(text, hint, table.lines[first], names[channel])
        if times:
            values["time"] = from_unit(table.numbers[len(numbers)], s.time_unit)
        dataset = with_absent(self._dataset(table, joint_angles, values), request.channels)
        return check_dataset(dataset, layout_of(request.channels, dataset, names, {}, by_line=True))

    def _dataset(self, table: LogTable, joints: Array, values: Mapping[str, Array]) -> Dataset:
        """All rows, or the means of the rests among them."""
        s = self._settings
        still = [Rest(i, i + 1) for i in range(len(table.lines))]
        warnings: tuple[str, ...] = ()
        if s.still is not None:
            still = rests(joints, table.texts, values.get("time"), s.still)
            if not still:
                text = f"found no moment at which no joint moves by more than {np.degrees(s.still.spread):.3g} deg."
                self._refuse(text, "Give a wider spread_deg or a shorter window under still.")
            used = sum(rest.stop - rest.start for rest in still)
            rows = f"{used} of {len(table.lines)} rows"
            warnings = (f"{s.path}: the log was reduced to {len(still)} still moments, the means of {rows}.",)
        starts = [rest.start for rest in still]
        channels = {
            name: np.array([row[rest.start : rest.stop].mean() for rest in still]) for name, row in values.items()
        }
        lines = tuple(table.lines[i] for i in starts)
        texts = {name: tuple(cells[i] for i in starts) for name, cells in zip(s.labels, table.texts, strict=True)}
        ids = tuple(map(str, lines))
        return Dataset(ids, channels, texts, lines, str(s.path), table.sha256, warnings=warnings)

    def _refuse(self, message: str, hint: str, line: int | None = None, column: str | None = None) -> NoReturn:
        raise DataError(message, where=Location(str(self._settings.path), line=line, field=column), hint=hint)
