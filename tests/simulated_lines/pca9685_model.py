"""The PCA9685 by its data sheet: what a master may write, and what then stands at the pins. [PCA9685]

Where the data sheet forbids something without saying what would follow, the model notes a violation and does what
would hurt most, so that a driver which breaks a rule is seen to break it.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import and_

CHANNELS, COUNTS = 16, 4096
MODE1, MODE2, SUBADR1, ALLCALLADR, LED0, LED_END = 0x00, 0x01, 0x02, 0x05, 0x06, 0x45
ALL_LED, PRE_SCALE, TEST = 0xFA, 0xFE, 0xFF
RESTART, EXTCLK, AI, SLEEP, SUB1, ALLCALL = 0x80, 0x40, 0x20, 0x10, 0x08, 0x01
INVRT, OCH, OUTDRV = 0x10, 0x08, 0x04
FULL = 0x10  # in ON_H: always on. In OFF_H: always off, which wins.
GENERAL_CALL, SOFTWARE_RESET = 0x00, 0x06
OSCILLATOR_STARTS_S = 0.0005
LEAST_PRESCALE = 3
_UNDEFINED_SHARE = 0.8
"""A pulse that was set before the oscillator ran is this much of what it should be: any value would do."""
_REMEMBERED = 100_000


@dataclass(frozen=True)
class PinCommit:
    """A change at a pin: pulse lengths (s) before and after; None where there are no pulses."""

    time: float
    channel: int
    before: float | None
    after: float | None


@dataclass(frozen=True)
class Violation:
    """A rule of the data sheet that was broken."""

    time: float
    rule: str


class Pca9685Model:
    """One chip.

    Attributes:
        address: the 7-bit address that its pins set.
        oscillator_hz: the true one; chips run at 23 to 27 MHz.
        commits: the latest changes at the pins.
        violations: rules that were broken, the latest.
        on_commit: called with every change at a pin.

    Args:
        clock: seconds, for the rules about time.
        external_hz: the clock at the EXTCLK pin; None where nothing is connected.
    """

    def __init__(
        self,
        clock: Callable[[], float],
        oscillator_hz: float = 25e6,
        address: int = 0x40,
        external_hz: float | None = None,
    ) -> None:
        self.address, self.oscillator_hz = address, oscillator_hz
        self.commits: deque[PinCommit] = deque(maxlen=_REMEMBERED)
        self.violations: deque[Violation] = deque(maxlen=_REMEMBERED)
        self.on_commit: Callable[[PinCommit], None] = lambda commit: None
        self._clock, self._external_hz = clock, external_hz
        self._pins: list[float | None] = [None] * CHANNELS
        self._set_defaults()

    def power_cycle(self) -> None:
        """A brown-out: everything as after power-up."""
        self._set_defaults()
        self._update_pins(range(CHANNELS))

    def transaction(self, address: int, data: bytes) -> int:
        """Write from START to STOP; the first byte of data is the register.

        Returns:
            how many bytes were acknowledged, the address counted: 0 nobody is there, ``len(data) + 1`` all of them.
        """
        if address == GENERAL_CALL:
            if data[:1] != bytes([SOFTWARE_RESET]):
                return 1
            if len(data) == 1:  # a further byte is not acknowledged, and nothing is reset
                self.power_cycle()
            return 2
        if not self._answers(address):
            return 0
        if self._write_channel(data):
            return len(data) + 1
        acknowledged = 1
        for index, byte in enumerate(data):
            if index == 0:
                if LED_END < byte < ALL_LED:
                    break  # reserved registers are not acknowledged
                self._register = byte
            else:
                self._write(self._register, byte)
                self._advance()
            acknowledged += 1
        self._stop()
        return acknowledged

    def read(self, address: int, register: int, count: int) -> bytes | None:
        """Read so many bytes from a register on; None where the address or the register is not acknowledged."""
        if not self._answers(address) or LED_END < register < ALL_LED:
            return None
        self._register = register
        data = bytearray()
        for _ in range(count):
            data.append(self._byte_in(self._register))
            self._advance()
        return bytes(data)

    def pulse_s(self, channel: int) -> float | None:
        """The length of a channel's pulses at the pin (s), by the true oscillator; None: there are none.

        A pin that is always high gives the whole period.
        """
        return self._pins[channel]

    @property
    def period_s(self) -> float:
        clock_hz = self._external_hz if self._mode1 & EXTCLK and self._external_hz else self.oscillator_hz
        return COUNTS * (self._prescale + 1) / clock_hz

    def _set_defaults(self) -> None:
        self._mode1, self._mode2, self._prescale, self._test = SLEEP | ALLCALL, OUTDRV, 0x1E, 0
        self._addresses = [0xE2, 0xE4, 0xE8, 0xE0]
        self._leds = bytearray((0, 0, 0, FULL) * CHANNELS)
        self._latched = bytearray(self._leds)
        self._written = [0] * CHANNELS
        self._running, self._stopped_while_running = [False] * CHANNELS, [False] * CHANNELS
        self._undefined = [False] * CHANNELS
        self._register = 0
        self._awake_since: float | None = None
        self._restart_at: float | None = None

    def _answers(self, address: int) -> bool:
        if address == self.address:
            return True
        enabled = (SUB1, SUB1 >> 1, SUB1 >> 2, ALLCALL)
        return any(self._mode1 & bit and address == own >> 1 for bit, own in zip(enabled, self._addresses, strict=True))

    def _advance(self) -> None:
        if not self._mode1 & AI:
            return
        if self._register in (LED_END, PRE_SCALE):
            self._register = MODE1
        elif self._register != TEST:
            self._register += 1

    def _byte_in(self, register: int) -> int:
        if register == MODE1:
            return self._mode1 | (RESTART if self._restart_set() else 0)
        if register == MODE2:
            return self._mode2
        if SUBADR1 <= register <= ALLCALLADR:
            return self._addresses[register - SUBADR1]
        if LED0 <= register <= LED_END:
            return self._leds[register - LED0]
        if register == PRE_SCALE:
            return self._prescale
        return self._test if register == TEST else 0

    def _write(self, register: int, byte: int) -> None:
        if register == MODE1:
            self._write_mode1(byte)
        elif register == MODE2:
            self._mode2 = byte & 0x1F
            self._update_pins(range(CHANNELS))
        elif SUBADR1 <= register <= ALLCALLADR:
            self._addresses[register - SUBADR1] = byte & 0xFE
        elif LED0 <= register <= LED_END:
            self._write_led(*divmod(register - LED0, 4), byte)
        elif ALL_LED <= register < PRE_SCALE:
            for channel in range(CHANNELS):
                self._write_led(channel, register - ALL_LED, byte)
        elif register == PRE_SCALE:
            if self._mode1 & SLEEP:
                self._prescale = max(LEAST_PRESCALE, byte)
            else:
                self._violated("PRE_SCALE was written while the oscillator runs: it is ignored")
        elif register == TEST:
            self._test = byte
            self._violated("the test register was written")

    def _write_channel(self, data: bytes) -> bool:
        """Do the commonest write by far at once, as ``transaction`` does byte by byte; whether it was one.

        It has all four bytes of one channel, to be taken on STOP.
        """
        if len(data) != 5 or not self._mode1 & AI or self._mode2 & OCH:
            return False
        if not LED0 <= data[0] < LED_END or (data[0] - LED0) % 4:
            return False
        channel = (data[0] - LED0) // 4
        self._leds[4 * channel : 4 * channel + 4] = bytes((data[1], data[2] & 0x1F, data[3], data[4] & 0x1F))
        self._register = MODE1 if channel == CHANNELS - 1 else data[0] + 4
        self._written[channel] = 0b1111
        self._stop()
        return True

    def _write_led(self, channel: int, part: int, byte: int) -> None:
        self._leds[4 * channel + part] = byte & (0x1F if part % 2 else 0xFF)
        self._written[channel] |= 1 << part
        if self._mode2 & OCH and self._written[channel] == 0b1111:
            self._latch([channel])

    def _write_mode1(self, byte: int) -> None:
        was_asleep = bool(self._mode1 & SLEEP)
        if byte & EXTCLK and not self._mode1 & EXTCLK and not (was_asleep and byte & SLEEP):
            self._violated("EXTCLK was set without SLEEP set before it and with it")
        kept = self._mode1 & EXTCLK  # sticky
        self._mode1 = kept | byte & ~RESTART & 0xFF
        if byte & SLEEP and not was_asleep:
            self._stopped_while_running = [
                running and not self._latched[4 * channel + 3] & FULL for channel, running in enumerate(self._running)
            ]
            self._running = [False] * CHANNELS
            # The bit is set when the refresh cycle ends, at the latest one period from now.
            self._restart_at = self._clock() + self.period_s if any(self._stopped_while_running) else None
            self._awake_since = None
        elif was_asleep and not byte & SLEEP:
            self._awake_since = self._clock()
            if not self._restart_set():
                self._restart_at = None  # woken within the cycle: nothing was stopped that could be restarted
        if byte & RESTART and not self._restart_set():
            self._violated("RESTART was written while it is not set: it does nothing")
        elif byte & RESTART and self._mode1 & SLEEP:
            self._violated("RESTART was written while the oscillator sleeps")
        elif byte & RESTART:
            if self._starting():
                self._violated("RESTART was written within 500 us of the oscillator's start")
            else:
                self._running = [a or b for a, b in zip(self._running, self._stopped_while_running, strict=True)]
            self._restart_at = None
        self._update_pins(range(CHANNELS))

    def _restart_set(self) -> bool:
        return self._restart_at is not None and self._clock() >= self._restart_at

    def _starting(self) -> bool:
        if self._awake_since is None or self._mode1 & EXTCLK:
            return False
        return self._clock() - self._awake_since < OSCILLATOR_STARTS_S * (1 - 1e-9)

    def _stop(self) -> None:
        if not self._mode2 & OCH:
            written = [channel for channel in range(CHANNELS) if self._written[channel]]
            if written:
                self._latch(written)

    def _latch(self, channels: list[int]) -> None:
        starting = self._starting()
        if starting:
            self._violated("PWM registers were written within 500 us of the oscillator's start")
        for channel in channels:
            place = slice(4 * channel, 4 * channel + 4)
            self._latched[place] = self._leds[place]
            self._written[channel] = 0
            self._running[channel], self._undefined[channel] = True, starting
            on, off = self._counts(channel)
            if on == off and not (self._latched[place][1] | self._latched[place][3]) & FULL:
                self._violated(f"ON and OFF of channel {channel} are equal")
        self._restart_at = None
        self._update_pins(channels)

    def _counts(self, channel: int) -> tuple[int, int]:
        on_low, on_high, off_low, off_high = self._latched[4 * channel : 4 * channel + 4]
        return on_low | (on_high & 0x0F) << 8, off_low | (off_high & 0x0F) << 8

    def _at_pin(self, channel: int) -> float | None:
        clocked = not self._mode1 & SLEEP and (not self._mode1 & EXTCLK or self._external_hz is not None)
        if not clocked or not self._running[channel]:
            return None
        on, off = self._counts(channel)
        high = (off - on) % COUNTS
        if self._latched[4 * channel + 3] & FULL:
            high = 0
        elif self._latched[4 * channel + 1] & FULL:
            high = COUNTS
        if self._mode2 & INVRT:
            high = COUNTS - high
        if high == 0:
            return None
        share = _UNDEFINED_SHARE if self._undefined[channel] else 1.0
        return share * high / COUNTS * self.period_s

    def _update_pins(self, channels: range | list[int]) -> None:
        for channel in channels:
            before, after = self._pins[channel], self._at_pin(channel)
            if before != after:
                self._pins[channel] = after
                commit = PinCommit(self._clock(), channel, before, after)
                self.commits.append(commit)
                self.on_commit(commit)

    def _violated(self, rule: str) -> None:
        self.violations.append(Violation(self._clock(), rule))


ADDRESS_ONLY = -1  # in the place of a byte's index: the address itself is not acknowledged


class BusStuckError(Exception):
    """SDA is held down: no transaction can begin."""


class I2cBus:
    """Chips on two wires; the clock gives seconds."""

    def __init__(self, clock: Callable[[], float], chips: Sequence[Pca9685Model]) -> None:
        self.chips = tuple(chips)
        self._clock = clock
        self._stuck_until = 0.0
        self._planned: list[tuple[int, int]] = []

    def plan_nack(self, byte: int, after: int = 0) -> None:
        """One write, after so many others, is not acknowledged at a byte of its data, or at ``ADDRESS_ONLY``."""
        self._planned.append((after, byte))

    def hold_down(self, seconds: float) -> None:
        self._stuck_until = self._clock() + seconds

    @property
    def stuck(self) -> bool:
        return self._clock() < self._stuck_until

    def write(self, address: int, data: bytes) -> int:
        """From START to STOP.

        Returns:
            how many bytes were acknowledged, the address counted; ``len(data) + 1`` is all.

        Raises:
            BusStuckError: see there.
        """
        self._require_free()
        refused = next((byte for after, byte in self._planned if after == 0), None)
        self._planned = [(after - 1, byte) for after, byte in self._planned if after > 0]
        if refused == ADDRESS_ONLY:
            return 0
        whole = data if refused is None else data[:refused]
        return max((chip.transaction(address, whole) for chip in self.chips), default=0)

    def read(self, address: int, register: int, count: int) -> bytes | None:
        """A register number written, and so many bytes read; None where nobody acknowledges.

        Raises:
            BusStuckError: see there.
        """
        self._require_free()
        answers = [data for chip in self.chips if (data := chip.read(address, register, count)) is not None]
        if not answers:
            return None
        # Several chips that answer at once pull the same line down: zeros win.
        return bytes(reduce(and_, column) for column in zip(*answers, strict=True))

    def _require_free(self) -> None:
        if self.stuck:
            raise BusStuckError
