"""The process that answers, with one calibration from its start to its end; and its messages to and from the server."""

from __future__ import annotations

import json
import os
import signal
import socket
import struct
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from armcal.errors import EXIT_FAULT, ArmcalError, CalibrationWarning, Location

from armcal_serve.order import Order

if TYPE_CHECKING:
    from armcal_serve.answering import Answerer

ABOUT_ITSELF = 0
"""The number of messages that are no request: orders to a worker, and its state."""
_HEAD = struct.Struct("!IQd")
_NICENESS = 19
"""Requests come first."""
CHUNK = 256 * 1024


@dataclass(frozen=True)
class Message:
    """One message: a head of fixed size, and bytes.

    Attributes:
        number: of the request that it belongs to, or ``ABOUT_ITSELF``.
        content: the request, or its answer.
        arrived: when the request came (monotonic seconds).
    """

    number: int
    content: bytes
    arrived: float = 0.0

    def packed(self) -> bytes:
        return _HEAD.pack(len(self.content), self.number, self.arrived) + self.content


class Unpacker:
    """Cuts bytes into messages."""

    def __init__(self) -> None:
        self._open = bytearray()

    def feed(self, data: bytes) -> list[Message]:
        """The messages that are complete now."""
        self._open += data
        messages, at = [], 0
        while len(self._open) - at >= _HEAD.size:
            length, number, arrived = _HEAD.unpack_from(self._open, at)
            end = at + _HEAD.size + length
            if len(self._open) < end:
                break
            messages.append(Message(number, bytes(self._open[at + _HEAD.size : end]), arrived))
            at = end
        del self._open[:at]
        return messages


def main(descriptor: int) -> None:
    """Take an order and a calibration from a socket, make it ready, and answer until the socket ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the server ends its workers, after the last answer
        signal.signal(number, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    link = socket.socket(fileno=descriptor)
    messages = _messages(link)
    try:
        order, data = Order(**json.loads(next(messages).content)), next(messages).content
        answerer, state = _prepared(order, data)
        link.sendall(Message(ABOUT_ITSELF, json.dumps(state).encode()).packed())
        if answerer is None:
            return
        for message in messages:
            answer = answerer.answer(message.content, message.arrived)
            link.sendall(Message(message.number, answer).packed())
    except (OSError, StopIteration):
        return  # the server is gone


def _messages(link: socket.socket) -> Iterator[Message]:
    cutter = Unpacker()
    while data := link.recv(CHUNK):
        yield from cutter.feed(data)


def _prepared(order: Order, data: bytes) -> tuple[Answerer | None, dict[str, Any]]:
    """The answerer, and that it is ready; None, and why there is none."""
    try:
        with ThreadPoolExecutor(1) as aside:
            answerer, notices = aside.submit(_made, order, data).result()
    except ArmcalError as fault:
        where = fault.where or Location()
        content: dict[str, Any] = {"message": fault.message, "file": where.file, "line": where.line}
        return None, {"fault": {**content, "field": where.field, "hint": fault.hint, "exit_code": fault.exit_code}}
    except Exception as fault:
        text = f"it cannot be used ({type(fault).__name__}: {fault})."
        return None, {"fault": {"message": text, "file": order.shown, "exit_code": EXIT_FAULT}}
    arms = {name: arm.shown for name, arm in answerer.arms.items()}
    return answerer, {"ready": answerer.tag, "arms": arms, "notices": notices}


def _made(order: Order, data: bytes) -> tuple[Answerer, list[str]]:
    """The answerer, and what its users should know of the calibration.

    In a thread of its own: on Linux a niceness is a thread's, and could not be taken back from a whole process.
    """
    if order.gently and sys.platform == "linux":
        os.nice(_NICENESS)
    from armcal_serve.loaded import loaded

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CalibrationWarning)
        answerer = loaded(order, data)
    return answerer, [str(notice.message) for notice in caught]
