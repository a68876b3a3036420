"""How far measurements may lie from predictions, and how residuals scatter.

The residual of a record that took no part in a fit has the covariance s^2 N + H C H' + s^2 D. N is the noise declared
of it, s the noise found in units of the declared one, C the covariance of the values and H the slope of its residual
by them. D is what a drift does: in another recording than the fit's, where nothing is known of it, its full variance;
in the same one G K G', with the slope G of the residual by the drift's states there and their covariance K after the
training records. The drift that those determine depends on the values as well: H has what they make of the drift taken
off. (Gaussian processes with explicit basis functions, [Rasmussen2006].)

A model that is wrong errs by more than its instrument, and alike in poses that follow one another. Whoever goes on from
the calibration needs both: the covariance as the noise to expect, and its shared part as no new evidence each time.
The shared part is a process whose correlation falls by e over a distance, beside an independent part: the first two
serial correlations determine share and distance [Box2015]. A few residuals do not determine a covariance of many rows:
it is taken together with the declared noise, scaled to the residuals, as the mean of an inverse Wishart distribution
whose weight is the likeliest for these residuals [Chen1979].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import fdtri, multigammaln, stdtrit

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.estimate.estimator import SMALLEST_SPREAD, Estimate
from armcal.estimate.validation import Recording, error_dimension
from armcal.problem.kernel import Kernel
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.records import noise_roots
from armcal.problem.variants import unexplained

LEVELS = (0.5, 0.9, 0.95)  # Of the intervals that are stated and judged
STATED = 0.9  # The level of a plus-minus
RADIUS_LEVEL = 0.95
POSITION, TURN = range(3), range(3, 6)  # Rows of the residual of a position, and of a pose
_LEAST_LEFT = 1e-3
"""Of the information on a direction that a record alone gives: without it next to nothing would be known."""
_MOST_COMPARED = 2000  # Records of which all pairs are compared; the degrees of freedom of more grow in proportion
_Parts = tuple[Array, Array, Array]


@dataclass(frozen=True)
class Spread:
    covariance: Array  # of each record's residual (N x n_r x n_r; m^2 or rad^2)
    freedom: float  # degrees of freedom of the noise found

    def of(self, rows: range) -> Spread:
        return replace(self, covariance=self.covariance[:, rows.start : rows.stop, rows.start : rows.stop])

    @cached_property
    def deviations(self) -> Array:
        return np.asarray(np.sqrt(np.einsum("nrr->rn", self.covariance)))

    def half_widths(self, level: float) -> Array:
        return self.deviations * quantile(level, self.freedom)

    def radius(self, level: float = RADIUS_LEVEL) -> Array:
        """The radius (N) that covers the length of a whole residual with this probability.

        The squared length is a sum of chi-squares, one an eigenvalue of the covariance. It is taken for a multiple of
        one chi-square of the same mean and variance, of (tr C)^2 / tr C^2 degrees of freedom [Satterthwaite1946], and
        so for an F because the noise is estimated. At 95 % of three dimensions it covers 94.9 to 95.2 %.
        """
        trace = np.einsum("nrr->n", self.covariance)
        dimensions = trace**2 / np.einsum("nrs,nsr->n", self.covariance, self.covariance)
        return np.asarray(np.sqrt(trace * fdtri(dimensions, max(self.freedom, 1), level)))


def quantile(level: float, freedom: float | Array) -> Array:
    """Of Student's t: the half width of a two-sided interval, in standard deviations."""
    return np.asarray(stdtrit(np.maximum(freedom, 1), 0.5 + level / 2))


@dataclass(frozen=True)
class KnownDrift:
    states: Array  # the most likely ones (n_k x n_s x 1)
    slopes: Array  # of the states by the values found (n_k x n_s x n_v)
    covariance: Array  # of the states at each node (n_k x n_s x n_s)

    @classmethod
    def by(cls, problem: Problem, values: Array) -> KnownDrift | None:
        shared = problem.correlation
        if shared is None:
            return None
        jacobians = [np.moveaxis(jacobian, 1, 2) for jacobian in problem.jacobians(values)]
        states = shared.states([r[:, :, None] for r in problem.weighted_residuals(values)])
        return cls(states, shared.states(jacobians), shared.covariance)


@dataclass(frozen=True)
class NewRecording:
    ratio: Array  # typical error in a new recording over that of each judged record (n)
    freedom: float  # degrees of freedom of the errors' mean square, as their records share a drift
    independent: float  # the same, if the records were independent


