"""Compensation on the real arm: from measured tips of poses that did not train it back to the commands."""

from __future__ import annotations

from itertools import combinations
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.calibration.compensation.request import Options
from armcal.calibration.compensation.step import slope_function
from armcal.estimate.prediction import quantile
from armcal.run.experiment import Experiment
from armcal.run.outputs import calibration_content
from armcal.run.pipeline import calibrate

pytestmark = [pytest.mark.shared, pytest.mark.slow]

JOINTS = tuple(f"q{i}" for i in range(1, 7))
SINGULAR = {("q1", "q2", "q3"), ("q3", "q4", "q5")}
"""Axes that meet in a point, so that these three leave the tip on a sphere."""
LEAST_M_PER_RAD = 0.02
"""Where a joint moves the tip by less, its angle cannot be told from the tip."""


def held_out(experiment: Experiment, calibration: Calibration, ids: set[str]) -> tuple[Dataset, Dataset]:
    """The records that did not train, as measured and as commands alone."""
    dataset = experiment.read()
    kept = dataset.subset([i for i, name in enumerate(dataset.ids) if name not in ids])
    commands = {name: values for name, values in kept.channels.items() if not name.startswith("tracker.")}
    return kept, Dataset(kept.ids, commands)


def test_joint_angles_follow_from_measured_tips(repository: Path, shared_data: Path, tmp_path: Path) -> None:
    """Three joints as commanded: the other three are where they were commanded, within their intervals."""
    data = shared_data / "lrm_arm"
    trained = data / "published_50.csv"
    settings = [f"validation.train_ids={trained}"]
    experiment = Experiment.load(repository / "configs/lrm_arm/best.yaml", settings, data / "poses.csv")
    result = calibrate(experiment)
    path = tmp_path / "calibration.yaml"
    path.write_text(sealed(calibration_content(result, experiment)))
    calibration = Calibration.load(path)
    ids = set(trained.read_text().split()[1:])
    measured, commands = held_out(experiment, calibration, ids)
    assert len(measured) == 263
    about = calibration.plus_minus(commands)
    covariance, width = about.covariances["tracker"], float(quantile(0.9, calibration.uncertainty.freedom))
    inside: dict[tuple[str, ...], np.ndarray] = {}
    for held in combinations(JOINTS, 3):
        free = tuple(joint for joint in JOINTS if joint not in held)
        inside[free] = _inside(calibration, held, measured, width**2 * covariance)
    assert {free for free, found in inside.items() if not found.size} == SINGULAR
    everything = np.concatenate(list(inside.values()))
    assert len(everything) > 3000
    # Intervals of angles follow from those of the tip: they are as good, and from 50 poses rather too wide.
    names = [f"tracker.{axis}" for axis in "xyz"]
    predicted, _ = calibration.predict(commands)
    missed = measured.stacked(names) - np.stack([predicted[name] for name in names])
    tips = np.abs(missed) <= np.stack([about.half_widths[name] for name in names])
    assert everything.mean() == pytest.approx(tips.mean(), abs=0.05)
    assert all(found.mean() > 0.9 for found in inside.values() if found.size)
    assert tips.mean() > 0.9
    assert np.mean(np.linalg.norm(missed, axis=0) <= about.radii["tracker"]) > 0.95


def _inside(calibration: Calibration, held: tuple[str, ...], measured: Dataset, covariance: np.ndarray) -> np.ndarray:
    """Whether each angle that was computed is as commanded within its 90 % interval; poses that tell it alone.

    ``covariance`` is of the tip, its standard deviations half widths of 90 % intervals.
    """
    q = measured.stacked([f"arm.{joint}" for joint in JOINTS]).T
    approach = measured.stacked([f"arm.approach.{joint}" for joint in JOINTS]).T
    tips = measured.stacked([f"tracker.{axis}" for axis in "xyz"]).T
    compensator = calibration.compensator(options=Options(held=held), choice="interpreted")
    targets = compensator.targets(tips, approach=approach)
    commands = compensator.solve(targets, q)
    free = [i for i, joint in enumerate(JOINTS) if joint not in held]
    record = np.concatenate([q.T, approach.T, targets.acting])
    states = compensator.stand(q, targets, approach).states
    function: ca.Function = slope_function(compensator.expression, False)
    slopes = np.asarray(function.map(len(q))(record, states)).reshape(6, 3, -1).transpose(2, 1, 0)[:, :, free]
    told = np.linalg.svd(slopes, compute_uv=False)[:, -1] > LEAST_M_PER_RAD
    assert commands.reached[told].all()
    back = np.linalg.inv(slopes[told])
    half_widths = np.sqrt(np.einsum("nij,njk,nik->ni", back, covariance[told], back))
    moved = (commands.joint_angles - q)[told][:, free]
    return (np.abs(moved) <= half_widths).ravel()
