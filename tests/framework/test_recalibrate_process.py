"""A recalibration as a process: killed at any moment, told things by signals, its output closed, its disk full."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from armcal.cli.main import cli
from armcal.io.json_server import JsonClient
from armcal_online.commands import ask
from armcal_online.decisions import SOCKET
from click.testing import CliRunner
from fake_recalibrator import row
from recalibrations import (
    events,
    kinds,
    replayed,
    table,
    taken,
)

TESTS = Path(__file__).resolve().parents[1]


def process(folder: Path, source: str, at_end: str = "stop", **given: Any) -> subprocess.Popen[bytes]:
    command = [sys.executable, str(TESTS / "fake_recalibrator.py"), str(folder), source, at_end]
    return subprocess.Popen(command, **{"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE, **given})


def wait_for(folder: Path, what: str, timeout_s: float = 20.0) -> None:
    ends = time.monotonic() + timeout_s
    while time.monotonic() < ends:
        path = folder / "events.jsonl"
        if path.exists() and what in path.read_text():
            return
        time.sleep(0.01)
    raise AssertionError(f"{what} did not come")


@pytest.mark.slow
def test_a_closed_standard_output_does_not_stop_it(tmp_path: Path) -> None:
    (tmp_path / "poses.csv").write_text(table(300))
    going = process(tmp_path / "out", str(tmp_path / "poses.csv"), stdout=subprocess.PIPE)
    assert going.stdout is not None and going.stderr is not None
    going.stdout.readline()
    going.stdout.close()
    assert (going.wait(60), going.stderr.read()) == (0, b"")
    assert kinds(tmp_path / "out")[-1] == "finished" and len(taken(tmp_path / "out")) == 300


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
@pytest.mark.slow
def test_signals_and_control_of_a_running_process(tmp_path: Path, number: signal.Signals) -> None:
    folder = tmp_path / "out"
    (tmp_path / "poses.csv").write_text(table(30))
    going = process(folder, str(tmp_path / "poses.csv"), "wait")
    wait_for(folder, '"p30"')
    assert ask(folder, {"command": "status"})["records"] == 30
    assert ask(folder, {"command": "pause"})["paused"] is True
    with (tmp_path / "poses.csv").open("a") as file:
        file.write(f"{row(31)}\n")
    target = next(e["sequence"] for e in events(folder) if e.get("id") == "p7")
    assert ask(folder, {"command": "rollback", "to": target})["count"] == 7
    assert ask(folder, {"command": "rollback", "to": "p7"})["to"] == target
    assert "found no record 'p99'" in ask(folder, {"command": "rollback", "to": "p99"})["error"]
    assert "expected a sequence number" in ask(folder, {"command": "rollback"})["error"]
    assert ask(folder, {"command": "resume"})["ok"]
    wait_for(folder, '"p31"')
    going.send_signal(number)
    assert going.wait(20) == 0
    assert "asked to finish by a signal" in events(folder)[-1]["sentence"]
    assert json.loads((folder / "calibration.yaml").read_text())["count"] == 7, (
        "what a pipe gave meanwhile is passed over"
    )
    assert replayed(folder).calibration_text() == (folder / "calibration.yaml").read_text()


def killed(tmp_path: Path, kills: int, rows: int) -> None:
    """Kill many times; then every row was taken once, in order, and a replay gives the calibration that was left."""
    folder, poses = tmp_path / "out", tmp_path / "poses.csv"
    poses.write_text(table(rows))
    command = [sys.executable, str(TESTS / "kill_recalibrations.py"), str(folder), str(poses), str(kills), "7", "0.25"]
    done = subprocess.run(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, timeout=1000, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert taken(folder) == [f"p{i}" for i in range(1, rows + 1)]
    assert replayed(folder).calibration_text() == (folder / "calibration.yaml").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("kills", [50, 200])
def test_kills_lose_nothing_and_repeat_nothing(tmp_path: Path, kills: int) -> None:
    killed(tmp_path, kills, 12 * kills)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [2, pytest.param(5, marks=pytest.mark.slow)])
def test_what_was_acknowledged_to_a_sender_outlasts_kills_and_counts_once(tmp_path: Path, kills: int) -> None:
    folder = tmp_path / "out"
    ends, acknowledged = threading.Event(), []

    def send() -> None:
        number, client = 1, None
        while not ends.is_set():
            record = {"id": f"p{number}", "q1_deg": number, "q2_deg": 2, "x_mm": number / 7, "y_mm": 4, "z_mm": 5}
            try:
                client = client or JsonClient(folder / SOCKET, 5.0)
                reply = client.ask(record)
            except OSError:
                client = None
                time.sleep(0.01)
                continue
            if reply.get("id") == f"p{number}" and "acknowledged" in reply:
                acknowledged.append(reply["id"])
                number += 1

    thread = threading.Thread(target=send)
    thread.start()
    try:
        for kill in range(kills + 1):
            going = process(folder, "socket")
            target = len(acknowledged) + 15
            while len(acknowledged) < target and going.poll() is None:
                time.sleep(0.001)
            if kill < kills:
                going.kill()
                going.wait()
        ends.set()
        thread.join()
        going.send_signal(signal.SIGTERM)
        assert going.wait(20) == 0 and going.stderr is not None and going.stderr.read() == b""
    finally:
        ends.set()
    found = taken(folder)
    assert found[: len(acknowledged)] == acknowledged and len(found) <= len(acknowledged) + 1
    assert len(acknowledged) >= 15 * (kills + 1) and replayed(folder).count == len(found)


@pytest.fixture()
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A disk of 3 MiB."""
    place = tmp_path / "disk"
    place.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", place], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no tmpfs can be mounted here")
    try:
        yield place
    finally:
        subprocess.run(["umount", "-l", place], check=True)


def test_a_full_disk_stops_it_tells_whoever_watches_and_loses_nothing_acknowledged(
    tmp_path: Path, small_disk: Path
) -> None:
    (tmp_path / "poses.csv").write_text(table(20))
    folder, out = small_disk / "out", tmp_path / "stdout"
    with out.open("wb") as stream:
        going = process(folder, str(tmp_path / "poses.csv"), "wait", stdout=stream)
        wait_for(folder, '"p20"')
        with (small_disk / "filler").open("wb", buffering=0) as filler, pytest.raises(OSError):
            while True:
                filler.write(b"x" * 4096)
        (tmp_path / "new").write_text(table(500))
        with (tmp_path / "new").open() as new, (tmp_path / "poses.csv").open("a") as file:
            file.writelines([*new][21:])
        assert going.wait(60) == 1
    assert going.stderr is not None and b"no room for an entry" in going.stderr.read()
    acknowledged = [json.loads(line) for line in out.read_text().splitlines()]
    found = taken(folder)
    assert found[:20] == [f"p{i}" for i in range(1, 21)] and len(found) < 500
    assert [event["id"] for event in acknowledged if event["event"] == "record"] == found
    assert json.loads((folder / "calibration.yaml").read_text())["count"] == len(found)
    told = CliRunner().invoke(cli, ["watch", str(folder), "--once"]).output
    for words in ("not running", "no room for an entry", "Make room on the disk", "Start the recalibration again"):
        assert words in told, words
    assert "Go on." not in told
    (small_disk / "filler").unlink()
    going = process(folder, str(tmp_path / "poses.csv"), "stop")
    assert going.wait(60) == 0 and taken(folder) == [f"p{i}" for i in range(1, 501)]
