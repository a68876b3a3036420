"""Directories that results are left in: only ours are written to, and nothing in them is overwritten."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path

from armcal.errors import InputError, Location

EARLIER = "earlier"
_STAGING = ".armcal-"


def check_folder(folder: Path, ours: Collection[str]) -> None:
    """Refuse a place that is not ours to write to.

    Raises:
        InputError: a file, or a directory with anything that is not called as ours are.
    """
    where = Location(str(folder))
    try:
        is_folder = folder.is_dir()
        is_other = folder.exists() and not is_folder
        names = {path.name for path in folder.iterdir()} if is_folder else set()
    except OSError as fault:
        raise InputError(f"it cannot be used ({fault.strerror}).", where=where, hint="Give another --out.") from fault
    if is_other:
        raise InputError("it is a file, expected a directory.", where=where, hint="Give another --out.")
    foreign = sorted(name for name in names - {*ours, EARLIER} if not name.startswith(_STAGING))
    if foreign:
        raise InputError(
            f"it holds files that are not of this kind of run ({', '.join(foreign[:3])}).",
            where=where,
            hint="Give --out a new or empty directory, or one of an earlier run.",
        )


def place(folder: Path, texts: Mapping[str, str], ours: Collection[str]) -> None:
    """Write files whole, in order, the last one last; those of an earlier run move to ``earlier/N`` first.

    Raises:
        InputError: the folder cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=_STAGING, dir=folder))
        for name, text in texts.items():
            _write_durably(staging / name, text)
        _keep_earlier(folder, ours)
        for name in texts:
            os.replace(staging / name, folder / name)
        shutil.rmtree(staging)
    except OSError as fault:
        raise InputError(
            f"it cannot be written ({fault}).",
            where=Location(str(folder)),
            hint="Give --out a writable directory.",
        ) from fault


def _write_durably(path: Path, text: str) -> None:
    with path.open("w", encoding="utf-8", newline="") as file:
        file.write(text)
        file.flush()
        os.fsync(file.fileno())


def _keep_earlier(folder: Path, ours: Collection[str]) -> None:
    present = [path for name in ours if (path := folder / name).exists()]
    if not present:
        return
    number = 1
    while (folder / EARLIER / str(number)).exists():
        number += 1
    kept = folder / EARLIER / str(number)
    kept.mkdir(parents=True)
    for path in present:
        os.replace(path, kept / path.name)
