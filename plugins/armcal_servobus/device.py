"""The device ``servobus``: joints by name, on servos that share a serial bus and know where they stand."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, NoReturn

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
from pydantic import Field
from typing_extensions import override

from armcal_servobus.bus import SILENT_MEND, Bus
from armcal_servobus.finding import looked_at, present, read_number
from armcal_servobus.joints import ServoJoint, ServoJointsSettings, ServoReading, Servos, drivable, named
from armcal_servobus.models import ANY

_READINGS = 2
SEVERAL_TURNS = 0x10  # Of a Feetech servo's phase: it reports angles of several turns
_ROUNDED = 2  # Counts: limits in a servo may be so much narrower than a range that was rounded


@dataclass(frozen=True)
class Eeprom:
    """What a servo keeps without power; where a model lacks a register, what does no harm."""

    offset: int = 0  # its homing offset (counts)
    limits: tuple[int, int] = (0, 1 << 20)  # the counts between which it lets itself be driven
    max_temperature: float = 100.0  # deg C
    voltage_range: tuple[float, float] = (0.0, 60.0)  # V
    phase: int = 0  # of a Feetech servo: directions and units, as bits
    mode: int | None = None


@dataclass(frozen=True)
class Mistake:
    """Something about a servo that is not as configured, and what to do. ``of_motion``: only one that moves minds."""

    joint: str
    what: str
    mend: str
    of_motion: bool = False


def read_eeprom(bus: Bus, joint: ServoJoint) -> Eeprom:
    """A servo's.

    Raises:
        DeviceError: it does not answer well.
    """
    model = joint.model

    def number(name: str, instead: int) -> int:
        return read_number(bus, joint.id, model, name) if name in model.registers else instead

    volts = model.registers["voltage"].unit
    return Eeprom(
        offset=number("offset", 0),
        limits=(number("min", 0), number("max", 1 << 20)),
        max_temperature=float(number("max_temperature", 100)),
        voltage_range=(number("min_voltage", 0) * volts, number("max_voltage", 600) * volts),
        phase=number("phase", 0),
        mode=number("mode", model.position_mode),
    )


@dataclass(frozen=True)
class Examination:
    """A bus beside its configuration."""

    eeproms: Mapping[str, Eeprom]  # by joint, of servos that are the configured ones
    mistakes: tuple[Mistake, ...]  # all that is not as configured
    silent: tuple[str, ...]  # joints whose servos do not answer
    strangers: tuple[int, ...]  # ids that answer and that no joint has; looked for only where somebody is silent


def checked(bus: Bus, joints: Mapping[str, ServoJoint], *, moves: bool = True) -> Mapping[str, Eeprom]:
    """The EEPROMs of all joints' servos, by joint, where all is as configured.

    Args:
        moves: whether they are to move.

    Raises:
        DeviceLostError: no servo answers at all.
        DeviceRefusedError: something is not as configured; every fault is named.
    """
    examination = examined(bus, joints)
    if len(examination.silent) == len(joints) and not examination.strangers:
        raise DeviceLostError(f"no servo answers at {bus.settings.baud} baud.", where=bus.where, hint=SILENT_MEND)
    mistakes = [mistake for mistake in examination.mistakes if moves or not mistake.of_motion]
    if not mistakes:
        return examination.eeproms
    listed = "; ".join(f"{mistake.joint} {mistake.what}" for mistake in mistakes)
    hints = " ".join(dict.fromkeys(mistake.mend for mistake in mistakes))
    raise DeviceRefusedError(f"found servos that are not as configured: {listed}.", where=bus.where, hint=hints)


def examined(bus: Bus, joints: Mapping[str, ServoJoint]) -> Examination:
    """What all servos hold, and all that is not as configured."""
    silent = tuple(name for name, joint in joints.items() if not bus.ping(joint.id))
    known = {joint.id for joint in joints.values()}
    strangers = tuple(servo for servo in present(bus) if servo not in known) if silent else ()
    eeproms: dict[str, Eeprom] = {}
    mistakes: list[Mistake] = []
    for name, joint in joints.items():
        label = f"{name} (id {joint.id})"
        if name in silent:
            listed = ", ".join(map(str, strangers))
            mend = f"Found the id {listed}, which no joint has: is that the servo? Then give it the id {joint.id}."
            mistakes.append(Mistake(label, "does not answer", mend if strangers else SILENT_MEND))
        elif (mistake := _wrong_servo(bus, label, joint)) is not None:
            mistakes.append(mistake)
        else:
            eeproms[name] = read_eeprom(bus, joint)
            mistakes += _mistakes(label, joint, eeproms[name])
    return Examination(eeproms, tuple(mistakes), silent, strangers)


def _wrong_servo(bus: Bus, label: str, joint: ServoJoint) -> Mistake | None:
    servo = looked_at(bus, joint.id, _READINGS)
    if servo.is_doubled:
        what = f"answers damaged or twice ({servo.damaged} times)"
        mend = f"Two servos may have the id {joint.id}: unplug all but one, and give it another id."
        return Mistake(label, what, mend)
    if joint.model.number in (servo.number, ANY):
        return None
    other = servo.model.name if servo.model else f"a model of number {servo.number}"
    mend = f"Set model, or plug in the {joint.model.name}; ids may be exchanged."
    return Mistake(label, f"is {other}, expected {joint.model.name}", mend)


def _mistakes(label: str, joint: ServoJoint, eeprom: Eeprom) -> list[Mistake]:
    """What a servo holds that does not fit its joint."""
    mistakes = []
    stated, model = joint.settings.offset, joint.model
    if stated is not None and stated != eeprom.offset:
        what = f"holds the homing offset {eeprom.offset}, expected {stated}"
        mistakes.append(Mistake(label, what, "Write it with armcal bus home, or correct offset."))
    if eeprom.mode != model.position_mode:
        what = f"is in operating mode {eeprom.mode}, expected {model.position_mode} (positions)"
        mistakes.append(Mistake(label, what, "Set its mode with the maker's program.", True))
    if eeprom.phase & SEVERAL_TURNS:
        what = "reports angles of several turns (bit 4 of its phase, register 18)"
        mistakes.append(Mistake(label, what, "Clear that bit: armcal bus home does so."))
    low, high = joint.count_range
    if not joint.crosses_seam and (low + _ROUNDED < eeprom.limits[0] or high - _ROUNDED > eeprom.limits[1]):
        what = f"stops at counts {eeprom.limits[0]} and {eeprom.limits[1]}, and its range is {low} to {high}"
        ends = sorted(math.degrees(joint.angle(limit)) for limit in eeprom.limits)
        mend = f"Narrow range_deg of {joint.name} to [{ends[0]:.1f}, {ends[1]:.1f}], or widen the limits in the servo."
        mistakes.append(Mistake(label, what, mend, True))
    return mistakes


def calibrated_parts(joints: Mapping[str, ServoJoint], eeproms: Mapping[str, Eeprom]) -> dict[str, Any]:
    parts: dict[str, Any] = {}
    for name, joint in joints.items():
        parts[name] = {"id": joint.id, "model": joint.model.name, "offset": eeproms[name].offset}
        parts[name] |= {"zero_count": joint.settings.zero_count, "direction": joint.settings.direction}
    return parts


_BLOCKED_S = 1.0
_VOLTAGE_SLACK = 0.15
_MENDS: Mapping[str, str] = {
    "overload": "It is blocked or carries too much: take the load away, then switch its power off and on.",
    "overheating": "Let it cool, with torque off; then give it rests (bench.acquisition.heat) or less load.",
    "overcurrent": "It is blocked or its motor is damaged: turn the joint by hand with the power off.",
    "voltage": "Measure the supply at the last servo while the arm holds: thin cables and weak supplies sag.",
    "angle sensor": "Its encoder or its magnet is damaged: exchange the servo.",
    "encoder": "Its encoder is damaged: exchange the servo.",
    "shock": "Its supply failed or its wiring is damaged: look at both, then switch its power off and on.",
    "angle limit": "Its goal is beyond the limits in its EEPROM: widen them, or narrow the joint's range.",
}


class Health:
    """Judges readings, one after the other.

    Args:
        joints: whose servos they are of.
        temperature: that is borne (deg C).
        load: share of full torque that is borne for a while.
    """

    def __init__(self, joints: Mapping[str, ServoJoint], temperature: float, load: float) -> None:
        self._joints, self._temperature, self._load = joints, temperature, load
        self._eeprom: Mapping[str, Eeprom] = {}
        self._loaded_since: dict[str, float] = {}
        self._reported: set[tuple[str, str]] = set()

    def begin(self, eeprom: Mapping[str, Eeprom]) -> None:
        self._eeprom, self._loaded_since, self._reported = eeprom, {}, set()

    def check(self, readings: Mapping[str, ServoReading], now: float) -> None:
        """Readings of a moment (s).

        Raises:
            DeviceUnwellError: a servo is too hot, or blocked; once for each.
            DeviceError: a servo reports an alarm, or has not its voltage.
        """
        for name, reading in readings.items():
            if reading.alarms:
                mends = " ".join(dict.fromkeys(_MENDS.get(word, "") for word in reading.alarms)).strip()
                self._fail(name, f"reports {' and '.join(reading.alarms)}", mends or "See the servo's manual.")
            eeprom = self._eeprom.get(name, Eeprom())
            limit = min(self._temperature, eeprom.max_temperature)
            if reading.temperature >= limit:
                text = f"is at {reading.temperature:.0f} deg C, expected below {limit:.0f}"
                self._report(name, text, _MENDS["overheating"], "heat")
            low, high = eeprom.voltage_range
            if not low - _VOLTAGE_SLACK <= reading.voltage <= high + _VOLTAGE_SLACK:
                text = f"has {reading.voltage:.1f} V, expected {low:.1f} to {high:.1f}"
                self._fail(name, text, _MENDS["voltage"])
            is_loaded = self._joints[name].model.load == "share" and abs(reading.load) >= self._load
            if not (is_loaded and reading.has_torque):
                self._loaded_since.pop(name, None)
            elif now - self._loaded_since.setdefault(name, now) >= _BLOCKED_S:
                text = f"works with {100 * abs(reading.load):.0f} % of its torque for {_BLOCKED_S:g} s"
                self._report(name, text, "It is blocked or carries too much: free it, or take the load away.", "load")

    def check_powered(self, readings: Mapping[str, ServoReading], powered: Collection[str]) -> None:
        """That those hold which were made to.

        Raises:
            DeviceResetError: one does not.
        """
        limp = [name for name in readings if name in powered and not readings[name].has_torque]
        if limp:
            text = f"{', '.join(map(self._label, limp))} lost torque by itself: started anew, or gave up under load."
            raise DeviceResetError(text, hint="Look at the supply and the plugs, and whether the joint is blocked.")

    def _label(self, name: str) -> str:
        return f"{name} (id {self._joints[name].id})"

    def _report(self, name: str, what: str, mend: str, kind: str) -> None:
        """The first time only: on its way to where it parks the arm is not stopped by it."""
        if (name, kind) not in self._reported:
            self._reported.add((name, kind))
            raise DeviceUnwellError(f"{self._label(name)} {what}.", hint=mend)

    def _fail(self, name: str, what: str, mend: str) -> NoReturn:
        raise DeviceError(f"{self._label(name)} {what}.", hint=mend)


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
        self._bus = Bus(settings, named(self._joints))
        self._servos = Servos(self._bus, self._joints)
        self._health = Health(self._joints, settings.temperature, settings.load_percent / 100)
        self._clock: Clock = RealClock()
        self._is_open = False
        self._powered: set[str] = set()

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self._joints)

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        self.close()
        self._clock = clock
        try:
            adapter = self._bus.open()
            eeprom = checked(self._bus, self._joints)
            self._health.begin(eeprom)
            readings = self._servos.readings()
            self._health.check(readings, clock.now())
            self._powered = {joint for joint, reading in readings.items() if reading.has_torque}
            for joint in self._ordered_powered:  # one that has started anew may hold, and knows no limit
                self._limit_motion(self._joints[joint])
            self._is_open = True
        except BaseException:
            self.close()
            raise
        models = ", ".join(sorted({joint.model.name for joint in self._joints.values()}))
        s = self._settings
        name = f"{len(self._joints)} servos ({models}) on {adapter or 'an adapter without an id'} at {s.baud} baud"
        return DeviceIdentity(name, identity_of(calibrated_parts(self._joints, eeprom)), None, adapter)

    @override
    def state(self) -> DeviceState:
        self._check_open()
        readings = self._servos.readings()
        self._powered = {joint for joint, reading in readings.items() if reading.has_torque}
        return DeviceState({joint: self._joints[joint].angle(readings[joint].goal) for joint in self._ordered_powered})

    @override
    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        known = {joint: self._known(joint) for joint in angles}
        return {joint: servo.angle(servo.count(angles[joint])) for joint, servo in known.items()}

    @override
    def measured(self) -> dict[str, float]:
        self._check_open()
        readings = self._servos.readings()
        return {joint: servo.angle(servo.unwrapped(readings[joint].position)) for joint, servo in self._joints.items()}

    @override
    def energise(self, joint: str, angle: float) -> None:
        """Hold the joint where it stands, then turn it to the angle at the speed that is set: it does not jump."""
        self._check_open()
        servo = self._known(joint)
        goal = servo.count(angle)
        if joint not in self._powered:
            self._limit_motion(servo)
            here = servo.unwrapped(self._servos.reading(joint).position)
            low, high = servo.count_range
            if not low <= here <= high:
                servo.count(servo.angle(here))  # refuses what is further out than a count
            self._servos.hold(servo, min(max(here, low), high))
            self._powered.add(joint)
        self._servos.command({joint: goal})
        self._clock.sleep(_SETTLES_S)

    @override
    def command(self, angles: Mapping[str, float]) -> None:
        self._check_open()
        goals = {joint: self._known(joint).count(angle) for joint, angle in angles.items()}
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
        self._check_open()
        readings = self._servos.readings()
        self._health.check(readings, self._clock.now())
        self._health.check_powered(readings, self._powered)
        self._servos.repeat(readings, self._powered)

    @override
    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        """Such servos have nobody who would look after them: they hold."""
        return False

    @override
    def release(self, joint: str) -> None:
        self._check_open()
        servo = self._known(joint)
        self._powered.discard(joint)
        self._servos.release(servo)

    @override
    def close(self) -> None:
        self._is_open, self._powered = False, set()
        self._bus.close()

    @property
    def _ordered_powered(self) -> list[str]:
        return [joint for joint in self._joints if joint in self._powered]

    def _limit_motion(self, servo: ServoJoint) -> None:
        limits = self._settings.speed_deg_per_s, self._settings.acceleration_deg_per_s2
        self._servos.set_motion(servo, *map(math.radians, limits))

    def _known(self, joint: str) -> ServoJoint:
        if joint not in self._joints:
            text = f"found the joint {joint!r}, expected one of {', '.join(self._joints)}."
            raise DeviceRefusedError(text, where=self._bus.where, hint="Name a joint of the arm.")
        return self._joints[joint]

    def _check_open(self) -> None:
        if not self._is_open:
            raise DeviceLostError("the device is not open.", where=self._bus.where, hint="Open it.")
