"""Recordings of a ball in sockets: a folder for each place of the sockets, in it a file for each. [Franzese2025]

The files are as their authors left them: ``front/hole_0.csv`` has a row a posture, the joint angles in rad from the
base to the tip, and no header.
"""

import hashlib
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings
from armcal.errors import DataError, Location
from armcal.io.plain_files import input_bytes, refuse
from armcal.measure.checks import read_as
from armcal.measure.measurement import GroupedMeasurement, named_arm, noise_channels
from armcal.measure.reader import ReadRequest, RequestedChannel
from armcal.measure.tables import open_table, read_cell

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
        """All postures of the folder, in SI; ``rows`` are lines of their files."""
        folder = self._settings.path
        files, warnings = _found(folder)
        try:
            arm = request.arms[named_arm(self._settings.arm, tuple(request.arms))]
        except ValueError as fault:
            hint = "Set arm: NAME in the data section."
            raise DataError(f"{fault}.", where=Location(str(folder), field="arm"), hint=hint) from fault
        channels = [w for w in request.channels if w.channel in arm.command_channels]
        tables = [_rows(path, content, channels) for path, content in files.items()]
        lines = [(path, line) for path, (numbers, _) in zip(files, tables, strict=True) for line in numbers]
        joints = np.concatenate([joints for _, joints in tables])
        dataset = Dataset(
            tuple(f"{path.parent.name}/{path.stem}/{line}" for path, line in lines),
            {w.channel: joints[:, i] for i, w in enumerate(channels)},
            {POSITION: tuple(p.parent.name for p, _ in lines), SOCKET: tuple(p.stem for p, _ in lines)},
            tuple(line for _, line in lines),
            str(folder),
            hashlib.sha256(b"".join(files.values())).hexdigest(),
            warnings=warnings,
        )
        checked = read_as(dataset, request, by_id=True)
        return _weighed(checked, request) if self._settings.weights == "positions" else checked


def _found(folder: Path) -> tuple[dict[Path, bytes], tuple[str, ...]]:
    """The files of all positions with their content, sorted by path, and what a user should know of the rest."""
    if not folder.exists():
        refuse(folder, "there is no such folder.", "Check the path.")
    if not folder.is_dir():
        refuse(folder, "it is a file, expected a folder.", _LAYOUT)
    files: dict[Path, bytes] = {}
    warnings = []
    try:
        others = [path for path in sorted(folder.iterdir()) if not path.is_dir()]
        own = any(_SOCKET_FILE.fullmatch(path.name) for path in others)
        for place in sorted(path for path in folder.iterdir() if path.is_dir() and not path.name.startswith(".")):
            inside = sorted(place.iterdir())
            sockets = [path for path in inside if _SOCKET_FILE.fullmatch(path.name)]
            others += [path for path in inside if path not in sockets]
            for path in sockets:
                if not path.resolve().is_relative_to(folder.resolve()):
                    refuse(path, "it is a link that leads out of the folder.", "Put the recording itself there.")
                files[path] = input_bytes(path, MAX_BYTES, "a CSV file")
            if len(sockets) < 2:
                named = f"has only {sockets[0].name}" if sockets else "has no file hole_0.csv, hole_1.csv, ..."
                rest = "nothing is known of the distance of its sockets" if sockets else "it is ignored"
                warnings.append(f"{place}: the position {named}: {rest}.")
    except OSError as fault:
        path = Path(str(fault.filename)) if fault.filename else folder
        refuse(path, f"it cannot be read ({fault.strerror or fault}).", "Check the path and its permissions.")
    if not files:
        where = " (its files lie in the folder itself: is it one position?)" if own else ""
        refuse(folder, f"found no position in it, expected folders with hole_0.csv and hole_1.csv{where}.", _LAYOUT)
    first: dict[bytes, Path] = {}
    for path, content in files.items():  # no ball sits in two sockets in the same postures
        other = first.setdefault(content, path)
        if other is not path and content.strip():
            refuse(path, f"it is a copy of {other}.", "Give each socket its own recording.")
    text = "it is ignored; only hole_0.csv, hole_1.csv, ... in a position's folder are read."
    ignored = [f"{path}: {text}" for path in others if path.suffix.lower() == ".csv"]
    return files, (*ignored, *warnings)


def _rows(path: Path, content: bytes, channels: Sequence[RequestedChannel]) -> tuple[tuple[int, ...], Array]:
    """The lines (from 1) of a file's postures, and the joints' displacements (lines x joints; rad or m)."""
    hint = "Give a row a posture, or remove the file."
    with open_table(path, most=MAX_BYTES, empty=hint, content=content) as table:
        line, cells = table.first
        if len(cells) != len(channels):
            arm = channels[0].channel.partition(".")[0] if channels else "arm"
            text = f"found {len(cells)} columns, expected {len(channels)}: a joint angle of the arm {arm} each."
            refuse(path, text, "Give this arm's recordings, comma separated.", line)
        names = [f"column {i} ({w.channel.partition('.')[2]})" for i, w in enumerate(channels, 1)]
        read = table.columns(list(enumerate(names)), has_header=False, number=partial(_number, path))
    for joint, name, column in zip(channels, names, read.numbers, strict=True):
        over = np.flatnonzero((np.abs(column) > _FULL_TURN * (1 + 1e-9)) & np.isfinite(column))
        if joint.dimension == "angle" and not joint.is_endless and over.size:
            text = f"found {column[over[0]]:.10g} rad, more than one turn (2 pi rad): are these degrees?"
            refuse(path, text, "Write the angles in rad.", read.lines[over[0]], name)
    return read.lines, np.array(read.numbers).T


def _number(path: Path, line: int, cell: str, name: str) -> float:
    try:
        return read_cell(cell)
    except DataError as fault:
        header = " These files have no header." if line == 1 else ""
        refuse(path, fault.message, fault.hint + header, line, name)


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
