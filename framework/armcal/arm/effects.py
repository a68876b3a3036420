"""Joint effects: what stands between the commanded and the real displacement of a joint."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import numpy as np

from armcal.arm.joints import unknown_joint
from armcal.arm.model import Z_AXIS, Chain, Vector3
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression
from armcal.base.settings import Settings
from armcal.plugins import expecting, refuse

JointChoice = Literal["all"] | tuple[str, ...]  # All joints, or some by name
XYZ: tuple[Vector3, ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), Z_AXIS)
"""The directions of a spring that gives about every axis."""
_Settings = Settings
_UNIT = 1e-9


@dataclass(frozen=True)
class JointCommand:
    """What is recorded of one joint: its commanded displacement and the direction it came from."""

    index: int  # from 0
    commanded: Expression  # rad or m
    approach: Expression  # the sign of the joint's last motion, 0 where it is not known

    @property
    def joint(self) -> int:
        """The joint's number, from 1."""
        return self.index + 1


MOUNT = JointCommand(-1, 0.0, 0.0)  # What the law of a spring at the mount is given, which nothing commands


@dataclass(frozen=True)
class Spring:
    """An elastic deflection at a site.

    ``law`` leads from generalised loads (N m, or N on a prismatic joint's own axis; one a coordinate) and what its
    joint was commanded (``MOUNT`` at the mount) to deflections (rad or m).
    """

    site: int  # 0 for the mount, i for joint i (from 1)
    directions: tuple[Vector3, ...]  # unit vectors in the site's frame, after its motion; none: the joint's own axis
    law: Callable[[Expression, JointCommand], Expression]

    @property
    def size(self) -> int:
        """How many coordinates it has."""
        return max(1, len(self.directions))


def check_springs(method: Callable[..., Any], given: Any, joints: int) -> tuple[Spring, ...]:
    """What a method gave as springs of an arm of so many joints, or refuse other sites, directions and laws."""
    with expecting(method, given, "a sequence of Spring(site, directions, law)"):
        springs: tuple[Spring, ...] = tuple(given)
        for spring in springs:
            if not 0 <= spring.site <= joints:
                refuse(method, f"a spring at the site {spring.site}", f"0 to {joints}: 0 is the mount, i is joint i")
            if spring.site == 0 and not spring.directions:
                odd = "a spring at the mount without directions"
                refuse(method, odd, "directions: the mount has no axis of its own")
            for direction in spring.directions:
                if np.shape(direction) != (3,) or abs(np.linalg.norm(direction) - 1) > _UNIT:
                    refuse(method, f"the direction {direction}", "a unit vector of three numbers")
            if not callable(spring.law):
                refuse(method, f"a law of type {type(spring.law).__name__}", "a function of load and command")
    return springs


@dataclass(frozen=True)
class Condition:
    """A recorded number of the surroundings that an effect reads."""

    name: str  # of its column, without the unit suffix (``humidity``)
    dimension: str | None = None  # ``dimensionless`` for a pure number; None of what any record may carry


JOINT_RATE = "joint rate"  # The dimension of rates of joints, sliding ones too


def joint_rate(joint: str) -> Condition:
    """How fast a joint moved when its place was recorded (rad/s or m/s): ``q1_rate``."""
    return Condition(f"{joint}_rate", JOINT_RATE)


class EffectSettings(Settings):
    """Which joints an effect is on."""

    joints: JointChoice = "all"


class JointEffect:
    """Base of joint effects: servos, gears, springs, for any arm model. What a subclass does not say is nothing.

    Values come as CasADi expressions under the names of ``parameters``. An expression may branch on what was recorded
    (a command, an approach), never on a parameter.

    Attributes:
        Settings: the class of its checked settings.
        conditions: the recorded numbers that ``shaped`` reads, each a column; a bare name is one that any record may
            carry (``temperature``, in C). Every measured record must have them, a prediction may lack them.
        settings: its own, checked.
        joints: the numbers (from 1) of the joints that it is on: those that settings called ``joints`` name, or all.
    """

    Settings: ClassVar[type[_Settings]] = EffectSettings
    conditions: Sequence[str | Condition] = ()

    def __init__(self, settings: Any, joint_names: Sequence[str]) -> None:
        self.settings = settings
        self.joints = chosen(getattr(settings, "joints", "all"), joint_names)

    def parameters(self) -> Sequence[ParameterBlock]:
        """Every number of the effect, under local names."""
        return ()

    def displacement(self, command: JointCommand, values: Mapping[str, Expression]) -> Expression:
        """What the effect adds to a joint's commanded displacement (rad or m); it is asked of every joint."""
        return 0

    def zeros(self) -> Mapping[str, int]:
        """Which parameters (local names, rad) are the zero of a joint, and the number of that joint."""
        return {}

    def springs(self, values: Mapping[str, Expression]) -> Sequence[Spring]:
        """The effect's elastic deflections."""
        return ()

    def shaped(self, chain: Chain, conditions: Mapping[str, Expression], values: Mapping[str, Expression]) -> Chain:
        """The chain under the recorded ``conditions``.

        Where a prediction lacks one, use a reference value, or let the ``KeyError`` of the missing name pass: then it
        is refused.
        """
        return chain


def reshapes(effect: JointEffect) -> bool:
    return type(effect).shaped is not JointEffect.shaped


def chosen(joints: JointChoice, joint_names: Sequence[str]) -> tuple[int, ...]:
    """The numbers (from 1) of the chosen joints, in the order of the chain."""
    names = joint_names if joints == "all" else joints
    if fault := unknown_joint(names, joint_names):
        raise ValueError(fault)
    return tuple(i for i, name in enumerate(joint_names, start=1) if name in names)
