"""A study: variants of one configuration, how they are judged, and what both kinds of study share."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeVar

from pydantic import Field

from armcal.base.settings import Mass, Settings
from armcal.config.validate import validate
from armcal.config.variants import load_variants
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError, InputError
from armcal.estimate.estimator import Progress
from armcal.estimate.validation import FitTask, JudgedFit, Split, fit_and_judge
from armcal.io.parallel import Executor
from armcal.plugins import PluginRegistry, discover
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal.run.pose_residual import Layer, judged_with, layer_of
from armcal.run.prepare import Prepared, Stopwatch
from armcal.run.settings import ExperimentSettings, ValidationSettings

R = TypeVar("R")
PREVIOUS = "previous"
"""As a reference: each variant is compared with the one before it."""
WORTH_COMPILING = 1000
"""Records to fit: less than for a run, since the models of a study may be large and their fits long."""


class ModelStudySettings(Settings):
    """Variants compared by cross-validation, all on the same folds of the same records.

    ``reference`` is what each is compared with: a variant, or ``previous`` for a ladder. ``repeats`` draws the folds
    anew. ``nested`` chooses a variant inside each fold's training records and judges the choice on the fold.
    ``blocks`` is the number of neighbouring records that are resampled together for standard errors.
    """

    kind: Literal["models"] = "models"
    variants: Annotated[dict[str, Any], Field(min_length=1)]
    reference: str = PREVIOUS
    folds: Annotated[int, Field(ge=2)] = 5
    repeats: Annotated[int, Field(ge=1, le=1000)] = 1
    seed: Annotated[int, Field(ge=0)] = 0
    nested: bool = False
    blocks: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"


class LoadTransferSettings(Settings):
    """Variants trained at some payloads and judged at others.

    ``payloads`` are simulated, or looked for in the records' payload column, to the nearest tenth of a gram (by
    default all that are in it). Where a fit is judged at a payload it trained on, ``folds`` keep the two apart.
    """

    kind: Literal["load_transfer"]
    variants: Annotated[dict[str, Any], Field(min_length=1)]
    payloads: tuple[Mass, ...] = ()
    folds: Annotated[int, Field(ge=2)] = 5
    seed: Annotated[int, Field(ge=0)] = 0


@dataclass(frozen=True)
class Study:
    """A configuration with its variants, checked and built, before any data is read."""

    name: str
    source: ConfigSource
    settings: ModelStudySettings | LoadTransferSettings
    experiments: Mapping[str, Experiment]

    @classmethod
    def load(
        cls,
        path: str | Path,
        overrides: Sequence[str] = (),
        data: str | Path | None = None,
        registry: PluginRegistry | None = None,
    ) -> Self:
        """Read and check a study; the arguments are those of ``Experiment.load``.

        Raises:
            ConfigError: the study or a variant is refused.
            PluginError: a component is missing or broken.
        """
        registry = registry or discover()
        read = load_variants(path, overrides)
        settings = study_settings(read.base)
        experiments = {}
        for name, source in read.variants.items():
            experiment = naming(name, partial(Experiment.of, source, data, registry))
            # Without the split that a run would make: a study draws its own folds.
            whole = experiment.settings.model_copy(update={"validation": ValidationSettings()})
            experiments[name] = replace(experiment, settings=whole)
        return cls(str(read.base.data.get("name") or Path(path).stem), read.base, settings, experiments)


def study_settings(source: ConfigSource) -> ModelStudySettings | LoadTransferSettings:
    """The checked section ``study`` of a configuration.

    Raises:
        ConfigError: there is none, or it is refused.
    """
    section = source.data.get("study")
    if not isinstance(section, dict):
        raise ConfigError(
            "found no study.",
            where=source.where(("study",)),
            hint="Give study: {variants: {NAME: {extends: FILE}, ...}}; see docs/study.md.",
        )
    kind = section.get("kind", "models")
    if kind == "load_transfer":
        transfer = validate(LoadTransferSettings, source, ("study",))
        grams = [round(payload * 1e4) for payload in transfer.payloads]
        if len(set(grams)) < len(grams) or len(grams) == 1 or min(grams, default=0) < 0:
            raise ConfigError(
                "expected at least two different payloads, none below zero.",
                where=source.where(("study", "payloads")),
                hint="Write for example payloads_g: [0, 66.3].",
            )
        return transfer
    if kind != "models":
        raise ConfigError(
            f"found kind {kind!r}, expected models or load_transfer.", where=source.where(("study", "kind"))
        )
    models = validate(ModelStudySettings, source, ("study",))
    if models.reference not in (PREVIOUS, *models.variants):
        names = ", ".join(models.variants)
        raise ConfigError(
            f"found the reference {models.reference!r}, expected {PREVIOUS} or one of {names}.",
            where=source.where(("study", "reference")),
        )
    return models


def interpreted_first(experiment: Experiment) -> ExperimentSettings:
    """Settings that compile nothing before everything is known to be solvable, unless they ask for it."""
    settings = experiment.settings
    return settings.model_copy(update={"evaluator": "interpreted"}) if settings.evaluator == "auto" else settings


def judged_fits(
    study: Study,
    ready: Mapping[str, Prepared],
    plan: Sequence[tuple[str, Split]],
    executor: Executor,
    progress: Progress,
    watch: Stopwatch,
) -> list[JudgedFit]:
    """Each variant of a plan fitted to the records that train and judged on those held out.

    By compiled functions where the choice was left open and the work (records to fit) is worth it.
    """
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
        task = FitTask(problems[name], study.experiments[name].estimator, start, ready[name].records, split)
        tasks.append((task, layers[name]))
    with watch.stage("fits"):
        return executor.map(_judged, tasks, lambda done: progress("fits", done))


def _judged(judging: tuple[FitTask, Layer | None]) -> JudgedFit:
    """A fit judged, with the pose residual that it learns where one is to be learned."""
    task, layer = judging
    return fit_and_judge(task) if layer is None else judged_with(task, layer)


def _compile(problem: Problem) -> None:
    problem.evaluated_by("compiled")


def naming(name: str, work: Callable[[], R]) -> R:
    try:
        return work()
    except InputError as fault:
        raise type(fault)(f"variant {name}: {fault.message}", where=fault.where, hint=fault.hint) from fault