@dataclass(frozen=True)
class Predictor:
    values: Array  # found (all canonical entries)
    covariance: Array  # of the free canonical entries
    noise_scale: float  # residuals in units of the declared noise
    freedom: float  # degrees of freedom of that
    drift: KnownDrift | None = None  # as the records of the fit determine it; None where nothing drifts

    def residuals(self, problem: Problem) -> tuple[Array, ...]:
        """Raw residuals less the known drift, one (n_r x N) a factor; records on the chain of those of the fit."""
        raw, here = problem.residuals(self.values), problem.correlation
        return raw if here is None or self.drift is None else here.taken_off(raw, self.drift.states)

    def spreads(self, problem: Problem, recording: Recording) -> tuple[Spread, ...]:
        """With the drift of the ``same`` recording (records on the chain of its fit), or of a ``new`` one."""
        parts = self._parts(problem, recording)
        return tuple(Spread(noise + values + drift, self.freedom) for noise, values, drift in parts)

    def left_out(
        self, fitted: Problem, recording: Recording, unknown: Sequence[Array] | None = None
    ) -> tuple[Spread, ...]:
        """As ``spreads`` of the fit's own records, each as if the fit had done without it.

        For a new recording as if each record were evidence of the values alone, though neighbours share their drift: a
        little too narrow. ``unknown`` is what pose residuals that did not see them do not know (see ``unexplained``).
        """
        spreads = []
        parts = zip(fitted.records, self._parts(fitted, recording, unknown), strict=True)
        for record, (noise, values, drift) in parts:
            own = (noise, values + drift) if recording == "same" else (noise + drift, values)
            spreads.append(Spread(_without_itself(*own, record), self.freedom))
        return tuple(spreads)

    def new_recording(self, problem: Problem, judged: Indices) -> NewRecording | None:
        """What the errors of judged records, held out of this recording, say of a new one.

        None where nothing drifts, or no record is judged.

        A fit takes up part of this recording's drift, which moves its held-out records as well: their errors lack
        that part, and in a new recording it is an error. For residuals of slopes J and the covariance S, of which D
        is the drift's, what both have in common is J C J' S^-1 D, with C the covariance of the values.
        """
        here, there = problem.correlation, self.drift
        if here is None or there is None or not len(judged):
            return None
        counted, whole, common = error_dimension(problem), 0.0, 0.0
        noises: list[Array] = []
        roots: list[Array] = []
        parts = zip(problem.kernels, self._slopes(problem), self._parts(problem, "new"), strict=True)
        for i, (kernel, slope, (noise, values, drift)) in enumerate(parts):
            rows = np.flatnonzero([dimension == counted for dimension in kernel.factor.dimensions])
            taken_up = np.moveaxis(here.shift(i, there.slopes)[:, : slope.shape[2]], 1, 2)
            whole = whole + np.einsum("nrr->n", (noise + values + drift)[:, rows][:, :, rows])
            common = common + np.einsum("rvn,vw,rwn->n", slope[rows], self.covariance, taken_up[rows], optimize=True)
            noises.append(noise[:, rows][:, :, rows])
            roots.append(self.noise_scale * np.moveaxis(here.raw[i][rows], 0, 1)[: len(noise)])
        ratio = np.sqrt(whole / np.maximum(whole - 2 * common, _LEAST_LEFT * whole))
        near = judged[np.argsort(here.node[judged], kind="stable")][:_MOST_COMPARED]
        own = [noise[near] for noise in noises], [root[near] for root in roots]
        freedom, independent = _degrees_of_freedom(*own, here.kernels(near))
        part = len(judged) / len(near)
        return NewRecording(ratio[judged], part * freedom, part * independent)

    def _parts(self, problem: Problem, recording: Recording, unknown: Sequence[Array] | None = None) -> list[_Parts]:
        """Covariances by noise, by values and by drift (N x n_r x n_r each), one of each a factor.

        What pose residuals do not know counts as noise: it is the same whether or not a record was learned from.
        """
        here, there, parts = problem.correlation, self.drift if recording == "same" else None, []
        blocks, variance = problem.parameters.free, self.noise_scale**2
        drifting = np.array([0.0 if b.drift is None else b.drift.sd**2 for b in blocks for _ in range(b.size)])
        unknown = unexplained(problem, self.values) if unknown is None else unknown
        rows = zip(problem.kernels, problem.records, self._slopes(problem), unknown, strict=True)
        for i, (kernel, record, slope, own) in enumerate(rows):
            if here is None or there is None:
                drift = np.einsum("rvn,v,svn->nrs", slope, variance * drifting, slope, optimize=True)
            else:  # the records of the fit determine it
                by_state, left = here.raw[i][:, : record.count], there.covariance[here.node[: record.count]]
                drift = variance * np.einsum("rnd,nde,sne->nrs", by_state, left, by_state, optimize=True)
                slope = slope - np.moveaxis(here.shift(i, there.slopes)[:, : record.count], 1, 2)
            values = np.einsum("rvn,vw,swn->nrs", slope, self.covariance, slope, optimize=True)
            roots = noise_roots(kernel.factor, record)
            parts.append((variance * (roots @ roots.transpose(0, 2, 1)) + own, values, drift))
        return parts

    def _slopes(self, problem: Problem) -> list[Array]:
        """Residuals by free canonical entries, raw, one (n_r x n_v x N) a factor."""
        bare = problem.with_records([replace(record, whitening=None) for record in problem.records]).unweighted()
        pairs = zip(problem.kernels, bare.jacobians(self.values), strict=True)
        return [jacobian * np.array(kernel.factor.noise)[:, None, None] for kernel, jacobian in pairs]


