"""Simulated smart servos on a bus, as tests use them: bytes in, bytes out, and time that passes on request."""

from __future__ import annotations

import termios

import numpy as np

from tests.simulated_lines.bus_motor import BusMotor, BusMotorSettings
from tests.simulated_lines.bus_registers import TABLES
from tests.simulated_lines.bus_servo import BusServo
from tests.simulated_lines.servo_bus import ServoBus

BAUD = 1_000_000


class BusOnDesk:
    """Servos of a model with the ids 1, 2, ..., with nothing on their shafts but a stated torque (N m)."""

    def __init__(self, model: str, count: int = 2, motor: dict[str, float] | None = None, **options: object) -> None:
        self.now, self.baud, self.sent = 0.0, BAUD, []
        table, random = TABLES[model], np.random.default_rng(0)
        code = next(code for code, baud in table.bauds.items() if baud == BAUD)
        settings = BusMotorSettings.si(**{"encoder_noise_counts": 0.0, **(motor or {})})
        self.servos = [
            BusServo(table, BusMotor(settings, 0.0), table.counts / 2, 1, random, {"id": number + 1, "baud": code})
            for number in range(count)
        ]
        supply = (float(table.by_name["min_voltage"].initial + table.by_name["max_voltage"].initial) / 20, 0.0)
        options = {"supply": supply, **options}
        self.bus = ServoBus(
            lambda: self.now, self.servos, lambda data: self.sent.append(data), lambda: self.baud, random, **options
        )
        self.torque = 0.0

    def ask(self, packet: bytes) -> list[bytes]:
        """The packets that answer one."""
        self.sent.clear()
        self.bus.receive(packet)
        return list(self.sent)

    def run(self, seconds: float) -> None:
        """Let time pass."""
        end = self.now + seconds
        while self.now < end - 1e-9:
            self.now += 0.01
            for servo in self.servos:
                servo.motor.advance(0.01, self.torque)
            if self.bus.next_event() <= self.now:
                self.bus.run_timers()

    def write(self, number: int, name: str, value: int) -> list[bytes]:
        """By a packet to one servo."""
        register = self.servos[number - 1].table.by_name[name]
        return self.ask(self._packet(number, 3, register.address, register.encoded(value)))

    def read(self, number: int, name: str) -> int:
        """See ``write``; the value in the only answer."""
        register = self.servos[number - 1].table.by_name[name]
        (answer,) = self.ask(self._packet(number, 2, register.address, self._number(register.size)))
        begin, end = (9, -2) if self.bus.protocol == "dynamixel2" else (5, -1)
        return register.decoded(answer[begin:end])

    def _number(self, value: int) -> bytes:
        return value.to_bytes(2 if self.bus.protocol == "dynamixel2" else 1, "little")

    def _packet(self, number: int, code: int, address: int, data: bytes) -> bytes:
        return packet(self.bus.protocol, number, code, self._number(address) + data)


def packet(protocol: str, number: int, code: int, params: bytes) -> bytes:
    """An instruction, written down here once more and not taken from what is tested."""
    if protocol != "dynamixel2":
        body = bytes((number, len(params) + 2, code)) + params
        return b"\xff\xff" + body + bytes((255 - sum(body) % 256,))
    whole = b"\xff\xff\xfd\x00" + bytes((number, (len(params) + 3) % 256, (len(params) + 3) // 256, code)) + params
    remainder = int.from_bytes(whole, "big") << 16
    for bit in range(remainder.bit_length() - 1, 15, -1):
        if remainder >> bit & 1:
            remainder ^= 0x18005 << (bit - 16)
    return whole + remainder.to_bytes(2, "little")


def at_baud(port: int) -> None:
    """Set an open pty to the rate of the servos."""
    settings = termios.tcgetattr(port)
    settings[4] = settings[5] = termios.B1000000
    termios.tcsetattr(port, termios.TCSANOW, settings)
