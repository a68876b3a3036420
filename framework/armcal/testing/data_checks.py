"""Checks on readers, simulators, estimators and exporters: known files, small problems whose answer is known."""

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any

import numpy as np
from pydantic import ValidationError
from typing_extensions import override

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset, SetAside
from armcal.base.domains import Interval
from armcal.base.parameters import Parameters
from armcal.base.units import from_unit, split_suffix
from armcal.calibration.exporter import Exported, ExportRequest
from armcal.errors import InputError, ProblemError
from armcal.estimate.estimator import Estimator, Solution
from armcal.estimate.online import Gaussian, Linearised, Observation, Update
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.measure.measurement import Measurement
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.problem.problem import FactorRecords, Problem
from armcal.testing.checking import ContractError, NotRun, Subject, check, expect, raises_only
from armcal.testing.planar import (
    ARM,
    GRAVITY,
    NOISE_M,
    QUATERNION,
    TRACKER,
    WALLS,
    Body,
    Tip,
    Walls,
    all_parameters,
    commands,
    dataset,
    planar_arms,
)

MISSING_FILE = "/no/such/folder/measurements"


# --- readers --------------------------------------------------------------------------------------------------------

_REFUSALS = (InputError, ValidationError)
_DAMAGED: Mapping[str, Mapping[str, bytes]] = {
    "an empty file": {"data": b""},
    "NUL bytes": {"data": b"\0" * 64},
    "text that is not UTF-8": {"data": b"id,q1_deg\n1,\xff\xfe\xfa\n"},
    "noise": {"data": bytes(np.random.default_rng(8).integers(0, 256, 4096, dtype=np.uint8))},
    "a cut-off line": {"data": b'id,q1_deg,q2_deg,x_mm,y_mm,z_mm\n1,10,"20'},
    "a folder in place of a file": {"data/data": b""},
}
_TABLE = """id,qw,qx,qy,qz,q1_deg,q2_deg,x_mm,y_mm,z_mm
r0,1,0,0,0,10,-20,541.6,0,-8.7
r1,0.8,0,0.6,0,30,45,324.5,0,-391.5
r2,0.96,0,-0.28,0,-60,5,293.4,0,464.6
r3,0,0,1,0,90,120,-216.5,0,-175
"""
"""As ``csv`` reads it, of a tip and of a body."""


@dataclass(frozen=True)
class _Source:
    """Files by name, which of them ``path`` names (the folder if empty), and what they say to whom."""

    files: Mapping[str, bytes]
    path: str
    channels: Mapping[str, Array]  # SI
    measurements: Mapping[str, Measurement]

    @property
    def count(self) -> int:
        return len(next(iter(self.channels.values())))


@check("reader")
def it_refuses_a_missing_file_a_damaged_one_and_a_folder_in_place_of_one(s: Subject) -> None:
    """By an armcal error; of a damaged one it may give no records."""
    method = getattr(s.built, "read", None)
    expect(callable(method), f"found read = {method!r}, expected a method")
    with suppress(*_REFUSALS):
        _read(s, Path(MISSING_FILE), {TRACKER: Tip()})
        raise ContractError("found no error for a file that is not there, expected it refused")
    for what, files in _DAMAGED.items():
        with suppress(*_REFUSALS), _written(files) as folder:
            read = _read(s, folder / "data", {TRACKER: Tip()})
            expect(len(read) == 0, f"found {len(read)} records made of {what}, expected it refused")


@check("reader", needed=True)
def it_reads_a_known_file_in_si_a_record_a_row_the_same_each_time(s: Subject) -> None:
    refused = []
    for source in _sources(s.made):
        try:
            first = _read_source(s, source)
        except _REFUSALS as refusal:
            refused.append(str(refusal))
            continue
        s.source = source
        text = f"found {len(first)} records and {len(first.set_aside)} set aside, expected {source.count}"
        expect(len(first) == source.count, text)
        for name, channel in source.channels.items():
            values = first.column(name)
            expect(float(np.abs(values - channel).max()) <= 1e-9, f"{name}: found {values}, expected {channel} (SI)")
        _expect_same(first, _read_source(s, source))
        return
    if hasattr(s.made, "EXAMPLE_SOURCE"):
        raise ContractError(f"it refuses its own EXAMPLE_SOURCE: {refused[0]}")
    raise NotRun("it reads no plain table, and has no EXAMPLE_SOURCE")


