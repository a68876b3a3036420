"""Smart servos on one half-duplex wire: who hears, who answers, and what arrives where several speak at once."""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import and_

import numpy as np

from tests.simulated_lines.bus_packets import (
    BROADCAST,
    BULK_READ,
    FRAMINGS,
    PING,
    READ,
    SYNC_READ,
    SYNC_WRITE,
    Instruction,
    ProtocolName,
)
from tests.simulated_lines.bus_servo import BAD_CRC, CHECKSUM, BusServo

LOOK_S = 0.1  # how often servos look at their temperature, voltage and load
_BAUD_TOLERANCE = 0.02
_LATEST_BYTES = 3  # by so much two servos that answer at once are apart at most


class ServoBus:
    """The wire.

    Attributes:
        servos: all, whether they are connected or not.
        absent: those whose plug is out.

    Args:
        clock: seconds.
        send: bytes to the host; once for every packet.
        baud: gives the host's.
        echo: the host hears what it says, as on adapters that join both directions.
        supply: voltage without load (V), and the resistance of supply and cables (ohm).
        random: for what happens by chance.
    """

    def __init__(
        self,
        clock: Callable[[], float],
        servos: Sequence[BusServo],
        send: Callable[[bytes], None],
        baud: Callable[[], int],
        random: np.random.Generator,
        *,
        echo: bool = False,
        supply: tuple[float, float] = (7.4, 0.1),
    ) -> None:
        self.servos, self.absent = tuple(servos), set[BusServo]()
        self._clock, self._send, self._baud, self._echo, self._random = clock, send, baud, echo, random
        self._supply = supply
        self._framing = FRAMINGS[self.servos[0].table.protocol]
        self._sizes = self._framing.address_size
        self._unfinished = b""
        self._looked = clock()
        for servo in servos:
            servo.volts = self.volts

    def volts(self) -> float:
        volts, ohms = self._supply
        return volts - ohms * sum(servo.amperes for servo in self.servos)

    @property
    def protocol(self) -> ProtocolName:
        return self.servos[0].table.protocol

    def split(self, data: bytes) -> tuple[list[bytes], bytes]:
        return self._framing.split(data)

    def boot(self) -> None:
        """Power-up: a brown-out, for servos that ran."""
        self._unfinished = b""
        for servo in self.servos:
            servo.power_cycle()

    def receive(self, data: bytes) -> None:
        if self._echo:
            self._send(data)
        if data.startswith(b"\xff\xff"):
            self._unfinished = b""  # what was cut off is forgotten in the pause before the next packet
        packets, self._unfinished = self._framing.split(self._unfinished + data)
        for packet in packets:
            self._take(self._framing.instruction(packet))

    def next_event(self) -> float:
        return self._looked + LOOK_S

    def run_timers(self) -> None:
        seconds, self._looked = self._clock() - self._looked, self._clock()
        for servo in self.servos:
            servo.pass_time(seconds)

    def _take(self, instruction: Instruction) -> None:
        baud = self._baud()
        plugged = [servo for servo in self.servos if servo not in self.absent]
        hearing = [servo for servo in plugged if abs(servo.baud - baud) <= _BAUD_TOLERANCE * servo.baud]
        servos = sorted(hearing, key=lambda servo: servo.id)
        if instruction.damaged:
            if self.protocol != "feetech":  # Dynamixels say that a packet came damaged
                error = BAD_CRC if self._sizes == 2 else CHECKSUM
                self._answer([(s, (s.status(error), b"")) for s in servos if s.id == instruction.servo])
        elif instruction.code == SYNC_WRITE:
            size, params = self._sizes, instruction.params
            address, count = (int.from_bytes(params[at : at + size], "little") for at in (0, size))
            blocks = params[2 * size :]
            for begin in range(0, len(blocks) - count, count + 1):
                for servo in (servo for servo in servos if servo.id == blocks[begin]):
                    servo.write(address, blocks[begin + 1 : begin + 1 + count])
        elif instruction.code == SYNC_READ or (instruction.code == BULK_READ and self._sizes == 2):
            for number, span in self._spans(instruction):
                self._answer([(s, s.execute(READ, span)) for s in servos if s.id == number])
        elif instruction.servo == BROADCAST:
            answers = [(servo, servo.execute(instruction.code, instruction.params)) for servo in servos]
            if instruction.code == PING and self._sizes == 2:  # one after another, in the order of their ids
                for number in sorted({servo.id for servo in servos}):
                    self._answer([(servo, answer) for servo, answer in answers if servo.id == number])
            elif instruction.code == PING:
                self._answer(answers)
        else:
            meant = [servo for servo in servos if servo.id == instruction.servo]
            answers = [(s, s.execute(instruction.code, instruction.params)) for s in meant]
            self._answer([pair for pair in answers if pair[0].answers(instruction.code)], instruction.servo)

    def _spans(self, instruction: Instruction) -> list[tuple[int, bytes]]:
        size, params = self._sizes, instruction.params
        if instruction.code == SYNC_READ:
            return [(number, params[: 2 * size]) for number in params[2 * size :]]
        step = 1 + 2 * size
        return [(params[at], params[at + 1 : at + step]) for at in range(0, len(params) - step + 1, step)]

    def _answer(self, answers: list[tuple[BusServo, tuple[int, bytes]]], number: int | None = None) -> None:
        """Send what those say that speak at the same time. ``number``: by which they were addressed."""
        packets = [
            self._framing.status(servo.id if number is None else number, error, data)
            for servo, (error, data) in answers
        ]
        if len(packets) == 1:
            self._send(packets[0])
        elif packets:
            # Several that speak at once pull the same line down: zeros win. They begin a little apart.
            delays = [int(self._random.integers(_LATEST_BYTES + 1)) for _ in packets]
            length = max(delay + len(packet) for delay, packet in zip(delays, packets, strict=True))
            lines = [
                (b"\xff" * delay + packet).ljust(length, b"\xff") for delay, packet in zip(delays, packets, strict=True)
            ]
            self._send(bytes(reduce(and_, column) for column in zip(*lines, strict=True)))
