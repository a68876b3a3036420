"""All that was observed, each entry of the journal on disk before anything else happens.

Entries are checked when they are read: one that was damaged must not become a table.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from armcal.arm.servo import COUNTS, PulseClock, PulseTable
from armcal.devices.device import DeviceIdentity
from armcal.errors import DataError, InputError, Location
from armcal.io.journal import JOURNAL, Entry, Journal, KeptJournal, has_journal
from armcal.io.plain_files import writing
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError, model_validator
from typing_extensions import override

from armcal_bench.acquisition.run_log import LEFT_OUT as PASSED
from armcal_bench.acquisition.run_log import MEASURED, Log, Progress
from armcal_bench.servo.setup import KnownServo, Setup

BEGUN, POSE, ANGLE, LEFT_OUT = "begun", "pose", "angle", "left_out"  # Kinds of entries

_SAME = 1e-6
_ROTATION_OFF = 1e-6


Counts = Annotated[int, Field(gt=0, lt=COUNTS)]
Row = tuple[float, float, float]


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
        InputError: it cannot be read.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.path = folder, folder / JOURNAL
        self._journal: Journal | None = None
        self._entries: list[Mapping[str, Any]] = []
        if has_journal(folder):
            with KeptJournal(folder) as journal:
                for number, entry in enumerate(journal.entries(), start=1):
                    self._entries.append(_checked(self.path, number, entry))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *ending: object) -> None:
        self._close()

    @property
    def entries(self) -> tuple[Mapping[str, Any], ...]:
        return tuple(self._entries)

    @property
    def begun(self) -> Mapping[str, Any] | None:
        """The first entry; None where there is none."""
        return self._entries[0] if self._entries else None

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


class SweepLog(Log):
    """Of a run whose poses are those of sweeps: what was observed goes to the record, and no more.

    A pose is called by its joint, counts and side: ``q3 307 +``. What an earlier run left out is tried once more.
    """

    def __init__(self, record: Record) -> None:
        self._record, entries = record, record.entries
        measured = {pose_name(e["joint"], e["counts"], e["came"]): e for e in entries if e["kind"] == POSE}
        warm = next((entry for entry in reversed(entries) if entry.get("warmth")), None)
        self.progress = Progress(measured)
        if warm is not None:
            self.progress = Progress(measured, thermal_state=warm["warmth"], at=float(warm["at"]))

    @override
    def record(self, kind: str, content: Mapping[str, Any]) -> None:
        self.progress = self.progress.after(kind, content)
        if kind not in (MEASURED, PASSED):
            return
        joint, counts, side = str(content["pose"]).rsplit(" ", 2)
        line: dict[str, Any] = {"joint": joint, "counts": int(counts), "came": 1 if side == "+" else -1}
        if kind == PASSED:
            self._record.append(LEFT_OUT, {**line, "at": self.progress.at, "why": content["why"]})
            return
        deviations = [float(d) if np.isfinite(d) else None for d in content["deviation"]] + content["turn_deviation"]
        line |= {"at": content["at"], "warmth": content["warmth"], "told": content["standing"]}
        line |= {key: content[key] for key in ("position", "rotation", "frames")}
        self._record.append(POSE, {**line, "deviations": deviations})


def pose_name(joint: str, counts: int, came: int) -> str:
    return f"{joint} {counts} {'+' if came > 0 else '-'}"


def next_name(path: Path) -> Path:
    """The first of ``NAME.before-1``, ``NAME.before-2``, ... that is free, for a file that is to be kept."""
    number = 1
    while (kept := path.with_name(f"{path.name}.before-{number}")).exists():
        number += 1
    return kept


def begin(setup: Setup, record: Record, device: DeviceIdentity) -> None:
    """The first entry of a record: by which tables and in which base pose it is measured.

    It is written when nothing is left that could refuse the run.
    """
    if record.begun is None:
        servos = {joint: _as_stated(setup, joint) for joint in setup.base}
        content = {"servos": servos, "device": device.name, "adapter": device.adapter, "base": dict(setup.base)}
        record.append(BEGUN, content)


def check_same(setup: Setup, record: Record, device: DeviceIdentity) -> None:
    """A record goes on only with the board, the wiring and the base pose that it began with.

    Raises:
        InputError: it would be another one.
    """
    begun = record.begun
    if begun is None:
        return
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


def stated_by(setup: Setup, begun: Any, joints: tuple[str, ...]) -> tuple[list[KnownServo], dict[str, PulseClock]]:
    """Servos and boards' clocks as they were when the record was begun."""
    servos, clocks = [], setup.clocks
    for joint in joints:
        stated = begun["servos"].get(joint)
        if stated is None:
            servos.append(setup.known(joint))
            continue
        table = PulseTable(tuple(stated["angles"]), tuple(stated["pulses"]))
        servos.append(replace(setup.known(joint), table=table))
        clocks[stated["board"]] = PulseClock(stated["oscillator_hz"], stated["prescale"])
    return servos, clocks
