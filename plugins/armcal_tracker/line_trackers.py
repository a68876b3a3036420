"""The trackers ``json_lines`` and ``csv``: a frame a line, in a file that grows or in datagrams.

One frame as a line of JSON.

    {"frame": 1, "t": 0.1, "bodies": {"tool": {"p_mm": [1, 2, 3], "q": [1, 0, 0, 0]}, "base": null}}

``t`` (s, the tracker's clock) may be left out, and ``q`` (w, x, y, z) where only positions are known; ``p_m`` stands in
place of ``p_mm`` for metres; ``null`` is a body that is not seen.
"""

import csv
import ipaddress
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, NoReturn, Self

from armcal.base.arrays import Array
from armcal.base.settings import InputPath, Settings
from armcal.base.units import from_unit, split_suffix
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceRefusedError
from armcal.devices.line_source import LONGEST_LINE_BYTES, Begin, FileLines, UdpLines
from armcal.devices.live import TrackerFrame
from armcal.errors import DataError, Location
from armcal.io.cells import DELIMITERS, read_cell, split
from armcal.io.plain_files import refuse
from pydantic import Field, field_validator, model_validator
from typing_extensions import override

from armcal_tracker.frames import CountingTracker, Frame, FrameCounter, UnreadableError, body_pose

ONLY_BODY = "tool"  # What a body is called whose columns have no name before them
_QUATERNION = ("qw", "qx", "qy", "qz")
_TIMES = {"t": "s", "t_s": "s", "t_ms": "ms", "t_us": "us"}
_FRAMES = ("frame", "frames")


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


MOST_BODIES = 100
LONGEST_NAME = 100
_MOST_FRAMES = 2**63
_MOST_DIGITS = 20
_POSITIONS = {"p_m": "m", "p_mm": "mm"}


def json_frame(line: bytes) -> Frame:
    """The frame in a line.

    Raises:
        UnreadableError: it is none.
    """
    try:
        content = json.loads(
            line.decode("utf-8"), parse_constant=_not_finite, parse_int=_integer, object_pairs_hook=_without_repeats
        )
    except UnreadableError:
        raise
    except UnicodeDecodeError:
        raise UnreadableError("not UTF-8 text") from None
    except (ValueError, RecursionError):
        raise UnreadableError("not JSON") from None
    if not isinstance(content, dict) or not {"frame", "bodies"} <= set(content) <= {"frame", "t", "bodies"}:
        raise UnreadableError("not an object with frame, bodies, and perhaps t")
    counter, bodies = content["frame"], content["bodies"]
    if type(counter) is not int or not 0 <= counter < _MOST_FRAMES:
        raise UnreadableError("a frame that is no whole number")
    if not isinstance(bodies, dict) or len(bodies) > MOST_BODIES or max(map(len, bodies), default=0) > LONGEST_NAME:
        raise UnreadableError("bodies that are no object of bodies by name")
    stamp = None if content.get("t") is None else _numbers([content["t"]], 1)[0]
    poses: dict[str, Array | str | None] = {}
    for name, body in bodies.items():
        keys = [key for key in _POSITIONS if isinstance(body, dict) and key in body]
        if body is not None and (len(keys) != 1 or set(body) - {"q", keys[0]}):
            raise UnreadableError("a body without one of p_mm and p_m, or with more than that and q")
        poses[name] = None
        if body is not None:
            position = [from_unit(x, _POSITIONS[keys[0]]) for x in _numbers(body[keys[0]], 3)]
            poses[name] = body_pose(position, _numbers(body["q"], 4) if body.get("q") is not None else None)
    return Frame.of(counter, stamp, poses)


def _numbers(values: Any, count: int) -> list[float]:
    if not isinstance(values, list) or len(values) != count or any(type(x) not in (int, float) for x in values):
        raise UnreadableError("a time, position or quaternion that is not so many numbers as it has")
    numbers = [float(x) for x in values]
    if not all(map(math.isfinite, numbers)):
        raise UnreadableError("a number that is not finite")
    return numbers


def _integer(text: str) -> int:
    if len(text) > _MOST_DIGITS:
        raise UnreadableError("a number of too many digits")
    return int(text)


def _not_finite(_: str) -> NoReturn:
    raise UnreadableError("a number that is not finite")


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content = dict(pairs)
    if len(content) != len(pairs):
        raise UnreadableError("a name that is given twice")
    return content


