"""The folder of a measuring run or a recording: its journal is begun, or gone on with."""

import shutil
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal

from armcal.errors import ArmcalError, InputError, Location
from armcal.io.folder import check_folder
from armcal.io.journal.journal import Journal

JOURNAL = "journal"
Start = Literal["anew", "resume"]


@contextmanager
def opened_journal(
    folder: Path, start: Start, ours: Collection[str], header: Mapping[str, Any], noun: str, same: Mapping[str, str]
) -> Iterator[Journal]:
    """The journal in a folder.

    Args:
        folder: its place; only files that are called as ``ours`` may be there when it is begun.
        start: ``anew``, or ``resume`` what is there.
        ours: names of files.
        header: what the journal begins with.
        noun: what it is the journal of.
        same: entries of the header that must be as they were when it was begun, and what they are called.

    Raises:
        InputError: there is a journal and ``start`` is not to resume it, or there is none to resume; or it was begun
            with another header.
        JournalDamagedError: it cannot be read.
    """
    where = Location(str(folder))
    try:
        there = (folder / JOURNAL).is_dir()
    except OSError as fault:
        hint = "Give a folder that can be written."
        raise InputError(f"it cannot be used ({fault.strerror}).", where=where, hint=hint) from fault
    if there and start == "anew" and _began_nothing(folder / JOURNAL):
        shutil.rmtree(folder / JOURNAL)
        there = False
    if there and start == "anew":
        raise InputError(f"it holds a {noun} already.", where=where, hint="Give another --out, or go on by --resume.")
    if start == "resume" and not there:
        raise InputError(f"it holds no {noun} to resume.", where=where, hint="Leave --resume out to begin one.")
    if not there:
        check_folder(folder, ours)
    with Journal.open(folder / JOURNAL, header) as journal:
        for key, name in same.items():
            begun, now = journal.recovered.header.get(key), header[key]
            if journal.recovered.header and begun != now:
                lists = (
                    f" ({', '.join(begun) or 'none'}, now {', '.join(now) or 'none'})"
                    if isinstance(begun, list)
                    else ""
                )
                hint = f"Give the {name} that it was begun with, or another --out."
                raise InputError(f"it was begun with another {name}{lists}.", where=where, hint=hint)
        yield journal


def _began_nothing(folder: Path) -> bool:
    """Whether a journal has no entries: its run was refused before anything moved. One in use or damaged is kept."""
    with suppress(ArmcalError), Journal.open(folder, {}) as journal:
        return not journal.recovered.entries and journal.recovered.checkpoint is None
    return False
