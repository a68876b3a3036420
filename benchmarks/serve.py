"""`armcal serve`: how long a client waits for one command, alone, with others, and while calibrations are replaced."""

from __future__ import annotations

import json
import multiprocessing
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from armcal.calibration.calibration import Calibration
from armcal_serve.client import Client

from benchmarks import lrm
from benchmarks.report import Row

NAME = "serve"
LIMIT_MS = 5.0
CLIENTS = 4
SECONDS = 15.0
RATE_HZ = 50.0
POSTURES = 400
"""One every 20 ms on a smooth motion through the arm's range."""


@dataclass(frozen=True)
class Load:
    """What clients do: how many, how often each asks (None: again at once), and whether calibrations are replaced."""

    clients: int
    rate_hz: float | None
    updates: bool = False

    @property
    def words(self) -> str:
        """For the table."""
        asking = "again at once" if self.rate_hz is None else f"at {self.rate_hz:g} Hz"
        updating = ", one new calibration after another" if self.updates else ""
        return f"{self.clients} client{'s' if self.clients > 1 else ''} {asking}{updating}"


LOADS = (Load(1, None), Load(CLIENTS, RATE_HZ), Load(CLIENTS, RATE_HZ, True), Load(CLIENTS, None, True))


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        path = _calibrated(folder)
        requests = _requests(Calibration.load(path))
        with serving(path, folder / "serve.sock") as socket:
            for load in LOADS:
                yield _row(load, *measured(load, socket, path, requests))


def _row(load: Load, waited: Sequence[float], taken: int) -> Row:
    p50, p99, most = (float(v) for v in (*np.percentile(waited, [50, 99]), max(waited)))
    within = 100 * float(np.mean(np.array(waited) * 1e3 <= LIMIT_MS))
    note = (
        f"p99 {p99 * 1e3:.2f} ms, max {most * 1e3:.2f} ms, {within:.2f} % within {LIMIT_MS:g} ms, {len(waited)} asked"
    )
    return Row(NAME, f"{load.words}, p50", p50, "", None, f"{note}, {taken} calibrations" if load.updates else note)


def measured(load: Load, socket: Path, path: Path, requests: Sequence[bytes]) -> tuple[list[float], int]:
    """How long each request waited (s), and by how many calibrations they were answered."""
    context = multiprocessing.get_context("spawn")
    with context.Pool(load.clients) as pool:
        asked = pool.map_async(partial(_client, socket, load.rate_hz, requests, SECONDS), range(load.clients))
        with Client(socket) as client:
            while load.updates and not asked.ready():
                replace_calibration(path)
                before = client.ask({"do": "status"})["calibration"]["sequence"]
                while not asked.ready() and client.ask({"do": "status"})["calibration"]["sequence"] == before:
                    asked.wait(0.2)
        told = asked.get()
    return [wait for waits, _ in told for wait in waits], len(set().union(*(seen for _, seen in told)))


def _client(
    socket: Path, rate_hz: float | None, requests: Sequence[bytes], seconds: float, number: int
) -> tuple[list[float], set[int]]:
    waits, seen = [], set()
    at = number * len(requests) // CLIENTS
    with Client(socket) as client:
        ends = time.perf_counter() + seconds
        due = time.perf_counter()
        while (began := time.perf_counter()) < ends:
            answer = client.ask(json.loads(requests[at % len(requests)]))
            waits.append(time.perf_counter() - began)
            if not (answer["ok"] and answer["commands"][0]["reached"]):
                raise RuntimeError(f"a request was not answered: {answer}")
            seen.add(answer["calibration"]["sequence"])
            at += 1
            if rate_hz is not None:
                due += 1 / rate_hz
                time.sleep(max(due - time.perf_counter(), 0.0))
    return waits, seen


def _requests(calibration: Calibration) -> list[bytes]:
    """Targets on a smooth motion, each asked for from where the arm was before."""
    phase = np.linspace(0, 2 * np.pi, POSTURES, endpoint=False)[:, None]
    postures = 0.8 * np.sin(phase * (1 + np.arange(6) % 3) + 0.4 * np.arange(6)) + 0.2
    tips = calibration.forward(postures)[:, :3, 3]
    befores = np.roll(postures, 1, axis=0)
    return [
        json.dumps({"do": "compensate", "targets": [{"position_m": tip}], "start_rad": before}).encode()
        for tip, before in zip(tips.tolist(), befores.tolist(), strict=True)
    ]


def _calibrated(folder: Path) -> Path:
    command = [sys.executable, "-m", "armcal.cli", "run", str(lrm.CONFIGS / "demo.yaml"), "--out", str(folder / "run")]
    subprocess.run([*command, "--quiet", "--set", "validation.folds=0"], check=True, stdin=subprocess.DEVNULL)
    return folder / "run" / "calibration.yaml"


def replace_calibration(path: Path) -> None:
    """Put another calibration in place: the first parameter a little larger."""
    text = path.read_text(encoding="utf-8")
    found = re.search(r"(?<=\n  value: )\S+", text)
    assert found is not None
    changed = f"{text[: found.start()]}{float(found[0]) + 1e-9!r}{text[found.end() :]}"
    beside = path.with_name("next.yaml")
    beside.write_text(changed, encoding="utf-8")
    os.replace(beside, path)


@contextmanager
def serving(path: Path, socket: Path) -> Iterator[Path]:
    """A server in a process of its own, ready."""
    command = [sys.executable, "-m", "armcal.cli", "serve", str(path), "--socket", str(socket), "--json"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        told: dict[str, Any] = json.loads(process.stderr.readline() or "{}")
        if told.get("event") != "ready":
            raise RuntimeError(f"the server did not start: {told}")
        try:
            yield socket
        finally:
            process.send_signal(signal.SIGTERM)
            process.stderr.read()
