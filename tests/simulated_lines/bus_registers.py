"""What the makers publish of their bus servos: registers, units, baud rates. [FeetechSTS] [Dynamixel1] [Dynamixel2]

Registers have the same names in all tables where they mean the same.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

from tests.simulated_lines.bus_packets import ProtocolName

Area = Literal["eeprom", "ram", "read"]
_RPM = 2 * math.pi / 60


@dataclass(frozen=True)
class Register:
    """One value of a servo's table.

    ``sign``: the bit that says minus (``magnitude``), the whole in two's complement (``complement``), or none.
    ``low`` and ``high``: what it takes, where the maker says so and refuses others.
    """

    name: str
    address: int
    size: int
    initial: int = 0
    area: Area = "ram"
    sign: int | Literal["complement"] | None = None
    low: int | None = None
    high: int | None = None

    def encoded(self, value: int) -> bytes:
        if isinstance(self.sign, int):
            most = (1 << self.sign) - 1
            raw = min(abs(value), most) | ((1 << self.sign) if value < 0 else 0)
        elif self.sign == "complement":
            raw = value & ((1 << 8 * self.size) - 1)
        else:
            raw = min(max(value, 0), (1 << 8 * self.size) - 1)
        return raw.to_bytes(self.size, "little")

    def decoded(self, data: bytes) -> int:
        if self.sign == "complement":
            return int.from_bytes(data, "little", signed=True)
        raw = int.from_bytes(data, "little")
        if self.sign is None:
            return raw
        magnitude = raw & ((1 << self.sign) - 1)
        return -magnitude if raw >> self.sign & 1 else magnitude


@dataclass(frozen=True)
class ServoTable:
    """One model of servo."""

    name: str
    protocol: ProtocolName
    number: int
    registers: tuple[Register, ...]
    bauds: dict[int, int]  # by their codes
    count: float  # one step of the encoder (rad); ``counts``: how many it has
    counts: int
    speed_unit: float  # rad/s; ``acceleration_unit``: rad/s^2, None where it has no such register
    acceleration_unit: float | None
    volt: int = 10  # how many units of the voltage register make one volt

    @cached_property
    def by_name(self) -> dict[str, Register]:
        return {register.name: register for register in self.registers}

    @cached_property
    def size(self) -> int:
        return max(register.address + register.size for register in self.registers)

    def touched(self, address: int, count: int) -> list[Register]:
        return [r for r in self.registers if r.address < address + count and address < r.address + r.size]


def _registers(area: Area, rows: Iterable[tuple[str, int, int, int]], **more: object) -> list[Register]:
    return [Register(*row, area=area, **more) for row in rows]  # type: ignore[arg-type]


def _sts3215() -> ServoTable:
    """Feetech STS3215, memory table of the STS series; addresses from 3 to 70."""
    eeprom = [
        ("id", 5, 1, 1), ("baud", 6, 1, 0), ("return_delay", 7, 1, 0), ("return_level", 8, 1, 1),
        ("min_position", 9, 2, 0), ("max_position", 11, 2, 4095), ("temperature_limit", 13, 1, 70),
        ("max_voltage", 14, 1, 140), ("min_voltage", 15, 1, 40), ("max_torque", 16, 2, 1000), ("phase", 18, 1, 12),
        ("unloading", 19, 1, 44), ("led_alarm", 20, 1, 47), ("p_gain", 21, 1, 32), ("d_gain", 22, 1, 32),
        ("i_gain", 23, 1, 0), ("start_force", 24, 2, 16), ("cw_dead", 26, 1, 1), ("ccw_dead", 27, 1, 1),
        ("protection_current", 28, 2, 500), ("resolution", 30, 1, 1), ("mode", 33, 1, 0),
        ("protective_torque", 34, 1, 20), ("protection_time", 35, 1, 200), ("overload_torque", 36, 1, 80),
        ("speed_p_gain", 37, 1, 10), ("overcurrent_time", 38, 1, 200), ("speed_i_gain", 39, 1, 200),
    ]  # fmt: skip
    ram = [
        ("torque_enable", 40, 1, 0), ("acceleration", 41, 1, 0), ("goal_position", 42, 2, 0), ("goal_time", 44, 2, 0),
        ("goal_speed", 46, 2, 0), ("torque_limit", 48, 2, 1000), ("lock", 55, 1, 1),
    ]  # fmt: skip
    state = [
        ("firmware_major", 0, 1, 3), ("firmware_minor", 1, 1, 10), ("model", 3, 2, 777), ("voltage", 62, 1, 0),
        ("temperature", 63, 1, 0), ("registered", 64, 1, 0), ("status", 65, 1, 0), ("moving", 66, 1, 0),
    ]  # fmt: skip
    signed = [
        *_registers("eeprom", [("homing_offset", 31, 2, 0)], sign=11),
        *_registers("read", [("position", 56, 2, 0), ("speed", 58, 2, 0), ("current", 69, 2, 0)], sign=15),
        *_registers("read", [("load", 60, 2, 0)], sign=10),
    ]
    registers = (*_registers("eeprom", eeprom), *_registers("ram", ram), *_registers("read", state), *signed)
    bauds = dict(enumerate((1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400)))
    count = 2 * math.pi / 4096
    return ServoTable("sts3215", "feetech", 777, registers, bauds, count, 4096, count, 100 * count)


def _x_series(name: str, number: int, supply: tuple[int, int], current: bool) -> ServoTable:
    """Dynamixel X series, protocol 2: those with a current sensor (XL330), and without (XL430)."""
    eeprom = [
        ("id", 7, 1, 1, 0, 252), ("baud", 8, 1, 1, 0, 6), ("return_delay", 9, 1, 250, 0, 254),
        ("drive_mode", 10, 1, 0, 0, 13), ("mode", 11, 1, 3, 0, 16), ("secondary_id", 12, 1, 255, 0, 255),
        ("temperature_limit", 31, 1, 70 if current else 72, 0, 100), ("max_voltage", 32, 2, supply[1], 31, 160),
        ("min_voltage", 34, 2, supply[0], 31, 160), ("pwm_limit", 36, 2, 885, 0, 885),
        ("velocity_limit", 44, 4, 445 if current else 265, 0, 2047), ("max_position", 48, 4, 4095, 0, 4095),
        ("min_position", 52, 4, 0, 0, 4095), ("shutdown", 63, 1, 53 if current else 52, 0, 255),
        *([("current_limit", 38, 2, 1750, 0, 1750)] if current else []),
    ]  # fmt: skip
    ram = [
        ("torque_enable", 64, 1, 0, 0, 1), ("led", 65, 1, 0, 0, 1), ("return_level", 68, 1, 2, 0, 2),
        ("velocity_i", 76, 2, 1600, 0, 16383), ("velocity_p", 78, 2, 180, 0, 16383), ("d_gain", 80, 2, 0, 0, 16383),
        ("i_gain", 82, 2, 0, 0, 16383), ("p_gain", 84, 2, 400, 0, 16383), ("watchdog", 98, 1, 0, 0, 255),
        ("acceleration", 108, 4, 0, 0, 32767), ("goal_speed", 112, 4, 0, 0, 32767),
    ]  # fmt: skip
    state = [
        ("model", 0, 2, number), ("firmware_minor", 6, 1, 45), ("protocol", 13, 1, 2), ("registered", 69, 1, 0),
        ("status", 70, 1, 0), ("tick", 120, 2, 0), ("moving", 122, 1, 0), ("moving_status", 123, 1, 0),
        ("voltage", 144, 2, 0), ("temperature", 146, 1, 0),
    ]  # fmt: skip
    registers = (
        *(Register(n, a, s, i, "eeprom", None, low, high) for n, a, s, i, low, high in eeprom),
        Register("homing_offset", 20, 4, 0, "eeprom", "complement", -1044479, 1044479),
        *(Register(n, a, s, i, "ram", None, low, high) for n, a, s, i, low, high in ram),
        Register("goal_position", 116, 4, 0, "ram", "complement"),
        *_registers("read", state),
        *_registers("read", [("pwm", 124, 2, 0), ("load", 126, 2, 0), ("speed", 128, 4, 0)], sign="complement"),
        *_registers("read", [("position", 132, 4, 0), ("trajectory", 140, 4, 0)], sign="complement"),
    )
    bauds = dict(enumerate((9_600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000)))
    count, minute = 2 * math.pi / 4096, 60.0
    return ServoTable(name, "dynamixel2", number, registers, bauds, count, 4096, 0.229 * _RPM, 214.577 * _RPM / minute)


def _ax12() -> ServoTable:
    """Dynamixel AX-12, protocol 1: 1024 steps over 300 degrees, no homing offset."""
    eeprom = [
        ("id", 3, 1, 1, 0, 253), ("baud", 4, 1, 1, 0, 254), ("return_delay", 5, 1, 250, 0, 254),
        ("min_position", 6, 2, 0, 0, 1023), ("max_position", 8, 2, 1023, 0, 1023),
        ("temperature_limit", 11, 1, 70, 0, 150), ("min_voltage", 12, 1, 60, 50, 250),
        ("max_voltage", 13, 1, 140, 50, 250), ("max_torque", 14, 2, 1023, 0, 1023), ("return_level", 16, 1, 2, 0, 2),
        ("led_alarm", 17, 1, 36, 0, 127), ("shutdown", 18, 1, 36, 0, 127),
    ]  # fmt: skip
    ram = [
        ("torque_enable", 24, 1, 0, 0, 1), ("led", 25, 1, 0, 0, 1), ("cw_margin", 26, 1, 1, 0, 254),
        ("ccw_margin", 27, 1, 1, 0, 254), ("cw_slope", 28, 1, 32, 0, 254), ("ccw_slope", 29, 1, 32, 0, 254),
        ("goal_position", 30, 2, 0, 0, 1023), ("goal_speed", 32, 2, 0, 0, 1023), ("torque_limit", 34, 2, 1023, 0, 1023),
        ("lock", 47, 1, 0, 1, 1), ("punch", 48, 2, 32, 0, 1023),
    ]  # fmt: skip
    state = [
        ("model", 0, 2, 12), ("firmware_minor", 2, 1, 24), ("position", 36, 2, 0), ("voltage", 42, 1, 0),
        ("temperature", 43, 1, 0), ("registered", 44, 1, 0), ("moving", 46, 1, 0),
    ]  # fmt: skip
    registers = (
        *(Register(n, a, s, i, "eeprom", None, low, high) for n, a, s, i, low, high in eeprom),
        *(Register(n, a, s, i, "ram", None, low, high) for n, a, s, i, low, high in ram),
        *_registers("read", state),
        *_registers("read", [("speed", 38, 2, 0), ("load", 40, 2, 0)], sign=10),
    )
    bauds = {1: 1_000_000, 3: 500_000, 4: 400_000, 7: 250_000, 9: 200_000, 16: 115_200, 34: 57_600, 103: 19_200}
    return ServoTable("ax12", "dynamixel1", 12, registers, bauds, math.radians(300) / 1023, 1024, 0.111 * _RPM, None)


TABLES = {
    table.name: table
    for table in (
        _sts3215(),
        _x_series("xl330-m288", 1200, (35, 70), current=True),
        _x_series("xl330-m077", 1190, (35, 70), current=True),
        _x_series("xl430-w250", 1060, (60, 140), current=False),
        _ax12(),
    )
}
"""By model."""
