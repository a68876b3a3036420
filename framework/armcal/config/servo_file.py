"""The servo file: which joint hangs on which channel of which board, the boards' clocks, and the pulse tables.

One file is read by what drives the boards and by what calibrates the arm, so that both mean the same angles.
"""

import hashlib
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Self

from pydantic import Field, model_validator

from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.settings import Settings, UnitOf
from armcal.base.units import from_unit, to_unit
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config, word
from armcal.errors import ConfigError

ALL_CALL = 0x70
ADDRESSES = (0x40, 0x77)  # The lowest and the highest that a board's pins may set; 0x78 to 0x7f are reserved. [PCA9685]
CHANNELS = 16

Angles = Annotated[tuple[float, ...], UnitOf("angle")]
Pulses = Annotated[tuple[float, ...], UnitOf("time")]
PulseRange = Annotated[tuple[float, float], UnitOf("time")]
Oscillator = Annotated[float, Field(ge=20e6, le=30e6)]
Place = tuple[str | int, ...]


def usable_address(address: int) -> int:
    """The address itself, or a ValueError where no board can have it."""
    if not ADDRESSES[0] <= address <= ADDRESSES[1] or address == ALL_CALL:
        text = f"found the address 0x{address:02x}, expected 0x40 to 0x77"
        raise ValueError(f"{text} and not 0x70, to which all boards listen")
    return address


class BoardSettings(Settings):
    """A board: its I2C address, its measured oscillator, the rate of its pulses, and what tells it from others.

    ``id`` is the adapter's that the board was calibrated with; empty: not known yet.
    """

    address: int = 0x40
    oscillator_hz: Oscillator = 25e6
    rate_hz: Annotated[float, Field(ge=24, le=1526)] = 50.0
    id: str = ""

    @model_validator(mode="after")
    def _usable(self) -> Self:
        usable_address(self.address)
        PulseClock(self.oscillator_hz, self.prescale)
        return self

    @property
    def prescale(self) -> int:
        """The one nearest to the rate. [PCA9685]"""
        return PulseClock.prescale_for(self.oscillator_hz, self.rate_hz)

    @property
    def clock(self) -> PulseClock:
        return PulseClock(self.oscillator_hz, self.prescale)


class ServoSettings(Settings):
    """A servo: its board, its channel (0 to 15), and its pulse lengths at known angles.

    ``pulse_range`` is the shortest and the longest pulse that its data sheet allows. No other is written to the
    file or sent to the board.
    """

    board: str
    channel: Annotated[int, Field(ge=0, le=CHANNELS - 1)]
    angles: Angles
    pulses: Pulses
    pulse_range: PulseRange = (300e-6, 2800e-6)

    @model_validator(mode="after")
    def _usable(self) -> Self:
        PulseTable(self.angles, self.pulses)
        if not 0 < self.pulse_range[0] < self.pulse_range[1]:
            raise ValueError("the pulse_range does not rise from above zero: give [shortest, longest]")
        return self

    @property
    def table(self) -> PulseTable:
        return PulseTable(self.angles, self.pulses)


class CalibratedServo(Settings):
    """All of one servo and its board that a calibration hangs on."""

    board_id: str = ""
    address: int
    channel: Annotated[int, Field(ge=0, le=CHANNELS - 1)]
    oscillator_hz: Oscillator
    prescale: Annotated[int, Field(ge=3, le=255)]
    angles: Angles
    pulses: Pulses

    @model_validator(mode="after")
    def _usable(self) -> Self:
        usable_address(self.address)
        check_longest(self.table, self.clock)
        return self

    @property
    def table(self) -> PulseTable:
        return PulseTable(self.angles, self.pulses)

    @property
    def clock(self) -> PulseClock:
        return PulseClock(self.oscillator_hz, self.prescale)


class ServoFileSettings(Settings):
    """The file as it is written; ``ServoFile`` has it checked as a whole."""

    boards: dict[str, BoardSettings]
    servos: dict[str, ServoSettings]


class ServoFileError(ValueError):
    """Parts of a servo file do not fit each other; ``place`` is the part that is to be changed."""

    def __init__(self, message: str, place: Place) -> None:
        super().__init__(message)
        self.place = place