@check("reader")
def a_cell_that_is_wrong_or_empty_is_reported_never_passed_over(s: Subject) -> None:
    """The last number of the second to last line becomes another text, in each file that has such a line."""
    source: _Source = s.source
    for cell in ("not_a_number", ""):
        files = {name: _with_cell(content, cell) for name, content in source.files.items()}
        if files == dict(source.files):
            raise NotRun("its example is not a table of text separated by commas")
        with suppress(*_REFUSALS):
            records = _read_source(s, replace(source, files=files))
            finite = all(np.isfinite(records.column(name)).all() for name in source.channels)
            expect(
                (len(records) + len(records.set_aside) == source.count or bool(records.warnings))
                and (len(records) < source.count or not finite),
                f"found {len(records)} records and {len(records.set_aside)} set aside of {source.count} rows, "
                f"one of them with {cell or 'nothing'!r} in a cell; expected it refused, or set aside with a reason",
            )


def _read(s: Subject, path: Path, measurements: Mapping[str, Measurement]) -> Dataset:
    if "path" not in type(s.settings).model_fields:
        raise NotRun("its settings have no path")
    arms = planar_arms([ARM])
    request = ReadRequest(arms, measurements, requested_channels(arms, measurements, measured=True))
    with raises_only(*_REFUSALS, expected="armcal.errors.DataError with the file's name"):
        read = s.made(s.made.Settings.model_validate({**s.example, "path": str(path)})).read(request)
    if not isinstance(read, Dataset):
        raise ContractError(f"found {type(read).__name__}, expected a Dataset")
    texts = all(isinstance(own, str) for own in (*read.ids, *read.warnings, read.source, read.sha256))
    expect(texts, "found ids, warnings, source or sha256 that are no texts")
    kinds = all(isinstance(own, SetAside) for own in read.set_aside) and all(isinstance(row, int) for row in read.rows)
    expect(kinds, "found set_aside that are no SetAside, or rows that are no whole numbers")
    return read


def _expect_same(first: Dataset, again: Dataset) -> None:
    same = first.ids == again.ids and set(first.channels) == set(again.channels)
    expect(same, "found other records or channels the second time")
    for name, values in first.channels.items():
        expect(np.array_equal(values, again.channels[name], equal_nan=True), f"found other numbers in {name} again")


@contextmanager
def _written(files: Mapping[str, bytes]) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        for file, content in files.items():
            path = Path(name, file)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        yield Path(name)


def _read_source(s: Subject, source: _Source) -> Dataset:
    with _written(source.files) as folder:
        return _read(s, folder / source.path, source.measurements)


def _with_cell(content: bytes, cell: str) -> bytes:
    lines = content.decode("utf-8", "replace").split("\n")
    filled = [i for i, line in enumerate(lines) if "," in line]
    if len(filled) < 2:
        return content
    lines[filled[-2]] = f"{lines[filled[-2]].rpartition(',')[0]},{cell}"
    return "\n".join(lines).encode()


def _sources(made: Any) -> Iterator[_Source]:
    """A component's own ``EXAMPLE_SOURCE``, else a plain table, of a tip and of a body."""
    own = getattr(made, "EXAMPLE_SOURCE", None)
    if own is None:
        header, *rows = (line.split(",") for line in _TABLE.splitlines())
        cells = dict(zip(header[1:], np.array([row[1:] for row in rows], dtype=float).T, strict=True))
        read = {split[0]: from_unit(cells[name], split[1].name) for name in cells if (split := split_suffix(name))}
        channels = {f"{ARM if name.startswith('q') else TRACKER}.{name}": values for name, values in read.items()}
        yield _Source({"data.csv": _TABLE.encode()}, "data.csv", channels, {TRACKER: Tip()})
        turned = {f"{TRACKER}.{name}": cells[name] for name in QUATERNION}
        yield _Source({"data.csv": _TABLE.encode()}, "data.csv", {**channels, **turned}, {TRACKER: Body()})
        return
    expect(
        isinstance(own, Mapping) and set(own) == {"files", "path", "channels"},
        f"found EXAMPLE_SOURCE = {own!r}, expected a mapping with files, path and channels",
    )
    files = {name: text.encode() if isinstance(text, str) else text for name, text in own["files"].items()}
    channels = {name: np.array(values, dtype=float) for name, values in own["channels"].items()}
    measures = any(name.startswith(f"{TRACKER}.") for name in channels)
    yield _Source(files, own["path"], channels, {TRACKER: Tip()} if measures else {WALLS: Walls()})


