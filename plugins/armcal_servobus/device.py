"""The device ``servobus``: joints by name, on servos that share a serial bus and know where they stand; and the joint
stream of an arm whose servos are guided by hand.
"""

import math
from collections import Counter
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
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
)
from armcal.devices.link import Link
from armcal.devices.live import JointSample, JointStream
from armcal.errors import ConfigError
from pydantic import Field
from typing_extensions import override

from armcal_servobus.bus import SILENT_MEND, Bus, looked_at, present
from armcal_servobus.joints import ServoJoint, ServoJointsSettings, ServoReading, Servos, bus_of, drivable

_READ_TWICE = 2
SEVERAL_TURNS = 0x10  # Of a Feetech servo's phase: it reports angles of several turns
_ROUNDED = 2  # Counts: limits in a servo may be so much narrower than a range that was rounded


@dataclass(frozen=True)
class Stored:
    """What a servo keeps without power."""

    offset: int  # its homing offset (counts)
    limits: tuple[int, int]  # the counts between which it lets itself be driven
    max_temperature: float  # deg C
    voltage_range: tuple[float, float]  # V
    mode: int
    phase: int  # of a Feetech servo: directions and units, as bits


@dataclass(frozen=True)
class Mistake:
    """Something about a servo that is not as configured, and what to do. ``of_motion``: only one that moves minds."""

    joint: str
    what: str
    mend: str
    of_motion: bool = False


def checked(bus: Bus, joints: Mapping[str, ServoJoint], *, moves: bool = True) -> dict[str, Stored]:
    """What all joints' servos store, by joint, where all is as configured.

    Args:
        moves: whether they are to move.

    Raises:
        DeviceLostError: no servo answers at all.
        DeviceRefusedError: something is not as configured; every fault is named.
    """
    stored, mistakes = examined(bus, joints)
    mistakes = [mistake for mistake in mistakes if moves or not mistake.of_motion]
    if not mistakes:
        return stored
    listed = "; ".join(f"{mistake.joint} {mistake.what}" for mistake in mistakes)
    hints = " ".join(dict.fromkeys(mistake.mend for mistake in mistakes))
    raise DeviceRefusedError(f"found servos that are not as configured: {listed}.", where=bus.where, hint=hints)


def examined(bus: Bus, joints: Mapping[str, ServoJoint]) -> tuple[dict[str, Stored], list[Mistake]]:
    """What the servos of joints store, where they are the configured ones; and all that is not as configured.

    Raises:
        DeviceLostError: no servo answers at all.
    """
    servos = {name: looked_at(bus, joint.id, _READ_TWICE) for name, joint in joints.items()}
    ids = {joint.id for joint in joints.values()}
    strangers = [servo for servo in present(bus) if servo not in ids] if None in servos.values() else []
    if not strangers and not any(servos.values()):
        raise DeviceLostError(f"no servo answers at {bus.settings.baud} baud.", where=bus.where, hint=SILENT_MEND)
    stored: dict[str, Stored] = {}
    mistakes: list[Mistake] = []
    for name, joint in joints.items():
        servo, model = servos[name], joint.model
        if servo is None:
            listed = ", ".join(map(str, strangers))
            mend = f"Found the id {listed}, which no joint has: is that the servo? Then give it the id {joint.id}."
            mistakes.append(Mistake(joint.label, "does not answer", mend if strangers else SILENT_MEND))
        elif servo.is_doubled:
            what = f"answers damaged or twice ({servo.damaged} times)"
            mend = f"Two servos may have the id {joint.id}: unplug all but one, and give it another id."
            mistakes.append(Mistake(joint.label, what, mend))
        elif model.number not in (servo.number, None):
            other = servo.model.name if servo.model else f"a model of number {servo.number}"
            mend = f"Set model, or plug in the {model.name}; ids may be exchanged."
            mistakes.append(Mistake(joint.label, f"is {other}, expected {model.name}", mend))
        else:
            stored[name] = _stored(bus, joint.id)
            mistakes += _mistakes(joint, stored[name])
    return stored, mistakes