class JsonLinesSettings(Settings):
    """Either a UDP ``port``, on an address of this machine, or the ``path`` of a file that another program writes.

    A file is read from its ``end``: what was in it before is not what the tracker sees now.
    """

    port: Annotated[int, Field(ge=0, le=65535)] | None = None
    host: str = "127.0.0.1"
    path: InputPath | None = None
    begin: Begin = "end"

    @field_validator("host")
    @classmethod
    def _address(cls, value: str) -> str:
        ipaddress.IPv4Address(value)
        return value

    @model_validator(mode="after")
    def _one_source(self) -> Self:
        if (self.port is None) == (self.path is None):
            raise ValueError("expected either a UDP port (port: 5005) or a file (path: frames.jsonl)")
        return self


class GrowingCsvSettings(Settings):
    """The file that another program writes; it is read from its ``end``: what was there before is past."""

    path: InputPath
    begin: Begin = "end"


class LineTracker(CountingTracker):
    """Frames of the lines of a source. See ``armcal.devices.live.Tracker``."""

    def __init__(self) -> None:
        super().__init__()
        self._source: FileLines | UdpLines | None = None
        self._renewed = 0

    def _open(self, source: FileLines | UdpLines, clock: Clock) -> None:
        self.close()
        self._source, self._clock, self._counter, self._renewed = source, clock, FrameCounter(), 0

    def _begin_anew(self) -> None:
        self._counter.begin_anew()

    def _frame(self, line: bytes) -> Frame | None:
        """The frame in a line; None where there is none to be.

        Raises:
            UnreadableError: it cannot be read.
        """
        raise NotImplementedError

    @override
    def frames(self) -> list[TrackerFrame]:
        if self._source is None or self._clock is None:
            return []
        now, lines = self._clock.now(), self._source.lines()
        if isinstance(self._source, FileLines) and self._source.renewed != self._renewed:
            self._renewed = self._source.renewed
            self._begin_anew()
        tracker_frames: list[TrackerFrame] = []
        for line in lines:
            if line is not None and not line.strip():
                continue
            try:
                if line is None:
                    raise UnreadableError(f"a line of more than {LONGEST_LINE_BYTES // 1024} KiB")
                frame = self._frame(line)
            except UnreadableError as fault:
                self._refused[str(fault)] += 1
                continue
            if frame is not None and self._accepts(frame):
                tracker_frames.append(TrackerFrame(frame.counter, now, frame.stamp, frame.bodies))
        return tracker_frames

    @override
    def close(self) -> None:
        if self._source is not None:
            self._source.close()
        self._source = None


class JsonLinesTracker(LineTracker):
    """Frames as ``json_message`` reads them."""

    Settings: ClassVar[type[JsonLinesSettings]] = JsonLinesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"port": 0}

    def __init__(self, settings: JsonLinesSettings) -> None:
        super().__init__()
        self._settings = settings

    @property
    def address(self) -> tuple[str, int]:
        assert isinstance(self._source, UdpLines)
        return self._settings.host, self._source.port

    @override
    def open(self, clock: Clock) -> None:
        s = self._settings
        if s.path is not None:
            self._open(_growing_file(s.path, s.begin), clock)
        else:
            self._open(UdpLines(f"udp:{s.host}:{s.port}?from=any"), clock)

    @override
    def _frame(self, line: bytes) -> Frame:
        return json_frame(line)


class GrowingCsvTracker(LineTracker):
    """Rows as ``frame_table`` reads them."""

    Settings: ClassVar[type[GrowingCsvSettings]] = GrowingCsvSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"path": "/no/such/folder/frames.csv"}

    def __init__(self, settings: GrowingCsvSettings) -> None:
        super().__init__()
        self._settings = settings
        self._table: FrameTable | None = None

    @override
    def open(self, clock: Clock) -> None:
        """Raises:
        DataError: the header, if it is there, cannot be used.
        """
        file = _growing_file(self._settings.path, self._settings.begin)
        self._open(file, clock)
        self._table = None if file.header is None else self._understood(file.header)

    @override
    def _begin_anew(self) -> None:
        super()._begin_anew()
        self._table = None

    @override
    def _frame(self, line: bytes) -> Frame | None:
        if self._table is not None:
            return row_of(self._table, line)
        try:
            self._table = self._understood(line)
        except DataError:
            raise UnreadableError("a line before any header that can be used") from None
        return None

    def _understood(self, header: bytes) -> FrameTable:
        return frame_table(header.decode("utf-8", "replace"), str(self._settings.path))


def _growing_file(path: Path, begin: Begin) -> FileLines:
    where = Location(str(path))
    try:
        if path.exists() and not path.is_file():
            raise DeviceRefusedError("it is not a regular file.", where=where, hint="Give a file that grows.")
        return FileLines(path, begin)
    except OSError as fault:
        hint = "Start the program that writes it first, and check the path."
        raise DeviceRefusedError(f"it cannot be read ({fault.strerror}).", where=where, hint=hint) from fault
