"""What a run knows when it ends: everything that the outputs, the report and the terminal show."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any, Self

import numpy as np

from armcal.base.arrays import Array
from armcal.base.config_text import finite
from armcal.base.dataset import Dataset
from armcal.calibration.intervals import PAYLOAD, PredictionRecord
from armcal.config.system import System
from armcal.diagnose.coverage import IntervalResult, intervals
from armcal.diagnose.fit import Fit, RecordErrors
from armcal.diagnose.verdict import Verdict
from armcal.estimate.estimator import Estimate
from armcal.estimate.polish import settled, untrained
from armcal.estimate.prediction import ResidualSpread, residual_spread
from armcal.estimate.uncertainty import Bootstrap
from armcal.estimate.validation import ErrorSummary, Split, summarise
from armcal.estimate.variance import VarianceComponents
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment, group_texts
from armcal.run.pose_residual import ResidualOutcome

_MM = 1000.0


@dataclass(frozen=True)
class SuspiciousRecord:
    """A training record beyond its limit: where it stood, how many standard deviations off, what became of it.

    ``row`` is that of the source (0 if it has none); ``weight`` 0 means that it was set aside.
    """

    row: int
    record_id: str
    measurement: str
    deviations: float
    limit: float
    weight: float
    error_mm: float

    @property
    def reason(self) -> str:
        return f"{self.deviations:.1f} standard deviations from the fit (limit {self.limit:.1f})"

    @property
    def fate(self) -> str:
        return "set aside" if self.weight == 0 else f"weight {self.weight:.2g}"


@dataclass(frozen=True)
class NoiseResult:
    """How the records of a run weighed.

    Attributes:
        weights: of each record of the dataset in the fit, its least one if it has several (N; nan: not trained on).
        scatter: of what the fit leaves unexplained, by measurement.
    """

    loss: str = "none"  # ``none``, ``huber``, ``cauchy`` or ``reject``
    weights: Array | None = None
    suspicious: tuple[SuspiciousRecord, ...] = ()  # the farthest first; not sought in plain least squares
    components: VarianceComponents | None = None  # estimated variances, or None
    rounds: int = 0  # solves beyond the first
    scatter: Mapping[str, ResidualSpread] = field(default_factory=dict)

    @property
    def set_aside(self) -> tuple[SuspiciousRecord, ...]:
        return tuple(record for record in self.suspicious if record.weight == 0)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json and calibration.yaml."""
        content: dict[str, Any] = {"loss": self.loss}
        if self.loss != "none":
            content["rounds"] = self.rounds
            content["suspicious_records"] = [asdict(record) for record in self.suspicious]
        if self.components is not None:
            content["components"] = [finite(asdict(component)) for component in self.components.components]
            content["inseparable"] = [list(pair) for pair in self.components.inseparable]
            content["unseen_joints"] = list(self.components.unseen)
        spreads = self.scatter.items()
        content["scatter"] = {name: {**asdict(own), "covariance": own.covariance.tolist()} for name, own in spreads}
        return content


def noise_result(fit: Fit) -> NoiseResult:
    fitted, dataset, train = fit.fitted, fit.dataset, fit.split.train
    weights = np.full(len(dataset), np.nan)
    weights[train] = np.min(np.array(fitted.weights), axis=0)
    suspicious = []
    for suspect in fitted.suspects:
        i = int(train[suspect.record])
        row = dataset.rows[i] if dataset.rows else 0
        numbers = (suspect.distance, suspect.limit, suspect.weight, float(fit.errors.calibrated_mm[i]))
        suspicious.append(SuspiciousRecord(row, dataset.ids[i], suspect.measurement, *numbers))
    scatter = residual_spread(fitted.problem, fit.estimate, fit.ready.trained)
    return NoiseResult(fitted.loss, weights, tuple(suspicious), fitted.components, len(fitted.rounds), scatter)


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


def run_groups(experiment: Experiment, fit: Fit) -> tuple[GroupError, ...]:
    """Errors of each group, sorted by name; none if nothing separates groups."""
    problem, dataset, label, errors = fit.problem, fit.dataset, experiment.label, fit.errors
    if label is None or not (label in dataset.extra or (label == PAYLOAD and dataset.has(PAYLOAD))):
        return ()
    labels = np.array(group_texts(dataset, label))
    before = _distances(problem, settled(untrained(problem), problem.parameters.nominal()))
    # Distances are judged by what the records of each socket say, not by what the known distance made of them.
    after = _distances(problem, settled(untrained(problem), fit.estimate.values))
    result = []
    for name in sorted(set(labels.tolist()) - {""}):
        inside = labels == name
        nominal, calibrated = (float(np.nanmean(e[inside])) for e in (errors.nominal_mm, errors.calibrated_mm))
        trained = int(np.sum(inside[fit.split.train]))
        of_nominal, of_calibrated = _within(name, before), _within(name, after)
        result.append(GroupError(name, int(inside.sum()), trained, nominal, calibrated, of_nominal, of_calibrated))
    return tuple(result)


def _distances(problem: Problem, values: Array) -> list[tuple[tuple[str, str], float]]:
    return [(tie.groups, float(np.linalg.norm(tie.residual(values))) * _MM) for tie in problem.compiled.known_ties]


def _within(name: str, distances: list[tuple[tuple[str, str], float]]) -> float | None:
    own = [error for groups, error in distances if all(name in group.split("/") for group in groups)]
    return float(np.mean(own)) if own else None


@dataclass(frozen=True)
class ErrorTable:
    """Error summaries (mm) by model and by records (train, holdout, cross_validated).

    ``calibrated`` counts the drift that neighbouring records show; ``at_rest`` is without it, and empty if nothing
    drifts. ``turns`` are those of orientations (deg): another table, without a drift; None where none are measured.
    """

    nominal: dict[str, ErrorSummary]
    calibrated: dict[str, ErrorSummary]
    at_rest: dict[str, ErrorSummary] = field(default_factory=dict)
    turns: Self | None = None

    def as_dict(self) -> dict[str, Any]:
        return {
            model: {name: asdict(summary) for name, summary in table.items()}
            for model, table in (("nominal", self.nominal), ("calibrated", self.calibrated), ("at_rest", self.at_rest))
            if table
        }

    @classmethod
    def of(cls, errors: RecordErrors, split: Split) -> Self:
        """The summaries of every record's errors."""
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
    """A finished run.

    Attributes:
        name: of the experiment.
        command: how to repeat it.
        fit: the problem, its records and the estimate, and whatever a check or a table asks of them.
        verdict: what to conclude.
        warnings: of config, data and problem.
        seconds: of each stage, and ``total``.
        provenance: hashes and versions.
        noise: how the training records weighed.
        bootstrap: refits to resampled records, if they were asked for.
        prediction: what predictions need of the run beyond the values; None if it did not converge.
        groups: errors of groups of records, where a column separates them.
        pose_residual: what became of one that was to be learned.
    """

    name: str
    command: str
    fit: Fit
    verdict: Verdict
    warnings: tuple[str, ...]
    seconds: dict[str, float]
    provenance: dict[str, Any]
    noise: NoiseResult = field(default_factory=NoiseResult)
    bootstrap: Bootstrap | None = None
    prediction: PredictionRecord | None = None
    groups: tuple[GroupError, ...] = ()
    pose_residual: ResidualOutcome | None = None

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
    def intervals(self) -> IntervalResult:
        """How wide prediction intervals are, and what they hold."""
        return self.fit.of(intervals)

    @property
    def backend(self) -> str:
        """What evaluated the model."""
        return self.fit.problem.backend
