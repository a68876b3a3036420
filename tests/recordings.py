"""Guided arms for tests of ``armcal record``: a sender of joint readings, and the command as a process."""

from __future__ import annotations

import csv
import json
import os
import queue
import random
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DEMO = ROOT / "configs" / "ball" / "demo.yaml"
QUICK = ("--set", "bench.recording={window_s: 0.1, stale_s: 0.5}")


def postures() -> list[dict[str, str]]:
    """The shipped recording's rows."""
    with DEMO.with_name("demo.csv").open() as file:
        return list(csv.DictReader(file))


def angles_of(row: Mapping[str, str]) -> dict[str, float]:
    return {key: float(value) for key, value in row.items() if key.startswith("j")}


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


class GuidedArm:
    """Sends joint readings over UDP until it is closed; ``stand`` puts the arm somewhere, at once."""

    def __init__(self, noise_deg: float = 0.003) -> None:
        self.port = free_port()
        self._noise, self._random = noise_deg, random.Random(3)
        self._message: dict[str, Any] = {}
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    @property
    def source(self) -> str:
        return f"udp:{self.port}"

    def stand(self, angles: Mapping[str, float], **more: Any) -> None:
        """And wait until the recorder's window holds nothing else."""
        self._message = {**angles, **more}
        time.sleep(0.2)

    def silent(self) -> None:
        self._message = {}

    def close(self) -> None:
        self._ends.set()
        self._thread.join()

    def _send(self) -> None:
        began = time.monotonic()
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not self._ends.wait(0.005):
                message = dict(self._message)
                if message:
                    noisy = {
                        k: v + self._random.gauss(0, self._noise) if isinstance(v, float) else v
                        for k, v in message.items()
                    }
                    sender.sendto(
                        json.dumps({**noisy, "time_s": time.monotonic() - began}).encode(), ("127.0.0.1", self.port)
                    )


class Recording:
    """``armcal record --json`` as a process, its commands as lines."""

    def __init__(self, out: Path, source: str, *more: str, config: Path = DEMO) -> None:
        command = [sys.executable, "-m", "armcal.cli", "record", str(config), "--out", str(out), "--from", source]
        self.process = subprocess.Popen(
            [*command, "--json", *more],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            cwd=ROOT,
            env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
        )
        self._events: queue.Queue[dict[str, Any]] = queue.Queue()
        threading.Thread(target=self._listen, daemon=True).start()

    def type(self, line: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(line + "\n")
        self.process.stdin.flush()

    def told(self, *kinds: str, timeout_s: float = 30.0) -> dict[str, Any]:
        """The next event of some kinds; others are passed over."""
        ends = time.monotonic() + timeout_s
        while time.monotonic() < ends:
            try:
                event = self._events.get(timeout=0.2)
            except queue.Empty:
                if self.process.poll() is not None:
                    break
                continue
            if event["event"] in kinds:
                return event
        if self.process.poll() is not None:
            raise AssertionError(f"it ended: {self.process.stderr.read() if self.process.stderr else ''}")
        raise AssertionError(f"none of {kinds} came")

    def ready(self) -> None:
        """Wait until it answers."""
        self.type("s")
        self.told("status")

    def capture(self) -> dict[str, Any]:
        """Captured or refused."""
        self.type("c")
        return self.told("captured", "refused")

    def finish(self) -> int:
        self.type("q")
        return self.process.wait(30)

    def close(self) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()

    def _listen(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._events.put(json.loads(line))


def recorded(out: Path) -> list[dict[str, str]]:
    """The rows of its dataset."""
    with (out / "dataset.csv").open() as file:
        return list(csv.DictReader(file))


def still_lines(rows: list[dict[str, str]], noise_deg: float = 0.003, seed: int = 1) -> str:
    """JSON lines of an arm that rests at each row and moves on, 50 readings a second, with labels."""
    source, lines, at, before = random.Random(seed), [], 0.0, None
    for row in rows:
        here, labels = angles_of(row), {"position": row["position"], "socket": row["socket"]}
        way = [{k: before[k] + (here[k] - before[k]) * i / 11 for k in here} for i in range(1, 11)] if before else []
        rest = [{k: v + source.gauss(0, noise_deg) for k, v in here.items()} for _ in range(56)]
        for reading in (*way, *rest):
            at += 0.02
            lines.append(json.dumps({**reading, **labels, "time_s": at}))
        before = here
    return "\n".join(lines) + "\n"


def command(*arguments: object, given: str | None = None) -> subprocess.CompletedProcess[str]:
    """An armcal command, to its end."""
    line = [sys.executable, "-m", "armcal.cli", *map(str, arguments)]
    return subprocess.run(line, input=given, capture_output=True, text=True, check=False, cwd=ROOT, timeout=120)