def _stored(bus: Bus, servo: int) -> Stored:
    numbers, volt = bus.numbers((servo,), bus.map.stored)[servo], bus.map.registers["voltage"].unit
    return Stored(
        offset=numbers["offset"],
        limits=(numbers["min"], numbers["max"]),
        max_temperature=float(numbers["max_temperature"]),
        voltage_range=(numbers["min_voltage"] * volt, numbers["max_voltage"] * volt),
        mode=numbers["mode"],
        phase=numbers.get("phase", 0),
    )


def _mistakes(joint: ServoJoint, stored: Stored) -> list[Mistake]:
    """What a servo holds that does not fit its joint."""
    mistakes = []
    stated, mode = joint.settings.offset, joint.model.map.position_mode
    if stated is not None and stated != stored.offset:
        what = f"holds the homing offset {stored.offset}, expected {stated}"
        mend = f"Write it with armcal bus home CONFIG --offset {joint.name}={stated}, or correct offset."
        mistakes.append(Mistake(joint.label, what, mend))
    if stored.mode != mode:
        what = f"is in operating mode {stored.mode}, expected {mode} (positions)"
        mistakes.append(Mistake(joint.label, what, "Set its mode with the maker's program.", True))
    if stored.phase & SEVERAL_TURNS:
        what = "reports angles of several turns (bit 4 of its phase, register 18)"
        mistakes.append(Mistake(joint.label, what, "Clear that bit: armcal bus home does so."))
    low, high = joint.count_range
    if not joint.crosses_seam and (low + _ROUNDED < stored.limits[0] or high - _ROUNDED > stored.limits[1]):
        what = f"stops at counts {stored.limits[0]} and {stored.limits[1]}, and its range is {low} to {high}"
        ends = sorted(math.degrees(joint.angle(limit)) for limit in stored.limits)
        mend = f"Narrow range_deg of {joint.name} to [{ends[0]:.1f}, {ends[1]:.1f}], or widen the limits in the servo."
        mistakes.append(Mistake(joint.label, what, mend, True))
    return mistakes


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


class Health:
    """Judges readings, one after the other.

    Args:
        joints: whose servos they are of.
        stored: by joint, what their servos store.
        temperature: that is borne (deg C).
        load: share of full torque that is borne for a while.
    """

    def __init__(
        self, joints: Mapping[str, ServoJoint], stored: Mapping[str, Stored], temperature: float, load: float
    ) -> None:
        self._joints, self._stored, self._temperature, self._load = joints, stored, temperature, load
        self._loaded_since: dict[str, float] = {}
        self._reported: set[tuple[str, str]] = set()

    def check(self, readings: Mapping[str, ServoReading], now: float, powered: Collection[str] = ()) -> None:
        """Readings of a moment (s) at which some joints shall hold.

        Raises:
            DeviceUnwellError: a servo is too hot, or blocked; once for each.
            DeviceError: a servo reports an alarm, or has not its voltage.
            DeviceResetError: one does not hold.
        """
        for name, reading in readings.items():
            joint, stored = self._joints[name], self._stored[name]
            if reading.alarms:
                mends = " ".join(dict.fromkeys(_MENDS.get(word, "") for word in reading.alarms)).strip()
                text = f"{joint.label} reports {' and '.join(reading.alarms)}."
                raise DeviceError(text, hint=mends or "See the servo's manual.")
            limit = min(self._temperature, stored.max_temperature)
            if reading.temperature >= limit:
                self._report(joint, f"is at {reading.temperature:.0f} deg C, expected below {limit:.0f}", "overheating")
            low, high = stored.voltage_range
            if not low - _VOLTAGE_SLACK <= reading.voltage <= high + _VOLTAGE_SLACK:
                text = f"{joint.label} has {reading.voltage:.1f} V, expected {low:.1f} to {high:.1f}."
                raise DeviceError(text, hint=_MENDS["voltage"])
            if not (joint.model.knows_load and reading.has_torque and abs(reading.load) >= self._load):
                self._loaded_since.pop(name, None)
            elif now - self._loaded_since.setdefault(name, now) >= _BLOCKED_S:
                text = f"works with {100 * abs(reading.load):.0f} % of its torque for {_BLOCKED_S:g} s"
                self._report(joint, text, "load")
        limp = [self._joints[name].label for name in readings if name in powered and not readings[name].has_torque]
        if limp:
            text = f"{', '.join(limp)} lost torque by itself: started anew, or gave up under load."
            raise DeviceResetError(text, hint="Look at the supply and the plugs, and whether the joint is blocked.")

    def _report(self, joint: ServoJoint, what: str, fault: str) -> None:
        """The first time only: on its way to where it parks the arm is not stopped by it."""
        if (joint.name, fault) not in self._reported:
            self._reported.add((joint.name, fault))
            raise DeviceUnwellError(f"{joint.label} {what}.", hint=_MENDS[fault])


