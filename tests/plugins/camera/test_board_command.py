"""``armcal board``: pages to print are to scale, and their boards are found again."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from armcal.base.arrays import Array
from click.testing import CliRunner

pytest.importorskip("cv2")
import cv2
from armcal.errors import InputError
from armcal_camera.board import Board, read_board
from armcal_camera.board_command import board as command
from armcal_camera.detection import Grey, detect

KINDS = {
    "chessboard": ("--columns", "9", "--rows", "6", "--square-mm", "25"),
    "charuco": ("--columns", "7", "--rows", "5", "--square-mm", "30"),
    "aprilgrid": ("--columns", "4", "--rows", "3", "--tag-mm", "40", "--first-id", "5"),
    "tag": ("--id", "3", "--tag-mm", "100"),
}
DPI = 250


def written(folder: Path, kind: str, *more: str) -> tuple[Board, Path]:
    out = folder / "sheet"
    CliRunner().invoke(command, [kind, *KINDS[kind], *more, "--out", str(out)], catch_exceptions=False)
    return read_board(f"{out}.yaml"), out


def printed(path: Path, folder: Path) -> Grey:
    """The page as a printer that is set to 100 % prints it."""
    subprocess.run(["pdftoppm", "-r", str(DPI), "-gray", "-singlefile", path, folder / "page"], check=True)
    return cv2.imread(str(folder / "page.pgm"), cv2.IMREAD_GRAYSCALE)


def printed_points(found: Array, pixels_per_mm: float) -> Array:
    """Corners of an image in millimetres, from the first one."""
    return (found - found[0]) / pixels_per_mm


@pytest.mark.quick("tag")
@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="no poppler to draw the page")
@pytest.mark.parametrize("kind", KINDS)
def test_a_printed_page_shows_board_and_ruler_to_scale(tmp_path: Path, kind: str) -> None:
    made, out = written(tmp_path, kind)
    page = printed(out.with_suffix(".pdf"), tmp_path)
    assert sorted(25.4 * length / DPI for length in page.shape) == pytest.approx([210, 297], abs=0.1)
    detection = detect(page, made)
    assert detection.fault == ""
    signs = (1, -1) if kind == "aprilgrid" else (1, 1)
    expected = 1000 * (made.points - made.points[0])[:, :2] * signs
    np.testing.assert_allclose(printed_points(detection.corners, DPI / 25.4), expected, atol=0.5 * 25.4 / DPI)
    lines = page < 128
    longest = max(np.ptp(np.flatnonzero(row)) + 1 for row in lines[-round(8.2 * DPI / 25.4) :] if row.any())
    assert longest * 25.4 / DPI == pytest.approx(100, abs=0.1)
    rows, columns = np.nonzero(lines)
    assert min(rows.min(), columns.min()) * 25.4 / DPI > 7.8


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("chromium") is None, reason="no chromium to draw the page")
def test_a_browser_draws_the_page_so_that_the_board_is_found(tmp_path: Path) -> None:
    made, out = written(tmp_path, "charuco")
    shot = tmp_path / "page.png"
    options = ["--headless", "--no-sandbox", "--disable-gpu", "--hide-scrollbars", "--window-size=1130,800"]
    options.append("--force-device-scale-factor=3")
    page = out.with_suffix(".svg").as_uri()
    subprocess.run(["chromium", *options, f"--screenshot={shot}", page], check=True, capture_output=True, timeout=60)
    detection = detect(cv2.imread(str(shot), cv2.IMREAD_GRAYSCALE), made)
    assert detection.fault == ""
    expected = 1000 * (made.points - made.points[0])[:, :2]
    np.testing.assert_allclose(printed_points(detection.corners, 3 * 96 / 25.4), expected, atol=0.1)


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("chessboard", *KINDS["chessboard"][:-1], "26"), "needs 260 x 182 mm.*take --paper a3"),
        (("charuco", *KINDS["charuco"], "--marker-mm", "31"), "expected the marker to be smaller"),
        (("chessboard", "--columns", "2", *KINDS["chessboard"][2:]), "columns: .*greater than or equal to 3"),
        (("tag", "--id", "600", "--tag-mm", "50"), "found ids up to 600, expected at most 586"),
    ],
)
def test_a_board_that_cannot_be_printed_is_refused(tmp_path: Path, arguments: tuple[str, ...], text: str) -> None:
    with pytest.raises(InputError, match=text):
        CliRunner().invoke(command, [*arguments, "--out", str(tmp_path / "b")], catch_exceptions=False)
    assert not list(tmp_path.iterdir())


def test_files_that_are_there_are_kept(tmp_path: Path) -> None:
    _, out = written(tmp_path, "tag")
    with pytest.raises(InputError, match="is there already"):
        written(tmp_path, "tag")
    written(tmp_path, "tag", "--force")
    assert out.with_suffix(".pdf").exists()
