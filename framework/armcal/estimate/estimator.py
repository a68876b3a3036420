"""Estimators and estimates: from a problem to values, and how sure they are."""

import difflib
from collections.abc import Callable, Iterator, KeysView
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.special import stdtrit

from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.errors import NotConvergedError
from armcal.estimate.identifiability import (
    DeterminedBy,
    Identifiability,
    InverseInformation,
    determined_by,
    identify_from,
)
from armcal.io.parallel import Executor
from armcal.problem.problem import Problem, triangular
from armcal.problem.variants import factor_at_zero

CONFIDENCE = 0.95
NEAR_A_BOUND_SD = 3.0  # Within so many standard deviations of a bound an interval is one-sided
SMALLEST_SPREAD = 1e-12
AT_BOUND = 1e-6  # In typical scales of the parameter: closer than this, a parameter lies on its bound

CHECK_THE_DATA = (
    "Check the axes, units and frame of the measurements, the order and signs of the joints, and the start values; "
    "or allow more iterations."
)
"""What to do about a fit that leads nowhere."""

Progress = Callable[[str, float], None]  # Called with what is being done, and which fraction of it is


def no_progress(what: str, fraction: float) -> None:
    """Shows nothing."""


@dataclass(frozen=True)
class SolverVerdict:
    """How a solver ended; ``status`` in its own words."""

    name: str
    status: str
    converged: bool
    iterations: int
    seconds: float
    starts: int = 1
    agreeing_starts: int = 1


def gave_up(verdict: SolverVerdict) -> NotConvergedError:
    return NotConvergedError(
        f"{verdict.name} did not converge ({verdict.status}): the fit was driven to where springs do not hold the arm.",
        hint=f"{CHECK_THE_DATA} If all is right, bound the compliances.",
    )


@dataclass(frozen=True)
class Solution:
    """A value vector (all canonical entries) and the solver's verdict on it."""

    values: Array
    verdict: SolverVerdict


class Estimator(Protocol):
    """What a plugin provides to solve a problem on all its records at once."""

    def solve(self, problem: Problem, start: Array, progress: Progress = no_progress) -> Solution:
        """Minimise half the squared whitened residuals plus priors, within bounds, from ``start``.

        A solver that does not converge says so in its verdict; it does not raise.
        """


@runtime_checkable
class SpreadableEstimator(Protocol):
    """An estimator whose own work falls into independent pieces, such as starts."""

    def spread(self, executor: Executor) -> Estimator:
        """The same estimator, with the same answers, its pieces done by an executor."""


def spread(estimator: Estimator, executor: Executor | None) -> Estimator:
    return estimator.spread(executor) if executor and isinstance(estimator, SpreadableEstimator) else estimator


@dataclass(frozen=True)
class Interval95:
    lower: float
    upper: float
    bounds: tuple[str, ...] = ()  # the ends that are bounds of the entry itself: lower, upper


@dataclass(frozen=True)
class Estimated:
    """A free number, in SI and radians."""

    value: float
    deviation: float  # standard deviation; not a number where undetermined
    interval: Interval95


