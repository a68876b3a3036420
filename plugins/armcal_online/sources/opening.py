"""Sources by what a user calls them."""

from __future__ import annotations

import sys
import time
from pathlib import Path

from armcal.errors import InputError, Location
from armcal.io.udp import UDP_KINDS, parsed

from armcal_online.sources.csv_file import CsvFile
from armcal_online.sources.folder import Folder
from armcal_online.sources.row_parser import RowParser
from armcal_online.sources.source import AtEnd, Clock, Source
from armcal_online.sources.streams import Lines, Udp

KINDS = f"- (standard input), {UDP_KINDS}, a directory, or a CSV file"


def open_source(text: str, rows: RowParser, at_end: AtEnd = "stop", clock: Clock = time.time) -> Source:
    """A source by its name: ``-``, ``udp:PORT``, ``udp:HOST:PORT?from=SENDER``, a directory, or a CSV file.

    Raises:
        InputError: it is none of these, or cannot be opened.
        DataError: the header of a file cannot be used.
    """
    if text == "-":
        return Lines(sys.stdin.fileno(), rows, clock)
    if text.startswith("udp:"):
        address = parsed(text)
        if address is None:
            raise InputError("it is no address.", where=Location(text), hint=f"Give {KINDS}.")
        host, port, senders = address
        return Udp(host, port, rows, clock, senders)
    path = Path(text)
    if path.is_dir():
        return Folder(path, rows, clock)
    if not path.exists():
        raise InputError("there is no such file or directory.", where=Location(text), hint=f"Give {KINDS}.")
    return CsvFile(path, rows, at_end, clock)
