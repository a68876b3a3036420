"""A Unix socket that many clients may connect to; only its owner may."""

import contextlib
import errno
import socket
import time
from functools import partial
from pathlib import Path

from armcal.errors import ArmcalError
from armcal.io.unix_socket import listening
from typing_extensions import override

from armcal_serve.dispatcher import Dispatcher
from armcal_serve.poller import Poller
from armcal_serve.protocol import as_bytes, refusal
from armcal_serve.transports.stream import CHUNK, StreamClient
from armcal_serve.transports.transport import Transport

MOST_CLIENTS = 64
PATIENCE_S = 10.0  # A client that leaves answers unread for so long is disconnected
FIRST_LINE_S = 30.0  # So long a client may take over its first line, and over any that it began
_LEAST_IDLE_S = 1.0  # A client that has sent no request for so long is disconnected where there is no place left
_PAUSE_S = 1.0  # No client is accepted for so long where the system has no descriptor and no client is idle
_NO_MORE = (errno.EMFILE, errno.ENFILE, errno.ENOBUFS, errno.ENOMEM)


class UnixSocket(Transport):
    """Serves a path.

    Raises:
        InputError: another server serves it, something else is there, or it cannot be made.
    """

    ended = False

    def __init__(
        self,
        path: Path,
        poller: Poller,
        dispatcher: Dispatcher,
        patience_s: float = PATIENCE_S,
        first_line_s: float = FIRST_LINE_S,
    ) -> None:
        self._path = path
        self._poller, self._dispatcher = poller, dispatcher
        self._patience_s, self._first_line_s = patience_s, first_line_s
        self._opens_at: float | None = None
        self._clients: dict[socket.socket, StreamClient] = {}
        self._listener = listening(path, "a server is running here.", "Give another --socket.", MOST_CLIENTS)

    @property
    @override
    def name(self) -> str:
        return f"socket {self._path}"

    @property
    @override
    def clients(self) -> int:
        return len(self._clients)

    @property
    @override
    def finished(self) -> bool:
        return all(client.ended or client.finished for client in self._clients.values())

    @override
    def open(self) -> None:
        self._opens_at = None
        self._poller.watch(self._listener, self._accept)

    def poll(self) -> None:
        """Disconnect clients that are done, that do not read, or that do not end a line."""
        if self._opens_at is not None and time.monotonic() >= self._opens_at:
            self.open()
        for connection, client in [*self._clients.items()]:
            if client.line_pending and client.idle_s > self._first_line_s:
                _dismiss(client, f"no whole request came within {self._first_line_s:g} s")
            if client.input_ended and client.finished and not client.ended:
                client.end()
            if client.stuck_s > self._patience_s:
                client.end()
            if client.ended:
                del self._clients[connection]
                connection.close()

    @override
    def stop_reading(self) -> None:
        self._opens_at = None
        self._poller.watch(self._listener)
        for client in self._clients.values():
            client.stop_reading()

    def close(self) -> None:
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
        except OSError as failed:
            if failed.errno in _NO_MORE and not self._make_room("the system has no place for another"):
                self._poller.watch(self._listener)
                self._opens_at = time.monotonic() + _PAUSE_S
            return
        connection.setblocking(False)
        if len(self._staying) >= MOST_CLIENTS and not self._make_room(f"{MOST_CLIENTS} clients are connected"):
            fault = ArmcalError(f"{MOST_CLIENTS} clients are connected.", hint="Close connections that are not used.")
            with contextlib.suppress(OSError):
                connection.send(as_bytes(refusal(None, fault)) + b"\n")
            connection.close()
            return
        receive, send = partial(connection.recv, CHUNK), connection.send
        client = StreamClient(connection, connection, receive, send, self._poller, self._dispatcher)
        self._clients[connection] = client

    @property
    def _staying(self) -> list[StreamClient]:
        return [client for client in self._clients.values() if not client.input_ended]

    def _make_room(self, why: str) -> bool:
        """Disconnect the client that has been idle for longest; False where none is idle."""
        idlest = max(self._staying, key=lambda client: client.idle_s, default=None)
        if idlest is None or idlest.idle_s < _LEAST_IDLE_S:
            return False
        _dismiss(idlest, f"{why}, and this one asked nothing for {idlest.idle_s:.0f} s")
        return True


def _dismiss(client: StreamClient, why: str) -> None:
    client.dismiss(ArmcalError(f"{why}: the connection is closed.", hint="Connect anew when there is a request."))
