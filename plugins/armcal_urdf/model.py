"""The arm model ``urdf``: any serial chain between two links, with six numbers for every joint on it."""

import math
from collections.abc import Mapping
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
from armcal.arm.model import Attachment, Chain, Joint, Vector3
from armcal.arm.statics import MassSpec
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.quaternions import rpy_matrices, rpy_of
from armcal.base.settings import InputPath, Settings
from pydantic import model_validator

from armcal_urdf.chain import UrdfChain, chain_of, ends
from armcal_urdf.elements import Three
from armcal_urdf.encoding import MAX_BYTES, Encoding, declared, encode, read_text
from armcal_urdf.robot import Robot, UrdfJoint, read_robot

LENGTH_SCALE_M = 0.01
ANGLE_SCALE_RAD = 0.05
XYZ = ("x", "y", "z")
RPY = ("roll", "pitch", "yaw")
LOCKED = 0.95
"""A sine of the pitch, which is the correlation of roll and yaw: beyond it a third rotation is hardly there."""
_STILL: Vector3 = (0.0, 0.0, 0.0)
_EXAMPLE = """<robot name="example">
  <link name="base"/>
  <joint name="turn" type="revolute">
    <origin xyz="0 0 0.3"/> <parent link="base"/> <child link="column"/>
    <axis xyz="0 0 1"/> <limit lower="-2.5" upper="2.5" effort="50" velocity="1"/>
  </joint>
  <link name="column"><inertial><origin xyz="0 0 0.1"/> <mass value="2.5"/></inertial></link>
  <joint name="tilt" type="revolute">
    <origin xyz="0.1 0 0.2" rpy="0.3 -0.2 0.1"/> <parent link="column"/> <child link="beam"/>
    <axis xyz="0 0.6 0.8"/> <limit lower="-1.5" upper="1.5" effort="50" velocity="1"/>
  </joint>
  <link name="beam"><inertial><origin xyz="0.2 0 0"/> <mass value="1.5"/></inertial></link>
  <joint name="slide" type="prismatic">
    <origin xyz="0.4 0 0" rpy="0 1.2 0"/> <parent link="beam"/> <child link="rod"/>
    <axis xyz="0 0 -1"/> <limit lower="0" upper="0.2" effort="50" velocity="1"/>
  </joint>
  <link name="rod"/>
  <joint name="flange" type="fixed"> <origin xyz="0 0 0.05"/> <parent link="rod"/> <child link="hand"/> </joint>
  <link name="hand"/>
</robot>
"""


class UrdfSettings(Settings):
    """A URDF, as a file (``path``) or as it stands (``text``), and two links of it.

    Attributes:
        path: the file. It is read at once, and its content kept in ``text``: a calibration holds it whole.
        text: the URDF.
        encoding: of the file, so that it can be written again byte for byte.
        file: the name of the file that the text was read from.
        root: the link that the chain stands on, and whose frame is the base; the tree's root unless given.
        tip: the link whose frame is the tool; the tree's only leaf unless given.
        inertials: whether stated masses load the arm.
        gimbal_lock: ``avoid`` counts the angles of a joint whose pitch is near a right angle from that right angle;
            ``keep`` has the roll, pitch and yaw of the file there too, of which two are then one rotation.
    """

    path: InputPath | None = None
    text: str = ""
    encoding: Encoding | None = None
    file: str = ""
    root: str | None = None
    tip: str | None = None
    inertials: Literal["use", "ignore"] = "use"
    gimbal_lock: Literal["avoid", "keep"] = "avoid"

    @model_validator(mode="after")
    def _read(self) -> Self:
        """The content of the file takes the place of its path; ends and encoding are written out."""
        if (self.path is None) == (not self.text):
            text = "both path and text" if self.text else "neither path nor text"
            raise ValueError(f"found {text}; give path: FILE, or text: the URDF itself")
        if self.path is not None and (self.encoding or self.file):
            raise ValueError("encoding and file belong to a text; a file's own are read from it")
        if len(self.text.encode("utf-8", "replace")) > MAX_BYTES:
            raise ValueError(f"the text is larger than {MAX_BYTES // 1024} KiB")
        label = self.file if self.path is None else str(self.path)
        content: dict[str, Any] = {"path": None, "text": str(self.text)}
        if self.path is not None:
            content["text"], content["encoding"] = read_text(self.path)
            content["file"] = self.path.name
        elif self.encoding is None:
            content["encoding"] = declared(self.text, label) or "utf-8"
        robot = read_robot(content["text"], label)
        encode(content["text"], content.get("encoding") or self.encoding or "utf-8")
        content["root"], content["tip"] = ends(robot, self.root, self.tip)
        for name, value in content.items():
            object.__setattr__(self, name, value)
        chain_of(robot, self.root, self.tip)
        return self

    def to_config(self) -> dict[str, Any]:
        return {name: value for name, value in super().to_config().items() if name != "path"}

    def quarter_turn(self, joint: UrdfJoint) -> float:
        """What is turned about y (rad) before a joint's parameters turn it: a right angle where its pitch is near one.

        Such a pitch makes roll and yaw one rotation (gimbal lock); counted from the right angle, the angles are small.
        """
        sine = math.sin(joint.rpy[1])
        locked = abs(sine) > LOCKED and self.gimbal_lock == "avoid"
        return math.copysign(math.pi / 2, sine) if locked else 0.0

    def nominal_angles(self, joint: UrdfJoint) -> Three:
        """The parameters roll, pitch and yaw (rad) of a joint as the URDF has it."""
        return turned(joint.rpy, -self.quarter_turn(joint))

    @property
    def robot(self) -> Robot:
        return read_robot(self.text, self.file)

    @property
    def content(self) -> bytes:
        return encode(self.text, self.encoding or "utf-8")


