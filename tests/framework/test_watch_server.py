"""Who may look at a recalibration, the stream of events, and bad clients."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from armcal.errors import InputError
from armcal_online.watch.feed import Feed
from armcal_online.watch.server import MOST_STREAMS, Access, WatchServer, is_loopback
from watching import Served, Stream, decision, made_up_folder

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


def test_ten_pages_hear_of_an_event_and_a_page_that_was_away_hears_what_it_missed(served: Served) -> None:
    after = served.state()["after"]
    streams = [Stream(served, after) for _ in range(10)]
    served.tell(*(decision(61 + n, f"Sentence {n}.") for n in range(5)))
    heard = [stream.messages(5) for stream in streams]
    assert all(each == heard[0] for each in heard)
    assert [message["sentence"] for _, message in heard[0]] == [f"Sentence {n}." for n in range(5)]
    back = Stream(served, after, last_event_id=heard[0][1][0])  # the newer of the two places counts
    assert back.messages(3) == heard[0][2:]
    for stream in [*streams, back]:
        stream.close()


@pytest.mark.slow
def test_a_page_that_missed_too_much_or_knew_another_watcher_begins_anew(served: Served) -> None:
    first = served.state()["after"]
    for place in ("", "nonsense", "other-5", first.split("-")[0] + "-999999999", first.split("-")[0] + "-\u00b2"):
        stream = Stream(served, "" if not place.isascii() else place)
        assert stream.messages(1) == [("reset", {})], place
        stream.close()
    served.tell(*(decision(61, f"Sentence {n}.") for n in range(1500)))
    deadline = time.monotonic() + 10
    while served.state()["after"] == first and time.monotonic() < deadline:
        time.sleep(0.02)
    stream = Stream(served, first)
    assert stream.messages(1) == [("reset", {})]
    stream.close()


@pytest.mark.slow
def test_idle_streams_beat_and_those_that_left_give_their_place_back(served: Served) -> None:
    after = served.state()["after"]
    streams = [Stream(served, after) for _ in range(MOST_STREAMS)]
    assert {stream.status for stream in streams} == {200}
    beat = next(block for block in streams[0].blocks() if "comment" in block)
    assert beat["comment"] == "still there"
    refused = Stream(served, after)
    assert refused.status == 503
    for stream in [*streams, refused]:
        stream.close()
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline:
        late = Stream(served, after)
        late.close()
        if late.status == 200:
            return
        time.sleep(0.1)
    raise AssertionError("no place was given back")


def _free(served: Served) -> int:
    """How many more pages could be open."""
    places = [served.server.streams.acquire(blocking=False) for _ in range(MOST_STREAMS)]
    for _ in filter(None, places):
        served.server.streams.release()
    return sum(places)


@pytest.mark.slow
def test_a_client_that_does_not_read_is_dropped(tmp_path: Path) -> None:
    served = Served(made_up_folder(tmp_path / "dir", 2), patience=0.3)
    try:
        served.wait_for(2)
        stalled = socket.socket()
        stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        stalled.connect(("127.0.0.1", served.server.server_port))
        stalled.sendall(f"GET /events?after={served.state()['after']} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode())
        deadline = time.monotonic() + 15
        while _free(served) == MOST_STREAMS and time.monotonic() < deadline:
            time.sleep(0.01)
        assert _free(served) == MOST_STREAMS - 1
        while _free(served) < MOST_STREAMS and time.monotonic() < deadline:
            served.tell(*(decision(3, "x" * 500) for _ in range(900)))
            time.sleep(0.3)
        assert _free(served) == MOST_STREAMS
        stalled.close()
    finally:
        served.close()


def test_only_three_addresses_are_answered_and_nothing_can_be_written(served: Served) -> None:
    assert [served.ask(path)[0] for path in ("/", "/state", "/x", "/../etc/passwd", "/page.css")] == [
        *(200, 200),
        *(404, 404, 404),
    ]
    for method in ("POST", "PUT", "DELETE", "PATCH", "OPTIONS"):
        assert served.ask("/state", method)[0] == 501
    for path in ("/", "/state", "/events"):
        assert served.ask(path, host="rebound.example")[0] == 403
    assert served.ask("/state", host="localhost:9")[0] == 200
    _, answer, body = served.ask("/state", **{"Accept-Encoding": "gzip"})
    assert answer.headers["Content-Encoding"] == "gzip" and body[:2] == b"\x1f\x8b"


def test_beyond_this_machine_every_address_needs_the_token(tmp_path: Path) -> None:
    served = Served(made_up_folder(tmp_path / "dir", 5), "0.0.0.0")
    try:
        token = served.server.access.token
        assert token and served.server.address.endswith(f"/?token={token}")
        for path in ("/", "/state", "/events"):
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
