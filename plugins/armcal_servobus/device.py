"""The joints of a servo bus: which servo each is, which count is which angle, how they are compared and driven by the
device ``servobus``, and read by the joint stream of that name while the arm is guided by hand.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

from armcal.base.settings import Settings, Temperature, UnitOf
from armcal.calibration.calibration_file import identity_of
from armcal.devices.clock import Clock, RealClock
from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceLostError,
    DeviceRefusedError,
    DeviceResetError,
    DeviceState,
    DeviceUnwellError,
    JointDevice,
    MeasuringDevice,
    require_energised,
)
from armcal.devices.link import Link
from armcal.devices.live import GuidedDevice, GuidedJoints, GuidedSettings
from armcal.errors import Location
from pydantic import Field, field_validator, model_validator
from typing_extensions import override

from armcal_servobus.bus import COUNTS, LAST_ID, MODELS, SILENT_MEND, STEP, Bus, BusSettings, FoundServo

SEVERAL_TURNS = 0x10  # Of a Feetech servo's phase: it reports angles of several turns
_SLACK = 1e-9
_ROUNDED = 2  # Counts: limits in a servo may be so much narrower than a range that was rounded
_BLOCKED_S = 1.0
_VOLTAGE_SLACK = 0.15
_MENDS: Mapping[str, str] = {
    "overload": "It is blocked or carries too much: take the load away, then switch its power off and on.",
    "overheating": "Let it cool, with torque off; then give it rests (bench.acquisition.heat) or less load.",
    "overcurrent": "It is blocked or its motor is damaged: turn the joint by hand with the power off.",
    "voltage": "Measure the supply at the last servo while the arm holds: thin cables and weak supplies sag.",
    "angle sensor": "Its encoder or its magnet is damaged: exchange the servo.",
    "load": "It is blocked or carries too much: free it, or take the load away.",
    "encoder": "Its encoder is damaged: exchange the servo.",
    "shock": "Its supply failed or its wiring is damaged: look at both, then switch its power off and on.",
}
_FASTEST = 32767  # As the registers have it
_SETTLES_S = 0.02


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
        keys = {}
        for name in names:
            alike = [key for key in self.joints if key.split(".")[-1] == name.split(".")[-1]]
            keys[name] = [name] if name in self.joints else alike
        if missing := [name for name, alike in keys.items() if len(alike) != 1]:
            raise ValueError(f"found no servo for {', '.join(missing)}; joints has {', '.join(self.joints)}")
        return {name: ServoJoint(name, self.joints[key]) for name, (key,) in keys.items()}


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

    def measured(self, count: int) -> float:
        """The angle of a count that the servo reports (rad)."""
        return self.angle(count + COUNTS * round((sum(self.count_range) / 2 - count) / COUNTS))

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

    def require_drivable(self) -> None:
        """Raise ValueError if the range crosses the end of the encoder's turn, over which no servo can be driven."""
        if self.crosses_seam:
            low, high = self.count_range
            what = f"the range of {self.name} is counts {low} to {high}, expected 0 to {COUNTS - 1}"
            mend = f"set homing offsets with armcal bus home, then zero_count: {COUNTS // 2}"
            raise ValueError(f"{what}: a servo cannot be driven over the end of its encoder's turn; {mend}")


class Mistake(NamedTuple):
    """Something about a servo that is not as configured."""

    joint: str
    what: str
    mend: str  # what to do
    of_motion: bool = False  # it matters only if joints are to move


