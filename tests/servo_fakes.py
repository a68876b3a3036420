"""A servo board of nothing but Python, and the LRM arm's bench set up on it."""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from armcal.config.servo_file import load_servo_file
from armcal.devices.device import DeviceIdentity, DeviceLostError, DeviceState
from armcal.run.experiment import Experiment
from armcal_bench.bench import Bench
from armcal_bench.servo_setup import Setup

from tests.bench_fakes import FakeClock

CONFIGS = Path(__file__).parents[1] / "configs" / "lrm_arm"


class FakeServos:
    """Sets whole counts and remembers all of them; ``lost_at`` names calls of ``set_pulse`` that fail."""

    def __init__(self, servo_file: Path) -> None:
        self.file = load_servo_file(servo_file)
        self.joint_names = tuple(self.file.servos)
        self.counts: dict[str, int] = {}
        self.log: list[tuple[str, int, float]] = []
        self.lost_at: set[int] = set()
        self.clock: Any = None
        self.calls = self.opened = 0
        self.after: Callable[[], None] = lambda: None

    def open(self, clock: Any) -> DeviceIdentity:
        self.clock = clock
        self.opened += 1
        return DeviceIdentity("fake", "d1")

    def state(self) -> DeviceState:
        angles = {}
        for joint, counts in self.counts.items():
            servo = self.file.calibrated(joint)
            angles[joint] = float(servo.table.angle(counts * servo.clock.tick))
        return DeviceState(angles)

    def set_pulse(self, joint: str, pulse: float) -> float:
        self.calls += 1
        if self.calls in self.lost_at:
            raise DeviceLostError("the board is gone.")
        clock = self.file.calibrated(joint).clock
        counts = math.floor(pulse / clock.tick + 0.5)
        self.counts[joint] = counts
        self.log.append((joint, counts, self.clock.now()))
        self.after()
        return counts * clock.tick

    def keep_alive(self) -> None:
        pass

    def guard(self, waypoints: Any, rate: float, after_s: float) -> bool:
        return False

    def release(self, joint: str) -> None:
        self.counts.pop(joint)

    def close(self) -> None:
        pass


def config_in(folder: Path, text: str = "") -> Path:
    """The LRM arm's bench, copied; ``text`` is put under the section ``bench``."""
    for file in CONFIGS.glob("*.yaml"):
        shutil.copy(file, folder)
    config = folder / "own.yaml"
    config.write_text(f"extends: bench.yaml\n{text}", encoding="utf-8")
    return config


def setup_on(monkeypatch: Any, config: Path, overrides: tuple[str, ...] = ()) -> tuple[Setup, FakeServos, FakeClock]:
    """A set-up whose device and clock are fakes."""
    device, clock = FakeServos(config.parent / "servos.yaml"), FakeClock()

    @contextmanager
    def fake_clock(self: Any) -> Any:
        yield clock

    monkeypatch.setattr(Bench, "device", lambda self: device)
    monkeypatch.setattr(Bench, "clock", fake_clock)
    return Setup.of(Experiment.load(config, overrides)), device, clock
