"""Arm models: the chain of joints that a model describes, and the pose of every frame of it."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import casadi as ca
import numpy as np

from armcal.base import se3
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression, Transform
from armcal.plugins import expecting, refuse

Vector3 = tuple[float, float, float]
Z_AXIS: Vector3 = (0.0, 0.0, 1.0)
_UNIT = 1e-9


@dataclass(frozen=True)
class Mimic:
    """How a joint follows another: its displacement is ``multiplier`` times that of ``master``, plus ``offset``.

    ``master`` is a joint of the chain that follows none itself.
    """

    master: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Joint:
    """One joint of a chain."""

    name: str
    parent_T_joint: Transform  # from the moving frame of the joint before it, or the mount, at zero displacement
    angular: Vector3 = Z_AXIS  # the axis of a revolute joint (unit, in its own frame); zeros for a prismatic one
    linear: Vector3 = (0.0, 0.0, 0.0)  # the direction of a prismatic joint; zeros for a revolute one
    offset: Expression = 0.0  # displacement (rad or m) at zero angle
    limits: tuple[float, float] | None = None  # of its displacement less ``offset`` (rad or m), where they are known
    endless: bool = False  # whether it may turn on and on, so that its angle may be of any size
    mimic: Mimic | None = None  # the joint that it follows; records have no column of one that does
    # What it moves along in place of the axis, of any pitch and length: angular and linear part (3x1 each) in its own
    # frame, not far from the axis, which still says whether it turns or slides
    twist: tuple[Expression, Expression] | None = None
    couplings: Mapping[str, float] = field(default_factory=dict)  # times the commands of other joints it contains

    @property
    def is_revolute(self) -> bool:
        """Whether it turns."""
        return any(self.angular)

    @property
    def axis(self) -> Vector3:
        """The direction about which it turns, or along which it slides."""
        return self.angular if self.is_revolute else self.linear

    def motion(self, displacement: Expression) -> Transform:
        """The joint's own motion at a displacement (rad or m), in its frame."""
        if self.twist is not None:
            along = se3.turning_motion if self.is_revolute else se3.sliding_motion
            return along(*self.twist, displacement)
        for name, unit in zip("xyz", ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), Z_AXIS), strict=True):
            if self.angular == unit:
                return se3.rotation_about(name, displacement)
            if self.linear == unit and not self.is_revolute:
                return se3.translation_along(name, displacement)
        angular, linear = (ca.sparsify(ca.SX(list(vector))) for vector in (self.angular, self.linear))
        return se3.screw_motion(angular, linear, displacement)


@dataclass(frozen=True)
class Attachment:
    """A frame fixed to the chain: which joint moves it last (0: none, it stands on the mount), and where it sits."""

    joint: int
    joint_T_frame: Transform


@dataclass(frozen=True)
class Chain:
    """A serial chain in the form that statics and effects work on."""

    base_T_mount: Transform  # from the base frame to what carries joint 1; a base spring deflects about its origin
    joints: tuple[Joint, ...]  # from the base to the tip
    tool: Attachment
    frames: Mapping[str, Attachment] = field(default_factory=dict)  # further ones, for masses and measurements


def check_chain(method: Callable[..., Any], chain: Any, joint_names: Sequence[str]) -> None:
    """Refuse what a method gave as the chain of these joints: other joints, axes, frames or shapes."""
    with expecting(method, chain, f"a Chain of the joints {', '.join(joint_names)}: mount, joints, tool and frames"):
        frames, count = {"tool": chain.tool, **chain.frames}, len(chain.joints)
        for joint in chain.joints:
            if abs(np.linalg.norm(joint.axis) - 1) > _UNIT:
                refuse(
                    method,
                    f"the joint {joint.name} about {joint.angular}, along {joint.linear}",
                    "one of them of length 1",
                )
            if ca.SX(joint.offset).shape != (1, 1):
                refuse(method, f"the offset {joint.offset!r} of the joint {joint.name}", "one expression (rad or m)")
        if [joint.name for joint in chain.joints] != list(joint_names):
            given = f"the joints {', '.join(joint.name for joint in chain.joints)}"
            refuse(method, given, f"a sequence of the joints {', '.join(joint_names)}")
        for name, frame in frames.items():
            if not 0 <= frame.joint <= count:
                refuse(method, f"the frame {name!r} on the joint {frame.joint}", f"0 to {count}: 0 is the mount")
        moved = (joint.parent_T_joint for joint in chain.joints), (frame.joint_T_frame for frame in frames.values())
        for transform in (chain.base_T_mount, *moved[0], *moved[1]):
            if transform.rotation.shape != (3, 3) or transform.translation.shape != (3, 1):
                refuse(method, f"the transform {transform!r}", "a rotation of 3 x 3 and a translation of 3 x 1")


class ArmModel(Protocol):
    """What a plugin provides to describe an arm.

    ``parameters`` are blocks with local names (``theta3``); the framework puts the instance before them
    (``arm.mdh.theta3``). ``chain`` is given their values as CasADi expressions under the local names.
    """

    @property
    def joint_names(self) -> tuple[str, ...]:
        """From the base to the tip."""

    def parameters(self) -> Sequence[ParameterBlock]:
        """Every number of the model."""

    def chain(self, values: Mapping[str, Expression]) -> Chain:
        """The chain as an expression of the parameters."""


@dataclass(frozen=True)
class Site:
    """Where a deflection can happen: the mount or a joint, in the base frame, after the joint's motion."""

    origin: Expression
    rotation: Expression


@dataclass(frozen=True)
class Frames:
    """The pose of everything, in the base frame: sites (0 the mount, i joint i), the tool, the named frames."""

    sites: tuple[Site, ...]
    base_T_tool: Transform
    named: Mapping[str, Transform]


def forward(chain: Chain, displacements: Sequence[Expression], rotations: Mapping[int, Expression]) -> Frames:
    """Forward kinematics at displacements of each joint (rad or m), effects and offsets included.

    ``rotations`` are further ones (3x3) at sites (0 the mount), after the joint's motion.
    """
    moving = [_deflected(chain.base_T_mount, rotations.get(0))]
    for index, (joint, displacement) in enumerate(zip(chain.joints, displacements, strict=True), start=1):
        here = moving[-1] @ joint.parent_T_joint @ joint.motion(displacement)
        moving.append(_deflected(here, rotations.get(index)))
    return Frames(
        sites=tuple(Site(pose.translation, pose.rotation) for pose in moving),
        base_T_tool=moving[chain.tool.joint] @ chain.tool.joint_T_frame,
        named={name: moving[at.joint] @ at.joint_T_frame for name, at in chain.frames.items()},
    )


def _deflected(pose: Transform, rotation: Expression | None) -> Transform:
    return pose if rotation is None else pose @ Transform(rotation, ca.SX(3, 1))
