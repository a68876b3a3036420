"""Servos at the far end of a pty, just enough of them to test packets, repeats and time-outs."""

from __future__ import annotations

import os
import pty
import select
import threading
import tty
from collections.abc import Callable
from dataclasses import dataclass, field

BROADCAST = 0xFE


@dataclass
class FakeServo:
    """Registers; what is written is kept, and a goal is reached at once while torque is on."""

    id: int
    memory: bytearray
    alarm: int = 0
    goal: tuple[int, int, int] = (42, 56, 40)
    """Where the goal, the position and the torque stand."""
    freezes: bool = False

    def write(self, address: int, data: bytes) -> None:
        self.memory[address : address + len(data)] = data
        goal, position, torque = self.goal
        size = 4 if goal == 116 else 2
        if self.memory[torque] and not self.freezes:
            self.memory[position : position + size] = self.memory[goal : goal + size]


def sts(servo: int, position: int = 2048, **registers: int) -> FakeServo:
    """An STS3215 as it comes from the maker."""
    memory = bytearray(96)
    memory[0:6] = bytes((3, 10, 0, 9, 3, servo))
    values = {8: (1, 1), 9: (0, 2), 11: (4095, 2), 13: (70, 1), 14: (140, 1), 15: (40, 1), 18: (12, 1), 62: (121, 1)}
    values |= {63: (31, 1), 55: (1, 1), 56: (position, 2), 42: (0, 2)}
    for address, (value, size) in values.items():
        memory[address : address + size] = value.to_bytes(size, "little")
    for name, value in registers.items():
        memory[int(name.removeprefix("r"))] = value
    return FakeServo(servo, memory)


def xl430(servo: int, position: int = 2048) -> FakeServo:
    """An XL430-W250."""
    memory = bytearray(160)
    values = {0: (1060, 2), 6: (45, 1), 7: (servo, 1), 11: (3, 1), 31: (72, 1), 32: (140, 2), 34: (60, 2)}
    values |= {48: (4095, 4), 68: (2, 1), 132: (position, 4), 144: (118, 2), 146: (33, 1)}
    for address, (value, size) in values.items():
        memory[address : address + size] = value.to_bytes(size, "little")
    return FakeServo(servo, memory, goal=(116, 132, 64))


def checked(body: bytes) -> bytes:
    return b"\xff\xff" + body + bytes((255 - sum(body) % 256,))


def crc(data: bytes) -> bytes:
    value = 0
    for byte in data:
        value ^= byte << 8
        for _ in range(8):
            value = ((value << 1) ^ 0x8005 if value & 0x8000 else value << 1) & 0xFFFF
    return value.to_bytes(2, "little")


@dataclass
class FakeBus:
    """``mangle`` gets each answer before it is sent and gives what is sent instead, in pieces."""

    servos: list[FakeServo]
    protocol: int = 0
    echoes: bool = False
    mangle: Callable[[bytes], bytes] = field(default=lambda answer: answer)
    instructions: list[tuple[int, int, bytes]] = field(default_factory=list)

    def __enter__(self) -> FakeBus:
        self.master, self.slave = pty.openpty()
        tty.setraw(self.slave)
        self.path = os.ttyname(self.slave)
        self.stop, self.wake = os.pipe()
        self.thread = threading.Thread(target=self._serve, daemon=True)
        self.thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        os.write(self.wake, b"x")
        self.thread.join()
        for descriptor in (self.master, self.slave, self.stop, self.wake):
            os.close(descriptor)

    def _serve(self) -> None:
        buffer = b""
        while True:
            ready, _, _ = select.select([self.master, self.stop], [], [])
            if self.stop in ready:
                return
            data = os.read(self.master, 4096)
            if self.echoes:
                os.write(self.master, data)
            buffer = self._instructions(buffer + data)

    def _instructions(self, buffer: bytes) -> bytes:
        head, length_at, size = (b"\xff\xff\xfd\x00", 5, 2) if self.protocol == 2 else (b"\xff\xff", 3, 1)
        while (at := buffer.find(head)) >= 0:
            length = int.from_bytes(buffer[at + length_at : at + length_at + size], "little")
            end = at + length_at + size + length
            if len(buffer) < max(end, at + length_at + size):
                return buffer[at:]
            packet, buffer = buffer[at:end], buffer[end:]
            if self.protocol == 2:
                if crc(packet[:-2]) == packet[-2:]:
                    body = packet[7:-2].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
                    self._do(packet[4], body[0], body[1:])
            elif checked(packet[2:-1]) == packet:
                self._do(packet[2], packet[4], packet[5:-1])
        return buffer

    def _do(self, servo: int, instruction: int, parameters: bytes) -> None:
        self.instructions.append((servo, instruction, parameters))
        width = 2 if self.protocol == 2 else 1
        first = int.from_bytes(parameters[:width], "little")
        count = int.from_bytes(parameters[width : 2 * width], "little")
        rest = parameters[2 * width :]
        if instruction == 0x83:
            for i in range(0, len(rest), count + 1):
                for chosen in self._with(rest[i]):
                    chosen.write(first, rest[i + 1 : i + 1 + count])
        elif instruction == 0x82:
            for wanted_id in rest:
                for chosen in self._with(wanted_id):
                    self._answer(chosen, bytes(chosen.memory[first : first + count]))
        else:
            for chosen in self.servos if servo == BROADCAST else self._with(servo):
                self._single(chosen, instruction, first, count, parameters[width:])

    def _single(self, servo: FakeServo, instruction: int, first: int, count: int, written: bytes) -> None:
        if instruction == 1:
            model = bytes(servo.memory[0:2]) + bytes(servo.memory[6:7])
            self._answer(servo, model if self.protocol == 2 else b"")
        elif instruction == 2:
            self._answer(servo, bytes(servo.memory[first : first + count]))
        elif instruction == 3:
            servo.write(first, written)
            self._answer(servo, b"")

    def _with(self, servo: int) -> list[FakeServo]:
        return [other for other in self.servos if other.id == servo]

    def _answer(self, servo: FakeServo, data: bytes) -> None:
        if self.protocol == 2:
            body = (bytes((0x55, servo.alarm)) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
            packet = b"\xff\xff\xfd\x00" + bytes((servo.id,)) + (len(body) + 2).to_bytes(2, "little") + body
            packet += crc(packet)
        else:
            packet = checked(bytes((servo.id, len(data) + 2, servo.alarm)) + data)
        if packet := self.mangle(packet):
            os.write(self.master, packet)
