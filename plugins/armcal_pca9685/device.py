"""PCA9685 boards: one chip on a link, set up, checked and set channel by channel [PCA9685]; and the device ``pca9685``,
joints by name on the channels and pulse tables of the servo file.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal, NamedTuple

from armcal.arm.servo import COUNTS, quantised
from armcal.base.settings import InputPath, Settings
from armcal.config.servo_file import CalibratedServo, ServoFile, digest, load_servo_file
from armcal.devices.clock import Clock
from armcal.devices.device import (
    DeviceError,
    DeviceIdentity,
    DeviceLostError,
    DeviceRefusedError,
    DeviceResetError,
    DeviceState,
    JointDevice,
    PulseDevice,
    require_energised,
)
from armcal.devices.link import GuardedLink, Link
from armcal.errors import Location
from armcal.plugins import refuse
from typing_extensions import override

MODE1, MODE2, LED0, ALL_LED, PRE_SCALE = 0x00, 0x01, 0x06, 0xFA, 0xFE
RESTART, EXTCLK, AUTO_INCREMENT, SLEEP, SUB_ADDRESSES, ALL_CALL = 0x80, 0x40, 0x20, 0x10, 0x0E, 0x01
OUTDRV = 0x04
FULL = 0x1000  # in ON: always high. In OFF: no pulses, which wins.
CHANNELS = 16
CHANNEL_BYTES = 4
OSCILLATOR_STARTS_S = 0.0005

_SPREAD = COUNTS // CHANNELS
ForeignPulses = Literal["refuse", "end"]

_AT_ONCE = 16  # bytes a read: small adapters have buffers of 32
_TRIES = 3


class Channel(NamedTuple):
    on: int
    off: int

    @property
    def counts(self) -> int | None:
        """The length of its pulses; None: it has none."""
        if (self.on | self.off) & FULL:
            return None
        return (self.off - self.on) % COUNTS or None

    def pack(self) -> bytes:
        return self.on.to_bytes(2, "little") + self.off.to_bytes(2, "little")

    @staticmethod
    def unpack(data: bytes) -> "Channel":
        """From four bytes that were read; bits that mean nothing are left out."""
        on, off = int.from_bytes(data[:2], "little"), int.from_bytes(data[2:4], "little")
        return Channel(on & 0x1FFF, off & 0x1FFF)


def channel_register(channel: int) -> int:
    return LED0 + CHANNEL_BYTES * channel


def pulse_on(channel: int, counts: int) -> Channel:
    """A pulse of so many counts (1 to 4095).

    Channels begin their pulses one after another over the period, so that servos do not all draw current at once; a
    pulse may go on over the end of the period.
    """
    on = channel * _SPREAD
    return Channel(on, (on + counts) % COUNTS)


def no_pulse(channel: int) -> Channel:
    return Channel(channel * _SPREAD, FULL)


class Chip:
    """The chip at an address, with the prescale that it must have."""

    def __init__(self, link: Link, clock: Clock, address: int, prescale: int) -> None:
        self._link, self._clock, self._address, self._prescale = link, clock, address, prescale
        self.where = Location(f"PCA9685 at 0x{address:02x}")

    def prepare(self, foreign_pulses: ForeignPulses) -> None:
        """Make it ready. Pulses that run with the right prescale go on untouched; none begins.

        Pulses of another set-up are a reason to refuse, or are ended (the servos let go).
        """
        mode1 = self._read(MODE1, 1)[0]
        if mode1 & EXTCLK:
            text = "it counts an external clock, expected its own oscillator."
            hint = "Switch the board's power off and on: nothing less undoes this."
            raise DeviceRefusedError(text, where=self.where, hint=hint)
        if not mode1 & AUTO_INCREMENT:  # without it neither several registers can be read, nor a channel be written
            self._write(MODE1, mode1 & (SLEEP | SUB_ADDRESSES | ALL_CALL) | AUTO_INCREMENT)
        is_running = not mode1 & (SLEEP | RESTART)
        prescale, mode2 = self._read(PRE_SCALE, 1)[0], self._read(MODE2, 1)[0]
        if not is_running or (prescale, mode2) != (self._prescale, OUTDRV):
            if is_running and foreign_pulses == "refuse" and (pulsed := self._pulsed()):
                text = f"found prescale {prescale} and MODE2 0x{mode2:02x} with pulses on channels"
                raise DeviceRefusedError(
                    f"{text} {', '.join(map(str, pulsed))}, expected prescale {self._prescale} and MODE2 "
                    f"0x{OUTDRV:02x}.",
                    where=self.where,
                    hint="Hold the arm, and switch the servos' power and the board off and on; or set foreign_pulses: "
                    "end, which lets go of the arm.",
                )
            self._set_up()
        elif mode1 & (SUB_ADDRESSES | ALL_CALL):
            self._write(MODE1, AUTO_INCREMENT)
        self._check_set_up()

    def check(self) -> None:
        """Find out whether it is still as ``prepare`` left it; if not, its power failed, probably."""
        for _ in range(_TRIES):
            mode1 = self._read(MODE1, 1)[0]
            if mode1 == AUTO_INCREMENT:
                return
        text = f"found MODE1 = 0x{mode1:02x}, expected 0x{AUTO_INCREMENT:02x}: it has forgotten its set-up."
        raise DeviceResetError(text, where=self.where, hint="Look at its supply: did the servos pull it down?")

    def channels(self, channels: Iterable[int]) -> dict[int, Channel]:
        """What stands in these channels' registers; read until two readings agree, for links without a checksum."""
        chosen = sorted(set(channels))
        before = self._channels(chosen)
        for _ in range(_TRIES):
            again = self._channels(chosen)
            if again == before:
                return again
            before = again
        raise DeviceError(
            "its channels read differently each time.", where=self.where, hint="Look at the bus: wires, pull-ups."
        )

    def set_channel(self, channel: int, pulse: Channel) -> None:
        """Write a channel's four registers in one transaction, and read them back; once more if they differ."""
        register, data = channel_register(channel), pulse.pack()
        for _ in range(2):
            self._link.write(self._address, bytes((register,)) + data)
            read_back = self._read(register, CHANNEL_BYTES)
            if read_back == data:
                return
        text = f"found {read_back.hex(' ')} in channel {channel}, expected {data.hex(' ')}, which was written twice."
        hint = "Look at the bus: wires, pull-ups, and whether another program uses it."
        raise DeviceError(text, where=self.where, hint=hint)

    def _channels(self, chosen: list[int]) -> dict[int, Channel]:
        channels: dict[int, Channel] = {}
        block = _AT_ONCE // CHANNEL_BYTES
        for first in sorted({channel // block * block for channel in chosen}):
            data = self._read(channel_register(first), _AT_ONCE)
            for channel in range(first, first + block):
                channels[channel] = Channel.unpack(data[CHANNEL_BYTES * (channel - first) :])
        return {channel: channels[channel] for channel in chosen}

    def _pulsed(self) -> list[int]:
        """Channels that have pulses: to set it up anew would let go of what they hold."""
        return [channel for channel, set_to in self.channels(range(CHANNELS)).items() if set_to.counts is not None]

    def _set_up(self) -> None:
        """Prescale and modes, while no channel has pulses."""
        self._link.write(self._address, bytes((ALL_LED,)) + Channel(0, FULL).pack())
        if self._pulsed():
            raise DeviceError("its pulses did not end as they should have.", where=self.where, hint="Try again.")
        self._write(MODE1, AUTO_INCREMENT | SLEEP)
        self._write(PRE_SCALE, self._prescale)
        self._write(MODE2, OUTDRV)
        self._write(MODE1, AUTO_INCREMENT)
        self._read(MODE1, 1)  # links may only queue what is written: once this is answered, it has arrived
        self._clock.sleep(OSCILLATOR_STARTS_S)
        if self._read(MODE1, 1)[0] & RESTART:
            self._write(MODE1, AUTO_INCREMENT | RESTART)

    def _check_set_up(self) -> None:
        expected = {MODE1: AUTO_INCREMENT, MODE2: OUTDRV, PRE_SCALE: self._prescale}
        read_back = {register: self._read(register, 1)[0] for register in expected}
        if read_back != expected:
            text = f"found {_listed(read_back)}, expected {_listed(expected)}: its set-up does not read back."
            hint = "Is it a PCA9685, and alone at this address? Look at the bus: wires, pull-ups."
            raise DeviceError(text, where=self.where, hint=hint)

    def _read(self, register: int, count: int) -> bytes:
        data = self._link.read(self._address, register, count)
        if len(data) != count:
            refuse(self._link.read, f"{len(data)} bytes", f"{count} bytes")
        return data

    def _write(self, register: int, value: int) -> None:
        self._link.write(self._address, bytes((register, value)))


def _listed(values: dict[int, int]) -> str:
    names = {MODE1: "MODE1", MODE2: "MODE2", PRE_SCALE: "PRE_SCALE"}
    return ", ".join(f"{names[register]} = 0x{value:02x}" for register, value in values.items())


_ANGLE_SLACK = 1e-9
_COUNT_SLACK = 1e-6


class Servo:
    """A servo as the servo file has it; what every step needs is computed once."""

    def __init__(self, calibrated: CalibratedServo, pulse_range: tuple[float, float]) -> None:
        self.calibrated, self.pulse_range = calibrated, pulse_range
        self.place = calibrated.address, calibrated.channel
        self.table, self.clock = calibrated.table, calibrated.clock
        # the smallest and the largest angle that its table has (rad); an end may be rounded over
        ends = self.table.angles[0], self.table.angles[-1]
        rounded = [float(quantised(end, self.table, self.clock)) for end in ends]
        self.span = min(ends[0], rounded[0]) - _ANGLE_SLACK, max(ends[1], rounded[1]) + _ANGLE_SLACK
        low, high = (pulse / self.clock.tick for pulse in pulse_range)
        self.allowed_counts = math.ceil(low - _COUNT_SLACK), math.floor(high + _COUNT_SLACK)

    def counts(self, angle: float) -> int:
        """Nearest to an angle (rad), within its pulse range."""
        fewest, most = self.allowed_counts
        return min(max(int(self.clock.counts(self.table.pulse(angle))), fewest), most)

    def angle(self, counts: int) -> float:
        return float(self.table.angle(counts * self.clock.tick))


class Pca9685Settings(Settings):
    """The servo file, and what becomes of pulses that another set-up has begun: ``refuse`` to open, or ``end`` them."""

    servos: InputPath
    foreign_pulses: ForeignPulses = "refuse"


@dataclass(frozen=True)
class _Guard:
    """What a board does by itself when its host falls silent: where to go, how fast, after which silence."""

    waypoints: tuple[Mapping[str, int], ...]  # counts by joint
    rate: float  # rad/s
    after_s: float  # s

    def hand_over(self, link: GuardedLink, servos: Mapping[str, Servo], standing: Mapping[str, int]) -> None:
        """To the board, for the joints that have pulses.

        A joint that a waypoint does not name stays where the waypoint before left it, or where it stands.
        """
        named = {joint for waypoint in self.waypoints for joint in waypoint}
        joints = [joint for joint in servos if joint in named and joint in standing]
        places = {joint: servos[joint].place for joint in joints}
        at = {joint: standing[joint] for joint in joints}
        ways = []
        for waypoint in self.waypoints:
            at = {joint: waypoint.get(joint, counts) for joint, counts in at.items()}
            ways.append({places[joint]: counts for joint, counts in at.items()})
        # no joint turns faster than the rate on any part of its table
        rates = {servos[j].place: self.rate * servos[j].table.least_slope / servos[j].clock.tick for j in joints}
        link.guard(ways if joints else [], rates, self.after_s)


class Pca9685Device(JointDevice, PulseDevice):
    """The device ``pca9685``; see ``JointDevice`` and ``PulseDevice`` in ``armcal.devices.device``."""

    Settings: ClassVar[type[Pca9685Settings]] = Pca9685Settings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"servos": str(Path(__file__).with_name("example_servos.yaml"))}

    def __init__(self, settings: Pca9685Settings, joint_names: Sequence[str], link: Link | None) -> None:
        if link is None:
            raise ValueError("found no link of the bench; give bench: {link: {type: NAME, ...}}")
        self._settings, self._link = settings, link
        self._file: ServoFile = load_servo_file(settings.servos)
        missing = [joint for joint in joint_names if joint not in self._file.servos]
        if missing:
            known = ", ".join(self._file.servos) or "none"
            raise ValueError(f"the servo file {settings.servos} has no servo {', '.join(missing)}; it has {known}")
        self._servos = {j: Servo(self._file.calibrated(j), self._file.servos[j].pulse_range) for j in joint_names}
        self._chips: dict[int, Chip] = {}
        self._counts: dict[str, int] = {}  # of joints with pulses, as last read or written
        self._guard = _Guard((), 0.0, 0.0)

    @property
    @override
    def joint_names(self) -> tuple[str, ...]:
        return tuple(self._servos)

    @override
    def open(self, clock: Clock) -> DeviceIdentity:
        identity = self._link.open(clock)
        try:
            for name in {self._file.servos[joint].board for joint in self._servos}:
                board_id = self._file.boards[name].id
                if board_id and identity.adapter and board_id != identity.adapter:
                    raise DeviceRefusedError(
                        f"found the adapter {identity.adapter!r}, expected {board_id!r}, with which the board {name!r} "
                        "was calibrated.",
                        where=Location(str(self._settings.servos), field=f"boards.{name}.id"),
                        hint="Connect the calibrated one, or calibrate this one: armcal servo.",
                    )
            self._guard = _Guard((), 0.0, 0.0)
            clocks = {servo.place[0]: servo.clock.prescale for servo in self._servos.values()}
            self._chips = {a: Chip(self._link, clock, a, prescale) for a, prescale in clocks.items()}
            for chip in self._chips.values():
                chip.prepare(self._settings.foreign_pulses)
            self._read_counts()
        except BaseException:
            self.close()
            raise
        boards = ", ".join(f"0x{address:02x}" for address in self._chips)
        name = f"PCA9685 {boards} on {identity.adapter or 'an adapter without an id'} ({identity.firmware})"
        calibrated = digest({joint: servo.calibrated for joint, servo in self._servos.items()})
        return DeviceIdentity(name, calibrated, identity.boots, identity.adapter)

    @override
    def state(self) -> DeviceState:
        self._read_counts()
        angles = {joint: self._servos[joint].angle(counts) for joint, counts in self._counts.items()}
        return DeviceState(angles, isinstance(self._link, GuardedLink) and self._link.took_over)

    @override
    def standing(self, angles: Mapping[str, float]) -> dict[str, float]:
        return {joint: self._servos[joint].angle(self._counts_of(joint, angle)) for joint, angle in angles.items()}

    @override
    def energise(self, joint: str, angle: float) -> None:
        self._begin(joint, self._counts_of(joint, angle))

    @override
    def command(self, angles: Mapping[str, float]) -> None:
        targets = {joint: self._counts_of(joint, angle) for joint, angle in angles.items()}
        require_energised(targets, self._counts, self._where)
        if isinstance(self._link, GuardedLink):
            places = {joint: self._servos[joint].place for joint in targets}
            self._link.set_counts({places[joint]: pulse_on(places[joint][1], n) for joint, n in targets.items()})
            self._counts.update(targets)
            return
        for joint, counts in targets.items():
            if counts != self._counts[joint]:
                self._set_counts(joint, counts)

    @override
    def keep_alive(self) -> None:
        """A guarded link reports, too, whether its other end drives by itself meanwhile."""
        self._check_open()
        if isinstance(self._link, GuardedLink):
            self._link.beat()
        for chip in self._chips.values():
            chip.check()

    @override
    def guard(self, waypoints: Sequence[Mapping[str, float]], rate: float, after_s: float) -> bool:
        """Joints without pulses stay without; a joint that gets them later is looked after too."""
        if not isinstance(self._link, GuardedLink):
            return False
        ways = tuple({joint: self._counts_of(joint, a) for joint, a in way.items()} for way in waypoints)
        self._guard = _Guard(ways, rate, after_s)
        self._guard.hand_over(self._link, self._servos, self._counts)
        return True

    @override
    def release(self, joint: str) -> None:
        address, channel = self._known(joint).place
        self._counts.pop(joint, None)
        self._renew_guard()  # before the pulses end: the board must not begin them anew
        self._chip(address).set_channel(channel, no_pulse(channel))

    @override
    def set_pulse(self, joint: str, pulse: float) -> float:
        servo = self._known(joint)
        counts = int(servo.clock.counts(pulse)) if math.isfinite(pulse) else 0
        fewest, most = servo.allowed_counts
        if not max(fewest, 1) <= counts <= min(most, COUNTS - 1):
            low, high = (1e6 * end for end in servo.pulse_range)
            raise DeviceRefusedError(
                f"found a pulse of {1e6 * pulse:g} us for {joint}, expected {low:g} to {high:g} us, the pulse "
                "range of its servo.",
                where=Location(str(self._settings.servos), field=f"servos.{joint}.pulse_range"),
                hint="Ask for a pulse in it, or state its range if its data sheet gives a wider one.",
            )
        self._begin(joint, counts)
        return counts * servo.clock.tick

    @override
    def close(self) -> None:
        self._chips, self._counts = {}, {}
        self._link.close()

    @property
    def _where(self) -> Location:
        return Location(str(self._settings.servos))

    def _counts_of(self, joint: str, angle: float) -> int:
        servo = self._known(joint)
        low, high = servo.span
        if not low <= angle <= high:  # no table has an angle that is not finite
            ends = " to ".join(f"{math.degrees(end):g}" for end in (servo.table.angles[0], servo.table.angles[-1]))
            raise DeviceRefusedError(
                f"found {math.degrees(angle):.3f} deg for {joint}, expected {ends} deg, its pulse table.",
                where=Location(str(self._settings.servos), field=f"servos.{joint}"),
                hint="Keep the plan within the table, or measure the servo further: armcal servo.",
            )
        return servo.counts(angle)

    def _known(self, joint: str) -> Servo:
        if joint not in self._servos:
            text = f"found the joint {joint!r}, expected one of {', '.join(self._servos)}."
            raise DeviceRefusedError(text, where=self._where, hint="Name a joint of the arm.")
        return self._servos[joint]

    def _begin(self, joint: str, counts: int) -> None:
        is_new = joint not in self._counts
        self._set_counts(joint, counts)
        if is_new:
            self._renew_guard()

    def _set_counts(self, joint: str, counts: int) -> None:
        address, channel = self._servos[joint].place
        self._chip(address).set_channel(channel, pulse_on(channel, counts))
        self._counts[joint] = counts

    def _read_counts(self) -> None:
        self._check_open()
        read: dict[str, int] = {}
        for address, chip in self._chips.items():
            own = {joint: servo.place[1] for joint, servo in self._servos.items() if servo.place[0] == address}
            channels = chip.channels(own.values())
            pulses = {joint: channels[channel].counts for joint, channel in own.items()}
            read |= {joint: counts for joint, counts in pulses.items() if counts is not None}
        self._counts = {joint: read[joint] for joint in self._servos if joint in read}

    def _renew_guard(self) -> None:
        if isinstance(self._link, GuardedLink) and self._guard.waypoints:
            self._guard.hand_over(self._link, self._servos, self._counts)

    def _chip(self, address: int) -> Chip:
        self._check_open()
        return self._chips[address]

    def _check_open(self) -> None:
        if not self._chips:
            raise DeviceLostError("the device is not open.", where=self._where, hint="Open it.")
