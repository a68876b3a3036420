"""A run: load, check, fit, validate, judge."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import DataError, Location
from armcal.measure.id_list import read_ids
from armcal.run.experiment import Experiment
from armcal.run.result import ErrorTable, RecordErrors, RunResult
from armcal.solve.estimator import Estimate, Progress, estimate, no_progress, require_solvable
from armcal.solve.problem import FactorRecords, Problem
from armcal.solve.suggestion import suggest
from armcal.solve.validation import (
    Split,
    cross_validate,
    folds,
    hold_out,
    record_errors,
    split_by_id,
    summarise,
)
from armcal.solve.verdict import Verdict, judge
from armcal.use.calibration import identity_of

_MM = 1000.0
_REACH_RATIO = 10.0


@dataclass(frozen=True)
class Stopwatch:
    """Seconds of each stage."""

    began: float = field(default_factory=time.perf_counter)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a stage; a stage entered twice adds up."""
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def total(self) -> float:
        """Since it was made."""
        return time.perf_counter() - self.began


@dataclass(frozen=True)
class Prepared:
    """A problem ready to solve: data read and checked, functions compiled."""

    dataset: Dataset
    problem: Problem
    records: tuple[FactorRecords, ...]
    split: Split
    warnings: tuple[str, ...]

    @property
    def training(self) -> tuple[FactorRecords, ...]:
        """The training records."""
        return self.problem.subset(self.records, self.split.train)


def prepare(experiment: Experiment, watch: Stopwatch) -> Prepared:
    """Everything that can be done and refused before solving.

    Raises:
        InputError: data, units, counts or rank do not allow a calibration.
    """
    with watch.stage("read"):
        dataset = experiment.read()
    system = experiment.system
    with watch.stage("build"):
        problem = Problem.build(
            system.arms,
            system.measurements,
            experiment.parameters,
            system.environment,
            dataset,
            experiment.settings.evaluator,
        )
        records = problem.records(dataset)
    with watch.stage("check"):
        _check_reach(problem, records, dataset)
        split = _split(experiment, dataset)
        start = experiment.parameters.nominal()
        found = require_solvable(problem, problem.subset(records, split.train), start)
    return Prepared(dataset, problem, records, split, (*experiment.warnings, *dataset.warnings, *found))


def calibrate(
    experiment: Experiment,
    command: str = "",
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
) -> RunResult:
    """Calibrate; see ``outputs.write`` for what is left behind.

    Raises:
        InputError: something is refused before solving.
    """
    watch = watch or Stopwatch()
    ready = prepare(experiment, watch)
    registry = experiment.registry
    faults = registry.notify("armcal_run_started", name=experiment.name, records=len(ready.dataset))
    for aside in ready.dataset.set_aside:
        told = {"row": aside.row, "record_id": aside.record_id, "reason": aside.reason}
        faults += registry.notify("armcal_record_rejected", **told)
    start = experiment.parameters.nominal()
    with watch.stage("fit"):
        solution = experiment.estimator.solve(ready.problem, ready.training, start, progress)
        found = estimate(ready.problem, ready.training, solution)
    faults += registry.notify("armcal_estimate_changed", estimate=found)
    with watch.stage("validate"):
        errors = _errors(experiment, ready, solution.values, progress)
        table = _table(errors, ready.split)
    return RunResult(
        name=experiment.name,
        command=command,
        dataset=ready.dataset,
        split=ready.split,
        estimate=found,
        errors=errors,
        table=table,
        verdict=_verdict(experiment, ready, found, errors),
        warnings=(*ready.warnings, *_fold_warnings(errors, experiment), *dict.fromkeys(faults)),
        backend=ready.problem.backend,
        seconds=watch.seconds,
        provenance=_provenance(experiment, ready.dataset),
    )


def _split(experiment: Experiment, dataset: Dataset) -> Split:
    validation = experiment.settings.validation
    if validation.train_ids is not None:
        return split_by_id(dataset.ids, read_ids(validation.train_ids))
    return hold_out(len(dataset), validation.holdout, validation.seed)


