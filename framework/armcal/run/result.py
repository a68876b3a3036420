"""What a run knows when it ends: everything that the outputs, the report and the terminal show."""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from typing import Any, Self

import numpy as np

from armcal.base.arrays import Array
from armcal.base.config_text import as_json, finite
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import (
    SCHEMA,
    CalibrationFile,
    InformationRecord,
    check_poses,
    dump,
    parameter_records,
    sealed,
)
from armcal.calibration.intervals import PAYLOAD, PredictionRecord
from armcal.config.system import System
from armcal.diagnose.fit import Fit, RecordErrors
from armcal.diagnose.record_checks import Intervals, intervals
from armcal.diagnose.verdict import Verdict, evidence
from armcal.errors import ArmcalError, CalibrationWarning, NotConvergedError
from armcal.estimate.estimator import Estimate
from armcal.estimate.polish import settled, untrained
from armcal.estimate.prediction import residual_spread
from armcal.estimate.validation import Bootstrap, ErrorSummary, Recording, Split, in_unit, summarise
from armcal.io import plain_files
from armcal.measure.reader import surroundings
from armcal.measure.tables import csv_text
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment, group_texts
from armcal.run.pose_residual import ResidualOutcome

_MM = 1000.0


@dataclass(frozen=True)
class SuspiciousRecord:
    row: int  # of the source; 0 if it has none
    record_id: str
    measurement: str
    deviations: float  # in standard deviations
    limit: float
    weight: float  # 0 if it was set aside
    error_mm: float

    @property
    def reason(self) -> str:
        return f"{self.deviations:.1f} standard deviations from the fit (limit {self.limit:.1f})"


def suspicious_records(fit: Fit) -> tuple[SuspiciousRecord, ...]:
    """The farthest first; not sought in plain least squares."""
    dataset, records = fit.dataset, list[SuspiciousRecord]()
    for suspect in fit.fitted.suspects:
        i = int(fit.split.train[suspect.record])
        row = dataset.rows[i] if dataset.rows else 0
        numbers = (suspect.distance, suspect.limit, suspect.weight, float(fit.errors.calibrated_mm[i]))
        records.append(SuspiciousRecord(row, dataset.ids[i], suspect.measurement, *numbers))
    return tuple(records)


def noise_content(fit: Fit, suspicious: Sequence[SuspiciousRecord]) -> dict[str, Any]:
    fitted, estimate = fit.fitted, fit.estimate
    content: dict[str, Any] = {"loss": fitted.loss}
    if fitted.loss != "none":
        content["rounds"] = fitted.rounds
        content["suspicious_records"] = [asdict(record) for record in suspicious]
    if fitted.components is not None:
        content["components"] = [finite(asdict(component)) for component in fitted.components.components]
        content["inseparable"] = [list(pair) for pair in fitted.components.inseparable]
        content["unseen_joints"] = list(fitted.components.unseen)
    scatter = residual_spread(fitted.problem, estimate, fit.ready.trained).items()
    content["scatter"] = {name: {**asdict(own), "covariance": own.covariance.tolist()} for name, own in scatter}
    return content


def run_groups(experiment: Experiment, fit: Fit) -> dict[str, dict[str, Any]]:
    """How wrong the model is on the records of each group (mean, mm), by name; none if nothing separates groups."""
    problem, dataset, label, errors = fit.problem, fit.dataset, experiment.label, fit.errors
    if label is None or not (label in dataset.extra or (label == PAYLOAD and dataset.has(PAYLOAD))):
        return {}
    labels = np.array(group_texts(dataset, label))
    before = _distances(problem, settled(untrained(problem), problem.parameters.nominal()))
    # Distances are judged by what the records of each socket say, not by what the known distance made of them.
    after = _distances(problem, settled(untrained(problem), fit.estimate.values))
    return {
        name: {
            "records": int(np.sum(labels == name)),
            "trained": int(np.sum(labels[fit.split.train] == name)),
            "nominal_error_mm": float(np.nanmean(errors.nominal_mm[labels == name])),
            "error_mm": float(np.nanmean(errors.calibrated_mm[labels == name])),
            "nominal_distance_error_mm": _within(name, before),
            "distance_error_mm": _within(name, after),
        }
        for name in sorted(set(labels.tolist()) - {""})
    }


def _distances(problem: Problem, values: Array) -> list[tuple[tuple[str, str], float]]:
    return [(tie.groups, float(np.linalg.norm(tie.residual(values))) * _MM) for tie in problem.compiled.known_ties]


