"""Calibrations to be served, variants of them, and a server as a process."""

from __future__ import annotations

import hashlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml
from armcal.calibration.calibration_file import identity_of, sealed
from armcal.io.json_server import JsonClient
from armcal_serve.answers import Answerer
from armcal_serve.loading import Loader

ROOT = Path(__file__).resolve().parents[1]
LONG_S = 120.0


def variant(text: str, number: int) -> str:
    """Another calibration of the same arm: its base stands some mm higher, and it was made at another time."""
    changed, found = re.subn(
        r"(name: arm\.mdh\.base_z\n(?:  .*\n)*?  value: )(\S+)",
        lambda m: f"{m[1]}{float(m[2]) + 0.01 * number!r}",
        text,
    )
    assert found == 1
    return sealed(yaml.safe_load(changed.replace("experiment: ", f"experiment: variant {number} of ", 1)))


def foreign(text: str) -> str:
    """A calibration that is whole, and of another arm."""
    content = yaml.safe_load(text)
    content["arms"]["arm"]["model"]["rows"][0]["d_m"] += 0.001
    return described(content)


def described(content: dict[str, Any]) -> str:
    """A calibration whose arm or statics were changed."""
    content["identity"]["arm"] = identity_of({key: content[key] for key in ("arms", "measurements", "statics")})
    return sealed({**content, "checks": None})


def sha256(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


def made(text: str, shown: str = "c.yaml", **order: Any) -> Answerer:
    """What answers by a calibration's text, in this process."""
    return loaded(Loader(shown, **{"evaluator": "interpreted", **order}), text)


def loaded(loader: Loader, text: str) -> Answerer:
    return loader.load(text.encode())[0]


def ask(answerer: Answerer, **request: Any) -> dict[str, Any]:
    """The answer to a request."""
    return dict(json.loads(answered(answerer, json.dumps(request).encode())))


def answered(answerer: Answerer, line: bytes) -> bytes:
    *slices, answer = answerer.begin(line, 0.0)
    assert not any(slices) and answer is not None
    return answer


def told(answerer: Answerer, **request: Any) -> dict[str, Any]:
    """The answer to a request that is not refused."""
    answer = ask(answerer, **request)
    assert answer["ok"], answer
    return answer


def put(path: Path, text: str) -> None:
    """As recalibrations publish: written aside, then renamed."""
    beside = path.with_name(".next")
    beside.write_text(text)
    os.replace(beside, path)


@dataclass
class Running:
    """A server as a process."""

    process: subprocess.Popen[str]
    socket: Path
    said: Path

    def ask(self, **request: Any) -> dict[str, Any]:
        with JsonClient(self.socket, LONG_S) as client:
            return client.ask(request)

    def status(self) -> dict[str, Any]:
        return self.ask(do="status")

    def until(self, holds: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The first status of which something holds."""
        ends = time.monotonic() + LONG_S
        while time.monotonic() < ends:
            status = self.status()
            if holds(status):
                return status
            time.sleep(0.05)
        raise AssertionError(f"never: {status}")


def command(path: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "armcal.cli", "serve", str(path), "--evaluator", "interpreted", *arguments]


@contextmanager
def serving(path: Path, *arguments: str) -> Iterator[Running]:
    """A server that is ready; it has to end well when it is told to."""
    socket, said = path.parent / "serve.sock", path.parent / "said.jsonl"
    with said.open("w") as told:
        process = subprocess.Popen(
            command(path, "--socket", str(socket), "--json", *arguments),
            stderr=told,
            stdin=subprocess.DEVNULL,
            text=True,
        )
    running = Running(process, socket, said)
    try:
        ends = time.monotonic() + LONG_S
        while '"ready"' not in said.read_text():
            assert process.poll() is None and time.monotonic() < ends, said.read_text()
            time.sleep(0.05)
        yield running
        process.send_signal(signal.SIGTERM)
        assert process.wait(LONG_S) == 0
        assert not socket.exists()
        events = [json.loads(line) for line in said.read_text().splitlines()]  # and no traceback
        assert all("event" in event for event in events)
    finally:
        process.kill()
        process.wait()
