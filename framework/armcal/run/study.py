"""A study: variants of one configuration, judged by cross-validation on the same folds of the same records.

With ``group_by`` each variant is also trained at each group of records alone and judged at the others, each way.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

import numpy as np
from pydantic import Field

from armcal.base.arrays import Array, Indices
from armcal.base.config_text import as_json
from armcal.base.dataset import Dataset
from armcal.base.settings import Settings
from armcal.calibration.calibration_file import dump
from armcal.config.validate import validate
from armcal.config.yaml_source import VARIANTS, ConfigSource, load_variants
from armcal.diagnose.fit import Prepared
from armcal.errors import ConfigError, DataError, InputError, Location, NotConvergedError, ProblemError
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.identifiability import candidates, freeing, require_solvable
from armcal.estimate.polish import restricted, untrained
from armcal.estimate.robust import fit
from armcal.estimate.validation import (
    BlockLength,
    ErrorSummary,
    FitTask,
    JudgedFit,
    Split,
    automatic_block_length,
    cross_validate,
    error_unit,
    errors_and_turns,
    fit_and_judge,
    folds,
    in_unit,
    standard_error_of_mean,
    summarise,
)
from armcal.io.parallel import Executor
from armcal.measure.tables import csv_text
from armcal.plugins import PluginRegistry, discover
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment, ExperimentSettings, ValidationSettings
from armcal.run.pipeline import Stopwatch, acting, prepare
from armcal.run.pose_residual import Layer, judged_with, layer_of

R = TypeVar("R")
PREVIOUS = "previous"  # As a reference: each variant is compared with the one before it
WORTH_COMPILING = 1000
"""Records to fit: less than for a run, since the models of a study may be large and their fits long."""
FILES = ("experiment.yaml", "study.csv", "study.json", "study.html")
_MM = 1000.0


class StudySettings(Settings):
    """Variants compared by cross-validation, all on the same folds of the same records.

    Without ``variants`` the configuration itself is the only one. ``reference`` is what each is compared with: a
    variant, or ``previous`` for a ladder. ``nested`` chooses a variant inside each
    fold's training records and judges the choice on the fold. ``blocks`` is the number of neighbouring records that
    are resampled together for standard errors. ``group_by`` is a text column of the data, or ``payload``: each variant
    is also trained at each of its groups, and judged at each.
    """

    variants: dict[str, Any] = Field(default_factory=dict)
    reference: str = PREVIOUS
    folds: Annotated[int, Field(ge=2)] = 5
    seed: Annotated[int, Field(ge=0)] = 0
    nested: bool = False
    blocks: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    group_by: str | None = None


@dataclass(frozen=True)
class Change:
    """One model against another, record by record; negative is better."""

    against: str  # the other model
    mean: float  # of the differences of each record's error
    standard_error: float  # of that mean, from blocks of neighbouring records; the fitted models are taken as given
    block: int  # how many neighbours a block has
    helped: float  # the share of records whose error is smaller


@dataclass(frozen=True)
class VariantResult:
    name: str  # of the variant
    free: int  # how many numbers the fit may change
    nominal: ErrorSummary  # errors without calibration (mm)
    train: ErrorSummary  # errors of a fit on all records, on the same records (mm)
    crossed: ErrorSummary  # errors of each record by a fit that did not see it (mm)
    at_rest: ErrorSummary  # the same if nothing is known of a drift; equal where nothing drifts
    errors_mm: Array  # ``crossed`` record by record (N; nan where a fold did not converge)
    change: Change | None  # against the variant it is compared with (mm); None for the reference itself
    converged: bool  # whether the fit on all records did
    failed_folds: int  # how many fits of the cross-validation did not converge
    fit_seconds: float  # of the fit on all records
    seconds: float  # of all fits of this variant
    turns: Mapping[str, ErrorSummary] | None = None  # of orientations (deg), by records; where measured beside lengths

    def as_dict(self) -> dict[str, Any]:
        errors = {"nominal": self.nominal, "train": self.train}
        errors |= {"cross_validated": self.crossed, "cross_validated_at_rest": self.at_rest}
        content: dict[str, Any] = {"error_mm": errors, **({"orientation_error_deg": self.turns} if self.turns else {})}
        return {
            "name": self.name,
            "free": self.free,
            **{what: {of: asdict(own) for of, own in summaries.items()} for what, summaries in content.items()},
            "change_mm": self.change and asdict(self.change),
            "converged": self.converged,
            "failed_folds": self.failed_folds,
            "seconds": {"fit": self.fit_seconds, "all_fits": self.seconds},
        }


@dataclass(frozen=True)
class NestedResult:
    crossed: ErrorSummary
    chosen: tuple[str, ...]  # by each fold
    errors_mm: Array  # N; nan where the chosen fit did not converge


@dataclass(frozen=True)
class Cell:
    variant: str
    trained_at: tuple[str, ...]  # none for the nominal model
    judged_at: str
    error_mm: ErrorSummary
    cross_validated: bool  # the group also trained: its records were kept out of the training by folds
    failed_fits: int
    orientation_error_deg: ErrorSummary | None = None  # where orientations are measured


@dataclass(frozen=True, kw_only=True)
class StudyResult:
    name: str
    command: str  # that repeats it
    dataset: Dataset
    simulated: bool
    folds: int
    variants: tuple[VariantResult, ...]  # in the order written
    best: str  # the lowest cross-validated mean error, of those whose fits all converged
    simplest: str  # the fewest parameters within one standard error of it
    nested: NestedResult | None
    group_by: str | None
    labels: tuple[str, ...]  # the group of each record
    groups: Mapping[str, int]  # records of each; empty where nothing groups them
    cells: tuple[Cell, ...]
    trained_mm: Mapping[tuple[str, tuple[str, ...]], Array]  # by variant and groups trained at, record by record
    warnings: tuple[str, ...]
    seconds: dict[str, float]
    provenance: dict[str, Any]
    unit: str = "mm"  # of all errors; ``mrad`` where nothing measured is a length

    def variant(self, name: str) -> VariantResult:
        return next(v for v in self.variants if v.name == name)

    def as_dict(self) -> dict[str, Any]:
        nested, grouped = self.nested, dict[str, Any]()
        if self.group_by is not None:
            grouped = {"group_by": self.group_by, "simulated": self.simulated, "groups": dict(self.groups)}
            cells = [asdict(cell) for cell in self.cells]
            grouped["cells"] = [{key: value for key, value in cell.items() if value is not None} for cell in cells]
        content = {
            "study": self.name,
            "records": len(self.dataset),
            "folds": self.folds,
            "variants": [variant.as_dict() for variant in self.variants],
            "lowest": self.best,
            "simplest_within_one_standard_error": self.simplest,
            "nested": nested and {"error_mm": asdict(nested.crossed), "chosen": list(nested.chosen)},
            **grouped,
            "warnings": list(self.warnings),
            "seconds": dict(self.seconds),
            "provenance": self.provenance,
        }
        return dict(in_unit(content, self.unit))


@dataclass(frozen=True)
class Study:
    name: str
    source: ConfigSource
    settings: StudySettings
    experiments: Mapping[str, Experiment]

    @classmethod
    def load(
        cls,
        path: str | Path,
        overrides: Sequence[str] = (),
        data: str | Path | None = None,
        registry: PluginRegistry | None = None,
    ) -> Self:
        registry = registry or discover()
        source, variants = load_variants(path, overrides)
        if not isinstance(source.data.get("study"), dict):
            raise ConfigError(
                "found no study.",
                where=source.where(("study",)),
                hint="Give study: {variants: {NAME: {extends: FILE}, ...}}; see docs/study.md.",
            )
        settings = validate(StudySettings, source, ("study",))
        if settings.reference not in (PREVIOUS, *variants):
            raise ConfigError(
                f"found the reference {settings.reference!r}, expected {PREVIOUS} or one of {', '.join(variants)}.",
                where=source.where(("study", "reference")),
            )
        experiments = {}
        for name, variant in variants.items():
            experiment = _naming(name, partial(Experiment.of, variant, data, registry))
            # Without the split that a run would make, a study draws its own folds; nothing is compiled before
            # everything is known to be solvable.
            chosen = experiment.settings.model_copy(update={"validation": ValidationSettings()})
            experiments[name] = replace(experiment, settings=chosen)
        return cls(str(source.data.get("name") or Path(path).stem), source, settings, experiments)

    def prepare(self, progress: Progress = no_progress) -> dict[str, Prepared]:
        """The problem of each variant with its records: those that were measured, or else simulated."""
        ready = {}
        for name, experiment in self.experiments.items():
            open_choice: ExperimentSettings = experiment.settings
            if open_choice.evaluator == "auto":
                open_choice = open_choice.model_copy(update={"evaluator": "interpreted"})
            ready[name] = _naming(name, partial(_prepared, replace(experiment, settings=open_choice), progress))
        (first_name, first), *others = ready.items()
        outputs = [c for k in first.problem.kernels for c in k.factor.output_channels]
        for name, other in others:
            same = other.dataset.ids == first.dataset.ids and other.dataset.sha256 == first.dataset.sha256
            measured = [c for k in other.problem.kernels for c in k.factor.output_channels]
            if not same or measured != outputs:
                raise ProblemError(
                    f"the variants {first_name} and {name} are not judged on the same records: "
                    f"{len(first.dataset)} and {len(other.dataset)} are used, measured are {', '.join(outputs)} and "
                    f"{', '.join(measured)}.",
                    hint="Give every variant the same data and measurements.",
                )
        return ready


def _naming(name: str, work: Callable[[], R]) -> R:
    try:
        return work()
    except InputError as fault:
        raise type(fault)(f"variant {name}: {fault.message}", where=fault.where, hint=fault.hint) from fault


def _prepared(experiment: Experiment, progress: Progress) -> Prepared:
    simulated = experiment.settings.data is None and experiment.settings.simulation is not None
    made = experiment.simulator().simulate(experiment.simulation_request) if simulated else None
    return prepare(experiment, Stopwatch(), progress=progress, dataset=made)


@dataclass(frozen=True)
class _Training:
    groups: tuple[str, ...]
    train: Indices
    folds: tuple[Split, ...]
    count: int  # of all records

    @property
    def splits(self) -> list[Split]:
        """Judged everywhere by the fit to all that train; then the folds."""
        return [Split(self.train, np.arange(self.count, dtype=np.intp)), *self.folds]

    def errors(self, fits: Sequence[JudgedFit]) -> Array:
        """Errors, the same at rest (mm) and turns (deg) of each record by a fit that did not see it (3 x N)."""
        rows, elsewhere = np.full((3, self.count), np.nan), np.ones(self.count, dtype=bool)
        elsewhere[self.train] = False
        rows[:, elsewhere] = _stacked(fits[0])[:, elsewhere]
        for split, own in zip(self.folds, fits[1:], strict=True):
            rows[:, split.holdout] = _stacked(own)
        return rows


def _stacked(fit: JudgedFit) -> Array:
    turns = np.full(len(fit.errors), np.nan) if fit.turns is None else np.degrees(fit.turns)
    return np.stack([fit.errors * _MM, fit.at_rest * _MM, turns])


def compare(
    study: Study,
    executor: Executor,
    command: str = "",
    progress: Progress = no_progress,
    watch: Stopwatch | None = None,
) -> StudyResult:
    watch, settings = watch or Stopwatch(), study.settings
    with watch.stage("prepare"):
        ready = study.prepare(progress)
        some, first = next(iter(ready.values())), next(iter(study.experiments.values()))
        dataset, poses = some.dataset, first.poses(some.dataset)
        where = study.source.where(("study", "group_by"))
        labels = () if settings.group_by is None else first.labels(dataset, settings.group_by, where)
        groups = _groups(labels, dataset, settings)
        for name, own in ready.items():
            for rows in groups.values():
                _naming(name, partial(_require_solvable, own, rows))
    listed: dict[tuple[str, ...], Indices] = {tuple(groups): np.arange(len(poses), dtype=np.intp)}
    listed |= {(name,): rows for name, rows in groups.items()}
    whole, *parts = (_Training(at, rows, _folds(rows, settings, poses), len(poses)) for at, rows in listed.items())
    inner = [_folds(outer.train, settings, poses) for outer in whole.folds] if settings.nested else []
    splits = [split for training in (whole, *parts) for split in training.splits]
    plan = [(name, split) for name in ready for split in (*splits, *chain.from_iterable(inner))]
    fits, count = _fits(study, ready, plan, executor, progress, watch), len(plan) // len(ready)
    by_name = {name: fits[i * count : (i + 1) * count] for i, name in enumerate(ready)}
    judged = [_judged(name, ready[name], by_name[name], whole) for name in ready]
    variants = _compared(judged, settings)
    best, simplest = _choices(variants, settings)
    trained = {name: _by_training(ready[name], by_name[name], (whole, *parts)) for name in ready} if parts else {}
    return StudyResult(
        name=study.name,
        command=command,
        dataset=dataset,
        simulated=first.settings.data is None,
        folds=settings.folds,
        variants=variants,
        best=best,
        simplest=simplest,
        nested=_nested(by_name, whole.folds, inner, len(splits)) if inner else None,
        group_by=settings.group_by,
        labels=labels,
        groups={name: len(rows) for name, rows in groups.items()},
        cells=tuple(
            own.cell(name, at, group, rows)
            for name, by_training in trained.items()
            for at, own in by_training.items()
            for group, rows in groups.items()
        ),
        trained_mm={(n, at): o.errors_mm for n, own in trained.items() for at, o in own.items() if at},
        warnings=_warnings(ready, variants),
        seconds=watch.seconds,
        provenance=first.provenance(dataset),
        unit=error_unit(some.problem),
    )


def _groups(labels: Sequence[str], dataset: Dataset, settings: StudySettings) -> dict[str, Indices]:
    """Records of each group, payloads in rising order; none where nothing groups them."""
    if settings.group_by is None:
        return {}
    names = list(dict.fromkeys(labels))
    if settings.group_by not in dataset.extra:
        names.sort(key=lambda name: float(name.partition(" ")[0]))
    groups = {name: np.flatnonzero(np.array(labels) == name).astype(np.intp) for name in names}
    few = [name for name, rows in groups.items() if len(rows) < settings.folds]
    if few or len(groups) < 2:
        counts = ", ".join(f"{name} ({len(rows)})" for name, rows in groups.items())
        raise DataError(
            f"too few records at {', '.join(few) or f'a second {settings.group_by}'}; there are records at {counts}.",
            where=Location(dataset.source),
            hint=f"Each {settings.group_by} needs at least as many records as there are folds ({settings.folds}).",
        )
    return groups


def _require_solvable(ready: Prepared, rows: Indices) -> None:
    problem = restricted(ready.problem.subset(rows))
    require_solvable(problem, problem.parameters.nominal())


def _folds(train: Indices, settings: StudySettings, poses: Indices) -> tuple[Split, ...]:
    inside = folds(len(train), settings.folds, settings.seed, poses[train])
    return tuple(Split(train[split.train], train[split.holdout]) for split in inside)


def _fits(
    study: Study,
    ready: Mapping[str, Prepared],
    plan: Sequence[tuple[str, Split]],
    executor: Executor,
    progress: Progress,
    watch: Stopwatch,
) -> list[JudgedFit]:
    """Each variant of a plan fitted to the records that train and judged on those held out."""
    work = len(next(iter(ready.values())).dataset) * len(plan) // len(ready)
    with watch.stage("compile"):
        open_choice = [name for name in ready if study.experiments[name].settings.evaluator == "auto"]
        chosen = open_choice if work >= WORTH_COMPILING else []
        executor.map(_compile, [ready[name].problem for name in chosen], lambda done: progress("compile", done))
        problems = {name: own.problem for name, own in ready.items()}
        problems |= {name: problems[name].evaluated_by("compiled") for name in chosen}
    layers = {name: layer_of(study.experiments[name].system, own.dataset) for name, own in ready.items()}
    tasks = []
    for name, split in plan:
        start = problems[name].parameters.nominal()
        task = FitTask(problems[name], study.experiments[name].estimator, start, split)
        tasks.append((task, layers[name]))
    with watch.stage("fits"):
        return executor.map(_fit, tasks, lambda done: progress("fits", done))


def _fit(judging: tuple[FitTask, Layer | None]) -> JudgedFit:
    task, layer = judging
    return fit_and_judge(task) if layer is None else judged_with(task, layer)


def _compile(problem: Problem) -> None:
    problem.evaluated_by("compiled")


def _judged(name: str, ready: Prepared, fits: Sequence[JudgedFit], whole: _Training) -> VariantResult:
    nominal, nominal_turns = _nominal(ready)
    of_all, own = fits[0], fits[: len(whole.splits)]
    errors, at_rest, turned = whole.errors(own)
    turns = None
    if nominal_turns is not None and of_all.turns is not None:
        turns = {
            "nominal": summarise(nominal_turns),
            "train": summarise(np.degrees(of_all.turns)),
            "cross_validated": summarise(turned),
        }
    return VariantResult(
        name=name,
        free=ready.problem.increments,
        nominal=summarise(nominal),
        train=summarise(of_all.errors * _MM),
        crossed=summarise(errors),
        at_rest=summarise(at_rest),
        errors_mm=errors,
        change=None,
        converged=of_all.converged,
        failed_folds=sum(not fit.converged for fit in own[1:]),
        fit_seconds=of_all.seconds,
        seconds=sum(fit.seconds for fit in fits),
        turns=turns,
    )


def _nominal(ready: Prepared) -> tuple[Array, Array | None]:
    """Errors (mm) and, where they are measured, turns (deg) without calibration."""
    problem = untrained(ready.problem)
    errors, turns = errors_and_turns(problem.with_records(ready.problem.records), problem.parameters.nominal())
    return errors * _MM, None if turns is None else np.degrees(turns)


def _compared(plain: Sequence[VariantResult], settings: StudySettings) -> tuple[VariantResult, ...]:
    by_name = {result.name: result for result in plain}
    others = [plain[0], *plain] if settings.reference == PREVIOUS else [by_name[settings.reference]] * len(plain)
    return tuple(
        result
        if other is result
        else replace(result, change=change(result.errors_mm, other.errors_mm, other.name, settings.blocks))
        for result, other in zip(plain, others, strict=False)
    )


def change(errors: Array, others: Array, against: str, block: BlockLength = "auto") -> Change:
    """Errors (N) of one model against those of another on the same records in recorded order; nan where not judged."""
    both = np.flatnonzero(np.isfinite(errors) & np.isfinite(others))
    gained = errors[both] - others[both]
    length = automatic_block_length(gained) if block == "auto" else block
    return Change(
        against=against,
        mean=float(np.mean(gained)) if len(both) else float("nan"),
        standard_error=standard_error_of_mean(gained, length),
        block=length,
        helped=float(np.mean(gained < 0)) if len(both) else float("nan"),
    )


def simplest_good(means: Array, freedoms: Sequence[int], changes: Sequence[Change]) -> int:
    """The model with the fewest parameters whose mean error is within one standard error of the lowest. [Hastie2009]

    ``changes`` are of each model against the one with the lowest mean.
    """
    best = int(np.nanargmin(means))
    good = [i for i, c in enumerate(changes) if i == best or c.mean <= c.standard_error]
    return min(good, key=lambda i: (freedoms[i], means[i]))


def _choices(variants: Sequence[VariantResult], settings: StudySettings) -> tuple[str, str]:
    whole = [v for v in variants if v.converged and not v.failed_folds]
    if not whole:
        raise NotConvergedError(
            "of every variant some fit did not converge.", hint="Check the data and the start values."
        )
    means = np.array([v.crossed.mean for v in whole], dtype=float)
    best = whole[int(np.argmin(means))]
    changes = [change(v.errors_mm, best.errors_mm, best.name, settings.blocks) for v in whole]
    return best.name, whole[simplest_good(means, [v.free for v in whole], changes)].name


def _nested(
    fits: Mapping[str, Sequence[JudgedFit]], outer: Sequence[Split], inner: Sequence[Sequence[Split]], offset: int
) -> NestedResult:
    """Each fold's choice, made by the mean error over the folds inside of it, judged by the fold. [Varma2006]"""
    chosen, errors = [], np.full(sum(len(split.holdout) for split in outer), np.nan)
    at = offset
    for number, (split, inside) in enumerate(zip(outer, inner, strict=True)):
        seen = {name: np.concatenate([f.errors for f in fit[at : at + len(inside)]]) for name, fit in fits.items()}
        means = {name: float(np.mean(e)) if np.isfinite(e).all() else np.inf for name, e in seen.items()}
        best = min(means, key=lambda name: means[name])
        chosen.append(best)
        errors[split.holdout] = fits[best][1 + number].errors * _MM
        at += len(inside)
    return NestedResult(summarise(errors), tuple(chosen), errors)


