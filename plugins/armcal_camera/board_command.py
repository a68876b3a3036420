"""``armcal board``: a board as a page to print (PDF and SVG, to scale, with a ruler), and its settings."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any
from xml.sax.saxutils import escape

import click
import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.cli.common import Console, speaking
from armcal.errors import InputError
from armcal.io.plain_files import write_new, write_over
from pydantic import ValidationError

from armcal_camera.board import Aprilgrid, Board, BoardFile, Charuco, Chessboard, Tag, dark_rectangles, outline

PAPERS = MappingProxyType(
    {
        "a4": (210.0, 297.0),
        "a3": (297.0, 420.0),
        "a2": (420.0, 594.0),
        "a1": (594.0, 841.0),
        "a0": (841.0, 1189.0),
        "letter": (215.9, 279.4),
    }
)
"""Width and height (mm)."""
RULER_MM = 100.0
_MARGIN_MM = 8.0
_FOOT_MM = 18.0
_TEXT_MM = 3.2
_POINTS_PER_MM = 72 / 25.4
_TICK_MM, _LINE_MM = 3.0, 0.3
_HEAD = "# Measure the printed board, and write the sizes that you measured here.\n"


@click.group()
def board() -> None:
    """Write a board to print (PDF and SVG, to scale), and its settings."""


def _output(command: Any) -> Any:
    paper = click.option("--paper", type=click.Choice(list(PAPERS)), default="a4", show_default=True, help="Its size.")
    out = click.option(
        "--out", required=True, type=click.Path(path_type=Path), help="The files' name; .pdf, .svg and .yaml are added."
    )
    force = click.option("--force", is_flag=True, help="Overwrite files that are there.")
    return paper(out(force(speaking(command))))


def _counts(command: Any) -> Any:
    columns = click.option("--columns", required=True, type=int, help="Inner corners, squares or tags along x.")
    rows = click.option("--rows", required=True, type=int, help="Inner corners, squares or tags along y.")
    return columns(rows(command))


_SQUARE = click.option("--square-mm", required=True, type=float, help="Edge of a square.")
_TAG = click.option("--tag-mm", required=True, type=float, help="Edge of a tag, its black border included.")
_FIRST = click.option("--first-id", default=0, show_default=True, help="Id of the first tag; boards must differ.")
_FAMILY = click.option("--family", default="36h11", show_default=True, help="Of AprilTags, or DICT_5X5_100 and such.")


@board.command()
@_counts
@_SQUARE
@_output
def chessboard(console: Console, paper: str, out: Path, force: bool, **sizes: Any) -> None:
    """A chessboard of --columns x --rows inner corners: simple, and must be seen whole."""
    _write(console, "chessboard", sizes, paper, out, force)


@board.command()
@_counts
@_SQUARE
@click.option("--marker-mm", type=float, help="Edge of a tag [default: three quarters of a square].")
@click.option("--dictionary", default="DICT_5X5_100", show_default=True, help="Of tags, by OpenCV's name.")
@_FIRST
@_output
def charuco(console: Console, paper: str, out: Path, force: bool, **sizes: Any) -> None:
    """A ChArUco board of --columns x --rows squares: a part of it will do."""
    sizes["marker_mm"] = sizes["marker_mm"] or 0.75 * sizes["square_mm"]
    _write(console, "charuco", sizes, paper, out, force)


@board.command()
@_counts
@_TAG
@click.option("--spacing-mm", type=float, help="Between tags [default: 0.3 of a tag].")
@_FAMILY
@_FIRST
@_output
def aprilgrid(console: Console, paper: str, out: Path, force: bool, **sizes: Any) -> None:
    """A grid of --columns x --rows AprilTags, numbered as Kalibr does: a part of it will do."""
    sizes["spacing_mm"] = sizes["spacing_mm"] or 0.3 * sizes["tag_mm"]
    _write(console, "aprilgrid", sizes, paper, out, force)


@board.command()
@click.option("--id", required=True, type=int, help="Which tag of the family.")
@_TAG
@_FAMILY
@_output
def tag(console: Console, paper: str, out: Path, force: bool, **sizes: Any) -> None:
    """A single tag."""
    _write(console, "tag", sizes, paper, out, force)


def _write(console: Console, kind: str, sizes: dict[str, Any], paper: str, out: Path, force: bool) -> None:
    settings = {"type": kind, **sizes}
    try:
        made: Board = BoardFile.model_validate({"board": settings}).board
        sheet = sheet_of(made, paper)
    except ValidationError as fault:
        texts = [f"{error['loc'][-1]}: {error['msg'].removeprefix('Value error, ')}" for error in fault.errors()]
        raise InputError("; ".join(texts), hint="See armcal board --help.") from fault
    except ValueError as fault:
        raise InputError(f"{fault}.") from fault
    text = _HEAD + yaml.safe_dump({"board": settings}, sort_keys=False)
    pages = {".pdf": pdf(sheet), ".svg": svg(sheet).encode(), ".yaml": text.encode()}
    files = {out.with_name(out.name + suffix): content for suffix, content in pages.items()}
    (write_over if force else write_new)(files)
    console.result({"board": settings, "points": len(made.points), "files": [str(file) for file in files]})
    for file in files:
        console.line(str(file))
    width, height = (1000 * extent for extent in made.extent)
    console.line(
        f"Print the PDF at 100 %. Its line must be 100 mm long, the board {width:g} x {height:g} mm: measure both."
    )


@dataclass(frozen=True)
class Sheet:
    """A page, in millimetres from its upper left corner.

    Attributes:
        width, height: of the paper.
    """

    width: float
    height: float
    dark: Array  # rectangles of the board (N x 4: left, top, width, height)
    ruler: Array  # the same of the ruler's lines
    texts: Sequence[tuple[float, float, str]]  # left, baseline and words of each line


def sheet_of(board: Board, paper: str) -> Sheet:
    """The page of a board, upright or lying, whichever has room.

    Raises:
        ValueError: the paper is too small; says what fits.
        PluginError: the board has tags, and OpenCV is not there.
    """
    size = 1000 * np.array(board.extent)
    quiet = 0.0 if isinstance(board, Chessboard | Charuco) else 100 * board.step  # white around tags
    pages = [page for page in (PAPERS[paper], PAPERS[paper][::-1]) if _fits(size + 2 * quiet, page)]
    if not pages:
        room = " or ".join(f"{w - 2 * _MARGIN_MM:g} x {h - 2 * _MARGIN_MM - _FOOT_MM:g}" for w, h in _both(paper))
        larger = [name for name in PAPERS if any(_fits(size + 2 * quiet, page) for page in _both(name))]
        mend = f"take --paper {larger[0]}, or a smaller board" if larger else "take a smaller board"
        needed = size + 2 * quiet
        text = f"the board needs {needed[0]:g} x {needed[1]:g} mm, and {paper} has room for {room} mm"
        raise ValueError(f"{text}: {mend}")
    width, height = pages[0]
    corner = np.array([width - size[0], height - _FOOT_MM - size[1]]) / 2
    low, rectangles = outline(board), 1000 * dark_rectangles(board)
    left, wide = rectangles[:, 0] - 1000 * low[0], rectangles[:, 2] - rectangles[:, 0]
    is_upwards = isinstance(board, Aprilgrid)  # y of these boards points up, and that of pages down
    top = 1000 * low[3] - rectangles[:, 3] if is_upwards else rectangles[:, 1] - 1000 * low[1]
    dark = np.stack([corner[0] + left, corner[1] + top, wide, rectangles[:, 3] - rectangles[:, 1]], axis=1)
    foot = height - _MARGIN_MM
    texts = [
        (_MARGIN_MM, foot - 12.8, _what(board)),
        (
            _MARGIN_MM,
            foot - 8.6,
            f"Print at 100 %, not fitted to the page. The line is {RULER_MM:g} mm long: measure it.",
        ),
        (
            _MARGIN_MM,
            foot - 1.4 - _TICK_MM,
            f"Then measure the board: {size[0]:g} mm wide, {size[1]:g} mm high. "
            "Write what you measure into board.yaml.",
        ),
    ]
    ticks = (
        _MARGIN_MM + np.arange(11) * (RULER_MM - _LINE_MM) / 10
    )  # the outer edges of the first and last are its ends
    rows = [(tick, foot - _TICK_MM, _LINE_MM, _TICK_MM) for tick in ticks]
    return Sheet(width, height, dark, np.array([(_MARGIN_MM, foot - _LINE_MM, RULER_MM, _LINE_MM), *rows]), texts)


def _both(paper: str) -> tuple[tuple[float, float], ...]:
    return PAPERS[paper], PAPERS[paper][::-1]


def _fits(size: Array, page: Sequence[float]) -> bool:
    room = np.array(page) - 2 * _MARGIN_MM - np.array([0.0, _FOOT_MM])
    return bool((size <= room + 1e-9).all())


def _what(board: Board) -> str:
    """The board in words."""
    if isinstance(board, Chessboard):
        return f"armcal: chessboard, {board.columns} x {board.rows} inner corners, square {1000 * board.square:g} mm"
    if isinstance(board, Charuco):
        sizes = f"square {1000 * board.square:g} mm, marker {1000 * board.marker:g} mm"
        tags = f"{board.dictionary} from {board.first_id}"
        return f"armcal: ChArUco, {board.columns} x {board.rows} squares, {sizes}, {tags}"
    if isinstance(board, Aprilgrid):
        sizes = f"tag {1000 * board.tag:g} mm, spacing {1000 * board.spacing:g} mm"
        return f"armcal: AprilTag grid, {board.columns} x {board.rows}, {sizes}, {board.family} from {board.first_id}"
    assert isinstance(board, Tag)
    return f"armcal: tag {board.id} of {board.family}, edge {1000 * board.tag:g} mm"


def svg(sheet: Sheet) -> str:
    """The page as SVG."""
    paths = [
        "".join(f"M{x:.4f} {y:.4f}h{w:.4f}v{h:.4f}h{-w:.4f}z" for x, y, w, h in r) for r in (sheet.dark, sheet.ruler)
    ]
    texts = [
        f'<text x="{x:g}" y="{y:g}" font-family="Helvetica, sans-serif" font-size="{_TEXT_MM}">{escape(t)}</text>'
        for x, y, t in sheet.texts
    ]
    size = f'width="{sheet.width:g}mm" height="{sheet.height:g}mm" viewBox="0 0 {sheet.width:g} {sheet.height:g}"'
    lines = [
        f'<svg xmlns="http://www.w3.org/2000/svg" {size}>',
        '<rect width="100%" height="100%" fill="white"/>',
        *(f'<path d="{path}"/>' for path in paths),
        *texts,
        "</svg>",
    ]
    return "\n".join([*lines, ""])


def pdf(sheet: Sheet) -> bytes:
    """The page as PDF 1.4; its user space is millimetres after the first operator."""
    parts = [f"{_POINTS_PER_MM:.9f} 0 0 {_POINTS_PER_MM:.9f} 0 0 cm", "0 g"]
    for rectangles in (sheet.dark, sheet.ruler):
        parts += [f"{x:.4f} {sheet.height - y - h:.4f} {w:.4f} {h:.4f} re" for x, y, w, h in rectangles]
        parts.append("f")
    for x, y, text in sheet.texts:
        words = text.replace("\\", r"\\").replace("(", r"\(").replace(")", r"\)")
        parts.append(f"BT /F {_TEXT_MM} Tf {x:g} {sheet.height - y:.4f} Td ({words}) Tj ET")
    content = "\n".join(parts)
    box = f"0 0 {sheet.width * _POINTS_PER_MM:.4f} {sheet.height * _POINTS_PER_MM:.4f}"
    preferences = "/ViewerPreferences << /PrintScaling /None >>"
    objects = [
        f"<< /Type /Catalog /Pages 2 0 R {preferences} >>",
        "<< /Type /Pages /Kids [3 0 R] /Count 1 >>",
        f"<< /Type /Page /Parent 2 0 R /MediaBox [{box}] /Contents 4 0 R /Resources << /Font << /F 5 0 R >> >> >>",
        f"<< /Length {len(content)} >>\nstream\n{content}\nendstream",
        "<< /Type /Font /Subtype /Type1 /BaseFont /Helvetica >>",
    ]
    text, places = "%PDF-1.4\n", []
    for number, item in enumerate(objects, start=1):
        places.append(len(text))
        text += f"{number} 0 obj\n{item}\nendobj\n"
    table = "".join(f"{place:010d} 00000 n \n" for place in places)
    end = f"trailer\n<< /Size {len(objects) + 1} /Root 1 0 R >>\nstartxref\n{len(text)}\n%%EOF\n"
    return f"{text}xref\n0 {len(objects) + 1}\n0000000000 65535 f \n{table}{end}".encode("ascii")
