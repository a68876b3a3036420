"""Calibrated cameras in the formats of ROS, OpenCV and easy_handeye; and what the report of a run shows of them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, cast

import numpy as np
import yaml
from armcal.arm.statics import BASE_FRAME, TOOL_FRAME
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, Instrument
from armcal.errors import ConfigError
from armcal.report.document import Figure, Marks, Panel, Part, ReportSection, Table
from armcal.report.numbers import significant
from armcal.report.page import nice_step
from armcal.run.result import RunResult
from scipy.spatial.transform import Rotation

if TYPE_CHECKING:  # importing it takes 0.1 s, which a run without a camera must not wait for
    from armcal_camera.camera import Camera

_PX = 1000.0
_MOST_VECTORS, _WORST = 4000, 8
_MODELS = {"pinhole": "plumb_bob", "fisheye": "equidistant"}


class CameraExportSettings(Settings):
    """Which camera (the only one unless said)."""

    camera: str | None = None


class FramesSettings(CameraExportSettings):
    """Which camera, and the names of frames in the other program; ``tool_frame`` is that which carries the camera."""

    base_frame: str = "base_link"
    tool_frame: str | None = None
    camera_frame: str = "camera_optical_frame"
    board_frame: str = "board"


class _CameraExporter:
    """What the exporters share; they need nothing of the arm, so no effect of it is left out."""

    Settings: ClassVar[type[CameraExportSettings]] = CameraExportSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}
    holds_residual = True

    def __init__(self, settings: Any) -> None:
        self._settings = settings

    def _camera(self, request: ExportRequest) -> tuple[str, Instrument, Camera]:
        from armcal_camera.camera import Camera, CameraSettings

        cameras = {name: i for name, i in request.instruments.items() if i.settings.get("type") == "camera"}
        chosen = self._settings.camera or (next(iter(cameras)) if len(cameras) == 1 else None)
        if chosen not in cameras:
            have = ", ".join(cameras) or "none"
            raise ConfigError(
                f"found the cameras {have} in the calibration, expected {self._settings.camera or 'one'}.",
                hint="Name one of them: camera=NAME." if cameras else "Calibrate a measurement of type camera.",
            )
        stated = {key: value for key, value in cameras[chosen].settings.items() if key != "type"}
        settings = CameraSettings.model_validate(stated)
        return chosen, cameras[chosen], Camera(settings, (settings.arm or "arm",))


class CameraInfoExporter(_CameraExporter):
    """The exporter ``camera_info``: the YAML of ROS's ``camera_info_manager``."""

    def export(self, request: ExportRequest) -> Exported:
        name, instrument, camera = self._camera(request)
        matrix, distortion, size = _intrinsics(instrument, camera)
        if size is None:
            raise ConfigError(
                f"the camera {name} does not state its image size, which camera_info needs.",
                hint="Give image_px: [1280, 960] in the measurement.",
            )
        flat = [float(x) for x in matrix.ravel()]
        projection = [*flat[:3], 0.0, *flat[3:6], 0.0, *flat[6:], 0.0]
        content = {
            "image_width": size[0],
            "image_height": size[1],
            "camera_name": name,
            "camera_matrix": {"rows": 3, "cols": 3, "data": flat},
            "distortion_model": _MODELS[camera.settings.model],
            "distortion_coefficients": {"rows": 1, "cols": len(distortion), "data": distortion},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": [float(x) for x in np.eye(3).ravel()]},
            "projection_matrix": {"rows": 3, "cols": 4, "data": projection},
        }
        return Exported(yaml.safe_dump(content, sort_keys=False).encode(), 4 + len(distortion))


