"""The end of a new robot's files: a calibration on simulated records, whose truth is known."""

import math
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from armcal.estimate.estimator import Progress, no_progress
from armcal.plugins import PluginRegistry
from armcal.report import plugin_sections, render
from armcal.run import outputs
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, calibrate
from armcal.run.result import RunResult
from armcal.scaffold.robot_files import SIMULATED, RobotFolder

RESULTS = "runs/simulated"
MOST_ERROR = 1.5
"""Times what the noise alone makes: a calibration that misses held-out tips by more has not found the arm."""
_MEAN_LENGTH = math.sqrt(8 / math.pi)
"""Of three independent normal numbers of unit variance."""


@dataclass(frozen=True)
class Trial:
    """How the calibration went: tip errors on held-out records (mm), and what the noise alone would make."""

    result: RunResult
    results: Path
    nominal_mm: float
    calibrated_mm: float
    noise_mm: float

    @property
    def fault(self) -> str:
        """What is wrong; empty if the files work."""
        verdict = self.result.estimate.verdict
        bad = [finding.text for finding in self.result.verdict.findings if finding.grade == "bad"]
        if not verdict.converged:
            return f"{verdict.name} did not converge ({verdict.status})"
        if bad:
            return bad[0]
        if not self.calibrated_mm <= MOST_ERROR * self.noise_mm:
            return (
                f"the error at held-out tips is {self.calibrated_mm:.3f} mm, and the noise alone makes "
                f"{self.noise_mm:.3f} mm"
            )
        return ""


def try_out(made: RobotFolder, registry: PluginRegistry, command: str = "", progress: Progress = no_progress) -> Trial:
    """Calibrate on the simulated records, as ``armcal run`` does.

    Raises:
        InputError: the data or the configuration is refused.
    """
    watch, folder = Stopwatch(), made.folder / RESULTS
    experiment = Experiment.load(made.folder / SIMULATED, registry=registry)
    result = calibrate(experiment, command, progress, watch)
    result.seconds["total"] = watch.total()
    sections = plugin_sections(result, registry)
    outputs.write(result, experiment, folder, partial(render, sections=sections))
    table = result.table
    held = (table.nominal["holdout"].mean, table.calibrated["holdout"].mean)
    nominal, calibrated = (math.nan if error is None else error for error in held)
    return Trial(result, folder, nominal, calibrated, made.noise_mm * _MEAN_LENGTH)
