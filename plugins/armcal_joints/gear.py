"""Gear error: what an eccentric gear or shaft adds, once and twice a turn of the joint. [Judd1990]"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import casadi as ca
from armcal.arm.effects import JointCommand, JointEffect
from armcal.base.parameters import ParameterBlock, scalar

GEAR_SCALE_RAD = 0.01
_PERIODS = (1, 2)


class GearError(JointEffect):
    """The effect ``gear_error``: ``sin1_3`` and ``cos1_3`` (rad) of joint 3 once a turn, ``sin2_3``, ``cos2_3`` twice.

    Cosines count from their value at zero command, so that they do not trade with the joint's offset.
    """

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """Four amplitudes a joint."""
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
