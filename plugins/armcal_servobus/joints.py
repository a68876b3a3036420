"""The joints of a servo bus: which servo each is, which count is which angle, how they are compared and driven."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Annotated, Literal, NamedTuple

from armcal.base.settings import Settings, UnitOf
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError
from armcal.errors import Location
from pydantic import Field, field_validator, model_validator

from armcal_servobus.bus import COUNTS, LAST_ID, MODELS, SILENT_MEND, STEP, Bus, BusSettings, looked_at, present

SEVERAL_TURNS = 0x10  # Of a Feetech servo's phase: it reports angles of several turns
_SLACK = 1e-9
_ROUNDED = 2  # Counts: limits in a servo may be so much narrower than a range that was rounded


class BusJointSettings(Settings):
    """A joint's servo: its id, its model, the count at the joint's zero, and the way in which counts rise.

    ``range`` is where the joint may go. ``offset`` is the homing offset that the servo's EEPROM must hold; where it is
    not stated, any will do, and is part of what identifies the arm.
    """

    id: Annotated[int, Field(ge=0, le=LAST_ID)]
    model: str
    zero_count: int = COUNTS // 2
    direction: Literal[1, -1] = 1
    range: Annotated[tuple[float, float], UnitOf("angle")]
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
            MODELS[self.model].check_offset(self.offset)
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
        """The servos of joints or channels, by the name that is asked for."""
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


class ServoJoint:
    """A joint and its servo.

    The angle is ``direction * step * (count - zero_count)``. The encoder goes on over the end of its turn: a count
    means the angle that is nearest to the middle of the joint's range.
    """

    def __init__(self, name: str, settings: BusJointSettings) -> None:
        self.name, self.settings = name, settings
        self.id, self.model = settings.id, MODELS[settings.model]
        self.label = f"{name} (id {self.id})"
        ends = sorted(map(self.exact_count, settings.range))
        low, high = math.ceil(ends[0] - _SLACK), math.floor(ends[1] + _SLACK)
        # One count beyond the turn is none: a range of the whole turn, -180 to 180 deg, ends where it begins
        self.count_range = (0 if low == -1 else low), (COUNTS - 1 if high == COUNTS else high)
        # The last count is followed by zero inside its range: it can be read there, and not be driven
        self.crosses_seam = self.count_range[0] < 0 or self.count_range[1] >= COUNTS

    def angle(self, count: float) -> float:
        return self.settings.direction * STEP * (count - self.settings.zero_count)

    def exact_count(self, angle: float) -> float:
        return self.settings.zero_count + self.settings.direction * angle / STEP

    def unwrapped(self, count: int) -> int:
        return count + COUNTS * round((sum(self.count_range) / 2 - count) / COUNTS)

    def count(self, angle: float) -> int:
        """Nearest to an angle (rad)."""
        low, high = self.settings.range
        if not low - STEP <= angle <= high + STEP:  # no range has what is not finite
            ends = " to ".join(f"{math.degrees(end):g}" for end in (low, high))
            text = f"found {math.degrees(angle):.3f} deg for {self.name}, expected {ends} deg, its range."
            hint = "Keep the plan within the range; or move the arm by hand, with torque off, if it hangs beyond it."
            raise DeviceRefusedError(text, where=Location(field=f"joints.{self.name}.range"), hint=hint)
        count = round(self.exact_count(angle))
        return min(max(count, self.count_range[0]), self.count_range[1])


def drivable(joints: Iterable[ServoJoint]) -> None:
    """Raise ValueError if a joint's range crosses the end of its encoder's turn, over which no servo can be driven."""
    for joint in joints:
        if joint.crosses_seam:
            low, high = joint.count_range
            raise ValueError(
                f"the range of {joint.name} is counts {low} to {high}, expected 0 to {COUNTS - 1}: a servo cannot be "
                "driven over the end of its encoder's turn; set homing offsets with armcal bus home, then zero_count: "
                f"{COUNTS // 2}"
            )


class Mistake(NamedTuple):
    """Something about a servo that is not as configured."""

    joint: str
    what: str
    mend: str  # what to do
    of_motion: bool = False  # it matters only if joints are to move


class Servos:
    """The servos of joints on their bus, by the joints' names."""

    def __init__(self, settings: ServoJointsSettings, names: Iterable[str]) -> None:
        self.joints = settings.chosen(names)
        self.bus = Bus(settings, {joint.id: name for name, joint in self.joints.items()})
        self.stored: dict[str, dict[str, int]] = {}  # what those that ``examine`` recognised keep without power

    def open(self, *, moves: bool = True) -> str:
        """Open the bus; gives the adapter's serial number where all is as configured, else names every fault.

        Who calls it closes the bus if that fails.
        """
        adapter = self.bus.open()
        if mistakes := [mistake for mistake in self.examine() if moves or not mistake.of_motion]:
            listed = "; ".join(f"{mistake.joint} {mistake.what}" for mistake in mistakes)
            text, hints = f"found servos that are not as configured: {listed}.", (m.mend for m in mistakes)
            raise DeviceRefusedError(text, where=self.bus.where, hint=" ".join(dict.fromkeys(hints)))
        return adapter

    def examine(self) -> list[Mistake]:
        """Read what the servos store; gives all that is not as configured."""
        bus, joints = self.bus, self.joints
        servos = {name: looked_at(bus, joint.id, times=2) for name, joint in joints.items()}
        ids = {joint.id for joint in joints.values()}
        strangers = [servo for servo in present(bus) if servo not in ids] if None in servos.values() else []
        if not strangers and not any(servos.values()):
            raise DeviceLostError(f"no servo answers at {bus.settings.baud} baud.", where=bus.where, hint=SILENT_MEND)
        self.stored, mistakes = {}, list[Mistake]()
        for name, joint in joints.items():
            servo, model = servos[name], joint.model
            if servo is None:
                listed = ", ".join(map(str, strangers))
                mend = f"Found the id {listed}, which no joint has: is that the servo? Then give it the id {joint.id}."
                mistakes.append(Mistake(joint.label, "does not answer", mend if strangers else SILENT_MEND))
            elif servo.doubled:
                what = f"answers damaged or twice ({servo.damaged} times)"
                mend = f"Two servos may have the id {joint.id}: unplug all but one, and give it another id."
                mistakes.append(Mistake(joint.label, what, mend))
            elif model.number not in (servo.model_number, None):
                other = servo.model or f"a model of number {servo.model_number}"
                mend = f"Set model, or plug in the {model.name}; ids may be exchanged."
                mistakes.append(Mistake(joint.label, f"is {other}, expected {model.name}", mend))
            else:
                self.stored[name] = bus.numbers((joint.id,), bus.map.stored)[joint.id]
                mistakes += _mistakes(joint, self.stored[name], bus.map.position_mode)
        return mistakes

    def readings(self) -> dict[str, dict[str, int]]:
        """What changes while servos work, by joint and register."""
        by_id = self.bus.numbers([joint.id for joint in self.joints.values()], *self.bus.map.polled)
        return dict(zip(self.joints, by_id.values(), strict=True))

    def angle(self, name: str, reading: Mapping[str, int]) -> float:
        """Where a joint stands (rad)."""
        joint = self.joints[name]
        return joint.angle(joint.unwrapped(reading["position"]))

    def release(self, name: str) -> None:
        """Torque off, read back."""
        joint = self.joints[name]
        self.bus.set_number(joint.id, "torque", 0)
        if self.bus.number(joint.id, "torque"):
            text = f"the torque of {joint.label} did not go off."
            raise DeviceError(text, where=self.bus.where, hint="Hold the arm and switch the servos' power off.")


