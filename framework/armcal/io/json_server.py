"""Answers requests at a Unix socket, a JSON object a line and one back, in its caller's thread."""

import contextlib
import json
import selectors
import socket
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

from armcal.base.config_text import as_line
from armcal.errors import ArmcalError
from armcal.io.unix_socket import listening

MOST_CLIENTS = 64
"""For another one a client has to go: one with half a request first, then the one that asked last the longest ago."""
_LONGEST = 64 * 1024
_PATIENCE_S = 10.0
"""A client that does not read its replies, or does not end a request that it began, for so long is dropped."""

Answer = Callable[[dict[str, Any]], Mapping[str, Any]]
"""The reply to a request; an exception becomes a reply with ``ok`` false and an ``error``."""


class _Client:
    def __init__(self, connection: socket.socket) -> None:
        self.connection = connection
        self.received, self.replies = bytearray(), bytearray()
        self.ends = False
        self.heard = time.monotonic()


class JsonServer:
    """Serves a socket: only while ``serve`` is called is anyone answered.

    Args:
        path: of the socket.
        taken: the sentence for a socket that somebody serves.
        hint: which option to change.
        answer: to a request.

    Raises:
        InputError: see ``listening``.
    """

    def __init__(self, path: Path, taken: str, hint: str, answer: Answer) -> None:
        self._path, self._answer = path, answer
        self._clients: list[_Client] = []
        self._listener = listening(path, taken, hint, MOST_CLIENTS)
        self._selector = selectors.DefaultSelector()
        self.watch(self._listener.fileno(), self._accept)

    def watch(self, descriptor: int, readable: Callable[[], None]) -> None:
        """Call this too, within ``serve``, while a descriptor can be read."""
        self._selector.register(descriptor, selectors.EVENT_READ, readable)

    def serve(self, wait_s: float = 0.0) -> None:
        for key, _ in self._selector.select(wait_s):
            key.data()
        for client in [*self._clients]:
            if client.replies:
                self._write(client)
            stuck = (client.replies or client.received) and time.monotonic() - client.heard > _PATIENCE_S
            if stuck or (client.ends and not client.replies):
                self._drop(client)

    def close(self) -> None:
        for client in [*self._clients]:
            self._write(client)
            self._drop(client)
        self._selector.close()
        self._listener.close()
        with contextlib.suppress(OSError):
            self._path.unlink()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            connection, _ = self._listener.accept()
            connection.setblocking(False)
            client = _Client(connection)
            self._clients.append(client)
            self.watch(connection.fileno(), partial(self._read, client))
            if len(self._clients) > MOST_CLIENTS:
                self._drop(min(self._clients[:-1], key=lambda client: (not client.received, client.heard)))

    def _read(self, client: _Client) -> None:
        try:
            data = client.connection.recv(_LONGEST)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        *lines, rest = bytes(client.received + data).split(b"\n")
        if (lines or not client.received) and not client.replies:  # else it has to end its request, or read first
            client.heard = time.monotonic()
        client.received = bytearray(rest)
        for line in lines:
            client.replies += as_line(self._reply(line)).encode() + b"\n"
        if len(rest) > _LONGEST:
            client.replies += as_line(_refusal("The request has more than 64 KiB.")).encode() + b"\n"
        if not data or len(rest) > _LONGEST:
            client.ends = True
            with contextlib.suppress(KeyError, ValueError):
                self._selector.unregister(client.connection)

    def _write(self, client: _Client) -> None:
        try:
            sent = client.connection.send(client.replies)
        except BlockingIOError:
            return
        except OSError:
            client.replies.clear()
            client.ends = True
            return
        client.heard = time.monotonic()
        del client.replies[:sent]

    def _drop(self, client: _Client) -> None:
        self._clients.remove(client)
        with contextlib.suppress(KeyError, ValueError):
            self._selector.unregister(client.connection)
        client.connection.close()

    def _reply(self, line: bytes) -> Mapping[str, Any]:
        try:
            request = json.loads(line.decode("utf-8"))
        except (ValueError, RecursionError) as fault:
            return _refusal(f"The request is not JSON ({fault}).")
        if not isinstance(request, dict):
            return _refusal("The request is JSON, but no object.")
        try:
            return self._answer(request)
        except (ArmcalError, ValueError) as fault:
            return _refusal(str(fault))
        except Exception as fault:  # whoever asks, and whatever, cannot end what is served
            return _refusal(f"It failed ({type(fault).__name__}: {fault}).")


def _refusal(sentence: str) -> dict[str, Any]:
    return {"ok": False, "error": sentence}
