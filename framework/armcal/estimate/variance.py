"""Variance components: how much of the residuals is the instrument's, and how much each joint's.

A record's residual has the covariance sum_c theta_c V_c: one V for each instrument, its declared noise squared, and
one for each joint, d r / d q (d r / d q)', what a joint that does not return to the same angle does at that pose.
The thetas are estimated by restricted maximum likelihood [Patterson1971], which counts what the fitted parameters
took out of the residuals, by average-information steps [Gilmour1995] kept above zero.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.special import ndtri

from armcal.base.domains import Array
from armcal.errors import ProblemError
from armcal.estimate.estimator import CONFIDENCE, degrees_of_freedom
from armcal.estimate.identifiability import CORRELATED
from armcal.estimate.likelihood import Term, maximise
from armcal.problem.kernel import Kernel
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.whitening import by_covariance, declared, transformed

Axes = Literal["together", "apart"]

SMALLEST_SHARE = 1e-6
"""Of the declared variance per rad^2 (or m^2) of the joint that moves most: a joint below it moves no residual."""


@dataclass(frozen=True)
class Component:
    """One source of scatter.

    Attributes:
        name: an instrument (``tracker``), one of its axes (``tracker.x``) or a joint (``arm.q3``).
        kind: ``instrument`` or ``joint``.
        unit: of ``sd`` in SI: rad or m for a joint; ``1``, multiples of the declared noise, for an instrument.
        sd: standard deviation.
        sd_error: its own standard deviation; not a number where it ended at zero.
        lower, upper: 95 % interval of ``sd``; reaches zero where the data allows it.
        share: of the variance of all residuals, 0 to 1.
        rms: what it contributes to a residual number (m or rad), root mean square over records.
    """

    name: str
    kind: Literal["instrument", "joint"]
    unit: str
    sd: float
    sd_error: float
    lower: float
    upper: float
    share: float
    rms: float


@dataclass(frozen=True)
class VarianceComponents:
    """What was found.

    Attributes:
        components: in the order of instruments, then joints.
        inseparable: pairs whose estimates correlate beyond 0.95, with the correlation.
        unseen: joints that move no residual.
        log_likelihood: restricted, up to a constant.
        rounds: estimates with refits between them.
    """

    components: tuple[Component, ...]
    inseparable: tuple[tuple[str, str, float], ...]
    unseen: tuple[str, ...]
    log_likelihood: float
    rounds: int = 1

    def share(self, kind: str) -> float:
        """Of all components of a kind."""
        return sum(c.share for c in self.components if c.kind == kind)

    def close_to(self, other: VarianceComponents) -> bool:
        """Whether another estimate differs by less than a tenth of its standard deviations."""
        if [c.name for c in self.components] != [c.name for c in other.components]:
            return False
        return all(
            abs(a.sd - b.sd) <= 0.1 * np.nan_to_num(b.sd_error) + 1e-3 * b.sd
            for a, b in zip(self.components, other.components, strict=True)
        )


def estimate_components(
    problem: Problem, values: Array, records: Sequence[FactorRecords], axes: Axes = "together"
) -> VarianceComponents:
    """Components at a fit; ``records`` carry the declared noise, and weight 0 where they are left out.

    Raises:
        ProblemError: there are not more equations than parameters and components, or parameters drift.
    """
    names, kinds, bases = _bases(problem, values, records, axes)
    sizes = np.array([_mean_variance(base, records) for base in bases])
    joints = np.array([kind == "joint" for kind in kinds])
    largest = float(sizes[joints].max(initial=0.0))
    seen = ~joints | (sizes > SMALLEST_SHARE * largest)
    _require_freedom(problem, values, records, int(seen.sum()))
    chosen = [i for i in range(len(names)) if seen[i]]
    terms = _terms(problem, values, records, [bases[i] for i in chosen], sizes[chosen])
    prior = problem.parameters.prior_information()
    likelihood_maximum = maximise(terms, prior, ~joints[chosen])
    shares = likelihood_maximum.theta / likelihood_maximum.theta.sum()
    rms = np.sqrt(likelihood_maximum.theta) * _typical_noise(problem, records)
    components = tuple(
        _component(
            names[i],
            kinds[i],
            problem,
            float(likelihood_maximum.theta[n] / sizes[i]),
            float(_deviation(likelihood_maximum.covariance, n) / sizes[i]),
        )
        for n, i in enumerate(chosen)
    )
    return VarianceComponents(
        tuple(replace(c, share=float(s), rms=float(r)) for c, s, r in zip(components, shares, rms, strict=True)),
        _inseparable(likelihood_maximum.covariance, likelihood_maximum.theta, [names[i] for i in chosen]),
        tuple(names[i] for i in range(len(names)) if not seen[i]),
        likelihood_maximum.log_likelihood,
    )


def apply_components(
    problem: Problem,
    values: Array,
    records: Sequence[FactorRecords],
    variance_components: VarianceComponents,
    axes: Axes,
) -> tuple[FactorRecords, ...]:
    """The same records (which carry the declared noise), whitened by the estimated covariances."""
    names, _, bases = _bases(problem, values, records, axes)
    variance = {c.name: c.sd**2 for c in variance_components.components}
    result = []
    for place, (kernel, factor_records) in enumerate(zip(problem.kernels, records, strict=True)):
        width = factor_records.record.shape[1]
        total = sum((variance.get(n, 0.0) * basis[place] for n, basis in zip(names, bases, strict=True)), np.array(0.0))
        padded = np.concatenate([total, np.repeat(total[:, :, -1:], width - factor_records.count, axis=2)], axis=2)
        base = _declared(kernel.factor.noise, factor_records)
        result.append(replace(factor_records, whitening=transformed(by_covariance(padded), base)))
    return tuple(result)


def _declared(noise: Sequence[float], factor_records: FactorRecords) -> Array:
    """Whitening by the declared noise (n_r x n_r x width)."""
    if factor_records.whitening is not None:
        return factor_records.whitening
    return np.repeat(declared(noise)[:, :, None], factor_records.record.shape[1], axis=2)


def _bases(
    problem: Problem, values: Array, records: Sequence[FactorRecords], axes: Axes
) -> tuple[list[str], list[Literal["instrument", "joint"]], list[list[Array]]]:
    """Names, kinds, and V by component and factor (n_r x n_r x N), in units of the declared noise."""
    names: list[str] = []
    kinds: list[Literal["instrument", "joint"]] = []
    bases: list[list[Array]] = []
    nothing = [np.zeros((k.factor.residual.numel(),) * 2 + (e.count,)) for k, e in _pairs(problem, records)]
    for place, (kernel, each) in enumerate(_pairs(problem, records)):
        for label, diagonal in _groups(problem, kernel.factor.name, kernel.factor.residual.numel(), axes):
            own = np.repeat(np.diag(diagonal)[:, :, None], each.count, axis=2)
            names.append(label)
            kinds.append("instrument")
            bases.append([own if i == place else none for i, none in enumerate(nothing)])
    joints = _joints(problem)
    slopes = problem.channel_slopes(values, records, joints)
    whitened = [
        transformed(_declared(kernel.factor.noise, factor_records)[:, :, : factor_records.count], slope)
        for (kernel, factor_records), slope in zip(_pairs(problem, records), slopes, strict=True)
    ]
    for number, joint in enumerate(joints):
        names.append(joint)
        kinds.append("joint")
        bases.append([w[:, None, number] * w[None, :, number] for w in whitened])
    return names, kinds, bases


def _pairs(problem: Problem, records: Sequence[FactorRecords]) -> Iterable[tuple[Kernel, FactorRecords]]:
    return zip(problem.kernels, records, strict=True)


def _groups(problem: Problem, name: str, count: int, axes: Axes) -> list[tuple[str, Array]]:
    """The parts of an instrument: label, and which residual entries (1 or 0)."""
    if axes == "together":
        return [(name, np.ones(count))]
    channels = [channel.name for channel in problem.blueprint.measurements[name].channels()]
    labels = channels if len(channels) == count else [str(i) for i in range(1, count + 1)]
    return [(f"{name}.{label}", row) for label, row in zip(labels, np.eye(count), strict=True)]


def _joints(problem: Problem) -> list[str]:
    """Joint channels of all arms."""
    return [f"{arm.name}.{joint}" for arm in problem.blueprint.arms.values() for joint in arm.commanded]


def _joint_unit(problem: Problem, channel: str) -> str:
    arm, _, joint = channel.rpartition(".")
    found = next(a for a in problem.blueprint.arms.values() if a.name == arm)
    return "rad" if found.commanded[joint] == "angle" else "m"


def _mean_variance(basis: Sequence[Array], records: Sequence[FactorRecords]) -> float:
    """Mean diagonal entry over the residual numbers that count."""
    total, count = 0.0, 0
    for record, own in zip(records, basis, strict=True):
        used = record.weight[: record.count] > 0
        total += float(np.einsum("aan->n", own)[used].sum())
        count += int(used.sum()) * len(own)
    return total / max(count, 1)


def _terms(
    problem: Problem, values: Array, records: Sequence[FactorRecords], bases: Sequence[list[Array]], sizes: Array
) -> list[Term]:
    """Residuals, Jacobians and bases (of mean variance one) of the records that count."""
    parameters = problem.parameters
    chain, moved = parameters.entries_jacobian(values), parameters.coordinates(parameters.local(values))
    residuals, blocks, terms = problem.whitened_residuals(values, records), problem.jacobians(values, records), []
    for place, record in enumerate(records):
        parts: list[Array] = []
        while sum(part.shape[2] for part in parts) < record.record.shape[1]:
            parts.append(next(blocks))
        used = np.flatnonzero(record.weight[: record.count] > 0)
        jacobian = np.einsum("avn,vc->nac", np.concatenate(parts, axis=2)[:, :, used], chain, optimize=True)
        own = np.stack([basis[place][:, :, used] / size for basis, size in zip(bases, sizes, strict=True)])
        target = residuals[place][:, used].T + jacobian @ moved
        terms.append(Term(target, jacobian, np.moveaxis(own, 3, 1)))
    return terms


def _require_freedom(problem: Problem, values: Array, records: Sequence[FactorRecords], components: int) -> None:
    if records[0].correlation is not None:
        raise ProblemError(
            "variance components cannot be estimated beside drifting parameters.",
            hint="Take the drifts away, or set noise.estimate: false.",
        )
    freedom = degrees_of_freedom(problem, values, records)
    if freedom <= 2 * components:
        raise ProblemError(
            f"{problem.equations(records)} equations leave {freedom:.1f} degrees of freedom, too few to estimate "
            f"{components} variance components from.",
            hint="Measure more poses, or set noise.estimate: false.",
        )


def _typical_noise(problem: Problem, records: Sequence[FactorRecords]) -> float:
    """Root mean square of the declared noise of the first measurement."""
    kernel, factor_records = problem.kernels[0], records[0]
    inverse = np.linalg.inv(
        np.moveaxis(_declared(kernel.factor.noise, factor_records)[:, :, : factor_records.count], 2, 0)
    )
    return float(np.sqrt(np.mean(np.sum(inverse**2, axis=2))))


def _deviation(covariance: Array, place: int) -> float:
    return float(np.sqrt(max(covariance[place, place], 0.0)))


def _component(
    name: str, kind: Literal["instrument", "joint"], problem: Problem, theta: float, deviation: float
) -> Component:
    """From a variance and its deviation; the interval is made on the variance, where the estimate is nearly normal."""
    reach = float(ndtri(0.5 + CONFIDENCE / 2)) * deviation
    sd = float(np.sqrt(theta))
    error = deviation / (2 * sd) if sd > 0 else float("nan")
    lower, upper = float(np.sqrt(max(theta - reach, 0.0))), float(np.sqrt(theta + reach))
    unit = "1" if kind == "instrument" else _joint_unit(problem, name)
    return Component(name, kind, unit, sd, error, lower, upper, 0.0, 0.0)


def _inseparable(covariance: Array, theta: Array, names: Sequence[str]) -> tuple[tuple[str, str, float], ...]:
    """Pairs whose estimates hardly differ in what they say of the data."""
    deviation = np.sqrt(np.maximum(np.diag(covariance), 1e-300))
    correlation = covariance / np.outer(deviation, deviation)
    rows, columns = np.triu_indices(len(theta), 1)
    return tuple(
        (names[i], names[j], float(correlation[i, j]))
        for i, j in zip(rows.tolist(), columns.tolist(), strict=True)
        if abs(correlation[i, j]) > CORRELATED
    )
