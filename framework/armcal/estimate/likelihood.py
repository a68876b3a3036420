"""Restricted likelihood of variance components in a linear model whose residuals are correlated within records only.

Targets y = J d + e, cov(e_i) = S_i = sum_c theta_c V_ci, and a Gaussian prior on d. With D = S^-1 and
P = D - D J (J' D J + prior)^-1 J' D [Patterson1971]:

    log L = -1/2 (log|S| + log|J' D J + prior| + y' P y)
    slope_c = 1/2 (y' P V_c P y - tr P V_c),    average information_cd = 1/2 y' P V_c P V_d P y    [Gilmour1995]
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.estimate.polish import bounded_step
from armcal.problem.problem import NormalEquations

MOST_STEPS = 100
AT_REST = 1e-3
"""A step this many standard deviations long ends the search."""
INSTRUMENT_FLOOR = 1e-4
"""Of the whole variance: an instrument without any noise would make records exact that are not."""
_MOST_HALVINGS = 30


@dataclass(frozen=True)
class Term:
    """Records of one factor: targets (N x n_r), Jacobians (N x n_r x n), bases (components x N x n_r x n_r)."""

    target: Array
    jacobian: Array
    bases: Array


@dataclass(frozen=True)
class LikelihoodMaximum:
    """Thetas, the covariance of their estimate, and the log likelihood there."""

    theta: Array
    covariance: Array
    log_likelihood: float


@dataclass(frozen=True)
class _Local:
    """Log likelihood, its slope and the average information at some thetas."""

    value: float
    slope: Array
    information: Array


def maximise(terms: Sequence[Term], prior: Array, floored: Array) -> LikelihoodMaximum:
    """The thetas of largest restricted likelihood.

    Args:
        terms: with bases of mean variance one.
        prior: information of the prior of each parameter (n).
        floored: which thetas may not fall to zero (components).
    """
    count = len(floored)
    # A parameter with a prior takes nothing away: its part of the target is in the sum of squares.
    freedom = max(1, sum(term.target.size for term in terms) - int(np.count_nonzero(prior == 0)))
    total = _least_squares(terms, prior) / freedom
    lower = np.where(floored, INSTRUMENT_FLOOR * total, 0.0)
    theta = np.full(count, max(total, 1e-300) / count)
    here = _evaluate(terms, prior, theta)
    for _ in range(MOST_STEPS):
        # Towards the maximum of the local model, above the floors.
        size = np.diag(here.information)
        ridge = 1e-9 * np.diag(size) + (1e-12 * float(np.max(size, initial=1e-300))) * np.eye(count)
        model = NormalEquations(0.0, -here.slope, here.information + ridge)
        step = bounded_step(model, lower - theta, np.full(count, np.inf))
        if step is None:
            break
        length = max(float(step @ here.information @ step), 0.0) ** 0.5
        moved = _raised(terms, prior, theta, step, here)
        if moved is None:
            break
        theta, here = moved
        if length < AT_REST:
            break
    scale = np.sqrt(np.maximum(np.diag(here.information), 1e-300))
    covariance = np.linalg.pinv(here.information / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    return LikelihoodMaximum(theta, covariance / np.outer(scale, scale), here.value)


def _raised(
    terms: Sequence[Term], prior: Array, theta: Array, step: Array, here: _Local
) -> tuple[Array, _Local] | None:
    """Along a step as far as the likelihood does not fall; None if it falls everywhere."""
    for halving in range(_MOST_HALVINGS):
        there = theta + step * 0.5**halving
        try:
            local = _evaluate(terms, prior, there)
        except np.linalg.LinAlgError:
            continue
        if local.value >= here.value:
            return there, local
    return None


def _evaluate(terms: Sequence[Term], prior: Array, theta: Array) -> _Local:
    information = np.diag(prior).astype(float)
    pull = np.zeros(len(prior))
    logarithm, weighed = 0.0, []
    for term in terms:
        own = np.einsum("c,cnab->nab", theta, term.bases, optimize=True)
        np.linalg.cholesky(own)  # raises where one is not positive definite
        inverse: Array = np.linalg.inv(own)
        slopes = np.einsum("nab,nbc->nac", inverse, term.jacobian, optimize=True)
        weighed.append((term, inverse, slopes))
        logarithm -= float(np.linalg.slogdet(inverse)[1].sum())
        information += np.einsum("nac,nad->cd", term.jacobian, slopes, optimize=True)
        pull += np.einsum("nac,na->c", slopes, term.target, optimize=True)
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(scale, scale) + 1e-14 * np.eye(len(scale))
    root = np.linalg.cholesky(scaled) if len(scale) else np.zeros((0, 0))
    covariance = np.linalg.inv(scaled) / np.outer(scale, scale) if len(scale) else np.zeros((0, 0))
    logarithm += 2 * float(np.log(np.diag(root) * scale).sum())
    fit = covariance @ pull
    energy, slope = 0.0, np.zeros(len(theta))
    curved, reached = np.zeros((len(theta),) * 2), np.zeros((len(theta), len(prior)))
    for term, inverse, slopes in weighed:
        projected = np.einsum("nab,nb->na", inverse, term.target - term.jacobian @ fit)
        energy += float(np.sum(term.target * projected))
        reduced = inverse - np.einsum("nac,cd,nbd->nab", slopes, covariance, slopes, optimize=True)
        outer = projected[:, :, None] * projected[:, None, :]
        slope += 0.5 * np.einsum("cnab,nab->c", term.bases, outer - reduced, optimize=True)
        u = np.einsum("cnab,nb->cna", term.bases, projected, optimize=True)
        pulled = np.einsum("nab,cnb->cna", inverse, u, optimize=True)
        curved += np.einsum("cna,dna->cd", u, pulled, optimize=True)
        reached += np.einsum("cna,nav->cv", pulled, term.jacobian, optimize=True)
    # The average information: 1/2 u_c' P u_d with u_c = V_c P y.
    return _Local(-0.5 * (logarithm + energy), slope, 0.5 * (curved - reached @ covariance @ reached.T))


def _least_squares(terms: Sequence[Term], prior: Array) -> float:
    rows = [term.jacobian.reshape(-1, len(prior)) for term in terms]
    stacked = np.vstack([*rows, np.diag(np.sqrt(prior))])
    target = np.concatenate([*[term.target.ravel() for term in terms], np.zeros(len(prior))])
    scale = np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
    fit = np.linalg.lstsq(stacked / scale, target, rcond=None)[0]
    return float(np.sum((target - stacked / scale @ fit) ** 2))
