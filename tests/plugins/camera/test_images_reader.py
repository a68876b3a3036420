"""Records from folders of images and files of poses."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from armcal import api
from armcal.errors import DataError, PluginError
from armcal.measure.reader import ReadRequest, RequestedChannel

pytest.importorskip("cv2")
import cv2
from armcal_camera.board import Board, Chessboard
from armcal_camera.camera import Camera, CameraSettings
from armcal_camera.images_reader import ImagesReader, ImagesSettings
from armcal_camera.intrinsics import IntrinsicsSettings
from armcal_camera.pose_table import FLANGE
from armcal_camera.render import Exposure, Lens, render
from armcal_tracker.csv_reader import CsvReader, CsvSettings
from scipy.spatial.transform import Rotation

from tests.plugins.camera.sheets import SIZE, facing, projected
from tests.plugins.camera.simulated_views import stand_for_images

BOARD = Chessboard.si(type="chessboard", columns=5, rows=4, square=0.04)
LENS = Lens((600.0, 600.0), (320.0, 240.0))
COUNT = 5
TURNS = [(0.1 * i, 0.2 - 0.1 * i, 0.05 * i) for i in range(COUNT)]


def camera_of(board: Board = BOARD, **settings: object) -> Camera:
    return Camera(CameraSettings.si(noise=1e-4, board=board, **settings), ("arm",))


@cache
def image(i: int) -> bytes:
    """Of the board, as a PNG."""
    shown = render([(BOARD, facing(BOARD, TURNS[i]))], LENS, SIZE, Exposure())
    return bytes(cv2.imencode(".png", shown)[1])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Images 8.png to 12.png, and a file of joint angles beside them."""
    place = tmp_path / "images"
    place.mkdir()
    for i in range(COUNT):
        (place / f"{i + 8}.png").write_bytes(image(i))
    rows = "".join(f"{10 * i},{5 - i},{20 + i}\n" for i in range(COUNT))
    (place / "poses.csv").write_text(f"q1_deg,q2_deg,temperature_C\n{rows}")
    return place


def truth(i: int) -> Any:
    pose = facing(BOARD, TURNS[i])
    return projected(LENS, BOARD.points @ pose[:3, :3].T + pose[:3, 3])


def request_of(joints: tuple[str, ...] = ("q1", "q2"), camera: Camera | None = None) -> ReadRequest:
    camera = camera or camera_of()
    dimensions = {name: "length" if name in ("x", "y", "z") else "angle" for name in joints}
    channels = [RequestedChannel(f"arm.{name}", (name,), dimensions[name], True) for name in joints]
    channels += [
        RequestedChannel(f"arm.approach.{name}", (f"approach_{name}",), "dimensionless", False) for name in joints
    ]
    channels.append(RequestedChannel("temperature", ("temperature",), "temperature", False))
    points = sum(len(board.points) for board in camera.boards)
    channels += [
        RequestedChannel(f"camera.{axis}_{k}", (f"{axis}_{k}",), "image", True, parts=("camera",))
        for k in range(points)
        for axis in "uv"
    ]
    arm = SimpleNamespace(name="arm", commanded=dict.fromkeys(joints))
    return ReadRequest({"arm": arm}, {"camera": camera}, tuple(channels))  # type: ignore[dict-item]


def read(request: ReadRequest | None = None, **settings: object) -> Any:
    given = {name: str(value) if isinstance(value, Path) else value for name, value in settings.items()}
    return ImagesReader(ImagesSettings.model_validate(given)).read(request or request_of())


def test_intrinsics_of_half_the_images_size_are_refused_with_the_factor(folder: Path) -> None:
    width, height = SIZE
    half = {"fx": 0.4, "fy": 0.4, "cx": 0.3, "cy": 0.2, "image": (width / 2000, height / 2000)}
    camera = camera_of(intrinsics=IntrinsicsSettings.si(**half))
    with pytest.raises(DataError, match=f"these are {width} x {height}: scale fx, fy, cx and cy by 2, or give"):
        read(request_of(camera=camera), folder=folder, poses=folder / "poses.csv")


