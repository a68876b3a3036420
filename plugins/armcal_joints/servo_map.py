"""A servo's gain: how far a joint really turns for what it is told."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import casadi as ca
from armcal.arm.effects import JointCommand, Spring
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.settings import Settings

from armcal_joints.joints import JointChoice, chosen

GAIN_SCALE = 0.02
OFFSET_SCALE_RAD = 0.02


class ServoMapSettings(Settings):
    """Which joints, and whether each side of zero has a gain of its own (``two``) or both share ``one``.

    An arm model that has joint offsets already (``mdh.theta3``) needs none here: the two trade.
    """

    joints: JointChoice = "all"
    gains: Literal["one", "two"] = "two"


class ServoMap:
    """The effect ``servo_map``: relative errors of the gain, and an offset (rad).

    ``above3`` holds for commands of joint 3 above zero, ``below3`` below; with one gain it is ``gain3``. A pulse
    table of three points has such a kink, and so a wrong point of it has this effect.
    """

    Settings: ClassVar[type[ServoMapSettings]] = ServoMapSettings

    def __init__(self, settings: ServoMapSettings, joint_names: Sequence[str]) -> None:
        self._names = ("above", "below") if settings.gains == "two" else ("gain",)
        self._joints = chosen(settings.joints, joint_names)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """Gains, then the offset, of each joint in turn."""
        blocks = []
        for joint in self._joints:
            blocks += [scalar(f"{name}{joint}", "1", 0.0, GAIN_SCALE) for name in self._names]
            blocks.append(scalar(f"offset{joint}", "rad", 0.0, OFFSET_SCALE_RAD))
        return tuple(blocks)

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """Gain error times command, plus the offset (rad)."""
        joint = command.index + 1
        if joint not in self._joints:
            return 0
        return self._scaled(command.commanded, values, joint) + values[f"offset{joint}"]

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        """None."""
        return ()

    def _scaled(self, commanded: Any, values: Mapping[str, Any], joint: int) -> Any:
        if len(self._names) == 1:
            return values[f"gain{joint}"] * commanded
        return values[f"above{joint}"] * ca.fmax(commanded, 0) + values[f"below{joint}"] * ca.fmin(commanded, 0)
