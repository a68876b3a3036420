"""From an uncalibrated bench to a predicted tip, by commands, through pyserial, a pty, framed bytes and datagrams."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.arm.servo import PulseClock, PulseTable
from armcal.config.selection import with_values
from armcal.config.servo_file import load_servo_file
from armcal.config.yaml_source import load_config
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.run.experiment import Experiment

from tests.bench_runs import free_port, overrides_for, simulated_bench, write_plan

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
POSES, FRESH = 60, 16
XYZ = ("x", "y", "z")


@dataclass(frozen=True)
class Loop:
    """What the commands left behind."""

    folder: Path
    config: Path
    sets: tuple[str, ...]
    plan: Path
    fresh: Path

    def armcal(self, *words: str | Path) -> str:
        """A command; gives what it printed."""
        sets = [word for text in self.sets for word in ("--set", text)] if words[0] in ("servo", "acquire") else []
        command = [sys.executable, "-m", "armcal.cli", *map(str, words), *sets]
        done = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=self.folder)
        assert done.returncode == 0, f"{words}: {done.stdout}\n{done.stderr}"
        return done.stdout

    def experiment(self) -> Experiment:
        return Experiment.load(self.config, self.sets)

    def table(self, name: str) -> list[dict[str, str]]:
        with (self.folder / name).open() as stream:
            return list(csv.DictReader(stream))


pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Loop]:
    folder = tmp_path_factory.mktemp("loop")
    config = folder / "lrm_arm" / "bench.yaml"
    shutil.copytree(CONFIGS, config.parent)
    port = free_port()
    ports = (f"bench.tracker.port={port}", f"bench.simulator.tracker.port={port}")
    sets = (*ports, *overrides_for(folder / "bench"))
    random = np.random.default_rng(7)
    limits = np.array([100, 50, 80, 80, 80, 50])
    found = Loop(folder, config, sets, folder / "plan.csv", folder / "fresh.csv")
    found.armcal("plan", config, "--poses", str(POSES), "--out", found.plan)
    candidates = write_plan(folder / "any.csv", tuple(map(tuple, random.uniform(-limits, limits, (200, 6)).round(1))))
    found.armcal("plan", config, "--candidates", candidates, "--poses", str(FRESH), "--out", found.fresh)
    with simulated_bench(config, ports, folder / "bench"):
        found.armcal("servo", config, "--out", folder / "servo", "--yes", "--set", "bench.servo.step_deg=20")
        found.armcal("servo", config, "--check", "--yes", "--set", "bench.servo.base={q2: 30 deg, q4: -40 deg}")
        found.armcal("acquire", config, "--plan", found.plan, "--out", folder / "runs", "--yes")
        found.armcal("acquire", config, "--plan", found.fresh, "--out", folder / "again", "--yes")
    found.armcal("run", config, "--data", "runs/dataset.csv", "--out", "calibrated")
    found.armcal("predict", "calibrated/calibration.yaml", "--poses", "again/dataset.csv", "--out", "predicted.csv")
    yield found


def test_the_bench_was_safe(loop: Loop) -> None:
    told = [json.loads(line) for line in (loop.folder / "bench" / "safety.jsonl").read_text().splitlines()]
    assert [line for line in told if "offence" in line] == []


def test_every_pose_of_the_plan_is_measured_once(loop: Loop) -> None:
    with loop.plan.open() as stream:
        planned = [row["pose_id"] for row in csv.DictReader(stream)]
    measured = [row["pose_id"] for row in loop.table("runs/dataset.csv")]
    assert len(planned) == POSES and sorted(measured) == sorted(planned)


def true_angles(loop: Loop, joint: str, angles: np.ndarray) -> np.ndarray:
    """Where a servo without play stands (rad) that is commanded so by the servo file that was written."""
    stated, true = load_servo_file(loop.config.parent / "servos.yaml"), load_servo_file(CONFIGS / "bench_servos.yaml")
    boards = stated.boards["front"], true.boards["front"]
    prescale = PulseClock.prescale_for(boards[0].oscillator_hz, boards[0].rate_hz)
    ticks = [PulseClock(board.oscillator_hz, prescale).tick for board in boards]
    tables = [PulseTable(file.servos[joint].angles, file.servos[joint].pulses) for file in (stated, true)]
    pulses = np.array([float(tables[0].pulse(angle)) for angle in angles]) / ticks[0] * ticks[1]
    return np.array([float(tables[1].angle(pulse)) for pulse in pulses])


def in_the_models_terms(loop: Loop, joint: int) -> np.ndarray:
    """A true servo as offset and gains above and below zero, over the commands it was measured at.

    Its table bends where its true zero is, a fraction of a degree from the commanded one where the model's bends.
    """
    angles = np.deg2rad([float(row[f"q{joint}_deg"]) for row in loop.table("runs/dataset.csv")])
    terms = np.array([np.ones(len(angles)), np.maximum(angles, 0), np.minimum(angles, 0)]).T
    return np.linalg.lstsq(terms, true_angles(loop, f"q{joint}", angles) - angles, rcond=None)[0]


def truth(loop: Loop) -> dict[str, float]:
    """Every free parameter's true value, as the model has it."""
    experiment = loop.experiment()
    source = load_config(CONFIGS / "truth.yaml")
    parameters = with_values(experiment.parameters, source.data, source, ())
    found = dict(zip(parameters.entry_names, parameters.nominal().tolist(), strict=True))
    for i in range(1, 7):
        offset, above, below = in_the_models_terms(loop, i)
        found[f"arm.mdh.theta{i}"] += offset
        found[f"arm.servo.above{i}"], found[f"arm.servo.below{i}"] = above, below
        found[f"arm.lag.lag{i}"] = np.deg2rad(0.05)
    return found


def test_the_truth_lies_within_its_intervals(loop: Loop) -> None:
    found = yaml.safe_load((loop.folder / "calibrated" / "calibration.yaml").read_text())
    free = [p for p in found["parameters"] if p["free"]]
    true = truth(loop)
    off = {p["name"]: (p["value"] - true[p["name"]]) / p["sd"] for p in free}
    assert len(off) == 48
    inside = np.mean([abs(z) < 1.96 for z in off.values()])
    assert inside > 0.85, off
    assert max(map(abs, off.values())) < 4.5, off


def test_fresh_poses_are_predicted_as_well_as_noise_lets(loop: Loop) -> None:
    experiment = loop.experiment()
    measured = np.array([[float(row[f"{axis}_mm"]) for axis in XYZ] for row in loop.table("again/dataset.csv")])
    predicted = np.array([[float(row[f"{axis}_mm"]) for axis in XYZ] for row in loop.table("predicted.csv")])
    true = truth(loop)
    values = np.array([true[name] for name in experiment.parameters.entry_names])
    system = experiment.system
    request = SimulationRequest(
        system.arms, system.measurements, experiment.parameters.with_nominal(values), system.environment
    )
    fresh = Experiment.load(loop.config, loop.sets, data=loop.folder / "again" / "dataset.csv").read()
    known = measured_without_noise(request, fresh)
    floor = 1000 * np.array([known[f"tracker.{axis}"] for axis in XYZ]).T
    error, noise = (np.linalg.norm(p - measured, axis=1).mean() for p in (predicted, floor))
    assert error < 1.3 * noise, (error, noise)
    assert noise < 0.05, "mm"
