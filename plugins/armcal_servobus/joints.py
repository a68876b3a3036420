"""The joints of a servo bus: which servo each is, and which count is which angle."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

from armcal.arm.horn import teeth_text
from armcal.base.quantities import UnitOf
from armcal.base.settings import Settings
from armcal.devices.device import DeviceRefusedError
from armcal.errors import Location
from pydantic import Field, field_validator, model_validator

from armcal_servobus.bus import BusSettings
from armcal_servobus.models import MODELS, ServoModel
from armcal_servobus.packets import LAST_ID

_SLACK = 1e-9
AngleRange = Annotated[tuple[float, float], UnitOf("angle")]


class BusJointSettings(Settings):
    """A joint's servo: its id, its model, the count at the joint's zero, and the way in which counts rise.

    ``range`` is where the joint may go. ``offset`` is the homing offset that the servo's EEPROM must hold; where it is
    not stated, any will do, and is part of what identifies the arm.
    """

    id: Annotated[int, Field(ge=0, le=LAST_ID)]
    model: str
    zero_count: int = 2048
    direction: Literal[1, -1] = 1
    range: AngleRange
    offset: int | None = None

    @field_validator("model")
    @classmethod
    def _known(cls, name: str) -> str:
        if name not in MODELS:
            raise ValueError(f"found the model {str(name)!r}, expected one of {', '.join(MODELS)}")
        return name

    @model_validator(mode="after")
    def _usable(self) -> BusJointSettings:
        if not self.range[0] < self.range[1]:
            raise ValueError("the range does not rise: give [lowest, highest]")
        if self.offset is not None:
            check_offset(self.servo_model, self.offset)
        return self

    @property
    def servo_model(self) -> ServoModel:
        return MODELS[self.model]


class ServoJointsSettings(BusSettings):
    """A bus, and the joints whose servos are on it, by the joint's name or by arm and joint (``arm.q1``)."""

    joints: Annotated[dict[str, BusJointSettings], Field(min_length=1)]

    @model_validator(mode="after")
    def _fit(self) -> ServoJointsSettings:
        ids: dict[int, str] = {}
        for name, joint in self.joints.items():
            if joint.id in ids:
                raise ValueError(f"{ids[joint.id]} and {name} have the id {joint.id}, expected one joint for each")
            ids[joint.id] = name
            if (protocol := joint.servo_model.protocol) != self.protocol:
                raise ValueError(f"{name} is a {joint.model}, which speaks {protocol}: set protocol: {protocol}")
        return self

    def chosen(self, names: Iterable[str]) -> dict[str, ServoJoint]:
        """The servos of joints or channels, by the name that is asked for.

        Raises:
            ValueError: there is none.
        """
        chosen: dict[str, ServoJoint] = {}
        missing = []
        for name in names:
            alike = [key for key in self.joints if key == name or key.split(".")[-1] == name.split(".")[-1]]
            key = name if name in self.joints else alike[0] if len(alike) == 1 else None
            if key is None:
                missing.append(name)
            else:
                chosen[name] = ServoJoint(name, self.joints[key])
        if missing:
            raise ValueError(f"found no servo for {', '.join(missing)}; joints has {', '.join(self.joints)}")
        return chosen


@dataclass(frozen=True)
class ServoJoint:
    """A joint and its servo.

    The angle is ``direction * step * (count - zero_count)``. Where the encoder goes on over the end of its turn, a
    count means the angle that is nearest to the middle of the joint's range.
    """

    name: str
    settings: BusJointSettings

    @property
    def id(self) -> int:
        return self.settings.id

    @cached_property
    def model(self) -> ServoModel:
        return self.settings.servo_model

    @cached_property
    def count_range(self) -> tuple[int, int]:
        """The lowest and the highest count of its range; beyond 0 or the last one where the range crosses the seam.

        One count beyond is none: a range of the whole turn, -180 to 180 deg, ends where it begins.
        """
        ends, last = sorted(map(self.exact_count, self.settings.range)), self.model.counts - 1
        low, high = math.ceil(ends[0] - _SLACK), math.floor(ends[1] + _SLACK)
        return (0 if low == -1 else low), (last if high == last + 1 else high)

    @property
    def crosses_seam(self) -> bool:
        """Whether the last count is followed by zero inside its range: it can be read there, and not be driven."""
        low, high = self.count_range
        return low < 0 or high >= self.model.counts

    @property
    def middle(self) -> float:
        return sum(self.count_range) / 2

    def angle(self, count: float) -> float:
        """Of a count (rad), as it stands."""
        return self.settings.direction * self.model.step * (count - self.settings.zero_count)

    def exact_count(self, angle: float) -> float:
        """Of an angle (rad), not rounded; ``angle`` turned round."""
        return self.settings.zero_count + self.settings.direction * angle / self.model.step

    def unwrapped(self, count: int, before: float | None = None) -> int:
        if not self.model.wraps:
            return count
        near = self.middle if before is None else before
        return count + self.model.counts * round((near - count) / self.model.counts)

    def count(self, angle: float) -> int:
        """Nearest to an angle (rad).

        Raises:
            DeviceRefusedError: it is outside the joint's range.
        """
        low, high = self.settings.range
        if not low - self.model.step <= angle <= high + self.model.step:  # no range has what is not finite
            ends = " to ".join(f"{math.degrees(end):g}" for end in (low, high))
            text = f"found {math.degrees(angle):.3f} deg for {self.name}, expected {ends} deg, its range."
            hint = "Keep the plan within the range; or move the arm by hand, with torque off, if it hangs beyond it."
            raise DeviceRefusedError(text, where=Location(field=f"joints.{self.name}.range"), hint=hint)
        count = round(self.exact_count(angle))
        return min(max(count, self.count_range[0]), self.count_range[1])


def check_offset(model: ServoModel, offset: int) -> None:
    """Raise ValueError if a servo cannot hold a homing offset; it says what to do."""
    if not model.offset_limit:
        raise ValueError(f"found an offset of {offset}, but a {model.name} has none: leave it out, set zero_count")
    beyond = abs(offset) - model.offset_limit
    if beyond <= 0:
        return
    amount = f"its horn by {math.degrees(beyond * model.step):.0f} deg or more"
    if model.teeth:
        tooth = model.counts / model.teeth
        amount = "it by " + teeth_text(math.ceil(beyond / tooth), math.degrees(tooth * model.step))
    raise ValueError(
        f"found an offset of {offset} counts, expected -{model.offset_limit} to {model.offset_limit}, which is all "
        f"that a {model.name} holds: remount {amount}"
    )


def drivable(joints: Collection[ServoJoint]) -> None:
    """Raise ValueError if a joint's range crosses the end of its encoder's turn, over which no servo can be driven."""
    across = [joint for joint in joints if joint.crosses_seam]
    if not across:
        return
    joint = across[0]
    low, high = joint.count_range
    raise ValueError(
        f"the range of {joint.name} is counts {low} to {high}, expected 0 to {joint.model.counts - 1}: a servo cannot "
        "be driven over the end of its encoder's turn; set homing offsets with armcal bus home, then zero_count: "
        f"{joint.model.counts // 2}"
    )


def named(joints: Mapping[str, ServoJoint]) -> dict[int, str]:
    return {joint.id: name for name, joint in joints.items()}
