"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_readers(register: Register) -> None:
    """Announce the reader."""
    register("images", "armcal_camera.images_reader:ImagesReader", "images of boards, and where the arm stood for each")


@hookimpl
def armcal_register_commands(register: Register) -> None:
    """Announce the command."""
    register("board", "armcal_camera.board_command:board", "Write a board to print, and its settings.")


@hookimpl
def armcal_register_models(register: Register) -> None:
    """Announce the arm model."""
    register("flange_pose", "armcal_camera.flange_pose:FlangePose", "an arm of which only flange poses are recorded")


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    """Announce the measurement."""
    register("camera", "armcal_camera.camera:Camera", "corners of boards in the images of a camera")


@hookimpl
def armcal_register_cameras(register: Register) -> None:
    """Announce the live camera."""
    register("opencv", "armcal_camera.live:Camera", "a camera of OpenCV, or a folder to which images come one by one")


@hookimpl
def armcal_register_exporters(register: Register) -> None:
    """Announce the exporters."""
    register("camera_info", "armcal_camera.export:CameraInfoExporter", "a camera's intrinsics as ROS camera_info YAML")
    register("opencv", "armcal_camera.export:OpenCvExporter", "a camera's intrinsics and poses as OpenCV YAML")
    register("hand_eye", "armcal_camera.export:HandEyeExporter", "where a camera sits: YAML, URDF joint, ROS 2 command")


@hookimpl
def armcal_register_report_sections(register: Register) -> None:
    """Announce the section of the report."""
    register("cameras", "armcal_camera.report:cameras", "reprojection residuals over the sensor and by image")