# --- simulators and exporters, of a planar arm ----------------------------------------------------------------------


@check("simulator")
def it_simulates_what_every_instrument_reads_the_same_each_time(s: Subject) -> None:
    arms, refused = planar_arms([ARM]), []
    choices: tuple[Mapping[str, Measurement], ...] = ({TRACKER: Tip()}, {WALLS: Walls()})
    for measurements in choices:
        request = SimulationRequest(arms, measurements, all_parameters(arms), GRAVITY)
        try:
            first = s.built.simulate(request)
            break
        except InputError as fault:
            refused.append(str(fault))
    else:
        raise NotRun(f"its EXAMPLE does not suit the arm of the check: {'; '.join(refused)}")
    for requested in requested_channels(request.arms, request.measurements, measured=True):
        given = first.has(requested.channel) or not requested.required
        expect(given, f"found no {requested.channel} in the records, expected every required channel")
    for again in (s.built.simulate(request), s.build().simulate(request)):
        _expect_same(first, again)
    odd = [name for name, values in first.channels.items() if not np.isfinite(values).all()]
    expect(not odd, f"found numbers in {', '.join(odd)} that are not finite")


@check("exporter")
def an_arm_is_written_the_same_each_time_or_refused_by_an_armcal_error(s: Subject) -> None:
    request = _request()
    first = _exported(s.built, request)
    same = all(np.array_equal(value, request.values[name]) for name, value in _request().values.items())
    expect(same, "it changes the values that it is given")
    for other in (s.built, s.build()):
        expect(_exported(other, _request()) == first, "found other content, or another refusal, the second time")


def _request() -> ExportRequest:
    arm = planar_arms([ARM])[ARM]
    return ExportRequest(ARM, arm, {block.name: np.array(block.nominal) for block in arm.parameters()})


def _exported(exporter: Any, request: ExportRequest) -> Exported | str:
    """What it writes, or why it refuses."""
    try:
        with raises_only(InputError):
            exported = exporter.export(request)
    except InputError as refusal:
        return str(refusal)
    if not isinstance(exported, Exported):
        raise ContractError(f"found {type(exported).__name__}, expected armcal.calibration.exporter.Exported")
    for name, content in {"content": exported.content, **exported.companions}.items():
        expect(isinstance(content, bytes), f"found {name} of type {type(content).__name__}, expected bytes")
    for name in exported.companions:
        plain = name == PurePath(name).name and name not in ("", ".", "..") and "\\" not in name
        expect(plain, f"found the companion {name!r}, expected the plain name of a file")
    return exported


# --- estimators: exact tip positions of an arm whose parameters are known -------------------------------------------

_POSES, _TOLERANCE = 12, 1e-6
_TRUTH = {"a1": 0.31, "a2": 0.243, "theta1": 0.05, "theta2": -0.08, "side": 0.02}
_UPPER_SIDE_M, _PRIOR_SD_M = 0.015, 4e-4
_SIDE = f"{ARM}.planar.side"


@dataclass(frozen=True)
class _Case:
    """A problem and its records."""

    problem: Problem
    records: tuple[FactorRecords, ...]

    def solved_by(self, estimator: Estimator) -> Solution:
        start = self.problem.parameters.nominal()
        solution = estimator.solve(self.problem, self.records, start)
        sized = f"found {np.size(solution.values)} values, expected {start.size}"
        expect(np.shape(solution.values) == start.shape, sized)
        expect(bool(np.array_equal(start, self.problem.parameters.nominal())), "it changed the start that it was given")
        return solution


