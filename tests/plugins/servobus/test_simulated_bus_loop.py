"""From an SO-101-like arm of which nothing is known to a gripper within a millimetre or two, by a user's commands."""

from __future__ import annotations

import csv
import json
import math
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.devices.clock import SimulatedClock
from armcal.devices.simulated import BOARD, CLOCK
from armcal.run.experiment import Experiment
from armcal_bench.acquisition.rehearsal import overrides_for, simulated_bench
from armcal_bench.bench import Bench
from bench_runs import free_port

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "so101"
POSES, FRESH = 40, 20
pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Loop:
    """What the commands left behind; ``ids`` answered on the bus, ``state`` is the bench's truth at the end."""

    folder: Path
    ids: list[tuple[int, int, str]]
    state: dict[str, object]

    def positions(self, name: str) -> np.ndarray:
        with (self.folder / name).open() as stream:
            return np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in csv.DictReader(stream)])


def armcal(folder: Path, *words: str | Path, sets: tuple[str, ...] = ()) -> str:
    given = [word for text in sets for word in ("--set", text)]
    command = [sys.executable, "-m", "armcal.cli", *map(str, words), *given]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=folder)
    assert done.returncode == 0, f"{words}: {done.stdout}\n{done.stderr}"
    return done.stdout


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Loop]:
    folder = tmp_path_factory.mktemp("loop")
    config = shutil.copytree(CONFIGS, folder / "so101") / "bench.yaml"
    port = free_port()
    ports = (f"bench.tracker.port={port}", f"bench.simulator.tracker.port={port}")
    sets = (*ports, *overrides_for(folder / "bench", "device"))
    armcal(folder, "plan", config, "--poses", str(POSES), "--out", folder / "plan.csv")
    fresh = ("plan.seed=5", "plan.starts=1", "plan.goal=A")
    armcal(folder, "plan", config, "--poses", str(FRESH), "--out", folder / "fresh.csv", sets=fresh)
    with simulated_bench(config, ports, folder / "bench"):
        found = json.loads(armcal(folder, "bus", "find", folder / "bench" / BOARD, "--last-id", "8", "--json"))
        ids = [(servo["baud"], servo["id"], servo["model"]) for servo in found["servos"]]
        armcal(folder, "servo", config, "--check", "--yes", sets=sets)
        armcal(folder, "acquire", config, "--plan", folder / "plan.csv", "--out", folder / "runs", "--yes", sets=sets)
        armcal(folder, "acquire", config, "--plan", folder / "fresh.csv", "--out", folder / "again", "--yes", sets=sets)
        clock = SimulatedClock(folder / "bench" / CLOCK)
        state = clock.ask({"state": True})
        clock.close()
    armcal(folder, "run", config, "--data", folder / "runs" / "dataset.csv", "--out", folder / "calibrated")
    poses = ("--poses", folder / "again" / "dataset.csv", "--out", folder / "predicted.csv")
    armcal(folder, "predict", folder / "calibrated" / "calibration.yaml", *poses)
    yield Loop(folder, ids, state)


def estimated(loop: Loop) -> dict[str, float]:
    text = yaml.safe_load((loop.folder / "calibrated" / "calibration.yaml").read_text())
    return {p["name"]: p["value"] for p in text["parameters"]}


def true_values() -> dict[str, float]:
    """Of the arm, with the play of the simulated servos."""
    experiment = Experiment.load(CONFIGS / "bench.yaml")
    source = load_config(CONFIGS / "truth.yaml")
    parameters = with_values(experiment.parameters, source.data, source, ())
    true = dict(zip(parameters.entry_names, parameters.nominal().tolist(), strict=True))
    joints = dict(Bench.of(experiment).settings.simulator or {})["joints"]
    for number, joint in enumerate(next(iter(experiment.system.arms.values())).commanded, start=1):
        true[f"arm.play.lag{number}"] = math.radians(joints[joint]["backlash_deg"]) / 2
    return true


def test_all_servos_are_found_on_the_bus(loop: Loop) -> None:
    assert loop.ids == [(1_000_000, number, "sts3215") for number in range(1, 6)]


def test_the_bench_was_safe_and_quick(loop: Loop) -> None:
    assert loop.state["offences"] == {}
    assert float(str(loop.state["now"])) < 20 * 60


def test_zeros_and_play_are_those_of_the_arm(loop: Loop) -> None:
    values, true = estimated(loop), true_values()
    zeros = [math.degrees(values[n] - true[n]) for n in (f"arm.zeros.offset{i}" for i in range(1, 6))]
    play = [math.degrees(values[n] - true[n]) for n in (f"arm.play.lag{i}" for i in range(1, 6))]
    assert max(map(abs, zeros)) < 0.2, zeros
    assert max(map(abs, play)) < 0.1, play


def test_the_gripper_is_where_it_is_predicted_on_fresh_poses(loop: Loop) -> None:
    measured = loop.positions("again/dataset.csv")
    errors = np.linalg.norm(loop.positions("predicted.csv") - measured, axis=1)
    metrics = json.loads((loop.folder / "calibrated" / "metrics.json").read_text())
    assert len(errors) == FRESH
    assert metrics["error_mm"]["nominal"]["holdout"]["mean"] > 25
    assert errors.max() < 3
