"""The device ``servobus``: joints by name, on servos that share a serial bus and know where they stand; and the joint
stream of an arm whose servos are guided by hand.
"""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from armcal.base.settings import Temperature
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
from armcal.devices.live import JointSample, JointStream
from armcal.errors import ConfigError
from pydantic import Field
from typing_extensions import override

from armcal_servobus.joints import ServoJoint, ServoJointsSettings, Servos, drivable

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
_AGAIN_S = 0.5


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


class ServoBusDevice(JointDevice, MeasuringDevice):
    """The device ``servobus``; see ``JointDevice`` and ``MeasuringDevice`` in ``armcal.devices.device``."""

    Settings: ClassVar[type[ServoBusSettings]] = ServoBusSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "port": "ttyUSB0",
        "joints": {
            "q1": {"id": 1, "model": "sts3215", "range_deg": [-100, 100]},
            "q2": {"id": 2, "model": "sts3215", "direction": -1, "range_deg": [-90, 90]},
        },
    }

    def __init__(self, settings: ServoBusSettings, joint_names: Sequence[str], link: Link | None = None) -> None:
        self._settings, self._servos = settings, Servos(settings, joint_names)
        self._joints, self._bus = self._servos.joints, self._servos.bus
        drivable(self._joints.values())
        self._clock: Clock = RealClock()
        self._is_open = False
        self._powered: set[str] = set()
        self._goals: dict[str, int] = {}  # counts by joint, as last commanded
        self._speeds: dict[str, int] = {}  # as the registers have them
        self._loaded_since: dict[str, float] = {}
        self._reported: set[tuple[str, str]] = set()

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self._joints)

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        self.close()
        self._clock, self._loaded_since, self._reported = clock, {}, set()
        try:
            adapter = self._servos.open()
            readings = self._servos.readings()
            self._check(readings)
            for joint, reading in readings.items():  # one that has started anew may hold, and knows no limit
                if reading["torque"]:
                    self._limit_motion(joint)
                    self._powered.add(joint)
            self._is_open = True
        except BaseException:
            self.close()
            raise
        models, baud = ", ".join(sorted({joint.model.name for joint in self._joints.values()})), self._settings.baud
        name = f"{len(self._joints)} servos ({models}) on {adapter or 'an adapter without an id'} at {baud} baud"
        parts: dict[str, Any] = {}
        for joint, servo in self._joints.items():
            parts[joint] = {"id": servo.id, "model": servo.model.name, "offset": self._servos.stored[joint]["offset"]}
            parts[joint] |= {"zero_count": servo.settings.zero_count, "direction": servo.settings.direction}
        return DeviceIdentity(name, identity_of(parts), None, adapter)

    @override
    def state(self) -> DeviceState:
        readings = self._opened().readings()
        self._powered = {joint for joint, reading in readings.items() if reading["torque"]}
        goals = {joint: readings[joint]["goal"] for joint in self._joints if joint in self._powered}
        return DeviceState({joint: self._joints[joint].angle(goal) for joint, goal in goals.items()})

    @override
    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        servos = self._joints
        return {joint: servos[joint].angle(servos[joint].count(angle)) for joint, angle in angles.items()}

    @override
    def measured(self) -> dict[str, float]:
        servos = self._opened()
        return {joint: servos.angle(joint, reading) for joint, reading in servos.readings().items()}

    @override
    def energise(self, joint: str, angle: float) -> None:
        """Hold the joint where it stands, then turn it to the angle at the speed that is set: it does not jump."""
        self._opened()
        servo = self._joints[joint]
        goal = servo.count(angle)
        if joint not in self._powered:
            self._limit_motion(joint)
            here = servo.unwrapped(self._bus.number(servo.id, "position"))
            low, high = servo.count_range
            if not low <= here <= high:
                servo.count(servo.angle(here))  # refuses what is further out than a count
            here = min(max(here, low), high)
            for register, value in (("goal", here), ("torque", 1), ("goal", here)):
                self._bus.set_number(servo.id, register, value)  # some set their goal anew when torque comes on
            self._goals[joint] = here
            self._powered.add(joint)
        self._write_goals({joint: goal})
        self._clock.sleep(_SETTLES_S)

    @override
    def command(self, angles: Mapping[str, float]) -> None:
        self._opened()
        goals = {joint: self._joints[joint].count(angle) for joint, angle in angles.items()}
        require_energised(goals, self._powered, self._bus.where)
        self._write_goals(goals)

    @override
    def keep_alive(self) -> None:
        """Read all servos, judge them, and send once more the goals that did not arrive."""
        readings = self._opened().readings()
        self._check(readings)
        for joint, goal in self._goals.items():
            if joint in self._powered and readings[joint]["goal"] != goal:
                address = self._bus.map.registers["goal"].address
                self._bus.write(self._joints[joint].id, address, self._goal_bytes(joint))

    @override
    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        """Such servos have nobody who would look after them: they hold."""
        return False

    @override
    def release(self, joint: str) -> None:
        servos = self._opened()
        self._powered.discard(joint)
        self._goals.pop(joint, None)
        servos.release(joint)

    @override
    def close(self) -> None:
        self._is_open, self._powered = False, set()
        self._bus.close()

    def _check(self, readings: Mapping[str, Mapping[str, int]]) -> None:
        settings, registers, now = self._settings, self._bus.map.registers, self._clock.now()
        volt = registers["voltage"].unit
        for name, reading in readings.items():
            joint, stored = self._joints[name], self._servos.stored[name]
            if alarms := self._bus.alarms(joint.id):
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
        limp = [self._joints[name].label for name in readings if name in self._powered and not readings[name]["torque"]]
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
            register = self._bus.map.registers[key]
            most = 254 if register.size == 1 else _FASTEST
            number = min(max(round(math.radians(limit) / register.unit), 1), most)
            self._bus.set_number(self._joints[joint].id, key, number)
        self._speeds[joint] = number

    def _write_goals(self, goals: Mapping[str, int]) -> None:
        """All at once: nobody acknowledges that, and ``keep_alive`` repeats what did not arrive."""
        self._goals |= goals
        written = {self._joints[joint].id: self._goal_bytes(joint) for joint in goals}
        self._bus.write_all(self._bus.map.registers["goal"].address, written)

    def _goal_bytes(self, joint: str) -> bytes:
        """A goal, and the speed in the same go where its register follows.

        A servo that started anew has forgotten its speed, and some switch their torque on with the next goal. Zero
        between the two is a time to be taken of some servos: the speed holds.
        """
        goal, speed = (self._bus.map.registers[register] for register in ("goal", "speed"))
        data, between = goal.pack(self._goals[joint]), speed.address - goal.address - goal.size
        return data + bytes(between) + speed.pack(self._speeds[joint]) if between >= 0 else data

    def _opened(self) -> Servos:
        if not self._is_open:
            raise DeviceLostError("the device is not open.", where=self._bus.where, hint="Open it.")
        return self._servos


