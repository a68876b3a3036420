"""Standard input and output: one client, the program that started the server."""

from __future__ import annotations

import os

from armcal.io.standard_output import write_ready
from typing_extensions import override

from armcal_serve.dispatcher import Dispatcher
from armcal_serve.poller import Poller
from armcal_serve.transports.stream import CHUNK, StreamClient
from armcal_serve.transports.transport import Transport


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
        self._client = StreamClient(
            self._incoming, self._outgoing, self._receive, self._send, self._poller, self._dispatcher
        )

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

    def _receive(self) -> bytes | None:
        return os.read(self._incoming, CHUNK)

    def _send(self, data: memoryview) -> int:
        return write_ready(self._outgoing, data)
