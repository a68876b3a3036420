"""The position of a target on the tool, measured in the arm's base frame."""

from collections.abc import Mapping
from typing import Any, ClassVar

from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock
from armcal.base.poses import point_blocks, point_expression
from armcal.base.settings import Length, Length3
from armcal.measure.instrument import Instrument, InstrumentSettings
from armcal.measure.measurement import Channel, Mistake
from pydantic import field_validator


class TipPositionSettings(InstrumentSettings):
    """Which arm, how noisy the tracker is (standard deviation of each coordinate), where the target sits on the tool.

    A record's own columns ``noise_x``, ``noise_y``, ``noise_z``, or ``noise`` for all three, stand above ``noise``.
    """

    noise: Length | Length3
    target: Length3 = (0.0, 0.0, 0.0)

    @field_validator("noise")
    @classmethod
    def _positive(cls, value: float | tuple[float, ...]) -> float | tuple[float, ...]:
        worst = min(three(value))
        if worst <= 0:
            raise ValueError(f"a noise of {worst * 1000:g} mm is not above zero: give the tracker's standard deviation")
        return value


class TipPosition(Instrument):
    """The measurement ``tip_position``: channels x, y, z; parameters target_x, target_y, target_z in the tool frame."""

    Settings = TipPositionSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_mm": 0.5, "target_mm": [10, 0, 25]}

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return point_blocks("target", self.settings.target)

    def mistakes(self) -> tuple[Mistake, ...]:
        again = "repeat some of the first poses now, fasten the target, and calibrate the records after it apart"
        own = tuple(block.name for block in self.parameters())
        return (Mistake("bump", "the target moves on the tool there", again, own, "once"),)

    def channels(self) -> tuple[Channel, ...]:
        return tuple(Channel(axis, "length") for axis in "xyz")

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        position = self.base_T_tool(arms).apply(point_expression("target", values))
        return {axis: position[i] for i, axis in enumerate("xyz")}

    def noise(self) -> tuple[float, ...]:
        return three(self.settings.noise)

    def noise_channels(self) -> tuple[tuple[Channel, ...], ...]:
        return tuple((Channel(f"noise_{axis}", "length"), Channel("noise", "length")) for axis in "xyz")


def three(value: float | tuple[float, ...]) -> tuple[float, ...]:
    """One number of each coordinate, where a single one stands for all."""
    return value if isinstance(value, tuple) else (value,) * 3
