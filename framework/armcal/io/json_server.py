"""JSON lines, a request a line and its answer a line back: the one server of them, and one who asks.

The server answers many clients in its caller's thread, in turn and a slice of work at a time, so that a long request
does not hold the others up. Clients come by a Unix socket, which only its owner may connect to, or are a pair of
descriptors such as standard input and output. Each has a thread, which reads a line, has it answered, and writes: so
memory is bounded, and who does not read its answers is not read from. Lines that are too long are thrown away while
they come.
"""

import contextlib
import json
import os
import queue
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISSOCK
from typing import Any, BinaryIO

from armcal.base.config_text import as_line
from armcal.errors import ArmcalError, DataError, InputError, Location

MOST_CLIENTS = 64
SLICE_S = 0.001  # After so much work the server looks who else has come
_GRACE_S = 0.5  # So long the last answers may take to be written
_PATH_BYTES = 100  # A longer path does not fit a Unix socket's address

_Answer = queue.SimpleQueue[bytes | None]  # to one request of a client; None where nobody will answer it


@contextmanager
def short_address(path: Path) -> Iterator[str]:
    """A socket's address, which is short: by the folder's descriptor where the path is long."""
    if len(os.fsencode(path)) <= _PATH_BYTES:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def vacate(path: Path, taken: str, hint: str) -> None:
    """Take away a socket that nobody serves any more.

    ``taken`` is what an InputError says of one that somebody serves, ``hint`` which option to change.
    """
    where = Location(str(path))
    try:
        kind = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not S_ISSOCK(kind):
        raise InputError("it is not a socket.", where=where, hint=f"Remove it, or {hint[:1].lower()}{hint[1:]}")
    try:
        JsonClient(path, 1.0).close()
    except (ConnectionRefusedError, FileNotFoundError):
        path.unlink(missing_ok=True)
        return
    except OSError:
        pass
    raise InputError(taken, where=where, hint=hint)


class JsonClient(contextlib.ExitStack):
    """A connection to a server, for requests one after another. OSError: nobody answers, or not in time."""

    def __init__(self, path: Path, timeout_s: float = 30.0) -> None:
        super().__init__()
        self._connection = self.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_STREAM))
        self._connection.settimeout(timeout_s)
        try:
            with short_address(path) as address:
                self._connection.connect(address)
        except OSError:
            self.close()
            raise
        self._answers = self.enter_context(self._connection.makefile("rb"))

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        self._connection.sendall(json.dumps(request).encode() + b"\n")
        line = self._answers.readline()
        if not line:
            raise ConnectionResetError("it closed the connection")
        return dict(json.loads(line))


