"""Measuring runs over real ptys and sockets while everything goes wrong that can: the arm is never unsafe."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.devices.device import DeviceLostError, DeviceRefusedError
from armcal.devices.serial_port import SerialPort, SerialPortSettings
from armcal.io.journal import Journal, KeptJournal, has_journal

from tests.bench_runs import BenchRun, positions
from tests.simulated_lines.socket_clock import SimulatedClock

MANY = 200
SECONDS = 28.0
"""What the run takes when nothing goes wrong."""
SERIAL = ("drop", "duplicate", "reorder", "flip", "split")
BOARD = ("unplug", "reset", "brown_out", "nack", "stuck")
KINDS = (*SERIAL, *BOARD, "lost", "silent", "frozen", "second", "asked", "kill")
AGREE_M = 0.0015
"""Backlash of 0.1 deg on either side, at 0.4 m."""


SETS = ("bench.acquisition.lost.park_s=6", "bench.acquisition.period_s=0.04")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> BenchRun:
    return BenchRun(tmp_path_factory.mktemp("bench"), SETS)


@pytest.fixture(scope="module")
def undisturbed(run: BenchRun) -> dict[str, np.ndarray]:
    run.clean()
    with run.simulated() as clock:
        outcome = run.acquire()
        state = clock.ask({"state": True})
    assert outcome.ending.how == "done"
    assert state["offences"] == {} and state["violations"] == 0
    return positions(run.measured())


def faults(random: np.random.Generator, kind: str) -> list[dict[str, Any]]:
    """One trouble as requests to the bench."""
    at = float(random.uniform(3, SECONDS))
    if kind in SERIAL:
        way, unit = random.choice(["to_host", "to_board"]), random.choice(["frames", "bytes"])
        return [{"kind": kind, "at": at, "count": int(random.integers(1, 30)), "direction": way, "unit": unit}]
    if kind == "unplug":
        return [{"kind": "unplug", "at": at}, {"kind": "replug", "at": at + float(random.uniform(0.2, 9))}]
    if kind == "nack":
        return [{"kind": "nack", "at": at, "byte": int(random.integers(-1, 5)), "count": int(random.integers(1, 4))}]
    if kind == "stuck":
        return [{"kind": "stuck", "at": at, "seconds": float(random.uniform(0.01, 1))}]
    if kind in ("lost", "silent", "frozen"):
        return [{"kind": kind, "at": at}, {"kind": "seen", "at": at + float(random.uniform(0.1, 9))}]
    return [{"kind": kind, "at": at}]


class Troubled:
    """One run through random troubles, gone on with until it is done."""

    def __init__(self, run: BenchRun, seed: int) -> None:
        self.run, self.random = run, np.random.default_rng(seed)
        self.kinds = [str(k) for k in self.random.choice(KINDS, int(self.random.integers(1, 4)), replace=False)]
        self.said: list[str] = []

    def go(self) -> dict[str, Any]:
        """Through the troubles and to the end; gives the bench's own account."""
        with self.run.simulated() as clock:
            for kind in self.kinds:
                if kind not in ("second", "asked", "kill"):
                    for fault in faults(self.random, kind):
                        clock.ask({"fault": fault})
            if "kill" in self.kinds:
                self.run.acquire_until_killed(int(self.random.integers(3, 700)))
                clock.ask({"advance": float(self.random.uniform(0, 8))})
            self._once(self._asked(clock))
            for _ in range(5):
                if self.said[-1].startswith("done"):
                    break
                clock.ask({"advance": 12.0})
                self._once(lambda: False)
            return clock.ask({"state": True})

    def _once(self, asked: Any) -> None:
        outcome = self.run.acquire(asked)
        assert outcome.ending.how in ("done", "held", "parked") and outcome.ending.sentence
        self.said.append(f"{outcome.ending.how}: {outcome.ending.sentence}")

    def _asked(self, clock: SimulatedClock) -> Any:
        """Looked at now and then by the run: a second program tries the port, or somebody presses Ctrl-C."""
        when, seen = float(self.random.uniform(5, SECONDS)), [0]

        def asked() -> bool:
            seen[0] += 1
            if "second" in self.kinds and seen[0] == 100:
                assert refused_to_another(self.run.bench / "board")
            return "asked" in self.kinds and seen[0] > when * 20

        return asked


def refused_to_another(port: Path) -> bool:
    """Whether one more opening of the port is refused while it is in use."""
    second = SerialPort(SerialPortSettings(port=port))
    try:
        second.open()
    except DeviceRefusedError:
        return True
    except DeviceLostError:
        return not port.exists()
    second.close()
    return False


def judge(run: BenchRun, seed: int, undisturbed: dict[str, np.ndarray]) -> Troubled:
    run.clean()
    troubled = Troubled(run, seed)
    state = troubled.go()
    told = f"seed {seed}, {troubled.kinds}: {troubled.said}"
    assert state["offences"] == {}, told
    assert state["failed"] == [], told
    assert troubled.said[-1].startswith("done"), told
    measured = [content["pose"] for content in run.entries("measured")]
    left_out = run.progress().left_out
    assert sorted([*measured, *left_out]) == sorted(undisturbed), told
    assert len(left_out) <= 1, f"{told}: {left_out}"
    for name, position in positions(run.measured()).items():
        assert np.linalg.norm(position - undisturbed[name]) < AGREE_M, f"{told}, {name}"
    return troubled


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(MANY))
def test_random_troubles_never_make_the_arm_unsafe(
    run: BenchRun, undisturbed: dict[str, np.ndarray], seed: int
) -> None:
    judge(run, seed, undisturbed)


@pytest.mark.slow
@pytest.mark.parametrize("kills", [6, 60])
def test_kills_lose_nothing_that_was_acknowledged(
    run: BenchRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kills: int
) -> None:
    """Killed again and again, each time gone on with; a run that came to its end is begun anew."""
    told, write, random, done = tmp_path / "told", Journal.record, np.random.default_rng(60), 0

    def recorded(journal: Journal, kind: str, content: Any) -> int:
        number = write(journal, kind, content)
        with told.open("a") as file:
            file.write(f"{number} {kind}\n")
        return number

    monkeypatch.setattr(Journal, "record", recorded)
    while done < kills:
        run.clean()
        told.write_text("")
        with run.simulated() as clock:
            while done < kills and run.acquire_until_killed(int(random.integers(3, 250))):
                done += 1
                if has_journal(run.out):
                    with KeptJournal(run.out) as journal:
                        found = {f"{entry.sequence} {entry.kind}" for entry in journal.entries()}
                    said = told.read_text().splitlines()
                    assert len(set(said)) == len(said) and found >= set(said), done
                clock.ask({"advance": 12.0})
            ending = run.acquire().ending
            assert ending.how == "done" and clock.ask({"state": True})["offences"] == {}, ending
        measured = [content["pose"] for content in run.entries("measured")]
        assert len(set(measured)) == len(measured)


@pytest.mark.slow
def test_an_arm_that_is_driven_too_fast_is_seen(tmp_path: Path) -> None:
    fast = BenchRun(tmp_path, (*SETS, "bench.acquisition.rate_deg_per_s=30"))
    with fast.simulated() as clock:
        fast.acquire()
        assert set(clock.ask({"state": True})["offences"]) == {"speed"}
