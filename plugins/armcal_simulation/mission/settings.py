"""The settings of a simulated mission: when records come, what the rover stands on, and what happens to the arm."""

from datetime import datetime
from typing import Annotated, Self

from armcal.base.settings import Angle, Duration, InputPath, Length, Settings, Temperature
from pydantic import Field, field_validator, model_validator

from armcal_simulation.mission.events import Day, Event, parsed_creep
from armcal_simulation.readings import OutlierSettings

Fraction = Annotated[float, Field(ge=0, le=1)]


class RecordSettings(Settings):
    """When the arm is measured, and where it stands then.

    Records come in working ``hours`` of each day, with random gaps of ``every`` in the mean. Poses are uniform within
    ``ranges`` of turning and ``travel`` of sliding joints; a joint without one is driven between its limits.
    """

    every: Annotated[Duration, Field(gt=0)] = 600.0
    hours: tuple[Annotated[float, Field(ge=0, le=24)], Annotated[float, Field(ge=0, le=24)]] = (8.0, 18.0)
    ranges: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)
    travel: dict[str, tuple[Length, Length]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _sane(self) -> Self:
        if self.hours[0] >= self.hours[1]:
            raise ValueError("found hours that end before they begin, expected [from, to], such as [8, 18]")
        for joint, (low, high) in {**self.ranges, **self.travel}.items():
            if low >= high:
                raise ValueError(f"found an empty range of {joint}, expected [from, to]")
        return self


class GapSettings(Settings):
    """A time without records: from a ``day`` on, for a ``duration``."""

    day: Day
    duration: Annotated[Duration, Field(gt=0)]


class LossSettings(Settings):
    """Which ``fraction`` of the records never arrives, and in which fraction of the ``hours`` there is no contact.

    In each of the ``gaps`` no record arrives at all.
    """

    fraction: Fraction = 0.0
    hours: Fraction = 0.0
    gaps: tuple[GapSettings, ...] = ()


class TiltSettings(Settings):
    """How far the rover stands tilted at ``most``, how often it drives, and how well it knows its tilt.

    ``error`` is the standard deviation about each axis, made anew at each stand.
    """

    most: Annotated[Angle, Field(ge=0)] = 0.0
    drives_per_day: Annotated[float, Field(ge=0)] = 3.0
    error: Annotated[Angle, Field(ge=0)] = 0.0


class TemperatureSettings(Settings):
    """A sine about ``mean``: ``swing`` up and down in each ``period``, warmest at the hour ``warmest``."""

    mean: Temperature = 20.0
    swing: Temperature = 0.0
    period: Annotated[Duration, Field(gt=0)] = 86400.0
    warmest: float = 14.0


class ThermalSettings(Settings):
    """How much a parameter changes for each K above ``reference``; a number with its unit (``0.002 deg``)."""

    per_K: str | float
    reference: Temperature = 20.0


class ExchangeSettings(Settings):
    """In which ``fraction`` of the records the measurement is delivered with the joints of the next one."""

    fraction: Fraction = 0.0


class MissionSettings(Settings):
    """The truth, and the mission over it; ``noise`` defaults to what each measurement declares.

    ``creep`` moves parameters (globs) along a line (``0.05 deg in 30 d``) or at random (``walk 0.05 deg in 30 d``: the
    standard deviation after that time). ``thermal`` moves them with the temperature. ``events`` befall the arm, its
    payload, the camera or the weather; those of the same ``day`` come at once. ``start`` is the date of the
    mission's midnight; without one time counts from 0. The power is cut on the days ``power_cuts``.
    """

    truth: InputPath
    days: Annotated[float, Field(gt=0, le=3660)]
    start: str | None = None
    seed: Annotated[int, Field(ge=0)] = 0
    records: RecordSettings = Field(default_factory=RecordSettings)
    losses: LossSettings = Field(default_factory=LossSettings)
    tilt: TiltSettings = Field(default_factory=TiltSettings)
    temperature: TemperatureSettings = Field(default_factory=TemperatureSettings)
    thermal: dict[str, ThermalSettings] = Field(default_factory=dict)
    creep: dict[str, str] = Field(default_factory=dict)
    events: tuple[Event, ...] = ()
    power_cuts: tuple[Day, ...] = ()
    noise: Annotated[Length, Field(ge=0)] | None = None
    outliers: OutlierSettings = Field(default_factory=OutlierSettings)
    exchanged: ExchangeSettings = Field(default_factory=ExchangeSettings)

    @field_validator("creep")
    @classmethod
    def _readable(cls, value: dict[str, str]) -> dict[str, str]:
        for text in value.values():
            parsed_creep(text)
        return value

    @model_validator(mode="after")
    def _sane(self) -> Self:
        began_at(self.start)
        begin = [(f"the {event.kind}", event.day) for event in self.events]
        begin += [("the gap", gap.day) for gap in self.losses.gaps]
        for what, day in begin:
            if day >= self.days:
                raise ValueError(
                    f"found {what} on day {day:g}, expected one before the mission ends after {self.days:g} days: "
                    "change its day, or leave it out"
                )
        return self


def began_at(start: str | None) -> float:
    """What the clock shows at the mission's midnight: unix seconds, or 0 without a date.

    Raises:
        ValueError: no date, or one without its zone.
    """
    if start is None:
        return 0.0
    try:
        date = datetime.fromisoformat(start)
    except ValueError:
        raise ValueError(f"found the start {start!r}, expected a date such as 2031-03-01T00:00:00Z") from None
    if date.tzinfo is None:
        raise ValueError(f"found the start {start!r} without a zone: end it with Z for UTC")
    return date.timestamp()
