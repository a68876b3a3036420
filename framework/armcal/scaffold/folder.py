"""Folders that appear whole or not at all."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from armcal.errors import InputError, Location


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """A folder beside ``folder`` that takes its place at the end; on any fault nothing is left of it.

    Raises:
        InputError: something is there already, or the place cannot be written.
    """
    where = Location(str(folder))
    if folder.exists() or folder.is_symlink():
        raise InputError("it is there already.", where=where, hint="Give another --out, or move it away.")
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as fault:
        raise _unwritable(folder, fault) from fault
    try:
        yield place
        place.chmod(0o755)
        place.rename(folder)
    except OSError as fault:
        raise _unwritable(folder, fault) from fault
    finally:
        shutil.rmtree(place, ignore_errors=True)


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    """Texts by their path in a folder, in UTF-8 with plain line ends."""
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")


def _unwritable(folder: Path, fault: OSError) -> InputError:
    return InputError(
        f"it cannot be written ({fault.strerror or fault}).",
        where=Location(str(folder)),
        hint="Give --out a place that can be written.",
    )
