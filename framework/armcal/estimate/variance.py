"""Variance components: how much of the residuals is the instrument's, and how much each joint's.

A record's residual has the covariance sum_c theta_c V_c: one V for each instrument, its declared noise squared, and
one for each joint, d r / d q (d r / d q)', what a joint that does not return to the same angle does at that pose.
The thetas are estimated by restricted maximum likelihood [Patterson1971], which counts what the fitted parameters
took out of the residuals, by average-information steps [Gilmour1995] kept above zero.

With targets y = J d + e, cov(e_i) = S_i = sum_c theta_c V_ci, correlated within records only, a Gaussian prior on d,
D = S^-1 and P = D - D J (J' D J + prior)^-1 J' D [Patterson1971]:

    log L = -1/2 (log|S| + log|J' D J + prior| + y' P y)
    slope_c = 1/2 (y' P V_c P y - tr P V_c),    average information_cd = 1/2 y' P V_c P V_d P y    [Gilmour1995]
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Literal, Self

import numpy as np
from scipy.special import ndtri

from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array
from armcal.base.units import si_unit
from armcal.errors import ProblemError
from armcal.estimate.estimator import CONFIDENCE, degrees_of_freedom
from armcal.estimate.identifiability import correlated_pairs
from armcal.estimate.polish import bounded_step
from armcal.problem.problem import FactorRecords, NormalEquations, Problem
from armcal.problem.records import by_covariance, noise_roots, transformed, whitening_of
from armcal.problem.variants import with_few_points

MOST_STEPS = 100
AT_REST = 1e-3  # A step this many standard deviations long ends the search
INSTRUMENT_FLOOR = 1e-4  # Of the whole variance: an instrument without any noise would make records exact that are not
_MOST_HALVINGS = 30


@dataclass(frozen=True)
class Term:
    """Records of one factor: targets (N x n_r), Jacobians (N x n_r x n), bases (components x N x n_r x n_r)."""

    target: Array
    jacobian: Array
    bases: Array


@dataclass(frozen=True)
class _Local:
    value: float  # log likelihood at some thetas
    slope: Array
    information: Array


def maximise(terms: Sequence[Term], prior: Array, floored: Array) -> tuple[Array, Array]:
    """The thetas of largest restricted likelihood, for bases of mean variance one, and their covariance.

    ``prior`` is the information of the prior of each parameter (n), ``floored`` says which thetas may not fall to zero.
    """
    count = len(floored)
    # A parameter with a prior takes nothing away: its part of the target is in the sum of squares.
    freedom = max(1, sum(term.target.size for term in terms) - int(np.count_nonzero(prior == 0)))
    rows = [term.jacobian.reshape(-1, len(prior)) for term in terms]
    stacked = np.vstack([*rows, np.diag(np.sqrt(prior))])
    target = np.concatenate([*[term.target.ravel() for term in terms], np.zeros(len(prior))])
    scale = np.maximum(np.linalg.norm(stacked, axis=0), 1e-300)
    fit = np.linalg.lstsq(stacked / scale, target, rcond=None)[0]
    total = float(np.sum((target - stacked / scale @ fit) ** 2)) / freedom
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
        for halving in range(_MOST_HALVINGS):  # along the step as far as the likelihood does not fall
            with suppress(np.linalg.LinAlgError):
                there = _evaluate(terms, prior, theta + step * 0.5**halving)
                if there.value >= here.value:
                    break
        else:
            break
        theta, here = theta + step * 0.5**halving, there
        if length < AT_REST:
            break
    scale = np.sqrt(np.maximum(np.diag(here.information), 1e-300))
    covariance = np.linalg.pinv(here.information / np.outer(scale, scale), rcond=1e-10, hermitian=True)
    return theta, covariance / np.outer(scale, scale)


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


Axes = Literal["together", "apart"]

SMALLEST_SHARE = 1e-6
"""Of the declared variance per rad^2 (or m^2) of the joint that moves most: a joint below it moves no residual."""


@dataclass(frozen=True)
class Component:
    name: str  # an instrument (``tracker``), one of its axes (``tracker.x``) or a joint (``arm.q3``)
    kind: Literal["instrument", "joint"]
    unit: str  # of ``sd`` in SI: rad or m for a joint; ``1``, multiples of the declared noise, for an instrument
    sd: float  # standard deviation
    sd_error: float  # its own standard deviation; not a number where it ended at zero
    lower: float  # of the 95 % interval of ``sd``; zero where the data allows it
    upper: float
    share: float  # of the variance of all residuals, 0 to 1
    rms: float  # what it contributes to a residual number (m or rad), root mean square over records


@dataclass(frozen=True)
class VarianceComponents:
    components: tuple[Component, ...]  # in the order of instruments, then joints
    inseparable: tuple[tuple[str, str, float], ...]  # pairs whose estimates correlate beyond 0.95, with the correlation
    unseen: tuple[str, ...]  # joints that move no residual
    rounds: int = 1  # estimates with refits between them

    def share(self, kind: str) -> float:
        return sum(c.share for c in self.components if c.kind == kind)

    @property
    def mostly_joints(self) -> bool:
        return self.share("joint") > 0.5

    def close_to(self, other: Self) -> bool:
        if [c.name for c in self.components] != [c.name for c in other.components]:
            return False
        return all(
            abs(a.sd - b.sd) <= 0.1 * np.nan_to_num(b.sd_error) + 1e-3 * b.sd
            for a, b in zip(self.components, other.components, strict=True)
        )


def estimate_components(
    problem: Problem, values: Array, axes: Axes = "together", of_joints: bool = True
) -> VarianceComponents:
    """Components at a fit, those of instruments alone unless ``of_joints``; left-out records weigh nothing."""
    problem = with_few_points(problem)
    sources = [s for s in _sources(problem, values, axes) if of_joints or s.kind == "instrument"]
    sizes = np.array([_mean_variance(source.bases, problem.records) for source in sources])
    joints = np.array([source.kind == "joint" for source in sources])
    seen = ~joints | (sizes > SMALLEST_SHARE * float(sizes[joints].max(initial=0.0)))
    if problem.correlation is not None:
        raise ProblemError(
            "variance components cannot be estimated beside drifting parameters.",
            hint="Take the drifts away, or set noise.estimate: false.",
        )
    freedom, count = degrees_of_freedom(problem, values), int(seen.sum())
    if freedom <= 2 * count:
        raise ProblemError(
            f"{problem.equations()} equations leave {freedom:.1f} degrees of freedom, too few to estimate "
            f"{count} variance components from.",
            hint="Measure more poses, or set noise.estimate: false.",
        )
    chosen, sizes = [source for source, moves in zip(sources, seen, strict=True) if moves], sizes[seen]
    terms = _terms(problem, values, [source.bases for source in chosen], sizes)
    theta, covariance = maximise(terms, problem.parameters.prior_information(), ~joints[seen])
    # Times the typical noise that is declared of the first measurement.
    roots = noise_roots(problem.kernels[0].factor, problem.records[0])
    rms = np.sqrt(theta * np.mean(np.sum(roots**2, axis=2)))
    deviations = np.sqrt(np.maximum(np.diag(covariance), 0.0)) / sizes
    rows = zip(chosen, theta / sizes, deviations, theta / theta.sum(), rms, strict=True)
    return VarianceComponents(
        tuple(_component(source, *map(float, numbers)) for source, *numbers in rows),
        correlated_pairs(covariance, tuple(source.name for source in chosen)),
        tuple(source.name for source, moves in zip(sources, seen, strict=True) if not moves),
    )


def apply_components(problem: Problem, values: Array, variance_components: VarianceComponents, axes: Axes) -> Problem:
    sources = _sources(problem, values, axes)
    variance = {c.name: c.sd**2 for c in variance_components.components}
    result = []
    for place, (kernel, factor_records) in enumerate(zip(problem.kernels, problem.records, strict=True)):
        base = whitening_of(kernel.factor, factor_records)
        total = sum((variance.get(s.name, 0.0) * s.bases[place] for s in sources), np.array(0.0))
        padded = np.pad(total, ((0, 0), (0, 0), (0, base.shape[2] - factor_records.count)), mode="edge")
        result.append(replace(factor_records, whitening=transformed(by_covariance(padded), base)))
    return problem.with_records(result)


@dataclass(frozen=True)
class _Source:
    """What a component may come from, and its V by factor (n_r x n_r x N), in units of the declared noise."""

    name: str
    kind: Literal["instrument", "joint"]
    unit: str
    bases: list[Array]


def _sources(problem: Problem, values: Array, axes: Axes) -> list[_Source]:
    pairs = list(zip(problem.kernels, problem.records, strict=True))
    nothing = [np.zeros((kernel.factor.rows,) * 2 + (record.count,)) for kernel, record in pairs]
    sources = []
    for place, (kernel, record) in enumerate(pairs):
        name, count = kernel.factor.name, kernel.factor.rows
        parts = [(name, np.ones(count))]
        if axes == "apart":
            channels = [channel.name for channel in problem.blueprint.measurements[name].channels()]
            labels = channels if len(channels) == count else [str(i) for i in range(1, count + 1)]
            parts = [(f"{name}.{label}", row) for label, row in zip(labels, np.eye(count), strict=True)]
        for label, diagonal in parts:
            own = np.repeat(np.diag(diagonal)[:, :, None], record.count, axis=2)
            bases = [own if i == place else none for i, none in enumerate(nothing)]
            sources.append(_Source(label, "instrument", "1", bases))
    joints = command_channels(problem.blueprint.arms)
    slopes = problem.channel_slopes(values, list(joints))
    whitened = [
        transformed(whitening_of(kernel.factor, record)[:, :, : record.count], slope)
        for (kernel, record), slope in zip(pairs, slopes, strict=True)
    ]
    for number, (joint, dimension) in enumerate(joints.items()):
        unit = si_unit(dimension).name
        sources.append(_Source(joint, "joint", unit, [w[:, None, number] * w[None, :, number] for w in whitened]))
    return sources


def _mean_variance(basis: Sequence[Array], records: Sequence[FactorRecords]) -> float:
    total, count = 0.0, 0
    for record, own in zip(records, basis, strict=True):
        used = record.weight[: record.count] > 0
        total += float(np.einsum("aan->n", own)[used].sum())
        count += int(used.sum()) * len(own)
    return total / max(count, 1)


def _terms(problem: Problem, values: Array, bases: Sequence[list[Array]], sizes: Array) -> list[Term]:
    parameters = problem.parameters
    chain, moved = parameters.entries_jacobian(values), parameters.coordinates(parameters.local(values))
    residuals, jacobians, terms = problem.whitened_residuals(values), problem.jacobians(values), []
    for place, record in enumerate(problem.records):
        used = np.flatnonzero(record.weight[: record.count] > 0)
        jacobian = np.einsum("avn,vc->nac", jacobians[place][:, :, used], chain, optimize=True)
        own = np.stack([basis[place][:, :, used] / size for basis, size in zip(bases, sizes, strict=True)])
        target = residuals[place][:, used].T + jacobian @ moved
        terms.append(Term(target, jacobian, np.moveaxis(own, 3, 1)))
    return terms


def _component(source: _Source, variance: float, deviation: float, share: float, rms: float) -> Component:
    """From a variance and its deviation; the interval is made on the variance, where the estimate is nearly normal."""
    reach, sd = float(ndtri(0.5 + CONFIDENCE / 2)) * deviation, float(np.sqrt(variance))
    error = deviation / (2 * sd) if sd > 0 else float("nan")
    lower, upper = float(np.sqrt(max(variance - reach, 0.0))), float(np.sqrt(variance + reach))
    return Component(source.name, source.kind, source.unit, sd, error, lower, upper, share, rms)
