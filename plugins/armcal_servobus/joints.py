"""The joints of a servo bus: which servo each is, which count is which angle, and how they are driven."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

from armcal.arm.servo import teeth_text
from armcal.base.settings import Settings, UnitOf
from armcal.devices.device import DeviceError, DeviceRefusedError
from armcal.errors import Location
from pydantic import Field, field_validator, model_validator

from armcal_servobus.bus import LAST_ID, Bus, BusSettings
from armcal_servobus.models import COUNTS, MODELS, STEP, ServoModel

_SLACK = 1e-9
AngleRange = Annotated[tuple[float, float], UnitOf("angle")]


class BusJointSettings(Settings):
    """A joint's servo: its id, its model, the count at the joint's zero, and the way in which counts rise.

    ``range`` is where the joint may go. ``offset`` is the homing offset that the servo's EEPROM must hold; where it is
    not stated, any will do, and is part of what identifies the arm.
    """

    id: Annotated[int, Field(ge=0, le=LAST_ID)]
    model: str
    zero_count: int = COUNTS // 2
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
        if self.range[1] - self.range[0] > 2 * math.pi + STEP:
            raise ValueError("the range is wider than a turn, and an encoder knows no more: narrow it")
        if self.offset is not None:
            check_offset(MODELS[self.model], self.offset)
        return self


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
            if (protocol := MODELS[joint.model].protocol) != self.protocol:
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
            alike = [key for key in self.joints if key.split(".")[-1] == name.split(".")[-1]]
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

    The angle is ``direction * step * (count - zero_count)``. The encoder goes on over the end of its turn: a count
    means the angle that is nearest to the middle of the joint's range.
    """

    name: str
    settings: BusJointSettings

    @property
    def id(self) -> int:
        return self.settings.id

    @property
    def label(self) -> str:
        return f"{self.name} (id {self.id})"

    @property
    def model(self) -> ServoModel:
        return MODELS[self.settings.model]

    @cached_property
    def count_range(self) -> tuple[int, int]:
        """The lowest and the highest count of its range; beyond 0 or the last one where the range crosses the seam.

        One count beyond is none: a range of the whole turn, -180 to 180 deg, ends where it begins.
        """
        ends = sorted(map(self.exact_count, self.settings.range))
        low, high = math.ceil(ends[0] - _SLACK), math.floor(ends[1] + _SLACK)
        return (0 if low == -1 else low), (COUNTS - 1 if high == COUNTS else high)

    @property
    def crosses_seam(self) -> bool:
        """Whether the last count is followed by zero inside its range: it can be read there, and not be driven."""
        low, high = self.count_range
        return low < 0 or high >= COUNTS

    def angle(self, count: float) -> float:
        """Of a count (rad), as it stands."""
        return self.settings.direction * STEP * (count - self.settings.zero_count)

    def exact_count(self, angle: float) -> float:
        """Of an angle (rad), not rounded; ``angle`` turned round."""
        return self.settings.zero_count + self.settings.direction * angle / STEP

    def unwrapped(self, count: int) -> int:
        return count + COUNTS * round((sum(self.count_range) / 2 - count) / COUNTS)

    def count(self, angle: float) -> int:
        """Nearest to an angle (rad).

        Raises:
            DeviceRefusedError: it is outside the joint's range.
        """
        low, high = self.settings.range
        if not low - STEP <= angle <= high + STEP:  # no range has what is not finite
            ends = " to ".join(f"{math.degrees(end):g}" for end in (low, high))
            text = f"found {math.degrees(angle):.3f} deg for {self.name}, expected {ends} deg, its range."
            hint = "Keep the plan within the range; or move the arm by hand, with torque off, if it hangs beyond it."
            raise DeviceRefusedError(text, where=Location(field=f"joints.{self.name}.range"), hint=hint)
        count = round(self.exact_count(angle))
        return min(max(count, self.count_range[0]), self.count_range[1])


def check_offset(model: ServoModel, offset: int) -> None:
    """Raise ValueError if a servo cannot hold a homing offset; it says what to do."""
    limit = model.map.offset_limit
    if (beyond := abs(offset) - limit) <= 0:
        return
    amount = f"its horn by {math.degrees(beyond * STEP):.0f} deg or more"
    if model.teeth:
        tooth = COUNTS / model.teeth
        amount = "it by " + teeth_text(math.ceil(beyond / tooth), math.degrees(tooth * STEP))
    raise ValueError(
        f"found an offset of {offset} counts, expected -{limit} to {limit}, which is all that a {model.name} holds: "
        f"remount {amount}"
    )


