"""What the command line does, in a few calls: load an experiment, run it, use what it found."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.diagnose.verdict import Verdict
from armcal.errors import NotConvergedError
from armcal.estimate.estimator import CHECK_THE_DATA, Estimate
from armcal.io.parallel import Executor
from armcal.report.page import page
from armcal.report.run_document import plugin_sections, run_document
from armcal.run import experiment
from armcal.run import result as results
from armcal.run.pipeline import calibrate
from armcal.run.result import RunResult


@dataclass(frozen=True)
class Run:
    """A finished calibration run."""

    experiment: experiment.Experiment  # what was run
    result: RunResult  # everything that it knows

    @property
    def converged(self) -> bool:
        """Whether the solver came to an end."""
        return self.result.estimate.verdict.converged

    @property
    def estimate(self) -> Estimate:
        """Values, covariance, residuals, and what the data could not determine."""
        return self.result.estimate

    @property
    def verdict(self) -> Verdict:
        """What to conclude: one finding a test that was made."""
        return self.result.verdict

    @property
    def metrics(self) -> dict[str, Any]:
        """The numbers of metrics.json; errors in mm, by model and records: ``metrics["error_mm"]["calibrated"]``.

        Where nothing measured is a length they are ``metrics["error_mrad"]``.
        """
        return results.metrics(self.result)

    @property
    def calibration(self) -> Calibration:
        """The calibrated arm, as calibration.yaml would give it.

        Raises:
            NotConvergedError: the solver did not converge, so nothing is calibrated.
        """
        if not self.converged:
            text = f"{self.estimate.verdict.name} did not converge ({self.estimate.verdict.status})."
            raise NotConvergedError(text, hint=CHECK_THE_DATA)
        text = sealed(results.calibration_content(self.result, self.experiment))
        return results.read_back(text, self.experiment.registry)

    def write(self, folder: str | Path, accept: bool = False) -> Path:
        """Write what ``armcal run`` writes: calibration.yaml, report.html, metrics.json and the rest.

        ``accept`` writes calibration.yaml although the verdict is bad, as ``--accept`` does.

        Raises:
            InputError: the folder holds other things, or cannot be written.
        """
        document = run_document(self.result, plugin_sections(self.result, self.experiment.registry)[0])
        with results.reserved(Path(folder)) as held:
            results.write(held, self.result, self.experiment, page(document), accept)
        return Path(folder)


@dataclass(frozen=True)
class Experiment(experiment.Experiment):
    """A configuration made of real components, ready to run."""

    def run(self, executor: Executor | None = None) -> Run:
        """Load the data, check, fit, validate; starts and folds by ``executor``.

        Raises:
            InputError: configuration or data are refused before solving.
        """
        return Run(self, calibrate(self, executor=executor))
