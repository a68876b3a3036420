"""The chain between two links, in the words that parameters, frames and records use, and the masses it moves."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np
from armcal.arm.model import Mimic
from armcal.arm.statics import MOUNT_FRAME, TOOL_FRAME, MassSpec
from armcal.base.arrays import Array
from scipy.spatial.transform import Rotation

from armcal_urdf.robot import FREE, MOVING, Robot, UrdfJoint

_UNFIT = re.compile(r"[^\w-]")


@dataclass(frozen=True)
class ChainJoint:
    """A joint of the chain.

    Attributes:
        name: as parameters and records call it.
        frame: what the frame of the link behind it is called.
        mimic: the independent joint that it follows, by its name here.
        urdf: as written.
    """

    name: str
    frame: str
    mimic: Mimic | None
    urdf: UrdfJoint

    @property
    def moves(self) -> bool:
        return self.urdf.kind in MOVING


@dataclass(frozen=True)
class UrdfChain:
    """A chain: the frame of the link that it stands on, its joints, and the masses that these move."""

    root_frame: str
    joints: tuple[ChainJoint, ...]
    masses: tuple[MassSpec, ...]

    @property
    def moving(self) -> tuple[ChainJoint, ...]:
        return tuple(joint for joint in self.joints if joint.moves)


def chain_of(robot: Robot, root: str | None, tip: str | None) -> UrdfChain:
    """The chain from a link (None: the tree's root) out to another (None: the only leaf).

    Raises:
        ValueError: no such link, no such path, or several leaves.
        ConfigError: a joint on the path is none that a chain can have; with file and line.
    """
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
    """Root and tip by name.

    Raises:
        ValueError: no such link, the tip is not beyond the root, or several leaves.
    """
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
    """What the frames of links are called: armcal has a mount and a tool of its own.

    Raises:
        ValueError: two links would share a name.
    """
    renamed = {name: f"{name}_link" for name in (MOUNT_FRAME, TOOL_FRAME)}
    fitting = {link: renamed.get(name, name) for link, name in _fitting("link", links).items()}
    return _different("link", fitting)


def _fitting(kind: str, names: list[str]) -> Mapping[str, str]:
    """Names with only letters, digits, _ and -: parameters, channels and globs use the rest."""
    return _different(kind, {name: _UNFIT.sub("_", name) for name in names})


def _different(kind: str, fitting: Mapping[str, str]) -> Mapping[str, str]:
    first: dict[str, str] = {}
    for name, called in fitting.items():
        if called in first:
            raise ValueError(f"the {kind}s {first[called]!r} and {name!r} would both be called {called!r}; rename one")
        first[called] = name
    return fitting


def _independent(joint: UrdfJoint, path: tuple[UrdfJoint, ...], names: Mapping[str, str]) -> Mimic | None:
    """The joint that this one follows in the end, through others that follow too."""
    if joint.mimic is None:
        return None
    moving = {urdf_joint.name: urdf_joint for urdf_joint in path if urdf_joint.kind in MOVING}
    mimic, passed = joint.mimic, [joint.name]
    while True:
        master = moving.get(mimic.master)
        if master is None:
            joint.element.refuse(
                f"joint {joint.name!r} follows {mimic.master!r}, which is no moving joint of the chain.",
                f"The chain has {', '.join(moving)}; choose root and tip so that it has both, or neither.",
            )
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
