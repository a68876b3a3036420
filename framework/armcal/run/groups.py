"""Errors by group of records: one tool position, one fixture, one day."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import ConfigError
from armcal.estimate.nuisance import settled, untrained
from armcal.measure.groups import Groups
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.problem import Problem
from armcal.run.errors import FittedRecords, RecordErrors
from armcal.run.experiment import Experiment

_MM = 1000.0


@dataclass(frozen=True)
class GroupError:
    """How wrong the model is on the records of one group (mean, mm), before and after calibration.

    ``distance_error_mm`` is what is left of known distances within the group; None where none is known.
    """

    name: str
    records: int
    trained: int
    nominal_error_mm: float
    error_mm: float
    nominal_distance_error_mm: float | None
    distance_error_mm: float | None

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        return {key: value for key, value in self.__dict__.items() if key != "name"}


@dataclass(frozen=True)
class RunGroups:
    """What a run found of groups: their errors, sorted by name, and the keys of those that bring parameters."""

    errors: tuple[GroupError, ...] = ()
    keys: Groups = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        return {error.name: error.as_dict() for error in self.errors}


def label_of(experiment: Experiment) -> str | None:
    """The text column that separates groups; None if there is none."""
    text = experiment.settings.validation.group_by
    if text is not None:
        return text
    labels = [
        measurement.group_labels
        for measurement in experiment.system.measurements.values()
        if isinstance(measurement, GroupedMeasurement)
    ]
    return next((label[0] for label in labels if label), None)


def labels_of(experiment: Experiment, dataset: Dataset) -> tuple[str, ...]:
    """Which group each record belongs to.

    Raises:
        ConfigError: no column separates groups.
    """
    label = label_of(experiment)
    if label is None or label not in dataset.extra:
        raise ConfigError(
            f"found no column {label or 'of groups'} in the records; they have {', '.join(dataset.extra) or 'none'}.",
            where=experiment.source.where(("validation",)),
            hint="Name a text column of the data: group_by: NAME.",
        )
    return _texts(dataset, label)


def run_groups(experiment: Experiment, run: FittedRecords, errors: RecordErrors) -> RunGroups:
    """Errors of each group, sorted by name (none if nothing separates groups), and the keys of the problem's groups."""
    problem, records, dataset, keys = run.problem, run.records, run.dataset, run.problem.blueprint.groups
    label = label_of(experiment)
    if label is None or label not in dataset.extra:
        return RunGroups((), keys)
    labels = np.array(_texts(dataset, label))
    before = _distances(problem, settled(untrained(problem), problem.parameters.nominal(), records))
    # Distances are judged by what the records of each socket say, not by what the known distance made of them.
    after = _distances(problem, settled(untrained(problem), run.fitted.estimate.values, records))
    result = []
    for name in sorted(set(labels.tolist()) - {""}):
        inside = labels == name
        nominal, calibrated = (float(np.nanmean(e[inside])) for e in (errors.nominal_mm, errors.calibrated_mm))
        trained = int(np.sum(inside[run.split.train]))
        of_nominal, of_calibrated = _within(name, before), _within(name, after)
        result.append(GroupError(name, int(inside.sum()), trained, nominal, calibrated, of_nominal, of_calibrated))
    return RunGroups(tuple(result), keys)


def _texts(dataset: Dataset, label: str) -> tuple[str, ...]:
    """A text column as groups are named by it: spaces about a text mean nothing."""
    return tuple(text.strip() for text in dataset.extra[label])


def _distances(problem: Problem, values: Array) -> list[tuple[tuple[str, str], float]]:
    return [(tie.groups, float(np.linalg.norm(tie.residual(values))) * _MM) for tie in problem.known_ties]


def _within(name: str, distances: list[tuple[tuple[str, str], float]]) -> float | None:
    own = [error for groups, error in distances if all(name in group.split("/") for group in groups)]
    return float(np.mean(own)) if own else None
