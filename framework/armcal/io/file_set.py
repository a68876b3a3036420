"""Several files written together: all of them or none, and never by mistake over what is there."""

import os
import re
import tempfile
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from armcal.errors import InputError, Location
from armcal.io.plain_files import check_output

_LEFT_BEHIND_S = 3600.0  # A file that was staged so long ago is nobody's any more


def write_new(files: Mapping[Path, bytes]) -> None:
    """Write files where none are.

    Raises:
        InputError: one is there already, or cannot be written; then none is written.
    """
    _write(files, keep=True)


def write_over(files: Mapping[Path, bytes]) -> None:
    """Write files, over those that are there.

    Raises:
        InputError: one cannot be written; then all are as they were.
    """
    _write(files, keep=False)


def require_new(paths: list[Path]) -> None:
    """Raise InputError if any of the files is there."""
    for path in paths:
        if os.path.lexists(path):
            hint = "Give another --out, or --force to overwrite it."
            raise InputError("it is there already.", where=Location(str(path)), hint=hint)


def _write(files: Mapping[Path, bytes], keep: bool) -> None:
    staged: dict[Path, Path] = {}
    kept: dict[Path, Path] = {}
    done: list[Path] = []
    place = Path()
    try:
        for place in files:
            check_output(place, InputError)
        for place, content in files.items():
            _clean_up(place)
            staged[place] = _staged(place, content)
        if keep:
            require_new(list(files))
        for place in files:
            if place.exists():
                kept[place] = _staged(place, place.read_bytes())
        for place, ready in staged.items():
            ready.replace(place)
            done.append(place)
    except BaseException as fault:  # an interrupt too must leave the earlier files
        for written in done:
            with suppress(OSError):
                if written in kept:
                    kept[written].replace(written)
                else:
                    written.unlink()
        if not isinstance(fault, OSError):
            raise
        hint = "Give --out a place that can be written."
        raise InputError(f"it cannot be written ({fault.strerror}).", where=Location(str(place)), hint=hint) from fault
    finally:
        for left in (*staged.values(), *kept.values()):
            left.unlink(missing_ok=True)


def _clean_up(place: Path) -> None:
    own = re.compile(re.escape(_prefix(place)) + r"[a-z0-9_]{8}")
    for path in place.parent.iterdir():
        with suppress(OSError):
            if own.fullmatch(path.name) and time.time() - path.stat().st_mtime > _LEFT_BEHIND_S:
                path.unlink()


def _prefix(place: Path) -> str:
    return f".armcal-{place.name}-"


def _staged(place: Path, content: bytes) -> Path:
    """The content beside its place, safely on disk."""
    descriptor, name = tempfile.mkstemp(prefix=_prefix(place), dir=place.parent)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        # What new files' rights are reduced by; it can only be read by setting it.
        mask = os.umask(0)
        os.umask(mask)
        Path(name).chmod(0o666 & ~mask)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    return Path(name)
