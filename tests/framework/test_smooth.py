"""What other records predict of residuals: planted functions and what carries them, nothing of noise, few records."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import oracle
import pytest
from armcal.cli.main import cli
from armcal.diagnose.causes import Functions, Records, Smooth
from armcal.diagnose.fit import FitRows
from armcal.diagnose.residual_structure import (
    FEWEST_POSES,
    Contest,
    depends,
    percent,
    structure,
)
from armcal.estimate.robust import fit
from armcal.measure.groups import pose_numbers
from armcal.problem.variants import Motion
from armcal_ipopt.estimator import IpoptEstimator
from click.testing import CliRunner
from fits import fit_of, fit_that_left
from noise_cases import FEW, NOISE_M, posed
from scipy.stats import multivariate_normal

COUNT = 240
UR10 = Path(__file__).resolve().parents[3] / "shared" / "data" / "ur10_leica" / "random_poses.csv"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "pose_residual.md"


def fitted(lrm, count=COUNT, poses=None):
    """A fit to poses anywhere of an arm without any structure: problem, estimate, dataset."""
    rng = np.random.default_rng(5)
    q = rng.uniform(-1.7, 1.7, (poses or count, 6))[np.arange(count) % (poses or count)]
    points = oracle.tip(oracle.published(), q) + NOISE_M * rng.normal(size=(count, 3))
    sides = {f"arm.approach.q{i + 1}": rng.choice((-1.0, 1.0), count) for i in range(6)}
    more = {**sides, "temperature": rng.uniform(15, 30, count)}
    problem, records, start = posed(lrm, q, points, FEW, **more)
    problem = problem.with_records(records)
    estimate = fit(problem, IpoptEstimator(IpoptEstimator.Settings()), start).estimate
    return problem, estimate, lrm.dataset(q, points, **more)


class Residuals:
    """Residuals of a fit, replaced by noise of size 1 and what is planted, taken through the same fit."""

    def __init__(self, problem, estimate, dataset):
        self.dataset, self.motion = dataset, Motion.of(problem, estimate.values, dataset)
        rows = FitRows.of(problem, estimate)
        recorded = Records(problem, rows, dataset, self.motion)
        pose = pose_numbers(dataset, self.motion.channels)
        self.contest = Contest(recorded, [], [], [], pose, np.ones(len(dataset) - 1, dtype=bool))
        self.rows = rows

    def along(self, joint, angle):
        """Rows of a joint that stands elsewhere (N; in units that make them 1 on average)."""
        raw = [slope[:, :, None] for slope in self.motion.along(f"arm.{joint}")]
        moved = self.rows.columns(raw)[:, 0]
        scale = np.sqrt(np.mean(moved[: len(self.rows.record_of)] ** 2))
        moved[: len(self.rows.record_of)] *= angle[self.rows.record_of] / scale
        return moved

    def judged(self, planted=0.0, seed=0, noise=None):
        own = np.random.default_rng(seed).normal(size=len(self.rows.residual)) if noise is None else noise.copy()
        rows = replace(self.rows, residual=own + planted)
        return replace(self.contest, recorded=replace(self.contest.recorded, rows=rows)).outcome(frozenset(), True)


@pytest.fixture(scope="module")
def arm(lrm):
    return Residuals(*fitted(lrm))


@pytest.mark.slow
def test_noise_is_not_predicted(lrm):
    small = Residuals(*fitted(lrm, 60))
    assert sum(small.judged(seed=seed).shows for seed in range(20)) <= 1


@pytest.mark.slow
def test_neither_uneven_noise_nor_wild_records_are_a_dependence(lrm):
    small, found = Residuals(*fitted(lrm, 60)), []
    q = small.dataset.column("arm.q2")
    for seed in range(10):
        rng = np.random.default_rng(seed)
        wild = rng.standard_t(2, size=len(small.rows.residual))
        wild[: len(small.rows.record_of)] *= (0.3 + 3 * (np.abs(q) > 1))[small.rows.record_of]
        found.append(small.judged(noise=wild))
    assert sum(one.shows for one in found) <= 1


@pytest.mark.slow
def test_the_share_is_that_of_what_was_planted(arm):
    """An error that changes within 30 degrees, as of a gear: more than noise, of q2 and q4 alone."""
    q = {joint: arm.dataset.column(f"arm.{joint}") for joint in ("q2", "q4")}
    planted = arm.along("q2", 2 * np.sin(6 * q["q2"])) + arm.along("q4", 1.5 * np.cos(5 * q["q4"]))
    free = planted - arm.contest.basis @ (arm.contest.basis.T @ planted)
    share = free.var() / (1 + free.var())
    found = arm.judged(planted)
    assert found.predictable is not None and 0.7 * share < found.share < share + 0.05
    assert found.predictable.cause == "pose" and not found.in_order
    assert [one.words for one in found.predictable.carriers] == ["the angle of q2", "the angle of q4"]
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
    assert found.predictable is not None and found.predictable.carriers[0].kind == kind
    assert found.predictable.cause == ("time" if kind == "time" else "pose")
    assert kind != "approach" or "q3" in found.predictable.carriers[0].words


@pytest.mark.slow
def test_a_few_records_do_not_make_a_dependence(arm):
    """Three of them, 40 standard deviations off to one side, at angles of q1 beside each other."""
    near = np.argsort(arm.dataset.column("arm.q1"))[:3]
    planted = np.zeros(len(arm.rows.residual))
    planted[arm.rows.by_record[near, 0]] = 40.0
    found = arm.judged(planted)
    assert found.predictable is None or found.share < 0.05


def test_evidence_and_what_others_predict_are_those_of_a_gaussian_process():
    """Against the plain density, noise marginalised as the fit's degrees of freedom do, and a refit of each group."""
    rng = np.random.default_rng(1)
    columns, basis = rng.normal(size=(30, 6)), np.linalg.qr(rng.normal(size=(30, 4)))[0]
    residual = columns @ rng.normal(size=6) + rng.normal(size=30)
    residual -= basis @ (basis.T @ residual)
    smooth = Smooth.of([Functions(columns, columns)], basis)
    complement = np.linalg.svd(basis.T)[2][4:]
    free, y = complement @ columns, complement @ residual
    plain = []
    for ratio in np.logspace(-4, 3, 29):
        scale = y @ np.linalg.solve(np.eye(26) + ratio * free @ free.T, y) / 26
        alone = y @ y / 26
        plain.append(
            multivariate_normal(cov=scale * (np.eye(26) + ratio * free @ free.T)).logpdf(y)
            - multivariate_normal(cov=alone * np.eye(26)).logpdf(y)
        )
    assert smooth.gains(residual[:, None])[0] == pytest.approx(max(plain), rel=1e-9)
    ratio, group, others = np.logspace(-4, 3, 29)[int(np.argmax(plain))], np.arange(5), np.arange(5, 30)

    def missed(columns, sizes):
        gram = columns[others].T @ columns[others] + np.diag(sizes)
        known = np.linalg.solve(gram, columns[others].T @ residual[others])
        return np.sum((residual[group] - columns[group] @ known) ** 2)

    share = 1 - missed(np.hstack([basis, columns]), [0.0] * 4 + [1 / ratio] * 6) / missed(basis, [0.0] * 4)
    assert smooth.predicted(residual, [group])[1] == pytest.approx(share, rel=1e-5)  # of one group nothing is bounded


