"""Measuring runs against a simulated bench in a process of its own, over its pty and its sockets."""

from __future__ import annotations

import os
import shutil
import signal
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.dataset import Dataset
from armcal.config.system import build_component
from armcal.errors import ArmcalError, InputError
from armcal.io.journal import KeptJournal, has_journal
from armcal.plugins import use_plugins
from armcal.run.experiment import Experiment
from armcal_bench.preparation import Prepared, prepare
from armcal_bench.run_log import Progress, Start, dataset_of, progress_of
from armcal_bench.session import Conversation, Outcome, acquire

from tests.simulated_lines.line_world import BOARD, CLOCK
from tests.simulated_lines.socket_clock import SimulatedClock

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / "configs" / "lrm_arm" / "bench.yaml"
POSES = ((0, 0, 0, 0, 0, 0), (40, -30, 60, -50, 30, 20), (-60, 20, 90, 40, -40, -30), (20, 40, -50, 80, 60, 10))
"""Degrees."""
AT_LINE = ROOT / "tests" / "simulated_lines" / "at_line.py"
_IDS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")  # of the SO-101, from 1 on


def overrides_for(folder: Path, part: str = "link") -> tuple[str, ...]:
    """What makes a configuration meet the bench that is served at a line in a folder.

    ``part``: of the bench, which has the serial port: a ``link`` to boards, or a ``device`` with a bus.
    """
    use_plugins(AT_LINE)
    there, kind = folder.absolute(), "servo" if part == "link" else "bus"
    return (
        f"bench.simulated={there}",
        f"bench.{part}.port={there / BOARD}",
        f"bench.simulator.type={kind}_bench_at_line",
    )


def bus_ids() -> tuple[str, ...]:
    """What the SO-101's bench at a line needs beside that of this process: which servo has which id."""
    return tuple(f"bench.simulator.joints.{joint}.id={number}" for number, joint in enumerate(_IDS, start=1))


def free_port() -> int:
    """A UDP port that nobody has."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def write_plan(path: Path, poses: tuple[tuple[float, ...], ...] = POSES) -> Path:
    """A plan in degrees."""
    rows = [f"p{i}," + ",".join(map(str, pose)) for i, pose in enumerate(poses, start=1)]
    path.write_text("pose_id,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n" + "\n".join(rows) + "\n")
    return path


@dataclass
class BenchRun:
    """A bench's folder, and a configuration that meets it there.

    Attributes:
        folder: of everything.
        sets: overrides beside those that a simulated bench needs.
        part: of the bench, which has the serial port.
    """

    folder: Path
    sets: tuple[str, ...] = ()
    config: Path = CONFIG
    part: str = "link"
    experiment: Experiment = field(init=False)
    plan: Path = field(init=False)

    def __post_init__(self) -> None:
        port = free_port()
        self.bench.mkdir(parents=True, exist_ok=True)
        ports = (f"bench.tracker.port={port}", f"bench.simulator.tracker.port={port}")
        if self.config == CONFIG:  # it holds the arm at the end; these runs see the servos let go unless they say so
            ports = (*ports, "bench.acquisition.at_end=release")
        if self.part == "device":
            ports = (*ports, *bus_ids())
        self.experiment = Experiment.load(self.config, (*ports, *self.sets, *overrides_for(self.bench, self.part)))
        self.plan = write_plan(self.folder / "plan.csv")

    @property
    def bench(self) -> Path:
        return self.folder / "bench"

    @property
    def out(self) -> Path:
        return self.folder / "out"

    def clean(self) -> None:
        """As if nothing had been done."""
        for path in (self.bench, self.out):
            shutil.rmtree(path, ignore_errors=True)
        self.bench.mkdir()

    @contextmanager
    def simulated(self) -> Iterator[SimulatedClock]:
        """The bench, forked off; the clock is one more client of it."""
        child = os.fork()
        if child == 0:
            _in_child(lambda: serve(self.experiment, self.bench))
        try:
            clock = _connected(self.bench)
            try:
                yield clock
            finally:
                clock.close()
        finally:
            os.kill(child, signal.SIGTERM)
            _wait(child)

    def prepared(self) -> Prepared:
        """The plan, ready to be driven."""
        return prepare(self.experiment, self.plan)

    def acquire(self, asked: Callable[[], bool] = lambda: False, prepared: Prepared | None = None) -> Outcome:
        """Begin or go on."""
        there = has_journal(self.out)
        talk = Conversation(asked, lambda start: True)
        start: Start = "resume" if there else "anew"
        return acquire(prepared or self.prepared(), self.plan, self.out, start, talk, unchecked=True)

    def acquire_until_killed(self, sleeps: int) -> bool:
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
        self.acquire()

    def progress(self) -> Progress:
        """By the journal."""
        with KeptJournal(self.out) as journal:
            return progress_of(journal.entries())

    def entries(self, kind: str) -> list[Any]:
        """Of the journal, of a kind."""
        with KeptJournal(self.out) as journal:
            return [entry.content for entry in journal.entries() if entry.kind == kind]

    def measured(self) -> Dataset:
        """As the data are written."""
        return dataset_of(self.experiment, self.progress(), {})


def positions(dataset: Dataset) -> dict[str, np.ndarray]:
    """Measured positions by pose (m)."""
    xyz = dataset.stacked(["tracker.x", "tracker.y", "tracker.z"]).T
    return dict(zip(dataset.ids, xyz, strict=True))


def serve(experiment: Experiment, folder: Path) -> None:
    """The bench of a configuration, at a line in a folder, until its end."""
    build_component(experiment.source, experiment.registry, "bench", ("bench", "simulator"))[0].serve(
        experiment, folder
    )


@contextmanager
def simulated_bench(config: Path, overrides: Sequence[str], folder: Path, part: str = "link") -> Iterator[None]:
    """A bench at a line in a folder, forked off."""
    folder.mkdir(parents=True, exist_ok=True)
    ids = bus_ids() if part == "device" else ()
    experiment = Experiment.load(config, (*ids, *overrides, *overrides_for(folder, part)))
    child = os.fork()
    if child == 0:
        _in_child(lambda: serve(experiment, folder))
    try:
        _connected(folder).close()
        yield
    finally:
        os.kill(child, signal.SIGTERM)
        _wait(child)


def _connected(bench: Path) -> SimulatedClock:
    until = time.monotonic() + 30
    while True:
        try:
            return SimulatedClock(bench / CLOCK)
        except InputError:
            if time.monotonic() > until:
                raise
            time.sleep(0.01)


def _in_child(action: Callable[[], object]) -> None:
    """Do it and end, whatever happens; no cleaning up of what belongs to the parent."""
    code = 1
    try:
        action()
        code = 0
    except ArmcalError:
        code = 2
    finally:
        os._exit(code)


def _wait(child: int) -> int:
    until = time.monotonic() + 60
    while time.monotonic() < until:
        found, status = os.waitpid(child, os.WNOHANG)
        if found:
            return status
        time.sleep(0.002)
    with suppress(ProcessLookupError):
        os.kill(child, signal.SIGKILL)
    return os.waitpid(child, 0)[1]
