"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    register("ball_in_socket", "armcal_contact.contacts:BallInSocket", "a ball on the tool, seated in sockets")
    register("clamped_tool", "armcal_contact.contacts:ClampedTool", "the tool clamped at points that do not move")
    register("plane_contact", "armcal_contact.contacts:PlaneContact", "a tip that touches planes")
    register("tip_distance", "armcal_contact.contacts:TipDistance", "the distance between the tips of two records")


@hookimpl
def armcal_register_readers(register: Register) -> None:
    register("mukca", "armcal_contact.mukca_reader:MukcaReader", "folders of postures with a ball in two sockets")


@hookimpl
def armcal_register_joint_streams(register: Register) -> None:
    register("json_lines", "armcal_contact.json_joints:JsonLinesJoints", "a JSON object a line: UDP, a pipe, a file")
