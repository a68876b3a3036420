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
from typing import Any, BinaryIO, Protocol

from armcal.base.config_text import as_line
from armcal.errors import ArmcalError, DataError, InputError, Location

MOST_CLIENTS = 64
SLICE_S = 0.001  # After so much work the server looks who else has come
_GRACE_S = 0.5  # So long the last answers may take to be written
_PATH_BYTES = 100  # A longer path does not fit a Unix socket's address


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

    ``taken`` is the sentence for one that somebody serves, ``hint`` says which option to change.

    Raises:
        InputError: somebody serves it, or something else is there.
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
    """A connection to a server, for requests one after another.

    Raises:
        OSError: nobody answers at the path.
    """

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
        """The answer.

        Raises:
            OSError: the server went away, or takes too long (TimeoutError).
        """
        self._connection.sendall(json.dumps(request).encode() + b"\n")
        line = self._answers.readline()
        if not line:
            raise ConnectionResetError("it closed the connection")
        return dict(json.loads(line))


class Answers(Protocol):
    """What a server answers; nothing here may raise."""

    def begin(self, line: bytes, arrived: float) -> Iterator[bytes | None]:
        """The answer to a line that came then (monotonic seconds); None before it, after each slice of work."""

    def refusal(self, fault: ArmcalError) -> bytes:
        """The answer to what cannot be read, and to a client that is one too many."""


class PlainAnswers(Answers):
    """Objects for objects, at once: by a function, whose exceptions become ``ok`` false and an ``error``."""

    def __init__(self, answer: Callable[[dict[str, Any]], Mapping[str, Any]]) -> None:
        self._answer = answer

    def begin(self, line: bytes, arrived: float) -> Iterator[bytes | None]:
        try:
            request = json.loads(line.decode("utf-8"))
        except (ValueError, RecursionError) as fault:
            yield self.refusal(DataError(f"the request is not JSON ({fault})."))
            return
        try:
            if not isinstance(request, dict):
                raise DataError("the request is JSON, but no object.")
            yield as_line(self._answer(request)).encode()
        except (ArmcalError, ValueError) as fault:
            yield self.refusal(fault)
        except Exception as fault:  # no request may end the server
            yield self.refusal(ArmcalError(f"it failed ({type(fault).__name__}: {fault})."))

    def refusal(self, fault: Exception) -> bytes:
        return as_line({"ok": False, "error": str(fault)}).encode()


class _Request:
    """A line, the slices of its answer, and the answer once it is there; None where nobody will answer it."""

    def __init__(self, line: bytes | None, arrived: float) -> None:
        self.line, self.arrived = line, arrived  # no line: it was too long
        self.work: Iterator[bytes | None] = iter(())
        self.answer: queue.SimpleQueue[bytes | None] = queue.SimpleQueue()


class JsonServer:
    """Serves clients: only while ``serve`` is called is anyone answered.

    Attributes:
        requests: so far.
    """

    def __init__(self, answers: Answers, longest: int = 64 * 1024) -> None:
        """A request of more than ``longest`` bytes is refused."""
        self.requests = 0
        self._answers, self._longest, self._stopped = answers, longest, False
        self._asked: queue.SimpleQueue[_Request | None] = queue.SimpleQueue()  # None: somebody left
        self._begun: list[_Request] = []
        self._clients: dict[threading.Thread, socket.socket | None] = {}
        self._waiting: set[threading.Thread] = set()  # for an answer, or for somebody to take it
        self._listener: socket.socket | None = None
        self._accepting: threading.Thread | None = None
        self._path = Path()

    @classmethod
    def at(
        cls, path: Path, taken: str, hint: str, answer: Callable[[dict[str, Any]], Mapping[str, Any]]
    ) -> "JsonServer":
        """A server of plain answers at a socket; see ``listen``."""
        server = cls(PlainAnswers(answer))
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
        """Serve a socket; one that nobody serves any more is replaced. ``taken`` and ``hint`` are as of ``vacate``.

        Raises:
            InputError: somebody serves it, something else is there, or it cannot be made.
        """
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
            for request in requests:
                answer = next(request.work)
                if answer is None:
                    self._begun.append(request)
                else:
                    request.answer.put(answer)
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
        for client, connection in [*self._clients.items()]:
            while connection is not None and client.is_alive():
                self._take(0.0)
                for request in self._begun:
                    request.answer.put(None)
                self._begun.clear()
                if time.monotonic() > ends:
                    with contextlib.suppress(OSError):
                        connection.shutdown(socket.SHUT_RDWR)
                client.join(SLICE_S)
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
                connection.send(self._answers.refusal(fault) + b"\n")

    def _begin(self, reader: BinaryIO, writer: BinaryIO, connection: socket.socket | None = None) -> None:
        client = threading.Thread(target=self._converse, args=[reader, writer, connection], daemon=True)
        self._clients[client] = connection
        client.start()

    def _converse(self, reader: BinaryIO, writer: BinaryIO, connection: socket.socket | None) -> None:
        """A client's thread: read its lines, have each answered, and write the answers."""
        client = threading.current_thread()
        with contextlib.suppress(OSError):  # it is gone
            for line in self._lines(reader):
                if self._stopped and connection is None:  # another's end is at what was sent before
                    break
                request = _Request(line, time.monotonic())
                self._waiting.add(client)
                self._asked.put(request)
                if (answer := request.answer.get()) is None:
                    break
                writer.write(answer + b"\n")
                writer.flush()
                self._waiting.discard(client)
        if connection is not None:
            with contextlib.suppress(OSError):
                connection.close()
                reader.close()
                writer.close()
        self._waiting.discard(client)
        del self._clients[client]
        self._asked.put(None)

    def _lines(self, stream: BinaryIO) -> Iterator[bytes | None]:
        """Those that hold anything; None for one that is too long."""
        while piece := stream.readline(self._longest + 1):
            line: bytes | None = piece
            while len(piece) > self._longest and not piece.endswith(b"\n"):
                piece, line = stream.readline(self._longest + 1), None
            if line is None or line.strip():
                yield line and line.strip()

    def _take(self, wait_s: float) -> None:
        """Begin what was asked."""
        with contextlib.suppress(queue.Empty):
            while True:
                request, wait_s = self._asked.get(timeout=wait_s), 0.0
                if request is None:
                    continue
                self.requests += 1
                if request.line is None:
                    text = f"the request has more than {self._longest // 1024} KiB."
                    request.work = iter([self._answers.refusal(DataError(text, hint="Ask for less at a time."))])
                else:
                    request.work = self._answers.begin(request.line, request.arrived)
                self._begun.insert(0, request)
