"""Tables whose file was cut off: an interrupted copy, a full disk.

A row that lost cells shows by their number. A last number that lost digits is a number still, which only those above it
give away. That a file ends without a line end says nothing: many editors write it so.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

from armcal.io.plain_files import refuse

_PARTS = re.compile(r"\s*[+-]?[0-9]*(?:[.,](?P<decimals>[0-9]*))?(?:[eE][+-]?(?P<exponent>[0-9]+))?\s*")
_FEWEST_OTHERS = 10


def may_be_cut(end: bytes) -> bool:
    return end[-1:] not in (b"\n", b"\r", b'"')


def whole_rows(rows: Iterable[tuple[int, list[str]]], path: Path, column: str) -> Iterator[tuple[int, list[str]]]:
    """Rows (their lines and cells) of a file without a last line end, as they come.

    Args:
        rows: to be passed on.
        path: of the file.
        column: what the last one is called.

    Raises:
        DataError: after the last row, whose last number has lost its end.
    """
    cells, line = list[str](), 0
    for line, row in rows:
        cells.append(row[-1])
        yield line, row
    if is_cut(cells):
        text = f"the file ends in {cells[-1].strip()!r} without a line end, and every other number here has more digits"
        hint = "Copy the whole file again, or remove this row. If nothing is missing, end its line."
        refuse(path, f"{text}: was the file cut off?", hint, line, column)


def is_cut(column: Sequence[str]) -> bool:
    """Whether the last number of a column has fewer digits after the decimal sign, or in the exponent, than all others.

    One fewer where zeros are written out (12.50); two where they are left out, as one number of a hundred ends in two
    zeros. A whole number tells nothing among whole numbers.
    """
    last = _PARTS.fullmatch(column[-1]) if column and column[-1].strip() else None
    others = [parts for cell in column[:-1] if cell.strip() and (parts := _PARTS.fullmatch(cell))]
    if last is None or len(others) < _FEWEST_OTHERS:
        return False
    decimals = [parts["decimals"] or "" for parts in others]
    fewest = min(map(len, decimals))
    writes_zeros = fewest == max(map(len, decimals)) and any(digits.endswith("0") for digits in decimals)
    lost = fewest - len(last["decimals"] or "")
    lost_exponent = min(len(parts["exponent"] or "") for parts in others) - len(last["exponent"] or "")
    return lost_exponent > 0 or lost > (0 if writes_zeros else 1)
