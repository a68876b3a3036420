"""The position of a target on the tool, measured in the arm's base frame."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import casadi as ca
from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.settings import Length, Length3, Settings
from armcal.measure.contact import named_arm
from armcal.measure.measurement import Channel
from pydantic import field_validator


class TipPositionSettings(Settings):
    """Which arm, how noisy the tracker is (standard deviation of each coordinate), where the target sits on the tool.

    A record's own columns ``noise_x``, ``noise_y``, ``noise_z``, or ``noise`` for all three, stand above ``noise``.
    """

    noise: Length | Length3
    arm: str | None = None
    target: Length3 = (0.0, 0.0, 0.0)

    @field_validator("noise")
    @classmethod
    def _positive(cls, value: float | tuple[float, ...]) -> float | tuple[float, ...]:
        worst = min(value) if isinstance(value, tuple) else value
        if worst <= 0:
            raise ValueError(f"a noise of {worst * 1000:g} mm is not above zero: give the tracker's standard deviation")
        return value


class TipPosition:
    """The measurement ``tip_position``: channels x, y, z; parameters target_x, target_y, target_z in the tool frame."""

    Settings: ClassVar[type[TipPositionSettings]] = TipPositionSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"noise_mm": 0.5, "target_mm": [10, 0, 25]}

    def __init__(self, settings: TipPositionSettings, arm_names: Sequence[str]) -> None:
        self._settings = settings
        self._arm = named_arm(settings.arm, arm_names)

    @property
    def arms(self) -> tuple[str, ...]:
        """The one arm that carries the target."""
        return (self._arm,)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """The target on the tool (m)."""
        return tuple(
            scalar(f"target_{axis}", "m", value, 0.01) for axis, value in zip("xyz", self._settings.target, strict=True)
        )

    def channels(self) -> tuple[Channel, ...]:
        """Three coordinates."""
        return tuple(Channel(axis, "length") for axis in "xyz")

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Any]) -> dict[str, Any]:
        """The target's position in the base frame (m)."""
        target = ca.sparsify(ca.vertcat(*[values[f"target_{axis}"] for axis in "xyz"]))
        position = arms[self._arm].base_T_tool.apply(target)
        return {axis: position[i] for i, axis in enumerate("xyz")}

    def residual(self, arms: Mapping[str, ArmState], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        """Measured minus predicted (3x1, m)."""
        predicted = self.outputs(arms, values)
        return ca.vertcat(*[measured[axis] - predicted[axis] for axis in "xyz"])

    def noise(self) -> tuple[float, ...]:
        """Of each coordinate (m)."""
        noise = self._settings.noise
        return noise if isinstance(noise, tuple) else (noise,) * 3

    def noise_channels(self) -> tuple[tuple[Channel, ...], ...]:
        """Each coordinate's own, or one for all three."""
        return tuple((Channel(f"noise_{axis}", "length"), Channel("noise", "length")) for axis in "xyz")
