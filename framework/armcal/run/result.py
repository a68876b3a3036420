"""What a run knows when it ends: everything that the outputs, the report and the terminal show."""

from dataclasses import dataclass, field
from typing import Any

from armcal.base.dataset import Dataset
from armcal.calibration.intervals import PredictionRecord
from armcal.config.system import System
from armcal.diagnose.evidence import Evidence
from armcal.diagnose.verdict import Verdict
from armcal.estimate.bootstrap import Bootstrap
from armcal.estimate.estimator import Estimate
from armcal.estimate.profile import Profile
from armcal.estimate.validation import Indices, Split
from armcal.run.errors import ErrorTable, RecordErrors
from armcal.run.groups import RunGroups
from armcal.run.intervals import IntervalResult
from armcal.run.noise import NoiseResult
from armcal.run.pose_residual import ResidualOutcome


@dataclass(frozen=True)
class RunResult:
    """A finished run.

    Attributes:
        name: of the experiment.
        command: how to repeat it.
        system: arms, measurements and statics, with what was learned of pose residuals.
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
        groups: of records, where a column separates them.
        pose_residual: what became of one that was to be learned.
    """

    name: str
    command: str
    system: System
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
    pose_residual: ResidualOutcome | None = None

    @property
    def train(self) -> Indices:
        """Indices of the training records."""
        return self.split.train