@dataclass(frozen=True)
class _Trained:
    errors_mm: Array  # by record
    turns_deg: Array | None
    failed_fits: int

    def cell(self, variant: str, trained_at: tuple[str, ...], group: str, rows: Indices) -> Cell:
        turns = None if self.turns_deg is None else summarise(self.turns_deg[rows])
        errors, crossed = summarise(self.errors_mm[rows]), group in trained_at
        return Cell(variant, trained_at, group, errors, crossed, self.failed_fits, turns)


def _by_training(
    ready: Prepared, fits: Sequence[JudgedFit], trainings: Sequence[_Training]
) -> dict[tuple[str, ...], _Trained]:
    """What a variant says of every record without calibration, then by each training: group by group, then all."""
    nominal, turned = _nominal(ready)
    trained, at = list[tuple[tuple[str, ...], _Trained]](), 0
    for training in trainings:
        own = fits[at : at + len(training.splits)]
        errors, _, turns = training.errors(own)
        failed = sum(not fit.converged for fit in own)
        trained.append((training.groups, _Trained(errors, None if turned is None else turns, failed)))
        at += len(own)
    return dict([((), _Trained(nominal, turned, 0)), *trained[1:], trained[0]])


def _warnings(ready: Mapping[str, Prepared], variants: Sequence[VariantResult]) -> tuple[str, ...]:
    """Each once, with the variants it holds for unless these are all."""
    holders: dict[str, list[str]] = {}
    for name, prepared in ready.items():
        for text in dict.fromkeys(prepared.warnings):
            holders.setdefault(text, []).append(name)
    listed = [text if len(names) == len(ready) else f"{', '.join(names)}: {text}" for text, names in holders.items()]
    for v in variants:
        if v.failed_folds or not v.converged:
            listed.append(f"{v.name}: {v.failed_folds + (not v.converged)} fits did not converge; it is not chosen.")
    return tuple(listed)


