"""Lists of record ids: a CSV with one column, or one called pose_id or id."""

import csv
from pathlib import Path

from armcal.io.plain_files import input_bytes, refuse, text_of

MAX_BYTES = 1 << 26
_HEADER = "Give a header pose_id and an id a line."


def read_ids(path: Path) -> tuple[str, ...]:
    """The ids in a file, in its order.

    Raises:
        DataError: no such file, no text, no ids, or an id stands twice.
    """
    text = text_of(input_bytes(path, MAX_BYTES, "a list of ids"), path, "Save it as CSV text in UTF-8.")
    rows = [row for row in csv.reader(text.splitlines()) if any(cell.strip() for cell in row)]
    if not rows:
        refuse(path, "it is empty.", _HEADER)
    header = [cell.strip().lower() for cell in rows[0]]
    column = next((header.index(name) for name in ("pose_id", "id") if name in header), None)
    if column is None:
        refuse(path, f"found the columns {', '.join(rows[0])}.", _HEADER)
    ids = [row[column].strip() for row in rows[1:] if len(row) > column]
    if not ids:
        refuse(path, "it lists no ids.", "Give an id a line below the header.")
    twice = sorted({record for record in ids if ids.count(record) > 1}) if len(set(ids)) < len(ids) else []
    if twice:
        refuse(path, f"the id {twice[0]} stands twice.", "List each record once.")
    return tuple(ids)