class JsonServer:
    """Serves clients: only while ``serve`` is called is anyone answered, but for who sends a line that is too long.

    Args:
        answering: makes the answer to a line that came then (monotonic seconds), after None for each slice of work
            before it; nothing in it may raise.
        refusal: makes the answer to what cannot be read, and to a client that is one too many.
        longest: bytes that a request may have.
    """

    def __init__(
        self,
        answering: Callable[[bytes, float], Iterator[bytes | None]],
        refusal: Callable[[ArmcalError], bytes],
        longest: int = 64 * 1024,
    ) -> None:
        self.requests = 0  # so far
        self._answering, self._refusal, self._longest, self._stopped = answering, refusal, longest, False
        self._asked: queue.SimpleQueue[tuple[bytes, float, _Answer]] = queue.SimpleQueue()
        self._begun: list[tuple[Iterator[bytes | None], _Answer]] = []
        self._clients: dict[threading.Thread, socket.socket | None] = {}
        self._waiting: set[threading.Thread] = set()  # for an answer, or for somebody to take it
        self._listener: socket.socket | None = None
        self._accepting: threading.Thread | None = None
        self._path = Path()

    @classmethod
    def at(
        cls, path: Path, taken: str, hint: str, answer: Callable[[dict[str, Any]], Mapping[str, Any]]
    ) -> "JsonServer":
        """A server of objects at a socket (see ``listen``); what ``answer`` raises becomes an ``error``."""

        def refusal(fault: Exception) -> bytes:
            return as_line({"ok": False, "error": str(fault)}).encode()

        def answering(line: bytes, arrived: float) -> Iterator[bytes]:
            try:
                request = json.loads(line.decode("utf-8"))
            except (ValueError, RecursionError) as fault:
                yield refusal(DataError(f"the request is not JSON ({fault})."))
                return
            try:
                if not isinstance(request, dict):
                    raise DataError("the request is JSON, but no object.")
                yield as_line(answer(request)).encode()
            except (ArmcalError, ValueError) as fault:
                yield refusal(fault)
            except Exception as fault:  # no request may end the server
                yield refusal(ArmcalError(f"it failed ({type(fault).__name__}: {fault})."))

        server = cls(answering, refusal)
        server.listen(path, taken, hint)
        return server

    @property
    def clients(self) -> int:
        return len(self._clients)

    @property
    def ended(self) -> bool:
        """Whether no request will ever come again."""
        return self._listener is None and not self._clients

    @property
    def finished(self) -> bool:
        """After ``stop_reading``: whether all requests are answered, and the answers taken."""
        return not self._waiting and not any([*self._clients.values()])

    def listen(self, path: Path, taken: str, hint: str) -> None:
        """Serve a socket; one that nobody serves any more is replaced. ``taken`` and ``hint`` are as of ``vacate``."""
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            with short_address(path) as address:
                vacate(path, taken, hint)
                mask = os.umask(0o177)
                try:
                    listener.bind(address)
                finally:
                    os.umask(mask)
            listener.listen(MOST_CLIENTS)
        except (OSError, ValueError) as fault:
            listener.close()
            hint = f"{hint} It has to be on a writable disk of this machine."
            raise InputError(f"the socket cannot be made ({fault}).", where=Location(str(path)), hint=hint) from fault
        except BaseException:
            listener.close()
            raise
        self._listener, self._path = listener, path
        self._accepting = threading.Thread(target=self._accept, args=[listener], daemon=True)
        self._accepting.start()

    def attach(self, incoming: int, outgoing: int) -> None:
        """Serve a pair of descriptors, which stay the caller's."""
        with contextlib.suppress(OSError):  # one is closed: nobody asks
            self._begin(open(incoming, "rb", closefd=False), open(outgoing, "wb", closefd=False))  # noqa: SIM115

    def serve(self, wait_s: float = 0.0) -> None:
        """Work on requests; wait so long for one where there is none."""
        self._take(0.0 if self._begun else wait_s)
        ends = time.monotonic() + SLICE_S
        while self._begun and time.monotonic() < ends:
            # A slice for each of them, and first for those that were not begun: most are done with one.
            requests, self._begun = self._begun, []
            for work, answer in requests:
                if (line := next(work)) is None:
                    self._begun.append((work, answer))
                else:
                    answer.put(line)
            self._take(0.0)

    def stop_reading(self) -> None:
        """Take no further requests and clients; those that came are answered."""
        self._stopped = True
        for connection in (self._listener, *self._clients.values()):
            if connection is not None:
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RD)

    def close(self) -> None:
        """End; who does not take the answer that it was given has a moment to do so."""
        self.stop_reading()
        if self._accepting is not None:
            self._accepting.join()
            self.stop_reading()  # of who came meanwhile
        ends = time.monotonic() + _GRACE_S
        connected = [(client, connection) for client, connection in [*self._clients.items()] if connection is not None]
        while any(client.is_alive() for client, _ in connected):
            self._take(SLICE_S)
            for _, answer in self._begun:
                answer.put(None)
            self._begun.clear()
            for _, connection in connected if time.monotonic() > ends else ():
                with contextlib.suppress(OSError):
                    connection.shutdown(socket.SHUT_RDWR)
        if self._listener is not None:
            self._listener.close()
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _accept(self, listener: socket.socket) -> None:
        while True:
            try:
                connection, _ = listener.accept()
            except OSError:  # it was shut down, or there are no descriptors
                if self._stopped:
                    return
                time.sleep(SLICE_S)
                continue
            if len(self._clients) < MOST_CLIENTS:
                self._begin(connection.makefile("rb"), connection.makefile("wb"), connection)
                continue
            fault = ArmcalError(f"{MOST_CLIENTS} clients are connected.", hint="Close connections that are not used.")
            with connection, contextlib.suppress(OSError):
                connection.send(self._refusal(fault) + b"\n")

    def _begin(self, reader: BinaryIO, writer: BinaryIO, connection: socket.socket | None = None) -> None:
        client = threading.Thread(target=self._converse, args=[reader, writer, connection], daemon=True)
        self._clients[client] = connection
        client.start()

    def _converse(self, reader: BinaryIO, writer: BinaryIO, connection: socket.socket | None) -> None:
        """A client's thread: read its lines, have each answered, and write the answers."""
        client, answer = threading.current_thread(), _Answer()
        with contextlib.suppress(OSError):  # it is gone
            while piece := reader.readline(self._longest + 1):
                is_too_long = False
                while len(piece) > self._longest and not piece.endswith(b"\n"):
                    piece, is_too_long = reader.readline(self._longest + 1), True
                if not (is_too_long or piece.strip()):
                    continue
                if self._stopped and connection is None:  # another's end is at what was sent before
                    break
                self._waiting.add(client)
                if is_too_long:
                    text = f"the request has more than {self._longest // 1024} KiB."
                    answer.put(self._refusal(DataError(text, hint="Ask for less at a time.")))
                else:
                    self._asked.put((piece.strip(), time.monotonic(), answer))
                if (line := answer.get()) is None:
                    break
                writer.write(line + b"\n")
                writer.flush()
                self._waiting.discard(client)
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.close()
                reader.close()
                writer.close()
        self._waiting.discard(client)
        del self._clients[client]

    def _take(self, wait_s: float) -> None:
        with contextlib.suppress(queue.Empty):
            while True:
                line, arrived, answer = self._asked.get(timeout=wait_s)
                self.requests += 1
                self._begun.insert(0, (self._answering(line, arrived), answer))
                wait_s = 0.0
