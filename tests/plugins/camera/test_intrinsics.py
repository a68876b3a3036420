"""Intrinsics from files of ROS, OpenCV and Kalibr."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.errors import ConfigError, DataError
from armcal.run.experiment import Experiment
from armcal_camera.board import Aprilgrid, Chessboard, read_board
from armcal_camera.intrinsics import read_intrinsics

DEMO = Path(__file__).resolve().parents[3] / "configs" / "camera" / "demo.yaml"
MATRIX = [900.0, 0, 640.5, 0, 910.0, 400.25, 0, 0, 1]
ROS = {
    "image_width": 1280,
    "image_height": 800,
    "camera_matrix": {"rows": 3, "cols": 3, "data": MATRIX},
    "distortion_model": "plumb_bob",
    "distortion_coefficients": {"rows": 1, "cols": 5, "data": [-0.1, 0.02, 0.001, -0.001, 0.0]},
}
EIGHT = {"rows": 1, "cols": 8, "data": [-0.1, 0.02, 0.001, -0.001, 0.0, 0.0, 0.0, 0.0]}
RATIONAL = {**ROS, "distortion_model": "rational_polynomial", "distortion_coefficients": EIGHT}
ECHOED = f"height: 800\nwidth: 1280\ndistortion_model: plumb_bob\nd:\n- 0.1\n- 0.0\nk: {MATRIX}\n"
ECHO = f"{ECHOED}---\n{ECHOED}"  # as ros2 topic echo prints messages
KALIBR = {
    "cam0": {
        "camera_model": "pinhole",
        "intrinsics": [900.0, 910.0, 640.5, 400.25],
        "distortion_model": "equidistant",
        "distortion_coeffs": [0.01, -0.002, 0.0, 0.0],
        "resolution": [1280, 800],
    }
}


def written(folder: Path, content: object) -> Path:
    path = folder / "intrinsics.yaml"
    path.write_text(content if isinstance(content, str) else yaml.safe_dump(content))
    return path


@pytest.mark.parametrize(
    ("content", "model", "count"),
    [(ROS, "pinhole", 5), (RATIONAL, "pinhole", 5), (KALIBR, "fisheye", 4), (ECHO, "pinhole", 2)],
)
def test_files_of_ros_and_kalibr(tmp_path: Path, content: object, model: str, count: int) -> None:
    read = read_intrinsics(written(tmp_path, content))
    assert np.allclose([read.fx, read.fy, read.cx, read.cy], [0.9, 0.91, 0.6405, 0.40025])
    assert (read.model, len(read.distortion), read.image) == (model, count, (1.28, 0.8))


def test_a_file_that_opencv_wrote(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'armcal[camera]'")
    storage = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", np.array(MATRIX).reshape(3, 3))
    storage.write("distortion_coefficients", np.array([[-0.1, 0.02, 0.001, -0.001, 0.0]]))
    storage.release()
    read = read_intrinsics(tmp_path / "camera.yaml")
    assert read.fy == pytest.approx(0.91) and read.distortion[1] == pytest.approx(0.02) and read.image is None


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("a: [", "it is not YAML"),
        ({"some": 1}, "no camera matrix"),
        (
            {**RATIONAL, "distortion_coefficients": {**EIGHT, "data": [0.1] * 8}},
            "the distortion model 'rational_polynomial'",
        ),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: object, expected: str) -> None:
    with pytest.raises(DataError, match=expected) as refused:
        read_intrinsics(written(tmp_path, content))
    assert ("camera_info" in refused.value.hint) != ("found from the images" in refused.value.hint)


@pytest.mark.parametrize(
    ("size", "mend"),
    [([1280, 960], "scale fx, fy, cx and cy by 2, or give"), ([1280, 720], "these are 1280 x 720: give those of")],
)
def test_intrinsics_of_another_image_size_are_refused(tmp_path: Path, size: list[int], mend: str) -> None:
    text = DEMO.parent.joinpath("arm.yaml").read_text() + "    intrinsics: intrinsics.yaml\n"
    (tmp_path / "arm.yaml").write_text(text.replace("image_px: [1280, 960]", f"image_px: {size}"))
    written(tmp_path, {**ROS, "image_width": 640, "image_height": 480})
    with pytest.raises(ConfigError, match=f"the intrinsics are of 640 x 480 images.*{mend}"):
        Experiment.load(tmp_path / "arm.yaml")


def test_targets_of_kalibr_are_boards(tmp_path: Path) -> None:
    path = tmp_path / "target.yaml"
    path.write_text("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.024\ntagSpacing: 0.3\n")
    grid = read_board(path)
    assert isinstance(grid, Aprilgrid) and (grid.columns, grid.rows, grid.border_bits) == (6, 5, 2)
    assert (grid.tag, grid.spacing) == pytest.approx((0.024, 0.0072))
    size = "rowSpacingMeters: 0.03\ncolSpacingMeters: 0.03\n"
    path.write_text(f"target_type: 'checkerboard'\ntargetCols: 6\ntargetRows: 7\n{size}")
    assert read_board(path) == Chessboard.si(type="chessboard", columns=6, rows=7, square=0.03)
    path.write_text("target_type: 'aprilgrid'\ntagCols: 6\ntagRows: 5\ntagSize: 0.024\ntagSpacing: 0.0072\n")
    with pytest.raises(
        ConfigError, match=r"tagSpacing: found 0\.0072, expected the gap between tags divided by"
    ) as refused:
        read_board(path)
    assert refused.value.hint == "If the gap is 7.2 mm, write 0.3."
    for wrong in ("target_type: aprilgrid\ntagCols: 6\n", "target_type: circlegrid\ntargetCols: 6\n"):
        path.write_text(wrong)
        with pytest.raises(ConfigError):
            read_board(path)


def test_a_configuration_names_the_file(tmp_path: Path) -> None:
    text = DEMO.parent.joinpath("arm.yaml").read_text() + "    intrinsics: intrinsics.yaml\n"
    (tmp_path / "arm.yaml").write_text(text.replace("    image_px: [1280, 960]\n", ""))
    written(tmp_path, KALIBR)
    camera = Experiment.load(tmp_path / "arm.yaml").system.measurements["camera"]
    assert camera.settings.model == "fisheye" and camera.image == (1.28, 0.8)  # type: ignore[attr-defined]
    (tmp_path / "intrinsics.yaml").unlink()
    with pytest.raises(ConfigError, match="intrinsics"):
        Experiment.load(tmp_path / "arm.yaml")
