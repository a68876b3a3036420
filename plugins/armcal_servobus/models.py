"""What servos have in their registers, by model; from the makers' tables. [FeetechSTS] [Dynamixel2]"""

import csv
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Literal, NamedTuple

ProtocolName = Literal["feetech", "dynamixel2"]
COUNTS = 4096  # Of a turn; the encoder goes on from the last one to zero
STEP = 2 * math.pi / COUNTS  # rad


@dataclass(frozen=True)
class Register:
    """Where a number stands (low byte first), and how it is written."""

    address: int  # of its first byte
    size: int = 1  # bytes
    sign_bit: int | None = None  # its sign stands apart, in this bit; None: there is none, or it is a two's complement
    is_signed: bool = False  # it is a two's complement
    unit: float = 1.0  # what one count is, in SI

    def pack(self, value: int) -> bytes:
        bits = self.sign_bit if self.sign_bit is not None else 8 * self.size - self.is_signed
        most = (1 << bits) - 1
        least = -most if self.sign_bit is not None else -(most + 1) if self.is_signed else 0
        if not least <= value <= most:
            raise ValueError(f"found {value}, expected {least} to {most}")
        if self.sign_bit is not None and value < 0:
            value = -value | 1 << self.sign_bit
        return value.to_bytes(self.size, "little", signed=self.is_signed)

    def unpack(self, data: bytes) -> int:
        value = int.from_bytes(data, "little", signed=self.is_signed)
        if self.sign_bit is None:
            return value
        magnitude = value & ((1 << self.sign_bit) - 1)
        return -magnitude if value >> self.sign_bit & 1 else magnitude


Stretch = tuple[int, int]  # Registers that follow each other: the address of the first one, and how many bytes


@dataclass(frozen=True)
class RegisterMap:
    """What all servos of a protocol have in common."""

    registers: Mapping[str, Register]  # by armcal's name of what they hold; those that servos lack are not there
    polled: tuple[Stretch, ...]  # what changes while they work
    stored: Stretch  # what their EEPROM keeps without power
    alarms: Mapping[int, str]  # words, by the bit of the alarm
    position_mode: int  # what the register of the operating mode holds while they go to positions
    offset_limit: int  # the largest magnitude of the homing offset
    offset_sign: int  # of the offset in the position that they report: -1 if that is the encoder's less the offset

    def numbers(self, stretch: Stretch, data: bytes) -> dict[str, int]:
        """What a stretch of registers holds, by name."""
        first, count = stretch
        there = {name: r for name, r in self.registers.items() if first <= r.address <= first + count - r.size}
        return {name: r.unpack(data[r.address - first : r.address - first + r.size]) for name, r in there.items()}

    def words(self, alarm: int) -> tuple[str, ...]:
        named = tuple(text for bit, text in self.alarms.items() if alarm & bit)
        unknown = alarm & ~sum(self.alarms)
        return (*named, f"alarm 0x{unknown:02x}") if unknown else named


class ServoModel(NamedTuple):
    name: str  # as configurations have it
    protocol: ProtocolName  # that it speaks
    number: int | None  # as its register has it; None: of all that are alike
    teeth: int = 0  # of the spline on which its horn sits; 0: not known
    knows_load: bool = True  # whether its register of load has a share of its full torque, and not a current

    @property
    def map(self) -> RegisterMap:
        return MAPS[self.protocol]


def _registers(protocol: ProtocolName) -> dict[str, Register]:
    """Those of ``registers.csv``; its units are in SI (V, rad/s, rad/s^2, shares of full torque)."""
    registers = {}
    with Path(__file__).with_name("registers.csv").open(encoding="utf-8") as file:
        for row in csv.DictReader(file):
            if row["protocol"] == protocol:
                bit = int(row["sign"].removeprefix("bit ")) if row["sign"].startswith("bit") else None
                place = int(row["address"]), int(row["bytes"])
                registers[row["name"]] = Register(*place, bit, row["sign"] == "complement", float(row["unit"]))
    return registers


_ALARMS = {0x01: "voltage", 0x02: "angle sensor", 0x04: "overheating", 0x20: "overload"}
MAPS: Mapping[ProtocolName, RegisterMap] = MappingProxyType(
    {
        "feetech": RegisterMap(
            _registers("feetech"),
            polled=((40, 27),),
            stored=(9, 25),
            alarms=_ALARMS | {0x08: "overcurrent"},
            position_mode=0,
            offset_limit=2047,
            offset_sign=-1,
        ),
        "dynamixel2": RegisterMap(
            _registers("dynamixel2"),
            polled=((64, 7), (116, 31)),
            stored=(11, 45),
            alarms=_ALARMS | {0x08: "encoder", 0x10: "shock"},
            position_mode=3,
            offset_limit=1024,
            offset_sign=1,
        ),
    }
)
_BY_LOAD = {"xl430-w250": 1060, "xc430-w150": 1070, "xc430-w240": 1080, "mx28-2": 30}
_BY_CURRENT = {
    **{"xl330-m077": 1190, "xl330-m288": 1200, "xc330-t181": 1210, "xc330-t288": 1220, "xc330-m181": 1230},
    **{"xc330-m288": 1240, "xm430-w350": 1020, "xm430-w210": 1030, "xm540-w270": 1120, "xm540-w150": 1130},
    **{"mx64-2": 311, "mx106-2": 321},
}
_ALL = (
    ServoModel("sts3215", "feetech", 777, teeth=25),
    ServoModel("sts3250", "feetech", 2825),
    ServoModel("sm8512bl", "feetech", 11272),
    ServoModel("sts", "feetech", None),
    *(ServoModel(name, "dynamixel2", number) for name, number in _BY_LOAD.items()),
    *(ServoModel(name, "dynamixel2", number, knows_load=False) for name, number in _BY_CURRENT.items()),
)
MODELS: Mapping[str, ServoModel] = MappingProxyType({model.name: model for model in _ALL})
# Those that servos can be set to, the likeliest first
BAUD_RATES: Mapping[ProtocolName, tuple[int, ...]] = MappingProxyType(
    {
        "feetech": (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400),
        "dynamixel2": (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 9_600),
    }
)
