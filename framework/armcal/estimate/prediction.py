"""How far a measurement may lie from its prediction: by noise, by parameters not known exactly, by a drift not known.

The residual of a record that took no part in a fit has the covariance s^2 N + H C H' + s^2 D. N is the noise declared
of it, s the noise found in units of the declared one, C the covariance of the values and H the slope of its residual
by them. D is what a drift does: in another recording than the fit's, where nothing is known of it, its full variance;
in the same one G K G', with the slope G of the residual by the drift's states there and their covariance K after the
training records. The drift that those determine depends on the values as well: H has what they make of the drift taken
off. (Gaussian processes with explicit basis functions, [Rasmussen2006].)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.special import fdtri, stdtrit

from armcal.base.arrays import Array, Indices
from armcal.estimate.validation import Recording, error_dimension
from armcal.problem.corrected import unexplained
from armcal.problem.factor_records import correlation_of, noise_roots
from armcal.problem.kernel import Kernel
from armcal.problem.problem import FactorRecords, Problem

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
    """How residuals of one factor are expected to vary."""

    covariance: Array  # of each record's residual (N x n_r x n_r; m^2 or rad^2)
    freedom: float  # degrees of freedom of the noise found

    def of(self, rows: range) -> Spread:
        return replace(self, covariance=self.covariance[:, rows.start : rows.stop, rows.start : rows.stop])

    @cached_property
    def deviations(self) -> Array:
        """Standard deviation of each residual number (n_r x N)."""
        return np.asarray(np.sqrt(np.einsum("nrr->rn", self.covariance)))

    def half_widths(self, level: float) -> Array:
        """Half the width of the interval that covers a residual number with this probability (n_r x N)."""
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
    """A drift as the records of a fit determine it."""

    states: Array  # the most likely ones (n_k x n_s x 1)
    slopes: Array  # of the states by the values found (n_k x n_s x n_v)
    covariance: Array  # of the states at each node (n_k x n_s x n_s)

    @classmethod
    def by(cls, problem: Problem, values: Array) -> KnownDrift | None:
        """From the records of a fit at the values found; None where nothing drifts."""
        shared = problem.correlation
        if shared is None:
            return None
        jacobians = [np.moveaxis(jacobian, 1, 2) for jacobian in problem.jacobians(values)]
        states = shared.states([r[:, :, None] for r in problem.weighted_residuals(values)])
        return cls(states, shared.states(jacobians), shared.covariance)


@dataclass(frozen=True)
class NewRecording:
    """What the errors of one recording say of another one, where something drifts."""

    ratio: Array  # typical error in a new recording over that of each judged record (n)
    freedom: float  # degrees of freedom of the errors' mean square, as their records share a drift
    independent: float  # the same, if the records were independent


@dataclass(frozen=True)
class Predictor:
    """A fit as far as its predictions need it."""

    problem: Problem  # of the fit, or one for other records with the same free parameters
    values: Array  # found (all canonical entries)
    covariance: Array  # of the free canonical entries
    noise_scale: float  # residuals in units of the declared noise
    freedom: float  # degrees of freedom of that
    drift: KnownDrift | None = None  # as the records of the fit determine it; None where nothing drifts

    @property
    def drifts(self) -> bool:
        return any(block.drift is not None for block in self.problem.parameters.free)

    def residuals(self, records: Sequence[FactorRecords]) -> tuple[Array, ...]:
        """Raw residuals less the known drift, one (n_r x N) a factor; records on the chain of those of the fit."""
        raw, here = self.problem.with_records(records).residuals(self.values), correlation_of(records)
        return raw if here is None or self.drift is None else here.taken_off(raw, self.drift.states)

    def spreads(self, records: Sequence[FactorRecords], recording: Recording) -> tuple[Spread, ...]:
        """Spread about predictions, one a factor: with the drift of the ``same`` recording, without in a ``new`` one.

        In the same recording the records must be on the chain of those of the fit.
        """
        parts = self._parts(records, recording)
        return tuple(Spread(noise + values + drift, self.freedom) for noise, values, drift in parts)

    def left_out(
        self, fitted: Sequence[FactorRecords], recording: Recording, unknown: Sequence[Array] | None = None
    ) -> tuple[Spread, ...]:
        """As ``spreads`` of the fit's own records, each as if the fit had done without it.

        For a new recording as if each record were evidence of the values alone, though neighbours share their drift: a
        little too narrow. ``unknown`` is what pose residuals that did not see them do not know (see ``unexplained``).
        """
        spreads = []
        for record, (noise, values, drift) in zip(fitted, self._parts(fitted, recording, unknown), strict=True):
            own = (noise, values + drift) if recording == "same" else (noise + drift, values)
            spreads.append(Spread(_without_itself(*own, record), self.freedom))
        return tuple(spreads)

    def new_recording(self, records: Sequence[FactorRecords], judged: Indices) -> NewRecording | None:
        """What the errors of judged records, held out of this recording, say of a new one.

        None where nothing drifts, or no record is judged.

        A fit takes up part of this recording's drift, which moves its held-out records as well: their errors lack
        that part, and in a new recording it is an error. For residuals of slopes J and the covariance S, of which D
        is the drift's, what both have in common is J C J' S^-1 D, with C the covariance of the values.
        """
        here, there = correlation_of(records), self.drift
        if here is None or there is None or not len(judged):
            return None
        counted, whole, common = error_dimension(self.problem), 0.0, 0.0
        noises: list[Array] = []
        roots: list[Array] = []
        parts = zip(self.problem.kernels, self._slopes(records), self._parts(records, "new"), strict=True)
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

    def _parts(
        self, records: Sequence[FactorRecords], recording: Recording, unknown: Sequence[Array] | None = None
    ) -> list[_Parts]:
        """Covariances by noise, by values and by drift (N x n_r x n_r each), one of each a factor.

        What pose residuals do not know counts as noise: it is the same whether or not a record was learned from.
        """
        here, there, parts = correlation_of(records), self.drift if recording == "same" else None, []
        blocks, variance = self.problem.parameters.free, self.noise_scale**2
        drifting = np.array([0.0 if b.drift is None else b.drift.sd**2 for b in blocks for _ in range(b.size)])
        unknown = unexplained(self.problem.with_records(records), self.values) if unknown is None else unknown
        rows = zip(self.problem.kernels, records, self._slopes(records), unknown, strict=True)
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

    def _slopes(self, records: Sequence[FactorRecords]) -> list[Array]:
        """Residuals by free canonical entries, raw, one (n_r x n_v x N) a factor."""
        bare = self.problem.with_records([replace(record, whitening=None) for record in records]).unweighted()
        pairs = zip(self.problem.kernels, bare.jacobians(self.values), strict=True)
        return [jacobian * np.array(kernel.factor.noise)[:, None, None] for kernel, jacobian in pairs]


def is_position(kernel: Kernel) -> bool:
    return bool(kernel.factor.position_channels) and kernel.factor.rows in (len(POSITION), 2 * len(POSITION))


def _without_itself(noise: Array, known: Array, factor_records: FactorRecords) -> Array:
    """Covariance of each record's residual (N x n_r x n_r) had the fit not had the record.

    ``known`` is that of what the fit predicts, which the record helped to know: of information it added its weight
    times the inverse of its noise, and that is taken away again.
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

    Those of the chi-square with its mean and variance, tr(C)^2 / tr(C^2) [Satterthwaite1946].

    Args:
        noises: covariance of each measurement's rows that no other record shares (N x n_r x n_r).
        roots: the same rows by the drifts (N x n_r x n_s).
        kernels: correlation of each drift between the records (N x N).
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
