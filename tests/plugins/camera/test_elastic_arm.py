"""A camera on an arm that gives under gravity: what loads do to few of its points is what they do to all."""

from __future__ import annotations

from pathlib import Path

import armcal
import numpy as np
from armcal.problem.variants import FEW_POINTS, Motion, with_few_points
from armcal.run.pipeline import Stopwatch, assemble

CONFIG = Path(__file__).parents[3] / "configs" / "so101" / "camera.yaml"


def test_slopes_by_loads_of_few_points_are_those_of_all() -> None:
    experiment = armcal.Experiment.load(CONFIG, ["arms.arm.effects.spring.compliance_rad_per_Nm=0.05"])
    ready = assemble(experiment, Stopwatch())
    problem = ready.training
    few = with_few_points(problem)
    values, dataset = problem.parameters.nominal(), ready.dataset.subset(ready.split.train)
    of_all, of_few = (Motion.of(p, values, dataset) for p in (problem, few))
    whole, part = problem.kernels[0].factor, few.kernels[0].factor
    assert whole.rows > part.rows == 2 * FEW_POINTS
    rows = [whole.output_channels.index(channel) for channel in part.output_channels]
    (every,), (some,) = of_all.by_load, of_few.by_load
    np.testing.assert_allclose(some, every[rows], atol=1e-12)
    assert np.abs(some).max() > 1e-3
