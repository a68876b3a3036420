"""Two arms: clamped together at their tools, a closed chain; and logs of the motors of several arms. [Bergstrom2016]

A clamp is found along with the arms. The pose of the right tool in the left one is the clamp's, whatever the joints do.
What the joints give instead is the closing error, and it belongs to both arms at once: it is not split between them.
A log has its columns in a robot's own order, in motor radians.
"""

import difflib
import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmState
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock
from armcal.base.poses import PoseSettings, pose_blocks, pose_transform, quaternion_expression
from armcal.base.settings import Angle, InputPath, Length, Settings
from armcal.base.units import from_unit
from armcal.io.plain_files import refuse
from armcal.measure.checks import read_as
from armcal.measure.measurement import Contact
from armcal.measure.reader import ReadRequest
from armcal.measure.rests import StillSettings, rests
from armcal.measure.tables import Columns, is_missing, is_number, open_table
from pydantic import Field, model_validator


class ClosedChainSettings(Settings):
    """Which two arms hold each other, how well the clamp holds (standard deviations), and what is known of it.

    ``clamps`` are the poses of the right tool in the left one that are known, by the clamp's name: a record's text
    columns ``group_labels`` joined by a slash, or ``one`` if there are none. A clamp that is not named here is found;
    one that is named is held, unless ``parameters.free`` frees it, best under a prior.
    """

    left: str = "left"
    right: str = "right"
    noise: Annotated[Length, Field(gt=0)]
    orientation_noise: Annotated[Angle, Field(gt=0)]
    group_labels: tuple[str, ...] = ()
    clamps: dict[str, PoseSettings] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _sane(self) -> Self:
        if self.left == self.right:
            raise ValueError(f"found {self.left} on both sides, expected two arms")
        return self


class ClosedChain(Contact):
    """The measurement ``closed_chain``: of each clamp the blocks clamp_x, clamp_y, clamp_z and clamp_rotation."""

    Settings: ClassVar[type[ClosedChainSettings]] = ClosedChainSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "noise_mm": 0.1,
        "orientation_noise_mrad": 0.5,
        "clamps": {"one": {"position_mm": [0, 0, 40], "rpy_deg": [180, 0, 90]}},
    }

    def __init__(self, settings: ClosedChainSettings, arm_names: Sequence[str]) -> None:
        self._settings = settings
        for name in (settings.left, settings.right):
            if name not in arm_names:
                raise ValueError(f"no arm is called {name!r}; the arms are {', '.join(arm_names)}")

    @property
    def arms(self) -> tuple[str, ...]:
        return (self._settings.left, self._settings.right)

    @property
    def group_labels(self) -> tuple[str, ...]:
        return self._settings.group_labels

    def group_parameters(self, group: str) -> tuple[ParameterBlock, ...]:
        known = self._settings.clamps.get(group)
        blocks = pose_blocks("clamp") if known is None else known.blocks("clamp")
        return tuple(replace(block, free=known is None) for block in blocks)

    def named_groups(self) -> tuple[str, ...]:
        return tuple(self._settings.clamps)

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        between = self._between(arms)
        place = {f"clamp_{axis}": between.translation[i] for i, axis in enumerate("xyz")}
        return {**place, "clamp_rotation": quaternion_expression(between.rotation)}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """The closing error in the clamp's right frame: position (3, m) and rotation vector (3, rad)."""
        error = pose_transform("clamp", values).inverse() @ self._between(arms)
        return ca.vertcat(error.translation, se3.rotation_vector(error.rotation))

    def noise(self) -> tuple[float, ...]:
        return (self._settings.noise,) * 3 + (self._settings.orientation_noise,) * 3

    def dimensions(self) -> tuple[str, ...]:
        return ("length",) * 3 + ("angle",) * 3

    def _between(self, arms: Mapping[str, ArmState]) -> se3.Transform:
        left, right = (arms[name].base_T_tool for name in self.arms)
        return left.inverse() @ right


