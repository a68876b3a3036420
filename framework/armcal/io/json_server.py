"""JSON lines, a request a line and its answer a line back: the one server of them, and one who asks.

The server answers many clients in its caller's thread, in turn and a slice of work at a time, so that a long request
does not hold the others up. Clients come by a Unix socket, which only its owner may connect to, or are a pair of
descriptors such as standard input and output. Memory is bounded for each: lines that are too long are thrown away while
they come, and who does not read its answers is not read from.
"""

import contextlib
import json
import os
import selectors
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from stat import S_ISSOCK
from types import TracebackType
from typing import Any, Protocol, Self

from armcal.base.config_text import as_line
from armcal.errors import ArmcalError, DataError, InputError, Location
from armcal.io.lines import LineCutter, write_ready

MOST_CLIENTS = 64
MOST_WAITING = 64  # So many of a client's requests are taken before the first is answered
MOST_UNREAD_BYTES = 1024**2  # A client that leaves so much unread is not answered, nor listened to, until it reads
SLICE_S = 0.001  # After so much work the server looks who else has come
_CHUNK = 64 * 1024
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
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe, short_address(path) as address:
        probe.settimeout(1.0)
        try:
            probe.connect(address)
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
        except OSError:
            pass
    raise InputError(taken, where=where, hint=hint)


class JsonClient:
    """A connection to a server, for requests one after another.

    Raises:
        OSError: nobody answers at the path.
    """

    def __init__(self, path: Path, timeout_s: float = 30.0) -> None:
        self._connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._connection.settimeout(timeout_s)
        try:
            with short_address(path) as address:
                self._connection.connect(address)
        except OSError:
            self._connection.close()
            raise
        self._answers = self._connection.makefile("rb")

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

    def close(self) -> None:
        self._answers.close()
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        self.close()


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


class _Client:
    """One of them: what it asked, and what it was not sent yet."""

    def __init__(
        self,
        incoming: int,
        outgoing: int,
        receive: Callable[[], bytes],  # what has come, nothing at the end; BlockingIOError where nothing has come
        send: Callable[[memoryview], int],  # how many bytes were taken; another OSError where the client is gone
        close: Callable[[], None],
        longest: int,
    ) -> None:
        self.incoming, self.outgoing = incoming, outgoing
        self.receive, self.send, self.close = receive, send, close
        self.cutter = LineCutter(longest)
        self.lines: deque[tuple[bytes | ArmcalError, float]] = deque()
        self.work: Iterator[bytes | None] | None = None
        self.out = bytearray()
        self.reading, self.gone = True, False

    @property
    def due(self) -> bool:
        """Whether it is owed anything."""
        return bool(self.lines or self.work or self.out)

    @property
    def ready(self) -> bool:
        return not self.gone and bool(self.lines or self.work) and len(self.out) <= MOST_UNREAD_BYTES


