"""Calibrated cameras in the formats of others: ROS ``camera_info``, OpenCV's YAML, and where the camera sits."""

from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
import yaml
from armcal.arm.statics import BASE_FRAME, TOOL_FRAME
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, Instrument
from armcal.errors import ConfigError
from scipy.spatial.transform import Rotation

from armcal_camera.camera import Camera, CameraSettings
from armcal_camera.images import opencv
from armcal_camera.intrinsics import DISTORTION

_PX = 1000.0
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
        """The camera that is meant: its name, its numbers, and what its settings make of it.

        Raises:
            ConfigError: there is none, or several and none is named.
        """
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
        """Width, height, matrix, distortion; rectification is the identity.

        Raises:
            ConfigError: no such camera, or its image size is not stated.
        """
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
        """``camera_matrix``, ``distortion_coefficients``, and the poses of camera and boards as 4 x 4 matrices (m).

        Raises:
            ConfigError: no such camera.
        """
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
        """The pose of the camera on the hand, or in the world, as translation (m) and quaternion; with its deviations.

        Raises:
            ConfigError: no such camera.
        """
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
