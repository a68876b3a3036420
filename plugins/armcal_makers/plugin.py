"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_commands(register: Register) -> None:
    register("maker", "armcal_makers.files:maker", "Read a maker's calibration: compare it, write it as a URDF.")


@hookimpl
def armcal_register_exporters(register: Register) -> None:
    register("ur_calibration", "armcal_makers.files:UrExporter", "the kinematics YAML of ur_calibration")
    register("xarm_kinematics", "armcal_makers.files:XarmExporter", "the kinematics YAML of xarm_ros and xarm_ros2")
