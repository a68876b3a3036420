"""The shipped recording of a ball in two sockets: what its guide says comes out of the commands that it shows."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import forked
import numpy as np
import pytest

DEMO = Path(__file__).parents[2] / "configs" / "ball" / "demo.yaml"


def armcal(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    return forked.armcal(*map(str, arguments), cwd=DEMO.parents[2], environment={"ARMCAL_CC": "none"})


@pytest.fixture(scope="module")
def metrics(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ball") / "run"
    ran = armcal("run", DEMO, "--out", folder, "-q")
    assert ran.returncode == 0, ran.stderr
    return json.loads((folder / "metrics.json").read_text())


@pytest.mark.slow
def test_it_is_judged_on_positions_that_did_not_train(metrics):
    judged = {name for name, group in metrics["groups"].items() if not group["trained"]}
    assert judged == {"right", "raised"}
    error = metrics["error_mm"]
    assert error["nominal"]["holdout"]["mean"] > 2.0
    assert error["calibrated"]["holdout"]["mean"] < 0.08
    assert error["calibrated"]["holdout"]["distance_mean_of_groups"] < 0.02


def test_all_that_is_free_is_determined_by_the_postures(metrics):
    assert metrics["parameters"]["rank"] == metrics["parameters"]["free"] == 37
    assert metrics["parameters"]["undetermined"] == [] and {*metrics["parameters"]["determined_by"].values()} == {
        "data"
    }


@pytest.mark.slow
def test_without_the_known_distance_the_size_is_not_seen(tmp_path):
    ran = armcal("run", DEMO, "--out", tmp_path / "run", "--set", "measurements.sockets.distances=[]")
    assert ran.returncode == 2
    assert "scale is not observable" in ran.stderr and "give one length" in ran.stderr.lower()
    assert not (tmp_path / "run").exists()


@pytest.mark.slow
def test_a_known_distance_that_is_ten_times_too_small_is_no_calibration(tmp_path):
    """Everything shrinks with it, and fits: only the nominal arm contradicts."""
    wrong = "measurements.sockets.distances=[{between: [hole_0, hole_1], distance_mm: 5, noise_mm: 0.05}]"
    ran = armcal("run", DEMO, "--out", tmp_path / "run", "--set", wrong, "--set", "validation.folds=0")
    assert ran.returncode == 3
    assert "0.1 times as large as the nominal one" in " ".join((ran.stdout + ran.stderr).split())
    assert not (tmp_path / "run" / "calibration.yaml").exists()


def test_the_shipped_recording_is_what_its_configuration_simulates(tmp_path):
    assert armcal("simulate", DEMO, "--out", tmp_path / "again.csv").returncode == 0
    shipped, again = ((p).read_text().splitlines() for p in (DEMO.with_name("demo.csv"), tmp_path / "again.csv"))
    assert shipped[0] == again[0]
    numbers = [[[float(x) for x in row.split(",")[1:8]] for row in rows[1:]] for rows in (shipped, again)]
    assert np.allclose(*numbers, rtol=0, atol=1e-7)


def test_a_missing_library_is_named_without_a_traceback(tmp_path, monkeypatch):
    (tmp_path / "casadi.py").write_text("raise ModuleNotFoundError(\"No module named 'casadi'\", name='casadi')")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    command = [sys.executable, "-m", "armcal.cli", "run", DEMO, "--out", tmp_path / "run"]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode == 1
    assert "the library casadi is missing" in ran.stderr and "Traceback" not in ran.stderr


@pytest.mark.slow
def test_a_socket_that_no_record_has_is_told(tmp_path):
    change = "measurements.sockets.distances=[{between: [hole_0, hole_9], distance_mm: 50, noise_mm: 0.05}]"
    ran = armcal("check", DEMO, "--set", change)
    assert "states something of */hole_9, to which no record belongs" in ran.stderr
    assert "hole_0, to which" not in ran.stderr


def test_what_an_error_of_the_known_distance_does_is_noted(metrics):
    """1 % of it passed as a good calibration without a word: no residual shows it where lengths are free."""
    (note,) = [f["text"] for f in metrics["verdict"]["findings"] if "rests on the known distances alone" in f["text"]]
    assert "1 % of them is 1 % of all its lengths (" in note and "mm at the arm's reach)" in note
