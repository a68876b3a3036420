"""``armcal run`` from a recording comes to the calibration that it comes to from the CSV file of the rests."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import recorded_bags as bags
import yaml
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal.cli.run import run
from armcal.run.experiment import Experiment
from click.testing import CliRunner


@pytest.fixture(scope="module")
def tour(tmp_path_factory: pytest.TempPathFactory) -> bags.Tour:
    return bags.made_tour(tmp_path_factory.mktemp("tour"), rests=40)


def calibrated(config: Path) -> tuple[Calibration, Array, Array]:
    """The calibration, with values and standard deviations of its free parameters (SI)."""
    out = config.with_name(f"run_{config.stem}")
    done = CliRunner().invoke(run, [str(config), "--out", str(out)], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    entries = [e for e in yaml.safe_load((out / "calibration.yaml").read_text())["parameters"] if e["free"]]
    numbers = np.array([[entry["value"], entry["sd"]] for entry in entries])
    return Calibration.load(out / "calibration.yaml"), numbers[:, 0], numbers[:, 1]


@pytest.mark.slow
def test_a_recording_gives_the_calibration_of_the_table(tour: bags.Tour) -> None:
    """Though the tracker's clock is 37 ms ahead: what is averaged lies well within a rest."""
    bag = bags.write_bag(tour.config.with_name("bag"), tour.sent(ahead=0.037), compressed="storage")
    from_bag, values, _ = calibrated(bags.of_bag(tour, bag))
    from_table, table_values, table_deviations = calibrated(tour.config)
    assert (np.abs(values - table_values) < 4 * table_deviations).all()
    random = np.random.default_rng(9)
    fresh = random.uniform(-1.2, 1.2, (200, 6))
    true = bags.simulated(Experiment.load(tour.config, ("simulation.noise_mm=0.000001",)), fresh)
    errors = {}
    for name, calibration in {"bag": from_bag, "table": from_table}.items():
        poses = calibration.forward(fresh)
        tips = poses[:, :3, 3] + poses[:, :3, :3] @ [0, 0.03, 0.04]
        errors[name] = np.linalg.norm(tips - true, axis=1).mean()
    # each record of the recording is the mean of some 35 samples, each of the table one
    assert errors["bag"] < 0.12e-3 and errors["bag"] < errors["table"]


@pytest.mark.slow
def test_a_frame_that_is_computed_from_joints_is_named(tmp_path: Path) -> None:
    """What robot_state_publisher publishes is the nominal arm: nothing is measured."""
    tour = bags.made_tour(tmp_path, rests=30)
    (tmp_path / "truth.yaml").write_text("{}\n")
    experiment = Experiment.load(tour.config, ("simulation.noise_mm=0.0000001",))
    at, _ = tour.seen
    times, joints = tour.joints
    exact = np.column_stack([np.interp(at, times, column) for column in joints.T])
    for name, noise, expected in (("computed", 0.0, True), ("measured", 3e-4, False)):
        seen = bags.simulated(experiment, exact) + np.random.default_rng(2).normal(0.0, noise, (len(at), 3))
        bag = bags.write_bag(tour.config.with_name(name), replace(tour, seen=(at, seen)).sent())
        done = CliRunner().invoke(run, [str(bags.of_bag(tour, bag)), "--out", str(tmp_path / f"run_{name}")])
        assert ("follow the nominal arm" in done.output) == expected, done.output
