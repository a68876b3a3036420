"""All that was observed, each entry of the journal on disk before anything else happens.

Entries are checked when they are read: one that was damaged must not become a table.
"""

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Annotated, Any, Literal, Self

import numpy as np
from armcal.arm.servo import COUNTS, PulseClock, PulseTable
from armcal.devices.device import DeviceIdentity
from armcal.errors import DataError, InputError, Location
from armcal.io.journal import JOURNAL, Entry, Journal, KeptJournal, has_journal
from armcal.io.plain_files import writing
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator

from armcal_bench.servo.setup import Setup
from armcal_bench.servo.tables import KnownBoard, KnownServo

_LINES_BEFORE = "observations.jsonl"  # what versions before had in the journal's place
BEGUN, POSE, ANGLE, LEFT_OUT = "begun", "pose", "angle", "left_out"  # Kinds of entries

_ROTATION_OFF = 1e-6


Counts = Annotated[int, Field(gt=0, lt=COUNTS)]
Row = tuple[float, float, float]
_SAME = 1e-6


class _Line(BaseModel):
    model_config = ConfigDict(strict=True, allow_inf_nan=False)


class _StatedServo(_Line):
    board: str
    channel: int
    oscillator_hz: Annotated[float, Field(gt=0)]
    prescale: int
    angles: tuple[float, ...]
    pulses: tuple[float, ...]

    @model_validator(mode="after")
    def _usable(self) -> Self:
        PulseTable(self.angles, self.pulses)
        PulseClock(self.oscillator_hz, self.prescale)
        return self


class _Begun(_Line):
    kind: Literal["begun"]
    servos: Annotated[dict[str, _StatedServo], Field(min_length=1)]
    base: dict[str, float]


class _Place(_Line):
    joint: str
    came: Literal[-1, 1]
    at: float
    warmth: dict[str, tuple[float, float]] = {}


class _Pose(_Place):
    kind: Literal["pose"]
    counts: Counts
    told: dict[str, float]
    position: Row
    rotation: tuple[Row, Row, Row] | None
    deviations: Annotated[tuple[Annotated[float, Field(ge=0)] | None, ...], Field(min_length=6, max_length=6)]

    @model_validator(mode="after")
    def _is_turned(self) -> Self:
        matrix = np.eye(3) if self.rotation is None else np.array(self.rotation)
        if np.linalg.det(matrix) < 0 or np.abs(matrix @ matrix.T - np.eye(3)).max() > _ROTATION_OFF:
            raise ValueError("no rotation")
        return self


class _Angle(_Place):
    kind: Literal["angle"]
    counts: Counts
    target: float
    angle: float
    sd: Annotated[float, Field(gt=0)]


class _LeftOut(_Place):
    kind: Literal["left_out"]
    counts: int | None = None
    target: float | None = None

    @model_validator(mode="after")
    def _is_about_a_point(self) -> Self:
        if self.counts is None and self.target is None:
            raise ValueError("neither counts nor a target")
        return self


_LINES: TypeAdapter[_Line] = TypeAdapter(Annotated[_Begun | _Pose | _Angle | _LeftOut, Field(discriminator="kind")])