class OpenCvExporter(_CameraExporter):
    """The exporter ``opencv``: YAML that ``cv::FileStorage`` reads."""

    def export(self, request: ExportRequest) -> Exported:
        """``camera_matrix``, ``distortion_coefficients``, and the poses of camera and boards as 4 x 4 matrices (m)."""
        from armcal_camera.board import opencv

        _, instrument, camera = self._camera(request)
        matrix, distortion, size = _intrinsics(instrument, camera)
        cv2 = opencv()
        storage = cv2.FileStorage("camera.yaml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
        for key, length in zip(("image_width", "image_height"), size or (), strict=False):
            storage.write(key, length)
        storage.write("camera_matrix", matrix)
        storage.write("distortion_coefficients", np.array([distortion]))
        numbers = instrument.numbers
        storage.write(f"{camera.camera_frame}_T_camera", _pose("camera", numbers))
        turned = (entry.removesuffix("_rotation[w]") for entry in numbers if entry.endswith("_rotation[w]"))
        for board in (name for name in turned if name.startswith("board")):
            storage.write(f"{camera.board_frame}_T_{board}", _pose(board, numbers))
        return Exported(storage.releaseAndGetString().encode(), 4 + len(distortion))


class HandEyeExporter(_CameraExporter):
    """The exporter ``hand_eye``: where the camera sits, for easy_handeye and easy_handeye2, and as a URDF joint."""

    Settings: ClassVar[type[CameraExportSettings]] = FramesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"tool_frame": "tool0"}

    def export(self, request: ExportRequest) -> Exported:
        name, instrument, camera = self._camera(request)
        on_hand = camera.camera_frame != BASE_FRAME
        carrier = camera.camera_frame if on_hand else camera.board_frame
        tool_frame = self._settings.tool_frame or ("tool0" if carrier == TOOL_FRAME else carrier)
        parent = tool_frame if on_hand else self._settings.base_frame
        pose, child = _pose("camera", instrument.numbers), self._settings.camera_frame
        place, quaternion = pose[:3, 3].tolist(), Rotation.from_matrix(pose[:3, :3]).as_quat().tolist()
        there, turned = dict(zip("xyz", place, strict=True)), dict(zip("xyzw", quaternion, strict=True))
        stem = request.out.rpartition("/")[2].rpartition(".")[0] or "camera"
        s = self._settings
        own = {
            "robot_base_frame": s.base_frame,
            "robot_effector_frame": tool_frame,
            "tracking_base_frame": s.camera_frame,
            "tracking_marker_frame": s.board_frame,
        }
        # easy_handeye takes parameters for keyword arguments, of which namespace has no default; easy_handeye2 takes
        # all of its file for the fields of a message: neither may have others
        first: dict[str, Any] = {
            "parameters": {"namespace": stem, "eye_on_hand": on_hand, **own},
            "transformation": {**there, **{f"q{axis}": x for axis, x in turned.items()}},
            "standard_deviation_m": {axis: instrument.deviations.get(f"camera_{axis}") for axis in "xyz"},
        }
        kind = "eye_in_hand" if on_hand else "eye_on_base"
        second = {
            "parameters": {"name": stem, "calibration_type": kind, **own, "freehand_robot_movement": True},
            "transform": {"translation": there, "rotation": turned},
        }
        numbers = " ".join(f"--{k} {x:.9g}" for k, x in first["transformation"].items())
        command = f"ros2 run tf2_ros static_transform_publisher {numbers} --frame-id {parent} --child-frame-id {child}"
        title = f"# {parent} to {child}, in metres: the camera {name}.\n"
        text, ros2 = (title + yaml.safe_dump(content, sort_keys=False) for content in (first, second))
        companions = {f"{stem}_joint.urdf": _urdf_joint(parent, child, pose).encode(), f"{stem}.calib": ros2.encode()}
        places = (
            f"easy_handeye reads {stem}.yaml in ~/.ros/easy_handeye, easy_handeye2 {stem}.calib in "
            "~/.ros2/easy_handeye2/calibrations."
        )
        return Exported(text.encode(), 7, companions=companions, remarks=(f"To publish it: {command}", places))


