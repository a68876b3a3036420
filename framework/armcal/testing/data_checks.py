"""Checks on readers, simulators, exporters and estimators: known files, small problems whose answer is known."""

import tempfile
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
from pydantic import ValidationError
from typing_extensions import override

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.domains import Interval
from armcal.calibration.exporter import Exporter, ExportRequest
from armcal.config.system import StaticsSettings, System
from armcal.diagnose.checks import Finding
from armcal.diagnose.fit import Fit, Prepared
from armcal.errors import InputError, ProblemError
from armcal.estimate.estimator import Estimator, Solution, SolverVerdict
from armcal.estimate.online import Gaussian, Linearised, Observation, OnlineEstimator, Update
from armcal.estimate.robust import plain_fit
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.estimate.start import Start
from armcal.estimate.validation import Split
from armcal.measure.measurement import Channel
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.problem.problem import Problem
from armcal.testing.checking import RESULTS, ContractError, NotRun, Subject, check, expect
from armcal.testing.planar import ARM, GRAVITY, NOISE_M, TRACKER, Tip, all_parameters, commands, dataset, planar_arms

# --- readers --------------------------------------------------------------------------------------------------------

_REFUSALS = (InputError, ValidationError)
_TABLE = """id,qw,qx,qy,qz,q1_deg,q2_deg,x_mm,y_mm,z_mm
r0,1,0,0,0,10,-20,541.6,0,-8.7
r1,0.8,0,0.6,0,30,45,324.5,0,-391.5
r2,0.96,0,-0.28,0,-60,5,293.4,0,464.6
r3,0,0,1,0,90,120,-216.5,0,-175
"""
_PLAIN: Mapping[str, Any] = {  # as ``csv`` reads it, in the form of a reader's own ``EXAMPLE_SOURCE``
    "files": {"data.csv": _TABLE},
    "path": "data.csv",
    "channels": {
        "arm.q1": np.radians((10, 30, -60, 90)),
        "arm.q2": np.radians((-20, 45, 5, 120)),
        "tracker.x": (0.5416, 0.3245, 0.2934, -0.2165),
        "tracker.z": (-0.0087, -0.3915, 0.4646, -0.175),
        "tracker.qw": (1, 0.8, 0.96, 0),
        "tracker.qy": (0, 0.6, -0.28, 1),
    },
}


class _Body(Tip):
    def channels(self) -> tuple[Channel, ...]:
        return (*super().channels(), *(Channel(f"q{axis}", "dimensionless") for axis in "wxyz"))


@check("reader", needed=True)
def it_reads_a_known_file_in_si_a_record_a_row(s: Subject) -> None:
    own = getattr(s.made, "EXAMPLE_SOURCE", None)
    s.source = _PLAIN if own is None else own
    files = s.source["files"].items()
    s.contents = {name: text.encode() if isinstance(text, str) else text for name, text in files}
    try:
        read = _read(s)
    except _REFUSALS as refusal:
        if own is None:
            raise NotRun("it reads no plain table, and has no EXAMPLE_SOURCE") from refusal
        raise ContractError(f"it refuses its own EXAMPLE_SOURCE: {refusal}") from refusal
    s.count = len(next(iter(s.source["channels"].values())))
    text = f"found {len(read)} records and {len(read.set_aside)} set aside, expected {s.count}"
    expect(len(read) == s.count, text)
    for name, expected in s.source["channels"].items():
        values, channel = read.column(name), np.asarray(expected, dtype=float)
        expect(float(np.abs(values - channel).max()) <= 1e-9, f"{name}: found {values}, expected {channel} (SI)")


@check("reader")
def a_cell_that_is_wrong_or_empty_is_reported_never_passed_over(s: Subject) -> None:
    """The last number of the second to last line becomes another text, in each file that has such a line."""
    if not any(b"," in content for content in s.contents.values()):
        raise NotRun("its example is not a table of text separated by commas")
    for cell in (b"not_a_number", b""):
        with suppress(*_REFUSALS):
            records = _read(s, cell)
            finite = all(np.isfinite(records.column(name)).all() for name in s.source["channels"])
            expect(
                (len(records) + len(records.set_aside) == s.count or bool(records.warnings))
                and (len(records) < s.count or not finite),
                f"found {len(records)} records and {len(records.set_aside)} set aside of {s.count} rows, "
                f"one of them with {cell.decode() or 'nothing'!r} in a cell; "
                "expected it refused, or set aside with a reason",
            )


def _read(s: Subject, cell: bytes | None = None) -> Dataset:
    if "path" not in type(s.settings).model_fields:
        raise NotRun("its settings have no path")
    instrument = _Body() if f"{TRACKER}.qw" in s.source["channels"] else Tip()
    measurements = {TRACKER: instrument} if f"{TRACKER}.x" in s.source["channels"] else {}
    arms = planar_arms([ARM])
    with tempfile.TemporaryDirectory() as folder:
        for name, content in s.contents.items():
            path = Path(folder, name)
            path.parent.mkdir(parents=True, exist_ok=True)
            lines = content.split(b"\n")
            filled = [i for i, line in enumerate(lines) if b"," in line]
            if cell is not None and len(filled) > 1:
                lines[filled[-2]] = lines[filled[-2]].rpartition(b",")[0] + b"," + cell
            path.write_bytes(b"\n".join(lines))
        reader = s.with_settings(path=str(Path(folder, s.source["path"])))
        read: Dataset = reader.read(
            ReadRequest(arms, measurements, requested_channels(arms, measurements, measured=True))
        )
    return read


