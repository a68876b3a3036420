"""The verdict: each sentence appears when what it says is planted, and not otherwise."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.run.experiment import Experiment
from armcal.solve.estimator import estimate
from armcal.solve.identifiability import POOR_CONDITION, analyse
from armcal.solve.problem import Problem
from armcal.solve.suggestion import suggest
from click.testing import CliRunner

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
DEMO = str(CONFIGS / "demo.yaml")
COMPLIANCES = [f"arm.spring.k{i}" for i in range(7)]


def sentences(folder: Path, *settings: str, data: Path = CONFIGS / "demo.csv") -> str:
    """All findings of a run, in one text with their grades."""
    flags = [x for s in (*settings, "validation.folds=0", "evaluator=interpreted") for x in ("--set", s)]
    result = CliRunner().invoke(cli, ["run", DEMO, "--data", str(data), "--out", str(folder), "--json", *flags])
    assert result.exit_code == 0, result.output
    return "\n".join(f"{f['grade']}: {f['text']}" for f in json.loads(result.stdout)["verdict"]["findings"])


def disturbed(tmp_path: Path, change) -> Path:
    """The shipped data with its measured columns changed: ``change`` gets them as (N x 3, mm)."""
    lines = [line.split(",") for line in (CONFIGS / "demo.csv").read_text().splitlines()]
    columns = [lines[0].index(f"{axis}_mm") for axis in "xyz"]
    moved = change(np.array([[float(line[c]) for c in columns] for line in lines[1:]]))
    for line, point in zip(lines[1:], moved, strict=True):
        for column, value in zip(columns, point, strict=True):
            line[column] = repr(float(value))
    path = tmp_path / "disturbed.csv"
    path.write_text("\n".join(",".join(line) for line in lines) + "\n")
    return path


def test_sound_data_gives_no_warning(tmp_path: Path) -> None:
    told = sentences(tmp_path / "run")
    assert "warning:" not in told and "bad:" not in told
    assert "good: Residuals are as large as the declared noise" in told
    assert "good: Residuals of neighbouring records do not correlate" in told


def test_a_noise_stated_too_small_or_too_large_is_noticed(tmp_path: Path) -> None:
    assert "warning: Residuals are 5" in sentences(tmp_path / "a", "measurements.tracker.noise_mm=0.1")
    assert "was it stated too large" in sentences(tmp_path / "b", "measurements.tracker.noise_mm=5")


def test_a_drift_of_the_tracker_shows_as_correlated_neighbours(tmp_path: Path) -> None:
    data = disturbed(tmp_path, lambda points: points + 3 * np.sin(np.linspace(0, 9, len(points)))[:, None])
    assert "warning: Residuals of neighbouring records correlate" in sentences(tmp_path / "run", data=data)


def test_gross_errors_are_counted(tmp_path: Path) -> None:
    def spoil(points):
        points[[5, 50, 120]] += 25
        return points

    told = sentences(tmp_path / "run", "validation.holdout=0", data=disturbed(tmp_path, spoil))
    assert "five robust deviations of the training errors: 3 records, the worst" in told


def test_data_that_wants_a_negative_compliance_pushes_against_its_bound(tmp_path: Path) -> None:
    """With gravity turned round in the model, springs would have to push with their load."""
    told = sentences(tmp_path / "run", "statics.gravity_m_s2=[0, 0, 9.81]")
    assert "warning: The data pushes against a bound" in told
    assert "arm.spring.k1" in told.split("pushes against a bound")[1].splitlines()[0]


def test_a_poor_condition_is_told_and_not_called_undetermined() -> None:
    triangle = np.diag([1.0, 1e-3, 3e-8])
    known = analyse(triangle, np.ones(3), ("a", "b", "c"))
    assert known.rank == 3 and known.condition > POOR_CONDITION and not known.undetermined
    assert str(known.weakest) == "c alone"


def test_suggested_poses_tell_more_than_random_ones() -> None:
    """Judged by the determinant of the information, with the suggested poses really added to the data."""
    experiment = Experiment.load(DEMO, ["evaluator=interpreted"])
    system, dataset = experiment.system, experiment.read().subset(np.arange(60))
    problem = Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, dataset, "interpreted"
    )
    records = problem.records(dataset)
    found = estimate(problem, records, experiment.estimator.solve(problem, records, experiment.parameters.nominal()))
    joints = {f"arm.q{i}": "angle" for i in range(1, 7)}
    chosen = suggest(problem, dataset, found, joints, count=3)
    assert len({tuple(s.commands.values()) for s in chosen}) == 3
    assert chosen[2].shrink < chosen[0].shrink < 1

    def information(angles) -> float:
        count = len(dataset) + len(angles)
        channels = {n: np.concatenate([v, np.zeros(len(angles))]) for n, v in dataset.channels.items()}
        for i, joint in enumerate(joints):
            channels[joint][len(dataset) :] = [row[i] for row in angles]
        more = replace(dataset, ids=tuple(map(str, range(count))), channels=channels, rows=(), extra={})
        triangle = problem.triangular_factor(found.values, problem.records(more))
        return float(2 * np.sum(np.log(np.abs(np.diag(triangle)))))

    best = information([tuple(s.commands.values()) for s in chosen])
    levels = [np.unique(dataset.column(joint)) for joint in joints]
    rng = np.random.default_rng(5)
    others = [information([[rng.choice(level) for level in levels] for _ in range(3)]) for _ in range(60)]
    assert best > max(others)


@pytest.mark.parametrize("free", ["[]", "[arm.spring.k1]"])
def test_a_run_with_nothing_or_little_free_still_ends_in_a_report(tmp_path: Path, free: str) -> None:
    told = sentences(tmp_path / "run", f"parameters.free={free}")
    assert ("No parameter was free" in told) == (free == "[]")
    assert (tmp_path / "run" / "report.html").stat().st_size > 10_000
