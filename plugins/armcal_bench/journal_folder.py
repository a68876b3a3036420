"""The folder of a measuring run or a recording: its journal is begun, or gone on with."""

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from armcal.errors import InputError, Location
from armcal.io.journal import Journal, has_journal
from armcal.io.plain_files import check_folder

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
        DataError: it cannot be read.
    """
    where = Location(str(folder))
    is_there = has_journal(folder)
    if start == "resume" and not is_there:
        raise InputError(f"it holds no {noun} to resume.", where=where, hint="Leave --resume out to begin one.")
    if not is_there:
        check_folder(folder, ours)
    with Journal(folder, header) as journal:
        if start == "anew" and not journal.is_new:  # a run that was refused before anything moved left an empty one
            hint = "Give another --out, or go on by --resume."
            raise InputError(f"it holds a {noun} already.", where=where, hint=hint)
        for key, name in same.items():
            begun, now, lists = journal.header.get(key), header[key], ""
            if begun != now:
                if isinstance(begun, list):
                    lists = f" ({', '.join(begun) or 'none'}, now {', '.join(now) or 'none'})"
                hint = f"Give the {name} that it was begun with, or another --out."
                raise InputError(f"it was begun with another {name}{lists}.", where=where, hint=hint)
        yield journal