def is_position(kernel: Kernel) -> bool:
    return bool(kernel.factor.position_channels) and kernel.factor.rows in (len(POSITION), 2 * len(POSITION))


def _without_itself(noise: Array, known: Array, factor_records: FactorRecords) -> Array:
    """Covariance of each record's residual (N x n_r x n_r) had the fit not had the record.

    ``known`` is that of what the fit predicts; of its information the record's own, its weight times the inverse of its
    noise, is taken away again.
    """
    root = np.linalg.cholesky(noise)
    inverse = np.linalg.inv(root)
    sizes, axes = np.linalg.eigh(inverse @ known @ inverse.transpose(0, 2, 1))
    left = np.maximum(1.0 - factor_records.weight[: factor_records.count, None] * sizes, _LEAST_LEFT)
    turned = root @ axes
    return np.asarray(noise + np.einsum("nrk,nk,nsk->nrs", turned, sizes / left, turned))


def _degrees_of_freedom(
    noises: Sequence[Array], roots: Sequence[Array], kernels: Sequence[Array]
) -> tuple[float, float]:
    """Of the mean square of all rows, as records are correlated and if they were independent.

    Those of the chi-square with its mean and variance, tr(C)^2 / tr(C^2) [Satterthwaite1946]. ``noises`` are
    covariances of each measurement's rows that no other record shares (N x n_r x n_r), ``roots`` the same rows by the
    drifts (N x n_r x n_s), ``kernels`` the correlation of each drift between the records (N x N).
    """
    across = np.sum([np.einsum("nrs,nrt->nst", own, own) for own in roots], axis=0)
    trace = sum(float(np.einsum("nrr->", noise)) for noise in noises) + float(np.einsum("nss->", across))
    alone = sum(
        float(np.sum(noise**2) + 2 * np.einsum("nrq,nrs,nqs->", noise, own, own, optimize=True))
        for noise, own in zip(noises, roots, strict=True)
    )
    independent = alone + float(np.einsum("nst,nst->", across, across))
    shared = alone + sum(
        float(across[:, s, t] @ (one * other) @ across[:, s, t])
        for s, one in enumerate(kernels)
        for t, other in enumerate(kernels)
    )
    return trace**2 / shared, trace**2 / independent


_FEWEST = 20
_SIGNIFICANT_SD = 3.0
_LONGEST = 50.0
_WEIGHTS = np.geomspace(1.0, 1e5, 51)  # Of the declared noise, in records: those that are tried


@dataclass(frozen=True)
class ResidualSpread:
    covariance: Array  # of the raw residual of one measurement (n_r x n_r; m or rad)
    share: float  # of it that neighbours have in common, 0 to 1
    over: float  # distance over which the common part falls by e
    channel: str = "record"  # what counts that: ``sequence`` where the records say their place, else one by one
    freedom: float = math.inf  # degrees of freedom with which the covariance is known


def residual_spread(problem: Problem, estimate: Estimate, dataset: Dataset) -> dict[str, ResidualSpread]:
    """The scatter of the residuals that an estimate of a problem leaves, by measurement.

    Where parameters drift, what neighbours share is the drift: what is left is the declared noise, scaled to the
    residuals. ``dataset`` has the records in the order of recording or with their ``sequence``.
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

    ``products`` is the sum of the residuals' outer products, ``count`` how many records they are worth less what
    parameters took of them, ``noise`` the declared standard deviations; ``scale``, of all residuals against theirs,
    holds where this measurement's own are too few to say.
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