_SETTLES_S = 0.02


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
        self._settings = settings
        self._joints: dict[str, ServoJoint] = settings.chosen(joint_names)
        drivable(self._joints.values())
        self._bus = bus_of(settings, self._joints)
        self._servos = Servos(self._bus, self._joints)
        self._health: Health | None = None  # None: it is not open
        self._clock: Clock = RealClock()
        self._powered: set[str] = set()

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self._joints)

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        self.close()
        self._clock, s = clock, self._settings
        try:
            adapter = self._bus.open()
            stored = checked(self._bus, self._joints)
            health = Health(self._joints, stored, s.temperature, s.load_percent / 100)
            readings = self._servos.readings()
            health.check(readings, clock.now())
            for joint, reading in readings.items():  # one that has started anew may hold, and knows no limit
                if reading.has_torque:
                    self._limit_motion(self._joints[joint])
                    self._powered.add(joint)
            self._health = health
        except BaseException:
            self.close()
            raise
        models = ", ".join(sorted({joint.model.name for joint in self._joints.values()}))
        name = f"{len(self._joints)} servos ({models}) on {adapter or 'an adapter without an id'} at {s.baud} baud"
        parts: dict[str, Any] = {}
        for joint, servo in self._joints.items():
            parts[joint] = {"id": servo.id, "model": servo.model.name, "offset": stored[joint].offset}
            parts[joint] |= {"zero_count": servo.settings.zero_count, "direction": servo.settings.direction}
        return DeviceIdentity(name, identity_of(parts), None, adapter)

    @override
    def state(self) -> DeviceState:
        self._opened()
        readings = self._servos.readings()
        self._powered = {joint for joint, reading in readings.items() if reading.has_torque}
        goals = {joint: readings[joint].goal for joint in self._joints if joint in self._powered}
        return DeviceState({joint: self._joints[joint].angle(goal) for joint, goal in goals.items()})

    @override
    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        servos = {joint: self._servo(joint) for joint in angles}
        return {joint: servo.angle(servo.count(angles[joint])) for joint, servo in servos.items()}

    @override
    def measured(self) -> dict[str, float]:
        self._opened()
        readings = self._servos.readings()
        return {joint: servo.angle(servo.unwrapped(readings[joint].position)) for joint, servo in self._joints.items()}

    @override
    def energise(self, joint: str, angle: float) -> None:
        """Hold the joint where it stands, then turn it to the angle at the speed that is set: it does not jump."""
        self._opened()
        servo = self._servo(joint)
        goal = servo.count(angle)
        if joint not in self._powered:
            self._limit_motion(servo)
            here = servo.unwrapped(self._bus.number(servo.id, "position"))
            low, high = servo.count_range
            if not low <= here <= high:
                servo.count(servo.angle(here))  # refuses what is further out than a count
            self._servos.hold(servo, min(max(here, low), high))
            self._powered.add(joint)
        self._servos.command({joint: goal})
        self._clock.sleep(_SETTLES_S)

    @override
    def command(self, angles: Mapping[str, float]) -> None:
        self._opened()
        goals = {joint: self._servo(joint).count(angle) for joint, angle in angles.items()}
        limp = [joint for joint in goals if joint not in self._powered]
        if limp:
            text = f"found commands for {', '.join(limp)}, which hang free."
            raise DeviceRefusedError(text, where=self._bus.where, hint="Energise them first, one at a time.")
        self._servos.command(goals)

    @override
    def keep_alive(self) -> None:
        """Read all servos, and send once more what did not arrive.

        Raises:
            DeviceError: one is unwell, or blocked.
            DeviceResetError: one has lost its torque.
        """
        health, readings = self._opened(), self._servos.readings()
        health.check(readings, self._clock.now(), self._powered)
        self._servos.repeat(readings, self._powered)

    @override
    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        """Such servos have nobody who would look after them: they hold."""
        return False

    @override
    def release(self, joint: str) -> None:
        self._opened()
        servo = self._servo(joint)
        self._powered.discard(joint)
        self._servos.release(servo)

    @override
    def close(self) -> None:
        self._health, self._powered = None, set()
        self._bus.close()

    def _limit_motion(self, servo: ServoJoint) -> None:
        limits = self._settings.speed_deg_per_s, self._settings.acceleration_deg_per_s2
        self._servos.set_motion(servo, *map(math.radians, limits))

    def _servo(self, joint: str) -> ServoJoint:
        if joint not in self._joints:
            text = f"found the joint {joint!r}, expected one of {', '.join(self._joints)}."
            raise DeviceRefusedError(text, where=self._bus.where, hint="Name a joint of the arm.")
        return self._joints[joint]

    def _opened(self) -> Health:
        if self._health is None:
            raise DeviceLostError("the device is not open.", where=self._bus.where, hint="Open it.")
        return self._health


