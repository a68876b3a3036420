"""Statics: gravity and load to moments and forces at the mount and the joints.

The moment of every weight beyond a site is the cross product of one first moment with gravity, so the
cost does not grow with the number of masses. [Conenna2024]
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Self

import casadi as ca

from armcal.arm.model import Chain, Frames, Joint, Site, Vector3
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.se3 import Expression

BASE_FRAME, MOUNT_FRAME, TOOL_FRAME = "base", "mount", "tool"


LOAD_CHANNELS = (
    *(f"gravity_{axis}" for axis in "xyz"),
    "payload",
    *(f"payload_{axis}" for axis in "xyz"),
    *(f"force_{axis}" for axis in "xyz"),
    *(f"torque_{axis}" for axis in "xyz"),
)
"""What acts on an arm in a record: m/s^2, kg, m, N, N m."""


@dataclass(frozen=True)
class MassSpec:
    """A mass in a named frame of the chain, ``mount`` or ``tool``: numbers as stated, or expressions of parameters."""

    name: str
    mass: Expression  # kg
    com: Expression  # centre of mass in its frame (3, or 3x1; m)
    frame: str
    loads_up_to: int | None = None  # the last joint it loads (from 1); unless given the one that moves it


@dataclass(frozen=True)
class Load:
    """What acts on the arm in one record."""

    gravity: Expression  # acceleration in the base frame (3x1, m/s^2)
    payload_mass: Expression  # kg, on top of the arm's own masses
    payload_com: Expression  # its centre in the tool frame (3x1, m)
    force: Expression  # external force at the tool frame's origin, in the base frame's axes (3x1, N)
    torque: Expression  # external torque, in the base frame's axes (3x1, N m)
    beyond: tuple[Expression, Expression] | None = None  # mass (kg), first moment (kg m) in the tool beside the payload

    @classmethod
    def of(cls, acting: Sequence[Expression]) -> Self:
        """From numbers in the order of ``LOAD_CHANNELS``."""
        gravity, com, force, torque = (ca.sparsify(ca.vertcat(*acting[i : i + 3])) for i in (0, 4, 7, 10))
        return cls(gravity, acting[3], com, force, torque)


@dataclass(frozen=True)
class SiteWrench:
    """What a site carries, in the base frame: moment about its origin (N m) and force (N)."""

    moment: Expression
    force: Expression


def wrenches(chain: Chain, frames: Frames, masses: Sequence[MassSpec], load: Load) -> tuple[SiteWrench, ...]:
    """The wrench that everything beyond it puts on each site (0 the mount, i joint i)."""
    last = len(chain.joints)
    weight_at: dict[int, Expression] = defaultdict(lambda: ca.SX(0))
    moment_at: dict[int, Expression] = defaultdict(lambda: ca.SX(3, 1))
    mount, moved_by = frames.sites[0], frame_names(chain)
    places = {**frames.named, MOUNT_FRAME: se3.Transform(mount.rotation, mount.origin), TOOL_FRAME: frames.base_T_tool}
    for mass in masses:
        up_to = moved_by[mass.frame] if mass.loads_up_to is None else mass.loads_up_to
        weight_at[up_to] += mass.mass
        moment_at[up_to] += mass.mass * places[mass.frame].apply(mass.com)
    weight_at[last] += load.payload_mass
    moment_at[last] += load.payload_mass * frames.base_T_tool.apply(load.payload_com)
    if load.beyond is not None:
        mass, moment = load.beyond
        weight_at[last] += mass
        moment_at[last] += mass * frames.base_T_tool.translation + ca.mtimes(frames.base_T_tool.rotation, moment)
    result: list[SiteWrench] = []
    weight, first_moment = ca.SX(0), ca.SX(3, 1)
    for index in reversed(range(last + 1)):
        weight, first_moment = weight + weight_at[index], first_moment + moment_at[index]
        origin = frames.sites[index].origin
        moment = _cross(first_moment - weight * origin, load.gravity) + load.torque
        moment += _cross(frames.base_T_tool.translation - origin, load.force)
        result.append(SiteWrench(moment, weight * load.gravity + load.force))
    return tuple(reversed(result))


def effort(joint: Joint, site: Site, wrench: SiteWrench) -> Expression:
    """What a wrench does along a joint's own motion: its work per displacement (N m; N on a sliding joint)."""
    if joint.twist is None:
        axis = ca.mtimes(site.rotation, ca.SX(list(joint.axis)))
        return ca.dot(axis, wrench.moment if joint.is_revolute else wrench.force)
    angular, linear = (ca.mtimes(site.rotation, part) for part in joint.twist)
    return ca.dot(angular, wrench.moment) + ca.dot(linear, wrench.force)


