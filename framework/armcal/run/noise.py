"""Noise of a run: how records weighed, which are suspicious, and estimated variances."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from armcal.base.config_text import finite
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.estimate.residual_spread import ResidualSpread, residual_spread
from armcal.estimate.validation import Split
from armcal.estimate.variance import VarianceComponents
from armcal.estimate.weighing import WeighedFit
from armcal.problem.problem import Problem


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
        """Why it is suspicious."""
        return f"{self.deviations:.1f} standard deviations from the fit (limit {self.limit:.1f})"

    @property
    def fate(self) -> str:
        """In words."""
        return "set aside" if self.weight == 0 else f"weight {self.weight:.2g}"


@dataclass(frozen=True)
class NoiseResult:
    """How the records of a run weighed.

    Attributes:
        loss: ``none``, ``huber``, ``cauchy`` or ``reject``.
        weights: of each record of the dataset in the fit, its least one if it has several (N; nan: not trained on).
        suspicious: the farthest first; not sought in plain least squares.
        components: estimated variances, or None.
        rounds: solves beyond the first.
        scatter: of what the fit leaves unexplained, by measurement.
    """

    loss: str = "none"
    weights: Array | None = None
    suspicious: tuple[SuspiciousRecord, ...] = ()
    components: VarianceComponents | None = None
    rounds: int = 0
    scatter: Mapping[str, ResidualSpread] = field(default_factory=dict)

    @property
    def set_aside(self) -> tuple[SuspiciousRecord, ...]:
        """Those that took no part in the fit."""
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
        content["scatter"] = {
            name: {
                "covariance": spread.covariance.tolist(),
                "share": spread.share,
                "over": spread.over,
                "channel": spread.channel,
                "freedom": spread.freedom,
            }
            for name, spread in self.scatter.items()
        }
        return content


def noise_result(problem: Problem, fit: WeighedFit, dataset: Dataset, split: Split, errors_mm: Array) -> NoiseResult:
    """From a fit on the training records; errors are of all records (N)."""
    weights = np.full(len(dataset), np.nan)
    weights[split.train] = np.min(np.array(fit.weights), axis=0)
    suspicious = []
    for suspect in fit.suspects:
        i = int(split.train[suspect.record])
        row = dataset.rows[i] if dataset.rows else 0
        numbers = (suspect.distance, suspect.limit, suspect.weight, float(errors_mm[i]))
        suspicious.append(SuspiciousRecord(row, dataset.ids[i], suspect.measurement, *numbers))
    scatter = residual_spread(problem, fit.estimate, fit.records, dataset.subset(split.train))
    return NoiseResult(fit.loss, weights, tuple(suspicious), fit.components, len(fit.rounds), scatter)
