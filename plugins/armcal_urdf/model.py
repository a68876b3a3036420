"""The arm model ``urdf``: any serial chain between two links, with six numbers for every joint on it."""

import math
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, Self

import numpy as np
from armcal.arm.model import Attachment, Chain, Joint, Mimic, Vector3
from armcal.arm.statics import MOUNT_FRAME, TOOL_FRAME, MassSpec
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.quaternions import rpy_matrices, rpy_of
from armcal.base.settings import InputPath, Settings
from pydantic import model_validator
from scipy.spatial.transform import Rotation

from armcal_urdf.robot import FREE, MAX_BYTES, MOVING, Encoding, Robot, Three, UrdfJoint, read_robot, read_text

_UNFIT = re.compile(r"[^A-Za-z0-9_-]")


@dataclass(frozen=True)
class ChainJoint:
    name: str  # as parameters and records call it
    frame: str  # what the frame of the link behind it is called
    mimic: Mimic | None  # the independent joint that it follows, by its name here
    urdf: UrdfJoint  # as written

    @property
    def moves(self) -> bool:
        return self.urdf.kind in MOVING


@dataclass(frozen=True)
class UrdfChain:
    root_frame: str  # of the link that it stands on
    joints: tuple[ChainJoint, ...]
    masses: tuple[MassSpec, ...]  # that the joints move

    @property
    def moving(self) -> tuple[ChainJoint, ...]:
        return tuple(joint for joint in self.joints if joint.moves)


def chain_of(robot: Robot, root: str | None, tip: str | None) -> UrdfChain:
    """The chain from a link (None: the tree's root) out to another (None: the only leaf)."""
    root, tip = ends(robot, root, tip)
    path = robot.path(root, tip) or ()
    for joint in path:
        if joint.kind in FREE:
            joint.element.refuse(
                f"joint {joint.name!r} is {joint.kind}, and stands between {root!r} and {tip!r}.",
                "Give root or tip so that the chain leaves it out: a chain has revolute, prismatic and fixed joints.",
            )
    if not any(joint.kind in MOVING for joint in path):
        raise ValueError(f"no joint between the links {root!r} and {tip!r} moves; give root and tip of the arm")
    names = _fitting("joint", [joint.name for joint in path])
    frames = frame_names([root, *(joint.child for joint in path)])
    joints = tuple(
        ChainJoint(names[joint.name], frames[joint.child], _independent(joint, path, names), joint) for joint in path
    )
    return UrdfChain(frames[root], joints, _masses(robot, joints))


def ends(robot: Robot, root: str | None, tip: str | None) -> tuple[str, str]:
    for name, link in (("root", root), ("tip", tip)):
        if link is not None and link not in robot.links:
            raise ValueError(f"{name}: no link is called {link!r}; the links are {', '.join(robot.links)}")
    start = robot.root if root is None else root
    if tip is None:
        leaves = robot.leaves(start)
        if len(leaves) > 1:
            raise ValueError(f"the tree ends in {len(leaves)} links, {', '.join(leaves)}; say which is the tip: LINK")
        return start, leaves[0]
    if robot.path(start, tip) is None:
        raise ValueError(f"the tip {tip!r} is not beyond the root {start!r}; links above the root cannot be its tip")
    return start, tip


def frame_names(links: list[str]) -> Mapping[str, str]:
    """What the frames of links are called: armcal has a mount and a tool of its own."""
    renamed = {name: f"{name}_link" for name in (MOUNT_FRAME, TOOL_FRAME)}
    fitting = {link: renamed.get(name, name) for link, name in _fitting("link", links).items()}
    return _different("link", fitting)


def _fitting(kind: str, names: list[str]) -> Mapping[str, str]:
    """Names with a letter first and only letters, digits, _ and -: parameters, channels and globs use the rest."""
    fitting = {name: _UNFIT.sub("_", name) for name in names}
    return _different(kind, {name: own if own[0].isalpha() else f"{kind}_{own}" for name, own in fitting.items()})


def _different(kind: str, fitting: Mapping[str, str]) -> Mapping[str, str]:
    first: dict[str, str] = {}
    for name, called in fitting.items():
        if called in first:
            raise ValueError(f"the {kind}s {first[called]!r} and {name!r} would both be called {called!r}; rename one")
        first[called] = name
    return fitting


