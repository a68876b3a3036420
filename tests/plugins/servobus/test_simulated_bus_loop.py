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
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.run.experiment import Experiment
from armcal_bench.bench import Bench

from tests.bench_runs import free_port, overrides_for, simulated_bench
from tests.simulated_lines.line_world import BOARD, CLOCK
from tests.simulated_lines.socket_clock import SimulatedClock

CONFIGS = Path(__file__).resolve().parents[3] / "configs" / "so101"
POSES, FRESH = 40, 20
LIMITS = {
    "shoulder_pan": (-82, 82),
    "shoulder_lift": (-52, 52),
    "elbow_flex": (-72, 62),
    "wrist_flex": (-72, 72),
    "wrist_roll": (-82, 82),
}
NARROWER = (
    *(f"plan.limits.{joint}=[{low} deg, {high} deg]" for joint, (low, high) in LIMITS.items()),
    *(f"plan.clearance.rules.{rule}.at_least_mm=50" for rule in range(3)),
)
"""The bench judges limits and clearance by shafts, up to 7 deg on for the same angle once zeros are written back."""
pytestmark = pytest.mark.slow


@dataclass(frozen=True)
class Loop:
    """What the commands left behind.

    Attributes:
        ids: baud, id and model of what answered on the bus.
        unchecked: what ``acquire`` said before any check, after ``servo --check``, and after ``bus home``.
        state: the bench's truth at the end.
        offsets: by joint, how ``bus home`` and ``lerobot zeros`` changed its homing offset (counts).
    """

    folder: Path
    ids: list[tuple[int, int, str]]
    unchecked: list[str]
    state: dict[str, Any]
    offsets: dict[str, tuple[int, int]]

    def positions(self, name: str) -> np.ndarray:
        with (self.folder / name).open() as stream:
            return np.array([[float(row[f"{axis}_mm"]) for axis in "xyz"] for row in csv.DictReader(stream)])

    def values(self, run: str) -> dict[str, float]:
        text = yaml.safe_load((self.folder / run / "calibration.yaml").read_text())
        return {p["name"]: p["value"] for p in text["parameters"]}

    def nominal_error_mm(self, run: str) -> float:
        metrics = json.loads((self.folder / run / "metrics.json").read_text())
        return float(metrics["error_mm"]["nominal"]["holdout"]["mean"])


class Terminal:
    """A user's commands in a folder, with overrides; exit codes are asserted."""

    def __init__(self, folder: Path, sets: tuple[str, ...] = ()) -> None:
        self._folder, self._sets = folder, [word for text in sets for word in ("--set", text)]

    def words(self, *words: str | Path) -> list[str]:
        return [sys.executable, "-m", "armcal.cli", *map(str, words), *self._sets]

    def __call__(self, *words: str | Path, code: int = 0) -> str:
        done = subprocess.run(self.words(*words), capture_output=True, text=True, timeout=600, cwd=self._folder)
        assert done.returncode == code, f"{words}: {done.stdout}\n{done.stderr}"
        return done.stdout if code == 0 else " ".join(done.stderr.split())


