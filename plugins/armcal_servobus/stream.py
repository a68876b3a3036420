"""The joint stream ``servobus``: the servos of an arm that is guided by hand say where they stand."""

from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceLostError, DeviceRefusedError
from armcal.devices.live import JointSample, JointStream
from armcal.errors import ConfigError
from pydantic import Field
from typing_extensions import override

from armcal_servobus.bus import Bus
from armcal_servobus.device import checked
from armcal_servobus.joints import ServoJoint, ServoJointsSettings, Servos, named

_AGAIN_S = 0.5


class ServoStreamSettings(ServoJointsSettings):
    """The bus and its joints, and how often they are read.

    ``torque`` is what becomes of servos that hold: they are a reason to refuse, or are let go one by one, so that a
    loaded arm drops.
    """

    rate_hz: Annotated[float, Field(gt=0, le=500)] = 50.0
    torque: Literal["refuse", "release"] = "refuse"


class ServoBusStream(JointStream):
    """Readings of all joints at a time. See ``armcal.devices.live.JointStream``."""

    Settings: ClassVar[type[ServoStreamSettings]] = ServoStreamSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "port": "ttyUSB0",
        "joints": {f"arm.q{i}": {"id": i, "model": "sts3215", "range_deg": [-150, 150]} for i in (1, 2, 3)},
    }

    def __init__(self, settings: ServoStreamSettings) -> None:
        self._settings = settings
        self._refused: Counter[str] = Counter()
        self._joints: dict[str, ServoJoint] = {}
        self._before: dict[str, float] = {}
        self._clock: Clock | None = None
        self._next = 0.0
        self._bus: Bus | None = None

    @override
    def open(self, clock: Clock, channels: tuple[str, ...]) -> None:
        self.close()
        try:
            self._joints = self._settings.chosen(channels)
        except ValueError as fault:
            raise ConfigError(f"bench.joints: {fault}.", hint="Give each joint its servo.") from fault
        self._bus, self._clock = Bus(self._settings, named(self._joints)), clock
        self._next, self._before = clock.now(), {}
        try:
            self._bus.open()
            checked(self._bus, self._joints, moves=False)
            self._let_go(self._bus)
        except DeviceLostError as fault:
            self.close()
            raise DeviceRefusedError(fault.message, where=fault.where, hint=fault.hint) from fault
        except BaseException:
            self.close()
            raise

    @override
    def samples(self) -> list[JointSample]:
        if self._bus is None or self._clock is None or (now := self._clock.now()) < self._next:
            return []
        self._next = now + 1 / self._settings.rate_hz
        try:
            positions = Servos(self._bus, self._joints).positions()
        except DeviceError as fault:
            self._refused[fault.message] += 1
            self._next = now + _AGAIN_S
            try:
                self._bus.open()
            except (DeviceError, DeviceRefusedError) as again:
                self._refused[again.message] += 1
            return []
        return [JointSample(now, None, {name: self._angle(name, count) for name, count in positions.items()})]

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

    def _angle(self, name: str, count: int) -> float:
        joint = self._joints[name]
        low, high = joint.count_range
        whole = joint.unwrapped(count, self._before.get(name) if high - low >= joint.model.counts else None)
        self._before[name] = whole
        return joint.angle(whole)

    def _let_go(self, bus: Bus) -> None:
        servos = Servos(bus, self._joints)
        holding = [name for name, reading in servos.readings().items() if reading.has_torque]
        if holding and self._settings.torque == "refuse":
            text = f"{', '.join(holding)} hold, expected servos without torque, which can be guided by hand."
            hint = "Hold the arm, and give bench.joints: {torque: release}, which lets them go."
            raise DeviceRefusedError(text, where=bus.where, hint=hint)
        for name in reversed(holding):
            servos.release(self._joints[name])
