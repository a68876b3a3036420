"""A Unix socket that many clients may connect to; only its owner may."""

from __future__ import annotations

import contextlib
import socket
from pathlib import Path

from armcal.errors import ArmcalError
from armcal.online.running.unix_socket import listening
from armcal.serve.dispatcher import Dispatcher
from armcal.serve.poller import Poller
from armcal.serve.protocol import as_bytes, refusal
from armcal.serve.transports.stream import CHUNK, StreamClient

MOST_CLIENTS = 64
PATIENCE_S = 10.0
"""A client that leaves answers unread for so long is let go of."""


class UnixSocket:
    """Serves a path.

    Raises:
        InputError: another server serves it, something else is there, or it cannot be made.
    """

    ended = False

    def __init__(self, path: Path, poller: Poller, dispatcher: Dispatcher, patience_s: float = PATIENCE_S) -> None:
        self._path = path
        self._poller, self._dispatcher, self._patience_s = poller, dispatcher, patience_s
        self._clients: dict[socket.socket, StreamClient] = {}
        self._listener = listening(path, "a server is running here.", "Give another --socket.", MOST_CLIENTS)

    @property
    def name(self) -> str:
        """See ``Transport``."""
        return f"socket {self._path}"

    @property
    def clients(self) -> int:
        """See ``Transport``."""
        return len(self._clients)

    @property
    def finished(self) -> bool:
        """See ``Transport``."""
        return all(client.ended or client.finished for client in self._clients.values())

    def open(self) -> None:
        """See ``Transport``."""
        self._poller.watch(self._listener, self._accept)

    def tend(self) -> None:
        """Let go of clients that are done, or that do not read."""
        for connection, client in [*self._clients.items()]:
            if client.heard_all and client.finished and not client.ended:
                client.end()
            if client.stuck_s > self._patience_s:
                client.end()
            if client.ended:
                del self._clients[connection]
                connection.close()

    def listen_no_more(self) -> None:
        """See ``Transport``."""
        self._poller.watch(self._listener)
        for client in self._clients.values():
            client.listen_no_more()

    def close(self) -> None:
        """Take the socket away."""
        for connection, client in self._clients.items():
            if not client.ended:
                client.end()
            connection.close()
        self._clients.clear()
        self._poller.watch(self._listener)
        with contextlib.suppress(OSError):
            self._path.unlink()
        self._listener.close()

    def _accept(self) -> None:
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        connection.setblocking(False)
        if len(self._clients) >= MOST_CLIENTS:
            _turn_away(connection)
            return
        client = StreamClient(
            connection,
            connection,
            lambda: _received(connection),
            lambda data: _sent(connection, data),
            self._poller,
            self._dispatcher,
        )
        self._clients[connection] = client


def _received(connection: socket.socket) -> bytes | None:
    try:
        return connection.recv(CHUNK)
    except BlockingIOError:
        return None


def _sent(connection: socket.socket, data: memoryview) -> int:
    try:
        return connection.send(data)
    except BlockingIOError:
        return 0


def _turn_away(connection: socket.socket) -> None:
    fault = ArmcalError(f"{MOST_CLIENTS} clients are connected.", hint="Close connections that are not used.")
    with contextlib.suppress(OSError):
        connection.send(as_bytes(refusal(None, fault)) + b"\n")
    connection.close()
