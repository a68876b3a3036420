"""Boards found in rendered and in real images."""

from __future__ import annotations

import struct
import sys
import zlib
from pathlib import Path

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.errors import DataError, PluginError

pytest.importorskip("cv2")
import cv2
from armcal_camera.board import Aprilgrid, Board, Charuco, Chessboard, dark_rectangles, opencv, outline
from armcal_camera.detection import Grey, detect, grey_image
from armcal_camera.render import Exposure, Lens, render

from tests.plugins.camera.sheets import APRILGRID, CHARUCO, CHESSBOARD, SIZE, TAG, facing, projected

PINHOLE = Lens((600.0, 605.0), (322.3, 241.1), (-0.2, 0.08, 0.001, -0.0005, 0.0))
FISHEYE = Lens((420.0, 421.0), (318.0, 243.0), (0.02, -0.01, 0.003, -0.001), "fisheye")
TURN = (0.3, -0.25, 0.4)


def image_of(board: Board, pose: Array, lens: Lens = PINHOLE, exposure: Exposure | None = None) -> Grey:
    return render([(board, pose)], lens, SIZE, exposure or Exposure())


def truth(board: Board, pose: Array, lens: Lens = PINHOLE) -> Array:
    return projected(lens, board.points @ pose[:3, :3].T + pose[:3, 3])


@pytest.mark.quick("fisheye-aprilgrid", "fisheye-tag", "pinhole-aprilgrid", "pinhole-tag")
@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO, APRILGRID, TAG], ids=lambda board: board.type)
@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_corners_are_where_they_were_rendered(board: Board, lens: Lens) -> None:
    pose = facing(board, TURN, 0.45 if lens is PINHOLE else 0.36)
    found = detect(image_of(board, pose, lens), board)
    assert found.fault == ""
    off = np.linalg.norm(found.corners - truth(board, pose, lens), axis=1)
    assert np.isfinite(off).all()
    assert np.sqrt(np.mean(off**2)) < (0.02 if lens is PINHOLE else 0.04)
    assert np.degrees(found.oblique) == pytest.approx(np.degrees(np.arccos(np.cos(0.3) * np.cos(0.25))), abs=6)
    assert found.blur == pytest.approx(0.55, abs=0.08)


@pytest.mark.parametrize("lens", [PINHOLE, FISHEYE], ids=["pinhole", "fisheye"])
def test_the_lens_of_the_renderer_is_that_of_opencv(lens: Lens) -> None:
    points = np.random.default_rng(3).uniform((-0.4, -0.3, 0.8), (0.4, 0.3, 1.2), (20, 3))
    np.testing.assert_allclose(lens.rays(projected(lens, points)), points[:, :2] / points[:, 2:], atol=1e-6)


@pytest.mark.quick("size1-1.5")
@pytest.mark.parametrize("roll", [0.0, 1.5, 3.1, -2.0])
@pytest.mark.parametrize("size", [(9, 6), (6, 9), (8, 5)])
def test_a_chessboard_is_the_same_way_round_in_every_image(roll: float, size: tuple[int, int]) -> None:
    board = Chessboard.si(type="chessboard", columns=size[0], rows=size[1], square=0.025)
    pose = facing(board, (0.0, 0.0, roll))
    np.testing.assert_allclose(detect(image_of(board, pose), board).corners, truth(board, pose), atol=0.1)


def test_noise_and_light_cost_little() -> None:
    pose = facing(CHESSBOARD, TURN)
    found = detect(image_of(CHESSBOARD, pose, exposure=Exposure(noise=6.0, light=0.6, seed=4)), CHESSBOARD)
    off = found.corners - truth(CHESSBOARD, pose)
    assert 0.005 < np.sqrt(np.mean(off**2)) < 0.06


@pytest.mark.parametrize("board", [CHARUCO, APRILGRID], ids=lambda board: board.type)
def test_a_part_of_a_board_with_tags_will_do(board: Board) -> None:
    pose = facing(board, TURN)
    pose[0, 3] += 0.16
    found = detect(image_of(board, pose), board)
    off = np.linalg.norm(found.corners - truth(board, pose), axis=1)
    assert found.fault == ""
    assert 6 <= np.isfinite(off).sum() < len(off)
    assert np.nanmax(off) < 0.15