def _independent(joint: UrdfJoint, path: tuple[UrdfJoint, ...], names: Mapping[str, str]) -> Mimic | None:
    """The joint of the chain that this one follows in the end, through others that follow too; None where it is off."""
    if joint.mimic is None:
        return None
    moving = {urdf_joint.name: urdf_joint for urdf_joint in path if urdf_joint.kind in MOVING}
    mimic, passed = joint.mimic, [joint.name]
    while True:
        master = moving.get(mimic.master)
        if master is None:
            return None
        if master.name in passed:
            joint.element.refuse(
                f"joints follow one another in a circle: {', '.join([*passed, master.name])}.", "Free one of them."
            )
        if master.mimic is None:
            return replace(mimic, master=names[mimic.master])
        passed.append(master.name)
        beyond = master.mimic
        offset = mimic.multiplier * beyond.offset + mimic.offset
        mimic = Mimic(beyond.master, mimic.multiplier * beyond.multiplier, offset)


def _masses(robot: Robot, joints: tuple[ChainJoint, ...]) -> tuple[MassSpec, ...]:
    """What the chain moves, links that hang on it by joints off the chain (at zero) too."""
    on_chain = {joint.urdf.name for joint in joints}
    masses: list[tuple[str, float, Array, str]] = []
    moved = False
    for joint in joints:
        moved = moved or joint.moves
        for link, pose in _hanging(robot, joint.urdf.child, on_chain) if moved else ():
            stated = robot.links[link]
            if stated.mass > 0:
                masses.append((link, stated.mass, pose[:3, :3] @ np.array(stated.com) + pose[:3, 3], joint.frame))
    names = _fitting("link", [link for link, *_ in masses])
    return tuple(
        MassSpec(names[link], mass, (float(com[0]), float(com[1]), float(com[2])), frame)
        for link, mass, com, frame in masses
    )


def _hanging(robot: Robot, link: str, on_chain: set[str]) -> Iterator[tuple[str, Array]]:
    """A link and all that hangs on it off the chain, each with its pose (4x4) in the link's frame."""
    waiting = [(link, np.eye(4))]
    while waiting:
        here, pose = waiting.pop(0)
        yield here, pose
        for joint in robot.below[here]:
            if joint.name not in on_chain:
                origin = np.eye(4)
                origin[:3, :3], origin[:3, 3] = Rotation.from_euler("xyz", joint.rpy).as_matrix(), joint.xyz
                waiting.append((joint.child, pose @ origin))


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
        root: the link that the chain stands on, and whose frame is the base; the tree's root unless given.
        gimbal_lock: ``avoid`` counts the angles of a joint whose pitch is near a right angle from that right angle;
            ``keep`` has the roll, pitch and yaw of the file there too, of which two are then one rotation.
    """

    path: InputPath | None = None
    text: str = ""  # the URDF
    encoding: Encoding | None = None  # of the file, so that it can be written again byte for byte
    file: str = ""  # the name of the file that the text was read from
    root: str | None = None
    tip: str | None = None  # the link whose frame is the tool; the tree's only leaf unless given
    inertials: Literal["use", "ignore"] = "use"  # whether stated masses load the arm
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
            content["encoding"] = "utf-8"
        robot = read_robot(content["text"], label)
        content["text"].encode(content.get("encoding") or self.encoding)
        content["root"], content["tip"] = ends(robot, self.root, self.tip)
        for name, value in content.items():
            object.__setattr__(self, name, value)
        chain_of(robot, self.root, self.tip)
        return self

    @property
    def notes(self) -> tuple[str, ...]:
        """What is ignored in the URDF, and which of its joints have another name here."""
        robot = self.robot
        ignored = [f"ignored: {', '.join(robot.ignored)}"] if robot.ignored else []
        joints = chain_of(robot, self.root, self.tip).moving
        renamed = [f"{joint.urdf.name} is {joint.name}" for joint in joints if joint.name != joint.urdf.name]
        if renamed:
            ignored.append(f"joints are named so that columns can be: {', '.join(renamed)}")
        for joint in joints:
            if joint.urdf.mimic and not joint.mimic:
                ignored.append(
                    f"{joint.urdf.name} follows {joint.urdf.mimic.master}, which is no moving joint of the chain from "
                    f"{self.root} to {self.tip}: {joint.name} needs angles of its own"
                )
        return tuple(ignored)

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
        return self.text.encode(self.encoding or "utf-8")


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
