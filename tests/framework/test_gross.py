"""The calibrated arm beside the nominal one: how large it is, and whether its tips were measured at all."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.cli.main import cli
from armcal.diagnose.fit import Prepared
from armcal.diagnose.gross import Figure, computed, figure
from armcal.diagnose.gross import size as size_of
from armcal.estimate.estimator import Estimate
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble, calibrate
from click.testing import CliRunner
from fits import fit_that_found

CONFIGS = Path(__file__).resolve().parents[2] / "configs"
CONFIG = CONFIGS / "so101" / "ruler.yaml"
FREE = 'parameters.free=["arm.zeros.offset3", "arm.mdh.d[1-5]", "arm.mdh.a[1-5]"]'


@pytest.fixture(scope="module")
def ready() -> Prepared:
    settings = (FREE, "parameters.priors=null", "validation.folds=0", "evaluator=interpreted")
    return assemble(Experiment.load(CONFIG, settings), Stopwatch())


def size(ready: Prepared, zero_rad: float, factor: float) -> float:
    """Of an arm whose elbow has another zero, and whose lengths are so many times the nominal ones."""
    parameters = ready.problem.parameters
    values = parameters.nominal()
    for block in parameters.free:
        own = parameters.entries_of(block.name)
        values[own] = values[own] * factor if block.unit == "m" else zero_rad
    known = SimpleNamespace(values=values, covariance=np.zeros((len(parameters.free_entries),) * 2))
    known.verdict = SimpleNamespace(converged=True)
    fit = fit_that_found(cast(Estimate, known), {}, ready)
    own = fit.of(figure)
    assert bool(size_of(fit)) == (factor != 1.0)
    return own.size


def test_lengths_make_a_size_and_the_zero_of_a_joint_does_not(ready: Prepared) -> None:
    """A horn two teeth off: the tip goes elsewhere at the same commands, and reaches further or less far."""
    assert size(ready, 0.5, 1.0) == pytest.approx(1.0)
    assert size(ready, 0.5, 1.1) == pytest.approx(1.1, abs=0.01)
    assert size(ready, 0.0, 1.1) == pytest.approx(1.1, abs=0.01)


@pytest.mark.parametrize(
    ("nominal_mm", "judged_mm", "grade", "words"),
    [
        (1e-4, 2e-4, "bad", "follow the nominal arm to 0.0001 mm"),
        (1.5, 0.003, "warning", "follow the calibrated arm to 0.003 mm"),
        (1.5, 0.02, "", ""),
        (1.5, np.nan, "", ""),
    ],
)
def test_tips_that_are_computed_from_the_joints_are_named(
    nominal_mm: float, judged_mm: float, grade: str, words: str
) -> None:
    """As the controller reports them: by the nominal arm, or by the arm that its maker calibrated. Reach 1 m."""
    own = Figure(1000.0, 1.0, 0.0, 0.0, ())
    factor = SimpleNamespace(position_channels=("tracker.x",))
    problem = SimpleNamespace(kernels=(SimpleNamespace(factor=factor),))
    ready = Prepared(None, Dataset(("1",), {"tracker.x": np.zeros(1)}), problem, None, None)
    errors = SimpleNamespace(nominal_mm=np.full(20, nominal_mm))
    known = {"errors": errors, "judged_mm": np.append(np.full(9, judged_mm), np.nan), "unit": "mm"}
    estimate = SimpleNamespace(verdict=SimpleNamespace(converged=True))
    findings = computed(fit_that_found(estimate, {figure: own}, ready, **known))
    assert [finding.grade for finding in findings] == [grade] * bool(grade)
    assert all(words in finding.text for finding in findings)


def test_contacts_that_agree_to_a_micrometre_are_no_tips_that_were_computed(tmp_path: Path) -> None:
    config, path = CONFIGS / "ball" / "demo.yaml", tmp_path / "data.csv"
    exact = ("arms.arm.joint_noise_mrad=0.001", "measurements.sockets.noise_mm=0.001", "evaluator=interpreted")
    flags = [word for text in exact for word in ("--set", text)]
    made = CliRunner().invoke(cli, ["simulate", str(config), *flags, "--out", str(path)])
    assert made.exit_code == 0, made.output
    verdict = calibrate(Experiment.load(config, exact, path)).verdict
    assert not any("computed from the joints" in finding.text for finding in verdict.findings)