def _records(s: Subject, reader: Any) -> object:
    read = _read(s)
    return read.ids, dict(read.channels)


RESULTS["reader"] = _records

# --- exporters, of a planar arm --------------------------------------------------------------------------------------


def _exported(exporter: Exporter) -> object:
    arm = planar_arms([ARM])[ARM]
    nominal = {block.name: np.array(block.nominal) for block in arm.parameters()}
    request = ExportRequest(ARM, arm, {name: value.copy() for name, value in nominal.items()})
    try:
        exported = exporter.export(request)
    except InputError as refusal:
        return str(refusal)
    same = all(np.array_equal(value, request.values[name]) for name, value in nominal.items())
    expect(same, "it changes the values that it is given")
    expect(isinstance(exported.content, bytes), f"found content of type {type(exported.content).__name__}, not bytes")
    return exported.content, dict(exported.companions)


@check("exporter")
def it_writes_an_arm_or_refuses_it_by_an_armcal_error_and_leaves_its_values_alone(s: Subject) -> None:
    _exported(s.built)


RESULTS["exporter"] = lambda s, exporter: _exported(exporter)

# --- estimators: tip positions of an arm whose parameters are known -------------------------------------------------

_POSES, _TOLERANCE = 12, 1e-6
_TRUTH = {"a1": 0.31, "a2": 0.243, "theta1": 0.05, "theta2": -0.08, "side": 0.02}
_UPPER_SIDE_M, _PRIOR_SD_M = 0.015, 4e-4
_SIDE = f"{ARM}.planar.side"


@check("estimator", needed=True)
def it_converges_to_the_truth_and_keeps_to_the_bounds(s: Subject) -> None:
    s.posed = _posed(Interval(upper=_UPPER_SIDE_M))
    solution = _solved(s.built, s.posed)
    expect(solution.verdict.converged, f"found the verdict {solution.verdict.status!r}, expected convergence")
    s.posed.parameters.check(solution.values)
    _expect_near(solution, {**_TRUTH, "side": _UPPER_SIDE_M})


@check("estimator")
def it_weighs_records_and_priors(s: Subject) -> None:
    """``side`` is then the weighted mean of y and of its prior at zero, by which nothing else moves."""
    problem, random = _posed(Interval(), _PRIOR_SD_M), np.random.default_rng(6)
    noisy = problem.records[0].record.copy()
    noisy[:, :_POSES] += random.normal(0.0, 3 * NOISE_M, (len(noisy), _POSES))
    weights = random.uniform(0.2, 5.0, _POSES)
    weighted = problem.with_records((replace(problem.records[0], record=noisy),)).weighted((weights,))
    y = noisy[problem.kernels[0].factor.channels.index(f"{TRACKER}.y"), :_POSES]
    mean = weights @ y / (weights.sum() + (NOISE_M / _PRIOR_SD_M) ** 2)
    _expect_near(_solved(s.built, weighted), {"side": mean})


@check("estimator")
def cut_short_it_reports_that_it_did_not_converge(s: Subject) -> None:
    if "max_iterations" not in type(s.settings).model_fields:
        raise NotRun("its settings have no max_iterations")
    verdict = _solved(s.with_settings(max_iterations=1), s.posed).verdict
    expect(not verdict.converged, "found converged after one iteration, expected not converged")


@check("check")
def of_a_sound_fit_it_gives_findings_or_none_and_none_is_bad(s: Subject) -> None:
    """Exact tips of an arm of two joints, and its true parameters; no other column is there."""
    problem, every = _posed(Interval()), np.arange(_POSES, dtype=np.intp)
    system = System(problem.blueprint.arms, problem.blueprint.measurements, StaticsSettings(), {})
    ready = Prepared(system, _measured(), problem, Split(every, every[:0]), Start(problem))
    true = Solution(np.array(list(_TRUTH.values())), SolverVerdict("exact", "", True, 1, 0.0))
    exact: Any = SimpleNamespace(solve=lambda *given: true)  # an estimator that knows the truth
    fit = Fit(ready, plain_fit(problem, true), exact)
    findings = s.made(ready if getattr(s.made, "before_fit", False) else fit)
    listed = isinstance(findings, list | tuple) and all(isinstance(one, Finding) for one in findings)
    expect(listed, f"found {findings!r}, expected a list of armcal.Finding, empty where there is nothing to say")
    bad = [one.text for one in findings if one.grade == "bad"]
    expect(not bad, f"found {bad} of a sound fit, expected nothing bad")


RESULTS["estimator"] = lambda s, estimator: _solved(estimator, s.posed).values