def files(result: StudyResult, study: ConfigSource, variants: Mapping[str, ConfigSource], page: str) -> dict[str, str]:
    """The configuration with each variant as the sections in which it differs: no other file is needed; and results."""
    read = next((own.data["data"] for own in variants.values() if "data" in own.data), None)
    data = study.data if read is None else {**study.data, "data": read}
    base = {key: section for key, section in data.items() if key != VARIANTS[0]}
    listed = {}
    for name, own in variants.items():
        differing = {key: section for key, section in own.data.items() if base.get(key) != section}
        listed[name] = {"set": differing | {key: None for key in base if key not in own.data}}
    # A row a record, an error a variant, by a fit that did not see the record.
    columns: dict[str, Any] = {} if result.group_by is None else {result.group_by: result.labels}
    columns |= {f"{v.name}_{result.unit}": v.errors_mm for v in result.variants}
    if result.nested:
        columns[f"chosen_inside_{result.unit}"] = result.nested.errors_mm
    for (name, trained), errors in result.trained_mm.items():
        if len(trained) < len(result.groups):
            columns[f"{name}_trained_at_{'_and_'.join(trained).replace(' ', '_')}_{result.unit}"] = errors
    dataset = result.dataset
    body = zip(dataset.ids, dataset.rows or ("",) * len(dataset), *columns.values(), strict=True)
    return {
        "experiment.yaml": dump({**data, VARIANTS[0]: {**data[VARIANTS[0]], "variants": listed}}),
        "study.csv": csv_text([["pose_id", "source_row", *columns], *body]),
        "study.json": as_json(result.as_dict()) + "\n",
        "study.html": page,
    }