@dataclass(frozen=True)
class Estimate:
    """Values, and how sure they are; by name of a free canonical entry, as a mapping to ``Estimated``.

    ``covariance`` leaves out directions that neither data nor priors determine. ``square_root_information`` is R
    (n x n) with R'R the information of data and priors on the coordinates, undetermined directions as its null space.
    ``widened`` says by what the standard deviations of free entries grew because neighbouring records err alike; it is
    empty where they do and nothing grew by it, None where no such correlation was found.
    """

    parameters: Parameters  # the blocks, with their nominal values
    values: Array  # all canonical entries
    free_entries: tuple[int, ...]  # positions of the free ones
    covariance: Array  # of the free canonical entries
    unconstrained: Array  # free canonical entries after a step that ignores the bounds
    square_root_information: Array
    noise_scale: float  # residuals in units of the declared noise (standard deviation)
    degrees_of_freedom: float  # residual numbers less what the fit takes up of them
    identifiability: Identifiability  # what the data alone determines
    verdict: SolverVerdict
    widened: tuple[float, ...] | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(self.parameters.entry_names[i] for i in self.free_entries)

    def __getitem__(self, name: str) -> Estimated:
        if name not in self._places:
            near = ", ".join(difflib.get_close_matches(name, self.names)) or "keys() has them"
            raise KeyError(f"{name!r} is no free number of this estimate: {near}")
        i = self._places[name]
        return Estimated(float(self.free_values[i]), float(self.deviations[i]), self.intervals[i])

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)

    def keys(self) -> KeysView[str]:
        """Names of the free canonical entries."""
        return self._places.keys()

    def items(self) -> tuple[tuple[str, Estimated], ...]:
        """Each free number with its name."""
        return tuple((name, self[name]) for name in self.names)

    @cached_property
    def _places(self) -> dict[str, int]:
        return {name: i for i, name in enumerate(self.names)}

    @cached_property
    def free_values(self) -> Array:
        """Values of the free canonical entries, in the order of ``names``, ``deviations`` and ``intervals``."""
        return self.values[list(self.free_entries)]

    @cached_property
    def deviations(self) -> Array:
        """Standard deviations of the free canonical entries; not a number where undetermined."""
        deviation = np.sqrt(np.maximum(np.diag(self.covariance), 0.0))
        return np.where([by == "nothing" for by in self.determined_by], np.nan, deviation)

    @cached_property
    def sources(self) -> dict[str, DeterminedBy]:
        """What determines each free parameter, by the names of their coordinates."""
        parameters, root = self.parameters, np.linalg.pinv(self._chain)
        deviations = np.sqrt(np.maximum(np.einsum("ij,jk,ik->i", root, self.covariance, root), 0.0))
        by = determined_by(self.identifiability, parameters, deviations)
        return dict(zip(parameters.coordinate_names, by, strict=True))

    @cached_property
    def determined_by(self) -> tuple[DeterminedBy, ...]:
        """What determines each free canonical entry: the least of what determines the coordinates that move it."""
        moved, by = np.abs(self._chain) * self.parameters.scales(), np.array(list(self.sources.values()), dtype=object)
        moves = moved > 1e-6 * np.linalg.norm(moved, axis=1, keepdims=True)
        return tuple(next((one for one in ("nothing", "prior") if one in by[row]), "data") for row in moves)

    @cached_property
    def _chain(self) -> Array:
        return self.parameters.entries_jacobian(self.values)

    @cached_property
    def at_bound(self) -> tuple[str, ...]:
        """Free entries that ended on a bound."""
        lower, upper = _entry_bounds(self.parameters)
        scale = np.array([block.scale for block in self.parameters.free for _ in range(block.size)])
        value = self.free_values
        on = (value - lower <= AT_BOUND * scale) | (upper - value <= AT_BOUND * scale)
        return tuple(name for name, flag in zip(self.names, on, strict=True) if flag)

    @cached_property
    def intervals(self) -> tuple[Interval95, ...]:
        """95 % intervals of the free entries, by Student's t.

        Within 3 deviations of a bound, or beyond it, an interval reaches from the bound to the other end of the
        two-sided one about the estimate without bounds, or about the bound where that lies beyond it. A
        one-sided quantile there would be shorter, but choosing between the two kinds by the estimate itself
        would then cover the truth in less than 95 % of cases [Feldman1998].
        """
        quantile = float(stdtrit(max(self.degrees_of_freedom, 1.0), 0.5 + CONFIDENCE / 2))
        rows = zip(self.free_values, self.unconstrained, self.deviations, *_entry_bounds(self.parameters), strict=True)
        return tuple(interval(value, at, sd, low, high, quantile) for value, at, sd, low, high in rows)


