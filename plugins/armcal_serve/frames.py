"""Messages between the server and its worker: a head of fixed size, and bytes."""

from __future__ import annotations

import struct
from dataclasses import dataclass

ABOUT_ITSELF = 0
"""The ticket of what is no request: orders to a worker, and what it says of itself."""
_HEAD = struct.Struct("!IQd")


@dataclass(frozen=True)
class Message:
    """One message.

    Attributes:
        ticket: of the request that it belongs to.
        content: the request, or its answer.
        arrived: when the request came (monotonic seconds).
    """

    ticket: int
    content: bytes
    arrived: float = 0.0

    def packed(self) -> bytes:
        """As it is sent."""
        return _HEAD.pack(len(self.content), self.ticket, self.arrived) + self.content


class Unpacker:
    """Cuts bytes into messages."""

    def __init__(self) -> None:
        self._open = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """The messages that are complete now."""
        self._open += data
        messages, at = [], 0
        while len(self._open) - at >= _HEAD.size:
            length, ticket, arrived = _HEAD.unpack_from(self._open, at)
            end = at + _HEAD.size + length
            if len(self._open) < end:
                break
            messages.append(Message(ticket, bytes(self._open[at + _HEAD.size : end]), arrived))
            at = end
        del self._open[:at]
        return messages