def joint_efforts(chain: Chain, frames: Frames, acting: Sequence[SiteWrench]) -> Expression:
    """What wrenches do about or along each joint's own axis (joints x 1; N m, N on sliding joints)."""
    joints = zip(chain.joints, frames.sites[1:], acting[1:], strict=True)
    return ca.vertcat(*[effort(joint, site, wrench) for joint, site, wrench in joints])


def _cross(a: Expression, b: Expression) -> Expression:
    return ca.cross(ca.densify(a), ca.densify(b))


def frame_names(chain: Chain) -> Mapping[str, int]:
    moved_by = {name: at.joint for name, at in chain.frames.items()}
    return {MOUNT_FRAME: 0, **moved_by, TOOL_FRAME: chain.tool.joint}


_ZERO: Vector3 = (0.0, 0.0, 0.0)
STATICS = "statics"  # The instance name of what acts on all arms


@dataclass(frozen=True)
class Environment:
    """What acts on the arms where a record does not say: gravity (m/s^2), payload (kg, m), wrench (N, N m)."""

    gravity: Vector3
    payload_mass: float = 0.0
    payload_com: Vector3 = _ZERO
    force: Vector3 = _ZERO
    torque: Vector3 = _ZERO

    @property
    def acting(self) -> tuple[float, ...]:
        return (*self.gravity, self.payload_mass, *self.payload_com, *self.force, *self.torque)

    @property
    def load(self) -> Load:
        return Load.of([ca.SX(number) for number in self.acting])


SAG_RAD = 0.002  # What a joint plausibly gives under half the moment that its arm's whole weight has at full reach


def plausible_compliance(load_Nm: float) -> float:
    """Of a joint (rad/(N m)) whose arm's whole weight has this moment at full reach."""
    return SAG_RAD / (0.5 * load_Nm)


def gravity_tilt() -> tuple[ParameterBlock, ...]:
    """How the real gravity is turned from the stated one, about the base frame's x and y axes (rad)."""
    return tuple(scalar(f"{STATICS}.gravity_{axis}", "rad", 0.0, 0.02) for axis in ("rx", "ry"))


def unstated_payload() -> tuple[ParameterBlock, ...]:
    """What hangs on the tool beyond what is stated: its mass (kg), its first moments in the tool frame (kg m)."""
    moments = (scalar(f"{STATICS}.payload_moment_{axis}", "kg_m", 0.0, 0.005) for axis in "xyz")
    return scalar(f"{STATICS}.payload", "kg", 0.0, 0.1), *moments


def tilted(load: Load, values: Mapping[str, Expression]) -> Load:
    """A load under the real gravity.

    ``values`` are those of ``gravity_tilt`` and those of ``unstated_payload``, by local name, where they are followed.
    """
    real = load
    if "gravity_rx" in values:
        about_x, about_y = (se3.rotation_about(axis, values[f"gravity_r{axis}"]).rotation for axis in "xy")
        real = replace(load, gravity=ca.mtimes(about_y, ca.mtimes(about_x, load.gravity)))
    if "payload" not in values:
        return real
    return replace(real, beyond=(values["payload"], ca.vertcat(*(values[f"payload_moment_{axis}"] for axis in "xyz"))))
