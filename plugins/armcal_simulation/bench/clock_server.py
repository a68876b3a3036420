"""The socket by which clients of a simulated bench let its time pass: a JSON object a line, and one back."""

import contextlib
import json
import select
import socket
from collections.abc import Callable
from pathlib import Path
from typing import Any

from armcal.errors import InputError, Location

Answer = Callable[[dict[str, Any]], dict[str, Any]]
Port = tuple[int, int]
"""A descriptor, and a number by which it differs from an earlier one of the same name."""
_AT_ONCE = 65536
_LONGEST_LINE = 1 << 20
_LOOK_UP_S = 0.25
_PATIENCE_S = 5.0
"""A client that does not read its answers for so long is let go."""


class ClockServer:
    """Listens on a Unix socket, beside one more descriptor that changes now and then.

    Args:
        path: of the socket; what an earlier bench left there is removed.
        answer: gives the answer to a request; ``ValueError`` refuses it.

    Raises:
        InputError: another bench is listening there.
    """

    def __init__(self, path: Path, answer: Answer) -> None:
        self._path, self._answer = path, answer
        self._clients: dict[int, tuple[socket.socket, bytearray]] = {}
        self._watched: Port | None = None
        if path.exists():
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
                try:
                    probe.connect(str(path))
                except OSError:  # nobody listens: it was left by a bench that was killed
                    path.unlink(missing_ok=True)
                else:
                    text, hint = "another simulated bench is running here.", "Stop it first, or give another folder."
                    raise InputError(text, where=Location(str(path)), hint=hint)
        self._listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._poll = select.epoll()
        self._bound = False

    def listen(self) -> None:
        """Be there for clients, who take the socket for the sign that the bench is ready.

        Raises:
            InputError: the path is too long for a socket, or cannot be written.
        """
        try:
            self._listener.bind(str(self._path))
        except OSError as fault:
            text = f"the clock's socket cannot be made ({fault})."
            hint = "Give a folder with a short path (a socket's has at most 107 characters) that can be written."
            raise InputError(text, where=Location(str(self._path)), hint=hint) from fault
        self._bound = True
        self._listener.listen()
        self._listener.setblocking(False)
        self._poll.register(self._listener.fileno(), select.EPOLLIN)

    def serve(self, port: Callable[[], Port | None], readable: Callable[[], None], ended: Callable[[], bool]) -> None:
        """Answer until ``ended``; call ``readable`` whenever something happens at the port."""
        while not ended():
            watched = port()
            if watched != self._watched:
                self._watched = watched  # a descriptor that was closed has left the poll by itself
                if watched is not None:
                    # Edges only: a port that nobody has open is at its end all the time.
                    self._poll.register(watched[0], select.EPOLLIN | select.EPOLLHUP | select.EPOLLET)
            for number, _ in self._poll.poll(_LOOK_UP_S):
                if number == self._listener.fileno():
                    client, _ = self._listener.accept()
                    client.settimeout(_PATIENCE_S)
                    self._clients[client.fileno()] = client, bytearray()
                    self._poll.register(client.fileno(), select.EPOLLIN)
                elif number in self._clients:
                    self._read(number)
                else:
                    readable()

    def close(self) -> None:
        """Let all clients go."""
        for number in list(self._clients):
            self._drop(number)
        self._poll.close()
        self._listener.close()
        if self._bound:
            self._path.unlink(missing_ok=True)

    def _read(self, number: int) -> None:
        client, buffer = self._clients[number]
        try:
            data = client.recv(_AT_ONCE)
        except OSError:
            data = b""
        if not data:
            self._drop(number)  # what was no whole line is forgotten with it
            return
        buffer += data
        while (end := buffer.find(b"\n")) >= 0:
            line = bytes(buffer[:end])
            del buffer[: end + 1]
            try:
                request = json.loads(line)
                if not isinstance(request, dict):
                    raise ValueError("found no JSON object")
                answer = self._answer(request)
            except (ValueError, RecursionError) as fault:
                answer = {"error": str(fault)}
            try:
                client.sendall(json.dumps(answer).encode() + b"\n")
            except OSError:
                self._drop(number)
                return
        if len(buffer) > _LONGEST_LINE:
            self._drop(number)

    def _drop(self, number: int) -> None:
        client, _ = self._clients.pop(number)
        with contextlib.suppress(OSError):
            self._poll.unregister(number)
        client.close()