class Servos(MeasuringDevice):
    """The servos of joints on their bus, by the joints' names: they are read, and let go."""

    moves: ClassVar[bool] = False  # whether joints are to be driven

    def __init__(self, settings: ServoJointsSettings, names: Iterable[str]) -> None:
        self.joints = settings.chosen(names)
        self.bus = Bus(settings, {joint.id: name for name, joint in self.joints.items()})
        self.stored: dict[str, dict[str, int]] = {}  # in those that ``examine`` recognised; empty: not open

    def open(self, clock: Clock) -> DeviceIdentity:
        """Open the bus; what is not as configured is refused, with every fault."""
        self.close()
        try:
            adapter = self.bus.open()
            if mistakes := [mistake for mistake in self.examine() if self.moves or not mistake.of_motion]:
                listed = "; ".join(f"{mistake.joint} {mistake.what}" for mistake in mistakes)
                text, hints = f"found servos that are not as configured: {listed}.", (m.mend for m in mistakes)
                raise DeviceRefusedError(text, where=self.bus.where, hint=" ".join(dict.fromkeys(hints)))
        except BaseException:
            self.close()
            raise
        models = ", ".join(sorted({joint.model.name for joint in self.joints.values()}))
        on = f"{adapter or 'an adapter without an id'} at {self.bus.settings.baud} baud"
        parts: dict[str, Any] = {}
        for name, joint in self.joints.items():
            parts[name] = {"id": joint.id, "model": joint.model.name, "offset": self.stored[name]["offset"]}
            parts[name] |= {"zero_count": joint.settings.zero_count, "direction": joint.settings.direction}
        return DeviceIdentity(f"{len(self.joints)} servos ({models}) on {on}", identity_of(parts), None, adapter)

    def close(self) -> None:
        self.stored = {}
        self.bus.close()

    def examine(self) -> list[Mistake]:
        """Read what the servos store; gives all that is not as configured."""
        bus, joints = self.bus, self.joints
        servos = {name: bus.looked_at(joint.id, times=2) for name, joint in joints.items()}
        ids = {joint.id for joint in joints.values()}
        strangers = [servo for servo in bus.present() if servo not in ids] if None in servos.values() else []
        if not strangers and not any(servos.values()):
            raise DeviceLostError(f"no servo answers at {bus.settings.baud} baud.", where=bus.where, hint=SILENT_MEND)
        self.stored = {}
        return [mistake for name in joints for mistake in self._mistakes(name, servos[name], strangers)]

    def _mistakes(self, name: str, servo: FoundServo | None, strangers: list[int]) -> Iterator[Mistake]:
        joint = self.joints[name]
        mistake, model = partial(Mistake, joint.label), joint.model
        if servo is None:
            listed = ", ".join(map(str, strangers))
            mend = f"Found the id {listed}, which no joint has: is that the servo? Then give it the id {joint.id}."
            yield mistake("does not answer", mend if strangers else SILENT_MEND)
            return
        if servo.doubled:
            mend = f"Two servos may have the id {joint.id}: unplug all but one, and give it another id."
            yield mistake(f"answers damaged or twice ({servo.damaged} times)", mend)
            return
        if model.number not in (servo.model_number, None):
            other = servo.model or f"a model of number {servo.model_number}"
            mend = f"Set model, or plug in the {model.name}; ids may be exchanged."
            yield mistake(f"is {other}, expected {model.name}", mend)
            return
        stored = self.stored[name] = self.bus.numbers((joint.id,), self.bus.map.stored)[joint.id]
        stated, expected = joint.settings.offset, self.bus.map.position_mode
        if stated is not None and stated != stored["offset"]:
            mend = f"Write it with armcal bus home CONFIG --offset {name}={stated}, or correct offset."
            yield mistake(f"holds the homing offset {stored['offset']}, expected {stated}", mend)
        if stored["mode"] != expected:
            what = f"is in operating mode {stored['mode']}, expected {expected} (positions)"
            yield mistake(what, "Set its mode with the maker's program.", of_motion=True)
        if stored.get("phase", 0) & SEVERAL_TURNS:
            what = "reports angles of several turns (bit 4 of its phase, register 18)"
            yield mistake(what, "Clear that bit: armcal bus home does so.")
        low, high = joint.count_range
        least, most = stored["min"], stored["max"]
        if not joint.crosses_seam and (low + _ROUNDED < least or high - _ROUNDED > most):
            what = f"stops at counts {least} and {most}, and its range is {low} to {high}"
            ends = sorted(math.degrees(joint.angle(limit)) for limit in (least, most))
            mend = f"Narrow range_deg of {name} to [{ends[0]:.1f}, {ends[1]:.1f}], or widen the limits in the servo."
            yield mistake(what, mend, of_motion=True)

    def readings(self) -> dict[str, dict[str, int]]:
        """What changes while servos work, by joint and register."""
        by_id = self.bus.numbers([joint.id for joint in self.joints.values()], *self.bus.map.polled)
        return dict(zip(self.joints, by_id.values(), strict=True))

    def state(self) -> DeviceState:
        readings, joints = self.readings(), self.joints
        return DeviceState({name: joints[name].angle(row["goal"]) for name, row in readings.items() if row["torque"]})

    @override
    def measured(self) -> dict[str, float]:
        return {name: self.joints[name].measured(row["position"]) for name, row in self.readings().items()}

    def release(self, joint: str) -> None:
        """Torque off, read back."""
        servo = self.joints[joint]
        self.bus.set_number(servo.id, "torque", 0)
        if self.bus.number(servo.id, "torque"):
            text = f"the torque of {servo.label} did not go off."
            raise DeviceError(text, where=self.bus.where, hint="Hold the arm and switch the servos' power off.")


