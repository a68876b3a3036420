"""``armcal board``: a board as a page to print (PDF and SVG, to scale, with a ruler), and its settings."""

from io import BytesIO
from pathlib import Path
from types import MappingProxyType
from typing import Any

import click
import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.cli.common import Console, speaking
from armcal.errors import InputError
from armcal.io.plain_files import write_new, write_over
from armcal.plugins import library
from pydantic import ValidationError

from armcal_camera.board import Aprilgrid, Board, BoardFile, Charuco, Chessboard, dark_rectangles, outline

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
_TEXT_POINTS = 9
_INCH_MM = 25.4
_TICK_MM, _LINE_MM = 3.0, 0.3
_HEAD = "# Measure the printed board, and write the sizes that you measured here.\n"
KINDS = ("chessboard", "charuco", "aprilgrid", "tag")


@click.command()
@click.argument("kind", type=click.Choice(KINDS))
@click.option("--columns", type=int, help="Inner corners of a chessboard, else squares or tags, along x.")
@click.option("--rows", type=int, help="The same along y.")
@click.option("--square-mm", type=float, help="Edge of a square (chessboard, charuco).")
@click.option("--marker-mm", type=float, help="Edge of a tag (charuco) [default: three quarters of a square].")
@click.option("--tag-mm", type=float, help="Edge of a tag, its black border included (aprilgrid, tag).")
@click.option("--spacing-mm", type=float, help="Between tags (aprilgrid) [default: 0.3 of a tag].")
@click.option("--dictionary", help="Of tags, by OpenCV's name (charuco) [default: DICT_5X5_100].")
@click.option("--family", help="Of AprilTags, or DICT_5X5_100 and such (aprilgrid, tag) [default: 36h11].")
@click.option("--first-id", type=int, help="Id of the first tag; boards must differ (charuco, aprilgrid) [default: 0].")
@click.option("--id", type=int, help="Which tag of the family (tag).")
@click.option("--paper", type=click.Choice(list(PAPERS)), default="a4", show_default=True, help="Its size.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Name; .pdf, .svg and .yaml are added.")
@click.option("--force", is_flag=True, help="Overwrite files that are there.")
@speaking
def board(console: Console, kind: str, paper: str, out: Path, force: bool, **sizes: Any) -> None:
    """Write a board to print (PDF and SVG, to scale), and its settings.

    A chessboard must be seen whole; of charuco and aprilgrid, which is numbered as Kalibr does, a part will do.
    """
    settings = {"type": kind, **{name: size for name, size in sizes.items() if size is not None}}
    for of, name, share in (("charuco", "marker_mm", 0.75), ("aprilgrid", "spacing_mm", 0.3)):
        edge = settings.get("square_mm", settings.get("tag_mm"))
        if kind == of and edge is not None:
            settings.setdefault(name, share * edge)
    try:
        made: Board = BoardFile.model_validate({"board": settings}).board
        pages = pages_of(made, paper)
    except ValidationError as fault:
        texts = [f"{error['loc'][-1]}: {error['msg'].removeprefix('Value error, ')}" for error in fault.errors()]
        raise InputError("; ".join(texts), hint="See armcal board --help.") from fault
    except ValueError as fault:
        raise InputError(f"{fault}.") from fault
    text = _HEAD + yaml.safe_dump({"board": settings}, sort_keys=False)
    named = {**pages, ".yaml": text.encode()}
    files = {out.with_name(out.name + suffix): content for suffix, content in named.items()}
    (write_over if force else write_new)(files)
    console.result({"board": settings, "points": len(made.points), "files": [str(file) for file in files]})
    for file in files:
        console.line(str(file))
    if isinstance(made, Chessboard) and (made.columns + made.rows) % 2 == 0:
        text = f"a chessboard of {made.columns} x {made.rows} inner corners is the same upside down"
        console.warn(f"{text}: take one count even and the other odd, as 9 x 6.")
    width, height = (1000 * extent for extent in made.layout.extent)
    console.line(
        f"Print the PDF at 100 %. Its line must be 100 mm long, the board {width:g} x {height:g} mm: measure both."
    )


