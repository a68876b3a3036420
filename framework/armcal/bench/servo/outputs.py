"""What a servo calibration leaves behind: the servo file, and its results."""

from __future__ import annotations

import errno
import json
import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from armcal.bench.servo.findings import findings, is_usable
from armcal.bench.servo.fit import FittedServo
from armcal.bench.servo.outcome import Outcome
from armcal.config.servo_file import BoardSettings, ServoFile, ServoSettings, servo_file_text
from armcal.errors import InputError, Location
from armcal.online.journal.files import REAL_FILES, write_whole

RESULTS = "servo.json"


def improved(file: ServoFile, outcome: Outcome, adapter: str = "") -> ServoFile:
    """The servo file with what was found; servos whose board has another oscillator now keep their counts.

    Boards whose adapter was not stated get the one that they were measured on (empty: not known).
    """
    boards = {name: board if board.id else _changed(board, id=adapter) for name, board in file.boards.items()}
    for name in outcome.fit.oscillator_sds:
        hz = outcome.fit.clocks[name].oscillator_hz
        boards[name] = _changed(boards[name], oscillator_hz=hz)
    servos: dict[str, ServoSettings] = {}
    for joint, servo in file.servos.items():
        found = outcome.fit.servos.get(joint)
        if found is not None and found.known.trusted_sd is None and is_usable(found):
            # Counts stay what they are: the file's board may have another oscillator than that of the record.
            same = outcome.fit.clocks[servo.board].oscillator_hz / boards[servo.board].oscillator_hz
            table = {"angles": found.angles, "pulses": tuple(round(p * same, 9) for p in found.pulses)}
        elif found is not None and found.known.trusted_sd is not None:
            table = {"angles": servo.angles, "pulses": servo.pulses}
        else:
            longer = file.boards[servo.board].oscillator_hz / boards[servo.board].oscillator_hz
            table = {"angles": servo.angles, "pulses": tuple(pulse * longer for pulse in servo.pulses)}
        servos[joint] = ServoSettings.si(board=str(servo.board), channel=servo.channel, **table)
    return ServoFile(boards, servos)


def _changed(board: BoardSettings, **values: Any) -> BoardSettings:
    return BoardSettings.si(**{**board.model_dump(), **values})


def write_servo_file(path: Path, file: ServoFile) -> Path | None:
    """Put a servo file in place whole; the one before is kept beside it. Where that is, None if nothing changed.

    Raises:
        InputError: it cannot be written; the one before is as it was.
    """
    text = servo_file_text(file).encode()
    try:
        path = path.resolve()  # of a link, what it leads to
        before = path.read_bytes()
        if before == text:
            return None
        if not path.stat().st_mode & 0o222:
            raise PermissionError(errno.EACCES, "it is read-only")
        kept = _next_name(path)
        write_whole(REAL_FILES, kept, before)
        write_whole(REAL_FILES, path, text)
    except OSError as fault:
        raise InputError(
            f"it cannot be written ({fault.strerror}).",
            where=Location(str(path)),
            hint="Make it writable and give the command again: nothing measured is lost.",
        ) from fault
    return kept


def results(outcome: Outcome, changed: ServoFile) -> dict[str, Any]:
    """Everything that was found, for programs; units are in the names."""
    return {
        "servos": {joint: _servo(servo, outcome, changed) for joint, servo in outcome.fit.servos.items()},
        "boards": {
            name: {"oscillator_hz": clock.oscillator_hz, "oscillator_sd_hz": outcome.fit.oscillator_sds.get(name)}
            for name, clock in outcome.fit.clocks.items()
        },
        "compliances_rad_per_Nm": {name: {"value": v, "sd": sd} for name, (v, sd) in outcome.compliances.items()},
        "not_told": {"servos": dict(outcome.silent), "compliances": list(outcome.fit.untold)},
        "findings": findings(outcome),
    }


def write_results(folder: Path, content: Mapping[str, Any]) -> None:
    """The results beside the record.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        write_whole(REAL_FILES, folder / RESULTS, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())
    except OSError as fault:
        raise InputError(
            f"it cannot be written ({fault.strerror}).", where=Location(str(folder)), hint="Give another --out."
        ) from fault


def _servo(servo: FittedServo, outcome: Outcome, changed: ServoFile) -> dict[str, Any]:
    sweeps = outcome.sweeps[servo.known.joint]
    return {
        "board": servo.known.board,
        "knots": _knots(servo),
        "backlash_deg": None if servo.lag is None else 2 * math.degrees(servo.lag),
        "backlash_sd_deg": _number(2 * math.degrees(servo.lag_sd)),
        "scatter_deg": math.degrees(servo.scatter),
        "observations": servo.used,
        "set_aside": len(servo.outliers),
        "seen_by": sweeps.by or "somebody",
        "axis": None if sweeps.turning is None else sweeps.turning.axis.tolist(),
        "written": is_usable(servo) and changed.servos[servo.known.joint].angles == servo.angles,
    }


def _knots(servo: FittedServo) -> list[dict[str, Any]]:
    stated = servo.known.pulses_at(np.array(servo.angles))
    slopes = _slopes(servo.angles, servo.pulses)
    rows: Sequence[Any] = list(
        zip(servo.angles, servo.pulses, servo.pulse_sds, servo.told, stated, slopes, strict=True)
    )
    return [
        {
            "angle_deg": math.degrees(angle),
            "pulse_us": 1e6 * pulse,
            "sd_us": _number(1e6 * sd),
            "told": told,
            "before_us": 1e6 * float(before),
            "change_us": 1e6 * (pulse - float(before)),
            "change_deg": math.degrees((float(before) - pulse) / slope),
        }
        for angle, pulse, sd, told, before, slope in rows
    ]


def _slopes(angles: Sequence[float], pulses: Sequence[float]) -> list[float]:
    """At each knot, by its neighbours (s/rad)."""
    each = np.gradient(np.array(pulses), np.array(angles))
    return [float(slope) if abs(slope) > 1e-9 else math.nan for slope in each]


def _number(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _next_name(path: Path) -> Path:
    number = 1
    while (kept := path.with_name(f"{path.name}.before-{number}")).exists():
        number += 1
    return kept