def test_a_covered_corner_is_absent() -> None:
    pose = facing(CHARUCO, TURN)
    image, hidden = image_of(CHARUCO, pose), 12
    u, v = np.rint(truth(CHARUCO, pose)[hidden]).astype(int)
    image[v - 7 : v + 8, u - 7 : u + 8] = 90
    absent = np.flatnonzero(np.isnan(detect(image, CHARUCO).corners[:, 0]))
    assert hidden in absent
    assert len(absent) < 12


@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.parametrize("rows", [5, 6])
def test_a_charuco_board_is_printed_as_opencv_prints_it(legacy: bool, rows: int) -> None:
    board = Charuco.si(type="charuco", columns=7, rows=rows, square=0.016, marker=0.012, legacy=legacy)
    theirs = cv2.aruco.CharucoBoard((7, rows), 16, 12, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_5X5_100))
    theirs.setLegacyPattern(legacy)
    expected = theirs.generateImage((7 * 112, rows * 112), marginSize=0)
    ours = np.full_like(expected, 255)
    pixels = np.rint((dark_rectangles(board) - np.tile(outline(board)[:2], 2)) * 7000).astype(int)
    for left, top, right, bottom in pixels:
        ours[top:bottom, left:right] = 0
    assert np.mean(ours != expected) < 0.02


@pytest.mark.parametrize("legacy", [False, True])
def test_tags_of_another_print_are_named(legacy: bool) -> None:
    board = Charuco.si(type="charuco", columns=7, rows=6, square=0.03, marker=0.0225, legacy=legacy)
    image = image_of(board, facing(board, TURN))
    assert fault_of(image, board) == ""
    other = board.model_copy(update={"legacy": not legacy})
    assert f"its tags stand as on a board with legacy: {str(legacy).lower()}" in fault_of(image, other)
    family = board.model_copy(update={"dictionary": "DICT_4X4_50"})
    assert "but tags 0 to 20 of DICT_5X5_50; those of the board are 0 to 20 of DICT_4X4_50" in fault_of(image, family)
    numbers = board.model_copy(update={"first_id": 40})
    assert "but tags 0 to 20 of DICT_5X5_100; those of the board are 40 to 60" in fault_of(image, numbers)


@pytest.mark.parametrize("rows", [5, 6])
@pytest.mark.parametrize("made", [Charuco, Aprilgrid])
def test_exchanged_columns_and_rows_are_named(made: type[Charuco | Aprilgrid], rows: int) -> None:
    sizes = {"square": 0.03, "marker": 0.0225} if made is Charuco else {"tag": 0.025, "spacing": 0.0075}
    board = made.si(type=made.__name__.lower(), columns=7, rows=rows, **sizes)
    image = image_of(board, facing(board, TURN))
    assert fault_of(image, board) == ""
    other = board.model_copy(update={"columns": rows, "rows": 7})
    assert fault_of(image, other) == f"its columns and rows are exchanged: write columns: 7, rows: {rows}"


def fault_of(image: Grey, board: Board) -> str:
    found = detect(image, board)
    assert np.isnan(found.corners).all() or found.blur > 0
    return found.fault


@pytest.mark.slow
def test_what_is_wrong_with_an_image_is_said() -> None:
    pose = facing(CHESSBOARD, TURN)
    image = image_of(CHESSBOARD, pose)
    assert "not found" in fault_of(np.full((480, 640), 90, np.uint8), CHESSBOARD)
    assert "not found" in fault_of(image, CHARUCO)
    larger = Chessboard.si(type="chessboard", columns=11, rows=7, square=0.02)
    assert "one of 11 x 7 inner corners" in fault_of(image_of(larger, facing(larger)), CHESSBOARD)
    smaller = CHESSBOARD.model_copy(update={"columns": 7, "rows": 4})
    assert "one of 9 x 6 inner corners" in fault_of(image, smaller)
    assert fault_of(image, CHESSBOARD.model_copy(update={"columns": 5, "rows": 4}))
    assert "too obliquely (79 deg" in fault_of(image_of(APRILGRID, facing(APRILGRID, (0.0, 1.4, 0.0), 0.3)), APRILGRID)
    assert "blurred: edges are 1" in fault_of(image_of(CHESSBOARD, pose, exposure=Exposure(blur=6.0)), CHESSBOARD)
    assert "not found" in fault_of(image_of(CHESSBOARD, facing(CHESSBOARD, TURN, 4.0)), CHESSBOARD)


