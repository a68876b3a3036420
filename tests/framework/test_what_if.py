"""``armcal what-if``: what one more record would tell, against differences of predictions and a larger covariance."""

from __future__ import annotations

import csv
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.run.experiment import Experiment
from click.testing import CliRunner, Result

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "configs" / "lrm_arm" / "demo.yaml"
POSES = DEMO.with_suffix(".csv")
STEP = 1e-6


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Path:
    """The demonstration's."""
    return demo_calibration


@pytest.fixture(scope="module")
def poses(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("poses") / "poses.csv"
    header, *rows = POSES.read_text().splitlines()
    path.write_text("\n".join([header, *rows[::10]]) + "\n")
    return path


def found(calibration: Path, poses: Path, *more: object) -> list[dict[str, Any]]:
    done = armcal("what-if", calibration, "--poses", poses, "--json", *more)
    assert done.exit_code == 0, done.output
    rows: list[dict[str, Any]] = json.loads(done.stdout)["poses"]
    return rows


def slopes(loaded: Calibration, names: tuple[str, ...], poses: Path) -> np.ndarray[Any, Any]:
    """Of predicted positions by parameters, by differences (poses x 3 x n)."""
    commands = Experiment.load(DEMO, data=poses).read()
    entries = [loaded.parameters.entry_names.index(name) for name in names]

    def tips(values: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        channels, _ = replace(loaded, parameters=loaded.parameters.with_nominal(values)).predict(commands)
        return np.stack([channels[f"tracker.{axis}"] for axis in "xyz"], axis=1)

    nominal, columns = loaded.parameters.nominal(), []
    here = tips(nominal)
    for entry in entries:
        moved = nominal.copy()
        moved[entry] += STEP
        columns.append((tips(moved) - here) / STEP)
    return np.stack(columns, axis=2)


@pytest.mark.slow
def test_bits_and_deviations_are_those_of_the_covariance_with_the_record(calibration: Path, poses: Path) -> None:
    loaded, rows = Calibration.load(calibration), found(calibration, poses)
    known = loaded.uncertainty.record
    lower = np.zeros((len(known.entries), len(known.entries)))
    for i, row in enumerate(known.covariance):
        lower[i, : len(row)] = row
    covariance = lower + np.tril(lower, -1).T
    noise = np.array(loaded.record.noise["scatter"]["tracker"]["covariance"])
    ids, jacobians = Experiment.load(DEMO, data=poses).read().ids, slopes(loaded, known.entries, poses)
    assert [row["bits"] for row in rows] == sorted((row["bits"] for row in rows), reverse=True)
    for row in rows[:4] + rows[-4:]:
        slope = jacobians[ids.index(row["id"])]
        forecast = slope @ covariance @ slope.T
        after = covariance - covariance @ slope.T @ np.linalg.solve(forecast + noise, slope @ covariance)
        bits = 0.5 * (np.linalg.slogdet(covariance)[1] - np.linalg.slogdet(after)[1]) / math.log(2)
        assert row["bits"] == pytest.approx(bits, rel=1e-3)
        assert row["prediction_sd_mm"] == pytest.approx(1000 * math.sqrt(np.linalg.eigvalsh(forecast)[-1]), rel=1e-3)
        left = dict(zip(known.entries, np.sqrt(np.diag(after) / np.diag(covariance)), strict=True))
        assert sorted(row["tells_most"].values()) == pytest.approx(sorted(left.values())[:3], rel=1e-4)
        for name, ratio in row["tells_most"].items():
            assert left[name] == pytest.approx(ratio, rel=1e-4)


def test_a_table_a_file_and_the_best_poses_first(calibration: Path, poses: Path, tmp_path: Path) -> None:
    out = tmp_path / "worth.csv"
    done = armcal("what-if", calibration, "--poses", poses, "--out", out)
    assert done.exit_code == 0 and "the best 10 of" in done.output
    rows, written = found(calibration, poses), list(csv.DictReader(out.open()))
    assert [row["id"] for row in written] == [row["id"] for row in rows]
    assert [float(row["bits"]) for row in written] == [row["bits"] for row in rows]
    assert [int(row["rank"]) for row in written] == list(range(1, len(rows) + 1))
    assert written[0]["tells_most"].count("%") == 3


@pytest.mark.slow
def test_bad_input_ends_with_2(calibration: Path, poses: Path, tmp_path: Path) -> None:
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    for arguments, expected in (
        ((tmp_path / "gone.yaml", "--poses", poses), "gone.yaml"),
        ((calibration, "--poses", tmp_path / "bad.csv"), "bad.csv"),
        ((calibration, "--poses", poses, "--out", poses), "another --out"),
        ((calibration, "--poses", poses, "--out", calibration), "another --out"),
    ):
        before = poses.read_bytes(), calibration.read_bytes()
        done = armcal("what-if", *arguments)
        assert done.exit_code == 2 and expected in done.stderr and done.stdout == "", done.output
        assert before == (poses.read_bytes(), calibration.read_bytes())
