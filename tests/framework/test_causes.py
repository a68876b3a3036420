"""Causes of residual structure: planted ones are named, or said to be open; one that is not listed is not renamed."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import oracle
import pytest
from armcal.cli.main import cli
from armcal.diagnose.causes import predicted_positions
from armcal.diagnose.fit import FitRows
from armcal.diagnose.gross import scale_deviation
from armcal.diagnose.residual_structure import LEVEL, UNLISTED, depends, neighbours, structure
from armcal.estimate.robust import fit
from armcal_ipopt.estimator import IpoptEstimator
from click.testing import CliRunner
from fits import fit_of, fit_that_left, whole
from noise_cases import NOISE_M, posed

DEG = np.pi / 180
LEVELS = np.array([100, 50, 100, 100, 100, 50]) * DEG
DEMO = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
COUNT = 150
QUICKLY = ("--set", "validation.folds=0", "--set", "evaluator=interpreted")
NAMED = {
    "gravity": ("gravity", "", "the direction of gravity"),
    "payload": ("load", "", "a load at the tool"),
    "heavy payload": ("load", "", "a load at the tool"),
    "scale": ("scale", "z", "scale along z"),
    "coupling": ("coupling", "q4 on q5", "q4 moves q5"),
    "step": ("step", "", "jumps there as a whole"),
    "hysteresis": ("approach", "q4", "the side q4 was approached from"),
}
"""What is planted: its kind and subject, and words that any sentence naming it has."""


def poses(seed, in_order=False):
    """Each joint on one of three levels, one after another at random or nested, and the side it came from."""
    q = np.random.default_rng(seed).integers(-1, 2, (COUNT, 6)) * LEVELS
    q = q[np.lexsort(q.T[::-1])] if in_order else q
    came = np.sign(np.diff(q, axis=0, prepend=q[:1]))
    for i in range(1, COUNT):
        came[i] = np.where(came[i] == 0, came[i - 1], came[i])
    return q, came


def loads_of(name, rng):
    """What really acts on the arm."""
    if name == "gravity":
        way = rng.uniform(0, 2 * np.pi)
        return oracle.Loads(
            gravity=9.81 * np.array([*(np.sin(3 * DEG) * np.array([np.cos(way), np.sin(way)])), -0.9986])
        )
    return oracle.Loads(payload_mass={"payload": 0.1, "heavy payload": 0.5}.get(name, 0.0))


def measured(name, seed, q, came):
    """Points that the oracle's published arm shows with one thing that the model does not know of (N x 3)."""
    rng, stands, time = np.random.default_rng(seed + 777), q.copy(), np.arange(COUNT)
    if name == "coupling":
        stands[:, 4] += 0.01 * q[:, 3]
    if name == "hysteresis":
        stands[:, 3] -= 0.4 * DEG * came[:, 3]
    points, noise = oracle.tip(oracle.published(), stands, loads_of(name, rng)), np.full(COUNT, NOISE_M)
    if name == "scale":
        points = points * [1, 1, 1.003]
    if name == "step":
        points[rng.integers(COUNT // 4, 3 * COUNT // 4) :] += [0.001, -0.0006, 0.0004]
    if name in ("smooth", "slow joints"):
        slope, phase = rng.normal(size=(3, 6)), rng.uniform(0, 6, 3)
        slope *= [1, 1, 1, 0, 0, 0] if name == "slow joints" else 0.6
        points = points + 0.0015 * np.sin(q @ slope.T + phase)
    if name == "drift":
        near = np.exp(-np.abs(time[:, None] - time) / 10) + 1e-9 * np.eye(COUNT)
        points = points + 0.001 * np.linalg.cholesky(near) @ rng.normal(size=(COUNT, 3))
    if name == "growing noise":
        noise = noise * (0.5 + 2 * time / COUNT)
    if name == "larger noise":
        noise = 2 * noise
    return points + noise[:, None] * rng.normal(size=points.shape)


def found_in(lrm, name, seed, in_order=False):
    """What is left in the residuals of a fit of all published parameters; q4's approach is not recorded."""
    q, came = poses(seed, in_order)
    points = measured(name, seed, q, came)
    columns = {f"arm.approach.q{i + 1}": came[:, i] for i in range(6) if name != "hysteresis"}
    problem, records, start = posed(lrm, q, points, oracle.OPTION_1, **columns)
    problem = problem.with_records(records)
    estimate = fit(problem, IpoptEstimator(IpoptEstimator.Settings()), start).estimate
    dataset = lrm.dataset(q, points, **columns)
    return structure(fit_of(problem, estimate, dataset))


def graded(found, name):
    """``right``, ``wrong``, ``open`` or ``nothing``, by what the findings say."""
    kind, subject, words = NAMED.get(name, ("", "", "no such words"))
    alone = {(s.kind, s.subject) for s in found.worthwhile if not s.alternatives}
    if alone - {(kind, subject)}:
        return "wrong"
    if alone:
        return "right"
    possible = [w for s in found.worthwhile for w in (s.words, *s.alternatives)]
    if not possible:
        return "nothing"
    return "open" if any(words in w or w == UNLISTED for w in possible) else "missed"


def said(found):
    return " ".join(whole(finding) for finding in depends(fit_that_left(found)))


@pytest.mark.parametrize("name", NAMED)
@pytest.mark.slow
def test_a_planted_cause_is_named_or_said_to_be_open(lrm, name):
    found = found_in(lrm, name, 3)
    assert graded(found, name) in (("open",) if name == "heavy payload" else ("right", "open"))
    assert NAMED[name][2] in said(found)
    assert (graded(found, name) == "open") == ("do not identify which" in said(found))


@pytest.fixture(scope="module")
def smooth(lrm):
    """What is found in an error of the pose that is none of the causes."""
    return found_in(lrm, "smooth", 4)


@pytest.mark.slow
def test_what_is_not_among_the_causes_is_not_given_the_name_of_one(smooth):
    found = smooth
    assert graded(found, "smooth") != "wrong" and found.predictable is not None
    assert "is not noise: other records predict it" in said(found)


@pytest.mark.slow
def test_what_is_significant_but_less_likely_than_chance_is_no_finding(lrm):
    """Of noise: the one recording in twenty or so of which the best of 200 causes has a family-wise p of 0.01."""
    found = found_in(lrm, "none", 62)
    assert found.more is False and not found.structures
    assert "explains the remaining error" in said(found)


@pytest.mark.slow
def test_how_large_an_unseen_scale_may_be_is_not_a_matter_of_chance(lrm):
    """The noise of the positions, taken for a part of the scale, made its deviation half as large."""
    q, _ = poses(1)
    exact, found = oracle.tip(oracle.published(), q), []
    for noise in (0.0, 4 * NOISE_M):
        points = exact + noise * np.random.default_rng(2).normal(size=exact.shape)
        problem, records, start = posed(lrm, q, points, oracle.OPTION_1)
        estimate = fit(problem.with_records(records), IpoptEstimator(IpoptEstimator.Settings()), start).estimate
        problem = problem.with_records(records)
        read = predicted_positions(problem, estimate.values, lrm.dataset(q, points))
        found.append(scale_deviation(problem, FitRows.of(problem, estimate), read, 1.0, estimate.values))
    assert found[1] == pytest.approx(found[0], rel=0.15)


@pytest.mark.slow
def test_noise_that_grows_is_noise_that_depends_on_the_order(lrm):
    found = found_in(lrm, "growing noise", 5)
    assert found.noise is not None and found.noise.words == "the recorded order"
    assert found.noise.low < 1.3 < 1.8 < found.noise.high
    assert "The spread of the residuals depends on the recorded order" in said(found)
    assert graded(found, "growing noise") == "nothing"


@pytest.mark.slow
def test_larger_noise_is_not_said_to_be_the_models_error(tmp_path):
    """Nothing but noise, of twice the declared size, through the command line."""
    flags = ["--set", "measurements.tracker.noise_mm=0.25", *QUICKLY, "--json"]
    result = CliRunner().invoke(cli, ["run", str(DEMO / "demo.yaml"), "--out", str(tmp_path / "out"), *flags])
    assert result.exit_code == 0, result.output
    findings = json.loads(result.stdout)["verdict"]["findings"]
    told = next(f for f in findings if "times the declared noise" in f["text"])
    assert told["text"].startswith("Residuals are 2.0 times the declared noise")
    assert "which this test cannot separate" in told["text"] and "not the tracker's" not in told["text"]
    assert "Repeat some poses" in told["action"]


@pytest.mark.slow
def test_a_stretched_instrument_is_named_by_the_command(tmp_path):
    lines = [line.split(",") for line in (DEMO / "demo.csv").read_text().splitlines()]
    z = lines[0].index("z_mm")
    rows = [[*line[:z], str(1.004 * float(line[z])), *line[z + 1 :]] for line in lines[1:]]
    (tmp_path / "data.csv").write_text("\n".join(",".join(line) for line in [lines[0], *rows]) + "\n")
    arguments = ["run", str(DEMO / "demo.yaml"), "--data", str(tmp_path / "data.csv"), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(cli, [*arguments, "--json", *QUICKLY])
    assert result.exit_code == 0, result.output
    structure = json.loads((tmp_path / "out" / "metrics.json").read_text())["structure"]
    first = structure["residual_structure"]["structures"][0]
    assert (first["kind"], first["subject"]) == ("scale", "z") and first["odds"] > 0.5
    assert first["size"].startswith("share: 0.")


@pytest.mark.slow
def test_late_joints_are_named_by_the_command_from_columns_of_their_rates(tmp_path):
    """Joints read 100 ms before the tip, at some 10 deg/s; a rate that is missing costs no record."""
    lines = [line.split(",") for line in (DEMO / "demo.csv").read_text().splitlines()]
    joints, rng = [lines[0].index(f"q{i}_deg") for i in range(1, 7)], np.random.default_rng(1)
    rows = [[*lines[0], *(f"q{i}_rate_deg_s" for i in range(1, 7))]]
    for line in lines[1:]:
        rates, late = 10 * rng.normal(size=6), list(line)
        for place, rate in zip(joints, rates, strict=True):
            late[place] = str(float(line[place]) - 0.1 * rate)
        rows.append([*late, *map(str, rates)])
    rows[3][-1] = ""
    (tmp_path / "data.csv").write_text("\n".join(map(",".join, rows)) + "\n")
    arguments = ["run", str(DEMO / "demo.yaml"), "--data", str(tmp_path / "data.csv"), "--out", str(tmp_path / "out")]
    result = CliRunner().invoke(cli, [*arguments, "--json", *QUICKLY])
    assert result.exit_code == 0, result.output
    findings = json.loads(result.stdout)["verdict"]["findings"]
    named = next(f for f in findings if "how fast the joints moved" in f["text"])
    assert "joints late by about 100 ms, to first order" in named["text"]
    assert "synchronise the clocks" in named["action"]
    metrics = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert "set aside" not in json.dumps(metrics) and len(lines) == 201
    kept = (tmp_path / "out" / "residuals.csv").read_text().splitlines()
    assert len(kept) == len(lines)


@pytest.mark.parametrize(("name", "in_order", "cause"), [("drift", False, "time"), ("slow joints", True, "open")])
@pytest.mark.slow
def test_time_is_blamed_only_where_poses_do_not_follow_it(lrm, name, in_order, cause):
    found = found_in(lrm, name, 0, in_order)
    assert found.lag_p <= LEVEL
    assert found.predictable is not None and found.predictable.cause == cause
    finding = next(f for f in depends(fit_that_left(found)) if "time" in f.text and "pose predicts" in f.text)
    assert ("It goes with time" in finding.text) == (cause == "time")
    assert ("Let the base drift" in finding.action) == (cause == "time")
    assert ("do not show whether the pose or time is the cause" in finding.text) == (cause == "open")
    assert neighbours(fit_that_left(found))[0].grade == "note"


@pytest.mark.slow
@pytest.mark.parametrize("name", [*NAMED, "growing noise", "larger noise", "none"])
def test_causes_are_named_wrong_at_most_once_in_twenty(lrm, name):
    grades = [graded(found_in(lrm, name, seed), name) for seed in range(50, 70)]
    print(name, {grade: grades.count(grade) for grade in sorted(set(grades))})
    assert grades.count("wrong") + grades.count("missed") <= 1
    assert name not in NAMED or grades.count("nothing") <= 1


@pytest.mark.slow
@pytest.mark.parametrize("name", ["smooth", "slow joints"])
def test_a_function_of_the_pose_in_nested_order_is_not_called_time(lrm, name):
    found = [found_in(lrm, name, seed, in_order=True) for seed in range(20)]
    print(name, [one.predictable.cause if one.predictable else "-" for one in found])
    blamed = [
        (one.predictable is not None and one.predictable.cause == "time")
        or any(s.kind in ("order", "step", "slip") and not s.alternatives for s in one.worthwhile)
        for one in found
    ]
    assert sum(blamed) <= 1