def _expect_near(solution: Solution, answers: Mapping[str, float]) -> None:
    for name, value in zip(_TRUTH, solution.values, strict=True):
        answer = answers.get(name, value)
        expect(abs(value - answer) <= _TOLERANCE, f"{name}: found {value:.9g}, expected {answer:.9g}")


@check("estimator", needed=True)
def it_gives_a_value_for_every_entry_and_converges(s: Subject) -> None:
    s.case = _case(Interval(upper=_UPPER_SIDE_M))
    s.solution = s.case.solved_by(s.built)
    expect(s.solution.verdict.converged, f"found the verdict {s.solution.verdict.status!r}, expected convergence")


@check("estimator")
def it_keeps_to_the_bounds_and_finds_the_truth(s: Subject) -> None:
    s.case.problem.parameters.check(s.solution.values)
    _expect_near(s.solution, {**_TRUTH, "side": _UPPER_SIDE_M})


@check("estimator")
def it_weighs_priors(s: Subject) -> None:
    data, prior = _POSES / NOISE_M**2, 1 / _PRIOR_SD_M**2  # information on ``side``, which the prior puts at zero
    answers = {**_TRUTH, "side": _TRUTH["side"] * data / (data + prior)}
    _expect_near(_case(Interval(), _PRIOR_SD_M).solved_by(s.built), answers)


@check("estimator")
def it_weighs_records_in_any_order(s: Subject) -> None:
    """Noisy tips whose weights differ; ``side`` is then the weighted mean of y, by which nothing else moves."""
    case, random = _case(Interval()), np.random.default_rng(6)
    noisy = case.records[0].record.copy()
    noisy[:, :_POSES] += random.normal(0.0, 3 * NOISE_M, (len(noisy), _POSES))
    weights = random.uniform(0.2, 5.0, _POSES)
    records = case.problem.weighted((replace(case.records[0], record=noisy),), (weights,))
    solution = replace(case, records=records).solved_by(s.built)
    y = noisy[case.problem.kernels[0].factor.channels.index(f"{TRACKER}.y"), :_POSES]
    _expect_near(solution, {"side": weights @ y / weights.sum()})
    order = random.permutation(_POSES)
    shuffled = replace(case, records=case.problem.subset(records, order)).solved_by(s.built)
    off = float(np.abs(shuffled.values - solution.values).max())
    expect(off <= _TOLERANCE, f"found values that differ by {off:.1e} for another order of records")


@check("estimator")
def it_does_the_same_twice(s: Subject) -> None:
    for estimator in (s.built, s.build()):
        off = float(np.abs(s.case.solved_by(estimator).values - s.solution.values).max())
        expect(off == 0.0, f"found values that differ by {off:.1e} from the first time")


@check("estimator")
def cut_short_it_reports_that_it_did_not_converge(s: Subject) -> None:
    if "max_iterations" not in type(s.settings).model_fields:
        raise NotRun("its settings have no max_iterations")
    short = s.made(s.made.Settings.model_validate({**s.example, "max_iterations": 1}))
    expect(not s.case.solved_by(short).verdict.converged, "found converged after one iteration, expected not converged")


def _case(side: Interval, prior_sd: float | None = None) -> _Case:
    """Exact tip positions; ``side`` moves y alone, so neither its bound nor its prior disturbs the rest."""
    arms, measurements = planar_arms([ARM]), {TRACKER: Tip()}
    parameters: Parameters = all_parameters(arms)
    true = parameters.with_nominal(np.array(list(_TRUTH.values())))
    moved = dataset(commands(arms, _POSES, np.random.default_rng(5)))
    exact = measured_without_noise(SimulationRequest(arms, measurements, true, GRAVITY), moved)
    records = dataset({**moved.channels, **exact})
    block = replace(parameters[_SIDE], domain=side, prior_sd=prior_sd)
    parameters = parameters.replaced({_SIDE: block}).with_free(parameters.names)
    problem = Problem.build(arms, measurements, parameters, GRAVITY, records, "interpreted")
    return _Case(problem, problem.records(records))


# --- online estimators: a linear problem whose answer is a sum of information ---------------------------------------

