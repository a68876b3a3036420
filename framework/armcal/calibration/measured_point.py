"""The point of a tool that instruments read: a ball, a reflector or a marker, seldom at the tool's origin."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, get_args

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, ArmState, scoped
from armcal.arm.model import forward
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.base.quaternions import rotation_matrix
from armcal.base.se3 import Transform, evaluated
from armcal.config.system import System
from armcal.errors import ConfigError
from armcal.measure.measurement import Measurement

Point = Literal["tool", "target"]  # What arrives: the origin of the tool's frame, or the target that was measured

_QUATERNION = ("qw", "qx", "qy", "qz")
_SAME_M = 1e-9


@dataclass(frozen=True)
class MeasuredPoint:
    """What a measurement reads of a tool.

    Attributes:
        fitted: whether free parameters of the measurement say where the target sits: the records then determine where
            the target goes, and not where the tool's origin is beside it.
    """

    measurement: str  # its instance name
    tool_T_target: Array  # the pose of the target (4 x 4)
    fitted: bool = False

    @property
    def distance(self) -> float:
        return float(np.linalg.norm(self.tool_T_target[:3, 3]))

    @property
    def transform(self) -> Transform:
        pose = ca.DM(self.tool_T_target)
        return Transform(ca.sparsify(ca.SX(pose[:3, :3])), ca.sparsify(ca.SX(pose[:3, 3])))


def measured_point(system: System, name: str, parameters: Parameters) -> MeasuredPoint | None:
    """The target of an arm's first measurement that reads a place in the base frame; None if no measurement does.

    ``parameters`` have the calibrated values as nominal ones. The target stands on the tool if it has the same place
    there in two postures: an instrument with a frame of its own, or a point of another link, has not.
    """
    arm, values = system.arms[name], {b.name: ca.SX(list(b.nominal)) for b in parameters.blocks if not b.nuisance}
    for instance, measurement in system.measurements.items():
        channels = {channel.name for channel in measurement.channels()}
        if tuple(measurement.arms) != (name,) or not channels.issuperset("xyz"):
            continue
        own = scoped(values, f"{instance}.")
        first, second = (_on_tool(measurement, arm, values, own, angle) for angle in (0.0, 0.3))
        if np.abs(first - second).max() <= _SAME_M:
            free = scoped({block.name: block.scale for block in parameters.free}, f"{instance}.")
            elsewhere = {name: value + free.get(name, 0.0) for name, value in own.items()}
            moved = _on_tool(measurement, arm, values, elsewhere, 0.0)
            return MeasuredPoint(instance, first, bool(np.abs(moved - first)[:3, 3].max() > _SAME_M))
    return None


def tool_point(point: Point, system: System, name: str, parameters: Parameters) -> Transform | None:
    """Where the point that arrives is on the tool of an arm; None for the tool's frame itself.

    Raises:
        ConfigError: there is no such point, or no measurement reads it.
    """
    if point not in get_args(Point):
        raise ConfigError(
            f"found the point {point!r}.", hint=f"Expected one of {', '.join(map(repr, get_args(Point)))}."
        )
    if point == "tool":
        return None
    target = measured_point(system, name, parameters)
    if target is None:
        raise ConfigError(
            f"no measurement reads the place of a target on the tool of {name!r} in the base frame.",
            hint="Leave the point target out: then the tool frame's origin arrives.",
        )
    return target.transform


def _on_tool(
    measurement: Measurement, arm: Arm, values: Mapping[str, ca.SX], own: Mapping[str, ca.SX], angle: float
) -> Array:
    """tool_T_target (4 x 4) as the measurement has it where every command is ``angle`` (rad or m)."""
    chain = arm.chain(values)
    moved = arm.joint_commands([ca.SX(angle)] * len(arm.commanded))
    frames = forward(chain, [joint.offset + moved[i] for i, joint in enumerate(chain.joints)], {})
    state = ArmState(frames.base_T_tool, frames.named, ca.SX(0, 1), ca.SX.zeros(len(chain.joints)))
    read = measurement.outputs({arm.name: state}, own)
    names = ("x", "y", "z", *(_QUATERNION if set(_QUATERNION) <= set(read) else ()))
    numbers = np.array([evaluated(read[name]).item() for name in names])
    base_T_tool = evaluated(frames.base_T_tool.matrix())
    base_T_target = base_T_tool.copy()
    base_T_target[:3, 3] = numbers[:3]
    if len(numbers) > len("xyz"):
        base_T_target[:3, :3] = rotation_matrix(numbers[3:])
    return np.asarray(np.linalg.inv(base_T_tool) @ base_T_target)
