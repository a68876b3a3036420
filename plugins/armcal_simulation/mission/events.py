"""What may happen in a simulated mission: to a joint, a link, the payload, the camera, the weather."""

import math
from typing import Annotated, Literal, Self

from armcal.base.settings import Angle, Angle3, Length3, Mass, Settings, Temperature
from armcal.base.units import amount_in_time
from pydantic import Field, field_validator, model_validator

Angle2 = tuple[Angle, Angle]
Day = Annotated[float, Field(ge=0)]


def parsed_creep(text: str) -> tuple[str, float, bool]:
    """The amount as written, over how many s, and whether it walks at random.

    Raises:
        ValueError: it is not written so.
    """
    first, _, rest = text.strip().partition(" ")
    walks = first == "walk"
    return *amount_in_time(rest.strip() if walks else text.strip()), walks


class EventSettings(Settings):
    """What all events have: the ``day`` on which they begin, counted from the mission's midnight."""

    day: Day


class LastingSettings(EventSettings):
    """An event that lasts ``until`` a day, or as long as the mission."""

    until: Day | None = None

    @model_validator(mode="after")
    def _ends_later(self) -> Self:
        if self.until is not None and self.until <= self.day:
            raise ValueError(f"found until: {self.until:g} of an event on day {self.day:g}: write a later day")
        return self


class SlipSettings(EventSettings):
    """A horn slips on its shaft: a joint's offset ``parameter`` jumps by whole ``teeth`` or by an ``angle``."""

    kind: Literal["slip"]
    joint: str
    parameter: str
    teeth: int | None = None
    of_teeth: Annotated[int, Field(ge=1)] = 25
    angle: Angle | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if (self.teeth is None) == (self.angle is None):
            raise ValueError("found both or neither of teeth and angle, expected one of them: write teeth: 1")
        return self

    @property
    def turned(self) -> float:
        """By how much it slips (rad)."""
        return self.angle if self.angle is not None else 2 * math.pi * (self.teeth or 0) / self.of_teeth


class SwapSettings(EventSettings):
    """A servo is replaced: what changes by how much, with units (``{arm.mdh.theta3: 2 deg}``)."""

    kind: Literal["swap"]
    joint: str
    changes: Annotated[dict[str, str | float], Field(min_length=1)]


class BendSettings(EventSettings):
    """The link behind a joint is bent: its lengths and angles jump (``{arm.mdh.a3: 3 mm, arm.mdh.alpha3: 1 deg}``).

    ``joint`` carries the link; the next joint is carried by it.
    """

    kind: Literal["bend"]
    joint: str
    changes: Annotated[dict[str, str | float], Field(min_length=1)]


class JointCreepSettings(LastingSettings):
    """A ``parameter`` of a joint that changes along a line from the event's day on: ``change: 0.5 deg in 10 d``."""

    joint: str
    parameter: str
    change: str

    @field_validator("change")
    @classmethod
    def _readable(cls, value: str) -> str:
        if parsed_creep(value)[2]:
            raise ValueError(f"found {value!r}, expected a change along a line, such as 0.5 deg in 10 d")
        return value


class CreepSettings(JointCreepSettings):
    """A joint begins to creep, or creeps faster than ``creep`` has it."""

    kind: Literal["creep"]


class PlaySettings(JointCreepSettings):
    """The play of a joint grows: ``parameter`` is its half-width in an effect of backlash (``arm.lag.lag3``)."""

    kind: Literal["play"]


class PayloadSettings(LastingSettings):
    """The tool picks up a ``mass`` that no record reports, and sets it down on the day ``until``.

    ``lever`` is its centre in the tool frame.
    """

    kind: Literal["payload"]
    mass: Annotated[Mass, Field(gt=0)]
    lever: Length3 = (0.0, 0.0, 0.0)


class TiltedSettings(EventSettings):
    """The rover reads its tilt wrong from now on: gravity is turned against it about the base's x and y axes."""

    kind: Literal["tilt"]
    turn: Angle2


class BumpSettings(EventSettings):
    """The camera moves: what is measured is turned about the base's origin (a rotation vector), then shifted."""

    kind: Literal["bump"]
    shift: Length3 = (0.0, 0.0, 0.0)
    turn: Angle3 = (0.0, 0.0, 0.0)


class BiasSettings(LastingSettings):
    """What the camera measures is off by more each day: ``per_day`` along the axes of the base frame."""

    kind: Literal["bias"]
    per_day: Length3

    @field_validator("per_day")
    @classmethod
    def _moves(cls, value: tuple[float, float, float]) -> tuple[float, float, float]:
        if not any(value):
            raise ValueError("found a bias that does not grow: write for example per_day_mm: [0.3, 0, 0]")
        return value


class ClimateSettings(EventSettings):
    """Days and nights change: from now on the temperature swings by ``swing`` about ``mean``."""

    kind: Literal["climate"]
    mean: Temperature
    swing: Temperature


Event = Annotated[
    SlipSettings
    | SwapSettings
    | BendSettings
    | CreepSettings
    | PlaySettings
    | PayloadSettings
    | TiltedSettings
    | BumpSettings
    | BiasSettings
    | ClimateSettings,
    Field(discriminator="kind"),
]


def label_of(event: Event) -> str:
    """A few words for figures and tables."""
    match event:
        case SlipSettings():
            return f"{event.joint} slips by {math.degrees(event.turned):.1f} deg"
        case SwapSettings():
            return f"servo of {event.joint} replaced"
        case BendSettings():
            return f"link behind {event.joint} bent ({', '.join(str(change) for change in event.changes.values())})"
        case CreepSettings():
            return f"{event.joint} creeps by {event.change}"
        case PlaySettings():
            return f"play of {event.joint} grows by {event.change}"
        case PayloadSettings():
            return f"unreported payload of {1000 * event.mass:.0f} g at {1000 * math.hypot(*event.lever):.0f} mm"
        case TiltedSettings():
            return f"unreported tilt of {math.degrees(math.hypot(*event.turn)):.1f} deg"
        case BumpSettings():
            shift, turn = math.hypot(*event.shift), math.hypot(*event.turn)
            return f"camera bumped by {1000 * shift:.1f} mm, {math.degrees(turn):.1f} deg"
        case BiasSettings():
            return f"camera's bias grows by {1000 * math.hypot(*event.per_day):.2f} mm a day"
        case ClimateSettings():
            return f"temperature now {event.mean - event.swing:.0f} to {event.mean + event.swing:.0f} C"
