"""A worker as the server sees it: a process at the other end of a socket, which may be busy, refuse, crash or hang."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import time
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Any

from armcal.errors import EXIT_FAULT, ArmcalError, CalibrationWarning, Location

from armcal_serve.conversation import Ticket
from armcal_serve.order import Order
from armcal_serve.poller import Poller

if TYPE_CHECKING:
    from armcal_serve.answering import Answerer

ABOUT_ITSELF = 0  # The number of messages that are no request: orders to a worker, and its state
_HEAD = struct.Struct("!IQd")
_NICENESS = 19  # Requests come first
CHUNK = 256 * 1024


@dataclass(frozen=True)
class Message:
    """One message: a head of fixed size, and bytes."""

    number: int  # of the request that it belongs to, or ``ABOUT_ITSELF``
    content: bytes  # the request, or its answer
    arrived: float = 0.0  # when the request came (monotonic seconds)

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


# -P: a file of the working directory called like a library is not taken for it, as it is not by the command.
_COMMAND = (
    sys.executable,
    "-P",
    "-c",
    "import sys; from armcal_serve.worker_process import main; main(int(sys.argv[1]))",
)
_TO_END_S = 5.0


class WorkerProcess:
    """A process, started at once, with an order and a calibration's bytes.

    Attributes:
        ticket: its request.
        since: when it was started, or got that request (monotonic seconds).
        state: ``ready``, ``arms`` and ``notices``, or a ``fault``; None before.
        gone: whether it ended.
    """

    def __init__(self, order: Order, data: bytes, poller: Poller, on_message: Callable[[], None]) -> None:
        self.ticket: Ticket | None = None
        self.since = time.monotonic()
        self.state: dict[str, Any] | None = None
        self.gone = False
        self._on_message = on_message
        self._poller = poller
        self._cutter = Unpacker()
        self._out = bytearray()
        self._leaves_by: float | None = None
        self._link, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                [*_COMMAND, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # ours may carry answers
                pass_fds=(theirs.fileno(),),
                process_group=0,  # Ctrl-C is for the server; a new session would be beyond the reach of niceness
            )
        self._link.setblocking(False)
        self._send(Message(ABOUT_ITSELF, json.dumps(asdict(order)).encode()))
        self._send(Message(ABOUT_ITSELF, data))

    @property
    def pid(self) -> int:
        return self._process.pid

    def give(self, ticket: Ticket) -> None:
        self.since = time.monotonic()
        self.ticket = ticket
        self._send(Message(ticket.number, ticket.line, ticket.arrived))

    def leave(self) -> None:
        self._leaves_by = time.monotonic() + _TO_END_S
        self._close()

    def kill(self) -> None:
        self._process.kill()
        self._close()

    def ended(self) -> bool:
        if self._leaves_by is not None and time.monotonic() > self._leaves_by:
            self._process.kill()
        return self._process.poll() is not None

    def wait(self) -> None:
        try:
            self._process.wait(_TO_END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()

    def _send(self, message: Message) -> None:
        self._out += message.packed()
        self._write()

    def _write(self) -> None:
        if self.gone:
            return
        try:
            while self._out:
                del self._out[: self._link.send(self._out)]
        except BlockingIOError:
            pass
        except OSError:
            self._out.clear()  # reading finds that it ended
        self._poller.watch(self._link, self._read, self._write if self._out else None)

    def _read(self) -> None:
        try:
            data = self._link.recv(CHUNK)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        for message in self._cutter.feed(data):
            if message.number == ABOUT_ITSELF:
                self.state = json.loads(message.content)
            elif self.ticket is not None and self.ticket.number == message.number:
                ticket, self.ticket = self.ticket, None
                ticket.answered(message.content)
        if not data:
            self._close()
        self._on_message()

    def _close(self) -> None:
        if not self.gone:
            self.gone = True
            self._poller.watch(self._link)
            with contextlib.suppress(OSError):
                self._link.close()
