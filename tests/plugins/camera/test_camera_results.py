"""What a calibrated camera becomes: files that other libraries read, a report, a verdict; and rendered images."""

from __future__ import annotations

import argparse
import csv
import json
import shlex
import shutil
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import armcal
import numpy as np
import pytest
import yaml
from armcal.api import Run
from armcal.base.arrays import Array
from armcal.calibration.exporter import request_of
from armcal.cli.main import cli
from armcal.errors import ConfigError
from armcal_camera.export import FramesSettings, HandEyeExporter
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[3]
DEMO = ROOT / "configs" / "camera" / "demo.yaml"
SHARED = ROOT.parent / "shared" / "data" / "camera"


@pytest.fixture(scope="module")
def run() -> Run:
    return armcal.Experiment.load(DEMO, ["validation.folds=0"]).run()


@pytest.fixture(scope="module")
def calibration(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return run.write(tmp_path_factory.mktemp("camera") / "run") / "calibration.yaml"


def exported(calibration: Path, kind: str, out: Path, *options: str) -> None:
    armcal_says("export", str(calibration), "--format", kind, "--out", str(out), *options)


def numbers(calibration: Path) -> dict[str, float]:
    return {e["name"]: e["value"] for e in yaml.safe_load(calibration.read_text())["parameters"]}


def matrix_of(place: list[float], rotation: Array) -> Array:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, place
    return pose


@pytest.mark.slow
def test_opencv_reads_its_file(calibration: Path, tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'armcal[camera]'")
    exported(calibration, "opencv", tmp_path / "camera.yaml")
    storage, known = cv2.FileStorage(str(tmp_path / "camera.yaml"), cv2.FILE_STORAGE_READ), numbers(calibration)
    matrix, pose = storage.getNode("camera_matrix").mat(), storage.getNode("tool_T_camera").mat()
    assert matrix[0, 0] == pytest.approx(1000 * known["camera.fx"], abs=1e-9)
    assert matrix[1, 2] == pytest.approx(1000 * known["camera.cy"], abs=1e-9)
    assert storage.getNode("distortion_coefficients").mat().shape == (1, 5)
    assert np.allclose(pose[:3, 3], [known[f"camera.camera_{axis}"] for axis in "xyz"], atol=1e-12)
    assert storage.getNode("image_width").real() == 1280


@pytest.mark.slow
def test_ros_files_agree_with_each_other(calibration: Path, tmp_path: Path) -> None:
    exported(calibration, "hand_eye", tmp_path / "where.yaml", "--option", "tool_frame=flange")
    exported(calibration, "camera_info", tmp_path / "info.yaml")
    where = yaml.safe_load((tmp_path / "where.yaml").read_text())["transformation"]
    joint = ElementTree.fromstring((tmp_path / "where_joint.urdf").read_text())
    assert joint.find("parent").get("link") == "flange"  # type: ignore[union-attr]
    origin = joint.find("origin")
    assert origin is not None
    xyz, rpy = ([float(x) for x in str(origin.get(key)).split()] for key in ("xyz", "rpy"))
    one = matrix_of([where[axis] for axis in "xyz"], Rotation.from_quat([where[f"q{a}"] for a in "xyzw"]).as_matrix())
    assert np.allclose(one, matrix_of(xyz, Rotation.from_euler("xyz", rpy).as_matrix()), atol=1e-8)
    info = yaml.safe_load((tmp_path / "info.yaml").read_text())
    assert (info["image_width"], info["image_height"], info["distortion_model"]) == (1280, 960, "plumb_bob")
    assert info["camera_matrix"]["data"][0] == pytest.approx(1000 * numbers(calibration)["camera.fx"])


def test_ros_takes_its_messages_and_its_command(calibration: Path, tmp_path: Path) -> None:
    stores = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed: pip install 'armcal[ros2]'")
    store = stores.get_typestore(stores.Stores.ROS2_HUMBLE)
    exported(calibration, "camera_info", tmp_path / "info.yaml")
    info, types = yaml.safe_load((tmp_path / "info.yaml").read_text()), store.types
    names = {
        "d": "distortion_coefficients",
        "k": "camera_matrix",
        "r": "rectification_matrix",
        "p": "projection_matrix",
    }
    matrices = {field: np.array(info[name]["data"], dtype=float) for field, name in names.items()}
    stamp = types["builtin_interfaces/msg/Time"](sec=0, nanosec=0)
    message = types["sensor_msgs/msg/CameraInfo"](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id="camera"),
        height=info["image_height"],
        width=info["image_width"],
        distortion_model=info["distortion_model"],
        binning_x=0,
        binning_y=0,
        roi=types["sensor_msgs/msg/RegionOfInterest"](0, 0, 0, 0, False),
        **matrices,
    )
    name = "sensor_msgs/msg/CameraInfo"
    again = store.deserialize_cdr(store.serialize_cdr(message, name), name)
    assert again.width == 1280 and again.distortion_model == "plumb_bob" and len(again.d) == 5
    assert again.p.reshape(3, 4)[:, :3].ravel() == pytest.approx(again.k) and again.k[0] > 100
    exported(calibration, "hand_eye", tmp_path / "where.yaml")
    request = request_of(armcal.Calibration.load(calibration), None)
    remark, _ = HandEyeExporter(FramesSettings()).export(request).remarks
    where = yaml.safe_load((tmp_path / "where.yaml").read_text())["transformation"]
    parser = argparse.ArgumentParser()  # the options of tf2_ros static_transform_publisher, from ROS 2 Humble on
    for key in where:
        parser.add_argument(f"--{key}", type=float, required=True)
    for key in ("--frame-id", "--child-frame-id"):
        parser.add_argument(key, required=True)
    command = shlex.split(remark.partition(": ")[2])
    assert command[:4] == ["ros2", "run", "tf2_ros", "static_transform_publisher"]
    options = vars(parser.parse_args(command[4:]))
    assert (options["frame_id"], options["child_frame_id"]) == ("tool0", "camera_optical_frame")
    assert {key: options[key] for key in where} == pytest.approx(where, abs=1e-8)


HAND_EYE = """geometry_msgs/Transform transform
easy_handeye2_msgs/HandeyeCalibrationParameters parameters"""
HAND_EYE_PARAMETERS = """string name
string calibration_type
string robot_base_frame
string robot_effector_frame
string tracking_base_frame
string tracking_marker_frame
bool freehand_robot_movement
string move_group_namespace
string move_group"""


def test_easy_handeye2_fills_its_message_from_the_file(calibration: Path, tmp_path: Path) -> None:
    stores = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed: pip install 'armcal[ros2]'")
    store, prefix = stores.get_typestore(stores.Stores.ROS2_HUMBLE), "easy_handeye2_msgs/msg/HandeyeCalibration"
    for text, name in ((HAND_EYE_PARAMETERS, f"{prefix}Parameters"), (HAND_EYE, prefix)):
        store.register(stores.get_types_from_msg(text, name))
    exported(calibration, "hand_eye", tmp_path / "wrist.yaml", "--option", "tool_frame=flange")
    content, types = yaml.safe_load((tmp_path / "wrist.calib").read_text()), store.types
    moved = {"move_group_namespace": "/", "move_group": "manipulator"}  # which the message has by default
    turned, there = (
        types[f"geometry_msgs/msg/{kind}"](**content["transform"].pop(part))
        for kind, part in (("Quaternion", "rotation"), ("Vector3", "translation"))
    )
    transform = types["geometry_msgs/msg/Transform"](translation=there, rotation=turned, **content.pop("transform"))
    parameters = types[f"{prefix}Parameters"](**content.pop("parameters"), **moved)
    message = types[prefix](transform=transform, parameters=parameters, **content)
    again = store.deserialize_cdr(store.serialize_cdr(message, prefix), prefix)
    assert (again.parameters.name, again.parameters.calibration_type) == ("wrist", "eye_in_hand")
    assert (again.parameters.robot_effector_frame, again.parameters.tracking_base_frame) == (
        "flange",
        "camera_optical_frame",
    )
    assert again.transform.translation.x == numbers(calibration)["camera.camera_x"]


def test_easy_handeye_takes_the_parameters_of_the_file(calibration: Path) -> None:
    def parameters(  # the arguments of its HandeyeCalibrationParameters
        namespace: str,
        move_group_namespace: str = "/",
        move_group: str = "manipulator",
        eye_on_hand: bool | None = None,
        robot_base_frame: str | None = None,
        robot_effector_frame: str | None = None,
        tracking_base_frame: str | None = None,
        tracking_marker_frame: str | None = None,
    ) -> tuple[object, ...]:
        return namespace, eye_on_hand, robot_base_frame, robot_effector_frame, tracking_base_frame

    request = request_of(armcal.Calibration.load(calibration), None)
    content = yaml.safe_load(HandEyeExporter(FramesSettings()).export(replace(request, out="a/wrist.yaml")).content)
    read = parameters(**content["parameters"])
    assert read == ("wrist", True, "base_link", "tool0", "camera_optical_frame")
    assert set(content["transformation"]) == {"x", "y", "z", "qx", "qy", "qz", "qw"}


def test_a_camera_that_is_not_there_is_refused(calibration: Path) -> None:
    from armcal_camera.export import CameraExportSettings, CameraInfoExporter

    request = request_of(armcal.Calibration.load(calibration), None)
    with pytest.raises(ConfigError, match="found the cameras camera"):
        CameraInfoExporter(CameraExportSettings(camera="other")).export(request)


def test_report_and_verdict_speak_of_pixels_and_of_the_camera(run: Run, calibration: Path) -> None:
    page = (calibration.parent / "report.html").read_text()
    assert "reprojection residuals over the sensor" in page
    assert run.verdict.headline.startswith("Reprojection error") and " px" in run.verdict.headline
    texts = [finding.text for finding in run.verdict.findings]
    assert any(text.startswith("camera: its place on the hand is known to") for text in texts)
    assert "error_px" in run.metrics
    rows = (calibration.parent / "residuals.csv").read_text().splitlines()
    assert len(rows) == 41 and "calibrated_px" in rows[0]


@pytest.mark.slow
@pytest.mark.skipif(
    not SHARED.exists(), reason="the measured images are not beside the checkout (../shared/data/camera)"
)
@pytest.mark.parametrize("name", ["synthetic_1"])
def test_rendered_images_give_the_camera_where_it_is(name: str, tmp_path: Path) -> None:
    pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'armcal[camera]'")
    config = {
        "name": name,
        "data": {"type": "images", "folder": "images", "poses": "images/flange_poses.txt"},
        "arms": {"arm": {"model": {"type": "flange_pose"}}},
        "measurements": {
            "camera": {
                "type": "camera",
                "noise_px": 0.015,
                "board": {"type": "chessboard", "columns": 9, "rows": 6, "square_mm": 200},
            }
        },
        "parameters": {"free": ["camera.camera_*", "camera.board_[xyzr]*", "camera.[fc][xy]", "camera.k[12]"]},
        "validation": {"holdout": 0.25, "folds": 0},
    }
    shutil.copytree(SHARED / name, tmp_path / "images")
    (tmp_path / "config.yaml").write_text(yaml.safe_dump(config))
    run = armcal.Experiment.load(tmp_path / "config.yaml").run()
    estimate, entries = run.estimate, run.estimate.parameters.entry_names
    place = [entries.index(f"camera.camera_{axis}") for axis in "xyz"]
    off = estimate.values[place]
    deviations = np.sqrt(np.diag(estimate.covariance))[[list(estimate.free_entries).index(i) for i in place]]
    assert np.linalg.norm(off) < 1e-4, "0.34 mm by a bundle adjustment with OpenCV's corners"
    assert (np.abs(off) < 3 * deviations).all()
    turned = Rotation.from_quat([estimate.values[entries.index(f"camera.camera_rotation[{a}]")] for a in "xyzw"])
    assert np.rad2deg((turned.inv() * Rotation.from_euler("x", 180, degrees=True)).magnitude()) < 0.01
    assert run.metrics["error_px"]["calibrated"]["holdout"]["rms"] < 0.02


@pytest.mark.slow
def test_commands_that_go_on_from_a_camera_take_its_records(calibration: Path, tmp_path: Path) -> None:
    records, out = str(DEMO.with_suffix(".csv")), tmp_path / "predicted.csv"
    predicted = armcal_says("predict", str(calibration), "--poses", records, "--out", str(out))
    assert "and 100 more" in predicted and len(out.read_text().splitlines()) == 41
    folder = tmp_path / "recalibrated"
    events = armcal_says("recalibrate", str(calibration), "--from", records, "--out", str(folder))
    verdicts = [json.loads(line) for line in events.splitlines() if '"event": "record"' in line]
    assert len(verdicts) == 40
    assert sum(event["verdict"] == "accepted" for event in verdicts) >= 39
    plan = tmp_path / "plan.csv"
    armcal_says("plan", str(DEMO), "--poses", "6", "--calibration", str(calibration), "--out", str(plan))
    assert len(plan.read_text().splitlines()) == 7


def armcal_says(*arguments: str) -> str:
    done = CliRunner().invoke(cli, list(arguments))
    assert done.exit_code == 0, done.output
    return done.stdout


@pytest.mark.slow
def test_what_a_record_lacks_is_empty_in_the_residuals(tmp_path: Path) -> None:
    rows = list(csv.reader(DEMO.with_suffix(".csv").read_text().splitlines()))
    place = rows[0].index("u_7_px")
    rows[3][place] = rows[3][place + 1] = ""
    (tmp_path / "demo.csv").write_text("\n".join(",".join(row) for row in rows) + "\n")
    for name in ("arm.yaml", "demo.yaml", "truth.yaml"):
        shutil.copy(DEMO.parent / name, tmp_path / name)
    run = armcal.Experiment.load(tmp_path / "demo.yaml", ["validation.folds=0"]).run()
    written = list(csv.DictReader((run.write(tmp_path / "run") / "residuals.csv").read_text().splitlines()))
    assert [i for i, row in enumerate(written) if row["residual_u_7_px"] == ""] == [2]
    assert all(value != "" for key, value in written[1].items() if key.startswith("residual_"))
    assert run.metrics["records"]["train"] == 30
