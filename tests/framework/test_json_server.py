"""Clients that ask too much, say nonsense, stop in the middle or never read; turns; and the order of answers."""

from __future__ import annotations

import contextlib
import json
import os
import resource
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from armcal.errors import ArmcalError, InputError
from armcal.io.json_server import MOST_CLIENTS, JsonServer

LONGEST = 256 * 1024


class House:
    """A server that echoes, turned by hand: ``long ...`` takes many slices, and nothing is answered while it waits."""

    def __init__(self) -> None:
        self.server = JsonServer(self.begin, self.refusal, LONGEST)
        self.answering = True
        self.size = 0
        self.lines: list[bytes] = []

    def begin(self, line: bytes, arrived: float) -> Iterator[bytes | None]:
        self.lines.append(line)
        for _ in range(20 if line.startswith(b"long") else 0):
            time.sleep(0.002)
            yield None
        while not self.answering:
            time.sleep(0.002)
            yield None
        yield json.dumps({"echo": line.decode(errors="replace")[:40], "pad": "x" * self.size}).encode()

    def refusal(self, fault: ArmcalError) -> bytes:
        return json.dumps({"error": str(fault)}).encode()

    def turn(self, times: int = 1) -> None:
        for _ in range(times):
            self.server.serve(0.001)

    def until(self, holds: Callable[[], bool]) -> None:
        ends = time.monotonic() + 20
        while not holds():
            assert time.monotonic() < ends
            self.turn()


@pytest.fixture
def house(tmp_path: Path) -> Iterator[House]:
    found = House()
    listen(found, tmp_path)
    yield found
    found.server.close()


def listen(house: House, folder: Path) -> None:
    house.server.listen(folder / "s.sock", "a server is running here.", "Give another --socket.")


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
    with connected(tmp_path) as client:
        send(house, client, b"long one\ntwo\n\n" + b"x" * (LONGEST + 9) + b"\nfour\n \nfive\n")
        found = heard(house, client, 5)
    assert [answer.get("echo") for answer in found] == ["long one", "two", None, "four", "five"]
    assert "256 KiB" in found[2]["error"]


def test_a_long_request_is_answered_in_slices_while_others_have_their_turns(house: House, tmp_path: Path) -> None:
    with connected(tmp_path) as greedy, connected(tmp_path) as modest:
        greedy.sendall(b"long\n" * 500)
        house.turn(5)
        modest.sendall(b"modest\n")
        assert heard(house, modest, 1)[0]["echo"] == "modest"
        assert house.lines.count(b"long") <= 2


@pytest.mark.slow
def test_one_client_with_many_requests_does_not_delay_another(house: House, tmp_path: Path) -> None:
    with connected(tmp_path) as greedy, connected(tmp_path) as modest:
        house.answering = False
        greedy.sendall(b"greedy\n" * 500)
        house.turn(5)
        modest.sendall(b"modest\n")
        house.turn(5)
        house.answering = True
        heard(house, modest, 1)
        assert house.lines.index(b"modest") <= 2
        assert len(heard(house, greedy, 500)) == 500


def test_who_does_not_read_is_not_listened_to(house: House, tmp_path: Path) -> None:
    house.size = 100_000
    with connected(tmp_path) as deaf, connected(tmp_path) as other:
        sent = 0
        for _ in range(300):
            with contextlib.suppress(BlockingIOError):
                sent += deaf.send(b"me\n" * 1000)
            house.turn()
        assert sent < 10_000_000 and len(house.lines) < 100
        house.size = 0
        other.sendall(b"here\n")
        assert heard(house, other, 1)[0]["echo"] == "here"
    house.until(lambda: house.server.clients == 0)


@pytest.mark.slow
def test_who_reads_slowly_gets_everything(house: House, tmp_path: Path) -> None:
    house.size = 50_000
    with connected(tmp_path) as slow:
        slow.sendall(b"".join(b"%d\n" % i for i in range(200)))
        house.turn(300)
        assert [answer["echo"] for answer in heard(house, slow, 200)] == [str(i) for i in range(200)]


