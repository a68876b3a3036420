"""Where nothing says from which side joints came, intervals hold what their play does."""

from __future__ import annotations

import csv
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import mkdtemp

import numpy as np
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.run.experiment import Experiment
from outside import armcal

ARM = """
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{d_mm: 80, alpha_deg: 90}, {a_mm: 250}, {a_mm: 200, theta_deg: 10}]}
    effects: {play: {type: approach_backlash}}
measurements: {tracker: {type: tip_position, noise_mm: 0.05}}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
parameters: {free: ["arm.play.*", "arm.mdh.theta2"], priors: {"arm.play.*": 1 deg}}
estimator: {type: cvxpy}
data: {type: csv, path: data.csv}
validation: {holdout: 0.2, seed: 1}
"""
NOISE_M = 5e-5
AXES = [f"tracker.{axis}" for axis in "xyz"]


def recorded(experiment: Experiment, count: int, seed: int) -> Dataset:
    """Records of the arm with play, its joints from either side."""
    random, system = np.random.default_rng(seed), experiment.system
    channels = {f"arm.q{i}": random.uniform(-1, 1, count) for i in (1, 2, 3)}
    channels |= {f"arm.approach.q{i}": random.choice((-1.0, 1.0), count) for i in (1, 2, 3)}
    commands = Dataset(tuple(map(str, range(count))), channels)
    values = experiment.parameters.nominal()
    for i, lag in enumerate((0.004, -0.002, 0.003), 1):
        values[experiment.parameters.entry_names.index(f"arm.play.lag{i}")] = lag
    parameters = experiment.parameters.with_nominal(values)
    exact = measured_without_noise(
        SimulationRequest(system.arms, system.measurements, parameters, system.environment), commands
    )
    read = {name: x + random.normal(0, NOISE_M, count) for name, x in exact.items()}
    return replace(commands, channels={**channels, **read})


@cache
def calibrated() -> tuple[Experiment, Path]:
    """A calibration of the arm, and how it was configured."""
    folder = Path(mkdtemp())
    (folder / "arm.yaml").write_text(ARM)
    experiment = Experiment.load(folder / "arm.yaml")
    dataset = recorded(experiment, 100, 0)
    head = ["pose_id", *(f"q{i}_deg" for i in (1, 2, 3)), *(f"approach{i}" for i in (1, 2, 3)), "x_mm", "y_mm", "z_mm"]
    columns = [*(np.degrees(dataset.column(f"arm.q{i}")) for i in (1, 2, 3))]
    columns += [dataset.column(f"arm.approach.q{i}") for i in (1, 2, 3)]
    columns += [1000 * dataset.column(axis) for axis in AXES]
    with (folder / "data.csv").open("w", newline="") as file:
        csv.writer(file).writerows([head, *zip(dataset.ids, *columns, strict=True)])
    armcal("run", folder / "arm.yaml", "--out", folder / "run", "-q")
    return experiment, folder / "run" / "calibration.yaml"


def test_intervals_cover_the_play_whether_or_not_its_side_is_known() -> None:
    experiment, path = calibrated()
    calibration, told = Calibration.load(path), recorded(experiment, 600, 1)
    untold = replace(told, channels={n: x for n, x in told.channels.items() if "approach" not in n})
    still = replace(told, channels={n: 0 * x if "approach" in n else x for n, x in told.channels.items()})
    widths = []
    for commands, most in (
        (told, 0.93),
        (untold, 0.98),
        (still, 0.98),
    ):  # one side or the other covers more than a normal
        read, half = calibration.predict(commands)[0], calibration.plus_minus(commands).half_widths
        off = np.array([np.abs(told.column(axis) - read[axis]) for axis in AXES])
        widths.append(np.array([half[axis] for axis in AXES]))
        assert 0.87 < np.mean(off <= widths[-1]) < most
    assert np.median(widths[1]) > 5 * np.median(widths[0])
    np.testing.assert_array_equal(widths[1], widths[2])


def test_one_side_that_is_not_known_adds_what_it_makes() -> None:
    experiment, path = calibrated()
    calibration, told = Calibration.load(path), recorded(experiment, 5, 2)

    def came(side: float) -> Dataset:
        return replace(told, channels={**told.channels, "arm.approach.q2": np.full(5, side)})

    low, high = (calibration.predict(came(side))[0] for side in (-1.0, 1.0))
    known, unknown = (calibration.plus_minus(came(side)).deviations for side in (1.0, 0.0))
    for axis in AXES:
        whole = np.hypot(known[axis], (high[axis] - low[axis]) / 2)
        np.testing.assert_allclose(unknown[axis], whole, rtol=1e-3)
