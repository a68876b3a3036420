"""What a run knows when it ends: everything that the outputs, the report and the terminal show."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.calibration.intervals import PredictionRecord
from armcal.diagnose.evidence import Evidence
from armcal.diagnose.verdict import Verdict
from armcal.estimate.bootstrap import Bootstrap
from armcal.estimate.estimator import Estimate
from armcal.estimate.profile import Profile
from armcal.estimate.validation import ErrorSummary, Indices, Split
from armcal.run.groups import RunGroups
from armcal.run.intervals import IntervalResult
from armcal.run.noise import NoiseResult


@dataclass(frozen=True)
class RecordErrors:
    """Error of each record of the dataset, in dataset order: in mm, or in ``unit`` where nothing measured is a length.

    Attributes:
        nominal_mm: with nominal parameters (N).
        calibrated_mm: with the calibrated ones (N).
        cross_validated_mm: by the fold that did not train on it (N; nan outside of cross-validation).
        nominal_residual_mm: measured minus predicted, all factors stacked (n_r x N).
        calibrated_residual_mm: the same after calibration.
        position_mm: predicted tool position of the first arm in its base frame (3 x N).
        failed_folds: how many folds of the cross-validation did not converge.
        at_rest_mm: with the calibrated parameters where nothing is known of a drift (N); None if nothing drifts.
        cross_validated_at_rest_mm: the same by the fold that did not train on it.
        residual_columns: names of the rows of the residuals, with their units (mm; mrad for angles).
        unit: of all errors, ``mm`` or ``mrad``.
    """

    nominal_mm: Array
    calibrated_mm: Array
    cross_validated_mm: Array
    nominal_residual_mm: Array
    calibrated_residual_mm: Array
    position_mm: Array
    failed_folds: int = 0
    at_rest_mm: Array | None = None
    cross_validated_at_rest_mm: Array | None = None
    residual_columns: tuple[str, ...] = ()
    unit: str = "mm"


@dataclass(frozen=True)
class ErrorTable:
    """Error summaries (mm) by model and by records (train, holdout, cross_validated).

    ``calibrated`` counts what neighbouring records tell of a drift; ``at_rest`` is without it, and empty if nothing
    drifts.
    """

    nominal: dict[str, ErrorSummary]
    calibrated: dict[str, ErrorSummary]
    at_rest: dict[str, ErrorSummary] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """For JSON."""
        return {
            model: {name: summary.as_dict() for name, summary in table.items()}
            for model, table in (("nominal", self.nominal), ("calibrated", self.calibrated), ("at_rest", self.at_rest))
            if table
        }


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    Attributes:
        name: of the experiment.
        command: how to repeat it.
        dataset: the records used.
        split: which trained and which judged.
        estimate: what was found.
        errors: of every record.
        table: their summaries.
        verdict: what to conclude.
        warnings: of config, data and problem.
        backend: what evaluated the model.
        seconds: of each stage, and ``total``.
        provenance: hashes and versions.
        noise: how the training records weighed.
        bootstrap: refits to resampled records, if they were asked for.
        intervals: how wide prediction intervals are, and what they hold.
        evidence: what residuals still depend on, which records are missed, what priors alone hold.
        profiles: intervals by profile likelihood, of the numbers asked for.
        prediction: what predictions need of the run beyond the values; None if it did not converge.
        groups: of records, where something tells them apart.
    """

    name: str
    command: str
    dataset: Dataset
    split: Split
    estimate: Estimate
    errors: RecordErrors
    table: ErrorTable
    verdict: Verdict
    warnings: tuple[str, ...]
    backend: str
    seconds: dict[str, float]
    provenance: dict[str, Any]
    noise: NoiseResult = field(default_factory=NoiseResult)
    bootstrap: Bootstrap | None = None
    intervals: IntervalResult = field(default_factory=IntervalResult)
    evidence: Evidence = field(default_factory=Evidence)
    profiles: tuple[Profile, ...] = ()
    prediction: PredictionRecord | None = None
    groups: RunGroups = field(default_factory=RunGroups)

    @property
    def train(self) -> Indices:
        """Indices of the training records."""
        return self.split.train
