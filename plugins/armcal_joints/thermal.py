"""Thermal expansion of the links: lengths that grow with the temperature recorded beside each measurement."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, ClassVar, Literal

from armcal.arm.effects import JointEffect
from armcal.arm.model import Attachment, Chain
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.se3 import Transform
from armcal.base.settings import Settings, Temperature

EXPANSION_SCALE_PER_K = 5e-5


class ThermalLengthSettings(Settings):
    """The temperature at which lengths are nominal, and whether all links share one coefficient (one material)."""

    reference: Temperature = 20.0
    links: Literal["one", "each"] = "one"


class ThermalLength(JointEffect):
    """The effect ``thermal_length``: ``expansion`` of all links (1/K), or ``expansion1`` to ``expansionN``.

    Link i lies before joint i, the last one between the last joint and the tool. Records need a column
    ``temperature_C``; a prediction without one is made at the reference temperature.
    """

    Settings = ThermalLengthSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"reference_C": 22, "links": "each"}
    conditions = ("temperature",)

    def __init__(self, settings: ThermalLengthSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        links = range(1, len(joint_names) + 2)
        separate = settings.links == "each"
        self._names = tuple(f"expansion{link}" if separate else "expansion" for link in links)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """Coefficients of linear expansion (1/K)."""
        physical = Interval(lower=0.0)
        return tuple(scalar(name, "per_K", 0.0, EXPANSION_SCALE_PER_K, physical) for name in dict.fromkeys(self._names))

    def shaped(self, chain: Chain, conditions: Mapping[str, Any], values: Mapping[str, Any]) -> Chain:
        """Every link's length, the tool's too, times one plus coefficient times temperature difference.

        A frame moves with the link that it stands on, so that the one at a link's end stays at the next joint.
        """
        warmer = conditions.get("temperature", self.settings.reference) - self.settings.reference
        factors = [1 + values[name] * warmer for name in self._names]
        joints = tuple(
            replace(joint, parent_T_joint=_longer(joint.parent_T_joint, factor))
            for joint, factor in zip(chain.joints, factors[:-1], strict=True)
        )
        frames = {name: _on_longer(at, factors) for name, at in chain.frames.items()}
        return replace(chain, joints=joints, tool=_on_longer(chain.tool, factors), frames=frames)


def _on_longer(at: Attachment, factors: Sequence[Any]) -> Attachment:
    return replace(at, joint_T_frame=_longer(at.joint_T_frame, factors[at.joint]))


def _longer(transform: Transform, factor: Any) -> Transform:
    return Transform(transform.rotation, transform.translation * factor)