@pytest.mark.slow
def test_each_image_is_a_record_in_the_order_of_numbers(folder: Path) -> None:
    dataset = read(folder=folder, poses=folder / "poses.csv")
    assert dataset.ids == ("8.png", "9.png", "10.png", "11.png", "12.png")
    np.testing.assert_allclose(np.degrees(dataset.column("arm.q1")), [0, 10, 20, 30, 40])
    np.testing.assert_allclose(dataset.column("temperature"), [20, 21, 22, 23, 24])
    for i in range(COUNT):
        pixels = [[1000 * dataset.column(f"camera.{axis}_{k}")[i] for axis in "uv"] for k in range(20)]
        np.testing.assert_allclose(pixels, truth(i), atol=0.05)


@pytest.mark.slow
def test_how_much_is_looked_at_is_reported(folder: Path) -> None:
    seen: list[float] = []
    asked = replace(request_of(), report=seen.append)
    read(asked, folder=folder, poses=folder / "poses.csv")
    assert len(seen) > COUNT and seen == sorted(seen) and (seen[0], seen[-1]) == (0.0, 1.0)
    seen.clear()
    joints = tuple(channel for channel in asked.channels if not channel.parts)
    two = replace(asked, measurements={"left": camera_of(), "right": camera_of()}, channels=joints)
    read(two, folder={"left": str(folder), "right": str(folder)}, poses=folder / "poses.csv")
    assert seen == sorted(seen) and 0.5 in seen and seen[-1] == 1.0


@pytest.mark.slow
def test_a_column_may_name_the_image(folder: Path) -> None:
    (folder / "poses.csv").write_text("image,q1_deg,q2_deg\n12.png,1,2\n10,3,4\nsub/8.png,5,6\n")
    dataset = read(folder=folder, poses=folder / "poses.csv")
    assert dataset.ids == ("12.png", "10.png", "8.png")
    assert 1000 * dataset.column("camera.u_0")[1] == pytest.approx(truth(2)[0, 0], abs=0.05)
    (folder / "poses.csv").write_text("image,q1_deg,q2_deg\n12.png,1,2\n7.png,3,4\n8.png,5,6\n")
    with pytest.raises(DataError, match=r":3.*found the image '7.png'"):
        read(folder=folder, poses=folder / "poses.csv")
    (folder / "poses.csv").write_text("image,q1_deg,q2_deg\n12.png,1,2\n12,3,4\n8.png,5,6\n")
    with pytest.raises(DataError, match=r":3.*found the image 12.png again"):
        read(folder=folder, poses=folder / "poses.csv")


def test_a_file_that_is_there_twice_counts_once_and_other_kinds_are_refused(folder: Path) -> None:
    (folder / "11.png").write_bytes((folder / "9.png").read_bytes())
    dataset = read(folder=folder, poses=folder / "poses.csv")
    assert dataset.set_aside[0].reason == "it is the same image as 9.png" and len(dataset) == COUNT - 1
    (folder / "12.CR2").write_bytes(b"the sensor's own data, beside 12.png")
    read(folder=folder, poses=folder / "poses.csv")
    (folder / "12.png").rename(folder / "12.heic")
    with pytest.raises(DataError, match=r"found 12.CR2, 12.heic \(2 in all\), a kind of image that is not read"):
        read(folder=folder, poses=folder / "poses.csv")


def test_what_says_nothing_is_set_aside_with_its_reason(folder: Path) -> None:
    (folder / "notes.txt").write_text("a text among the images")
    (folder / "8.png").write_bytes((folder / "8.png").read_bytes()[:5000])
    cv2.imwrite(str(folder / "9.png"), np.full((480, 640), 99, np.uint8))
    dataset = read(folder=folder, poses=folder / "poses.csv")
    assert [(record.record_id, record.row) for record in dataset.set_aside] == [("8.png", 2), ("9.png", 3)]
    assert "cut off" in dataset.set_aside[0].reason
    assert "not found" in dataset.set_aside[1].reason
    assert "2 of 5 images are set aside: 8.png: the image is cut off" in dataset.warnings[-1]
    cv2.imwrite(str(folder / "10.png"), render([(BOARD, facing(BOARD))], LENS, (800, 480), Exposure()))
    with pytest.raises(DataError, match=r"found 2 of 5 images .* 10.png: it is 800 x 480 px, the others are 640 x 480"):
        read(folder=folder, poses=folder / "poses.csv")


