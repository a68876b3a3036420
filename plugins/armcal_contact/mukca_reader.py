"""Recordings of a ball in sockets: a folder for each place of the sockets, in it a file for each. [Franzese2025]

The files are as their authors left them: ``front/hole_0.csv`` has a row a posture, the joint angles in rad from the
base to the tip, and no header.
"""

import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings
from armcal.errors import DataError, Location
from armcal.io.cells import is_missing, is_number
from armcal.io.cut_file import may_be_cut, whole_rows
from armcal.io.plain_files import input_bytes, refuse, text_of
from armcal.measure.checks import check_dataset, layout_of
from armcal.measure.instrument import named_arm
from armcal.measure.measurement import GroupedMeasurement, noise_channels
from armcal.measure.missing import with_absent
from armcal.measure.reader import ReadRequest, RequestedChannel

_FULL_TURN = 2 * math.pi
_NOISE = "noise"
POSITION, SOCKET = "position", "socket"
MAX_BYTES = 64 * 1024**2

_SOCKET_FILE = re.compile(r"hole_[0-9]+\.csv")
_LAYOUT = "Give the folder of one robot; in it a folder for each position, and there hole_0.csv, hole_1.csv."


class MukcaSettings(Settings):
    """Which robot's folder, which arm it is (the only one by default), and what weighs the same.

    With ``weights: positions`` every place of the sockets weighs the same, however many postures it has: the noise of
    each is multiplied by the root of their number. With ``postures`` every posture does.
    """

    path: InputPath
    arm: str | None = None
    weights: Literal["positions", "postures"] = "postures"


@dataclass(frozen=True)
class SocketFile:
    """One file: the position's and the socket's name, and its text."""

    path: Path
    position: str
    socket: str
    text: str
    raw: bytes


