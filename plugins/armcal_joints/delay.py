"""Joints whose recorded places lag behind what was measured beside them: by how long, of an arm that moved."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar

from armcal.arm.effects import EffectSettings, JointEffect, joint_rate
from armcal.arm.model import Chain
from armcal.base.parameters import ParameterBlock, scalar

_SCALE_S = 0.01


class Delay(JointEffect):
    """The effect ``delay``: recorded joints are those of ``delay`` (s) before the measurement and have moved on since.

    Records need a column ``NAME_rate`` of each joint (``q1_rate_deg_s``); the reader ``images`` has them from the times
    of its joint table. A prediction without rates is one at rest.
    """

    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: EffectSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        rates = {joint: joint_rate(joint_names[joint - 1]) for joint in self.joints}
        self._rates, self.conditions = {joint: rate.name for joint, rate in rates.items()}, tuple(rates.values())

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return (scalar("delay", "s", 0.0, _SCALE_S),)

    def shaped(self, chain: Chain, conditions: Mapping[str, Any], values: Mapping[str, Any]) -> Chain:
        """Joints where they were at the time of the measurement: a rate times the delay beyond the recorded place."""
        joints = list(chain.joints)
        for number, name in self._rates.items():
            joint = joints[number - 1]
            joints[number - 1] = replace(joint, offset=joint.offset + values["delay"] * conditions.get(name, 0.0))
        return replace(chain, joints=tuple(joints))
