"""`armcal serve`: how long a client waits, alone, with others, and through updates; and how long an update takes."""

from __future__ import annotations

import gc
import json
import multiprocessing
import os
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
import yaml
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.io.json_server import JsonClient

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
        forward, requests = _requests(Calibration.load(path))
        with serving(path, folder / "serve.sock") as socket:
            yield _row(LOADS[0], measured(LOADS[0], socket, path, forward)[0], [], "forward, ")
            for load in LOADS:
                waited, updates = measured(load, socket, path, requests)
                yield _row(load, waited, updates)
                if updates:
                    note = f"longest {max(updates):.2f} s, {len(updates)} calibrations"
                    yield Row(NAME, f"{load.words}: until it is in use, p50", float(np.median(updates)), "", None, note)


def _row(load: Load, waited: Sequence[float], updates: Sequence[float], what: str = "") -> Row:
    p50, p99, most = (float(v) for v in (*np.percentile(waited, [50, 99]), max(waited)))
    within = 100 * float(np.mean(np.array(waited) * 1e3 <= LIMIT_MS))
    note = (
        f"p99 {p99 * 1e3:.2f} ms, max {most * 1e3:.2f} ms, {within:.2f} % within {LIMIT_MS:g} ms, {len(waited)} asked"
    )
    more = f", {len(updates)} calibrations" if load.updates else ""
    return Row(NAME, f"{what}{load.words}, p50", p50, "", None, note + more)


def measured(load: Load, socket: Path, path: Path, requests: Sequence[bytes]) -> tuple[list[float], list[float]]:
    """How long each request waited, and how long each new calibration took until it was answered from (s)."""
    updates: list[float] = []
    context = multiprocessing.get_context("spawn")
    with context.Pool(load.clients) as pool:
        asked = pool.map_async(partial(_client, socket, load.rate_hz, requests, SECONDS), range(load.clients))
        with JsonClient(socket) as client:
            while load.updates and not asked.ready():
                before = client.ask({"do": "status"})["calibration"]["sequence"]
                replace_calibration(path)
                began = time.perf_counter()
                while not asked.ready() and client.ask({"do": "status"})["calibration"]["sequence"] == before:
                    asked.wait(0.05)
                if not asked.ready():
                    updates.append(time.perf_counter() - began)
        told = asked.get()
    return [wait for waits in told for wait in waits], updates


def _client(socket: Path, rate_hz: float | None, requests: Sequence[bytes], seconds: float, number: int) -> list[float]:
    gc.disable()  # a collection of the client's own garbage takes 50 ms, which it would take for waiting
    waits = []
    at = number * len(requests) // CLIENTS
    with JsonClient(socket) as client:
        ends = time.perf_counter() + seconds
        due = time.perf_counter()
        while (began := time.perf_counter()) < ends:
            answer = client.ask(json.loads(requests[at % len(requests)]))
            waits.append(time.perf_counter() - began)
            if not (answer["ok"] and all(command["reached"] for command in answer.get("commands", ()))):
                raise RuntimeError(f"a request was not answered: {answer}")
            at += 1
            if rate_hz is not None:
                due += 1 / rate_hz
                time.sleep(max(due - time.perf_counter(), 0.0))
    return waits


def _requests(calibration: Calibration) -> tuple[list[bytes], list[bytes]]:
    """Postures of a smooth motion; and its targets, each asked for from where the arm was before."""
    phase = np.linspace(0, 2 * np.pi, POSTURES, endpoint=False)[:, None]
    postures = 0.8 * np.sin(phase * (1 + np.arange(6) % 3) + 0.4 * np.arange(6)) + 0.2
    tips = calibration.forward(postures)[:, :3, 3]
    befores = np.roll(postures, 1, axis=0)
    forward = [json.dumps({"do": "forward", "joint_angles_rad": posture}).encode() for posture in postures.tolist()]
    return forward, [
        json.dumps({"do": "compensate", "targets": [{"position_m": tip}], "start_rad": before}).encode()
        for tip, before in zip(tips.tolist(), befores.tolist(), strict=True)
    ]


def _calibrated(folder: Path) -> Path:
    command = [sys.executable, "-m", "armcal.cli", "run", str(lrm.CONFIGS / "demo.yaml"), "--out", str(folder / "run")]
    subprocess.run([*command, "--quiet", "--set", "validation.folds=0"], check=True, stdin=subprocess.DEVNULL)
    return folder / "run" / "calibration.yaml"


def replace_calibration(path: Path) -> None:
    """Put another calibration in place: the first free parameter a little larger."""
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    next(entry for entry in content["parameters"] if entry["free"])["value"] += 1e-9
    beside = path.with_name("next.yaml")
    beside.write_text(sealed(content), encoding="utf-8")
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