class ServoStreamSettings(ServoJointsSettings):
    """The bus and its joints, and how often they are read.

    ``torque`` is what becomes of servos that hold: they are a reason to refuse, or are let go one by one, so that a
    loaded arm drops.
    """

    rate_hz: Annotated[float, Field(gt=0, le=500)] = 50.0
    torque: Literal["refuse", "release"] = "refuse"


class ServoBusStream(JointStream):
    """The joint stream ``servobus``: all joints at a time. See ``armcal.devices.live.JointStream``."""

    Settings: ClassVar[type[ServoStreamSettings]] = ServoStreamSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "port": "ttyUSB0",
        "joints": {f"arm.q{i}": {"id": i, "model": "sts3215", "range_deg": [-150, 150]} for i in (1, 2, 3)},
    }

    def __init__(self, settings: ServoStreamSettings) -> None:
        self._settings = settings
        self._refused: Counter[str] = Counter()
        self._clock: Clock = RealClock()
        self._next = 0.0
        self._servos: Servos | None = None

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        try:
            servos = Servos(self._settings, channels)
        except ValueError as fault:
            raise ConfigError(f"bench.joints: {fault}.", hint="Give each joint its servo.") from fault
        self._servos, self._clock, self._next = servos, clock, clock.now()
        try:
            servos.open(moves=False)
            holding = [name for name, reading in servos.readings().items() if reading["torque"]]
            if holding and self._settings.torque == "refuse":
                text = f"{', '.join(holding)} hold, expected servos without torque, which can be guided by hand."
                hint = "Hold the arm, and give bench.joints: {torque: release}, which lets them go."
                raise DeviceRefusedError(text, hint=hint)
            for name in reversed(holding):
                servos.release(name)
        except DeviceLostError as fault:
            self.close()
            raise DeviceRefusedError(fault.message, where=fault.where, hint=fault.hint) from fault
        except BaseException:
            self.close()
            raise

    @override
    def samples(self) -> list[JointSample]:
        if self._servos is None or (now := self._clock.now()) < self._next:
            return []
        self._next = now + 1 / self._settings.rate_hz
        try:
            readings = self._servos.readings()
        except DeviceError as fault:
            self._refused[fault.message] += 1
            self._next = now + _AGAIN_S
            try:
                self._servos.bus.open()
            except (DeviceError, DeviceRefusedError) as again:
                self._refused[again.message] += 1
            return []
        return [JointSample(now, None, {name: self._servos.angle(name, row) for name, row in readings.items()})]

    @property
    @override
    def ended(self) -> bool:
        return self._servos is None

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return dict(self._refused)

    @override
    def close(self) -> None:
        if self._servos is not None:
            self._servos.bus.close()
        self._servos = None
