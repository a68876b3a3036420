"""All that was observed, a JSON object a line, each on disk before anything else happens.

Lines are checked when they are read: one that was damaged must not become a table.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.servo import COUNTS, PulseClock, PulseTable
from armcal.errors import DataError, InputError, Location
from armcal.io.journal.files import REAL_FILES, opened

NAME = "observations.jsonl"
BEGUN, POSE, ANGLE, LEFT_OUT = "begun", "pose", "angle", "left_out"
"""Kinds of lines."""

_ROTATION_OFF = 1e-6


class Record:
    """The lines of a folder's record; a last line that was cut short is cut off.

    Raises:
        DataError: another line is not one of ours, or damaged.
        InputError: the folder cannot be written.
    """

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        try:
            REAL_FILES.make_folder(folder)
            whole = self.path.read_bytes() if self.path.exists() else b""
            kept = whole[: whole.rfind(b"\n") + 1]
            if kept != whole:
                with opened(REAL_FILES, self.path) as descriptor:
                    REAL_FILES.truncate(descriptor, len(kept))
                    REAL_FILES.sync(descriptor)
        except OSError as fault:
            raise _unwritable(folder, fault) from fault
        self._entries: list[Mapping[str, Any]] = []
        for number, line in enumerate(kept.splitlines(), start=1):
            try:
                entry = json.loads(line)
            except ValueError:
                entry = None
            if damage := _fault_of(entry, number == 1):
                raise DataError(
                    f"found {damage}.",
                    where=Location(str(self.path), line=number),
                    hint="Give another --out." if number == 1 else "Give another --out, or remove this line.",
                )
            self._entries.append(entry)

    @property
    def entries(self) -> tuple[Mapping[str, Any], ...]:
        """All lines, in their order."""
        return tuple(self._entries)

    def of_kind(self, kind: str) -> list[Mapping[str, Any]]:
        """The lines of a kind."""
        return [entry for entry in self._entries if entry["kind"] == kind]

    @property
    def is_measured(self) -> bool:
        """Whether there is any line beside the first."""
        return len(self._entries) > 1

    def set_aside(self) -> Path:
        """Keep the file under another name, which is given, and be empty.

        Raises:
            InputError: it cannot be renamed.
        """
        kept = next_name(self.path)
        try:
            REAL_FILES.rename(self.path, kept)
        except OSError as fault:
            raise _unwritable(self.path, fault) from fault
        self._entries = []
        return kept

    def append(self, kind: str, content: Mapping[str, Any]) -> None:
        """One more line, durable when this returns.

        Raises:
            InputError: it cannot be written.
        """
        entry = {"kind": kind, **content}
        is_first = not self.path.exists()
        try:
            with opened(REAL_FILES, self.path) as descriptor:
                REAL_FILES.write(descriptor, json.dumps(entry, allow_nan=False).encode() + b"\n")
                REAL_FILES.sync(descriptor)
            if is_first:
                REAL_FILES.sync_folder(self.path.parent)
        except OSError as fault:
            raise _unwritable(self.path, fault) from fault
        self._entries.append(entry)


def next_name(path: Path) -> Path:
    """The first of ``NAME.before-1``, ``NAME.before-2``, ... that is free, for a file that is to be kept."""
    number = 1
    while (kept := path.with_name(f"{path.name}.before-{number}")).exists():
        number += 1
    return kept


def _unwritable(path: Path, fault: OSError) -> InputError:
    return InputError(
        f"it cannot be written ({fault.strerror}).", where=Location(str(path)), hint="Give --out a writable folder."
    )


def _fault_of(entry: Any, is_first: bool) -> str:
    """Why a line cannot be what was written; empty if it can. Only the first says by what it was begun."""
    if not isinstance(entry, dict) or not isinstance(entry.get("kind"), str) or entry["kind"] not in _CHECKS:
        return "a line that is not an observation"
    if is_first != (entry["kind"] == BEGUN):
        return "a first line that does not say by which tables it was begun" if is_first else "a second beginning"
    try:
        is_sound = _CHECKS[entry["kind"]](entry)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError):
        is_sound = False
    return "" if is_sound else "a damaged observation"


def _is_begun(entry: Mapping[str, Any]) -> bool:
    for servo in entry["servos"].values():
        PulseTable(tuple(_numbers(servo["angles"])), tuple(_numbers(servo["pulses"])))
        PulseClock(_number(servo["oscillator_hz"]), _whole(servo["prescale"]))
        if not isinstance(servo["board"], str) or not servo["oscillator_hz"] > 0:
            return False
        _whole(servo["channel"])
    _numbers(entry["base"].values())
    return bool(entry["servos"])


def _is_pose(entry: Mapping[str, Any]) -> bool:
    place = _is_place(entry) and 0 < _whole(entry["counts"]) < COUNTS
    deviations = [d for d in entry["deviations"] if d is not None]
    _numbers(entry["told"].values())
    sizes = len(_numbers(entry["position"])) == 3 and len(entry["deviations"]) == 6
    rotation = np.eye(3)
    if entry["rotation"] is not None:
        rotation = np.array([_numbers(row) for row in entry["rotation"]])
    if rotation.shape != (3, 3) or np.linalg.det(rotation) < 0:
        return False
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    return place and sizes and all(d >= 0 for d in _numbers(deviations)) and off < _ROTATION_OFF


def _is_angle(entry: Mapping[str, Any]) -> bool:
    _numbers((entry["angle"], entry["target"]))
    return _is_place(entry) and 0 < _whole(entry["counts"]) < COUNTS and _number(entry["sd"]) > 0


def _is_left_out(entry: Mapping[str, Any]) -> bool:
    about = _whole(entry["counts"]) if "counts" in entry else _number(entry["target"])
    return _is_place(entry) and math.isfinite(about)


def _is_place(entry: Mapping[str, Any]) -> bool:
    _number(entry["at"])
    warm = all(len(_numbers(parts)) == 2 for parts in entry.get("warmth", {}).values())
    return warm and isinstance(entry["joint"], str) and entry["came"] in (-1, 1)


def _numbers(values: Sequence[Any] | Any) -> list[float]:
    return [_number(value) for value in values]


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError("no number")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError("no whole number")
    return value


_CHECKS: Mapping[str, Callable[[Mapping[str, Any]], bool]] = {
    BEGUN: _is_begun,
    POSE: _is_pose,
    ANGLE: _is_angle,
    LEFT_OUT: _is_left_out,
}