@pytest.mark.slow
def test_a_blurred_image_among_sharp_ones_is_set_aside(folder: Path) -> None:
    cv2.imwrite(str(folder / "11.png"), cv2.GaussianBlur(cv2.imread(str(folder / "11.png"), 0), (0, 0), 3.0))
    dataset = read(folder=folder, poses=folder / "poses.csv")
    assert "it is blurred: edges are 6." in dataset.set_aside[0].reason


@pytest.mark.slow
def test_poses_and_images_that_differ_in_number_are_refused(folder: Path) -> None:
    (folder / "12.png").unlink()
    with pytest.raises(DataError, match=r"found 5 poses in .*poses.csv and 4 images"):
        read(folder=folder, poses=folder / "poses.csv")


@pytest.mark.slow
@pytest.mark.parametrize(
    "change", [lambda f: [p.unlink() for p in f.glob("*.png")], lambda f: f.rename(f.parent / "x")]
)
def test_a_folder_without_images_is_refused(folder: Path, change: Callable[[Path], object]) -> None:
    poses = folder.parent / "poses.csv"
    poses.write_bytes((folder / "poses.csv").read_bytes())
    change(folder)
    with pytest.raises(DataError, match=r"no image in it|cannot be read as a folder"):
        read(folder=folder, poses=poses)


def test_corners_are_written_as_records_that_the_reader_csv_reads(folder: Path) -> None:
    corners = folder / "corners.csv"
    first = read(folder=folder, poses=folder / "poses.csv", corners=corners)
    again = CsvReader(CsvSettings(path=corners)).read(request_of())
    assert first.ids == again.ids
    for name, values in first.channels.items():
        np.testing.assert_allclose(values, again.channels[name], rtol=1e-15)


POSES = [Rotation.from_euler("ZYX", (0.3 * i, -0.2, 3.0 + 0.1 * i)) for i in range(COUNT)]


@pytest.mark.parametrize("form", ["matrix", "three rows", "four lines", "quaternion", "euler"])
def test_flange_poses_become_coordinates(tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch) -> None:
    path, settings = tmp_path / "flange.txt", None
    matrices = [np.hstack([turn.as_matrix(), [[0.1 * i], [0.2], [0.5]]]) for i, turn in enumerate(POSES)]
    if form in ("matrix", "three rows"):
        rows = [[*m.ravel(), *([0, 0, 0, 1] if form == "matrix" else [])] for m in matrices]
        text = "# by a robot\n" + "".join(" ".join(f"{x:.12f}" for x in row) + "\n" for row in rows)
    elif form == "four lines":
        rows = [row for m in matrices for row in (*m, [0, 0, 0, 1], [])]
        text = "".join(" ".join(f"{x:.12f}" for x in row) + "\n" for row in rows)
    elif form == "quaternion":
        quaternions = [turn.as_quat()[[3, 0, 1, 2]] for turn in POSES]
        lines = [",".join(repr(float(x)) for x in (*m[:, 3], *q)) for m, q in zip(matrices, quaternions, strict=True)]
        text = "\n".join(["x_m,y_m,z_m,qw,qx,qy,qz", *lines, ""])
    else:
        angles = [turn.as_euler("XYZ", degrees=True) for turn in POSES]
        lines = [",".join(repr(float(x)) for x in (*m[:, 3], *a)) for m, a in zip(matrices, angles, strict=True)]
        text = "\n".join(["x_m,y_m,z_m,a,b,c", *lines, ""])
        euler = {"columns": ["a", "b", "c"], "order": "XYZ", "unit": "deg"}
        settings = {"type": "pose_csv", "path": str(path), "euler": euler}
    path.write_text(text)
    stand_for_images(monkeypatch, {f"{i}.png": truth(i) for i in range(COUNT)})
    dataset = read(request_of(FLANGE), folder=tmp_path, poses=settings or path)
    values = {name: dataset.column(f"arm.{name}") for name in FLANGE}
    np.testing.assert_allclose(values["x"], 0.1 * np.arange(COUNT), atol=1e-9)
    turns = Rotation.from_euler("ZYX", np.stack([values["rz"], values["ry"], values["rx"]], axis=1))
    assert max((turn.inv() * expected).magnitude() for turn, expected in zip(turns, POSES, strict=True)) < 1e-7
    assert np.abs(np.diff(values["rx"])).max() < 1


