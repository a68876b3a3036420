"""The control socket: what it answers, whom it lets in, and that nobody can hold up a recalibration by it."""

from __future__ import annotations

import json
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from armcal.cli.main import cli
from armcal.errors import InputError
from armcal.io.json_server import MOST_CLIENTS, JsonServer
from armcal_online.commands import ask
from armcal_online.decisions import SOCKET
from armcal_online.loop import BUSY, Recalibration
from click.testing import CliRunner


def echo(content: Mapping[str, Any]) -> Mapping[str, Any]:
    if content["command"] == "rollback":
        raise InputError("the journal does not reach there.", hint="Give a later one.")
    return {"ok": True, "asked": dict(content)}


def control_server(folder: Path, answer: Callable[[Any], Mapping[str, Any]] = echo) -> JsonServer:
    return JsonServer.at(folder / SOCKET, *BUSY, answer)


@contextmanager
def serving(folder: Path, answer: Callable[[Mapping[str, Any]], Mapping[str, Any]] = echo) -> Iterator[JsonServer]:
    """A server in a thread of its own, as the loop would call it."""
    server, ends = control_server(folder, answer), threading.Event()

    def loop() -> None:
        while not ends.is_set():
            server.serve()
            time.sleep(0.002)
        server.close()

    thread = threading.Thread(target=loop)
    thread.start()
    try:
        yield server
    finally:
        ends.set()
        thread.join()


def raw(folder: Path, data: bytes) -> list[dict[str, Any]]:
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(5.0)
        connection.connect(str(folder / SOCKET))
        connection.sendall(data)
        connection.shutdown(socket.SHUT_WR)
        with connection.makefile("rb") as replies:
            return [json.loads(line) for line in replies]


def test_a_request_is_answered_and_an_error_is_told(tmp_path: Path) -> None:
    with serving(tmp_path):
        assert (tmp_path / SOCKET).stat().st_mode & 0o777 == 0o600
        assert ask(tmp_path, {"command": "status"}) == {"ok": True, "asked": {"command": "status"}}
        told = ask(tmp_path, {"command": "rollback", "to": 3})
        assert told == {"ok": False, "error": "the journal does not reach there. Give a later one."}
    assert not (tmp_path / SOCKET).exists()


@pytest.mark.parametrize(
    "data",
    [b"{\n", b"\xff\n", b"[]\n", b"7\n", b"{}\n", b"[" * 9000 + b"\n"],
)
def test_what_is_not_understood_gets_an_error(tmp_path: Path, data: bytes) -> None:
    with serving(tmp_path):
        (told,) = raw(tmp_path, data)
        assert told["ok"] is False and told["error"]
        assert ask(tmp_path, {"command": "status"})["ok"]


@pytest.mark.parametrize("command", ["reboot", ["pause"], None])
def test_a_command_that_is_none_is_refused(command: Any) -> None:
    with pytest.raises(InputError, match="expected one of status, pause"):
        Recalibration.answer(None, {"command": command})  # type: ignore[arg-type]


def test_several_requests_in_one_go_and_one_in_pieces(tmp_path: Path) -> None:
    line = json.dumps({"command": "status"}).encode() + b"\n"
    with serving(tmp_path):
        assert [told["ok"] for told in raw(tmp_path, line * 3 + b"{\n" + line)] == [True, True, True, False, True]
        with socket.socket(socket.AF_UNIX) as connection:
            connection.connect(str(tmp_path / SOCKET))
            for i in range(len(line)):
                connection.sendall(line[i : i + 1])
                time.sleep(0.001)
            assert json.loads(connection.recv(4096))["ok"]


def test_a_request_without_an_end_is_refused_and_many_clients_do_no_harm(tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        (told,) = raw(tmp_path, b"x" * 70_000)
        assert "64 KiB" in told["error"]
        clients: list[socket.socket] = []
        for _ in range(MOST_CLIENTS + 4):
            connection = socket.socket(socket.AF_UNIX)
            connection.connect(str(tmp_path / SOCKET))
            connection.settimeout(5.0)
            clients.append(connection)
        with clients[-1].makefile("rb") as said:  # one too many is told so
            assert "64 clients are connected" in json.loads(said.readline())["error"]
            assert said.read() == b""
        clients[0].sendall(b'{"command": "status"}\n')
        assert b"status" in clients[0].recv(4096)
        for connection in clients:
            connection.close()
        while server.clients:
            time.sleep(0.01)
        assert ask(tmp_path, {"command": "status"})["ok"]


def test_a_client_that_asks_on_and_never_reads_holds_nobody_up(tmp_path: Path) -> None:
    line = json.dumps({"command": "status", "filler": "x" * 20_000}).encode() + b"\n"
    with serving(tmp_path), socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(0.2)
        connection.connect(str(tmp_path / SOCKET))
        with pytest.raises(TimeoutError):  # it is not read from any more
            for _ in range(10_000):
                connection.sendall(line)
        assert ask(tmp_path, {"command": "status"})["ok"]


def test_a_stale_socket_is_replaced_a_live_one_and_a_file_are_not(tmp_path: Path) -> None:
    stale = socket.socket(socket.AF_UNIX)
    stale.bind(str(tmp_path / SOCKET))
    stale.close()
    with pytest.raises(InputError, match="no recalibration answers here"):
        ask(tmp_path, {"command": "status"})
    with serving(tmp_path), pytest.raises(InputError, match="is running here"):
        control_server(tmp_path, echo)
    (tmp_path / SOCKET).write_text("mine")
    with pytest.raises(InputError, match="not a socket"):
        control_server(tmp_path, echo)
    assert (tmp_path / SOCKET).read_text() == "mine"


def test_a_folder_with_a_long_name_is_served_too(tmp_path: Path) -> None:
    folder = tmp_path / ("a" * 120) / ("b" * 120)
    folder.mkdir(parents=True)
    before = [*Path("/proc/self/fd").iterdir()]
    with serving(folder):
        assert ask(folder, {"command": "status"})["ok"]
        with pytest.raises(InputError, match="is running here"):
            control_server(folder, echo)
    assert len([*Path("/proc/self/fd").iterdir()]) == len(before)


def test_nobody_there_and_nobody_answering(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"control\.sock: no recalibration answers here"):
        ask(tmp_path, {"command": "status"})
    server = control_server(tmp_path, echo)
    with pytest.raises(InputError, match="no answer within"):
        ask(tmp_path, {"command": "status"}, 0.1)
    server.close()


def test_the_command_asks_and_tells(tmp_path: Path) -> None:
    def armcal(*arguments: str) -> Any:
        return CliRunner().invoke(cli, ["control", str(tmp_path), *arguments])

    with serving(tmp_path):
        told = json.loads(armcal("status").stdout)
        assert told == {"schema_version": 1, "asked": {"command": "status"}}
        assert armcal("pause", "-q").output == ""
        refused = armcal("rollback", "7")
        assert refused.exit_code == 2 and "does not reach there. Give a later one." in refused.output
        for wrong in (["rollback"], ["rollback", "x"], ["pause", "3"], ["reboot"]):
            assert armcal(*wrong).exit_code == 2, wrong
    gone = armcal("status")
    assert gone.exit_code == 2 and "armcal recalibrate" in gone.output
    (tmp_path / "status.json").write_text('{"level": "watch", "finished": true}\n')
    ended = armcal("status")
    assert json.loads(ended.stdout)["level"] == "watch" and "no recalibration runs here" in ended.stderr
    (tmp_path / "status.json").write_text("half of")
    assert armcal("status").exit_code == 2