class JsonServer:
    """Serves clients: only while ``serve`` is called is anyone answered.

    Attributes:
        requests: so far.
    """

    def __init__(self, answers: Answers, longest: int = 64 * 1024) -> None:
        """A request of more than ``longest`` bytes is refused."""
        self.requests = 0
        self._answers, self._longest = answers, longest
        self._selector = selectors.PollSelector()  # takes regular files too, as standard input may be one
        self._clients: list[_Client] = []
        self._round: list[_Client] = []  # those who are ready
        self._listener: socket.socket | None = None
        self._path: Path | None = None

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
        return self._listener is None and not any(client.reading for client in self._clients)

    @property
    def finished(self) -> bool:
        """Whether all requests are answered, and the answers taken."""
        return not any(client.due for client in self._clients)

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
            listener.setblocking(False)
        except (OSError, ValueError) as fault:
            listener.close()
            hint = f"{hint} It has to be on a writable disk of this machine."
            raise InputError(f"the socket cannot be made ({fault}).", where=Location(str(path)), hint=hint) from fault
        except BaseException:
            listener.close()
            raise
        self._listener, self._path = listener, path
        self.watch(listener.fileno(), self._accept)

    def attach(self, incoming: int, outgoing: int) -> None:
        """Serve a pair of descriptors, which stay the caller's and are not made non-blocking: others share them."""
        receive, send = partial(os.read, incoming, _CHUNK), partial(write_ready, outgoing)
        self._begin(_Client(incoming, outgoing, receive, send, lambda: None, self._longest))

    def serve(self, wait_s: float = 0.0) -> None:
        """Read, work and write once; wait so long for something to do where there is nothing."""
        for key, events in self._selector.select(0.0 if self._round else wait_s):
            for event, call in zip((selectors.EVENT_READ, selectors.EVENT_WRITE), key.data, strict=True):
                if events & event and call is not None and self._selector.get_map().get(key.fd) is key:
                    call()  # unless one before dropped it, or changed it
        ends = time.monotonic() + SLICE_S
        while self._round and time.monotonic() < ends:
            # A slice for each of them, and first for those whose request was not begun: most are done with one.
            clients, self._round = sorted(self._round, key=lambda client: client.work is not None), []
            for client in clients:
                self._work(client)

    def stop_reading(self) -> None:
        """Take no further requests and clients; those that came are answered."""
        if self._listener is not None:
            self.watch(self._listener.fileno())
        for client in [*self._clients]:
            client.reading = False
            self._arrange(client)

    def close(self) -> None:
        for client in [*self._clients]:
            self._write(client)
            self._drop(client)
        self._selector.close()
        if self._listener is not None and self._path is not None:
            self._listener.close()
            with contextlib.suppress(OSError):
                self._path.unlink()

    def _begin(self, client: _Client) -> None:
        self._clients.append(client)
        self._arrange(client)

    def _accept(self) -> None:
        assert self._listener is not None
        try:
            connection, _ = self._listener.accept()
        except OSError:
            return
        connection.setblocking(False)
        if len(self._clients) >= MOST_CLIENTS:
            fault = ArmcalError(f"{MOST_CLIENTS} clients are connected.", hint="Close connections that are not used.")
            with contextlib.suppress(OSError):
                connection.send(self._answers.refusal(fault) + b"\n")
            connection.close()
            return
        number, receive = connection.fileno(), partial(connection.recv, _CHUNK)
        self._begin(_Client(number, number, receive, connection.send, connection.close, self._longest))

    def _read(self, client: _Client) -> None:
        try:
            data = client.receive()
        except BlockingIOError:
            return
        except OSError:
            self._drop(client)
            return
        now, lines = time.monotonic(), client.cutter.feed(data)
        if not data:
            client.reading = False
            lines = [client.cutter.rest()] if client.cutter.begun else []
        for line in lines:
            if line is None:
                text = f"the request has more than {self._longest // 1024} KiB."
                client.lines.append((DataError(text, hint="Ask for less at a time."), now))
            elif line.strip():
                client.lines.append((line, now))
        self._arrange(client)

    def _work(self, client: _Client) -> None:
        """One slice of the oldest request of a client."""
        if not client.ready:
            return
        if client.work is None:
            line, arrived = client.lines.popleft()
            self.requests += 1
            if isinstance(line, ArmcalError):
                client.work = iter([self._answers.refusal(line)])
            else:
                client.work = self._answers.begin(line, arrived)
        answer = next(client.work)
        if answer is not None:
            client.work = None
            client.out += answer + b"\n"
            self._write(client)
        self._arrange(client)

    def _write(self, client: _Client) -> None:
        try:
            while client.out:
                with memoryview(client.out) as view:
                    sent = client.send(view)
                if not sent:
                    break
                del client.out[:sent]
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
            return
        self._arrange(client)

    def _drop(self, client: _Client) -> None:
        if client.gone:
            return
        client.gone, client.reading = True, False
        for place in {client.incoming, client.outgoing}:
            self.watch(place)
        client.lines.clear()
        client.out.clear()
        client.work = None
        self._clients.remove(client)
        client.close()

    def _arrange(self, client: _Client) -> None:
        """Drop it if it is done; else put it into the round if it is ready, and watch what it waits for."""
        if not (client.reading or client.due):
            self._drop(client)
        if client.gone:
            return
        if client.ready and client not in self._round:
            self._round.append(client)
        full = len(client.lines) >= MOST_WAITING or len(client.out) > MOST_UNREAD_BYTES
        read = partial(self._read, client) if client.reading and not full else None
        write = partial(self._write, client) if client.out else None
        if client.incoming == client.outgoing:
            self.watch(client.incoming, read, write)
        else:
            self.watch(client.incoming, read)
            self.watch(client.outgoing, None, write)

    def watch(
        self, place: int, read: Callable[[], None] | None = None, write: Callable[[], None] | None = None
    ) -> None:
        """Call these, within ``serve``, while a descriptor can be read or written.

        With neither it is not registered at all: a peer that hung up would be reported for ever.
        """
        events = (selectors.EVENT_READ if read else 0) | (selectors.EVENT_WRITE if write else 0)
        known = self._selector.get_map().get(place)
        if not events:
            if known is not None:
                self._selector.unregister(place)
        elif known is None:
            self._selector.register(place, events, (read, write))
        elif known.events != events:
            self._selector.modify(place, events, (read, write))
