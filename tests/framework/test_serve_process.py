"""The server as a process: new calibrations under load, many clients and targets, files that must not be taken."""

from __future__ import annotations

import contextlib
import json
import os
import random
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.functions.compiler import find_compiler
from armcal.io.json_server import JsonClient
from click.testing import CliRunner
from serving import LONG_S, Running, command, foreign, put, serving, sha256, variant

HALF = "a: [\n"
POSTURES = np.random.default_rng(0).uniform(-80, 80, (40, 6))


@pytest.fixture(scope="module")
def text(demo_calibration: Path) -> str:
    return demo_calibration.read_text()


@pytest.fixture
def path(tmp_path: Path, text: str) -> Path:
    (tmp_path / "calibration.yaml").write_text(text)
    return tmp_path / "calibration.yaml"


class Asking(threading.Thread):
    """A client that asks and asks, and keeps what it was told; once it is to end it asks a last time."""

    def __init__(self, running: Running, number: int) -> None:
        super().__init__()
        self.running, self.number = running, number
        self.ends = threading.Event()
        self.told: list[tuple[int, dict[str, Any]]] = []
        self.fault: BaseException | None = None

    def run(self) -> None:
        try:
            with JsonClient(self.running.socket, LONG_S) as client:
                at, last = self.number, False
                while not last:
                    last = self.ends.is_set()
                    row = at % len(POSTURES)
                    answer = client.ask({"id": at, "do": "forward", "joint_angles_deg": POSTURES[row].tolist()})
                    assert answer["ok"] and answer["id"] == at, answer
                    self.told.append((row, answer))
                    at += 1
                    time.sleep(0.04)
        except BaseException as fault:
            self.fault = fault


@pytest.fixture
def clients() -> Iterator[list[Asking]]:
    found: list[Asking] = []
    yield found
    for each in found:
        each.ends.set()
    for each in found:
        each.join(LONG_S)


def taken(running: Running, text: str) -> dict[str, Any]:
    return running.until(lambda status: status["calibration"]["sha256"] == sha256(text))


@pytest.mark.slow
def test_a_calibration_is_replaced_under_load(path: Path, text: str, clients: list[Asking], tmp_path: Path) -> None:
    texts = [text, variant(text, 1)]
    with serving(path) as running:
        asked_by(clients, running)
        put(path, texts[1])
        assert taken(running, texts[1])["calibration"]["sequence"] == 2
        ended(clients)
    check_answers(clients, texts, tmp_path)


def asked_by(clients: list[Asking], running: Running) -> None:
    """Four clients, all of whom have an answer."""
    clients += [Asking(running, number) for number in range(4)]
    for client in clients:
        client.start()
    while not all(client.told or client.fault for client in clients):
        time.sleep(0.05)


def ended(clients: list[Asking]) -> None:
    for client in clients:
        client.ends.set()
    for client in clients:
        client.join(LONG_S)
    assert [client.fault for client in clients] == [None] * 4


