"""Whether each servo was seen to move the joint that its line of the servo file names, since that line was changed.

``armcal servo --check`` writes what it saw beside the servo file; ``armcal acquire`` drives no joint that is not there.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from armcal.base.config_text import resolve_path
from armcal.config.servo_file import ServoFile, digest, load_servo_file
from armcal.errors import InputError, Location
from armcal.io.journal.files import REAL_FILES, write_whole

from armcal_bench.bench import Bench

_WRONG = ""
"""In the place of the fingerprint of a servo that did not do what was commanded."""


def servo_file_of(bench: Bench) -> Path | None:
    """The servo file of a bench's device; None where it has none."""
    stated = (bench.settings.device or {}).get("servos")
    return resolve_path(stated) if isinstance(stated, str) else None


def record_of(servos: Path) -> Path:
    """Where the checks of a servo file are written down."""
    return servos.with_name(f"{servos.name}.checked")


def note_checked(
    servos: Path, file: ServoFile, right: Iterable[str], others: Iterable[str], seen: Mapping[str, Any]
) -> None:
    """Write down which joints were seen to turn as commanded, and which were not.

    Args:
        servos: the servo file's path.
        file: as it was when they were seen.
        right: the joints seen to turn.
        others: joints that were tried and did not, or cannot be distinguished from another one.
        seen: ``adapter``, ``by`` (``tracker`` or ``somebody``) and ``at`` (unix s).

    Raises:
        InputError: it cannot be written.
    """
    wrong = {joint: {"servo": _WRONG, **seen} for joint in others}
    _write(servos, {**_read(servos), **wrong, **{joint: {"servo": _digest(file, joint), **seen} for joint in right}})


def carry_over(servos: Path, before: ServoFile, after: ServoFile) -> None:
    """What was checked stays so in a file whose numbers armcal itself has changed; see ``note_checked``."""
    kept = _read(servos)
    same = {joint: entry for joint, entry in kept.items() if _is_of(entry, before, joint)}
    if same:
        _write(servos, {**kept, **{joint: {**same[joint], "servo": _digest(after, joint)} for joint in same}})


def check_wiring(bench: Bench, joints: Iterable[str], adapter: str = "") -> None:
    """Whether all joints were seen to turn by their lines of the servo file, on this adapter (empty: not known).

    Raises:
        InputError: one was not, or its line or the adapter is another one since.
    """
    if (servos := servo_file_of(bench)) is None:
        return
    file, checks = load_servo_file(servos), _read(servos)
    why = {}
    for joint in joints:
        entry = checks.get(joint)
        checked_on = str((entry or {}).get("adapter", ""))
        if entry is None or joint not in file.servos:
            why[joint] = "never checked"
        elif entry.get("servo") == _WRONG:
            why[joint] = "the last check did not find it right"
        elif not _is_of(entry, file, joint):
            why[joint] = "changed since it was checked"
        elif adapter and checked_on and adapter != checked_on:
            why[joint] = f"checked on the adapter {checked_on}"
    if not why:
        return
    alike = {reason: ", ".join(joint for joint in why if why[joint] == reason) for reason in why.values()}
    named = "; ".join(f"{joints_of}: {reason}" for reason, joints_of in alike.items())
    raise InputError(
        f"found servos that were not checked to move their joint ({named}); nothing was moved.",
        where=Location(str(servos)),
        hint="With exchanged plugs the wrong joint moves: check them with armcal servo CONFIG --check, or "
        "give --unchecked to drive them without a check.",
    )


def _is_of(entry: Mapping[str, Any], file: ServoFile, joint: str) -> bool:
    return joint in file.servos and entry.get("servo") == _digest(file, joint)


def _digest(file: ServoFile, joint: str) -> str:
    return digest({joint: file.calibrated(joint)})


def _read(servos: Path) -> dict[str, Any]:
    """Entries by joint; a record that is damaged says nothing, so that its joints are checked again."""
    try:
        content = json.loads(record_of(servos).read_bytes())
    except (OSError, ValueError):
        return {}
    return {joint: e for joint, e in content.items() if isinstance(e, dict)} if isinstance(content, dict) else {}


def _write(servos: Path, entries: Mapping[str, Any]) -> None:
    path = record_of(servos)
    try:
        write_whole(REAL_FILES, path, (json.dumps(entries, indent=2) + "\n").encode())
    except OSError as fault:
        raise InputError(
            f"it cannot be written ({fault.strerror}), so that what was checked is not known later.",
            where=Location(str(path)),
            hint="Make the folder of the servo file writable, and check again.",
        ) from fault
