"""Recordings of a ball in sockets: a folder for each place of the sockets, in it a file for each. [Franzese2025]

The files are as their authors left them: ``front/hole_0.csv`` has a row a posture, the joint angles in rad from the
base to the tip, and no header.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar, Literal, NoReturn

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.settings import InputPath, Settings
from armcal.errors import DataError, Location
from armcal.io.cells import is_missing, is_number
from armcal.measure.checks import check_dataset, layout_of
from armcal.measure.contact import named_arm
from armcal.measure.measurement import GroupedMeasurement, noise_channels
from armcal.measure.missing import with_absent
from armcal.measure.reader import ReadRequest, RequestedChannel

from armcal_contact.mukca_folder import POSITION, SOCKET, SocketFile, found_files, hash_of

_FULL_TURN = 2 * math.pi
_NOISE = "noise"


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
            w for w in request.wanted if w.channel in {f"{arm.name}.{joint}" for joint in arm.commanded}
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
        dataset = with_absent(dataset, request.wanted)
        layout = layout_of(request.wanted, dataset, {}, {}, by_line=True)
        checked = check_dataset(dataset, replace(layout, by_id=True))
        return _weighed(checked, request) if self._settings.weights == "positions" else checked


def _rows(file: SocketFile, requested_channels: Sequence[RequestedChannel]) -> tuple[list[int], Array]:
    """The lines (from 1) of a file's postures, and the joints' displacements (lines x joints)."""
    path, lines, numbers, first = file.path, [], [], 0
    for line, text in enumerate(file.text.split("\n"), start=1):
        if not text.strip():
            continue
        cells = text.split(",")
        first = first or len(cells)
        if len(cells) != first:
            mend = "Complete the row, or remove it."
            _refuse(path, f"found {len(cells)} numbers, expected {first} as in the first row.", mend, line)
        if len(cells) != len(requested_channels):
            arm = requested_channels[0].channel.partition(".")[0] if requested_channels else "arm"
            message = (
                f"found {len(cells)} columns, expected {len(requested_channels)}: a joint angle of the arm {arm} each."
            )
            _refuse(path, message, "Give this arm's recordings, comma separated.", line)
        lines.append(line)
        numbers.append([_number(path, line, i, cell, requested_channels) for i, cell in enumerate(cells)])
    if not lines:
        _refuse(path, "it is empty.", "Give a row a posture, or remove the file.")
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
        _refuse(path, f"found {text[:40]!r}, expected a number.", mend, line, column)
    value = float(text)
    if joint.dimension == "angle" and not joint.is_endless and _FULL_TURN * (1 + 1e-9) < abs(value) < math.inf:
        message = f"found {value:.10g} rad, more than one turn (2 pi rad): are these degrees?"
        _refuse(path, message, "Write the angles in rad.", line, column)
    return value


def _refuse(path: Path, message: str, hint: str, line: int | None = None, column: str | None = None) -> NoReturn:
    raise DataError(message, where=Location(str(path), line=line, field=column), hint=hint)


def _weighed(dataset: Dataset, request: ReadRequest) -> Dataset:
    """The dataset with a standard deviation for each ball, by which every position weighs the same."""
    known = {channel.channel for channel in request.wanted}
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