Column = str | int  # A column's name in the header, or its number from 1


def _read_columns(
    path: Path, delimiter: str, numbers: Sequence[Column], texts: Sequence[Column]
) -> tuple[Columns, list[str], str]:
    """Columns of a log, what those of numbers are called in it, and the file's sha256."""
    with open_table(path, "a log", delimiter, empty="Give a row a moment.") as table:
        line, cells = table.first[0], [cell.strip() for cell in table.first[1]]
        header = cells if _is_header(cells, numbers, texts) else []
        places = [_place_of(path, line, header, len(cells), column) for column in (*numbers, *texts)]
        names = [header[place] if header else f"column {place + 1}" for place in places[: len(numbers)]]
        named = list(zip(places, names, strict=False))
        read = table.columns(named, places[len(numbers) :], has_header=bool(header))
    if not read.lines:
        refuse(path, "found a header and no rows.", "Give a row a moment.", line)
    words = tuple(tuple(cell.strip() for cell in column) for column in read.texts)
    return replace(read, texts=words), names, table.sha256


def _is_header(cells: Sequence[str], numbers: Sequence[Column], texts: Sequence[Column]) -> bool:
    """Whether the first row holds names: for columns by name, no number at all; by place, none where one is due."""
    if any(isinstance(column, str) for column in (*numbers, *texts)):
        return not any(is_number(cell) for cell in cells)
    due = [cells[column - 1] for column in numbers if isinstance(column, int) and 1 <= column <= len(cells)]
    return not any(is_number(cell) for cell in due) and any(not is_missing(cell) for cell in due)


def _place_of(path: Path, line: int | None, header: Sequence[str], count: int, column: Column) -> int:
    """Where a column stands, from 0."""
    if isinstance(column, int):
        if not 1 <= column <= count:
            refuse(path, f"found {count} columns, expected a column {column}.", "Columns count from 1.", line)
        return column - 1
    if not header:
        text = f"found no header, expected one with the column {column}."
        refuse(path, text, "Add it, or give the columns' numbers, from 1.", line)
    if header.count(column) != 1:
        near = difflib.get_close_matches(column, header, n=2)
        text = f"found the column {column} {header.count(column)} times" if column in header else f"no column {column}"
        hint = f"The nearest is {' or '.join(near)}." if near else f"The columns are {', '.join(header[:20])[:200]}."
        refuse(path, f"{text}, expected it once.", hint, line, column)
    return header.index(column)


class ArmColumns(Settings):
    """The columns of one arm's motors, by name or number (from 1), in the robot's own order.

    ``order`` gives for each joint from the base its number in the robot's own order; ``gear_ratios`` how far the motor
    of each joint from the base turns while the joint turns once, with its sign.
    """

    columns: tuple[Column, ...]
    order: tuple[int, ...] | None = None
    gear_ratios: tuple[float, ...] | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        count = len(self.columns)
        if self.order is not None and sorted(self.order) != list(range(1, count + 1)):
            raise ValueError(f"order: found {list(self.order)}, expected each of 1 to {count} once")
        if self.gear_ratios is not None and len(self.gear_ratios) != count:
            raise ValueError(f"gear_ratios: found {len(self.gear_ratios)}, expected one for each of {count} columns")
        if self.gear_ratios is not None and 0 in self.gear_ratios:
            raise ValueError("gear_ratios: found 0, expected how often the motor turns for a turn of the joint")
        return self

    @property
    def from_base(self) -> tuple[Column, ...]:
        return tuple(self.columns[number - 1] for number in self.order or range(1, len(self.columns) + 1))


