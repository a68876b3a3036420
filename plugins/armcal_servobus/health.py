"""Whether servos are well: alarms, temperature, voltage, load, torque. Named with the joint, and what to do."""

from collections.abc import Collection, Mapping
from typing import NoReturn

from armcal.devices.device import DeviceError, DeviceResetError, DeviceUnwellError

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
