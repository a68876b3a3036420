"""Who may look at a recalibration, what is new to a page, and bad clients."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from armcal.errors import InputError
from armcal_online.watch.feed import Feed
from armcal_online.watch.server import MOST_CONNECTIONS, Access, WatchServer, is_loopback
from watching import Served, decision, made_up, made_up_folder

ROOT = Path(__file__).resolve().parents[2]
DEMO = str(ROOT / "configs" / "lrm_arm" / "demo.yaml")
HOSTILE = "</script><script>document.title='taken'</script><img src=x onerror=\"document.title='taken'\">"
# Who may look


@pytest.mark.parametrize(
    ("header", "allowed"),
    [
        ("localhost", True),
        ("localhost:1234", True),
        ("127.0.0.1:8642", True),
        ("[::1]:8642", True),
        ("LOCALHOST", True),
        ("", False),
        (None, False),
        ("rebound.example", False),
        ("127.0.0.1.rebound.example", False),
        ("localhost:80@rebound.example", False),
        ("[::1].rebound.example", False),
        ("0.0.0.0", False),
    ],
)
def test_on_this_machine_only_names_of_this_machine_are_answered(header: str | None, allowed: bool) -> None:
    assert Access.of("127.0.0.1").allows(header, None) is allowed


def test_beyond_this_machine_only_who_knows_the_token() -> None:
    access = Access.of("0.0.0.0")
    assert access.token and len(access.token) >= 32 and access.token != Access.of("0.0.0.0").token
    assert access.allows("anything.example", access.token)
    for wrong in (None, "", access.token[:-1], access.token + "x", "\u00e9"):
        assert not access.allows("localhost", wrong)
    assert [is_loopback(h) for h in ("127.0.0.9", "::1", "localhost", "0.0.0.0", "::", "10.0.0.1", "example.org")] == [
        *(True, True, True),
        *(False, False, False, False),
    ]


# The server


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    server = Served(made_up_folder(tmp_path / "dir", 60))
    server.wait_for(60)
    yield server
    server.close()


def test_ten_pages_get_what_is_new_and_a_page_that_was_away_gets_what_it_missed(served: Served) -> None:
    first = served.state()
    assert first["whole"] and len(first["records"]) == 60
    served.tell(*(decision(61, f"Sentence {n}.") for n in range(5)))
    pages = [served.state(first["place"]) for _ in range(10)]  # the first of them waits for it
    for page in pages:
        assert [event["sentence"] for event in page["events"]] == [f"Sentence {n}." for n in range(5)]
        assert not page["whole"] and page["records"] == page["estimates"]["rows"] == page["over_time"]["rows"] == []
    served.tell({**made_up(60)[-2], "sequence": 62, "id": "p62"})
    newer, back = served.state(pages[0]["place"]), served.state(first["place"])
    assert [record["id"] for record in newer["records"]] == ["p62"] and newer["events"] == []
    assert [record["id"] for record in back["records"]] == ["p62"] and back["events"] == pages[0]["events"]
    assert len(newer["over_time"]["rows"]) == 1 and newer["last"]["id"] == "p62"


def test_a_page_that_knew_another_watcher_or_recalibration_begins_anew(served: Served) -> None:
    known = served.state()["place"]
    run = known.split("-")[0]
    for place in ("", "nonsense", "other-5", f"{run}-{'9' * 20}", f"{run}-\u00b2", f"{run}-"):
        assert served.state(place)["whole"], place
    served.tell({**made_up(1)[0], "sequence": 61})
    anew = served.state(known)
    assert anew["whole"] and anew["records"] == []


def test_a_page_that_nothing_is_new_to_is_answered_all_the_same(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("armcal_online.watch.server._NEWS_S", 0.1)
    known = served.state()
    idle = served.state(known["place"])
    assert not idle["whole"] and idle["records"] == [] and idle["place"] == known["place"]


class Trickle:
    """Connections that send a byte of a request now and then, and never its end."""

    def __init__(self, served: Served, count: int) -> None:
        self.sockets = [socket.create_connection(("127.0.0.1", served.server.server_port)) for _ in range(count)]
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self) -> None:
        while not self._stop.wait(0.02):
            for one in self.sockets:
                with suppress(OSError):
                    one.send(b"G" * 2)

    def close(self) -> None:
        self._stop.set()
        self._thread.join()
        for one in self.sockets:
            one.close()


def _until(holds: Callable[[], bool], seconds: float = 15.0) -> bool:
    deadline = time.monotonic() + seconds
    while not holds() and time.monotonic() < deadline:
        time.sleep(0.01)
    return holds()


@pytest.mark.slow
def test_connections_that_trickle_bytes_shut_nobody_out(served: Served) -> None:
    """All places are taken by requests without an end, again and again."""
    trickles = []
    try:
        for _ in range(2):
            trickles.append(Trickle(served, MOST_CONNECTIONS + 5))
            assert _until(lambda: len(served.server.due) == MOST_CONNECTIONS)
            assert [served.ask(path)[0] for path in ("/", "/state")] == [200, 200]
    finally:
        for trickle in trickles:
            trickle.close()


def test_a_request_has_to_be_whole_in_its_time_however_often_a_byte_comes(tmp_path: Path) -> None:
    served = Served(made_up_folder(tmp_path / "dir", 5), patience=0.3)
    trickle = Trickle(served, 3)
    try:
        assert _until(lambda: len(served.server.due) == 3) and _until(lambda: not served.server.due)
        assert served.ask("/")[0] == 200
    finally:
        trickle.close()
        served.close()


@pytest.mark.slow
def test_a_client_that_does_not_read_is_dropped(tmp_path: Path) -> None:
    served = Served(made_up_folder(tmp_path / "dir", 3000), patience=1.0)
    try:
        served.wait_for(3000)
        stalled = socket.socket()
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.connect(("127.0.0.1", served.server.server_port))
        stalled.sendall(b"GET /state HTTP/1.1\r\nHost: localhost\r\n\r\n")
        assert _until(lambda: len(served.server.due) == 1) and _until(lambda: not served.server.due)
        stalled.close()
    finally:
        served.close()


def test_only_two_addresses_are_answered_and_nothing_can_be_written(served: Served) -> None:
    assert [served.ask(path)[0] for path in ("/", "/state", "/events", "/../etc/passwd", "/page.css")] == [
        *(200, 200),
        *(404, 404, 404),
    ]
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        assert served.ask("/state", method)[0] == 501
    for path in ("/", "/state"):
        assert served.ask(path, host="rebound.example")[0] == 403
    assert served.ask("/state", host="localhost:9")[0] == 200
    _, answer, body = served.ask("/state", **{"Accept-Encoding": "gzip"})
    assert answer.headers["Content-Encoding"] == "gzip" and body[:2] == b"\x1f\x8b"


def test_beyond_this_machine_every_address_needs_the_token(tmp_path: Path) -> None:
    served = Served(made_up_folder(tmp_path / "dir", 5), "0.0.0.0")
    try:
        token = served.server.access.token
        assert token and served.server.address.endswith(f"/?token={token}")
        for path in ("/", "/state"):
            assert served.ask(path)[0] == 403
            assert served.ask(f"{path}?token=wrong")[0] == 403
        assert served.ask(f"/state?token={token}")[0] == 200
    finally:
        served.close()


def test_an_address_that_is_taken_is_told(served: Served) -> None:
    with pytest.raises(InputError, match="another --port"):
        WatchServer(Feed(served.folder), "127.0.0.1", served.server.server_port)
    with pytest.raises(InputError, match="cannot be listened on"):
        WatchServer(Feed(served.folder), "no.such.host.invalid", 0)


def test_broken_requests_do_not_end_the_server(served: Served) -> None:
    for raw in (b"\r\n\r\n", b"GET\r\n\r\n", b"GET / HTTP/9.9\r\n\r\n", b"\x16\x03\x01" * 50, b"GET /" + b"a" * 70_000):
        with socket.create_connection(("127.0.0.1", served.server.server_port), timeout=5) as client:
            client.sendall(raw)
            client.shutdown(socket.SHUT_WR)
            try:
                while client.recv(65536):
                    pass
            except ConnectionResetError:
                pass
    assert served.ask("/")[0] == 200