@pytest.mark.quick("1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1-:2.*last row is not 0 0 0 1")
@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1 0 0 0 0 1 0 0 0 0 1", r":2.*found 11 cells, expected 12 or 16"),
        ("1 0 0 0 0 1 0 0 0 0 2 0", r":2.*no rotation"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 1 1", r":2.*last row is not 0 0 0 1"),
    ],
)
def test_a_flange_pose_that_is_none_is_refused(folder: Path, line: str, message: str) -> None:
    path = folder / "flange.txt"
    path.write_text(f"1 0 0 0 0 1 0 0 0 0 1 0\n{line}\n")
    with pytest.raises(DataError, match=message):
        read(request_of(FLANGE), folder=folder, poses=path)


@pytest.mark.parametrize("joints", [FLANGE, ("q1", "q2")])
def test_angles_of_a_flange_pose_are_named_and_not_taken_for_joints(folder: Path, joints: tuple[str, ...]) -> None:
    path = folder / "flange.csv"
    path.write_text("image,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n8.png,1,2,3,4,5,6\n")
    with pytest.raises(DataError, match=r":1: found x_mm, .*yaw_deg: a pose of the flange by three angles") as caught:
        read(request_of(joints), folder=folder, poses=path)
    assert "rpy: {columns: [roll_deg, pitch_deg, yaw_deg], unit: deg}" in caught.value.hint
    assert "rotation_vector" in caught.value.hint and "qw, qx, qy, qz" in caught.value.hint


def test_without_opencv_a_sentence_says_what_to_install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(PluginError, match=r"pip install 'armcal\[camera\]'"):
        read(folder=folder, poses=folder / "poses.csv")


@pytest.mark.shared
@pytest.mark.slow
def test_from_images_and_flange_poses_to_the_camera_on_the_hand(shared_data: Path, tmp_path: Path) -> None:
    """The set was rendered with the camera on the flange, half a turn about x."""
    config = tmp_path / "hand_eye.yaml"
    (tmp_path / "images").mkdir()
    for path in (shared_data / "camera" / "synthetic_1").iterdir():
        (tmp_path / "images" / path.name).write_bytes(path.read_bytes())
    config.write_text(
        "arms: {arm: {model: {type: flange_pose}}}\n"
        "data: {type: images, folder: images, poses: images/flange_poses.txt}\n"
        "measurements: {camera: {type: camera, noise_px: 0.02,"
        " board: {type: chessboard, columns: 9, rows: 6, square_mm: 200}}}\n"
        'parameters: {free: ["camera.camera_*", "camera.board_[xyzr]*", "camera.[fc][xy]", "camera.[kp][123]"]}\n'
    )
    run = api.Experiment.load(config).run()
    values = dict(zip(run.estimate.parameters.entry_names, run.estimate.values, strict=True))
    assert 1000 * np.linalg.norm([values[f"camera.camera_{axis}"] for axis in "xyz"]) < 0.1
    assert 2 * np.hypot(*(values[f"camera.camera_rotation[{axis}]"] for axis in "wy")) < np.radians(0.01)
    assert run.metrics["error_px"]["calibrated"]["train"]["rms"] < 0.015
