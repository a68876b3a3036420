"""Clients at streams of bytes: lines in, lines out, with bounded memory for both; and standard input and output."""

import os
import time
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from armcal.errors import ArmcalError, DataError
from armcal.io.lines import LineCutter, write_ready
from typing_extensions import override

from armcal_serve.conversation import MOST_WAITING, Conversation
from armcal_serve.dispatcher import Dispatcher
from armcal_serve.poller import Poller
from armcal_serve.protocol import MAX_LINE_BYTES
from armcal_serve.transports.transport import Transport

CHUNK = 64 * 1024
MOST_UNREAD_BYTES = 1024**2  # A client that leaves so much unread is not listened to until it reads

Receive = Callable[[], bytes]
"""What has come: nothing where the stream has ended; raises BlockingIOError where nothing has come."""
Send = Callable[[memoryview], int]  # How many bytes were taken; 0, or BlockingIOError, where none can be


class StreamClient:
    """One client. It is read from as long as it reads its answers.

    Args:
        incoming, outgoing: descriptors, or what has one; the same for a socket.
        receive, send: raise another OSError when the client is gone.

    Attributes:
        ended: whether the client is gone.
        input_ended: whether all of its requests have come.
        progress_at: when it last read, or had nothing to read (monotonic seconds).
        has_sent_line: whether it ever sent a whole line.
    """

    def __init__(
        self, incoming: Any, outgoing: Any, receive: Receive, send: Send, poller: Poller, dispatcher: Dispatcher
    ) -> None:
        self.ended = False
        self.input_ended = False
        self.has_sent_line = False
        self.progress_at = self._last_line_at = time.monotonic()
        self._incoming, self._outgoing = incoming, outgoing
        self._receive, self._take = receive, send
        self._poller, self._dispatcher = poller, dispatcher
        self._cutter = LineCutter(MAX_LINE_BYTES)
        self._lines: deque[bytes | None] = deque()
        self._out = bytearray()
        self.conversation = Conversation(self._answer)
        self.arrange()

    @property
    def finished(self) -> bool:
        return not (self._lines or self.conversation.open or self._out)

    @property
    def stuck_s(self) -> float:
        return time.monotonic() - self.progress_at if self._out else 0.0

    @property
    def idle_s(self) -> float:
        """How long it has sent no whole request (s); 0 while answers to it are due."""
        return time.monotonic() - max(self._last_line_at, self.progress_at) if self.finished else 0.0

    @property
    def line_pending(self) -> bool:
        return not self.input_ended and (not self.has_sent_line or self._cutter.begun)

    def dismiss(self, why: ArmcalError) -> None:
        self._dispatcher.refuse(self.conversation, why)
        self.stop_reading()

    def stop_reading(self) -> None:
        self.input_ended = True
        self.arrange()

    def end(self) -> None:
        self.ended = True
        self.conversation.end()
        self._out.clear()
        self._lines.clear()
        for place in (self._incoming, self._outgoing):
            self._poller.watch(place)

    def arrange(self) -> None:
        """Hand on requests as far as there is room, and watch the descriptors that can go on."""
        while self._lines and self.conversation.open < MOST_WAITING and not self.ended:
            line = self._lines.popleft()
            if line is None:
                text = f"the request has more than {MAX_LINE_BYTES // 1024} KiB."
                self._dispatcher.refuse(self.conversation, DataError(text, hint="Ask for less at a time."))
            elif line.strip():
                self._dispatcher.ask(self.conversation, line)
        if self.ended:
            return
        full = bool(self._lines) or len(self._out) > MOST_UNREAD_BYTES
        read = None if full or self.input_ended else self._read
        write = self._write if self._out else None
        if self._incoming is self._outgoing:
            self._poller.watch(self._incoming, read, write)
        else:
            self._poller.watch(self._incoming, read)
            self._poller.watch(self._outgoing, None, write)

    def _read(self) -> None:
        try:
            data = self._receive()
        except BlockingIOError:
            return
        except OSError:
            self.end()
            return
        began = not self._cutter.begun
        lines = self._cutter.feed(data)
        if began or lines:
            self._last_line_at = time.monotonic()
        self.has_sent_line = self.has_sent_line or bool(lines)
        self._lines.extend(lines)
        if not data:
            self.input_ended = True
            if self._cutter.begun:
                self._lines.append(self._cutter.rest())
        self.arrange()

    def _answer(self, answer: bytes) -> None:
        if not self._out:
            self.progress_at = time.monotonic()
        self._out += answer
        self._out += b"\n"
        self._write()

    def _write(self) -> None:
        try:
            while self._out:
                with memoryview(self._out) as view:
                    sent = self._take(view)
                if not sent:
                    break
                del self._out[:sent]
                self.progress_at = time.monotonic()
        except BlockingIOError:
            pass
        except OSError:
            self.end()
            return
        self.arrange()


class StandardStreams(Transport):
    """Requests from one descriptor, answers to another, which stay the caller's; no waiting in either.

    They are shared with other programs (a terminal with its shell), so neither is made non-blocking.
    """

    name = "standard input"

    def __init__(self, incoming: int, outgoing: int, poller: Poller, dispatcher: Dispatcher) -> None:
        self._incoming, self._outgoing = incoming, outgoing
        self._poller, self._dispatcher = poller, dispatcher
        self._client: StreamClient | None = None

    @property
    @override
    def clients(self) -> int:
        return int(not self.ended)

    @property
    @override
    def ended(self) -> bool:
        client = self._client
        return client is not None and (client.ended or (client.input_ended and client.finished))

    @property
    @override
    def finished(self) -> bool:
        return self._client is None or self._client.ended or self._client.finished

    @override
    def open(self) -> None:
        receive, send = partial(os.read, self._incoming, CHUNK), partial(write_ready, self._outgoing)
        self._client = StreamClient(self._incoming, self._outgoing, receive, send, self._poller, self._dispatcher)

    @override
    def poll(self) -> None:
        """Nothing: a slow reader delays no other client here."""

    @override
    def stop_reading(self) -> None:
        if self._client is not None:
            self._client.stop_reading()

    @override
    def close(self) -> None:
        if self._client is not None and not self._client.ended:
            self._client.end()
