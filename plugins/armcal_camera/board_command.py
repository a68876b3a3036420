"""``armcal board``: a board to print, and its settings for a configuration."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import yaml
from armcal.cli.common import Console, speaking
from armcal.errors import InputError
from armcal.io.file_set import write_new, write_over
from pydantic import ValidationError

from armcal_camera.board import Board, BoardFile
from armcal_camera.sheet import PAPERS, pdf, sheet_of, svg

_HEAD = "# Measure the printed board, and write the sizes that you measured here.\n"


@click.group()
def board() -> None:
    """Write a board to print (PDF and SVG, to scale), and its settings."""


def _output(command: Any) -> Any:
    """The options of every kind of board."""
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