def _intrinsics(instrument: Instrument, camera: Camera) -> tuple[Array, list[float], tuple[int, int] | None]:
    """Camera matrix (px), distortion coefficients, and width and height (px) where they are stated."""
    from armcal_camera.intrinsics import DISTORTION

    n = instrument.numbers
    matrix = np.array([[_PX * n["fx"], 0, _PX * n["cx"]], [0, _PX * n["fy"], _PX * n["cy"]], [0, 0, 1.0]])
    size = camera.image and (round(_PX * camera.image[0]), round(_PX * camera.image[1]))
    return matrix, [n[name] for name in DISTORTION[camera.settings.model]], size


def _pose(name: str, numbers: Mapping[str, float]) -> Array:
    pose = np.eye(4)
    turned = [numbers[f"{name}_rotation[{axis}]"] for axis in "xyzw"]
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat(turned).as_matrix(), [numbers[f"{name}_{axis}"] for axis in "xyz"]
    return pose


def _urdf_joint(parent: str, child: str, pose: Array) -> str:
    rpy = Rotation.from_matrix(pose[:3, :3]).as_euler("xyz")
    place, turn = (" ".join(f"{x:.9g}" for x in numbers) for numbers in (pose[:3, 3], rpy))
    return (
        f'<joint name="{child}_joint" type="fixed">\n  <parent link="{parent}"/>\n  <child link="{child}"/>\n'
        f'  <origin xyz="{place}" rpy="{turn}"/>\n</joint>\n'
    )


def cameras(result: RunResult) -> ReportSection | None:
    described = result.system.description["measurements"]
    start, parts = 0, list[Part]()
    for name, measurement in result.system.measurements.items():
        rows = len(measurement.noise())
        if described[name]["type"] == "camera":
            camera, residual = cast("Camera", measurement), result.errors.calibrated_residual_mm[start : start + rows]
            shape = (len(camera.points), 2, len(result.dataset))
            seen = result.dataset.stacked([f"{name}.{channel.name}" for channel in camera.channels()])
            # Where it saw corners, and measured minus predicted (2 x P x N each, px); NaN of those not seen
            places, off = (numbers.reshape(shape).transpose(1, 0, 2) for numbers in (_PX * seen, residual))
            off = np.where(np.isfinite(places).all(axis=0), off, np.nan)
            count = np.isfinite(off[0]).sum(axis=0)
            errors = np.sqrt(np.nansum(off**2, axis=(0, 1)) / np.maximum(count, 1))
            order = [int(i) for i in np.argsort(-errors)[:_WORST] if count[i]]
            worst = [(result.dataset.ids[i], significant(float(errors[i])), str(count[i])) for i in order]
            title = f"{name}: the images with the largest errors"
            parts += [_over_the_sensor(name, places, off), Table(title, ("Image", "rms, px", "Corners"), worst)]
        start += rows
    return ReportSection("Cameras", parts=parts) if parts else None


def _over_the_sensor(name: str, places: Array, off: Array) -> Figure:
    there = np.isfinite(off).all(axis=0)
    places, off = places[:, there], off[:, there]
    step = max(1, places.shape[1] // _MOST_VECTORS)
    places, off = places[:, ::step], off[:, ::step]
    typical = float(np.median(np.linalg.norm(off, axis=0)))
    enlarged = nice_step(0.02 * float(np.ptp(places, axis=1).max()) / max(typical, 1e-9))
    caption = (
        f"Where corners were seen, all images together; lines are measured minus predicted, "
        f"{significant(enlarged, 1)} times enlarged (median {significant(typical)} px). Lines of neighbours that agree "
        "mean that the lens differs from its model; all lines of an image alike, that the arm stood elsewhere."
    )
    lines = np.stack([places, places + enlarged * off, np.full(places.shape, np.nan)], axis=2).reshape(2, -1)
    marks = [Marks("vector", lines), Marks("dot small", places)]
    panel = Panel("", marks, "u, px", "v, px", equal=True, down=True)
    return Figure(f"{name}: reprojection residuals over the sensor", caption, caption, [panel], columns=1)