_RECORDS, _STATES, _ROWS = 12, 4, 2
_SHARE = 1e-7
"""How far a number may be off, in its standard deviation."""


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
def it_takes_a_record(s: Subject) -> None:
    window, random = s.built.window, np.random.default_rng(3)
    expect(isinstance(window, int) and window >= 1, f"found window = {window!r}, expected a number of records from 1")
    root = random.normal(size=(_STATES, _STATES))
    s.prior = Gaussian(random.normal(size=_STATES), root @ root.T + np.eye(_STATES))
    noise = np.array([[0.2, 0.05], [0.05, 0.1]])
    truth = s.prior.mean + root @ random.normal(size=_STATES)
    slopes = random.normal(size=(_RECORDS, _ROWS, _STATES))
    s.lines = [_Line(slope @ truth + 0.3 * random.normal(size=_ROWS), slope, noise) for slope in slopes]
    s.updates = _updates(s)


@check("online")
def it_finds_what_prior_and_records_say_together(s: Subject) -> None:
    for place, update in enumerate(s.updates, start=1):
        right, covariance = _known(s.prior, s.lines[:place]), update.posterior.covariance
        expect(bool((covariance == covariance.T).all()), f"found a covariance that is not symmetric after {place}")
        sd = np.sqrt(np.diag(right.covariance))
        off = float(np.abs((update.posterior.mean - right.mean) / sd).max())
        expect(off < _SHARE, f"found a mean {off:.1e} standard deviations off after record {place}")
        wide = float(np.abs((covariance - right.covariance) / np.outer(sd, sd)).max())
        expect(wide < _SHARE, f"found a covariance {wide:.1e} off after record {place}, in units of variances")
    update, first = s.updates[0], s.lines[0]  # of the first record: the prior is known, whatever the window
    innovation = update.innovation - (first.measured - first.slope @ s.prior.mean)
    covariance = update.covariance - (first.slope @ s.prior.covariance @ first.slope.T + first.noise)
    off = max(float(np.abs(innovation).max()), float(np.abs(covariance).max()))
    expect(off < _SHARE, f"found an innovation or its covariance (the NIS) {off:.1e} off for the first record")


@check("online")
def it_changes_nothing_that_it_is_given_and_keeps_nothing(s: Subject) -> None:
    """From one update to the next, too."""
    mean, covariance = s.prior.mean.copy(), s.prior.covariance.copy()
    s.built.update(s.prior, s.lines[:1])
    same = bool(np.array_equal(mean, s.prior.mean) and np.array_equal(covariance, s.prior.covariance))
    expect(same, "it changed the prior that it was given")
    for first, again in zip(s.updates, _updates(s), strict=True):
        same = np.array_equal(first.posterior.mean, again.posterior.mean)
        same = same and np.array_equal(first.posterior.covariance, again.posterior.covariance)
        expect(same, "the same records gave other beliefs the second time")


@check("online")
def a_variance_below_zero_is_an_error(s: Subject) -> None:
    line = s.lines[0]
    blind = _Line(line.measured, line.slope * [1, 1, 1, 0], line.noise)
    with suppress(ProblemError, np.linalg.LinAlgError), np.errstate(invalid="ignore"):
        s.built.update(Gaussian(s.prior.mean, np.diag([1.0, 1.0, 1.0, -0.5])), [blind])
        raise ContractError("found a belief made of a variance of -0.5, expected armcal.errors.ProblemError")


def _updates(s: Subject) -> list[Update]:
    """By each record and those of its window before it, from what is known without these."""
    ends = [(max(0, end - s.built.window), end) for end in range(1, _RECORDS + 1)]
    return [s.built.update(_known(s.prior, s.lines[:begin]), s.lines[begin:end]) for begin, end in ends]


def _known(prior: Gaussian, lines: Sequence[_Line]) -> Gaussian:
    """By information: what prior and records say."""
    if not lines:
        return prior
    information = np.linalg.inv(prior.covariance)
    projected = information @ prior.mean
    for line in lines:
        weighted = line.slope.T @ np.linalg.inv(line.noise)
        information, projected = information + weighted @ line.slope, projected + weighted @ line.measured
    covariance = np.linalg.inv(information)
    covariance = (covariance + covariance.T) / 2
    return Gaussian(covariance @ projected, covariance)
