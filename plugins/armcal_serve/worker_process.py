"""A worker as the server sees it: a process at the other end of a socket, which may be busy, refuse, crash or hang."""

import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from armcal_serve.conversation import Ticket
from armcal_serve.order import Order
from armcal_serve.poller import Poller
from armcal_serve.worker import ABOUT_ITSELF, CHUNK, Message, Unpacker

# -P: a file of the working directory called like a library is not taken for it, as it is not by the command.
_COMMAND = (sys.executable, "-P", "-c", "import sys; from armcal_serve.worker import main; main(int(sys.argv[1]))")
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