def pages_of(board: Board, paper: str) -> dict[str, bytes]:
    """The page of a board as PDF and SVG, upright or lying, whichever has room; to scale, with a ruler."""
    width, height = page_of(board, paper)
    figure = library("matplotlib.figure", "printing a board").Figure((width / _INCH_MM, height / _INCH_MM))
    axes = figure.add_axes((0, 0, 1, 1), xlim=(0, width), ylim=(height, 0))  # a unit is a millimetre
    axes.axis("off")
    size, low = 1000 * np.array(board.layout.extent), 1000 * outline(board)[:2]
    corner = np.array([width - size[0], height - _FOOT_MM - size[1]]) / 2
    ends = 1000 * dark_rectangles(board).reshape(-1, 2, 2) - low
    if isinstance(board, Aprilgrid):  # y of these boards points up, and that of pages down
        ends[:, :, 1] = size[1] - ends[:, ::-1, 1]
    _fill(axes, corner + ends)
    foot = height - _MARGIN_MM
    # The outer edges of the first and the last tick are the ruler's ends.
    ticks = _MARGIN_MM + np.arange(11) * (RULER_MM - _LINE_MM) / 10
    line = [[(_MARGIN_MM, foot - _LINE_MM), (_MARGIN_MM + RULER_MM, foot)]]
    _fill(axes, np.array(line + [[(tick, foot - _TICK_MM), (tick + _LINE_MM, foot)] for tick in ticks]))
    stated = (
        f"{name.removesuffix('_m')} {1000 * value:g} mm" if name.endswith("_m") else f"{name} {value}"
        for name, value in board.to_config().items()
    )
    lines = (
        (12.8, f"armcal: {', '.join(stated)}"),
        (8.6, f"Print at 100 %, not fitted to the page. The line is {RULER_MM:g} mm long: measure it."),
        (
            1.4 + _TICK_MM,
            f"Then measure the board: {size[0]:g} mm wide, {size[1]:g} mm high. "
            "Write what you measure into board.yaml.",
        ),
    )
    for up, text in lines:
        axes.text(_MARGIN_MM, foot - up, text, fontsize=_TEXT_POINTS)
    pages = {}
    for suffix, date in ((".pdf", "CreationDate"), (".svg", "Date")):
        content = BytesIO()
        figure.savefig(content, format=suffix[1:], metadata={date: None})
        pages[suffix] = content.getvalue()
    return pages


def _fill(axes: Any, rectangles: Array) -> None:
    """Black rectangles (N x 2 x 2: ends x, y; mm), as one path: no seam between neighbours."""
    paths, patches = (library(f"matplotlib.{name}", "printing a board") for name in ("path", "patches"))
    (left, top), (right, bottom) = rectangles[:, 0].T, rectangles[:, 1].T
    corners = np.array([(left, right, right, left), (top, top, bottom, bottom)]).transpose(2, 1, 0)
    path = paths.Path.make_compound_path_from_polys(corners)
    axes.add_patch(patches.PathPatch(path, facecolor="black", linewidth=0))


def page_of(board: Board, paper: str) -> tuple[float, float]:
    """Width and height of the page (mm), upright where there is room so."""
    quiet = 0.0 if isinstance(board, Chessboard | Charuco) else 100 * board.layout.step  # white around tags
    needed = 1000 * np.array(board.layout.extent) + 2 * quiet
    border = np.array([2 * _MARGIN_MM, 2 * _MARGIN_MM + _FOOT_MM])
    fitting = {
        name: page
        for name, upright in PAPERS.items()
        for page in (upright[::-1], upright)
        if (needed <= np.array(page) - border + 1e-9).all()
    }
    if paper in fitting:
        return fitting[paper]
    room = " or ".join(f"{w:g} x {h:g}" for w, h in np.array([PAPERS[paper], PAPERS[paper][::-1]]) - border)
    larger = next(iter(fitting), None)
    mend = f"take --paper {larger}, or a smaller board" if larger else "take a smaller board"
    text = f"the board needs {needed[0]:g} x {needed[1]:g} mm, and {paper} has room for {room} mm"
    raise ValueError(f"{text}: {mend}")