def turned(rpy: Three, angle: float) -> Three:
    """Roll, pitch and yaw of Rz(yaw) Ry(pitch) Rx(roll) Ry(angle) (rad); at no angle the same numbers."""
    if not angle:
        return rpy
    about_y, before = rpy_matrices(np.array([0.0, angle, 0.0])), rpy_matrices(np.array(rpy))
    return rpy_of(before @ about_y)


class UrdfModel:
    """The arm model ``urdf``: parameters ``JOINT_x``, ``JOINT_y``, ``JOINT_z`` (m), ``JOINT_roll``, ... (rad).

    Every joint from root to tip has its six, fixed joints too. The base frame and the mount are the root link's.
    A joint is turned by Rz(yaw) Ry(pitch) Rx(roll) Ry(``quarter_turn``).
    """

    Settings: ClassVar[type[UrdfSettings]] = UrdfSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"text": _EXAMPLE}

    def __init__(self, settings: UrdfSettings) -> None:
        self.settings = settings

    @cached_property
    def urdf_chain(self) -> UrdfChain:
        return chain_of(self.settings.robot, self.settings.root, self.settings.tip)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.urdf_chain.moving)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """The origins of all joints on the chain: xyz (m) and rpy (rad)."""
        blocks: list[ParameterBlock] = []
        for joint in self.urdf_chain.joints:
            xyz = zip(XYZ, joint.urdf.xyz, strict=True)
            rpy = zip(RPY, self.settings.nominal_angles(joint.urdf), strict=True)
            blocks += [scalar(f"{joint.name}_{name}", "m", value, LENGTH_SCALE_M) for name, value in xyz]
            blocks += [scalar(f"{joint.name}_{name}", "rad", value, ANGLE_SCALE_RAD) for name, value in rpy]
        return tuple(blocks)

    def masses(self) -> tuple[MassSpec, ...]:
        return self.urdf_chain.masses if self.settings.inertials == "use" else ()

    def chain(self, values: Mapping[str, Any]) -> Chain:
        """Origins and motions in turn; every link is a frame."""
        joints: list[Joint] = []
        frames = {self.urdf_chain.root_frame: Attachment(0, se3.identity())}
        here = se3.identity()
        for joint in self.urdf_chain.joints:
            # translation, then Rz(yaw) Ry(pitch) Rx(roll) [URDF]
            shift = se3.translation(*[values[f"{joint.name}_{axis}"] for axis in XYZ])
            roll, pitch, yaw = (values[f"{joint.name}_{angle}"] for angle in RPY)
            turn = se3.rotation_about("z", yaw) @ se3.rotation_about("y", pitch) @ se3.rotation_about("x", roll)
            quarter = self.settings.quarter_turn(joint.urdf)
            if quarter:
                turn = turn @ se3.rotation_about("y", quarter)
            here = here @ (shift @ turn)
            if joint.moves:
                urdf, slides = joint.urdf, joint.urdf.kind == "prismatic"
                angular, linear = (_STILL, urdf.axis) if slides else (urdf.axis, _STILL)
                endless = urdf.kind == "continuous"
                joints.append(
                    Joint(joint.name, here, angular, linear, limits=urdf.limits, endless=endless, mimic=joint.mimic)
                )
                here = se3.identity()
            frames[joint.frame] = Attachment(len(joints), here)
        return Chain(se3.identity(), tuple(joints), Attachment(len(joints), here), frames)
