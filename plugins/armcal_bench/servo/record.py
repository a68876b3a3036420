"""All that was observed, a JSON object a line, each on disk before anything else happens."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from armcal.errors import DataError, InputError, Location
from armcal.io.journal.files import REAL_FILES, opened

from armcal_bench.servo.entries import ANGLE as ANGLE
from armcal_bench.servo.entries import BEGUN as BEGUN
from armcal_bench.servo.entries import LEFT_OUT as LEFT_OUT
from armcal_bench.servo.entries import POSE as POSE
from armcal_bench.servo.entries import fault_of

NAME = "observations.jsonl"


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
        self._entries = [self._read(i, line) for i, line in enumerate(kept.splitlines(), start=1)]

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

    def _read(self, line: int, text: bytes) -> Mapping[str, Any]:
        try:
            entry = json.loads(text)
        except ValueError:
            entry = None
        if fault := fault_of(entry, line == 1):
            raise DataError(
                f"found {fault}.",
                where=Location(str(self.path), line=line),
                hint="Give another --out." if line == 1 else "Give another --out, or remove this line.",
            )
        return dict(entry)


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
