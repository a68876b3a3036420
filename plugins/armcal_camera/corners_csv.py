"""Corners as CSV in long form, for those who detect them with other programs: ``image,board,point,u_px,v_px``.

``board`` counts from 0, and may be left out where there is one; ``point`` counts each board's points from 0. The
centre of an image's first pixel is at 0, 0.
"""

import csv
import io
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from armcal.base.arrays import Array
from armcal.io.cells import CellFault, read_cell
from armcal.io.plain_files import input_bytes, refuse, text_of

from armcal_camera.board import Board

COLUMNS = ("image", "board", "point", "u_px", "v_px")
_MAX_BYTES = 512 * 1024**2
_LAYOUT = f"Give a header {','.join(COLUMNS)} and a line a corner."


def read_corners(path: Path, boards: Sequence[Board]) -> tuple[dict[str, Array], bytes]:
    """The corners of each image (K x 2 over all boards, px), in the order in which images appear; and the file.

    Raises:
        DataError: with line and column.
    """
    content = input_bytes(path, _MAX_BYTES, "a CSV file of corners")
    rows = csv.reader(io.StringIO(text_of(content, path, "Save it as CSV text in UTF-8.")))
    header = [cell.strip() for cell in next(rows, [])]
    missing = [name for name in COLUMNS if name not in header and (name != "board" or len(boards) > 1)]
    if missing:
        text = f"found the columns {', '.join(header) or 'none'}, expected {', '.join(missing)} as well."
        refuse(path, text, _LAYOUT, 1)
    at = {name: header.index(name) for name in COLUMNS if name in header}
    starts = np.cumsum([0, *(len(board.points) for board in boards)])
    corners: dict[str, Array] = {}
    for cells in rows:
        if not any(cell.strip() for cell in cells):
            continue
        line = rows.line_num
        if len(cells) != len(header):
            refuse(path, f"found {len(cells)} cells, expected {len(header)} as in the header.", _LAYOUT, line)
        board = _count(path, line, "board", cells[at["board"]], len(boards)) if "board" in at else 0
        point = _count(path, line, "point", cells[at["point"]], len(boards[board].points))
        own = corners.setdefault(cells[at["image"]].strip(), np.full((starts[-1], 2), np.nan))
        place = own[starts[board] + point]
        if not np.isnan(place).all():
            refuse(path, f"found the point {point} of this image again.", "Remove one of the lines.", line, "point")
        place[:] = [_pixel(path, line, name, cells[at[name]]) for name in ("u_px", "v_px")]
    if not corners:
        refuse(path, "found a header and no corners.", _LAYOUT)
    return corners, content


def corners_text(corners: Mapping[str, Array], boards: Sequence[Board]) -> str:
    """The file that says the same; corners that were not seen are left out."""
    places = [(number, point) for number, board in enumerate(boards) for point in range(len(board.points))]
    lines = [",".join(COLUMNS)]
    for image, pixels in corners.items():
        shown = f'"{image}"' if "," in image else image
        lines += [
            f"{shown},{board},{point},{u:.5f},{v:.5f}"
            for (board, point), (u, v) in zip(places, pixels, strict=True)
            if math.isfinite(u) and math.isfinite(v)
        ]
    return "\n".join([*lines, ""])


def _count(path: Path, line: int, column: str, cell: str, number: int) -> int:
    text = cell.strip()
    if not (text.isascii() and text.isdecimal() and int(text) < number):
        message = f"found {text[:40]!r}, expected a whole number from 0 to {number - 1}."
        refuse(path, message, "Check which board of the measurement it is, and count from 0.", line, column)
    return int(text)


def _pixel(path: Path, line: int, column: str, cell: str) -> float:
    value = read_cell(cell)
    if isinstance(value, CellFault):
        refuse(path, value.text, value.hint, line, column)
    if math.isinf(value):
        refuse(path, "found an infinite number, expected pixels.", "Leave the line out.", line, column)
    return value