@pytest.mark.slow
def test_of_too_few_poses_nothing_is_known_however_often_they_were_repeated(lrm):
    """Each pose was measured four times, and errs alike each time: no other pose says so."""
    problem, estimate, dataset = fitted(lrm, COUNT, FEWEST_POSES - 1)
    own = fit_of(problem, estimate, dataset)
    left = own.of(structure)
    assert left.poses == FEWEST_POSES - 1 and left.predictable is None
    assert any("too few distinct poses" in finding.text for finding in depends(fit_that_left(left)))
    none = depends(fit_that_left(None))
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
    return content, content["structure"]["residual_structure"]


@pytest.mark.slow
@pytest.mark.skipif(not UR10.exists(), reason="measured data that are not published here")
def test_an_industrial_arm_leaves_what_joints_predict_and_learning_takes_it_away(tmp_path):
    content, before = run(tmp_path, False)
    told = next(f for f in content["verdict"]["findings"] if "is not noise" in f["text"])
    assert before["share"] > 0.8 and {one["kind"] for one in before["predictable"]["carriers"]} == {"joint"}
    assert told["grade"] == "warning" and "gaussian_process" in told["action"]
    assert "nothing" not in content["verdict"]["paragraph"].lower()
    _, after = run(tmp_path, True)
    assert after["share"] < before["share"] / 2


@pytest.mark.parametrize(
    ("share", "text"), [(0.62, "62 %"), (0.097, "10 %"), (0.0949, "9 %"), (0.004, "0.4 %"), (0.0001, "0.1 %")]
)
def test_shares_are_written_without_an_exponent(share: float, text: str) -> None:
    assert percent(share) == text