_FOLDS = 5
_MOST_STEPS = 6
_STANDARD_ERRORS, _LEAST_GAIN = 2.6, 0.01
"""What a gain on records held out must be: in its standard errors, and of the error."""


@dataclass(frozen=True)
class FreedStep:
    """A fixed parameter, freed beside those before it; ``error`` is the mean of records held out (None: not judged)."""

    name: str
    unit: str
    change: tuple[float, ...]  # of its coordinates, to first order (SI)
    sd: tuple[float, ...]
    p_value: float
    error: float | None  # in the unit of errors
    recommended: bool


@dataclass(frozen=True)
class FixedParameters:
    unit: str  # of errors
    error: float | None  # mean error of records held out, as configured
    gaining: tuple[FreedStep, ...]  # parameters that explain residuals, in the order in which they are freed
    recommended: tuple[str, ...]  # to be freed: none if held-out errors do not fall by more than chance, and by 1 %
    determined_and_nothing_gained: tuple[str, ...]


def fixed_parameters(experiment: Experiment, ready: Prepared, progress: Progress = no_progress) -> FixedParameters:
    """Fit with what is configured, look for what it leaves, and cross-validate what is found."""
    parameters = ready.problem.parameters
    # The problem with every candidate free, too: functions for whatever is chosen of them.
    system, own = experiment.system, [block.name for block in parameters.free]
    freer = parameters.with_free([*own, *candidates(parameters)])
    groups, evaluator = ready.problem.blueprint.groups, experiment.settings.evaluator
    built = (system.arms, system.measurements, freer, system.environment, ready.dataset, evaluator, groups)
    wide = Problem.build(*built)
    train = ready.split.train
    wide = acting(wide, ready.dataset).subset(train)
    start = next(iter(ready.start.values(ready.problem)), parameters.nominal())
    fitted = fit(wide.with_parameters(parameters), experiment.estimator, start, progress)
    values = fitted.solution.values
    gaining, others = freeing(wide.with_records(fitted.problem.records), own, values)
    determined = tuple(one.name for one in others)
    unit = error_unit(ready.problem)
    if not gaining:
        return FixedParameters(unit, None, (), (), determined)
    splits = folds(len(train), _FOLDS, 0, experiment.poses(ready.dataset.subset(train)))
    names = [one.name for one in gaining]

    def errors_with(count: int) -> Array:
        problem = wide.with_parameters(parameters.with_free([*own, *names[:count]]))
        return cross_validate(problem, splits, experiment.estimator, values, progress).errors

    counts = sorted({*range(min(len(names), _MOST_STEPS) + 1), len(names)})
    errors, best = {count: errors_with(count) for count in counts}, 0
    for count in counts[1:]:
        gains = errors[best] - errors[count]
        chance = _STANDARD_ERRORS * float(np.std(gains)) / np.sqrt(len(gains))
        if np.mean(gains) > max(chance, _LEAST_GAIN * float(np.mean(errors[best]))):
            best = count
    means = {count: 1000 * float(np.mean(error)) for count, error in errors.items()}
    steps = []
    for i, one in enumerate(gaining, 1):
        numbers = (tuple(one.change.tolist()), tuple(one.sd.tolist()), one.p_value)
        steps.append(FreedStep(one.name, parameters[one.name].unit, *numbers, means.get(i), i <= best))
    return FixedParameters(unit, means[0], tuple(steps), tuple(names[:best]), determined)