def _within(name: str, distances: list[tuple[tuple[str, str], float]]) -> float | None:
    own = [error for groups, error in distances if all(name in group.split("/") for group in groups)]
    return float(np.mean(own)) if own else None


@dataclass(frozen=True)
class ErrorTable:
    """Error summaries (mm) by model and by records (train, holdout, cross_validated)."""

    nominal: dict[str, ErrorSummary]
    calibrated: dict[str, ErrorSummary]  # counts the drift that neighbouring records show
    at_rest: dict[str, ErrorSummary] = field(default_factory=dict)  # without that; empty if nothing drifts
    turns: Self | None = None  # of orientations (deg), without a drift; None where none are measured

    def as_dict(self) -> dict[str, Any]:
        return {
            model: {name: asdict(summary) for name, summary in table.items()}
            for model, table in (("nominal", self.nominal), ("calibrated", self.calibrated), ("at_rest", self.at_rest))
            if table
        }

    @classmethod
    def of(cls, errors: RecordErrors, split: Split) -> Self:
        judged = np.isfinite(errors.cross_validated_mm)

        def summaries(of: Array, crossed: Array) -> dict[str, ErrorSummary]:
            sets = {"train": of[split.train], "holdout": of[split.holdout], "cross_validated": crossed[judged]}
            return {name: summarise(own) for name, own in sets.items()}

        at_rest = {}
        if errors.at_rest_mm is not None and errors.cross_validated_at_rest_mm is not None:
            at_rest = summaries(errors.at_rest_mm, errors.cross_validated_at_rest_mm)
        nominal = summaries(errors.nominal_mm, errors.nominal_crossed_mm)
        turns = None
        if errors.turns is not None:
            own = errors.turns
            before = summaries(own.nominal_deg, own.nominal_crossed_deg)
            turns = cls(before, summaries(own.calibrated_deg, own.cross_validated_deg))
        return cls(nominal, summaries(errors.calibrated_mm, errors.cross_validated_mm), at_rest, turns)


@dataclass(frozen=True)
class RunResult:
    """A finished run."""

    name: str  # of the experiment
    command: str  # how to repeat it
    fit: Fit  # the problem, its records and the estimate, and whatever a check or a table asks of them
    verdict: Verdict  # what to conclude
    warnings: tuple[str, ...]  # of config, data and problem
    seconds: dict[str, float]  # of each stage, and ``total``
    provenance: dict[str, Any]  # hashes and versions
    noise: Mapping[str, Any] = field(default_factory=lambda: {"loss": "none", "scatter": {}})  # as metrics.json has it
    suspicious: tuple[SuspiciousRecord, ...] = ()  # training records beyond their limits
    bootstrap: Bootstrap | None = None  # refits to resampled records, if they were asked for
    prediction: PredictionRecord | None = None  # what predictions need beyond the values; None if it did not converge
    groups: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)  # errors by group, as metrics.json has them
    pose_residual: ResidualOutcome | None = None  # what became of one that was to be learned

    @property
    def system(self) -> System:
        """Arms, measurements and statics, with what was learned of pose residuals."""
        return self.fit.system

    @property
    def dataset(self) -> Dataset:
        """The records used."""
        return self.fit.dataset

    @property
    def split(self) -> Split:
        """Which records trained and which judged."""
        return self.fit.split

    @cached_property
    def estimate(self) -> Estimate:
        """What was found; what a pose residual learned tells nothing of it: it is as sure as without."""
        left, plain = self.fit.estimate, (self.fit.before or self.fit).estimate
        return replace(plain, noise_scale=left.noise_scale, degrees_of_freedom=left.degrees_of_freedom)

    @property
    def errors(self) -> RecordErrors:
        """Of every record."""
        return self.fit.errors

    @cached_property
    def table(self) -> ErrorTable:
        """Summaries of the errors."""
        return ErrorTable.of(self.errors, self.split)

    @property
    def rejected(self) -> tuple[SuspiciousRecord, ...]:
        """The suspicious records that the fit set aside."""
        return tuple(record for record in self.suspicious if record.weight == 0)

    @property
    def intervals(self) -> dict[Recording, Intervals]:
        """How wide prediction intervals are, and what they hold, by recording."""
        return self.fit.of(intervals)

    @property
    def backend(self) -> str:
        """What evaluated the model."""
        return self.fit.problem.backend