_AGAIN_S = 0.5


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
        self._joints: dict[str, ServoJoint] = {}
        self._clock: Clock = RealClock()
        self._next = 0.0
        self._bus: Bus | None = None

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        try:
            self._joints = self._settings.chosen(channels)
        except ValueError as fault:
            raise ConfigError(f"bench.joints: {fault}.", hint="Give each joint its servo.") from fault
        self._bus, self._clock, self._next = bus_of(self._settings, self._joints), clock, clock.now()
        try:
            self._bus.open()
            checked(self._bus, self._joints, moves=False)
            self._let_go(Servos(self._bus, self._joints))
        except DeviceLostError as fault:
            self.close()
            raise DeviceRefusedError(fault.message, where=fault.where, hint=fault.hint) from fault
        except BaseException:
            self.close()
            raise

    @override
    def samples(self) -> list[JointSample]:
        if self._bus is None or (now := self._clock.now()) < self._next:
            return []
        self._next = now + 1 / self._settings.rate_hz
        try:
            readings = Servos(self._bus, self._joints).readings()
        except DeviceError as fault:
            self._refused[fault.message] += 1
            self._next = now + _AGAIN_S
            try:
                self._bus.open()
            except (DeviceError, DeviceRefusedError) as again:
                self._refused[again.message] += 1
            return []
        angles = {name: joint.angle(joint.unwrapped(readings[name].position)) for name, joint in self._joints.items()}
        return [JointSample(now, None, angles)]

    @property
    @override
    def ended(self) -> bool:
        return self._bus is None

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return dict(self._refused)

    @override
    def close(self) -> None:
        if self._bus is not None:
            self._bus.close()
        self._bus = None

    def _let_go(self, servos: Servos) -> None:
        holding = [name for name, reading in servos.readings().items() if reading.has_torque]
        if holding and self._settings.torque == "refuse":
            text = f"{', '.join(holding)} hold, expected servos without torque, which can be guided by hand."
            hint = "Hold the arm, and give bench.joints: {torque: release}, which lets them go."
            raise DeviceRefusedError(text, hint=hint)
        for name in reversed(holding):
            servos.release(self._joints[name])
