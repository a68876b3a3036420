"""The device ``servobus``: joints by name, on servos that share a serial bus and know where they stand."""

import math
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

from armcal.base.settings import Temperature
from armcal.calibration.calibration_file import identity_of
from armcal.devices.clock import Clock, RealClock
from armcal.devices.device import (
    DeviceIdentity,
    DeviceLostError,
    DeviceRefusedError,
    DeviceState,
    JointDevice,
    MeasuringDevice,
)
from armcal.devices.link import Link
from pydantic import Field
from typing_extensions import override

from armcal_servobus.bus import Bus
from armcal_servobus.checks import calibrated_parts, checked
from armcal_servobus.health import Health
from armcal_servobus.joints import ServoJoint, ServoJointsSettings, drivable, named
from armcal_servobus.servos import Servos

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
