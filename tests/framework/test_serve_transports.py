"""Clients that ask too much, say nonsense, stop in the middle or never read; and the order of answers."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from armcal.errors import ArmcalError, InputError
from armcal_serve.conversation import MOST_WAITING, Ticket
from armcal_serve.dispatcher import Dispatcher
from armcal_serve.poller import Poller
from armcal_serve.protocol import MAX_LINE_BYTES
from armcal_serve.transports.datagrams import Datagrams
from armcal_serve.transports.stream import StandardStreams
from armcal_serve.transports.unix import MOST_CLIENTS, UnixSocket
from armcal_serve.worker_process import Message, Unpacker


class Worker:
    """Answers with the number of the request in its line, when it is told to."""

    def __init__(self) -> None:
        self.ticket: Ticket | None = None
        self.gone = False
        self.lines: list[bytes] = []

    def give(self, ticket: Ticket) -> None:
        self.ticket = ticket
        self.lines.append(ticket.line)

    def answer(self, size: int = 0) -> None:
        ticket, self.ticket = self.ticket, None
        if ticket is not None:
            content = {"echo": ticket.line.decode(errors="replace")[:40], "pad": "x" * size}
            ticket.answered(json.dumps(content).encode())


class House:
    """A dispatcher with workers of its own, turned by hand."""

    def __init__(self, workers: int = 1) -> None:
        self.poller = Poller()
        self.dispatcher = Dispatcher(lambda: {"ok": True, "well": 1})
        self.workers = [Worker() for _ in range(workers)]
        self.transports: list[Any] = []
        self.answering = True
        self.size = 0

    def turn(self, times: int = 1) -> None:
        for _ in range(times):
            self.poller.step(0.001)
            if self.answering:
                self.dispatcher.dispatch(self.workers)  # type: ignore[arg-type]
                for worker in self.workers:
                    worker.answer(self.size)
            for transport in self.transports:
                transport.poll()

    def until(self, holds: Callable[[], bool]) -> None:
        ends = time.monotonic() + 20
        while not holds():
            assert time.monotonic() < ends
            self.turn()


@pytest.fixture
def house() -> Iterator[House]:
    found = House()
    yield found
    for transport in found.transports:
        transport.close()


def unix(house: House, folder: Path, patience_s: float = 10.0) -> UnixSocket:
    transport = UnixSocket(folder / "s.sock", house.poller, house.dispatcher, patience_s)
    transport.open()
    house.transports.append(transport)
    return transport


def connected(folder: Path) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX)
    connection.connect(str(folder / "s.sock"))
    connection.setblocking(False)
    return connection


def send(house: House, connection: socket.socket, data: bytes) -> None:
    left = memoryview(data)
    while left:
        try:
            left = left[connection.send(left) :]
        except BlockingIOError:
            house.turn()


def heard(house: House, connection: socket.socket, lines: int) -> list[dict[str, Any]]:
    data = bytearray()

    def come() -> bool:
        with contextlib.suppress(BlockingIOError):
            data.extend(connection.recv(1 << 20))
        return data.count(b"\n") >= lines

    house.until(come)
    return [json.loads(line) for line in data.splitlines()]


def test_answers_come_in_the_order_of_requests_whatever_they_are(house: House, tmp_path: Path) -> None:
    unix(house, tmp_path)
    house.workers.append(Worker())
    with connected(tmp_path) as client:
        send(house, client, b'one\n{"do": "status", "id": 2}\n\n' + b"x" * (MAX_LINE_BYTES + 9) + b"\nfour\n \nfive\n")
        found = heard(house, client, 5)
    assert [answer.get("echo") for answer in found] == ["one", None, None, "four", "five"]
    assert found[1] == {"ok": True, "well": 1, "id": 2}
    assert "256 KiB" in found[2]["error"]


def test_a_later_answer_waits_for_an_earlier_one(house: House, tmp_path: Path) -> None:
    unix(house, tmp_path)
    house.answering = False
    house.workers.append(Worker())
    with connected(tmp_path) as client:
        client.sendall(b"one\ntwo\n")
        house.turn(5)
        house.dispatcher.dispatch(house.workers)  # type: ignore[arg-type]
        house.workers[1].answer()
        house.turn(5)
        with pytest.raises(BlockingIOError):
            client.recv(100)
        house.workers[0].answer()
        assert [answer["echo"] for answer in heard(house, client, 2)] == ["one", "two"]


@pytest.mark.slow
def test_clients_have_their_turns(house: House, tmp_path: Path) -> None:
    unix(house, tmp_path)
    with connected(tmp_path) as greedy, connected(tmp_path) as modest:
        house.answering = False
        greedy.sendall(b"greedy\n" * 500)
        house.turn(5)
        modest.sendall(b"modest\n")
        house.turn(5)
        assert house.dispatcher.waiting == MOST_WAITING + 1
        house.answering = True
        heard(house, modest, 1)
        assert house.workers[0].lines.index(b"modest") <= 2
        assert len(heard(house, greedy, 500)) == 500


def test_who_does_not_read_is_not_listened_to_and_then_let_go(house: House, tmp_path: Path) -> None:
    transport = unix(house, tmp_path, patience_s=0.3)
    house.size = 100_000
    with connected(tmp_path) as deaf, connected(tmp_path) as other:
        sent = 0
        ends = time.monotonic() + 20
        while transport.clients != 1 and time.monotonic() < ends:
            with contextlib.suppress(BlockingIOError, BrokenPipeError):
                sent += deaf.send(b"me\n" * 1000)
            house.turn()
        assert transport.clients == 1 and sent < 10_000_000 and len(house.workers[0].lines) < 100
        house.size = 0
        other.sendall(b"here\n")
        assert heard(house, other, 1)[0]["echo"] == "here"


@pytest.mark.slow
def test_who_reads_slowly_gets_everything(house: House, tmp_path: Path) -> None:
    unix(house, tmp_path)
    house.size = 50_000
    with connected(tmp_path) as slow:
        slow.sendall(b"".join(b"%d\n" % i for i in range(200)))
        house.turn(300)
        assert [answer["echo"] for answer in heard(house, slow, 200)] == [str(i) for i in range(200)]


def test_leaving_in_the_middle_harms_nobody(house: House, tmp_path: Path) -> None:
    transport = unix(house, tmp_path)
    for data in (b"", b"half a li", b"asked\n" * 100, b"\xff" * 100_000, b"asked\nhalf"):
        for _ in range(5):
            client = connected(tmp_path)
            with contextlib.suppress(BlockingIOError):
                client.sendall(data)
            house.turn(2)
            client.close()
    house.until(lambda: transport.clients == 0)
    with connected(tmp_path) as client:
        client.sendall(b"still there\n")
        assert heard(house, client, 1)[0]["echo"] == "still there"


def test_who_says_all_and_then_listens_is_answered(house: House, tmp_path: Path) -> None:
    transport = unix(house, tmp_path)
    with connected(tmp_path) as client:
        client.sendall(b"one\ntwo\nlast without an end")
        client.shutdown(socket.SHUT_WR)
        assert [answer["echo"] for answer in heard(house, client, 3)] == ["one", "two", "last without an end"]
        house.until(lambda: transport.clients == 0)


def test_ten_megabytes_without_a_line_end_take_no_memory(house: House, tmp_path: Path) -> None:
    unix(house, tmp_path)
    with connected(tmp_path) as client:
        send(house, client, os.urandom(1 << 20).replace(b"\n", b" ") * 10 + b"\nafter\n")
        found = heard(house, client, 2)
    assert "256 KiB" in found[0]["error"] and found[1]["echo"] == "after"


def test_too_many_clients_are_told_so(house: House, tmp_path: Path) -> None:
    transport = unix(house, tmp_path)
    crowd = []
    for _ in range(MOST_CLIENTS):
        crowd.append(connected(tmp_path))
        house.turn()
    with connected(tmp_path) as one_more:
        assert "clients" in heard(house, one_more, 1)[0]["error"]
    for client in crowd:
        client.close()
    house.until(lambda: transport.clients == 0)


def test_the_socket_is_its_owners_and_a_stale_one_is_replaced(house: House, tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(tmp_path / "s.sock"))
    unix(house, tmp_path)
    assert (tmp_path / "s.sock").stat().st_mode & 0o777 == 0o600
    with pytest.raises(InputError, match="a server is running here"):
        UnixSocket(tmp_path / "s.sock", house.poller, house.dispatcher)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="not a socket"):
        UnixSocket(tmp_path / "file", house.poller, house.dispatcher)
    house.transports.pop().close()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_datagrams_are_answered_to_their_senders(house: House) -> None:
    transport = Datagrams(0, house.poller, house.dispatcher)
    house.transports.append(transport)
    transport.open()
    senders = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(3)]
    for number, sender in enumerate(senders):
        sender.setblocking(False)
        for i in range(4):
            sender.sendto(f"{number} {i}".encode(), ("127.0.0.1", transport.port))
    senders[0].sendto(b"\xff\x00", ("127.0.0.1", transport.port))
    house.turn(60)
    for number, sender in enumerate(senders):
        found = [json.loads(sender.recv(65536))["echo"] for _ in range(4)]
        assert found == [f"{number} {i}" for i in range(4)]
    assert transport.clients == 0 or transport.finished
    house.size = 80_000
    senders[1].sendto(b'{"id": 5}', ("127.0.0.1", transport.port))
    house.turn(20)
    assert "no datagram holds" in json.loads(senders[1].recv(65536))["error"]
    house.answering = False
    for i in range(300):
        senders[2].sendto(b"again %d" % i, ("127.0.0.1", transport.port))
        if i % 20 == 0:
            house.turn()
    house.turn(20)
    assert "are waiting" in json.loads(senders[2].recv(65536))["error"]
    for sender in senders:
        sender.close()
    with pytest.raises(InputError):
        Datagrams(transport.port, house.poller, house.dispatcher)


def test_standard_streams_wait_for_a_slow_reader_and_end_with_the_input(house: House) -> None:
    ours, theirs = os.pipe(), os.pipe()
    transport = StandardStreams(ours[0], theirs[1], house.poller, house.dispatcher)
    house.transports.append(transport)
    transport.open()
    house.size = 30_000
    os.write(ours[1], b"".join(b"%d\n" % i for i in range(100)))
    os.close(ours[1])
    house.turn(100)
    assert not transport.ended
    data = bytearray()
    os.set_blocking(theirs[0], False)

    def drained() -> bool:
        with contextlib.suppress(BlockingIOError):
            data.extend(os.read(theirs[0], 1 << 20))
        return transport.ended

    house.until(drained)
    house.until(lambda: data.count(b"\n") == 100 or drained())
    assert [json.loads(line)["echo"] for line in data.splitlines()] == [str(i) for i in range(100)]
    os.close(theirs[0])


def test_standard_output_that_is_closed_ends_it(house: House) -> None:
    ours, theirs = os.pipe(), os.pipe()
    transport = StandardStreams(ours[0], theirs[1], house.poller, house.dispatcher)
    house.transports.append(transport)
    transport.open()
    os.close(theirs[0])
    os.write(ours[1], b"one\n")
    house.until(lambda: transport.ended)


def test_a_request_that_costs_two_workers_is_given_up(house: House, tmp_path: Path) -> None:
    unix(house, tmp_path)
    house.answering = False
    worker, why = house.workers[0], ArmcalError("it ended the process.")
    with connected(tmp_path) as client:
        client.sendall(b'{"id": 3}\n{"id": 4}\n')
        house.turn(3)
        for _ in range(2):
            house.dispatcher.dispatch(house.workers)  # type: ignore[arg-type]
            assert worker.ticket is not None and worker.lines[-1] == b'{"id": 3}'
            ticket, worker.ticket = worker.ticket, None
            house.dispatcher.requeue(ticket, why)
        house.answering = True
        first, second = heard(house, client, 2)
    assert first["id"] == 3 and not first["ok"] and "ended" in first["error"]
    assert "4" in second["echo"]


def test_messages_survive_any_cutting() -> None:
    sent = [Message(i, os.urandom(i * 7 % 50), i / 3) for i in range(40)]
    data = b"".join(message.packed() for message in sent)
    for step in (1, 3, 20, 10_000):
        cutter = Unpacker()
        found = [m for at in range(0, len(data), step) for m in cutter.feed(data[at : at + step])]
        assert found == sent


def test_idle_and_slow_clients_give_way_to_one_that_asks(
    house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All places are taken: by one that asks now and then, by one that never ends its line, and by idle ones."""
    now = _clock(monkeypatch)
    transport = unix(house, tmp_path)
    crowd = [connected(tmp_path) for _ in range(MOST_CLIENTS)]
    house.until(lambda: transport.clients == MOST_CLIENTS)
    busy, slow, *others = crowd
    send(house, slow, b"x")
    house.turn(3)
    now[0] += 2.0
    for idle in others:
        send(house, idle, b"once\n")
        heard(house, idle, 1)
    for _ in range(5):
        now[0] += 4.0
        send(house, slow, b"x")
        send(house, busy, b"again\n")
        heard(house, busy, 1)
    for number in range(3):
        one_more = connected(tmp_path)
        send(house, one_more, f"new {number}\n".encode())
        assert heard(house, one_more, 1)[0]["echo"] == f"new {number}"
        crowd.append(one_more)
    assert "this one asked nothing for 22 s: the connection is closed" in heard(house, slow, 1)[0]["error"]
    house.until(lambda: transport.clients <= MOST_CLIENTS)
    send(house, busy, b"still\n")
    assert heard(house, busy, 1)[0]["echo"] == "still"
    for client in crowd:
        client.close()