def _mistakes(joint: ServoJoint, stored: Mapping[str, int], mode: int) -> list[Mistake]:
    """What a servo holds that does not fit its joint."""
    mistakes = []
    stated, least, most = joint.settings.offset, stored["min"], stored["max"]
    if stated is not None and stated != stored["offset"]:
        what = f"holds the homing offset {stored['offset']}, expected {stated}"
        mend = f"Write it with armcal bus home CONFIG --offset {joint.name}={stated}, or correct offset."
        mistakes.append(Mistake(joint.label, what, mend))
    if stored["mode"] != mode:
        what = f"is in operating mode {stored['mode']}, expected {mode} (positions)"
        mistakes.append(Mistake(joint.label, what, "Set its mode with the maker's program.", True))
    if stored.get("phase", 0) & SEVERAL_TURNS:
        what = "reports angles of several turns (bit 4 of its phase, register 18)"
        mistakes.append(Mistake(joint.label, what, "Clear that bit: armcal bus home does so."))
    low, high = joint.count_range
    if not joint.crosses_seam and (low + _ROUNDED < least or high - _ROUNDED > most):
        what = f"stops at counts {least} and {most}, and its range is {low} to {high}"
        ends = sorted(math.degrees(joint.angle(limit)) for limit in (least, most))
        mend = f"Narrow range_deg of {joint.name} to [{ends[0]:.1f}, {ends[1]:.1f}], or widen the limits in the servo."
        mistakes.append(Mistake(joint.label, what, mend, True))
    return mistakes
