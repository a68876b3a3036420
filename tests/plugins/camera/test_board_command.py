"""``armcal board``: pages to print are to scale, and their boards are found again."""

from __future__ import annotations

import re
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
from armcal_camera.detection import detect
from armcal_camera.images import Grey

KINDS = {
    "chessboard": ("--columns", "9", "--rows", "6", "--square-mm", "25"),
    "charuco": ("--columns", "7", "--rows", "5", "--square-mm", "30"),
    "aprilgrid": ("--columns", "4", "--rows", "3", "--tag-mm", "40", "--first-id", "5"),
    "tag": ("--id", "3", "--tag-mm", "100"),
}
PIXELS_PER_MM = 5.0


def written(folder: Path, kind: str, *more: str) -> tuple[Board, Path]:
    out = folder / "sheet"
    CliRunner().invoke(command, [kind, *KINDS[kind], *more, "--out", str(out)], catch_exceptions=False)
    return read_board(f"{out}.yaml"), out


def pdf_rectangles(path: Path) -> tuple[Array, list[Array]]:
    """The page (mm), and each filled group of rectangles (mm: left, top, width, height)."""
    text = path.read_bytes().decode("ascii")
    width, height = map(float, re.search(r"MediaBox \[0 0 (\S+) (\S+)\]", text).groups())  # type: ignore[union-attr]
    scale = float(re.search(r"\n(\S+) 0 0 (\S+) 0 0 cm", text)[1]) / 72 * 25.4  # type: ignore[index]
    page = np.array([width, height]) / 72 * 25.4
    groups = re.findall(r"((?:\S+ \S+ \S+ \S+ re\n)+)f\n", text)
    read = [np.array([line.split()[:4] for line in group.splitlines()], float) * scale for group in groups]
    return page, [np.column_stack([r[:, 0], page[1] - r[:, 1] - r[:, 3], r[:, 2:]]) for r in read]


def svg_image(path: Path) -> Grey:
    """The board's path, drawn."""
    text = path.read_text()
    width, height = map(float, re.search(r'width="(\S+)mm" height="(\S+)mm"', text).groups())  # type: ignore[union-attr]
    image = np.full((round(height * PIXELS_PER_MM), round(width * PIXELS_PER_MM)), 255, np.uint8)
    for drawn in re.findall(r'<path d="(.*)"/>', text):
        for x, y, w, h in re.findall(r"M(\S+) (\S+?)h(\S+?)v(\S+?)h", drawn):
            left, top = float(x) * PIXELS_PER_MM, float(y) * PIXELS_PER_MM
            right, bottom = left + float(w) * PIXELS_PER_MM, top + float(h) * PIXELS_PER_MM
            image[round(top) : round(bottom), round(left) : round(right)] = 0
    return cv2.GaussianBlur(image, (0, 0), 1.0)


def printed_points(found: Array, pixels_per_mm: float) -> Array:
    """Corners of an image in millimetres, from the first one."""
    return (found - found[0]) / pixels_per_mm


@pytest.mark.quick("tag")
@pytest.mark.parametrize("kind", KINDS)
def test_a_drawn_page_shows_the_board_to_scale(tmp_path: Path, kind: str) -> None:
    made, out = written(tmp_path, kind)
    detection = detect(svg_image(out.with_suffix(".svg")), made)
    assert detection.fault == ""
    signs = (1, -1) if kind == "aprilgrid" else (1, 1)
    expected = 1000 * (made.points - made.points[0])[:, :2] * signs
    np.testing.assert_allclose(printed_points(detection.corners, PIXELS_PER_MM), expected, atol=0.25)


@pytest.mark.parametrize("kind", KINDS)
def test_the_pdf_measures_what_it_says(tmp_path: Path, kind: str) -> None:
    made, out = written(tmp_path, kind)
    page, (dark, ruler) = pdf_rectangles(out.with_suffix(".pdf"))
    assert sorted(page.round(3)) == [210, 297]
    low, high = dark[:, :2].min(axis=0), (dark[:, :2] + dark[:, 2:]).max(axis=0)
    np.testing.assert_allclose(high - low, 1000 * np.array(made.extent), atol=1e-3)
    assert (low >= 7.9).all()
    assert (high <= page - 7.9).all()
    assert (ruler[:, 0] + ruler[:, 2]).max() - ruler[:, 0].min() == pytest.approx(100, abs=1e-3)
    text = out.with_suffix(".svg").read_text()
    rows = re.findall(r"M(\S+) (\S+?)h(\S+?)v(\S+?)h", re.findall(r'<path d="(.*)"/>', text)[0])
    np.testing.assert_allclose(np.array(rows, float), dark, atol=2e-3)


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