def test_leaving_in_the_middle_harms_nobody(house: House, tmp_path: Path) -> None:
    for data in (b"", b"half a li", b"asked\n" * 100, b"\xff" * 100_000, b"asked\nhalf", b"long\n"):
        for _ in range(5):
            client = connected(tmp_path)
            with contextlib.suppress(BlockingIOError):
                client.sendall(data)
            house.turn(2)
            client.close()
    house.until(lambda: house.server.clients == 0)
    with connected(tmp_path) as client:
        client.sendall(b"still there\n")
        assert heard(house, client, 1)[0]["echo"] == "still there"


def test_who_says_all_and_then_listens_is_answered(house: House, tmp_path: Path) -> None:
    with connected(tmp_path) as client:
        client.sendall(b"one\ntwo\nlast without an end")
        client.shutdown(socket.SHUT_WR)
        assert [answer["echo"] for answer in heard(house, client, 3)] == ["one", "two", "last without an end"]
        house.until(lambda: house.server.clients == 0)


def test_fifty_megabytes_without_a_line_end_take_no_memory_and_delay_nobody(house: House, tmp_path: Path) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with connected(tmp_path) as client, connected(tmp_path) as other:
        piece = memoryview(os.urandom(1 << 20).replace(b"\n", b" "))
        for _ in range(50):
            send(house, client, piece)
            other.sendall(b"meanwhile\n")
            assert heard(house, other, 1)[0]["echo"] == "meanwhile"
        send(house, client, b"\nafter\n")
        found = heard(house, client, 2)
    assert "256 KiB" in found[0]["error"] and found[1]["echo"] == "after"
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 16 * 1024  # KiB


def test_one_client_too_many_is_told_so(house: House, tmp_path: Path) -> None:
    crowd = [connected(tmp_path) for _ in range(MOST_CLIENTS)]
    house.until(lambda: house.server.clients == MOST_CLIENTS)
    with connected(tmp_path) as one_more:
        assert "64 clients are connected" in heard(house, one_more, 1)[0]["error"]
        house.until(lambda: one_more.recv(100) == b"")
    crowd.pop().close()
    house.until(lambda: house.server.clients < MOST_CLIENTS)
    crowd.append(connected(tmp_path))
    send(house, crowd[-1], b"now\n")
    assert heard(house, crowd[-1], 1)[0]["echo"] == "now"
    for client in crowd:
        client.close()
    house.until(lambda: house.server.clients == 0)


def test_the_socket_is_its_owners_and_a_stale_one_is_replaced(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as stale:
        stale.bind(str(tmp_path / "s.sock"))
    house = House()
    listen(house, tmp_path)
    assert (tmp_path / "s.sock").stat().st_mode & 0o777 == 0o600
    with pytest.raises(InputError, match="a server is running here"):
        listen(House(), tmp_path)
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="not a socket"):
        House().server.listen(tmp_path / "file", "a server is running here.", "Give another --socket.")
    house.server.close()
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_standard_streams_wait_for_a_slow_reader_and_end_with_the_input() -> None:
    house, ours, theirs = House(), os.pipe(), os.pipe()
    house.server.attach(ours[0], theirs[1])
    house.size = 30_000
    os.write(ours[1], b"".join(b"%d\n" % i for i in range(100)))
    os.close(ours[1])
    house.turn(100)
    assert not (house.server.ended and house.server.finished)
    data = bytearray()
    os.set_blocking(theirs[0], False)

    def drained() -> bool:
        with contextlib.suppress(BlockingIOError):
            data.extend(os.read(theirs[0], 1 << 20))
        return data.count(b"\n") == 100

    house.until(drained)
    house.until(lambda: house.server.ended and house.server.finished)
    assert [json.loads(line)["echo"] for line in data.splitlines()] == [str(i) for i in range(100)]
    os.close(theirs[0])


def test_standard_output_that_is_closed_ends_it() -> None:
    house, ours, theirs = House(), os.pipe(), os.pipe()
    house.server.attach(ours[0], theirs[1])
    os.close(theirs[0])
    os.write(ours[1], b"one\n")
    house.until(lambda: house.server.ended)
