"""Command quantisation: a servo board sets whole counts, and the joint stands at the angle of the nearest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

from armcal.arm.effects import JointCommand, Spring
from armcal.arm.servo import PulseClock, PulseTable, quantised
from armcal.base.parameters import ParameterBlock
from armcal.base.quantities import UnitOf
from armcal.base.settings import Settings
from pydantic import Field, model_validator

from armcal_joints.joints import chosen

Angles = Annotated[tuple[float, ...], UnitOf("angle")]
Pulses = Annotated[tuple[float, ...], UnitOf("time")]


class PulseTableSettings(Settings):
    """Pulse lengths at known angles."""

    angles: Angles
    pulses: Pulses

    @model_validator(mode="after")
    def _usable(self) -> PulseTableSettings:
        PulseTable(self.angles, self.pulses)
        return self


class QuantisationSettings(Settings):
    """A pulse table a joint, the board's measured oscillator, and its pulse rate or prescale."""

    tables: dict[str, PulseTableSettings]
    oscillator_hz: Annotated[float, Field(ge=20e6, le=30e6)] = 25e6
    rate_hz: Annotated[float, Field(ge=24, le=1526)] = 50.0
    prescale: Annotated[int, Field(ge=3, le=255)] | None = None


class Quantisation:
    """The effect ``quantisation``: no parameters; the difference between what was told and what the board can set.

    A joint without a table is not quantised.
    """

    Settings: ClassVar[type[QuantisationSettings]] = QuantisationSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "tables": {"q1": {"angles_deg": [-100, 0, 100], "pulses_us": [620, 1540, 2460]}}
    }

    def __init__(self, settings: QuantisationSettings, joint_names: Sequence[str]) -> None:
        chosen(tuple(settings.tables), joint_names)
        prescale = settings.prescale or PulseClock.prescale_for(settings.oscillator_hz, settings.rate_hz)
        self._clock = PulseClock(settings.oscillator_hz, prescale)
        self._tables = {
            joint_names.index(name): PulseTable(table.angles, table.pulses) for name, table in settings.tables.items()
        }
        longest, limit = max((max(t.pulses) for t in self._tables.values()), default=0.0), self._clock.longest_pulse
        if longest > limit:
            raise ValueError(
                f"a pulse of {1e6 * longest:g} us is longer than the board's longest, {1e6 * limit:.0f} us"
            )

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """None: the table is known, or it is the servo map's to find."""
        return ()

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """From the commanded angle to the one that is set (rad)."""
        table = self._tables.get(command.index)
        return 0 if table is None else quantised(command.commanded, table, self._clock) - command.commanded

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        """None."""
        return ()
