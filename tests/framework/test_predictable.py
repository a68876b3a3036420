"""What other records predict of residuals: planted functions and what carries them, nothing of noise, few records."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from armcal.cli.main import cli
from armcal.diagnose.predictable import FEWEST_POSES, LEVEL, predictable
from armcal.diagnose.residual_structure import percent, structure, structure_findings
from armcal.diagnose.score_tests import FitRows, linear_fit
from armcal.diagnose.verdict import _left
from armcal.estimate.robust import fit
from armcal.problem.motion import Motion
from armcal_ipopt.estimator import IpoptEstimator
from click.testing import CliRunner
from fits import fit_of
from noise_cases import FEW, NOISE_M, posed
from scipy.stats import binom

COUNT = 240
UR10 = Path(__file__).resolve().parents[3] / "shared" / "data" / "ur10_leica" / "random_poses.csv"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "pose_residual.md"


def fitted(lrm, count=COUNT, poses=None):
    """A fit to poses anywhere of an arm without any structure: problem, records, estimate, motion, dataset."""
    rng = np.random.default_rng(5)
    q = rng.uniform(-1.7, 1.7, (poses or count, 6))[np.arange(count) % (poses or count)]
    points = oracle.tip(oracle.published(), q) + NOISE_M * rng.normal(size=(count, 3))
    sides = {f"arm.approach.q{i + 1}": rng.choice((-1.0, 1.0), count) for i in range(6)}
    more = {**sides, "temperature": rng.uniform(15, 30, count)}
    problem, records, start = posed(lrm, q, points, FEW, **more)
    estimate = fit(problem.with_records(records), IpoptEstimator(IpoptEstimator.Settings()), start).estimate
    dataset = lrm.dataset(q, points, **more)
    return problem, records, estimate, Motion.of(problem.with_records(records), estimate.values, dataset), dataset


class Residuals:
    """Residuals of a fit, replaced by noise of size 1 and what is planted, taken through the same fit."""

    def __init__(self, problem, records, estimate, motion, dataset):
        self.problem, self.motion, self.dataset = problem, motion, dataset
        self.rows = FitRows.of(problem.with_records(records), estimate)
        pair = np.zeros(len(self.rows.residual), dtype=np.intp), np.ones(len(dataset) - 1, dtype=bool)
        self.basis = linear_fit(self.rows.slopes, self.rows.residual, pair[0], self.rows.by_record, pair[1])[1]

    def along(self, joint, angle):
        """Rows of a joint that stands elsewhere (N; in units that make them 1 on average)."""
        raw = [slope[:, :, None] for slope in self.motion.along(f"arm.{joint}")]
        moved = self.rows.columns(raw)[:, 0]
        scale = np.sqrt(np.mean(moved[: len(self.rows.record_of)] ** 2))
        moved[: len(self.rows.record_of)] *= angle[self.rows.record_of] / scale
        return moved

    def judged(self, planted=0.0, seed=0, noise=None):
        own = np.random.default_rng(seed).normal(size=len(self.rows.residual)) if noise is None else noise.copy()
        own += planted
        own -= self.basis @ (self.basis.T @ own)
        return predictable(self.problem, replace(self.rows, residual=own), self.basis, self.motion, self.dataset)


@pytest.fixture(scope="module")
def arm(lrm):
    return Residuals(*fitted(lrm))


@pytest.mark.slow
def test_noise_is_not_predicted(lrm):
    small = Residuals(*fitted(lrm, 60))
    found = [small.judged(seed=seed) for seed in range(20)]
    assert sum(one.above_chance for one in found) <= 1
    assert max(one.share for one in found) < 0.1, "shares of noise are those of records held out"


@pytest.mark.slow
def test_neither_uneven_noise_nor_wild_records_are_a_dependence(lrm):
    small, found = Residuals(*fitted(lrm, 60)), []
    q = small.dataset.column("arm.q2")
    for seed in range(10):
        rng = np.random.default_rng(seed)
        wild = rng.standard_t(2, size=len(small.rows.residual))
        wild[: len(small.rows.record_of)] *= (0.3 + 3 * (np.abs(q) > 1))[small.rows.record_of]
        found.append(small.judged(noise=wild))
    assert sum(one.above_chance for one in found) <= 1


@pytest.mark.slow
def test_the_share_is_that_of_what_was_planted(arm):
    """An error that changes within 30 degrees, as of a gear: more than noise, of q2 and q4 alone."""
    q = {joint: arm.dataset.column(f"arm.{joint}") for joint in ("q2", "q4")}
    planted = arm.along("q2", 2 * np.sin(6 * q["q2"])) + arm.along("q4", 1.5 * np.cos(5 * q["q4"]))
    free = planted - arm.basis @ (arm.basis.T @ planted)
    share = free.var() / (1 + free.var())
    found = arm.judged(planted)
    assert found.above_chance and 0.7 * share < found.share < share + 0.05 and found.chance < 0.03
    assert [(one.kind, one.name) for one in found.carriers] == [("joint", "q2"), ("joint", "q4")]
    assert found == arm.judged(planted)


@pytest.mark.quick("time")
@pytest.mark.parametrize("kind", ["time", "temperature", "approach"])
def test_what_is_no_joint_is_named_too(arm, kind):
    count = np.arange(COUNT)
    recorded = {"time": np.sin(count / 30), "temperature": arm.dataset.column("temperature") / 5 - 4.5}
    planted = np.zeros(len(arm.rows.residual))
    if kind == "approach":
        planted = arm.along("q3", 0.7 * arm.dataset.column("arm.approach.q3"))
    else:
        planted[arm.rows.by_record[:, 0]] = recorded[kind]
    found = arm.judged(planted)
    assert found.above_chance and found.carriers[0].kind == kind
    assert found.carriers[0].name == ("q3" if kind == "approach" else "")


@pytest.mark.slow
def test_a_few_records_do_not_make_a_dependence(arm):
    """Three of them, 40 standard deviations off to one side, at angles of q1 beside each other."""
    near = np.argsort(arm.dataset.column("arm.q1"))[:3]
    planted = np.zeros(len(arm.rows.residual))
    planted[arm.rows.by_record[near, 0]] = 40.0
    found = arm.judged(planted)
    assert not found.above_chance or found.share < 0.05


@pytest.mark.slow
def test_of_too_few_poses_nothing_is_known_however_often_they_were_repeated(lrm):
    """Each pose was measured four times, and errs alike each time: no other pose says so."""
    parts = fitted(lrm, COUNT, FEWEST_POSES - 1)
    assert Residuals(*parts).judged() is None
    problem, records, estimate, _, dataset = parts
    own = fit_of(problem.with_records(records), estimate, dataset)
    left = own.of(structure)
    assert any("too few distinct poses" in finding.text for finding in structure_findings(left))
    assert all("nothing" not in sentence for sentence in _left(own))
    none = structure_findings(None)
    assert "too few" in none[0].text and none[0].grade == "note"


def run(tmp_path, residual):
    """The run on the page of the pose residual, with fewer records, and with or without the pose residual."""
    text = next(part for part in PAGE.read_text().split("```") if "random_poses.csv" in part).partition("\n")[2]
    text = text if residual else text.replace("    residual: {type: gaussian_process}\n", "")
    (tmp_path / "run.yaml").write_text(text)
    lines = UR10.read_text().splitlines(keepends=True)
    (tmp_path / "random_poses.csv").write_text("".join([lines[0], *lines[1::2]]))
    out = tmp_path / f"out_{residual}"
    result = CliRunner().invoke(cli, ["run", str(tmp_path / "run.yaml"), "--out", str(out), "-q"])
    assert result.exit_code == 0, result.output
    content = json.loads((out / "metrics.json").read_text())
    return content, content["structure"]["residual_structure"]["predictable"]


@pytest.mark.slow
@pytest.mark.skipif(not UR10.exists(), reason="measured data that are not published here")
def test_an_industrial_arm_leaves_what_joints_predict_and_learning_takes_it_away(tmp_path):
    content, before = run(tmp_path, False)
    told = next(f for f in content["verdict"]["findings"] if "is not noise" in f["text"])
    assert before["share"] > 0.8 and {one["kind"] for one in before["carriers"]} == {"joint"}
    assert told["grade"] == "warning" and "gaussian_process" in told["action"]
    assert "nothing" not in content["verdict"]["paragraph"].lower()
    _, after = run(tmp_path, True)
    assert after["share"] < before["share"] / 2


@pytest.mark.slow
def test_fits_without_structure_give_a_finding_as_often_as_stated(lrm):
    above = []
    for seed in range(120):
        rng = np.random.default_rng(seed)
        q = rng.uniform(-1.7, 1.7, (70, 6))
        points = oracle.tip(oracle.published(), q) + NOISE_M * rng.normal(size=(70, 3))
        problem, records, start = posed(lrm, q, points, FEW)
        estimate = fit(problem.with_records(records), IpoptEstimator(IpoptEstimator.Settings()), start).estimate
        dataset = lrm.dataset(q, points)
        motion = Motion.of(problem.with_records(records), estimate.values, dataset)
        own = Residuals(problem, records, estimate, motion, dataset)
        above.append(predictable(problem, own.rows, own.basis, motion, dataset).above_chance)
    print(f"{sum(above)} of {len(above)}")
    assert sum(above) <= binom.ppf(0.99, len(above), LEVEL)


@pytest.mark.parametrize(
    ("share", "text"), [(0.62, "62 %"), (0.097, "10 %"), (0.0949, "9 %"), (0.004, "0.4 %"), (0.0001, "0.1 %")]
)
def test_shares_are_written_without_an_exponent(share: float, text: str) -> None:
    assert percent(share) == text
