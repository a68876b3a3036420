"""Whether servos are well: alarms, temperature, voltage, load, torque. Named with the joint, and what to do."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import NoReturn

from armcal.devices.faults import DeviceError, DeviceResetError

from armcal_servobus.checks import Eeprom
from armcal_servobus.joints import ServoJoint
from armcal_servobus.servos import ServoReading

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


@dataclass(frozen=True)
class HealthLimits:
    """What is borne: a temperature (deg C), and a share of full torque for a while."""

    temperature: float
    load: float


class Health:
    """Judges readings, one after the other."""

    def __init__(self, joints: Mapping[str, ServoJoint], limits: HealthLimits) -> None:
        self._joints, self._limits = joints, limits
        self._eeprom: Mapping[str, Eeprom] = {}
        self._loaded_since: dict[str, float] = {}

    def begin(self, eeprom: Mapping[str, Eeprom]) -> None:
        """With what the servos' EEPROMs hold."""
        self._eeprom, self._loaded_since = eeprom, {}

    def check(self, readings: Mapping[str, ServoReading], now: float) -> None:
        """Readings of a moment (s).

        Raises:
            DeviceError: a servo is unwell, too hot, without voltage or blocked.
        """
        for name, reading in readings.items():
            if reading.alarms:
                mends = " ".join(dict.fromkeys(_MENDS.get(word, "") for word in reading.alarms)).strip()
                self._fail(name, f"reports {' and '.join(reading.alarms)}", mends or "See the servo's manual.")
            eeprom = self._eeprom.get(name, Eeprom())
            if reading.temperature >= (limit := min(self._limits.temperature, eeprom.max_temperature)):
                self._fail(
                    name, f"is at {reading.temperature:.0f} deg C, expected below {limit:.0f}", _MENDS["overheating"]
                )
            low, high = eeprom.voltage_range
            if not low - _VOLTAGE_SLACK <= reading.voltage <= high + _VOLTAGE_SLACK:
                text = f"has {reading.voltage:.1f} V, expected {low:.1f} to {high:.1f}"
                self._fail(name, text, _MENDS["voltage"])
            self._check_load(name, reading, now)

    def check_powered(self, readings: Mapping[str, ServoReading], powered: Collection[str]) -> None:
        """That those hold which were made to.

        Raises:
            DeviceResetError: one does not.
        """
        limp = [name for name in readings if name in powered and not readings[name].has_torque]
        if limp:
            raise DeviceResetError(
                f"{', '.join(map(self._label, limp))} lost torque by itself: started anew, or gave up under load.",
                hint="Look at the supply and the plugs, and whether the joint is blocked.",
            )

    def _check_load(self, name: str, reading: ServoReading, now: float) -> None:
        is_loaded = self._joints[name].model.load == "share" and abs(reading.load) >= self._limits.load
        if not (is_loaded and reading.has_torque):
            self._loaded_since.pop(name, None)
        elif now - self._loaded_since.setdefault(name, now) >= _BLOCKED_S:
            text = f"works with {100 * abs(reading.load):.0f} % of its torque for {_BLOCKED_S:g} s"
            self._fail(name, text, "It is blocked or carries too much: free it, or take the load away.")

    def _label(self, name: str) -> str:
        return f"{name} (id {self._joints[name].id})"

    def _fail(self, name: str, what: str, mend: str) -> NoReturn:
        raise DeviceError(f"{self._label(name)} {what}.", hint=mend)
