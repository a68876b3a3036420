"""The distance between the tips of two records: a gauge block, a pair of callipers, a tape."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import casadi as ca
from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock
from armcal.base.poses import point_blocks, point_expression
from armcal.base.settings import Length, Length3
from armcal.measure.instrument import Instrument, InstrumentSettings
from armcal.measure.measurement import Channel
from armcal.measure.partners import OTHER
from pydantic import Field


class TipDistanceSettings(InstrumentSettings):
    """How well a distance is known (standard deviation), where the tip sits on the tool, which column names the pair.

    A record that has a ``distance`` names the other record by its id in the text column ``partner``.
    """

    noise: Annotated[Length, Field(gt=0)]
    tip: Length3 = (0.0, 0.0, 0.0)
    partner: str = "partner"


class TipDistance(Instrument):
    """The measurement ``tip_distance``: channel distance; parameters tip_x, tip_y, tip_z in the tool frame."""

    Settings = TipDistanceSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_mm": 0.05, "tip_mm": [0, 0, 60]}

    def __init__(self, settings: TipDistanceSettings, arm_names: Sequence[str]) -> None:
        super().__init__(settings, arm_names)
        self.arms += (self.arms[0] + OTHER,)  # in the other record

    @property
    def partner_label(self) -> str:
        return str(self.settings.partner)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return point_blocks("tip", self.settings.tip)

    def channels(self) -> tuple[Channel, ...]:
        return (Channel("distance", "length"),)

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        tip = point_expression("tip", values)
        here, there = (arms[name].base_T_tool.apply(tip) for name in self.arms)
        return {"distance": ca.sqrt(ca.dot(here - there, here - there))}

    def noise(self) -> tuple[float, ...]:
        return (self.settings.noise,)
