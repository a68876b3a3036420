"""Load transfer: trained at one payload, judged at another, each way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError, DataError, Location
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.simulation import SimulationRequest, with_channels
from armcal.estimate.structure import require_solvable
from armcal.estimate.validation import (
    FitTask,
    Indices,
    JudgedFit,
    Split,
    error_unit,
    fit_and_judge,
    folds,
    record_errors,
    summarise,
)
from armcal.io.parallel import Executor
from armcal.problem.drift import with_drift
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch
from armcal.run.provenance import provenance
from armcal.run.study import Study, Trainable, compiled, interpreted_first, naming
from armcal.run.study_result import TransferCell, TransferResult
from armcal.run.study_settings import LoadTransferSettings

_MM = 1000.0
_GRAMS = 1000.0
PAYLOAD = "payload"


@dataclass(frozen=True)
class _Fit:
    """One fit of the plan: trained at some payloads (indices), without one fold of them, judged on the rest."""

    variant: str
    trained: tuple[int, ...]
    split: Split


def transfer(
    study: Study,
    executor: Executor,
    command: str = "",
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
) -> TransferResult:
    """Train every variant at each payload and at all, and judge it at each.

    At a payload that it trained at, a record is judged by a fit whose training left its fold out, so that no figure
    is of a record that trained.

    Raises:
        InputError: the records are not at two payloads, or a variant cannot be solved with those of one.
    """
    watch, settings = watch or Stopwatch(), study.settings_as(LoadTransferSettings)
    first = next(iter(study.experiments.values()))
    with watch.stage("prepare"):
        simulated = first.settings.data is None
        dataset = _simulated(first, settings) if simulated else _measured(first)
        groups, payloads = _groups(dataset, settings)
        ready = {name: naming(name, partial(_prepared, e, dataset, groups)) for name, e in study.experiments.items()}
    plan = [fit for name in ready for fit in _plan(name, groups, settings)]
    with watch.stage("compile"):
        ready = compiled(study.experiments, ready, len(dataset) * len(plan) // len(ready), executor, progress)
    tasks = [_task(ready[fit.variant], fit) for fit in plan]
    with watch.stage("fits"):
        fits = executor.map(fit_and_judge, tasks, lambda done: progress("fits", done))
    errors = _collected(plan, fits, len(dataset))
    unsolved = [(p.variant, p.trained) for p, fit in zip(plan, fits, strict=True) if not fit.converged]
    return TransferResult(
        name=study.name,
        command=command,
        dataset=dataset,
        simulated=simulated,
        payloads_g=payloads,
        counts=tuple(len(group) for group in groups),
        cells=_all_cells(ready, errors, groups, payloads, unsolved),
        errors_mm={(name, tuple(payloads[i] for i in trained)): error for (name, trained), error in errors.items()},
        warnings=dataset.warnings,
        seconds=watch.seconds,
        provenance=provenance(first, dataset),
        unit=error_unit(next(iter(ready.values())).problem),
    )


def _simulated(experiment: Experiment, settings: LoadTransferSettings) -> Dataset:
    """Records at each payload, in poses and with noise of their own where the simulator has a seed."""
    if not settings.payloads:
        raise ConfigError(
            "found no payloads to simulate.",
            where=experiment.source.where(("study", "payloads")),
            hint="Write for example payloads_g: [0, 66.3].",
        )
    parts = []
    for number, payload in enumerate(settings.payloads):
        system = experiment.system
        environment = replace(system.environment, payload_mass=payload)
        request = SimulationRequest(system.arms, system.measurements, experiment.parameters, environment)
        seeded = replace(experiment, source=_with_seed(experiment.source, number))
        made = seeded.simulator().simulate(request)
        parts.append(with_channels(made, {PAYLOAD: np.full(len(made), payload)}))
    ids = tuple(f"{p * _GRAMS:g}g-{i}" for p, part in zip(settings.payloads, parts, strict=True) for i in part.ids)
    channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels}
    return Dataset(ids, channels, source="simulation")


def _with_seed(source: ConfigSource, number: int) -> ConfigSource:
    section = dict(source.data.get("simulation") or {})
    if isinstance(section.get("seed", 0), int):
        section["seed"] = section.get("seed", 0) + number
    return replace(source, data={**source.data, "simulation": section})


def _measured(experiment: Experiment) -> Dataset:
    dataset = experiment.read()
    if not dataset.has(PAYLOAD):
        raise DataError(
            "no column says what hung on the tool.",
            where=Location(dataset.source),
            hint="Add a column payload_g; a load transfer needs records at two payloads at least.",
        )
    return dataset


def _groups(dataset: Dataset, settings: LoadTransferSettings) -> tuple[list[Indices], tuple[float, ...]]:
    """Record indices of each payload, and the payloads (g), to the nearest tenth of a gram."""
    tenths = np.round(dataset.column(PAYLOAD) * _GRAMS * 10).astype(int)
    wanted = [round(p * _GRAMS * 10) for p in settings.payloads] or sorted(set(tenths.tolist()))
    groups = [np.flatnonzero(tenths == each).astype(np.intp) for each in wanted]
    missing = [f"{each / 10:g} g" for each, group in zip(wanted, groups, strict=True) if len(group) < settings.folds]
    if missing or len(groups) < 2:
        there = ", ".join(f"{each / 10:g} g ({int(np.sum(tenths == each))})" for each in sorted(set(tenths.tolist())))
        raise DataError(
            f"too few records at {', '.join(missing) or 'a second payload'}; there are records at {there}.",
            where=Location(dataset.source),
            hint=f"A payload needs at least as many records as there are folds ({settings.folds}).",
        )
    return groups, tuple(each / 10 for each in wanted)


def _prepared(experiment: Experiment, dataset: Dataset, groups: Sequence[Indices]) -> Trainable:
    system, parameters = experiment.system, experiment.parameters
    choice = interpreted_first(experiment).evaluator
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, dataset, choice)
    records = with_drift(problem, problem.records(dataset), dataset, parameters.nominal())
    for group in groups:
        require_solvable(problem, problem.subset(records, group), parameters.nominal())
    return Trainable(experiment, problem, records)


def _plan(name: str, groups: Sequence[Indices], settings: LoadTransferSettings) -> list[_Fit]:
    """At each payload and at all of them: one fit on everything there, judged elsewhere, and one for each fold."""
    every = tuple(range(len(groups)))
    plan = []
    for trained in [*((i,) for i in every), every]:
        train = np.concatenate([groups[i] for i in trained])
        elsewhere = [groups[i] for i in every if i not in trained]
        if elsewhere:
            plan.append(_Fit(name, trained, Split(train, np.concatenate(elsewhere))))
        for split in folds(len(train), settings.folds, settings.seed):
            plan.append(_Fit(name, trained, Split(train[split.train], train[split.holdout])))
    return plan


def _task(ready: Trainable, fit: _Fit) -> FitTask:
    e = ready.experiment
    return FitTask(ready.problem, e.estimator, ready.problem.parameters.nominal(), ready.records, fit.split)


def _collected(
    plan: Sequence[_Fit], fits: Sequence[JudgedFit], count: int
) -> Mapping[tuple[str, tuple[int, ...]], Array]:
    """Errors (mm) of each record by variant and payloads trained at."""
    errors: dict[tuple[str, tuple[int, ...]], Array] = {}
    for fit, judged in zip(plan, fits, strict=True):
        row = errors.setdefault((fit.variant, fit.trained), np.full(count, np.nan))
        row[fit.split.holdout] = judged.errors * _MM
    return errors


def _all_cells(
    ready: Mapping[str, Trainable],
    errors: Mapping[tuple[str, tuple[int, ...]], Array],
    groups: Sequence[Indices],
    payloads: Sequence[float],
    unsolved: Sequence[tuple[str, tuple[int, ...]]],
) -> tuple[TransferCell, ...]:
    """Variant by variant: without calibration, then by what it was trained at."""
    cells: list[TransferCell] = []
    for name in ready:
        cells += _nominal_cells(name, ready[name], groups, payloads)
        for key in [key for key in errors if key[0] == name]:
            cells += _cells(key, errors[key], groups, payloads, unsolved.count(key))
    return tuple(cells)


def _cells(
    key: tuple[str, tuple[int, ...]],
    errors: Array,
    groups: Sequence[Indices],
    payloads: Sequence[float],
    failed: int,
) -> list[TransferCell]:
    name, trained = key
    at = tuple(payloads[i] for i in trained)
    return [
        TransferCell(name, at, payloads[i], summarise(errors[group]), i in trained, failed)
        for i, group in enumerate(groups)
    ]


def _nominal_cells(
    name: str, ready: Trainable, groups: Sequence[Indices], payloads: Sequence[float]
) -> list[TransferCell]:
    errors = record_errors(ready.problem, ready.problem.parameters.nominal(), ready.records) * _MM
    return [
        TransferCell(name, (), payload, summarise(errors[group]), False, 0)
        for group, payload in zip(groups, payloads, strict=True)
    ]