def interval(value: float, unconstrained: float, sd: float, lower: float, upper: float, quantile: float) -> Interval95:
    """Of an entry, by its value and where it would be without bounds; see ``Estimate.intervals``."""
    low, high = value - quantile * sd, value + quantile * sd
    if not np.isfinite(sd):
        low, high = lower, upper
    # Beyond a bound the interval starts there: an estimate that noise pushed far out is no surer than one at the bound.
    elif unconstrained - lower < NEAR_A_BOUND_SD * sd and unconstrained - lower <= upper - unconstrained:
        low, high = lower, np.clip(max(unconstrained, lower) + quantile * sd, lower, upper)
    elif upper - unconstrained < NEAR_A_BOUND_SD * sd:
        low, high = np.clip(min(unconstrained, upper) - quantile * sd, lower, upper), upper
    ends = {"lower": low == lower > -np.inf, "upper": high == upper < np.inf}
    return Interval95(float(low), float(high), tuple(end for end, is_bound in ends.items() if is_bound))


@dataclass(frozen=True)
class Influence:
    """How residuals act on an estimate: all alike in least squares, less when large under a robust loss [Huber1981]."""

    weights: tuple[Array, ...] | None  # of each record, factor by factor (N each); None for ones
    spread: float  # root mean square of what a residual number contributes, in units of the declared noise
    slope: float  # mean derivative of that by the residual
    noise_scale: float  # residuals in units of the declared noise, outliers discounted


def estimate(problem: Problem, solution: Solution, influence: Influence | None = None) -> Estimate:
    """Covariance, intervals and identifiability at a solution; without ``influence``, one of least squares.

    The declared noise is scaled to the residuals found (the a posteriori variance factor [Mikhail1976]): with a model
    that is wrong by more than the noise the intervals widen. Priors weigh as they were stated against the declared
    noise, so the covariance is the sandwich H^-1 (s^2 J'J + P) H^-1 with H = b J'J + P; s is the influence's spread and
    b its slope, 1 in least squares. A parameter at a bound keeps its full covariance: the bound is not evidence.
    """
    problem.require_held(solution.values)
    parameters = problem.parameters
    prior, slope = parameters.prior_information(), 1.0 if influence is None else influence.slope
    chain = parameters.entries_jacobian(solution.values)
    acting = problem.weighted(influence.weights) if influence and influence.weights else problem
    equations = acting.normal_equations(solution.values).chained(chain)
    triangle = factor_at_zero(problem, solution.values)
    known = identify_from(triangle, parameters)
    inverse = InverseInformation.of(np.sqrt(slope) * triangle, parameters)
    half, freedom = inverse.root, problem.equations() - inverse.spent
    if influence is None:  # with less than one degree of freedom the declared noise is believed
        noise_scale = float(np.sqrt(2 * equations.cost / freedom)) if freedom >= 1 else 1.0
        influence = Influence(None, noise_scale, 1.0, noise_scale)
    by_data = influence.spread * half @ (half.T @ triangle.T)
    by_both = np.hstack([by_data, half @ (half.T * np.sqrt(prior))])
    pull = equations.gradient + prior * parameters.coordinates(parameters.local(solution.values))
    step = -(half @ (half.T @ pull))
    information = triangle * (influence.slope / max(influence.spread, SMALLEST_SPREAD))
    return Estimate(
        parameters=parameters,
        values=solution.values,
        free_entries=parameters.free_entries,
        covariance=chain @ (by_both @ by_both.T) @ chain.T,
        unconstrained=solution.values[list(parameters.free_entries)] + chain @ step,
        square_root_information=triangular(np.vstack([information, np.diag(np.sqrt(prior))])),
        noise_scale=influence.noise_scale,
        degrees_of_freedom=freedom,
        identifiability=known,
        verdict=solution.verdict,
    )


def degrees_of_freedom(problem: Problem, values: Array, slope: float = 1.0) -> float:
    """Residual numbers less what a fit takes up of them, the trace of its hat matrix; ``slope`` is of an influence.

    A parameter that its prior holds takes up nothing, so that it is not counted as spent.
    """
    triangle = np.sqrt(slope) * factor_at_zero(problem, values)
    return problem.equations() - InverseInformation.of(triangle, problem.parameters).spent


def _entry_bounds(parameters: Parameters) -> tuple[Array, Array]:
    lower, upper = [], []
    for block in parameters.free:
        lower += [getattr(block.domain, "lower", -np.inf)] * block.size
        upper += [getattr(block.domain, "upper", np.inf)] * block.size
    return np.array(lower), np.array(upper)