@pytest.fixture(scope="module")
def loop(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Loop]:
    folder = tmp_path_factory.mktemp("loop")
    config = shutil.copytree(CONFIGS, folder / "so101") / "bench.yaml"
    port = free_port()
    ports = (f"bench.tracker.port={port}", f"bench.simulator.tracker.port={port}")
    there = (*ports, *overrides_for(folder / "bench", "device"))
    desk, bench, careful = Terminal(folder), Terminal(folder, there), Terminal(folder, (*there, *NARROWER))
    desk("plan", config, "--poses", str(POSES), "--out", folder / "plan.csv")
    fresh = Terminal(folder, ("plan.seed=5", "plan.starts=1", *NARROWER))
    fresh("plan", config, "--poses", str(FRESH), "--out", folder / "fresh.csv")

    def acquire(plan: str, out: str, by: Terminal = bench, code: int = 0) -> str:
        return by("acquire", config, "--plan", folder / plan, "--out", folder / out, "--yes", code=code)

    def doubt() -> str:
        words = ("acquire", config, "--plan", folder / "plan.csv", "--dry-run", "--json")
        return str(json.loads(bench(*words))["unchecked"])

    with simulated_bench(config, ports, folder / "bench", "device"):
        clock = SimulatedClock(folder / "bench" / CLOCK)
        found = json.loads(desk("bus", "find", folder / "bench" / BOARD, "--last-id", "8", "--json"))
        ids = [(servo["baud"], servo["id"], servo["model"]) for servo in found["servos"]]
        bench("bus", "check", config)
        unchecked = [acquire("plan.csv", "refused", code=2)]
        bench("servo", config, "--check", "--yes")
        unchecked.append(doubt())
        acquire("plan.csv", "runs")
        acquire("fresh.csv", "again")
        desk("run", config, "--data", folder / "runs" / "dataset.csv", "--out", folder / "calibrated")
        calibration = folder / "calibrated" / "calibration.yaml"
        home = ("bus", "home", config, "--calibration", calibration, "--release", "--yes", "--json")
        plans = json.loads(bench(*home))["offsets"]
        unchecked.append(doubt())
        bench("servo", config, "--check", "--yes")
        acquire("fresh.csv", "homed", by=careful)
        state = clock.ask({"state": True})
        clock.close()
    desk("run", config, "--data", folder / "homed" / "dataset.csv", "--out", folder / "afterwards")
    desk("predict", calibration, "--poses", folder / "again" / "dataset.csv", "--out", folder / "predicted.csv")
    without = without_zeros(calibration, folder / "without.yaml")
    desk("calibration", "accept", without)
    desk("predict", without, "--poses", folder / "homed" / "dataset.csv", "--out", folder / "homed.csv")
    motors = folder / "motors.json"
    motor = {"drive_mode": 0, "homing_offset": 0, "range_min": 900, "range_max": 3195}
    motors.write_text(json.dumps({joint: {"id": i, **motor} for i, joint in enumerate(plans, start=1)}))
    desk("lerobot", "zeros", calibration, motors, "--yes")
    lerobot = {joint: entry["homing_offset"] for joint, entry in json.loads(motors.read_text()).items()}
    offsets = {joint: (plan["after"] - plan["before"], lerobot[joint]) for joint, plan in plans.items()}
    yield Loop(folder, ids, unchecked, state, offsets)


def without_zeros(calibration: Path, to: Path) -> Path:
    """The calibration for servos that have its zeros by themselves."""
    content = yaml.safe_load(calibration.read_text())
    for parameter in content["parameters"]:
        if parameter["name"].startswith("arm.zeros.offset"):
            value = parameter["value"]
            parameter |= {key: parameter[key] - value for key in ("value", "lower", "upper")}
    to.write_text(yaml.safe_dump(content, sort_keys=False))
    return to


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
    assert loop.state["offences"] == {}, loop.state["worst"]
    assert float(str(loop.state["now"])) < 20 * 60


def test_zeros_and_play_are_those_of_the_arm(loop: Loop) -> None:
    values, true = loop.values("calibrated"), true_values()
    zeros = [math.degrees(values[n] - true[n]) for n in (f"arm.zeros.offset{i}" for i in range(1, 6))]
    play = [math.degrees(values[n] - true[n]) for n in (f"arm.play.lag{i}" for i in range(1, 6))]
    assert max(map(abs, zeros)) < 0.2, zeros
    assert max(map(abs, play)) < 0.1, play


def test_the_gripper_is_where_it_is_predicted_on_fresh_poses(loop: Loop) -> None:
    errors = np.linalg.norm(loop.positions("predicted.csv") - loop.positions("again/dataset.csv"), axis=1)
    assert len(errors) == FRESH
    assert loop.nominal_error_mm("calibrated") > 25
    assert errors.max() < 3


def test_no_arm_was_driven_whose_wiring_was_not_checked(loop: Loop) -> None:
    before, checked, homed = loop.unchecked
    assert "never checked" in before and "armcal servo CONFIG --check" in before
    assert checked == "" and "never checked" in homed


def test_the_zeros_are_in_the_servos_afterwards(loop: Loop) -> None:
    """The calibrated arm without its zeros predicts fresh poses; LeRobot's file would get the same offsets."""
    values = loop.values("afterwards")
    left = [math.degrees(values[f"arm.zeros.offset{i}"]) for i in range(1, 6)]
    assert max(map(abs, left)) < 0.4, "two calibrations, each within 0.2 deg; it was 4 to 7 deg"
    errors = np.linalg.norm(loop.positions("homed.csv") - loop.positions("homed/dataset.csv"), axis=1)
    assert len(errors) == FRESH and errors.max() < 3
    assert loop.nominal_error_mm("afterwards") < loop.nominal_error_mm("calibrated") / 2, "springs and lengths are left"
    assert all(on_bus == in_file and abs(on_bus) > 30 for on_bus, in_file in loop.offsets.values()), loop.offsets
