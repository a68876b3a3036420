"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_readers(register: Register) -> None:
    register("rosbag2", "armcal_ros2.reader:Rosbag2Reader", "the rests of an arm in a recording of ROS 2")


@hookimpl
def armcal_register_commands(register: Register) -> None:
    register("bag", "armcal_ros2.bag_command:bag", "Look into a recording of ROS 2, and take images out of it.")


@hookimpl
def armcal_register_exporters(register: Register) -> None:
    register("ros2-node", "armcal_ros2.node:Ros2NodeExporter", "a ROS 2 node that feeds a recalibration")
