"""The joints of a servo bus: which servo each is, and which count is which angle."""

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
from armcal_servobus.finding import alarms_of, read_number
from armcal_servobus.models import MODELS, ServoModel

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


_TIME_BYTES = 2  # Between goal and speed some have a time to be taken, which is zero here: the speed holds


@dataclass(frozen=True)
class ServoReading:
    """What a servo says while it works.

    Attributes:
        position, goal: counts, as its registers have them.
    """

    position: int
    goal: int
    has_torque: bool  # whether it holds
    load: float  # share of full torque (-1 to 1), or its current (A) where the model says that
    voltage: float  # V
    temperature: float  # deg C
    alarms: tuple[str, ...] = ()  # in words


class Servos:
    """All of a bus; each call is an exchange or two for all of them."""

    def __init__(self, bus: Bus, joints: Mapping[str, ServoJoint]) -> None:
        self._bus, self._joints = bus, joints
        self._goals: dict[str, int] = {}
        self._speeds: dict[str, int] = {}

    def reading(self, joint: str) -> ServoReading:
        return self.readings((joint,))[joint]

    def readings(self, names: Iterable[str] | None = None) -> dict[str, ServoReading]:
        """Of all joints, or of some.

        Raises:
            DeviceError: one does not answer, or not well.
        """
        joints = [self._joints[name] for name in (self._joints if names is None else names)]
        values: dict[str, dict[str, int]] = {joint.name: {} for joint in joints}
        by_polled: dict[tuple[tuple[int, int], ...], list[ServoJoint]] = {}
        for joint in joints:
            by_polled.setdefault(joint.model.polled, []).append(joint)
        for polled, alike in by_polled.items():
            for stretch in polled:
                together = all(joint.model.reads_together for joint in alike)
                data = self._bus.read_all([joint.id for joint in alike], *stretch, together=together)
                for joint in alike:
                    model = joint.model
                    names_there = [name for name in model.registers if model.holds(name, stretch)]
                    values[joint.name] |= {name: model.unpack(name, data[joint.id], stretch[0]) for name in names_there}
        readings = {}
        for joint in joints:
            own, registers = values[joint.name], joint.model.registers
            readings[joint.name] = ServoReading(
                position=own["position"],
                goal=own["goal"],
                has_torque=bool(own["torque"]),
                load=own["load"] * registers["load"].unit,
                voltage=own["voltage"] * registers["voltage"].unit,
                temperature=float(own["temperature"]),
                alarms=alarms_of(self._bus, joint.id, joint.model),
            )
        return readings

    def positions(self) -> dict[str, int]:
        """Counts of all joints, in one exchange; quicker than ``readings``."""
        positions: dict[str, int] = {}
        by_model: dict[tuple[int, int, bool], list[ServoJoint]] = {}
        for joint in self._joints.values():
            register = joint.model.registers["position"]
            by_model.setdefault((register.address, register.size, joint.model.reads_together), []).append(joint)
        for (address, size, together), alike in by_model.items():
            data = self._bus.read_all([joint.id for joint in alike], address, size, together=together)
            positions |= {joint.name: joint.model.unpack("position", data[joint.id]) for joint in alike}
        return positions

    def set_motion(self, joint: ServoJoint, speed: float, acceleration: float) -> None:
        """How fast a servo turns by itself at most (rad/s, rad/s^2). Zero would be no limit, so it is never written."""
        for name, value in (("acceleration", acceleration), ("speed", speed)):
            if name in joint.model.registers:
                register = joint.model.registers[name]
                most = 254 if register.size == 1 else 1023 if joint.model.counts == 1024 else 32767
                unit = register.unit if register.unit != 1.0 else joint.model.step
                number = min(max(round(value / unit), 1), most)
                self._write(joint, name, number)
                if name == "speed":
                    self._speeds[joint.name] = number

    def hold(self, joint: ServoJoint, count: int) -> None:
        """Torque on, at a count that is where it stands."""
        self._write(joint, "goal", count)
        self._write(joint, "torque", 1)
        self._write(joint, "goal", count)  # some servos set their goal anew when torque comes on
        self._goals[joint.name] = count

    def release(self, joint: ServoJoint) -> None:
        """Torque off, read back.

        Raises:
            DeviceError: it is still on.
        """
        self._goals.pop(joint.name, None)
        self._write(joint, "torque", 0)
        if read_number(self._bus, joint.id, joint.model, "torque"):
            text = f"the torque of {joint.name} (id {joint.id}) did not go off."
            raise DeviceError(text, where=self._bus.where, hint="Hold the arm and switch the servos' power off.")

    def command(self, goals: Mapping[str, int]) -> None:
        self._goals |= goals
        places: dict[tuple[int, int], dict[int, bytes]] = {}
        for name, goal in goals.items():
            address, data = self._with_speed(self._joints[name], goal)
            places.setdefault((address, len(data)), {})[self._joints[name].id] = data
        for (address, _), by_id in places.items():
            self._bus.write_all(address, by_id)

    def repeat(self, readings: Mapping[str, ServoReading], powered: Iterable[str]) -> None:
        """Command once more what did not arrive: a goal for all at once is acknowledged by nobody.

        Raises:
            DeviceError: a servo does not take its goal.
        """
        chosen = set(powered) & set(self._goals)
        missed = {name: self._goals[name] for name in readings if name in chosen}
        missed = {name: goal for name, goal in missed.items() if readings[name].goal != goal}
        for name, goal in missed.items():
            self._bus.write(self._joints[name].id, *self._with_speed(self._joints[name], goal))

    def _with_speed(self, joint: ServoJoint, goal: int) -> tuple[int, bytes]:
        """The address and the bytes that set a goal, and the speed in the same go where its register is at hand.

        A servo that started anew has forgotten its speed, and some switch their torque on with the next goal.
        """
        model = joint.model
        first, speed, data = model.registers["goal"], model.registers.get("speed"), model.pack("goal", goal)
        between = -1 if speed is None else speed.address - first.address - first.size
        if joint.name not in self._speeds or not 0 <= between <= _TIME_BYTES:
            return first.address, data
        return first.address, data + bytes(between) + model.pack("speed", self._speeds[joint.name])

    def _write(self, joint: ServoJoint, name: str, value: int) -> None:
        self._bus.write(joint.id, joint.model.registers[name].address, joint.model.pack(name, value))