def _posed(side: Interval, prior_sd: float | None = None) -> Problem:
    """Exact tip positions; ``side`` moves y alone, so neither its bound nor its prior disturbs the rest."""
    arms, measurements = planar_arms([ARM]), {TRACKER: Tip()}
    parameters, records = all_parameters(arms), _measured()
    block = replace(parameters[_SIDE], domain=side, prior_sd=prior_sd)
    parameters = parameters.replaced({_SIDE: block}).with_free(parameters.names)
    return Problem.build(arms, measurements, parameters, GRAVITY, records, "interpreted")


def _measured() -> Dataset:
    arms = planar_arms([ARM])
    true = all_parameters(arms).with_nominal(np.array(list(_TRUTH.values())))
    moved = dataset(commands(arms, _POSES, np.random.default_rng(5)))
    exact = measured_without_noise(SimulationRequest(arms, {TRACKER: Tip()}, true, GRAVITY), moved)
    return dataset({**moved.channels, **exact})


def _solved(estimator: Estimator, problem: Problem) -> Solution:
    start = problem.parameters.nominal()
    solution = estimator.solve(problem, start)
    expect(bool(np.array_equal(start, problem.parameters.nominal())), "it changed the start that it was given")
    return solution


def _expect_near(solution: Solution, answers: Mapping[str, float]) -> None:
    for name, value in zip(_TRUTH, solution.values, strict=True):
        answer = answers.get(name, value)
        expect(abs(value - answer) <= _TOLERANCE, f"{name}: found {value:.9g}, expected {answer:.9g}")


# --- online estimators: a linear problem whose answer is a sum of information ---------------------------------------

_STATES, _ROWS = 4, 2
_SHARE = 1e-7  # how far a number may be off, in its standard deviation


@dataclass(frozen=True)
class _Line(Observation):
    """A record whose prediction is linear in the state, so that it looks alike from anywhere."""

    measured: Array
    slope: Array
    noise: Array

    @override
    def at(self, point: Array) -> Linearised:
        return Linearised(self.measured - self.slope @ point, self.slope, self.noise)


@check("online", needed=True)
def it_finds_what_prior_and_record_say_together(s: Subject) -> None:
    random, noise = np.random.default_rng(3), np.array([[0.2, 0.05], [0.05, 0.1]])
    root = random.normal(size=(_STATES, _STATES))
    s.prior = Gaussian(random.normal(size=_STATES), root @ root.T + np.eye(_STATES))
    truth = s.prior.mean + root @ random.normal(size=_STATES)
    slope = random.normal(size=(_ROWS, _STATES))
    s.line = line = _Line(slope @ truth + 0.3 * random.normal(size=_ROWS), slope, noise)
    update = _updated(s, s.built)
    right, covariance = _known(s.prior, line), update.posterior.covariance
    expect(bool((covariance == covariance.T).all()), "found a covariance that is not symmetric")
    sd = np.sqrt(np.diag(right.covariance))
    off = float(np.abs((update.posterior.mean - right.mean) / sd).max())
    expect(off < _SHARE, f"found a mean {off:.1e} standard deviations off")
    wide = float(np.abs((covariance - right.covariance) / np.outer(sd, sd)).max())
    expect(wide < _SHARE, f"found a covariance {wide:.1e} off, in units of variances")
    innovation = update.innovation - (line.measured - slope @ s.prior.mean)
    covariance = update.covariance - (slope @ s.prior.covariance @ slope.T + noise)
    off = max(float(np.abs(innovation).max()), float(np.abs(covariance).max()))
    expect(off < _SHARE, f"found an innovation or its covariance (the NIS) {off:.1e} off")


@check("online")
def a_variance_below_zero_is_an_error(s: Subject) -> None:
    blind = _Line(s.line.measured, s.line.slope * [1, 1, 1, 0], s.line.noise)
    with suppress(ProblemError, np.linalg.LinAlgError), np.errstate(invalid="ignore"):
        s.built.update(Gaussian(s.prior.mean, np.diag([1.0, 1.0, 1.0, -0.5])), blind)
        raise ContractError("found a belief made of a variance of -0.5, expected armcal.errors.ProblemError")


def _updated(s: Subject, estimator: OnlineEstimator) -> Update:
    mean, covariance = s.prior.mean.copy(), s.prior.covariance.copy()
    update = estimator.update(s.prior, s.line)
    same = np.array_equal(mean, s.prior.mean) and np.array_equal(covariance, s.prior.covariance)
    expect(same, "it changed the prior that it was given")
    return update


RESULTS["online"] = lambda s, estimator: vars(_updated(s, estimator).posterior)


def _known(prior: Gaussian, line: _Line) -> Gaussian:
    """By information: what prior and record say."""
    information, weighted = np.linalg.inv(prior.covariance), line.slope.T @ np.linalg.inv(line.noise)
    covariance = np.linalg.inv(information + weighted @ line.slope)
    covariance = (covariance + covariance.T) / 2
    return Gaussian(covariance @ (information @ prior.mean + weighted @ line.measured), covariance)