def test_a_line_has_a_deadline_and_an_answer_that_is_awaited_has_none(
    house: House, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = _clock(monkeypatch)
    transport = unix(house, tmp_path)
    with connected(tmp_path) as silent, connected(tmp_path) as waiting, connected(tmp_path) as planner:
        house.answering = False
        send(house, waiting, b"long\n")
        send(house, planner, b'{"do": "status"}\n')
        heard(house, planner, 1)
        house.until(lambda: transport.clients == 3)
        for _ in range(8):
            now[0] += 9.0
            house.turn()
        assert "no whole request came within 30 s" in heard(house, silent, 1)[0]["error"]
        house.until(lambda: transport.clients == 2)
        house.answering = True
        assert heard(house, waiting, 1)[0]["echo"] == "long"
        send(house, planner, b"half a l")
        house.turn(3)
        now[0] += 31.0
        assert "no whole request" in heard(house, planner, 1)[0]["error"]


@pytest.mark.slow
def test_out_of_descriptors_it_neither_spins_nor_stops(house: House, tmp_path: Path) -> None:
    transport = unix(house, tmp_path)
    with connected(tmp_path) as first, connected(tmp_path) as second:
        send(house, first, b"one\n")
        heard(house, first, 1)
        house.until(lambda: transport.clients == 2)
        third = connected(tmp_path)
        soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
        free = os.dup(0)
        os.close(free)
        resource.setrlimit(resource.RLIMIT_NOFILE, (free, hard))
        try:
            turns, ends = 0, time.monotonic() + 0.5
            while time.monotonic() < ends:
                house.poller.step(0.1)
                transport.poll()
                turns += 1
            send(house, second, b"two\n")
            assert heard(house, second, 1)[0]["echo"] == "two"
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
        assert turns < 50
        send(house, third, b"three\n")
        assert heard(house, third, 1)[0]["echo"] == "three"
        third.close()


def _clock(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Time as the transports have it, in a list of one number (s)."""
    now = [1000.0]
    for module in ("stream", "unix"):
        clock = SimpleNamespace(monotonic=lambda: now[0])
        monkeypatch.setattr(f"armcal_serve.transports.{module}.time", clock)
    return now
