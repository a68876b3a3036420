"""Calibrations on few records of a simulated arm, and good records after them: measurements of few rows and of many."""

from __future__ import annotations

import tempfile
from collections import Counter
from dataclasses import dataclass
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path

import board_camera
import numpy as np
import yaml
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.plugins import PluginRegistry, discover
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal.run.result import reserved, write
from armcal_online.recalibrator import Recalibrator
from armcal_online.settings import RecalibrateSettings
from armcal_online.sources import Incoming
from scipy.spatial.transform import Rotation

ARM = Path(__file__).resolve().parents[1] / "configs" / "lrm_arm" / "arm.yaml"
REACH = np.radians([100.0, 50.0, 100.0, 100.0, 100.0, 50.0])
JOINTS = tuple(f"q{i}" for i in range(1, 7))
FREE = tuple(f"arm.mdh.{name}" for name in ("theta2", "theta3", "theta4", "theta5", "base_x", "base_y", "base_z"))
SD = {"m": 0.002, "rad": 0.01}
"""How far the true arm is from the nominal one."""
_BOARD = {"type": "board", "square_mm": 15, "noise_mm": 0.003}
MEASUREMENTS = {
    3: {"type": "tip_position", "noise_mm": 0.3},
    6: {"type": "tip_pose", "noise_mm": 0.3, "orientation_noise_deg": 0.1},
    12: {**_BOARD, "columns": 3, "rows": 2},
    40: {**_BOARD, "columns": 5, "rows": 4},
    108: {**_BOARD, "columns": 9, "rows": 6},
}
"""By the number of rows of a residual."""


@cache
def registry() -> PluginRegistry:
    """The installed plugins, and the camera."""
    return discover([*entry_points(group="armcal"), board_camera.ENTRY_POINT])


def configuration(rows: int, data: Path) -> Path:
    """An experiment with one measurement, beside its data."""
    content = {
        **yaml.safe_load(ARM.read_text(encoding="utf-8")),
        "measurements": {"seen": MEASUREMENTS[rows]},
        "parameters": {"free": list(FREE)},
        "data": {"type": "csv", "path": data.name},
        "validation": {"holdout": 0, "folds": 0},
        "evaluator": "interpreted",
    }
    path = data.with_suffix(".yaml")
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    return path


@dataclass
class World:
    """An arm and an instrument as they are.

    Attributes:
        rows: of the measurement's residual.
        random: for all chance.
        noise: of the instrument, against the stated one.
    """

    rows: int
    random: np.random.Generator
    noise: float = 1.0

    def __post_init__(self) -> None:
        self.experiment, self.problem = _posed(self.rows)
        self.values = self.problem.parameters.nominal()
        for block in self.problem.parameters.free:
            self.values[self.problem.parameters.entries_of(block.name)] += SD[block.unit] * self.random.normal()

    def records(self, count: int) -> Dataset:
        """Good records at random poses."""
        q = self.random.uniform(-1, 1, (count, 6)) * REACH
        channels = {f"arm.{name}": q[:, i] for i, name in enumerate(JOINTS)}
        return Dataset(tuple(f"p{i}" for i in range(count)), channels | self._measured(q))

    def _measured(self, q: np.ndarray) -> dict[str, np.ndarray]:
        (kernel,) = self.problem.kernels
        outputs = kernel.factor.output_channels
        empty = {f"arm.{name}": q[:, i] for i, name in enumerate(JOINTS)} | {c: np.zeros(len(q)) for c in outputs}
        poses = Dataset(tuple(map(str, range(len(q)))), empty)
        read = self.problem.of(poses).predict(self.values)[0].outputs
        noise = self.noise * np.array(kernel.factor.noise)[:, None] * self.random.normal(size=(self.rows, len(q)))
        if self.rows != 6:
            return dict(zip(outputs, read + noise, strict=True))
        turned = Rotation.from_quat(read[3:].T, scalar_first=True) * Rotation.from_rotvec(noise[3:].T)
        return dict(zip(outputs, [*(read[:3] + noise[:3]), *turned.as_quat(scalar_first=True).T], strict=True))


@cache
def _posed(rows: int) -> tuple[Experiment, Problem]:
    with tempfile.TemporaryDirectory() as folder:
        experiment = Experiment.load(configuration(rows, Path(folder) / "none.csv"), registry=registry())
    system = experiment.system
    (measurement,) = system.measurements.values()
    names = [f"arm.{name}" for name in JOINTS] + [f"seen.{c.name}" for c in measurement.channels()]
    one = Dataset(("",), {name: np.ones(1) for name in names})
    return experiment, Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, one, "interpreted"
    )


def calibrated(world: World, count: int, folder: Path) -> Calibration:
    """A calibration as ``armcal run`` writes it."""
    dataset = world.records(count)
    (measurement,) = world.experiment.system.measurements.values()
    units = {"length": "m", "angle": "rad", "dimensionless": ""}
    suffix = {f"seen.{c.name}": (c.name, units[c.dimension]) for c in measurement.channels()}
    suffix |= {f"arm.{name}": (name, "rad") for name in JOINTS}
    head = ["pose_id", *("_".join(p for p in suffix[name] if p) for name in dataset.channels)]
    table = np.array(list(dataset.channels.values())).T
    lines = [",".join([i, *(repr(float(x)) for x in row)]) for i, row in zip(dataset.ids, table, strict=True)]
    (folder / "data.csv").write_text("\n".join([",".join(head), *lines]) + "\n", encoding="utf-8")
    experiment = Experiment.load(configuration(world.rows, folder / "data.csv"), registry=registry())
    with reserved(folder / "run") as held:
        write(held, calibrate(experiment), experiment, "")
    return Calibration.load(folder / "run" / "calibration.yaml", registry())


@dataclass(frozen=True)
class Kept:
    """What a recalibration made of good records: how many it rejected, what it decided, and its level at the end."""

    rejected: int
    decisions: tuple[str, ...]
    level: str


def kept_true(calibration: Calibration, world: World, count: int, **settings) -> Kept:
    """Of so many good records after a calibration."""
    given = RecalibrateSettings.model_validate({"evaluator": "interpreted", **settings})
    session, dataset = Recalibrator(calibration, given, registry()), world.records(count)
    counted: Counter[str] = Counter()
    decisions = []
    for i, name in enumerate(dataset.ids):
        channels = {c: float(v[i]) for c, v in dataset.channels.items()} | {"time": 1e9 + i}
        for event in session.take(Incoming(name, channels, {}, 1e9 + i, "list", i + 1), i + 1):
            counted[event.get("verdict", "")] += 1
            if event["event"] == "decision":
                decisions.append(event["kind"])
    assert counted["accepted"] + counted["rejected"] == count
    return Kept(counted["rejected"], tuple(decisions), session.state.health.level)
