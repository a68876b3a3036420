"""What instruments share: each of their readings is what the arm and the instrument say, plus noise."""

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar

import casadi as ca

from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression, Transform
from armcal.base.settings import Settings
from armcal.measure.contact import named_arm
from armcal.measure.measurement import Channel
from armcal.plugins import refuse

_Settings = Settings


class InstrumentSettings(Settings):
    """Which arm is measured; the only one unless said."""

    arm: str | None = None


class Instrument(ABC):
    """A base for measurements that read something of one arm: channels, outputs and noise are all a subclass must say.

    Attributes:
        Settings: the class of its checked settings.
        settings: its own, checked.
        arms: the instance name of its arm.
    """

    Settings: ClassVar[type[_Settings]] = InstrumentSettings

    def __init__(self, settings: Any, arm_names: Sequence[str]) -> None:
        self.settings = settings
        self.arms: tuple[str, ...] = (named_arm(settings.arm, arm_names),)

    def parameters(self) -> Sequence[ParameterBlock]:
        """Parameters of the instrument itself, under local names."""
        return ()

    @abstractmethod
    def channels(self) -> Sequence[Channel]:
        """The measured numbers that it reads from a record."""

    @abstractmethod
    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> Mapping[str, Expression]:
        """What each channel would read without noise (SI)."""

    @abstractmethod
    def noise(self) -> Sequence[float]:
        """Standard deviation of each entry of the residual (m or rad)."""

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        """Measured minus predicted, an entry a channel (n x 1, m or rad); angles by the shorter way round."""
        predicted, names = self.outputs(arms, values), [channel.name for channel in self.channels()]
        if set(predicted) != set(names):
            refuse(self.outputs, f"only {', '.join(predicted) or 'none'}", f"every channel: {', '.join(names)}")
        off = {channel: measured[channel.name] - predicted[channel.name] for channel in self.channels()}
        turns = [ca.remainder(x, 2 * ca.pi) if channel.dimension == "angle" else x for channel, x in off.items()]
        return ca.vertcat(*turns)

    def dimensions(self) -> Sequence[str]:
        """``length`` or ``angle`` of each entry of the residual: the channels', or lengths of a residual of its own."""
        if type(self).residual is Instrument.residual:
            return tuple(channel.dimension for channel in self.channels())
        return ("length",) * len(self.noise())

    def noise_channels(self) -> Sequence[Sequence[Channel]]:
        """Of each entry of the residual, the channels that may carry its noise; none takes any from records."""
        return ()

    def base_T_tool(self, arms: Mapping[str, ArmState]) -> Transform:  # noqa: N802
        """Where the tool is, in the base frame of the arm (m)."""
        return arms[self.arms[0]].base_T_tool