def drivable(joints: Collection[ServoJoint]) -> None:
    """Raise ValueError if a joint's range crosses the end of its encoder's turn, over which no servo can be driven."""
    for joint in joints:
        if joint.crosses_seam:
            low, high = joint.count_range
            raise ValueError(
                f"the range of {joint.name} is counts {low} to {high}, expected 0 to {COUNTS - 1}: a servo cannot be "
                "driven over the end of its encoder's turn; set homing offsets with armcal bus home, then zero_count: "
                f"{COUNTS // 2}"
            )


def bus_of(settings: ServoJointsSettings, joints: Mapping[str, ServoJoint]) -> Bus:
    """The bus, which names these joints in what it says."""
    return Bus(settings, {joint.id: name for name, joint in joints.items()})


_FASTEST = 32767  # As the registers have it, in which zero is no limit


@dataclass(frozen=True)
class ServoReading:
    """What a servo says while it works."""

    position: int  # counts
    goal: int
    has_torque: bool  # whether it holds
    load: float  # share of full torque (-1 to 1); of no meaning where the model does not know it
    voltage: float  # V
    temperature: float  # deg C
    alarms: tuple[str, ...] = ()  # in words


class Servos:
    """All of a bus; each call is an exchange or two for all of them."""

    def __init__(self, bus: Bus, joints: Mapping[str, ServoJoint]) -> None:
        self._bus, self._joints = bus, joints
        self._goals: dict[str, int] = {}
        self._speeds: dict[str, int] = {}

    def readings(self) -> dict[str, ServoReading]:
        """Of all joints.

        Raises:
            DeviceError: one does not answer, or not well.
        """
        registers = self._bus.map.registers
        by_id = self._bus.numbers([joint.id for joint in self._joints.values()], *self._bus.map.polled)
        return {
            name: ServoReading(
                position=numbers["position"],
                goal=numbers["goal"],
                has_torque=bool(numbers["torque"]),
                load=numbers["load"] * registers["load"].unit,
                voltage=numbers["voltage"] * registers["voltage"].unit,
                temperature=float(numbers["temperature"]),
                alarms=self._bus.alarms(self._joints[name].id),
            )
            for name, numbers in zip(self._joints, by_id.values(), strict=True)
        }

    def set_motion(self, joint: ServoJoint, speed: float, acceleration: float) -> None:
        """How fast a servo turns by itself at most (rad/s, rad/s^2). Zero would be no limit, so it is never written."""
        for name, value in (("acceleration", acceleration), ("speed", speed)):
            register = self._bus.map.registers[name]
            most = 254 if register.size == 1 else _FASTEST
            number = min(max(round(value / register.unit), 1), most)
            self._bus.set_number(joint.id, name, number)
        self._speeds[joint.name] = number

    def hold(self, joint: ServoJoint, count: int) -> None:
        """Torque on, at a count that is where it stands."""
        self._bus.set_number(joint.id, "goal", count)
        self._bus.set_number(joint.id, "torque", 1)
        self._bus.set_number(joint.id, "goal", count)  # some servos set their goal anew when torque comes on
        self._goals[joint.name] = count

    def release(self, joint: ServoJoint) -> None:
        """Torque off, read back.

        Raises:
            DeviceError: it is still on.
        """
        self._goals.pop(joint.name, None)
        self._bus.set_number(joint.id, "torque", 0)
        if self._bus.number(joint.id, "torque"):
            text = f"the torque of {joint.label} did not go off."
            raise DeviceError(text, where=self._bus.where, hint="Hold the arm and switch the servos' power off.")

    def command(self, goals: Mapping[str, int]) -> None:
        """Goals of joints whose motion was set, all at once."""
        self._goals |= goals
        written = {self._joints[name].id: self._goal_bytes(name) for name in goals}
        self._bus.write_all(self._bus.map.registers["goal"].address, written)

    def repeat(self, readings: Mapping[str, ServoReading], powered: Collection[str]) -> None:
        """Command once more what did not arrive: a goal for all at once is acknowledged by nobody.

        Raises:
            DeviceError: a servo does not take its goal.
        """
        for name, goal in self._goals.items():
            if name in powered and readings[name].goal != goal:
                address = self._bus.map.registers["goal"].address
                self._bus.write(self._joints[name].id, address, self._goal_bytes(name))

    def _goal_bytes(self, name: str) -> bytes:
        """A goal, and the speed in the same go where its register follows.

        A servo that started anew has forgotten its speed, and some switch their torque on with the next goal. Zero
        between the two is a time to be taken of some servos: the speed holds.
        """
        goal, speed = (self._bus.map.registers[register] for register in ("goal", "speed"))
        data, between = goal.pack(self._goals[name]), speed.address - goal.address - goal.size
        return data + bytes(between) + speed.pack(self._speeds[name]) if between >= 0 else data
