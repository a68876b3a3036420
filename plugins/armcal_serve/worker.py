"""The process that answers: it has one calibration, from its start to its end."""

from __future__ import annotations

import json
import os
import signal
import socket
import sys
import warnings
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

from armcal.errors import EXIT_FAULT, ArmcalError, CalibrationWarning

from armcal_serve.frames import ABOUT_ITSELF, Message, Unpacker

if TYPE_CHECKING:
    from armcal_serve.answering import Answerer

_NICENESS = 19
"""Requests come first."""
_CHUNK = 256 * 1024


def main(descriptor: int) -> None:
    """Take an order and a calibration from a socket, make it ready, and answer until the socket ends."""
    for number in (signal.SIGINT, signal.SIGTERM):  # the server ends its workers, after the last answer
        signal.signal(number, signal.SIG_IGN)
    warnings.simplefilter("ignore")
    link = socket.socket(fileno=descriptor)
    messages = _messages(link)
    try:
        order, data = json.loads(next(messages).content), next(messages).content
        answerer = _prepared(order, data, link)
        if answerer is None:
            return
        for message in messages:
            answer = answerer.answer(message.content, message.arrived)
            link.sendall(Message(message.ticket, answer).packed())
    except (OSError, StopIteration):
        return  # the server is gone


def _messages(link: socket.socket) -> Iterator[Message]:
    cutter = Unpacker()
    while data := link.recv(_CHUNK):
        yield from cutter.feed(data)


def _prepared(order: dict[str, Any], data: bytes, link: socket.socket) -> Answerer | None:
    """What answers, once the server was told that it is ready; None if it was told why not."""
    try:
        with ThreadPoolExecutor(1) as aside:
            answerer, notices = aside.submit(_made, order, data).result()
    except ArmcalError as fault:
        content: dict[str, Any] = {
            "fault": {
                "message": fault.message,
                "file": fault.where.file if fault.where else None,
                "line": fault.where.line if fault.where else None,
                "field": fault.where.field if fault.where else None,
                "hint": fault.hint,
                "exit_code": fault.exit_code,
            }
        }
        link.sendall(Message(ABOUT_ITSELF, json.dumps(content).encode()).packed())
        return None
    except Exception as fault:
        text = f"it cannot be used ({type(fault).__name__}: {fault})."
        content = {"fault": {"message": text, "file": order["shown"], "exit_code": EXIT_FAULT}}
        link.sendall(Message(ABOUT_ITSELF, json.dumps(content).encode()).packed())
        return None
    arms = {name: arm.shown for name, arm in answerer.arms.items()}
    content = {"ready": answerer.tag, "arms": arms, "notices": notices}
    link.sendall(Message(ABOUT_ITSELF, json.dumps(content).encode()).packed())
    return answerer


def _made(order: dict[str, Any], data: bytes) -> tuple[Answerer, list[str]]:
    """What answers, and what its users should know of the calibration.

    In a thread of its own: on Linux a niceness is a thread's, and could not be taken back from a whole process.
    """
    if order["gently"] and sys.platform == "linux":
        os.nice(_NICENESS)
    from armcal_serve.loaded import Order, loaded

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("ignore")
        warnings.simplefilter("always", CalibrationWarning)
        answerer = loaded(Order(**{name: value for name, value in order.items() if name != "gently"}), data)
    return answerer, [str(each.message) for each in caught]
