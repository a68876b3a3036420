"""What servos have in their registers, by model; from the makers' tables. [FeetechSTS] [Dynamixel1] [Dynamixel2]"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import Literal

from armcal_servobus.bus import ProtocolName

ANY = -1
_RPM = 2 * math.pi / 60
_OLD_TURN = math.radians(300.0) * 1024 / 1023
"""Servos with potentiometers: count 0 is at 0 degrees and count 1023 at 300."""


@dataclass(frozen=True)
class Register:
    """Where a number stands, and how it is written.

    Attributes:
        address, size: of its first byte, and bytes.
    """

    address: int
    size: int = 1
    sign_bit: int | None = None  # its sign stands apart, in this bit; None: there is none, or it is a two's complement
    is_signed: bool = False  # it is a two's complement
    unit: float = 1.0  # what one count is, in SI (V, rad/s, deg C)

    def pack(self, value: int, order: Literal["little", "big"]) -> bytes:
        """As it is written.

        Raises:
            ValueError: it does not fit.
        """
        bits = self.sign_bit if self.sign_bit is not None else 8 * self.size - self.is_signed
        most = (1 << bits) - 1
        least = -most if self.sign_bit is not None else -(most + 1) if self.is_signed else 0
        if not least <= value <= most:
            raise ValueError(f"found {value}, expected {least} to {most}")
        if self.sign_bit is not None and value < 0:
            value = -value | 1 << self.sign_bit
        return value.to_bytes(self.size, order, signed=self.is_signed)

    def unpack(self, data: bytes, order: Literal["little", "big"]) -> int:
        value = int.from_bytes(data, order, signed=self.is_signed)
        if self.sign_bit is None:
            return value
        magnitude = value & ((1 << self.sign_bit) - 1)
        return -magnitude if value >> self.sign_bit & 1 else magnitude


@dataclass(frozen=True)
class ServoModel:
    """A kind of servo.

    Attributes:
        load: what its register of load counts: a share of its full torque, or a current (A).
    """

    name: str  # as configurations have it
    number: int  # as its register has it; ``ANY``: of all that are alike
    protocol: ProtocolName  # that it speaks
    registers: Mapping[str, Register]  # by armcal's name of what they hold; those that it lacks are not there
    polled: tuple[tuple[int, int], ...]  # the stretches (address, bytes) that hold what changes while it works
    alarms: Mapping[int, str]  # words, by the bit of its alarm
    counts: int = 4096  # so many are ``turn`` (rad)
    turn: float = 2 * math.pi
    wraps: bool = True  # whether its encoder goes on over the end of the turn, from the last count to zero
    position_mode: int = 0  # what the register of its operating mode holds while it goes to positions
    offset_limit: int = 0  # the largest magnitude of its homing offset; 0: it has none
    offset_sign: int = -1  # of the offset in the position that it reports: -1 if that is the encoder's less the offset
    teeth: int = 0  # of the spline on which its horn sits; 0: not known
    order: Literal["little", "big"] = "little"  # of the bytes of a number
    reads_together: bool = True  # whether it takes part when several are read at once
    load: Literal["share", "current"] = "share"

    @property
    def step(self) -> float:
        """The angle of a count (rad)."""
        return self.turn / self.counts

    def pack(self, name: str, value: int) -> bytes:
        return self.registers[name].pack(value, self.order)

    def unpack(self, name: str, data: bytes, at: int | None = None) -> int:
        register = self.registers[name]
        first = register.address - (register.address if at is None else at)
        return register.unpack(data[first : first + register.size], self.order)

    def holds(self, name: str, stretch: tuple[int, int]) -> bool:
        register, (first, count) = self.registers.get(name), stretch
        return register is not None and first <= register.address <= first + count - register.size

    def words(self, alarm: int) -> tuple[str, ...]:
        named = tuple(text for bit, text in self.alarms.items() if alarm & bit)
        unknown = alarm & ~sum(self.alarms)
        return (*named, f"alarm 0x{unknown:02x}") if unknown else named


_FEETECH_ALARMS = MappingProxyType(
    {0x01: "voltage", 0x02: "angle sensor", 0x04: "overheating", 0x08: "overcurrent", 0x20: "overload"}
)
_DYNAMIXEL1_ALARMS = MappingProxyType({0x01: "voltage", 0x02: "angle limit", 0x04: "overheating", 0x20: "overload"})
_DYNAMIXEL2_ALARMS = MappingProxyType(
    {0x01: "voltage", 0x02: "angle sensor", 0x04: "overheating", 0x08: "encoder", 0x10: "shock", 0x20: "overload"}
)


def _registers(rows: str, **units: float) -> MappingProxyType[str, Register]:
    """A table of names, addresses, bytes (1) and ``signed``, or ``sign`` and its bit; units apart where not 1."""
    registers: dict[str, Register] = {}
    for row in rows.split(","):
        name, address, *more = row.split()
        size, kind = int(more[0]) if more else 1, more[1] if len(more) > 1 else ""
        bit = int(kind[4:]) if kind.startswith("sign") and kind != "signed" else None
        registers[name] = Register(int(address), size, bit, kind == "signed", units.get(name, 1.0))
    return MappingProxyType(registers)


_TENTHS = {"voltage": 0.1, "min_voltage": 0.1, "max_voltage": 0.1, "load": 0.001}
_FEETECH = _registers(
    "firmware 0, model 3 2, id 5, baud 6, answers 8, min 9 2, max 11 2, max_temperature 13, max_voltage 14,"
    "min_voltage 15, torque 40, goal 42 2, time 44 2, speed 46 2, position 56 2, load 60 2 sign10, voltage 62,"
    "temperature 63, status 65, moving 66",
    **_TENTHS,
)
_STS = _FEETECH | _registers(
    "phase 18, offset 31 2 sign11, mode 33, acceleration 41, goal 42 2 sign15, speed 46 2 sign15, lock 55,"
    "position 56 2 sign15",
    acceleration=100 * 2 * math.pi / 4096,
    speed=2 * math.pi / 4096,
)
_X = _registers(
    "model 0 2, firmware 6, id 7, baud 8, mode 11, offset 20 4 signed, max_temperature 31, max_voltage 32 2,"
    "min_voltage 34 2, max 48 4, min 52 4, torque 64, answers 68, status 70, acceleration 108 4, speed 112 4,"
    "goal 116 4 signed, moving 122, load 126 2 signed, position 132 4 signed, voltage 144 2, temperature 146",
    acceleration=214.577 * _RPM / 60,
    speed=0.229 * _RPM,
    **_TENTHS,
)
_OLD = _registers(
    "model 0 2, firmware 2, id 3, baud 4, min 6 2, max 8 2, max_temperature 11, min_voltage 12, max_voltage 13,"
    "answers 16, torque 24, goal 30 2, speed 32 2, position 36 2, load 40 2 sign10, voltage 42, temperature 43,"
    "moving 46",
    speed=0.111 * _RPM,
    **_TENTHS,
)

_STS_SERVO = ServoModel(
    "sts3215", 777, "feetech", _STS, ((40, 27),), _FEETECH_ALARMS, offset_limit=2047, teeth=25
)  # fmt: skip
_SCS_SERVO = ServoModel(
    "scs0009",
    1284,
    "feetech",
    _FEETECH | _registers("lock 48"),
    ((40, 27),),
    _FEETECH_ALARMS,
    counts=1024,
    turn=_OLD_TURN,
    wraps=False,
    order="big",
    reads_together=False,
)
_X_SERVO = ServoModel(
    "xl430-w250",
    1060,
    "dynamixel2",
    _X,
    ((64, 7), (116, 31)),
    _DYNAMIXEL2_ALARMS,
    position_mode=3,
    offset_limit=1024,
    offset_sign=1,
)
_OLD_SERVO = ServoModel(
    "ax12",
    12,
    "dynamixel1",
    _OLD,
    ((24, 23),),
    _DYNAMIXEL1_ALARMS,
    counts=1024,
    turn=_OLD_TURN,
    wraps=False,
    reads_together=False,
)
_MX = replace(
    _OLD_SERVO,
    name="mx28",
    number=29,
    counts=4096,
    turn=2 * math.pi,
    wraps=True,
    registers=_OLD | _registers("speed 32 2, acceleration 73", speed=0.114 * _RPM, acceleration=math.radians(8.583)),
)


def _x(name: str, number: int, current: float = 0.0) -> ServoModel:
    """An X servo; with the current (A) of a count where it has that in the place of the load."""
    if not current:
        return replace(_X_SERVO, name=name, number=number)
    registers = _X | _registers("load 126 2 signed", load=current)
    return replace(_X_SERVO, name=name, number=number, registers=registers, load="current")


_ALL = (
    _STS_SERVO,
    replace(_STS_SERVO, name="sts3250", number=2825, teeth=0),
    replace(_STS_SERVO, name="sm8512bl", number=11272, teeth=0),
    replace(_STS_SERVO, name="sts", number=ANY, teeth=0),
    _SCS_SERVO,
    replace(_SCS_SERVO, name="scs", number=ANY),
    _X_SERVO,
    _x("xc430-w150", 1070),
    _x("xc430-w240", 1080),
    _x("xl330-m077", 1190, 0.001),
    _x("xl330-m288", 1200, 0.001),
    _x("xc330-t181", 1210, 0.001),
    _x("xc330-t288", 1220, 0.001),
    _x("xc330-m181", 1230, 0.001),
    _x("xc330-m288", 1240, 0.001),
    _x("xm430-w350", 1020, 0.00269),
    _x("xm430-w210", 1030, 0.00269),
    _x("xm540-w270", 1120, 0.00269),
    _x("xm540-w150", 1130, 0.00269),
    _x("mx28-2", 30),
    _x("mx64-2", 311, 0.00336),
    _x("mx106-2", 321, 0.00336),
    _OLD_SERVO,
    replace(_OLD_SERVO, name="ax18", number=18),
    _MX,
    replace(_MX, name="mx64", number=310),
    replace(_MX, name="mx106", number=320),
)
MODELS: Mapping[str, ServoModel] = MappingProxyType({model.name: model for model in _ALL})
BASE_MODELS: Mapping[ProtocolName, ServoModel] = MappingProxyType(
    {"feetech": _STS_SERVO, "dynamixel1": _OLD_SERVO, "dynamixel2": _X_SERVO}
)
"""By which servos of a model that is not known are read as far as all of a maker's are alike: model, firmware, id."""
BAUD_RATES: Mapping[ProtocolName, tuple[int, ...]] = MappingProxyType(
    {
        "feetech": (1_000_000, 500_000, 250_000, 128_000, 115_200, 76_800, 57_600, 38_400),
        "dynamixel1": (1_000_000, 57_600, 115_200, 200_000, 250_000, 400_000, 500_000, 19_200, 9_600),
        "dynamixel2": (57_600, 1_000_000, 115_200, 2_000_000, 3_000_000, 4_000_000, 9_600),
    }
)
"""Those that servos can be set to, the likeliest first."""


def model_of(protocol: ProtocolName, number: int) -> ServoModel | None:
    """The model with a number; None: not known."""
    numbered = (model for model in MODELS.values() if model.protocol == protocol and model.number == number)
    return next(numbered, None)
