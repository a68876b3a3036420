"""How far a joint really turns for its command: a servo's gain and offset, and gear error. [Judd1990]"""

from collections.abc import Mapping
from typing import Any, Literal

import casadi as ca
from armcal.arm.effects import EffectSettings, JointCommand, JointEffect
from armcal.base.parameters import ParameterBlock, scalar

GAIN_SCALE = 0.02
OFFSET_SCALE_RAD = 0.02
GEAR_SCALE_RAD = 0.01
_PERIODS = (1, 2)


class ServoMapSettings(EffectSettings):
    """Which joints, and whether each side of zero has a gain of its own (``two``) or both share ``one``.

    An arm model that has joint offsets already (``mdh.theta3``) needs none here: the two trade.
    """

    gains: Literal["one", "two"] = "two"


class ServoMap(JointEffect):
    """The effect ``servo_map``: relative errors of the gain, and an offset (rad).

    ``above3`` holds for commands of joint 3 above zero, ``below3`` below; with one gain it is ``gain3``. A pulse
    table of three points has such a kink, and so a wrong point of it has this effect.
    """

    Settings = ServoMapSettings

    def parameters(self) -> tuple[ParameterBlock, ...]:
        blocks, gains = [], ("above", "below") if self.settings.gains == "two" else ("gain",)
        for joint in self.joints:
            blocks += [scalar(f"{name}{joint}", "1", 0.0, GAIN_SCALE) for name in gains]
            blocks.append(scalar(f"offset{joint}", "rad", 0.0, OFFSET_SCALE_RAD))
        return tuple(blocks)

    def zeros(self) -> dict[str, int]:
        return {f"offset{joint}": joint for joint in self.joints}

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """Gain error times command, plus the offset (rad)."""
        joint, commanded = command.joint, command.commanded
        if joint not in self.joints:
            return 0
        if self.settings.gains == "one":
            return values[f"gain{joint}"] * commanded + values[f"offset{joint}"]
        above, below = ca.fmax(commanded, 0), ca.fmin(commanded, 0)
        return values[f"above{joint}"] * above + values[f"below{joint}"] * below + values[f"offset{joint}"]


class GearError(JointEffect):
    """The effect ``gear_error``: ``sin1_3`` and ``cos1_3`` (rad) of joint 3 once a turn, ``sin2_3``, ``cos2_3`` twice.

    Cosines count from their value at zero command, so that they do not trade with the joint's offset.
    """

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return tuple(
            scalar(f"{wave}{periods}_{joint}", "rad", 0.0, GEAR_SCALE_RAD)
            for joint in self.joints
            for periods in _PERIODS
            for wave in ("sin", "cos")
        )

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """The harmonics at the commanded angle (rad)."""
        joint = command.joint
        if joint not in self.joints:
            return 0
        total = ca.SX(0)
        for periods in _PERIODS:
            angle = periods * command.commanded
            total += values[f"sin{periods}_{joint}"] * ca.sin(angle)
            total += values[f"cos{periods}_{joint}"] * (ca.cos(angle) - 1)
        return total