@pytest.mark.slow
def test_calibrations_are_replaced_under_load_and_only_whole_ones(
    path: Path, text: str, clients: list[Asking], tmp_path: Path
) -> None:
    texts = [text, *(variant(text, i) for i in (1, 2))]
    with serving(path) as running:
        asked_by(clients, running)
        put(path, texts[1])
        assert taken(running, texts[1])["calibration"]["sequence"] == 2

        put(path, foreign(text))
        refused = running.until(lambda status: status["file"]["state"] == "refused")
        assert "another arm" in refused["file"]["why"] and refused["calibration"]["sequence"] == 2
        half = variant(text, 9)[:-100]
        with path.open("w") as file:
            for at in range(0, len(half), len(half) // 4):
                file.write(half[at : at + len(half) // 4])
                file.flush()
                time.sleep(0.3)
            running.until(
                lambda status: status["file"]["state"] == "refused" and "another arm" not in status["file"]["why"]
            )
        put(path, texts[2])
        assert taken(running, texts[2])["calibration"]["sequence"] == 3
        ended(clients)
    check_answers(clients, texts, tmp_path)


def check_answers(clients: list[Asking], texts: list[str], folder: Path) -> None:
    """Each is by exactly the calibration that it names, which never goes back for a client."""
    expected = {}
    for each in texts:
        (folder / "known.yaml").write_text(each)
        expected[sha256(each)] = Calibration.load(folder / "known.yaml").forward(np.deg2rad(POSTURES))[:, :3, 3] * 1000
    seen = set()
    for client in clients:
        sequences = [answer["calibration"]["sequence"] for _, answer in client.told]
        assert sequences == sorted(sequences)
        for row, answer in client.told:
            name = answer["calibration"]["sha256"]
            seen.add(name)
            assert answer["tools"][0]["position_mm"] == pytest.approx(expected[name][row], abs=1e-6)
        # The status named the last one before they asked a last time.
        assert name == sha256(texts[-1])
    # One that is followed by the next before it is ready may never answer; the first and the last do.
    assert {sha256(texts[0]), sha256(texts[-1])} <= seen <= set(expected)


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="there is no C compiler")
def test_many_targets_and_sixty_idle_clients_hold_nobody_up(path: Path) -> None:
    request = {"do": "forward", "joint_angles_deg": POSTURES[0].tolist()}
    with serving(path, "--evaluator", "compiled") as running, contextlib.ExitStack() as opened:
        tools = running.ask(do="forward", joint_angles_deg=np.tile(POSTURES, (25, 1)).tolist())["tools"]
        assert len(tools) == 1000
        idle = [opened.enter_context(JsonClient(running.socket, LONG_S)) for _ in range(60)]
        assert all(client.ask(request)["ok"] for client in idle)
        asking = opened.enter_context(JsonClient(running.socket, LONG_S))
        answers: list[dict[str, Any]] = []
        many = {"do": "compensate", "targets": tools, "start_deg": POSTURES[0].tolist()}
        thread = threading.Thread(target=lambda: answers.append(running.ask(**many)))
        thread.start()
        beside = []
        while thread.is_alive():
            beside.append(asking.ask(request))
        thread.join()
        assert len(answers[0]["commands"]) == 1000 and all(answer["ok"] for answer in beside)
        assert len(beside) > 100  # between its slices; one or two if it were answered in one go
        assert all(client.ask(request)["ok"] for client in idle)
        assert running.status()["clients"] >= 61
        second = subprocess.run(
            command(path, "--socket", str(running.socket)), capture_output=True, text=True, timeout=LONG_S, check=False
        )
        assert second.returncode == 2 and "a server is running here" in second.stderr


@pytest.mark.slow
def test_nonsense_by_standard_input_is_answered_line_by_line_to_the_end(path: Path) -> None:
    chance = random.Random(11)
    whole = {"do": "forward", "joint_angles_deg": [0] * 6}
    lines = [json.dumps({"id": "first", **whole}).encode(), b'{"id": 2, "do": "status"}']
    for _ in range(2000):
        line = bytearray(lines[0])
        for _ in range(chance.randint(1, 5)):
            line[chance.randrange(len(line))] = chance.randrange(256)
        lines.append(bytes(line).replace(b"\n", b"\x00"))
    lines += [b"[" * 100_000, b'{"a":' * 40_000, b"\xff\xfe\x00", os.urandom(10_000_000).replace(b"\n", b"")]
    lines.append(json.dumps({"id": "last", **whole}).encode())  # without an end
    done = subprocess.run(command(path), input=b"\n".join(lines), capture_output=True, timeout=LONG_S, check=False)
    assert done.returncode == 0
    assert done.stderr.decode().splitlines() == [f"armcal serve: ready: {path} by standard input"]
    answers = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(answers) == len(lines)
    assert (answers[0]["id"], answers[1]["id"], answers[-1]["id"]) == ("first", 2, "last")
    assert answers[0]["tools"] == answers[-1]["tools"]
    assert all(answer["ok"] or answer["error"] for answer in answers)
    assert "256 KiB" in answers[-2]["error"]


@pytest.mark.quick("None-no such file", "\\xff\\xfe\\n-not UTF-8")
@pytest.mark.parametrize(
    ("content", "says"),
    [
        (None, "no such file"),
        (b"", "the file is empty"),
        (b"\xff\xfe\n", "not UTF-8"),
        (f"{HALF}# sha256 of the lines above: {sha256(HALF)}\n".encode(), "not valid YAML"),
        (f"{HALF}# sha256 of the lines above: {sha256('other')}\n".encode(), "edited or damaged"),
    ],
)
def test_what_is_no_calibration_is_refused_at_the_start(tmp_path: Path, content: bytes | None, says: str) -> None:
    path = tmp_path / "calibration.yaml"
    if content is not None:
        path.write_bytes(content)
    result = CliRunner().invoke(cli, ["serve", str(path), "--socket", str(tmp_path / "s.sock")])
    assert result.exit_code == 2
    assert says in result.output and str(path) in result.output
    assert "Traceback" not in result.output
    assert not (tmp_path / "s.sock").exists()
