"""Command quantisation: a servo board sets whole counts, and the joint stands at the angle of the nearest."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Self

from armcal.arm.effects import JointCommand, chosen
from armcal.arm.servo import PulseClock, PulseTable, SteppedEffect, quantised, without_slope
from armcal.base.config_text import resolve_path
from armcal.base.settings import Settings
from armcal.config.servo_file import Angles, CalibratedServo, Oscillator, Pulses, check_longest, load_servo_file
from armcal.errors import ConfigError
from pydantic import BeforeValidator, Field, model_validator


class PulseTableSettings(Settings):
    """Pulse lengths at known angles."""

    angles: Angles
    pulses: Pulses

    @model_validator(mode="after")
    def _usable(self) -> Self:
        PulseTable(self.angles, self.pulses)
        return self


def _read_file(value: Any) -> Any:
    """A servo file's name becomes its content, so that the settings are whole by themselves."""
    if not isinstance(value, str):
        return value
    try:
        file = load_servo_file(resolve_path(value))
    except ConfigError as fault:  # pydantic places it; it would not catch an error of ours
        raise ValueError(str(fault)) from fault
    return {joint: file.calibrated(joint).to_config() for joint in file.servos}


Servos = Annotated[dict[str, CalibratedServo], BeforeValidator(_read_file)]


class QuantisationSettings(Settings):
    """Which angles the board can set: ``servos``, the servo file that drives the board too, or ``tables``.

    ``tables`` have a pulse table a joint, one measured oscillator for all, and its pulse rate or prescale.
    """

    servos: Servos = Field(default_factory=dict)
    tables: dict[str, PulseTableSettings] = Field(default_factory=dict)
    oscillator_hz: Oscillator = 25e6
    rate_hz: Annotated[float, Field(ge=24, le=1526)] = 50.0
    prescale: Annotated[int, Field(ge=3, le=255)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if bool(self.servos) == bool(self.tables):
            text = "both servos and tables" if self.tables else "neither servos nor tables"
            raise ValueError(f"found {text}, expected one of them: write servos: servos.yaml")
        if self.servos and (self.oscillator_hz, self.rate_hz, self.prescale) != (25e6, 50.0, None):
            raise ValueError("found a clock beside servos, expected none: the servo file has each board's clock")
        return self

    def clocked(self) -> dict[str, tuple[PulseTable, PulseClock]]:
        """Each joint's table, and the clock of its board.

        Raises:
            ValueError: no board can make these pulses.
        """
        if self.servos:
            return {joint: (servo.table, servo.clock) for joint, servo in self.servos.items()}
        prescale = self.prescale or PulseClock.prescale_for(self.oscillator_hz, self.rate_hz)
        clock = PulseClock(self.oscillator_hz, prescale)
        return {joint: (PulseTable(table.angles, table.pulses), clock) for joint, table in self.tables.items()}


class Quantisation(SteppedEffect):
    """The effect ``quantisation``: no parameters; the difference between the command and what the board can set.

    A joint without a table is not quantised. A servo file has all joints, and may have servos that are none.
    """

    Settings = QuantisationSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "tables": {"q1": {"angles_deg": [-100, 0, 100], "pulses_us": [620, 1540, 2460]}}
    }

    def __init__(self, settings: QuantisationSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        chosen(tuple(settings.tables), joint_names)
        missing = [joint for joint in joint_names if settings.servos and joint not in settings.servos]
        if missing:
            raise ValueError(f"the servo file has no servo {', '.join(missing)}; it has {', '.join(settings.servos)}")
        clocked = settings.clocked()
        self._servos = {joint_names.index(joint): clocked[joint] for joint in clocked if joint in joint_names}
        for table, clock in self._servos.values():
            check_longest(table, clock)

    def servos(self) -> Mapping[int, tuple[PulseTable, PulseClock]]:
        """Pulse table and clock by the joint's index; a joint without a table is not stepped."""
        return dict(self._servos)

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        """From the commanded angle to the one that is set (rad)."""
        servo = self._servos.get(command.index)
        return 0 if servo is None else without_slope(quantised(command.commanded, *servo) - command.commanded)
