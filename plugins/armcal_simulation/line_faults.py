"""What goes wrong on a serial line: messages or bytes that are lost, doubled, swapped, damaged or torn apart."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

LineFault = Literal["drop", "duplicate", "reorder", "flip", "split"]
LINE_FAULTS: tuple[LineFault, ...] = ("drop", "duplicate", "reorder", "flip", "split")


@dataclass
class _Plan:
    kind: LineFault
    after: int
    count: int
    frames: bool


class FaultyStream:
    """One direction of a line.

    Args:
        delimiter: the byte that ends a message.
        random: chooses the bit that is damaged.
    """

    def __init__(self, delimiter: int, random: np.random.Generator) -> None:
        self._delimiter, self._random = delimiter, random
        self._plans: list[_Plan] = []
        self._unfinished = b""
        self._held = b""

    def plan(self, kind: LineFault, count: int, after: int = 0, *, frames: bool = True) -> None:
        """Do this to the next ``count`` messages, or bytes, once ``after`` of them have passed."""
        self._plans.append(_Plan(kind, after, count, frames))

    def clear(self) -> None:
        """No more faults; what was held back is lost."""
        self._plans.clear()
        self._unfinished = self._held = b""

    def through(self, data: bytes) -> list[bytes]:
        """What arrives, in pieces that arrive one after another."""
        if not self._plans and not self._unfinished and not self._held:
            return [data] if data else []
        delivered: list[bytes] = []
        for message in self._messages(data):
            delivered += self._one(message)
        if not self._plans and not self._held:
            delivered.append(self._unfinished)
            self._unfinished = b""
        return [piece for piece in delivered if piece]

    def _messages(self, data: bytes) -> list[bytes]:
        """Whole messages, or single bytes; what is not whole waits."""
        waiting, self._unfinished = self._unfinished + data, b""
        if self._plans and not self._plans[0].frames:
            return [bytes((byte,)) for byte in waiting]
        end = bytes((self._delimiter,))
        *whole, self._unfinished = waiting.split(end)
        return [message + end for message in whole]

    def _one(self, message: bytes) -> list[bytes]:
        late, self._held = self._held, b""
        if not self._plans:
            return [message, late]
        plan = self._plans[0]
        if plan.after > 0:
            plan.after -= 1
            return [message, late]
        plan.count -= 1
        if plan.count <= 0:
            self._plans.pop(0)
        return [*self._harmed(plan.kind, message), late]

    def _harmed(self, kind: LineFault, message: bytes) -> list[bytes]:
        if kind == "drop":
            return []
        if kind == "duplicate":
            return [message, message]
        if kind == "reorder":
            self._held = message
            return []
        if kind == "split":
            return [bytes((byte,)) for byte in message]
        place, bit = int(self._random.integers(len(message))), int(self._random.integers(8))
        harmed = bytearray(message)
        harmed[place] ^= 1 << bit
        return [bytes(harmed)]
