"""Which fixed parameters a fit would rather have free: those that the records determine and that explain residuals.

One after another, the one whose score is largest for its spread [Rao1948] is freed, to first order. What chance would
find among so many is no gain: levels are divided by their number.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from armcal.base.arrays import Array
from armcal.base.domains import Semidefinite
from armcal.base.parameters import Parameters
from armcal.problem.problem import NormalEquations, Problem

LEVEL = 0.05  # Of naming any parameter though nothing is to be gained
MOST_UNCERTAIN = 0.5  # In typical scales: what the noise leaves less certain than this is not determined
MOST_FREED = 12
_OWN = 1e-6  # Of what a parameter does: less than this beside the free ones is theirs
_RANK = 1e-11


@dataclass(frozen=True)
class Candidate:
    """A fixed parameter that the records would determine."""

    name: str  # of its block
    sd: Array  # of its coordinates if it were free, by the residuals found (SI)
    change: Array  # by how much it would move, to first order (SI)
    p_value: float  # that it gains nothing, counting that so many were looked at


@dataclass(frozen=True)
class Freeing:
    """What is worth freeing, in that order, and what else the records would determine beside it."""

    gaining: tuple[Candidate, ...]
    others: tuple[Candidate, ...]


def candidates(parameters: Parameters) -> tuple[str, ...]:
    return tuple(
        block.name
        for block in parameters.blocks
        if not (block.free or block.nuisance or isinstance(block.domain, Semidefinite))
        and ".links." not in block.name
        and not block.name.startswith("statics.")
    )


def freeing(wide: Problem, own: Sequence[str], values: Array) -> Freeing:
    """Judge all that is free in ``wide`` and not among the ``own`` parameters, at a fit of these alone."""
    parameters = wide.parameters
    chain = parameters.entries_jacobian(values) * parameters.scales()
    model = wide.normal_equations(values).chained(chain)
    priors = parameters.prior_information() * parameters.scales() ** 2
    off = parameters.coordinates(parameters.local(values)) / parameters.scales()
    model = NormalEquations(model.cost, model.gradient + priors * off, model.hessian + np.diag(priors))
    places = {name: np.arange(own.start, own.stop) for name, own in parameters.coordinates_of.items()}
    search = _Search(model, priors, wide.equations(), parameters.scales())
    taken, left = [i for name in own for i in places[name]], [name for name in places if name not in set(own)]
    gaining, count = list[Candidate](), len(left)
    while left and len(gaining) < MOST_FREED:
        judged = [search.judged(name, places[name], taken, count) for name in left]
        best = min((one for one in judged if one is not None), key=lambda one: one.p_value, default=None)
        if best is None or best.p_value > LEVEL:
            break
        gaining.append(best)
        taken.extend(places[best.name])
        left.remove(best.name)
    others = [search.judged(name, places[name], taken, count) for name in left]
    return Freeing(tuple(gaining), tuple(one for one in others if one is not None))


@dataclass(frozen=True)
class _Search:
    """A quadratic model of the cost by coordinates in typical scales, of so many equations; priors are part of it."""

    model: NormalEquations
    priors: Array
    equations: int
    scales: Array

    def judged(self, name: str, own: Array, taken: Sequence[int], count: int) -> Candidate | None:
        """A parameter beside those taken, one of ``count``; None if the records do not determine it."""
        beside = np.array(taken, dtype=np.intp)
        slopes, bends = self.model.gradient, self.model.hessian
        size = np.sqrt(np.maximum(np.diag(bends)[beside], 1e-300))
        units, inside = np.outer(size, size), bends[np.ix_(beside, beside)]
        inverse = np.linalg.pinv(inside / units, rcond=_RANK, hermitian=True) / units  # where they are determined
        across = bends[np.ix_(own, beside)] @ inverse
        spread = bends[np.ix_(own, own)] - across @ bends[np.ix_(beside, own)]
        score = slopes[own] - across @ slopes[beside]
        by_data = spread - np.diag(self.priors[own])
        if np.linalg.eigvalsh(by_data)[0] <= _OWN * np.diag(bends)[own].max():
            return None
        cost = self.model.cost - float(slopes[beside] @ inverse @ slopes[beside]) / 2
        spare = max(1, self.equations - len(beside) - len(own))
        gain = float(score @ np.linalg.solve(spread, score))
        variance = max(2 * cost - gain, 0.0) / spare
        sd = np.sqrt(variance * np.diag(np.linalg.inv(by_data)))
        if sd.max() > MOST_UNCERTAIN:
            return None
        p_value = float(fdtrc(len(own), spare, gain / max(variance, 1e-300) / len(own)))
        change = -np.linalg.solve(spread, score)
        return Candidate(name, sd * self.scales[own], change * self.scales[own], min(1.0, count * p_value))