class TwoArmLogSettings(Settings):
    """Which file, which columns are whose, and whether a continuous log is reduced to its still moments.

    ``time`` is the column of the time, ``labels`` maps names to text columns (``clamp: 16``).
    """

    path: InputPath
    arms: Annotated[dict[str, ArmColumns], Field(min_length=1)]
    delimiter: Literal["auto", ",", ";", "\t", "|", " "] = "auto"
    time: Column | None = None
    time_unit: Literal["s", "ms", "us"] = "s"
    labels: dict[str, Column] = Field(default_factory=dict)
    still: StillSettings | None = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        times = [] if self.time is None else [self.time]
        taken = Counter([*(column for arm in self.arms.values() for column in arm.columns), *times])
        twice = [str(column) for column, count in taken.items() if count > 1]
        if twice:
            raise ValueError(f"the column {twice[0]} is given twice; give each its own")
        if self.still is not None and self.still.window is not None and self.time is None:
            raise ValueError("still: window_s needs the column of the time; give time: COLUMN, or samples")
        return self


_FULL_TURN = 2 * math.pi


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
        """The log in SI; ``rows`` are lines, those of a rest's first row."""
        s, path = self._settings, self._settings.path
        for name, arm in s.arms.items():
            if name not in request.arms:
                refuse(path, f"no arm is called {name!r}; the arms are {', '.join(request.arms)}.", "Correct the name.")
            if len(arm.columns) != (joints := len(request.arms[name].commanded)):
                text = f"found {len(arm.columns)} columns for the arm {name}, which has {joints} joints."
                refuse(path, text, f"Give arms: {{{name}: {{columns: [...]}}}} a column for each joint.")
        channels = [f"{name}.{joint}" for name in s.arms for joint in request.arms[name].commanded]
        times = [] if s.time is None else [s.time]
        numbers = [*(column for arm in s.arms.values() for column in arm.from_base), *times]
        read, column_names, digest = _read_columns(path, s.delimiter, numbers, list(s.labels.values()))
        ratios = [ratio for arm in s.arms.values() for ratio in arm.gear_ratios or (1.0,) * len(arm.columns)]
        joint_angles = np.array(read.numbers[: len(channels)]) / np.array(ratios)[:, None]
        values = dict(zip(channels, joint_angles, strict=True))
        names = dict(zip(channels, column_names, strict=False))
        turning = {w.channel for w in request.channels if w.dimension == "angle" and not w.is_endless}
        for channel, row in values.items():
            over = np.flatnonzero((np.abs(row) > _FULL_TURN * (1 + 1e-9)) & np.isfinite(row))
            if channel in turning and over.size:  # wrong ratios, or other units
                first = int(over[0])
                text = f"{channel} would stand at {row[first]:.6g} rad there, more than one turn (2 pi rad)."
                hint = "Check order and gear_ratios, both from the base, and that the log is in radians."
                refuse(path, text, hint, read.lines[first], names[channel])
        if times:
            values["time"] = from_unit(read.numbers[-1], s.time_unit)
        return read_as(self._dataset(read, digest, joint_angles, values), request, names)

    def _dataset(self, read: Columns, digest: str, joints: Array, values: Mapping[str, Array]) -> Dataset:
        """All rows, or the means of the rests among them."""
        s = self._settings
        still = [slice(i, i + 1) for i in range(len(read.lines))]
        warnings: tuple[str, ...] = ()
        if s.still is not None:
            still = rests(joints, read.texts, values.get("time"), s.still)
            if not still:
                text = f"found no moment at which no joint moves by more than {np.degrees(s.still.spread):.3g} deg."
                refuse(s.path, text, "Give a wider spread_deg or a shorter window under still.")
            used = sum(rest.stop - rest.start for rest in still)
            rows = f"{used} of {len(read.lines)} rows"
            warnings = (f"{s.path}: the log was reduced to {len(still)} still moments, the means of {rows}.",)
        starts = [rest.start for rest in still]
        channels = {
            name: np.array([row[rest.start : rest.stop].mean() for rest in still]) for name, row in values.items()
        }
        lines = tuple(read.lines[i] for i in starts)
        texts = {name: tuple(cells[i] for i in starts) for name, cells in zip(s.labels, read.texts, strict=True)}
        ids = tuple(map(str, lines))
        return Dataset(ids, channels, texts, lines, str(s.path), digest, warnings=warnings)