def _errors(experiment: Experiment, ready: Prepared, values: Array, progress: Progress) -> RecordErrors:
    problem, records = ready.problem, ready.records
    nominal = problem.parameters.nominal()
    crossed, failed = np.full(len(ready.dataset), np.nan), 0
    validation = experiment.settings.validation
    if validation.folds:
        train = ready.split.train
        splits = folds(len(train), validation.folds, validation.seed)
        judged = cross_validate(problem, ready.training, splits, experiment.estimator, nominal, progress)
        crossed[train] = judged.errors * _MM
        failed = judged.failed_folds
    shown = problem.predict(values, records)[0]
    first = len(problem.kernels[0].factor.output_channels)
    return RecordErrors(
        nominal_mm=record_errors(problem, nominal, records) * _MM,
        calibrated_mm=record_errors(problem, values, records) * _MM,
        cross_validated_mm=crossed,
        nominal_residual_mm=np.vstack(problem.residuals(nominal, records)) * _MM,
        calibrated_residual_mm=np.vstack(problem.residuals(values, records)) * _MM,
        position_mm=shown[first + 9 : first + 12] * _MM,
        failed_folds=failed,
    )


def _fold_warnings(errors: RecordErrors, experiment: Experiment) -> list[str]:
    if not errors.failed_folds:
        return []
    folds_asked = experiment.settings.validation.folds
    return [f"{errors.failed_folds} of {folds_asked} folds did not converge; their records are not cross-validated."]


def _table(errors: RecordErrors, split: Split) -> ErrorTable:
    nominal, calibrated, crossed = errors.nominal_mm, errors.calibrated_mm, errors.cross_validated_mm
    judged = np.isfinite(crossed)
    return ErrorTable(
        nominal={
            "train": summarise(nominal[split.train]),
            "holdout": summarise(nominal[split.holdout]),
            "cross_validated": summarise(nominal[judged]),
        },
        calibrated={
            "train": summarise(calibrated[split.train]),
            "holdout": summarise(calibrated[split.holdout]),
            "cross_validated": summarise(crossed[judged]),
        },
    )


def _verdict(experiment: Experiment, ready: Prepared, found: Estimate, errors: RecordErrors) -> Verdict:
    noise = np.concatenate([kernel.factor.noise for kernel in ready.problem.kernels])
    whitened = errors.calibrated_residual_mm / _MM / noise[:, None]
    held, crossed = errors.calibrated_mm[ready.split.holdout], errors.cross_validated_mm
    crossed = crossed[np.isfinite(crossed)]
    judged, words = (held, f"{len(held)} held-out records") if len(held) else (crossed, "cross-validation")
    joints = {
        f"{name}.{joint}": dimension
        for name, arm in experiment.system.arms.items()
        for joint, dimension in zip(arm.joint_names, arm.joint_dimensions, strict=True)
    }
    training = ready.dataset.subset(ready.split.train)
    suggestions = suggest(ready.problem, training, found, joints) if found.names else ()
    return judge(
        found, whitened, errors.calibrated_mm, ready.split.train, judged, words, ready.dataset.ids, suggestions
    )


def _check_reach(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> None:
    """Positions ten times farther out, or nearer, than the model's: a unit is wrong."""
    shown = problem.predict(problem.parameters.nominal(), records)
    for kernel, values in zip(problem.kernels, shown, strict=True):
        channels = kernel.factor.output_channels
        if [channel.rpartition(".")[2] for channel in channels] != ["x", "y", "z"]:
            continue
        expected = float(np.median(np.linalg.norm(values[:3], axis=0)))
        found = float(np.median(np.linalg.norm(dataset.stacked(channels), axis=0)))
        if found > _REACH_RATIO * expected or expected > _REACH_RATIO * found:
            raise DataError(
                f"{kernel.factor.name}: positions are typically {found:.4g} m from the base frame, the model's tip "
                f"{expected:.4g} m.",
                where=Location(dataset.source),
                hint="Check the unit in the column names (x_mm or x_m) and the frame of the measurements.",
            )


def _provenance(experiment: Experiment, dataset: Dataset) -> dict[str, Any]:
    packages = ("armcal", "numpy", "scipy", "casadi", "cvxpy")
    return {
        "config": str(experiment.source.path),
        "config_files": [Path(file).name for file in experiment.source.files],
        "data": dataset.source,
        "data_sha256": dataset.sha256,
        "arm_sha256": identity_of(experiment.system.description),
        "versions": {
            "python": sys.version.split()[0],
            **{name: version(name) for name in packages},
        },
        "plugins": {p.name: f"{p.distribution} {p.version}" for p in experiment.registry.plugins if not p.fault},
    }
