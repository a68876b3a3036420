"""How a calibration's residuals scatter: all that the model leaves unexplained, and how much of it neighbours share.

A model that is wrong errs by more than its instrument, and alike in poses that follow one another. Whoever goes on from
the calibration needs both: the covariance as the noise to expect, and its shared part as no new evidence each time.
The shared part is a process whose correlation falls by e over a distance, beside an independent part: the first two
serial correlations determine share and distance [Box2015].

A few residuals do not determine a covariance of many rows: it is taken together with the declared noise, scaled to the
residuals, as the mean of an inverse Wishart distribution whose weight is the likeliest for these residuals [Chen1979].
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import multigammaln

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.estimate.estimator import SMALLEST_SPREAD, Estimate
from armcal.problem.problem import Problem

_FEWEST = 20
_SIGNIFICANT_SD = 3.0
_LONGEST = 50.0
_WEIGHTS = np.geomspace(1.0, 1e5, 51)  # Of the declared noise, in records: those that are tried


@dataclass(frozen=True)
class ResidualSpread:
    """Of one measurement.

    Attributes:
        channel: what counts it: ``sequence`` where the records say their place, else ``record``, one by one.
    """

    covariance: Array  # of the raw residual (n_r x n_r; m or rad)
    share: float  # of it that neighbours have in common, 0 to 1
    over: float  # distance over which the common part falls by e
    channel: str = "record"
    freedom: float = math.inf  # degrees of freedom with which the covariance is known


def residual_spread(problem: Problem, estimate: Estimate, dataset: Dataset) -> dict[str, ResidualSpread]:
    """The scatter of the residuals that an estimate leaves, by measurement.

    Where parameters drift, what neighbours share is the drift: what is left is the declared noise, scaled to the
    residuals.

    Args:
        problem: that was solved.
        estimate: of it.
        records: it was trained on, with their weights.
        dataset: the same ones, in the order of recording or with their ``sequence``.
    """
    known = max(float(estimate.degrees_of_freedom), 1.0)
    if problem.correlation is not None:
        noise = {k.factor.name: np.array(k.factor.noise) * estimate.noise_scale for k in problem.kernels}
        return {name: ResidualSpread(np.diag(sd**2), 0.0, 1.0, freedom=known) for name, sd in noise.items()}
    # Parameters that were fitted make residuals too small.
    freedom = known / max(problem.equations(), 1)
    channel = "sequence" if dataset.has("sequence") else "record"
    places = dataset.column("sequence") if dataset.has("sequence") else np.arange(len(dataset), dtype=float)
    residual_spreads, residuals = {}, problem.residuals(estimate.values)
    for kernel, record, residual in zip(problem.kernels, problem.records, residuals, strict=True):
        weight = np.minimum(record.weight[: record.count], 1.0) * record.measured
        kept = np.flatnonzero(weight > 0)
        if len(kept) < 2:
            continue
        roots = residual[:, kept] * np.sqrt(weight[kept])
        count = float(weight.sum()) * freedom
        covariance, weighed = _shrunk(roots @ roots.T, count, np.array(kernel.factor.noise), estimate.noise_scale)
        size, directions = np.linalg.eigh(covariance)
        inverse = np.where(size > 1e-12 * size[-1], 1 / np.sqrt(np.maximum(size, 1e-300)), 0.0)
        share, over = _shared((directions * inverse).T @ residual[:, kept], places[kept])
        spread = ResidualSpread(covariance, share, over, channel, min(weighed, known))
        residual_spreads[kernel.factor.name] = spread
    return residual_spreads


def _shrunk(products: Array, count: float, noise: Array, scale: float) -> tuple[Array, float]:
    """The covariance of residuals (n_r x n_r), and the records that it is worth, those of the declared noise included.

    Args:
        products: sum of the residuals' outer products (n_r x n_r; m or rad).
        count: how many records they are worth, less what parameters took of them.
        noise: standard deviations that are declared (n_r; m or rad).
        scale: of all residuals against theirs; holds where this measurement's own are too few to say.
    """
    rows, own = len(noise), float(np.sum(np.diag(products) / noise**2))
    variance = own / (rows * count) if rows * count >= 1 else scale**2
    declared = noise * np.sqrt(max(variance, SMALLEST_SPREAD**2))
    sizes = np.maximum(np.linalg.eigvalsh(products / np.outer(declared, declared)), 0.0)
    prior = _WEIGHTS + rows + 1
    evidence = multigammaln(0.5 * (prior + count), rows) - multigammaln(0.5 * prior, rows)
    evidence += 0.5 * prior * rows * np.log(_WEIGHTS)
    evidence -= 0.5 * (prior + count) * np.log(_WEIGHTS[:, None] + sizes).sum(axis=1)
    weight = float(_WEIGHTS[int(np.argmax(evidence))])
    covariance = (weight * np.diag(declared**2) + products) / (weight + count)
    return covariance, min(weight + count, max(rows * count, 1.0))


def _shared(whitened: Array, places: Array) -> tuple[float, float]:
    """Share and distance; none where chance may have made the correlation."""
    order = np.argsort(places, kind="stable")
    series, count = whitened[:, order], whitened.shape[1]
    if count < _FEWEST:
        return 0.0, 1.0
    total = float(np.sum(series**2)) / count
    first, second = (float(np.sum(series[:, lag:] * series[:, :-lag])) / (count - lag) / total for lag in (1, 2))
    spacing = float(np.median(np.diff(places[order]))) or 1.0
    if first < _SIGNIFICANT_SD / np.sqrt(count * len(series)):
        return 0.0, 1.0
    decay = float(np.clip(second / first, np.exp(-1.0), np.exp(-1.0 / _LONGEST)))
    return float(np.clip(first / decay, 0.0, 0.95)), float(-spacing / np.log(decay))