class Record:
    """The observations in a folder's journal; what is there is read and checked at once, and written to when needed.

    Raises:
        DataError: an entry is not one of ours, or damaged.
        InputError: it is of an earlier version, or cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / JOURNAL
        self._journal: Journal | None = None
        self._entries: list[Mapping[str, Any]] = []
        if has_journal(folder):
            with KeptJournal(folder) as journal:
                for number, entry in enumerate(journal.entries(), start=1):
                    self._entries.append(_checked(self.path, number, entry))
        elif (folder / _LINES_BEFORE).exists():
            text = f"it holds the observations of an earlier version of armcal ({_LINES_BEFORE})."
            hint = "Go on, or evaluate them, with that version; or give another --out."
            raise InputError(text, where=Location(str(folder)), hint=hint)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._close()

    @property
    def entries(self) -> tuple[Mapping[str, Any], ...]:
        return tuple(self._entries)

    @property
    def begun(self) -> Mapping[str, Any] | None:
        """The first entry; None where there is none."""
        return self._entries[0] if self._entries else None

    @property
    def is_measured(self) -> bool:
        return len(self._entries) > 1

    def set_aside(self) -> Path:
        """Keep the journal under another name, which is given, and be empty.

        Raises:
            InputError: it cannot be renamed, or another process writes it.
        """
        self._opened()
        self._close()
        kept = next_name(self.path)
        with writing(self.path, "Give --out a writable folder."):
            self.path.rename(kept)
        self._entries = []
        return kept

    def append(self, kind: str, values: Mapping[str, Any]) -> None:
        """One more entry, durable when this returns; see ``Journal`` for what it raises."""
        self._opened().record(kind, dict(values))
        self._entries.append({"kind": kind, **values})

    def _opened(self) -> Journal:
        if self._journal is None:
            self._journal = Journal(self.folder, {})
        return self._journal

    def _close(self) -> None:
        if self._journal is not None:
            self._journal.close()
        self._journal = None


def _checked(path: Path, number: int, entry: Entry) -> Mapping[str, Any]:
    damage, content = "", {"kind": entry.kind, **(entry.content if isinstance(entry.content, dict) else {})}
    try:
        is_beginning = isinstance(_LINES.validate_json(json.dumps(content)), _Begun)
    except ValidationError:
        damage = "an entry that is no observation, or a damaged one"
    else:
        if number == 1 and not is_beginning:
            damage = "a first entry that does not say by which tables it was begun"
        elif number > 1 and is_beginning:
            damage = "a second beginning"
    if damage:
        remove = f'sqlite3 {path} "delete from entry where sequence = {entry.sequence}"'
        hint = "Give another --out." if number == 1 else f"Give another --out, or remove it: {remove}"
        raise DataError(f"entry {entry.sequence}: found {damage}.", where=Location(str(path)), hint=hint)
    return content


def next_name(path: Path) -> Path:
    """The first of ``NAME.before-1``, ``NAME.before-2``, ... that is free, for a file that is to be kept."""
    number = 1
    while (kept := path.with_name(f"{path.name}.before-{number}")).exists():
        number += 1
    return kept


def begin(setup: Setup, record: Record, device: DeviceIdentity | None, say: Callable[[str], None]) -> None:
    """The first entry of a record: by which tables and in which base pose it is measured.

    It is written when nothing is left that could refuse the run. One that stands there without a measurement after it
    is of a run that measured nothing, and must not be taken for this run's.
    """
    if record.is_measured:
        return
    servos = {joint: _as_stated(setup, joint) for joint in setup.base}
    board = {} if device is None else {"device": device.name, "adapter": device.adapter}
    content = {"servos": servos, **board, "base": dict(setup.base)}
    if (begun := record.begun) is not None:
        if {**begun, **content} == begun:
            return
        kept = record.set_aside()
        say(
            f"{record.path}: it was begun with another base pose, servo file or board, and holds no measurement; it is "
            f"kept as {kept.name}, and this run begins anew."
        )
    record.append(BEGUN, content)


def check_same(setup: Setup, record: Record, device: DeviceIdentity) -> None:
    """A record that holds measurements goes on only with the board, the wiring and the base pose that it began with.

    Raises:
        InputError: it would be another one.
    """
    begun = record.entries[0]
    where = Location(str(record.path))
    adapter = str(begun.get("adapter", ""))
    if adapter and device.adapter and adapter != device.adapter:
        text = f"it was begun with the adapter {adapter!r}, found {device.adapter!r}."
        raise InputError(text, where=where, hint="Connect the one that it was begun with, or give a new --out.")
    moved = [joint for joint, angle in setup.base.items() if abs(begun["base"].get(joint, angle) - angle) > _SAME]
    if moved:
        raise InputError(
            f"it was begun with another base pose: {moved[0]} stood at {_deg(begun['base'][moved[0]])}, not at "
            f"{_deg(setup.base[moved[0]])}.",
            where=where,
            hint="Give the base pose that it was begun with, or a new --out.",
        )
    for joint in setup.base:
        stated, before = _as_stated(setup, joint), begun["servos"].get(joint, {})
        if any(stated[key] != before.get(key) for key in ("board", "channel", "oscillator_hz", "prescale")):
            text = f"it was begun with another board, channel or oscillator of {joint}."
            raise InputError(text, where=where, hint="Give a new --out.")


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.1f} deg"


def _as_stated(setup: Setup, joint: str) -> dict[str, Any]:
    servo = setup.file.servos[joint]
    clock = setup.file.boards[servo.board].clock
    return {
        "board": str(servo.board),
        "channel": servo.channel,
        "oscillator_hz": clock.oscillator_hz,
        "prescale": clock.prescale,
        "angles": list(servo.angles),
        "pulses": list(servo.pulses),
    }


def stated_by(setup: Setup, begun: Any, joints: tuple[str, ...]) -> tuple[list[KnownServo], dict[str, KnownBoard]]:
    """Servos and boards as they were when the record was begun."""
    servos, boards = [], setup.boards()
    for joint in joints:
        stated = begun["servos"].get(joint)
        if stated is None:
            servos.append(setup.known(joint))
            continue
        table = PulseTable(tuple(stated["angles"]), tuple(stated["pulses"]))
        servos.append(replace(setup.known(joint), table=table))
        clock = PulseClock(stated["oscillator_hz"], stated["prescale"])
        boards[stated["board"]] = KnownBoard(clock, boards[stated["board"]].measured)
    return servos, boards
