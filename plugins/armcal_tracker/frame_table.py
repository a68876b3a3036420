"""The columns of a table of frames: ``frame``, ``t``, and for each body ``NAME_x_mm`` ..., perhaps ``NAME_qw`` ..."""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from armcal.base.arrays import Array
from armcal.base.units import from_unit, split_suffix
from armcal.io.cells import DELIMITERS, read_cell, split
from armcal.io.plain_files import refuse

from armcal_tracker.frames import Frame, UnreadableError, body_pose

ONLY_BODY = "tool"
"""What a body is called whose columns have no name before them."""
_QUATERNION = ("qw", "qx", "qy", "qz")
_TIMES = {"t": "s", "t_s": "s", "t_ms": "ms", "t_us": "us"}
_FRAMES = ("frame", "frames")
_MOST_FRAMES = 2**63


@dataclass(frozen=True)
class BodyColumns:
    """Where a body stands in a row: places of x, y, z with their units, and of a quaternion; empty if it has none."""

    position: tuple[tuple[int, str], ...]
    quaternion: tuple[int, ...]


@dataclass(frozen=True)
class FrameTable:
    """A header that was understood."""

    cells: tuple[str, ...]
    delimiter: str
    frame: int
    time: tuple[int, str] | None
    bodies: Mapping[str, BodyColumns]


def frame_table(line: str, source: str) -> FrameTable:
    """The table whose header is this line.

    Raises:
        DataError: it is none.
    """
    line = line.removeprefix("\ufeff")
    delimiter = next((d for d in DELIMITERS if d in line), DELIMITERS[0])
    try:
        cells = split(line, delimiter)
    except csv.Error as fault:
        refuse(source, f"the header is not CSV ({fault}).", "Close every quote.", 1)
    places = {name: i for i, name in enumerate(cells)}
    if len(places) != len(cells):
        refuse(source, "found two columns of one name.", "Rename or remove one of them.", 1)
    frame = next((places[name] for name in _FRAMES if name in places), None)
    if frame is None:
        refuse(
            source, f"found no column frame among {_shown(cells)}.", "Give each frame its number, one higher each.", 1
        )
    time = next(((places[name], unit) for name, unit in _TIMES.items() if name in places), None)
    positions: dict[str, dict[str, str]] = {}
    for cell in cells:
        unit = split_suffix(cell, "length")
        if unit is not None and unit[0].rpartition("_")[2] in ("x", "y", "z"):
            name, _, axis = unit[0].rpartition("_")
            positions.setdefault(name or ONLY_BODY, {}).setdefault(axis, cell)
    bodies = {name: _body(name, columns, places, source) for name, columns in positions.items()}
    if not bodies:
        hint = "Name them after the body, with their unit: tool_x_mm, tool_y_mm, tool_z_mm."
        refuse(source, f"found no column of positions among {_shown(cells)}.", hint, 1)
    return FrameTable(tuple(cells), delimiter, frame, time, bodies)


def row_of(table: FrameTable, line: bytes) -> Frame | None:
    """The frame in a line; None for the header, written again.

    Raises:
        UnreadableError: it is none.
    """
    try:
        cells = split(line.decode("utf-8"), table.delimiter)
    except (UnicodeDecodeError, csv.Error):
        raise UnreadableError("a row that is not CSV in UTF-8") from None
    if tuple(cells) == table.cells:
        return None
    if len(cells) != len(table.cells):
        raise UnreadableError("a row with another number of cells than the header")
    counter = _number(cells[table.frame])
    if not 0 <= counter < _MOST_FRAMES or counter != int(counter):
        raise UnreadableError("a frame that is no whole number")
    stamp = math.nan if table.time is None else from_unit(_number(cells[table.time[0]]), table.time[1])
    poses: dict[str, Array | str | None] = {}
    for name, columns in table.bodies.items():
        position = [from_unit(_number(cells[i]), unit) for i, unit in columns.position]
        turn = [_number(cells[i]) for i in columns.quaternion]
        known = None if not turn or any(map(math.isnan, turn)) else turn
        poses[name] = None if any(map(math.isnan, position)) else body_pose(position, known)
    return Frame.of(int(counter), None if math.isnan(stamp) else stamp, poses)


def _body(name: str, columns: Mapping[str, str], places: Mapping[str, int], source: str) -> BodyColumns:
    lacking = [axis for axis in "xyz" if axis not in columns]
    if lacking:
        hint = f"Give all of {name}_x_mm, {name}_y_mm, {name}_z_mm."
        refuse(source, f"found no {lacking[0]} of the body {name}.", hint, 1)
    units = [split_suffix(columns[axis]) for axis in "xyz"]
    position = tuple((places[columns[axis]], u[1].name) for axis, u in zip("xyz", units, strict=True) if u is not None)
    stem = columns["x"].rpartition("x_")[0]
    quaternion = tuple(places[stem + part] for part in _QUATERNION if stem + part in places)
    if len(quaternion) not in (0, 4):
        hint = f"Give {stem}qw, {stem}qx, {stem}qy and {stem}qz, or none."
        refuse(source, f"found {len(quaternion)} columns of the quaternion of {name}.", hint, 1)
    return BodyColumns(position, quaternion)


def _number(cell: str) -> float:
    """NaN where it is missing."""
    number = read_cell(cell)
    if not isinstance(number, float) or math.isinf(number):
        raise UnreadableError("a cell that is no number")
    return number


def _shown(cells: Sequence[str]) -> str:
    return ", ".join(cell[:40] for cell in cells[:8])