class ServoBusSettings(ServoJointsSettings):
    """The bus and its joints; how fast a servo may turn by itself, and when it counts as unwell.

    ``speed_deg_per_s`` and ``acceleration_deg_per_s2`` are written to the servos; they limit a step that is commanded,
    and how fast a joint goes to its first angle. ``temperature`` is the highest that is borne, the servo's own limit
    where it is lower; ``load_percent`` of full torque for longer than a second is a joint that is blocked.
    """

    speed_deg_per_s: Annotated[float, Field(gt=0, le=720, description="at most, of a servo")] = 60.0
    acceleration_deg_per_s2: Annotated[float, Field(gt=0, le=10_000, description="at most")] = 500.0
    temperature: Annotated[Temperature, Field(gt=20, le=100)] = 65.0
    load_percent: Annotated[float, Field(gt=0, le=100, description="of full torque")] = 95.0


class ServoBusDevice(Servos, JointDevice):
    """The device ``servobus``; see ``JointDevice`` and ``MeasuringDevice`` in ``armcal.devices.device``."""

    Settings: ClassVar[type[ServoBusSettings]] = ServoBusSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "port": "ttyUSB0",
        "joints": {
            "q1": {"id": 1, "model": "sts3215", "range_deg": [-100, 100]},
            "q2": {"id": 2, "model": "sts3215", "direction": -1, "range_deg": [-90, 90]},
        },
    }
    moves = True

    def __init__(self, settings: ServoBusSettings, joint_names: Sequence[str], link: Link | None = None) -> None:
        super().__init__(settings, joint_names)
        for joint in self.joints.values():
            joint.require_drivable()
        self._settings = settings
        self._clock: Clock = RealClock()
        self._powered: set[str] = set()
        self._goals: dict[str, int] = {}  # counts by joint, as last commanded
        self._speeds: dict[str, int] = {}  # as the registers have them
        self._loaded_since: dict[str, float] = {}
        self._reported: set[tuple[str, str]] = set()

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self.joints)

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        self._powered, self._loaded_since, self._reported = set(), {}, set()
        identity, self._clock = super().open(clock), clock
        try:
            readings = self.readings()
            self._check(readings)
            for joint, reading in readings.items():  # one that has started anew may hold, and knows no limit
                if reading["torque"]:
                    self._limit_motion(joint)
                    self._powered.add(joint)
        except BaseException:
            self.close()
            raise
        return identity

    @override
    def state(self) -> DeviceState:
        state = super().state()
        self._powered = set(state.angles)
        return state

    @override
    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        return {joint: self.joints[joint].angle(self.joints[joint].count(angle)) for joint, angle in angles.items()}

    @override
    def energise(self, joint: str, angle: float) -> None:
        """Hold the joint where it stands, then turn it to the angle at the speed that is set: it does not jump."""
        servo = self.joints[joint]
        goal = servo.count(angle)
        if joint not in self._powered:
            self._limit_motion(joint)
            here = servo.count(servo.measured(self.bus.number(servo.id, "position")))
            for register, value in (("goal", here), ("torque", 1), ("goal", here)):
                self.bus.set_number(servo.id, register, value)  # some set their goal anew when torque comes on
            self._goals[joint] = here
            self._powered.add(joint)
        self._write_goals({joint: goal})
        self._clock.sleep(_SETTLES_S)

    @override
    def command(self, angles: Mapping[str, float]) -> None:
        goals = {joint: self.joints[joint].count(angle) for joint, angle in angles.items()}
        require_energised(goals, self._powered, self.bus.where)
        self._write_goals(goals)

    @override
    def keep_alive(self) -> None:
        """Read all servos, judge them, and send once more the goals that did not arrive."""
        readings = self.readings()
        self._check(readings)
        for joint, goal in self._goals.items():
            if joint in self._powered and readings[joint]["goal"] != goal:
                address = self.bus.map.registers["goal"].address
                self.bus.write(self.joints[joint].id, address, self._goal_bytes(joint))

    @override
    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        """Such servos have nobody who would look after them: they hold."""
        return False

    @override
    def release(self, joint: str) -> None:
        self._powered.discard(joint)
        self._goals.pop(joint, None)
        super().release(joint)

    def _check(self, readings: Mapping[str, Mapping[str, int]]) -> None:
        settings, registers, now = self._settings, self.bus.map.registers, self._clock.now()
        volt = registers["voltage"].unit
        for name, reading in readings.items():
            joint, stored = self.joints[name], self.stored[name]
            if alarms := self.bus.alarms(joint.id):
                mends = " ".join(dict.fromkeys(_MENDS.get(word, "") for word in alarms)).strip()
                raise DeviceError(f"{joint.label} reports {' and '.join(alarms)}.", hint=mends or "See its manual.")
            limit = min(settings.temperature, stored["max_temperature"])
            if reading["temperature"] >= limit:
                self._report(joint, f"is at {reading['temperature']} deg C, expected below {limit:.0f}", "overheating")
            low, high = stored["min_voltage"] * volt, stored["max_voltage"] * volt
            if not low - _VOLTAGE_SLACK <= (voltage := reading["voltage"] * volt) <= high + _VOLTAGE_SLACK:
                text = f"{joint.label} has {voltage:.1f} V, expected {low:.1f} to {high:.1f}."
                raise DeviceError(text, hint=_MENDS["voltage"])
            percent = 100 * abs(reading["load"] * registers["load"].unit)
            if not (joint.model.knows_load and reading["torque"] and percent >= settings.load_percent):
                self._loaded_since.pop(name, None)
            elif now - self._loaded_since.setdefault(name, now) >= _BLOCKED_S:
                self._report(joint, f"works with {percent:.0f} % of its torque for {_BLOCKED_S:g} s", "load")
        limp = [self.joints[name].label for name in readings if name in self._powered and not readings[name]["torque"]]
        if limp:
            text = f"{', '.join(limp)} lost torque by itself: started anew, or gave up under load."
            raise DeviceResetError(text, hint="Look at the supply and the plugs, and whether the joint is blocked.")

    def _report(self, joint: ServoJoint, what: str, fault: str) -> None:
        """The first time only: on its way to where it parks the arm is not stopped by it."""
        if (joint.name, fault) not in self._reported:
            self._reported.add((joint.name, fault))
            raise DeviceUnwellError(f"{joint.label} {what}.", hint=_MENDS[fault])

    def _limit_motion(self, joint: str) -> None:
        """Limit how fast a servo turns by itself. Zero would be no limit, so it is never written."""
        limits = self._settings.acceleration_deg_per_s2, self._settings.speed_deg_per_s
        for key, limit in zip(("acceleration", "speed"), limits, strict=True):
            register = self.bus.map.registers[key]
            most = 254 if register.size == 1 else _FASTEST
            number = min(max(round(math.radians(limit) / register.unit), 1), most)
            self.bus.set_number(self.joints[joint].id, key, number)
        self._speeds[joint] = number

    def _write_goals(self, goals: Mapping[str, int]) -> None:
        """All at once: nobody acknowledges that, and ``keep_alive`` repeats what did not arrive."""
        if not self.stored:  # what nobody sends now must not be sent once it is open again
            raise DeviceLostError("the device is not open.", where=self.bus.where, hint="Open it.")
        self._goals |= goals
        written = {self.joints[joint].id: self._goal_bytes(joint) for joint in goals}
        self.bus.write_all(self.bus.map.registers["goal"].address, written)

    def _goal_bytes(self, joint: str) -> bytes:
        """A goal, and the speed in the same go where its register follows.

        A servo that started anew has forgotten its speed, and some switch their torque on with the next goal. Zero
        between the two is a time to be taken of some servos: the speed holds.
        """
        goal, speed = (self.bus.map.registers[register] for register in ("goal", "speed"))
        data, between = goal.pack(self._goals[joint]), speed.address - goal.address - goal.size
        return data + bytes(between) + speed.pack(self._speeds[joint]) if between >= 0 else data


class ServoStreamSettings(ServoJointsSettings, GuidedSettings):
    """A bus, its joints, how often they are read; ``torque: release`` lets servos go that hold: a loaded arm drops."""


class ServoBusStream(GuidedJoints):
    """The joint stream ``servobus``: all joints at a time. See ``armcal.devices.live.JointStream``."""

    Settings: ClassVar[type[ServoStreamSettings]] = ServoStreamSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "port": "ttyUSB0",
        "joints": {f"arm.q{i}": {"id": i, "model": "sts3215", "range_deg": [-150, 150]} for i in (1, 2, 3)},
    }

    def __init__(self, settings: ServoStreamSettings) -> None:
        super().__init__(settings, partial(Servos, settings))

    @override
    def reopen(self, device: GuidedDevice) -> None:
        """The port alone: servos that do not answer would be looked for on the whole bus."""
        assert isinstance(device, Servos)
        device.bus.open()