FILES = ("experiment.yaml", "residuals.csv", "metrics.json", "report.html", "calibration.yaml")
"""In the order in which they are put in place: the calibration last."""
NOT_CONVERGED_SUFFIX = ".not-converged"
DO_NOT_USE_SUFFIX = ".do-not-use"
UNREADABLE_SUFFIX = ".unreadable"
_SUFFIXES = (NOT_CONVERGED_SUFFIX, DO_NOT_USE_SUFFIX, UNREADABLE_SUFFIX)
_OURS = (*(f"calibration.yaml{suffix}" for suffix in _SUFFIXES), *FILES)


def reserved(folder: Path) -> AbstractContextManager[plain_files.Reservation]:
    return plain_files.reserved(folder, _OURS)


def calibration_name(result: RunResult, accepted: bool) -> str:
    """What the calibration is called: as no command loads it if it did not converge, or is bad and not accepted."""
    if not result.estimate.verdict.converged:
        return f"calibration.yaml{NOT_CONVERGED_SUFFIX}"
    return f"calibration.yaml{DO_NOT_USE_SUFFIX}" if result.verdict.bad and not accepted else "calibration.yaml"


def write(
    held: plain_files.Reservation, result: RunResult, experiment: Experiment, page: str, accepted: bool = False
) -> None:
    """Write all files into a reserved folder; those of an earlier run in the same place move to ``earlier/``.

    A calibration that cannot be read back is left as ``calibration.yaml.unreadable``, and raises an ArmcalError.
    """
    fault: ArmcalError | None = None
    texts = {
        "experiment.yaml": dump(experiment.source.data),
        "residuals.csv": residuals_text(result),
        "metrics.json": as_json(metrics(result)) + "\n",
        "report.html": page,
        calibration_name(result, accepted): sealed(calibration_content(result, experiment, accepted)),
    }
    if "calibration.yaml" in texts:
        try:
            read_back(texts["calibration.yaml"], experiment.registry)
        except ArmcalError as refusal:
            fault = refusal
            texts[f"calibration.yaml{UNREADABLE_SUFFIX}"] = texts.pop("calibration.yaml")
    held.place(texts)
    if fault is not None:
        hint = f"It was left as calibration.yaml{UNREADABLE_SUFFIX}, which nothing loads. {fault.hint}"
        raise ArmcalError(f"the calibration cannot be read back: {fault.message}", hint=hint) from fault


def metrics(result: RunResult) -> dict[str, Any]:
    estimate, known, verdict = result.estimate, result.estimate.identifiability, result.verdict
    resampled: dict[str, Any] | None = None
    if (bootstrap := result.bootstrap) is not None:
        rows = zip(bootstrap.names, bootstrap.deviations, bootstrap.intervals, strict=True)
        numbers = {name: {"sd": float(sd), "lower": float(low), "upper": float(high)} for name, sd, (low, high) in rows}
        resampled = {"refits": len(bootstrap.values), "failed": bootstrap.failed, "block_records": bootstrap.block}
        resampled["parameters"] = {name: finite(own) for name, own in numbers.items()}
    content = {
        "experiment": result.name,
        "error_mm": _errors(result),
        **({"orientation_error_deg": result.table.turns.as_dict()} if result.table.turns else {}),
        "groups": result.groups,
        **({"pose_residual": result.pose_residual.as_dict()} if result.pose_residual else {}),
        "records": {
            "used": len(result.dataset),
            "train": len(result.split.train),
            "holdout": len(result.split.holdout),
            "set_aside": len(result.dataset.set_aside),
            "rejected": len(result.rejected),
        },
        "parameters": {
            "free": len(known),
            "rank": known.rank,
            "determined_by": estimate.sources,
            "at_bound": list(estimate.at_bound),
            "undetermined": [str(combination) for combination in known.undetermined],
            "scaled_condition": finite(float(known.condition)),
        },
        "noise": _noise(result),
        "solver": asdict(estimate.verdict),
        "verdict": {
            "usable": not verdict.bad,
            "grade": verdict.grade,
            "headline": verdict.headline,
            "findings": [asdict(finding) for finding in verdict.findings],
            "paragraph": verdict.paragraph,
        },
        "structure": evidence(result.fit),
        "prediction_intervals": {
            f"{name}_recording": own.as_dict()
            for name, own in result.intervals.items()
            if own.half_width_mm is not None
        },
        "bootstrap": resampled,
        "warnings": list(result.warnings),
        "evaluator": result.backend,
        "seconds": dict(result.seconds),
        "provenance": result.provenance,
    }
    return dict(in_unit(content, result.errors.unit))


