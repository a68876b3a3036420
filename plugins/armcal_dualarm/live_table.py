"""The rows of a log that is being written: the same columns as those of a finished one, line by line."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from armcal.base.domains import Array
from armcal.errors import DataError

from armcal_dualarm.log_table import Column, cells_of, delimiter_of, is_header, number_of, place_of


@dataclass(frozen=True)
class Row:
    """Chosen cells of a row: numbers (NaN where empty) and texts."""

    numbers: Array
    texts: tuple[str, ...]


@dataclass(frozen=True)
class _Form:
    """What the first row has shown; ``header`` is empty if it held numbers."""

    delimiter: str
    header: tuple[str, ...]
    count: int
    places: tuple[int, ...]


class LiveTable:
    """Reads rows as ``log_table.read_table`` does.

    Args:
        source: what the log is called in messages.
        delimiter: or ``auto``.
        numbers, texts: the columns to read.
    """

    def __init__(self, source: Path, delimiter: str, numbers: Sequence[Column], texts: Sequence[Column]) -> None:
        self._source, self._delimiter = source, delimiter
        self._numbers, self._texts = list(numbers), list(texts)
        self._form: _Form | None = None

    def row(self, line: bytes) -> Row | None:
        """The row in a line; None for a blank one, or the header.

        Raises:
            DataError: it cannot be read.
        """
        try:
            text = line.decode("utf-8-sig")
        except UnicodeDecodeError as fault:
            raise DataError("found bytes that are not UTF-8 text.") from fault
        if not text.strip():
            return None
        if "\0" in text:
            raise DataError("found a NUL byte, expected text.")
        if self._form is None:
            delimiter = delimiter_of(text) if self._delimiter == "auto" else self._delimiter
            cells = cells_of(text, delimiter)
            header = tuple(cells) if is_header(cells, self._numbers, self._texts) else ()
            places = [place_of(self._source, None, header, len(cells), c) for c in (*self._numbers, *self._texts)]
            self._form = _Form(delimiter, header, len(cells), tuple(places))
        form = self._form
        cells = cells_of(text, form.delimiter)
        if form.header and tuple(cells) == form.header:
            return None
        if len(cells) != form.count:
            raise DataError(f"found {len(cells)} cells, expected {form.count} as in the first row.")
        chosen = [cells[place] for place in form.places]
        count = len(self._numbers)
        named = zip(chosen[:count], self._numbers, strict=True)
        numbers = [number_of(self._source, None, cell, f"column {name}") for cell, name in named]
        return Row(np.array(numbers), tuple(chosen[count:]))
