"""How a calibration's residuals scatter: all that the model leaves unexplained, and how much of it neighbours share.

A model that is wrong errs by more than its instrument, and alike in poses that follow one another. Whoever goes on from
the calibration needs both: the covariance as the noise to expect, and its shared part as no new evidence each time.
The shared part is a process whose correlation falls by e over a distance, beside an independent part: the first two
serial correlations tell share and distance [Box2015].
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.solve.estimator import Estimate
from armcal.solve.factor_records import correlation_of
from armcal.solve.problem import FactorRecords, Problem

_FEWEST = 20
_TOLD_SD = 3.0
_LONGEST = 50.0


@dataclass(frozen=True)
class Scatter:
    """Of one measurement.

    Attributes:
        covariance: of the raw residual (n_r x n_r; m or rad).
        share: of it that neighbours have in common, 0 to 1.
        over: distance over which the common part falls by e.
        channel: what counts it: ``sequence`` where the records say their place, else ``record``, one by one.
    """

    covariance: Array
    share: float
    over: float
    channel: str = "record"


def scatter_of(
    problem: Problem, estimate: Estimate, records: Sequence[FactorRecords], dataset: Dataset
) -> dict[str, Scatter]:
    """The scatter of the residuals that an estimate leaves, by measurement.

    Where parameters drift, what neighbours share is the drift: what is left is the declared noise, scaled to the
    residuals.

    Args:
        problem: that was solved.
        estimate: of it.
        records: it was trained on, with their weights.
        dataset: the same ones, in the order of recording or with their ``sequence``.
    """
    if correlation_of(records) is not None:
        noise = {k.factor.name: np.array(k.factor.noise) * estimate.noise_scale for k in problem.kernels}
        return {name: Scatter(np.diag(deviations**2), 0.0, 1.0) for name, deviations in noise.items()}
    # Parameters that were fitted make residuals too small.
    freedom = estimate.degrees_of_freedom / max(problem.equations(records), 1)
    found, residuals = {}, problem.residuals(estimate.values, records)
    for kernel, each, residual in zip(problem.kernels, records, residuals, strict=True):
        weight = np.minimum(each.weight[: each.count], 1.0) * each.measured
        kept = np.flatnonzero(weight > 0)
        if len(kept) < 2:
            continue
        roots = residual[:, kept] * np.sqrt(weight[kept])
        covariance = roots @ roots.T / max(float(weight.sum()) * freedom, 1e-9)
        whitened = _whitened(covariance, residual[:, kept])
        share, over = _shared(whitened, _places(dataset)[kept])
        found[kernel.factor.name] = Scatter(
            covariance, share, over, "sequence" if dataset.has("sequence") else "record"
        )
    return found


def _places(dataset: Dataset) -> Array:
    return dataset.column("sequence") if dataset.has("sequence") else np.arange(len(dataset), dtype=float)


def _whitened(covariance: Array, residual: Array) -> Array:
    size, directions = np.linalg.eigh(covariance)
    inverse = np.where(size > 1e-12 * size[-1], 1 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
    return np.asarray((directions * inverse).T @ residual)


def _shared(whitened: Array, places: Array) -> tuple[float, float]:
    """Share and distance; none where chance may have made the correlation."""
    order = np.argsort(places, kind="stable")
    series, count = whitened[:, order], whitened.shape[1]
    if count < _FEWEST:
        return 0.0, 1.0
    total = float(np.sum(series**2)) / count
    first, second = (float(np.sum(series[:, lag:] * series[:, :-lag])) / (count - lag) / total for lag in (1, 2))
    spacing = float(np.median(np.diff(places[order]))) or 1.0
    if first < _TOLD_SD / np.sqrt(count * len(series)):
        return 0.0, 1.0
    decay = float(np.clip(second / first, np.exp(-1.0), np.exp(-1.0 / _LONGEST)))
    return float(np.clip(first / decay, 0.0, 0.95)), float(-spacing / np.log(decay))