def _errors(result: RunResult) -> dict[str, Any]:
    """The table, and of training and judging groups the mean of their means: a group of few records counts as much."""
    table, groups = result.table.as_dict(), result.groups.values()
    for key, trained in (("train", True), ("holdout", False)):
        if own := [group for group in groups if bool(group["trained"]) == trained]:
            table["nominal"][key]["mean_of_groups"] = float(np.mean([group["nominal_error_mm"] for group in own]))
            table["calibrated"][key]["mean_of_groups"] = float(np.mean([group["error_mm"] for group in own]))
            known = [e for group in own if (e := group["distance_error_mm"]) is not None]
            table["calibrated"][key]["distance_mean_of_groups"] = float(np.mean(known)) if known else None
    return table


def calibration_content(result: RunResult, experiment: Experiment, accepted: bool = False) -> dict[str, Any]:
    """The content of calibration.yaml; nothing loads one whose verdict is bad, unless it was ``accepted``."""
    estimate, provenance, unit = result.estimate, result.provenance, result.errors.unit
    quality: dict[str, Any] = {f"quality_{unit}": result.table.as_dict()}
    information = InformationRecord(
        increments=estimate.parameters.coordinate_names,
        square_root=tuple(tuple(float(x) for x in row) for row in estimate.square_root_information),
    )
    record = CalibrationFile(
        armcal_calibration=SCHEMA,
        created=datetime.now(UTC).isoformat(timespec="seconds"),
        experiment=result.name,
        converged=estimate.verdict.converged,
        software=dict(provenance["versions"]),
        identity={"arm": provenance["arm_sha256"], "data": provenance["data_sha256"], "source": provenance["data"]},
        environment_columns=tuple(filter(result.dataset.has, surroundings(result.system.arms))),
        noise=in_unit(_noise(result), unit),
        **quality,
        verdict={
            "headline": result.verdict.headline,
            "usable": not result.verdict.bad,
            "accepted": accepted,
            "findings": [f.text for f in result.verdict.findings],
        },
        arms=dict(result.system.description["arms"]),
        measurements=dict(result.system.description["measurements"]),
        statics=dict(result.system.description["statics"]),
        groups={owner: tuple(keys) for owner, keys in result.fit.problem.blueprint.groups.items()},
        parameters=parameter_records(estimate),
        prediction=result.prediction,
        information=information,
    )
    system, registry = result.system, experiment.registry
    parameters = system.parameters(record.groups).with_nominal(estimate.values)
    calibration = Calibration(system, parameters, record)
    try:
        calibration = calibration.checked(check_poses(system, result.dataset, result.split.train), registry)
    except NotConvergedError:  # the arm does not settle at the check poses
        calibration = calibration.checked(None, registry)
    return dict(finite(calibration.record.to_config()))


def read_back(text: str, registry: PluginRegistry) -> Calibration:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", CalibrationWarning)
        return Calibration.load("calibration.yaml", registry, content=text.encode())


def _noise(result: RunResult) -> dict[str, Any]:
    estimate = result.estimate
    fit = {"scale": estimate.noise_scale, "degrees_of_freedom": estimate.degrees_of_freedom}
    return {**fit, **result.noise}


def residuals_text(result: RunResult) -> str:
    errors, dataset = result.errors, result.dataset
    held = np.zeros(len(dataset), dtype=bool)
    held[result.split.holdout] = True
    weights = np.full(len(dataset), np.nan)  # the least one of a record that has several
    weights[result.split.train] = np.min(np.array(result.fit.fitted.weights), axis=0)
    numbered = [f"residual{i}_{errors.unit}" for i in range(1, len(errors.calibrated_residual_mm) + 1)]
    axes = list(errors.residual_columns) or numbered
    columns = ["pose_id", "source_row", "set", "weight"]
    models, turns = ("nominal", "calibrated", "cross_validated"), errors.turns
    columns += [*(f"{model}_{errors.unit}" for model in models), *axes]
    columns += [f"{model}_deg" for model in models if turns]
    rows: list[list[object]] = [[*columns]]
    for i, record in enumerate(dataset.ids):
        row = dataset.rows[i] if dataset.rows else ""
        weight = "" if held[i] else f"{weights[i]:.6g}"
        numbers = [errors.nominal_mm[i], errors.calibrated_mm[i], errors.cross_validated_mm[i]]
        turned = [turns.nominal_deg[i], turns.calibrated_deg[i], turns.cross_validated_deg[i]] if turns else []
        residual = errors.calibrated_residual_mm[:, i]
        rows.append([record, row, "holdout" if held[i] else "train", weight, *numbers, *residual, *turned])
    return csv_text(rows)
