"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_readers(register: Register) -> None:
    register("images", "armcal_camera.images_reader:ImagesReader", "images of boards, and where the arm stood for each")


@hookimpl
def armcal_register_commands(register: Register) -> None:
    register("board", "armcal_camera.board_command:board", "Write a board to print, and its settings.")


@hookimpl
def armcal_register_models(register: Register) -> None:
    register("flange_pose", "armcal_camera.pose_table:FlangePose", "an arm of which only flange poses are recorded")


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    register("camera", "armcal_camera.camera:Camera", "corners of boards in the images of a camera")


@hookimpl
def armcal_register_cameras(register: Register) -> None:
    register("opencv", "armcal_camera.images_reader:LiveImages", "a camera of OpenCV, or a folder that fills")


@hookimpl
def armcal_register_exporters(register: Register) -> None:
    register("camera_info", "armcal_camera.export:CameraInfoExporter", "a camera's intrinsics as ROS camera_info YAML")
    register("opencv", "armcal_camera.export:OpenCvExporter", "a camera's intrinsics and poses as OpenCV YAML")
    register("hand_eye", "armcal_camera.export:HandEyeExporter", "where a camera sits: YAML, URDF joint, ROS 2 command")


@hookimpl
def armcal_register_report_sections(register: Register) -> None:
    register("cameras", "armcal_camera.export:cameras", "reprojection residuals over the sensor and by image")