class MukcaReader:
    """The reader ``mukca``: text labels ``position`` and ``socket``, ids such as ``front/hole_0/12`` (the line)."""

    Settings: ClassVar[type[MukcaSettings]] = MukcaSettings
    EXAMPLE_SOURCE: ClassVar[Mapping[str, Any]] = {
        "files": {"front/hole_0.csv": "0.1,-0.2\n0.3,0.4\n", "front/hole_1.csv": "0.5,-0.6\n0.7,0.8\n"},
        "path": "",
        "channels": {"arm.q1": (0.1, 0.3, 0.5, 0.7), "arm.q2": (-0.2, 0.4, -0.6, 0.8)},
    }

    def __init__(self, settings: MukcaSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """All postures of the folder, in SI; ``rows`` are lines of their files.

        Raises:
            DataError: with file, line and column.
        """
        folder = self._settings.path
        files, warnings = found_files(folder)
        try:
            arm = request.arms[named_arm(self._settings.arm, tuple(request.arms))]
        except ValueError as fault:
            hint = "Set arm: NAME in the data section."
            raise DataError(f"{fault}.", where=Location(str(folder), field="arm"), hint=hint) from fault
        requested_channels = [
            w for w in request.channels if w.channel in {f"{arm.name}.{joint}" for joint in arm.commanded}
        ]
        tables = [_rows(file, requested_channels) for file in files]
        names = [(file, line) for file, (lines, _) in zip(files, tables, strict=True) for line in lines]
        joints = np.concatenate([joints for _, joints in tables])
        dataset = Dataset(
            tuple(f"{file.position}/{file.socket}/{line}" for file, line in names),
            {w.channel: joints[:, i] for i, w in enumerate(requested_channels)},
            {POSITION: tuple(f.position for f, _ in names), SOCKET: tuple(f.socket for f, _ in names)},
            tuple(line for _, line in names),
            str(folder),
            hash_of(files),
            warnings=warnings,
        )
        dataset = with_absent(dataset, request.channels)
        layout = layout_of(request.channels, dataset, {}, {}, by_line=True)
        checked = check_dataset(dataset, replace(layout, by_id=True))
        return _weighed(checked, request) if self._settings.weights == "positions" else checked


def found_files(folder: Path) -> tuple[tuple[SocketFile, ...], tuple[str, ...]]:
    """The files of all positions, sorted by their paths, and what a user should know of the rest.

    Raises:
        DataError: there is no such folder, no position in it, or a file cannot be read or is a copy of another.
    """
    if not folder.exists():
        refuse(folder, "there is no such folder.", "Check the path.")
    if not folder.is_dir():
        refuse(folder, "it is a file, expected a folder.", _LAYOUT)
    files: list[SocketFile] = []
    try:
        warnings = [_ignored(path) for path in sorted(folder.iterdir()) if not path.is_dir() and _is_table(path)]
        for place in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
            inside = sorted(place.iterdir())
            sockets = [path for path in inside if _SOCKET_FILE.fullmatch(path.name)]
            warnings += [_ignored(path) for path in inside if path not in sockets and _is_table(path)]
            files += [_file(path, folder) for path in sockets]
            if len(sockets) < 2:
                named = f"has only {sockets[0].name}" if sockets else "has no file hole_0.csv, hole_1.csv, ..."
                rest = "nothing is known of the distance of its sockets" if sockets else "it is ignored"
                warnings.append(f"{place}: the position {named}: {rest}.")
        own = any(_SOCKET_FILE.fullmatch(path.name) for path in folder.iterdir())
    except OSError as fault:
        path = Path(str(fault.filename)) if fault.filename else folder
        refuse(path, f"it cannot be read ({fault.strerror or fault}).", "Check the path and its permissions.")
    if not files:
        where = " (its files lie in the folder itself: is it one position?)" if own else ""
        refuse(folder, f"found no position in it, expected folders with hole_0.csv and hole_1.csv{where}.", _LAYOUT)
    first: dict[bytes, SocketFile] = {}
    for file in files:  # no ball sits in two sockets in the same postures
        other = first.setdefault(file.raw, file)
        if other is not file and file.text.strip():
            refuse(file.path, f"it is a copy of {other.path}.", "Give each socket its own recording.")
    return tuple(files), tuple(warnings)


def hash_of(files: Sequence[SocketFile]) -> str:
    """sha256 of the contents, one file after the other."""
    return hashlib.sha256(b"".join(file.raw for file in files)).hexdigest()


def _file(path: Path, folder: Path) -> SocketFile:
    if not path.resolve().is_relative_to(folder.resolve()):
        refuse(path, "it is a link that leads out of the folder.", "Put the recording itself there.")
    raw = input_bytes(path, MAX_BYTES, "a CSV file")
    text = text_of(raw, path, "Save it as CSV text.")
    return SocketFile(path, path.parent.name, path.stem, text.replace("\r\n", "\n").replace("\r", "\n"), raw)


def _is_table(path: Path) -> bool:
    return path.suffix.lower() == ".csv"


def _ignored(path: Path) -> str:
    return f"{path}: it is ignored; only hole_0.csv, hole_1.csv, ... in a position's folder are read."


def _rows(file: SocketFile, requested_channels: Sequence[RequestedChannel]) -> tuple[list[int], Array]:
    """The lines (from 1) of a file's postures, and the joints' displacements (lines x joints)."""
    path, lines, numbers, first = file.path, [], [], 0
    texts = enumerate(file.text.split("\n"), start=1)
    rows = ((line, text.split(",")) for line, text in texts if text.strip())
    last = f"column {len(requested_channels)}"
    for line, cells in whole_rows(rows, path, last) if may_be_cut(file.raw) else rows:
        first = first or len(cells)
        if len(cells) != first:
            mend = "Complete the row, or remove it."
            refuse(path, f"found {len(cells)} numbers, expected {first} as in the first row.", mend, line)
        if len(cells) != len(requested_channels):
            arm = requested_channels[0].channel.partition(".")[0] if requested_channels else "arm"
            message = (
                f"found {len(cells)} columns, expected {len(requested_channels)}: a joint angle of the arm {arm} each."
            )
            refuse(path, message, "Give this arm's recordings, comma separated.", line)
        lines.append(line)
        numbers.append([_number(path, line, i, cell, requested_channels) for i, cell in enumerate(cells)])
    if not lines:
        refuse(path, "it is empty.", "Give a row a posture, or remove the file.")
    return lines, np.array(numbers)


def _number(path: Path, line: int, index: int, cell: str, requested_channels: Sequence[RequestedChannel]) -> float:
    """One cell (rad, or m for a sliding joint)."""
    text, joint = cell.strip(), requested_channels[index]
    column = f"column {index + 1} ({joint.channel.partition('.')[2]})"
    if is_missing(text):
        return math.nan
    if not is_number(text):
        header = " These files have no header." if line == 1 else ""
        mend = f"Correct it, or leave the cell empty to set the record aside.{header}"
        refuse(path, f"found {text[:40]!r}, expected a number.", mend, line, column)
    value = float(text)
    if joint.dimension == "angle" and not joint.is_endless and _FULL_TURN * (1 + 1e-9) < abs(value) < math.inf:
        message = f"found {value:.10g} rad, more than one turn (2 pi rad): are these degrees?"
        refuse(path, message, "Write the angles in rad.", line, column)
    return value


def _weighed(dataset: Dataset, request: ReadRequest) -> Dataset:
    """The dataset with a standard deviation for each ball, by which every position weighs the same."""
    known = {channel.channel for channel in request.channels}
    postures = Counter(dataset.extra[POSITION])
    roots = np.sqrt([postures[position] for position in dataset.extra[POSITION]])
    noises: dict[str, Array] = {}
    for name, measurement in request.measurements.items():
        at_positions = isinstance(measurement, GroupedMeasurement) and measurement.group_labels[:1] == (POSITION,)
        if not at_positions or f"{name}.{_NOISE}" not in known:
            continue
        for sd, channels in zip(measurement.noise(), noise_channels(measurement), strict=False):
            if any(channel.name == _NOISE for channel in channels):  # records may give it
                noises.setdefault(f"{name}.{_NOISE}", sd * roots)
    return replace(dataset, channels={**dataset.channels, **noises})
