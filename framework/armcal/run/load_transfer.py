"""Load transfer: trained at one payload, judged at another, each way."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.errors import ConfigError, DataError, Location
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.simulation import SimulationRequest, with_channels
from armcal.estimate.start import aligned_start, with_proposals
from armcal.estimate.structure import require_solvable
from armcal.estimate.validation import Split, error_unit, errors_and_turns, folds, summarise
from armcal.io.parallel import Executor
from armcal.problem.drift import with_drift
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal.run.prepare import Prepared, Stopwatch
from armcal.run.study import LoadTransferSettings, Study, interpreted_first, judged_fits, naming
from armcal.run.study_result import TransferCell, TransferResult

_MM = 1000.0
_GRAMS = 1000.0
PAYLOAD = "payload"


Training = tuple[str, tuple[int, ...]]
"""A variant, and the payloads (indices) that it trained at."""


def transfer(
    study: Study,
    executor: Executor,
    command: str = "",
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
) -> TransferResult:
    """Train every variant at each payload and at all, and judge it at each.

    At a payload that it trained at, a record is judged by a fit whose training left its fold out.

    Raises:
        InputError: the records are not at two payloads, or a variant cannot be solved with those of one.
    """
    watch, settings = watch or Stopwatch(), study.settings
    assert isinstance(settings, LoadTransferSettings)
    first = next(iter(study.experiments.values()))
    with watch.stage("prepare"):
        simulated = first.settings.data is None
        dataset = _simulated(first, settings) if simulated else first.read(progress)
        groups, payloads = _groups(dataset, settings)
        ready = {name: naming(name, partial(_prepared, e, dataset, groups)) for name, e in study.experiments.items()}
    plan = [((name, trained), split) for name in ready for trained, split in _plan(groups, settings)]
    fits = judged_fits(study, ready, [(name, split) for (name, _), split in plan], executor, progress, watch)
    errors, turns = ({key: np.full(len(dataset), np.nan) for key, _ in plan} for _ in range(2))
    for (key, split), judged in zip(plan, fits, strict=True):
        errors[key][split.holdout] = judged.errors * _MM
        if judged.turns is not None:
            turns[key][split.holdout] = np.degrees(judged.turns)
    unsolved = [key for (key, _), judged in zip(plan, fits, strict=True) if not judged.converged]
    return TransferResult(
        name=study.name,
        command=command,
        dataset=dataset,
        simulated=simulated,
        payloads_g=payloads,
        counts=tuple(len(group) for group in groups),
        cells=_cells(ready, errors, turns, groups, payloads, unsolved),
        errors_mm={(name, tuple(payloads[i] for i in trained)): error for (name, trained), error in errors.items()},
        warnings=dataset.warnings,
        seconds=watch.seconds,
        provenance=first.provenance(dataset),
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
        section = dict(experiment.source.data.get("simulation") or {})
        if isinstance(section.get("seed", 0), int):
            section["seed"] = section.get("seed", 0) + number
        source = replace(experiment.source, data={**experiment.source.data, "simulation": section})
        simulated = replace(experiment, source=source).simulator().simulate(request)
        parts.append(with_channels(simulated, {PAYLOAD: np.full(len(simulated), payload)}))
    ids = tuple(f"{p * _GRAMS:g}g-{i}" for p, part in zip(settings.payloads, parts, strict=True) for i in part.ids)
    channels = {name: np.concatenate([part.channels[name] for part in parts]) for name in parts[0].channels}
    return Dataset(ids, channels, source="simulation")


def _groups(dataset: Dataset, settings: LoadTransferSettings) -> tuple[list[Indices], tuple[float, ...]]:
    """Record indices of each payload, and the payloads (g), to the nearest tenth of a gram."""
    where = Location(dataset.source)
    if not dataset.has(PAYLOAD):
        raise DataError(
            "no column states what hung on the tool.",
            where=where,
            hint="Add a column payload_g; a load transfer needs records at two payloads at least.",
        )
    tenths = np.round(dataset.column(PAYLOAD) * _GRAMS * 10).astype(int)
    present = sorted(set(tenths.tolist()))
    payloads = [round(p * _GRAMS * 10) for p in settings.payloads] or present
    groups = [np.flatnonzero(tenths == payload).astype(np.intp) for payload in payloads]
    few = [f"{p / 10:g} g" for p, group in zip(payloads, groups, strict=True) if len(group) < settings.folds]
    if few or len(groups) < 2:
        counts = ", ".join(f"{payload / 10:g} g ({int(np.sum(tenths == payload))})" for payload in present)
        raise DataError(
            f"too few records at {', '.join(few) or 'a second payload'}; there are records at {counts}.",
            where=where,
            hint=f"A payload needs at least as many records as there are folds ({settings.folds}).",
        )
    return groups, tuple(payload / 10 for payload in payloads)


def _prepared(experiment: Experiment, dataset: Dataset, groups: Sequence[Indices]) -> Prepared:
    system, parameters = experiment.system, experiment.parameters
    choice = interpreted_first(experiment).evaluator
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, dataset, choice)
    records = problem.records(dataset)
    start = with_proposals(aligned_start(problem, records, dataset), records, dataset)
    problem, nominal = start.problem, start.problem.parameters.nominal()
    records = with_drift(problem, problem.records(dataset), dataset, nominal)
    for group in groups:
        require_solvable(problem, problem.subset(records, group), nominal)
    every = np.arange(len(dataset), dtype=np.intp)
    return Prepared(dataset, problem, records, Split(every, every), start.warnings, start)


def _plan(groups: Sequence[Indices], settings: LoadTransferSettings) -> list[tuple[tuple[int, ...], Split]]:
    """At each payload and at all of them: one fit on everything there, judged elsewhere, and one for each fold."""
    every, plan = tuple(range(len(groups))), []
    for trained in [*((i,) for i in every), every]:
        train = np.concatenate([groups[i] for i in trained])
        elsewhere = [groups[i] for i in every if i not in trained]
        if elsewhere:
            plan.append((trained, Split(train, np.concatenate(elsewhere))))
        for split in folds(len(train), settings.folds, settings.seed):
            plan.append((trained, Split(train[split.train], train[split.holdout])))
    return plan


def _cells(
    ready: Mapping[str, Prepared],
    errors: Mapping[Training, Array],
    turns: Mapping[Training, Array],
    groups: Sequence[Indices],
    payloads: Sequence[float],
    unsolved: Sequence[Training],
) -> tuple[TransferCell, ...]:
    """Variant by variant: without calibration, then by what it was trained at."""
    cells: list[TransferCell] = []
    for name, own in ready.items():
        nominal, turned = errors_and_turns(own.problem, own.problem.parameters.nominal(), own.records)
        before = nominal if turned is None else np.degrees(turned)
        rows = [((), nominal * _MM, before), *((k[1], row, turns[k]) for k, row in errors.items() if k[0] == name)]
        for trained, row, turn in rows:
            at, failed = tuple(payloads[i] for i in trained), unsolved.count((name, trained))
            for i, group in enumerate(groups):
                of_turns = None if turned is None else summarise(turn[group])
                cell = TransferCell(name, at, payloads[i], summarise(row[group]), i in trained, failed, of_turns)
                cells.append(cell)
    return tuple(cells)
