"""Three ways to find the zeros of an SO-101, rehearsed: the shipped records, and several seeds of each."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import armcal
import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.calibration.tool_expression import Equilibrium, arm_expression
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.measure.tables import write_csv

CONFIGS = Path(__file__).parents[2] / "configs" / "so101"
LIMITS_DEG = ((-80, 80), (-40, 50), (-50, 60), (-60, 80), (-90, 90))


@dataclass(frozen=True)
class Way:
    """What a way finds at least: zeros (deg), and the gripper's error over fresh poses, mean (mm)."""

    name: str
    zeros_deg: float
    gripper_mm: float


WAYS = (Way("ruler", 1.7, 2.5), Way("sockets", 1.7, 12.0), Way("camera", 0.5, 1.5))


def run_of(way: str, seed: int | None, folder: Path) -> armcal.Run:
    config = CONFIGS / f"{way}.yaml"
    if seed is None:
        return armcal.Experiment.load(config).run()
    experiment, records = armcal.Experiment.load(config, [f"simulation.seed={seed}"]), folder / "records.csv"
    channels = experiment.request(measured=True).channels
    write_csv(records, experiment.simulator().simulate(experiment.simulation_request), channels)
    return armcal.Experiment.load(config, data=records).run()


def truth_of(run: armcal.Run) -> Parameters:
    """The driven arm in the frame of its foot: torque on, so that it sags, whatever it did while it was measured."""
    parameters, source = run.experiment.system.parameters(), load_config(CONFIGS / "arm_truth.yaml")
    placed = {f"arm.mdh.base_{part}" for part in ("x", "y", "z", "rx", "ry")}
    own = "tracker" in run.experiment.system.measurements
    values = {name: value for name, value in source.data.items() if own or name not in placed}
    return with_values(parameters, values, source, ())


def tips(run: armcal.Run, parameters: Parameters) -> Array:
    """Where the gripper is in 300 fresh poses, each joint approached from either side (N x 3, m)."""
    system, random = run.experiment.system, np.random.default_rng(99)
    expression = arm_expression(system.arms["arm"], parameters, system.environment)
    commands = np.radians([random.uniform(*ends, 300) for ends in LIMITS_DEG])
    record = expression.records(commands)
    record[5:10] = random.choice([-1.0, 1.0], (5, 300))
    return Equilibrium(expression, "interpreted")(record).base_T_tool[:, :3, 3]


def judge(way: Way, run: armcal.Run) -> None:
    true, calibrated = truth_of(run), run.calibration.parameters
    drawn = run.experiment.system.parameters()
    free = [name for name in (f"arm.zeros.offset{i}" for i in range(1, 6)) if run.experiment.parameters[name].free]
    off = [calibrated.nominal()[calibrated.entries_of(n)][0] - true.nominal()[true.entries_of(n)][0] for n in free]
    assert np.degrees(np.abs(off)).max() < way.zeros_deg, (way, np.degrees(off))
    there = tips(run, true)
    errors = [1000 * np.linalg.norm(tips(run, p) - there, axis=1).mean() for p in (calibrated, drawn)]
    assert errors[0] < way.gripper_mm < 20 < errors[1], (way, errors)


@pytest.mark.slow
@pytest.mark.parametrize("way", [pytest.param(way, id=way.name) for way in WAYS])
def test_the_shipped_records_find_the_zeros(way: Way, tmp_path: Path) -> None:
    run = run_of(way.name, None, tmp_path)
    assert run.converged and not any(finding.grade == "bad" for finding in run.verdict.findings)
    judge(way, run)


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("way", [pytest.param(way, id=way.name) for way in WAYS])
def test_other_noise_and_poses_find_them_as_well(way: Way, seed: int, tmp_path: Path) -> None:
    judge(way, run_of(way.name, 500 + seed, tmp_path))