@dataclass(frozen=True)
class ServoFile:
    """Boards by name and servos by joint, that fit each other."""

    boards: Mapping[str, BoardSettings]
    servos: Mapping[str, ServoSettings]

    def __post_init__(self) -> None:
        addresses: dict[int, str] = {}
        for name, board in self.boards.items():
            first = addresses.setdefault(board.address, name)
            if first != name:
                text = f"found 0x{board.address:02x}, the address of the board {first!r} too, expected its own"
                raise ServoFileError(text, ("boards", name, "address"))
        channels: dict[tuple[str, int], str] = {}
        for joint, servo in self.servos.items():
            if servo.board not in self.boards:
                known = ", ".join(self.boards) or "none"
                text = f"found the board {str(servo.board)!r}, expected one of the boards: {known}"
                raise ServoFileError(text, ("servos", joint, "board"))
            first = channels.setdefault((servo.board, servo.channel), joint)
            if first != joint:
                text = f"found channel {servo.channel}, which {first!r} has, expected its own"
                raise ServoFileError(text, ("servos", joint, "channel"))
            clock, (low, high) = self.boards[servo.board].clock, servo.pulse_range
            try:
                if high - low < 2 * clock.tick:
                    text = f"found a pulse_range of {1e6 * (high - low):g} us, expected more than two counts of the"
                    raise ValueError(f"{text} board, {2e6 * clock.tick:.1f} us")
                if outside := [pulse for pulse in servo.pulses if not low <= pulse <= high]:
                    text = f"found a pulse of {1e6 * outside[0]:.1f} us, expected {1e6 * low:g} to {1e6 * high:g} us"
                    raise ValueError(f"{text}, the pulse_range of the servo")
                check_longest(servo.table, clock)
            except ValueError as fault:
                raise ServoFileError(str(fault), ("servos", joint, "pulses")) from fault

    def calibrated(self, joint: str) -> CalibratedServo:
        servo = self.servos[joint]
        board = self.boards[servo.board]
        return CalibratedServo.si(
            board_id=board.id,
            address=board.address,
            channel=servo.channel,
            oscillator_hz=board.oscillator_hz,
            prescale=board.prescale,
            angles=servo.angles,
            pulses=servo.pulses,
        )


def load_servo_file(path: str | Path) -> ServoFile:
    source = load_config(path)
    settings = validate(ServoFileSettings, source)
    try:
        return ServoFile(settings.boards, settings.servos)
    except ServoFileError as fault:
        where = source.where(fault.place)
        raise ConfigError(f"{fault}.", where=where, hint="Correct this line of the servo file.") from fault


def servo_file_text(file: ServoFile) -> str:
    lines = ["boards:"]
    for name, board in file.boards.items():
        fields = [("address", f"0x{board.address:02x}"), ("oscillator_hz", _number(board.oscillator_hz))]
        fields += [("rate_hz", _number(board.rate_hz)), ("id", json.dumps(board.id, ensure_ascii=False))]
        lines.append(_entry(name, fields))
    lines.append("servos:")
    for joint, servo in file.servos.items():
        fields = [("board", word(servo.board)), ("channel", str(servo.channel))]
        fields += [_in_unit("angles", servo.angles, "deg", "rad"), _in_unit("pulses", servo.pulses, "us", "s")]
        if "pulse_range" in servo.model_fields_set:
            fields.append(_in_unit("pulse_range", servo.pulse_range, "us", "s"))
        lines.append(_entry(joint, fields))
    return "\n".join(lines) + "\n"


def _entry(name: str, fields: Iterable[tuple[str, str]]) -> str:
    return f"  {word(name)}: {{{', '.join(f'{key}: {text}' for key, text in fields)}}}"


def digest(servos: Mapping[str, CalibratedServo]) -> str:
    """A fingerprint (hex) of all that a calibration hangs on; another number anywhere gives another one."""
    parts = {joint: servo.to_config() for joint, servo in servos.items()}
    return hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest()


def check_longest(table: PulseTable, clock: PulseClock) -> None:
    """Raise ValueError if a table has a pulse that its board cannot make."""
    longest, limit = max(table.pulses), clock.longest_pulse
    if longest > limit:
        raise ValueError(f"a pulse of {1e6 * longest:g} us is longer than the board's longest, {1e6 * limit:.0f} us")


def _in_unit(name: str, values: tuple[float, ...], unit: str, si: str) -> tuple[str, str]:
    """The numbers in a customary unit if every one can be read back from it to the last bit, in SI otherwise."""
    written = [_exact(value, unit) for value in values]
    stated = [number for number in written if number is not None]
    key, numbers = (f"{name}_{unit}", stated) if len(stated) == len(values) else (f"{name}_{si}", list(values))
    return key, f"[{', '.join(map(_number, numbers))}]"


def _number(value: float) -> str:
    """A number that the strict reader takes: with a point, also before an exponent."""
    mantissa, e, exponent = repr(float(value)).partition("e")
    return f"{mantissa}{'' if '.' in mantissa or not e else '.0'}{e}{exponent}"


def _exact(value: float, unit: str) -> float | None:
    """The shortest number in a unit that is read as exactly ``value`` (SI)."""
    near = to_unit(value, unit)
    tried = [round(near, digits) for digits in range(1, 13)]
    tried += [near, math.nextafter(near, math.inf), math.nextafter(near, -math.inf)]
    return next((number for number in tried if from_unit(number, unit) == value), None)
