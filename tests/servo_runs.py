"""Servo calibrations against a simulated bench in a process of its own, over its pty and its sockets."""

from __future__ import annotations

import json
import os
import shutil
import signal
import sqlite3
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from armcal.io.journal import JOURNAL, Journal
from armcal.run.experiment import Experiment
from armcal_bench.servo_session import evaluated, measure
from armcal_bench.servo_setup import Record, Setup
from armcal_bench.session import Conversation

from tests.bench_runs import BenchRun, _in_child, _wait, free_port, overrides_for
from tests.servo_fakes import CONFIGS
from tests.simulated_lines.socket_clock import SimulatedClock

JOINTS = ("q3", "q5")
SETS = (
    "bench.servo.joints=[q3, q5]",
    "bench.servo.ranges={q3: [-50 deg, 50 deg], q5: [-50 deg, 50 deg]}",
    "bench.servo.step_deg=46",
    "bench.servo.period_s=0.04",
    "bench.acquisition.lost.park_s=6",
    "bench.servo.sag=model",
)
"""A calibration of a few poses."""
Asked = Callable[[], bool]


def never() -> bool:
    return False


@dataclass
class ServoRun:
    """A bench in a folder, with copies of the LRM arm's files, and a calibration on it."""

    folder: Path
    sets: tuple[str, ...] = SETS

    def __post_init__(self) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        for file in CONFIGS.glob("*.yaml"):
            shutil.copy(file, self.folder)
        port = free_port()
        self.ports = (f"bench.tracker.port={port}", f"bench.simulator.tracker.port={port}")
        self.run = BenchRun(self.folder, (*self.ports, *self.sets), self.folder / "bench.yaml")

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def setup(self, *sets: str) -> Setup:
        """As configured, with more overrides."""
        if not sets:
            return Setup.of(self.run.experiment)
        return Setup.of(
            Experiment.load(self.run.config, (*self.ports, *self.sets, *overrides_for(self.run.bench), *sets))
        )

    def measure(self, asked: Asked = never, wishes: Any = None, setup: Setup | None = None) -> None:
        """Begin or go on; with wishes by somebody's eye."""
        measure(setup or self.setup(), self.out, self.talk(asked, wishes), "automatic" if wishes is None else "guided")

    def talk(self, asked: Asked = never, wishes: Any = None, may: Callable[[Any], bool] = lambda joints: True) -> Any:
        """A conversation."""
        return Conversation(asked, may, lambda *told: None, lambda text: None, lambda: nullcontext(wishes))

    def measure_until_killed(self, sleeps: int) -> bool:
        """In a child that is killed (SIGKILL) when it sleeps for the n-th time; False if it ended before."""
        child = os.fork()
        if child == 0:
            _in_child(lambda: self._deadly(sleeps))
        return os.WIFSIGNALED(_wait(child))

    def _deadly(self, sleeps: int) -> None:
        left, sleep = [sleeps], SimulatedClock.sleep

        def counted(clock: SimulatedClock, seconds: float) -> None:
            left[0] -= 1
            if left[0] <= 0:
                os.kill(os.getpid(), signal.SIGKILL)
            sleep(clock, seconds)

        SimulatedClock.sleep = counted  # type: ignore[method-assign]
        self.measure()

    def pulses(self) -> dict[str, np.ndarray]:
        """Those found (us), by joint."""
        outcome = evaluated(self.setup(), self.out)
        return {joint: 1e6 * np.array(servo.pulses) for joint, servo in outcome.servos.items()}

    def entries(self, kind: str) -> list[Any]:
        """Of the record, of a kind."""
        return [entry for entry in Record(self.out).entries if entry["kind"] == kind]

    def rows(self) -> list[dict[str, Any]]:
        """The record, entry by entry."""
        return [dict(entry) for entry in Record(self.out).entries]


def put_rows(folder: Path, rows: Sequence[Mapping[str, Any]]) -> None:
    """A record of these entries in place of what is there, right or wrong."""
    (folder / JOURNAL).unlink(missing_ok=True)
    with Journal(folder, {}) as journal:
        for _ in rows:
            journal.record("record", 0)
    with sqlite3.connect(folder / JOURNAL) as database:
        for number, row in enumerate(rows, start=1):
            kind = row.get("kind")
            content = {key: value for key, value in row.items() if key != "kind"}
            values = kind if isinstance(kind, str) else json.dumps(kind), json.dumps(content), number
            database.execute("UPDATE entry SET kind = ?, content = ? WHERE sequence = ?", values)
    database.close()