@pytest.mark.slow
def test_a_board_that_stands_there_twice_is_refused() -> None:
    left, right = facing(CHESSBOARD, distance=1.0), facing(CHESSBOARD, distance=1.0)
    left[0, 3] -= 0.2
    right[0, 3] += 0.2
    twice = render([(CHESSBOARD, left), (CHESSBOARD, right)], PINHOLE, SIZE, Exposure())
    assert "found twice" in fault_of(twice, CHESSBOARD)
    left, right = facing(TAG, distance=1.0), facing(TAG, distance=1.0)
    left[0, 3] -= 0.2
    right[0, 3] += 0.2
    assert "the tag 7 was found 2 times" in fault_of(
        render([(TAG, left), (TAG, right)], PINHOLE, SIZE, Exposure()), TAG
    )


@pytest.mark.quick("colour", "dazzled")
@pytest.mark.parametrize("kind", ["colour", "sixteen bits", "dazzled", "jpeg"])
def test_images_of_every_kind_are_read(kind: str) -> None:
    pose = facing(CHESSBOARD, TURN)
    image = image_of(CHESSBOARD, pose)
    stored = {"colour": cv2.cvtColor(image, cv2.COLOR_GRAY2BGR), "sixteen bits": image.astype(np.uint16) * 16}
    stored["dazzled"] = image.astype(np.uint16) * 4
    stored["dazzled"][:3, :3] = 65535
    content = cv2.imencode(".jpg" if kind == "jpeg" else ".png", stored.get(kind, image))[1].tobytes()
    found = detect(grey_image(content, "image"), CHESSBOARD)
    np.testing.assert_allclose(found.corners, truth(CHESSBOARD, pose), atol=0.15)
    with pytest.raises(DataError, match="cut off"):
        grey_image(content[: len(content) // 2], "image")


@pytest.mark.parametrize("content", [b"", b"hello, this is a text"])
def test_what_is_no_image_is_refused(content: bytes) -> None:
    with pytest.raises(DataError, match=r"image: it is not an image"):
        grey_image(content, "image")


@pytest.mark.parametrize("kind", [".png", ".jpg", ".tif", ".bmp", ".webp", ".pgm", ".ppm"])
def test_an_image_with_too_many_pixels_is_refused_by_its_header(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is decoded: a PNG of one colour of a megabyte may be gigabytes then."""
    image = np.full((100, 130) + ((3,) if kind == ".ppm" else ()), 90, np.uint8)
    content = cv2.imencode(kind, image)[1].tobytes()
    assert grey_image(content, "image").shape == (100, 130)
    monkeypatch.setattr("armcal_camera.detection.MOST_PIXELS", 12_999)
    monkeypatch.setattr(cv2, "imdecode", lambda *_: pytest.fail("it was decoded"))
    with pytest.raises(
        DataError, match=r"image: found an image of more than 0\.012999 million pixels, expected at most"
    ):
        grey_image(content, "image")


def test_a_header_of_30000_by_30000_pixels_is_refused() -> None:
    header = b"IHDR" + struct.pack(">IIBBBBB", 30_000, 30_000, 8, 0, 0, 0, 0)
    content = b"\x89PNG\r\n\x1a\n" + struct.pack(">I", 13) + header + struct.pack(">I", zlib.crc32(header))
    with pytest.raises(DataError, match="more than 100 million pixels"):
        grey_image(content + struct.pack(">I", 0) + b"IEND" + struct.pack(">I", zlib.crc32(b"IEND")), "image")


def test_without_opencv_a_sentence_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(PluginError, match=r"pip install 'armcal\[camera\]'"):
        opencv()


@pytest.mark.shared
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "columns", "rows", "square", "rms"), [("synthetic_1", 9, 6, 0.2, 0.018), ("kuka_1", 28, 17, 0.02, 0.073)]
)
def test_real_images_are_all_found_and_agree_with_a_camera(
    shared_data: Path, name: str, columns: int, rows: int, square: float, rms: float
) -> None:
    board = Chessboard.si(type="chessboard", columns=columns, rows=rows, square=square)
    images = [
        grey_image(path.read_bytes(), path.name) for path in sorted((shared_data / "camera" / name).glob("*.png"))
    ]
    found = [detect(image, board) for image in images]
    assert [detection.fault for detection in found] == [""] * len(images)
    points = [board.points.astype(np.float32)] * len(found)
    corners = [detection.corners.astype(np.float32).reshape(-1, 1, 2) for detection in found]
    size = images[0].shape[::-1]
    assert cv2.calibrateCamera(points, corners, size, None, None)[0] < rms
