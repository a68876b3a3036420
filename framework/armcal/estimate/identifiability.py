"""Which parameter combinations the data determines, by name.

Rank is judged on the whitened Jacobian with each column scaled by the typical scale of its parameter, by singular
values and by QR with pivoting [Golub2013]; undetermined combinations are reduced to as few parameters each as
possible.

A minimal set of parameters, which to keep free and what absorbs each of the others, is found by QR with column pivoting
on the scaled Jacobian, block by block, preferred blocks first; the way in which base parameters are found numerically
[Khalil2002].

A combination is undetermined because no poses determine it, these poses do not, or only not at these values. A model is
analytic, so its rank is the same almost everywhere; random poses at a point near the values at hand show it with
probability one, and what is undetermined there is a gauge.

Of fixed parameters, those are worth freeing that the records would determine and that explain residuals: one after
another the one whose score is largest for its spread [Rao1948], to first order. What chance would find among so many is
no gain: levels are divided by their number.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from math import comb
from typing import Literal, Self

import numpy as np
from scipy.linalg import qr
from scipy.special import fdtrc

from armcal.base.arrays import Array, Indices, Mask
from armcal.base.domains import Semidefinite
from armcal.base.parameters import Parameters
from armcal.base.units import shown_unit
from armcal.errors import NotConvergedError, ProblemError
from armcal.problem.problem import NormalEquations, Problem
from armcal.problem.records import subset
from armcal.problem.rigid_alignment import along, apart_from, tools, unseen_motions
from armcal.problem.variants import approach_channels, factor_at_zero, fits, joint_channels, projected

MOST_NAMES = 6  # A longer combination is cut when it is shown; ``terms`` has all of it


@dataclass(frozen=True)
class Measure:
    """How one parameter is shown: its SI unit, and its typical scale in it."""

    unit: str
    scale: float

    def shown(self, coefficient: float) -> tuple[float, str]:
        factor, unit = shown_unit(self.unit)
        return coefficient * self.scale * factor, unit


@dataclass(frozen=True)
class Combination:
    terms: tuple[tuple[str, float], ...]  # (name, coefficient in typical scales of the parameter), the largest first
    measures: tuple[Measure, ...] = ()  # one a term; empty to show coefficients in typical scales

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(name for name, _ in self.terms)

    @property
    def amounts(self) -> tuple[str, ...]:
        """What each term moves by when the first moves by one unit: ``+1 mm``, ``-0.5 deg``."""
        if not self.measures:
            return tuple(f"{weight / self.terms[0][1]:+.3g}" for _, weight in self.terms)
        shown = [m.shown(weight) for m, (_, weight) in zip(self.measures, self.terms, strict=True)]
        return tuple(f"{amount / shown[0][0]:+.3g} {unit}".rstrip() for amount, unit in shown)

    def __str__(self) -> str:
        if not self.terms:
            return "nothing"
        if len(self.terms) == 1:
            return f"{self.terms[0][0]} alone"
        more = len(self.terms) - MOST_NAMES
        others, amounts = self.names[1:MOST_NAMES], self.amounts[:MOST_NAMES]
        tail = f" and {more} more" if more > 0 else ""
        listed = f"{', '.join(others)}{tail}" if tail else _listed(others)
        return f"{self.names[0]} trades with {listed} ({amounts[0]} with {_listed(amounts[1:])})"


def named(vector: Array, names: Sequence[str], measures: Sequence[Measure], at_least: float) -> Combination:
    """A vector in typical scales (n) as a combination, entries below ``at_least`` times the largest left out.

    The first term is positive: the vector's own sign means nothing.
    """
    largest = float(np.abs(vector).max(initial=0.0)) or 1.0
    # Rounded, so that equal shares stay in the order of the parameters whatever their last digits.
    order = np.argsort(-np.round(np.abs(vector) / largest, 6), kind="stable")
    kept = [int(i) for i in order if abs(vector[i]) > at_least * largest]
    size = float(np.copysign(largest, vector[kept[0]])) if kept else largest
    terms = tuple((names[i], float(vector[i] / size)) for i in kept)
    return Combination(terms, tuple(measures[i] for i in kept) if measures else ())


def _listed(words: Sequence[str]) -> str:
    return " and ".join([", ".join(words[:-1]), words[-1]] if len(words) > 1 else words)


EXACT = 1e-6  # Sine of the angle within which a vector belongs to a space
_LEAST_SHARE = 3e-3
_MOST_SUBSETS = 60_000
_LARGEST_SUBSET = 3
_MOST_BY_SEARCH = 100
_MOST_WIDE = 300


def sparse_basis(space: Array, nested: tuple[Array, ...] = (), within: float = EXACT) -> Array:
    """A basis (m x n) of the space of orthonormal rows (m x n) whose vectors have few entries, the largest of each 1.

    Vectors of up to three entries are all tried; beyond them those of the least sum of magnitudes are searched for.
    ``nested`` are orthonormal rows of subspaces of it, each in the next, known to ``within`` (sine of the angle); the
    basis begins with a basis of the first, goes on to one of the second, and so on.
    """
    chosen = np.zeros((0, space.shape[1]))
    for part in (*nested, space):
        sine = within if part is not space else EXACT
        for vector in _candidates(part, space, sine):
            if len(chosen) == len(part):
                break
            basis = np.linalg.qr(chosen.T)[0]
            left = vector - basis @ (basis.T @ vector)
            if not len(chosen) or np.linalg.norm(left) > 10 * sine * np.linalg.norm(vector):
                chosen = np.vstack([chosen, vector])
    return np.array([row / np.abs(row).max() for row in chosen]).reshape(-1, space.shape[1])


def null_rows(matrix: Array, tolerance: float) -> Array:
    """Orthonormal rows that a matrix (m x n) maps to no more than ``tolerance``."""
    _, values, directions = np.linalg.svd(matrix)
    return np.asarray(directions[int(np.sum(values > tolerance)) :])


def _candidates(part: Array, space: Array, sine: float) -> Iterator[Array]:
    """Sparse vectors of a subspace, the sparsest first; then enough to span it."""
    if len(part) == 1:
        snapped = _snapped(part[0], space, _support(part[0], 3 * sine))
        yield part[0] if snapped is None else snapped
        return
    taking_part = np.flatnonzero(np.linalg.norm(part, axis=0) > sine).astype(np.intp)
    for size in range(1, _LARGEST_SUBSET + 1):
        if comb(len(taking_part), size) <= _MOST_SUBSETS:
            yield from _on_few(part, space, taking_part, size, sine)
    if 1 < len(part) <= _MOST_BY_SEARCH and len(taking_part) <= _MOST_WIDE:
        least = [v for i in taking_part if (v := _least(part, space, int(i))) is not None]
        yield from sorted(
            least, key=lambda v: (int(_support(v, EXACT).sum()), float(np.abs(v).sum() / np.abs(v).max()))
        )
    if len(part):  # reduced row echelon form
        pivots = qr(part, pivoting=True, mode="economic")[2]
        yield from np.linalg.solve(part[:, pivots[: len(part)]], part)
    yield from part


def _on_few(part: Array, space: Array, taking_part: Indices, size: int, sine: float) -> Iterator[Array]:
    """All vectors of a subspace with exactly ``size`` entries, the surest first."""
    subsets = np.array(list(combinations(taking_part, size)), dtype=np.intp).reshape(-1, size)
    columns = part.T[subsets]
    cosines, vectors = np.linalg.eigh(columns @ columns.transpose(0, 2, 1))
    entries = vectors[:, :, -1]
    full = np.abs(entries).min(axis=1) > 3 * sine
    off = 1 - cosines[:, -1]
    belonging = np.flatnonzero(full & (off < max(sine**2, 1e-12)))
    for index in belonging[np.argsort(np.round(off[belonging], 9), kind="stable")]:
        vector = np.zeros(part.shape[1])
        vector[subsets[index]] = entries[index]
        snapped = _snapped(vector, space, np.isin(np.arange(len(vector)), subsets[index]))
        if snapped is not None:
            yield snapped


def _least(part: Array, space: Array, entry: int) -> Array | None:
    """The vector of the least sum of magnitudes whose ``entry`` is 1."""
    from scipy.optimize import linprog

    count, width = part.shape
    cost = np.concatenate([np.zeros(count), np.ones(width)])
    above = np.block([[part.T, -np.eye(width)], [-part.T, -np.eye(width)]])
    through = np.concatenate([part[:, entry], np.zeros(width)])[None, :]
    bounds = [(None, None)] * count + [(0, None)] * width
    done = linprog(cost, above, np.zeros(2 * width), through, [1.0], bounds, method="highs")
    if done.status != 0 or done.x is None:
        return None
    vector = np.asarray(done.x[:count] @ part)
    snapped = _snapped(vector, space, _support(vector, _LEAST_SHARE))
    return vector if snapped is None else snapped


def _snapped(vector: Array, space: Array, present: Mask) -> Array | None:
    """The nearest vector of a space that has no other entries than those present; None if there is none."""
    inside = null_rows(space[:, ~present].T, EXACT) @ space if not present.all() else space
    if not len(inside):
        return None
    return np.asarray(np.where(present, (inside @ vector) @ inside, 0.0))


def _support(vector: Array, share: float) -> Mask:
    return np.asarray(np.abs(vector) > share * np.abs(vector).max())


RANK_TOLERANCE = 1e-9
"""Relative to the largest singular value: far above rounding, far below anything a real experiment determines."""
POOR_CONDITION = 1e6
HARDLY = 1.0
"""A singular value below this: the declared noise leaves the combination more than its typical scale uncertain."""
CORRELATED = 0.95
_NEGLIGIBLE = 1e-6  # Of its typical scale: a parameter that moves by less takes no part in a combination
_NAMED = 1e-4
_LARGE_SHARE = 0.2


@dataclass(frozen=True)
class Identifiability:
    names: tuple[str, ...]  # of the coordinates
    singular_values: Array  # of the scaled whitened Jacobian, largest first
    directions: Array  # right singular vectors, one a row
    rank: int  # how many are determined
    undetermined: tuple[Combination, ...]  # combinations the data does not see
    rank_by_qr: int = 0  # how many are determined by the diagonal of a QR decomposition with pivoting
    measures: tuple[Measure, ...] = ()  # how each coordinate is shown; empty for coefficients in typical scales

    def __len__(self) -> int:
        return len(self.names)

    @property
    def null(self) -> Array:
        return self.directions[self.rank :]

    @property
    def condition(self) -> float:
        if not len(self):
            return 1.0
        if not self.rank:
            return float("inf")
        return float(self.singular_values[0] / max(self.singular_values[self.rank - 1], np.finfo(float).tiny))

    @property
    def weakest(self) -> Combination:
        if not self.rank:
            return Combination(())
        return named(self.directions[self.rank - 1], self.names, self.measures, _LARGE_SHARE)

    @cached_property
    def hardly(self) -> tuple[tuple[Combination, float], ...]:
        """Combinations that are determined, but poorly, and the standard deviation of each in typical scales.

        Those that stay uncertain by more than a typical scale, lie beyond a poor condition, or are determined by
        one of the two rank decisions alone; the worst first.
        """
        combinations = []
        for i in reversed(range(self.rank)):
            value = float(self.singular_values[i])
            doubtful = i >= min(self.rank_by_qr, _count_above(self.singular_values))
            if value < HARDLY or value * POOR_CONDITION < self.singular_values[0] or doubtful:
                combination = named(self.directions[i], self.names, self.measures, _LARGE_SHARE)
                combinations.append((combination, 1 / value if value > 0 else float("inf")))
        return tuple(combinations)


DeterminedBy = Literal["data", "prior", "nothing"]
DETERMINED_BY: dict[DeterminedBy, str] = {
    "data": "determined by the data",
    "prior": "held by its prior",
    "nothing": "undetermined",
}
OF_PRIOR = 0.9  # Of its prior's standard deviation: a parameter that keeps more of it is held by its prior


def determined_by(known: Identifiability, parameters: Parameters, deviations: Array) -> tuple[DeterminedBy, ...]:
    """What determines each free coordinate, of these standard deviations (n, SI) by data and priors together.

    The data, unless it takes part in a combination that they do not determine, or keeps 90 % of its prior's deviation.
    """
    information = parameters.prior_information()
    by_priors = np.linalg.norm(known.null, axis=0) >= _NEGLIGIBLE
    by_nothing = np.linalg.norm(unheld(parameters, known), axis=0) >= _NEGLIGIBLE
    by_priors |= deviations * np.sqrt(information) > OF_PRIOR
    return tuple("nothing" if n else "prior" if p else "data" for n, p in zip(by_nothing, by_priors, strict=True))


def expected_sources(known: Identifiability, parameters: Parameters, triangle: Array) -> dict[str, DeterminedBy]:
    deviations = np.sqrt(np.diag(expected_covariance(triangle, parameters)))
    return dict(zip(known.names, determined_by(known, parameters, deviations), strict=True))


def determined_in_words(sources: Mapping[str, DeterminedBy]) -> str:
    names = {by: [name for name, own in sources.items() if own == by] for by in DETERMINED_BY}
    if len(names["data"]) == len(sources):
        return f"The data determines all {len(sources)} free parameters"
    text = f"The data determines {len(names['data'])} of {len(sources)} free parameters"
    for words, own in (("held by priors", names["prior"]), ("undetermined", names["nothing"])):
        if own:
            more = f" and {len(own) - MOST_NAMES} more" if len(own) > MOST_NAMES else ""
            text += f"; {words}: {', '.join(own[:MOST_NAMES])}{more}"
    return text


def measures_of(parameters: Parameters) -> tuple[Measure, ...]:
    return tuple(Measure(block.unit, block.scale) for block in parameters.coordinate_blocks)


def analyse(
    triangle: Array, scales: Array, names: tuple[str, ...], measures: Sequence[Measure] = ()
) -> Identifiability:
    """Identifiability from R (m x n, m <= n) with R'R = J'J: undetermined by singular values and by QR."""
    count = len(names)
    if not count:
        return Identifiability(names, np.zeros(0), np.zeros((0, 0)), 0, ())
    square = np.zeros((count, count))
    square[: len(triangle)] = triangle * scales
    _, values, directions = np.linalg.svd(square)
    diagonal = np.abs(np.diag(qr(square, pivoting=True, mode="r")[0]))
    by_qr = _count_above(diagonal)
    rank = max(_count_above(values), by_qr)
    undetermined = tuple(named(v, names, measures, _NAMED) for v in sparse_basis(directions[rank:]))
    return Identifiability(names, values, directions, rank, undetermined, by_qr, tuple(measures))


@dataclass(frozen=True)
class InverseInformation:
    """The inverse of the information of data and priors, R'R + P, by coordinates (SI).

    ``spent`` is how many of the data's numbers the fit takes up, tr J B B' J', the trace of its hat matrix: one for a
    direction that the data alone determines, none for one that its prior alone holds [Hastie2009].
    """

    root: Array  # B (n x k) with B B' the inverse, in the k directions that data and priors determine together
    null: Array  # orthonormal rows, in typical scales, that neither determines
    spent: float

    @classmethod
    def of(cls, triangle: Array, parameters: Parameters) -> Self:
        scales = parameters.scales()
        prior = np.sqrt(parameters.prior_information()) * scales
        _, values, directions = np.linalg.svd(np.vstack([triangle * scales, np.diag(prior)]), full_matrices=False)
        rank = _count_above(values)
        half = directions[:rank].T / values[:rank]
        spent = rank - float(np.sum((prior[:, None] * half) ** 2))
        return cls(scales[:, None] * half, directions[rank:], max(spent, 0.0))


def expected_covariance(triangle: Array, parameters: Parameters) -> Array:
    """Covariance by coordinates (n x n, SI) that the declared noise and the priors leave; zero where undetermined."""
    inverse = InverseInformation.of(triangle, parameters)
    known = np.linalg.norm(inverse.null, axis=0) < _NEGLIGIBLE
    return np.asarray(inverse.root @ inverse.root.T * np.outer(known, known))


def deviations(triangle: Array) -> Array:
    """Standard deviations (n) from R (rows x n) with R'R the information; infinite where something is undetermined."""
    size = triangle.shape[1]
    _, values, directions = np.linalg.svd(np.vstack([triangle, np.zeros((size, size))]), full_matrices=False)
    seen = values > RANK_TOLERANCE * values.max(initial=1e-300)
    spread = np.linalg.norm(directions[seen].T / values[seen], axis=1)
    return np.where(np.linalg.norm(directions[~seen], axis=0) > _NEGLIGIBLE, np.inf, spread)


def correlated_pairs(
    covariance: Array,
    names: tuple[str, ...],
    above: float = CORRELATED,
    bound: Callable[[str, str], bool] | None = None,
) -> tuple[tuple[str, str, float], ...]:
    """Pairs of parameters that correlate by more than ``above`` and are not ``bound``, the strongest first."""
    correlation = correlations(covariance)
    rows, columns = np.triu_indices(len(names), 1)
    pairs = [
        (names[i], names[j], float(correlation[i, j]))
        for i, j in zip(rows, columns, strict=True)
        if abs(correlation[i, j]) > above and not (bound and bound(names[i], names[j]))
    ]
    return tuple(sorted(pairs, key=lambda pair: -abs(pair[2])))


def bound_together(parameters: Parameters) -> Callable[[str, str], bool]:
    """Whether two entries are correlated by what they are: those of one rotation, or two sockets of one plate."""
    fewer = {block.name for block in parameters.free if block.domain.dof < block.size}
    of_groups = {block.name for block in parameters.nuisances}

    def bound(one: str, other: str) -> bool:
        first, second = (name.partition("[")[0] for name in (one, other))
        return (first == second and first in fewer) or {first, second} <= of_groups

    return bound


def correlations(covariance: Array) -> Array:
    deviation = np.sqrt(np.diag(covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(np.nan_to_num(covariance / np.outer(deviation, deviation)))


def numerical_rank(scaled: Array) -> int:
    diagonal = np.diag(qr(scaled, pivoting=True, mode="r")[0])
    return max(_count_above(np.asarray(np.linalg.svd(scaled, compute_uv=False))), _count_above(np.abs(diagonal)))


def _count_above(values: Array) -> int:
    largest = float(values.max(initial=0.0))
    return int(np.sum(values > RANK_TOLERANCE * largest)) if largest > 0 else 0


_NEW = 1e-6  # Of a column's own length: less than this beyond what is kept adds nothing


@dataclass(frozen=True)
class Dropped:
    name: str  # of a coordinate that need not be free
    absorbed_by: Combination  # it first, then what the kept ones do instead: changes no measurement
    left: float  # the part of its effect that the kept ones cannot imitate, 0 to 1


@dataclass(frozen=True)
class MinimalSet:
    kept: tuple[str, ...]  # names of blocks to free, in the order of the parameters
    redundant: tuple[Dropped, ...]  # coordinates that the kept ones absorb entirely
    left_out: tuple[Dropped, ...]  # coordinates that would add something, but were too many, or too uncertain
    deviations: dict[str, float]  # of kept coordinates, in typical scales, by the declared noise; inf: undetermined


def minimal_set(
    triangle: Array,
    parameters: Parameters,
    preferred: Sequence[Sequence[str]] = (),
    most: int | None = None,
    most_uncertain: float = np.inf,
) -> MinimalSet:
    """Choose blocks that determine all that the data determines, and no more.

    Free parameters of groups, sockets and clamps, are tried first: a configuration has them free without naming them.
    Of ``preferred`` names those of the first group are tried next, and so on; no more blocks than ``most``; what stays
    uncertain by more than ``most_uncertain`` typical scales is left out, the most uncertain first.
    """
    columns = triangle * parameters.scales()
    places = parameters.coordinates_of
    tolerance = RANK_TOLERANCE * float(np.linalg.norm(columns, 2)) if columns.size else 0.0
    of_groups = [block.name for block in parameters.free if block.nuisance]
    ranked = [[name for name in group if name in places] for group in (of_groups, *preferred)]
    ranked.append([name for name in places if not any(name in group for group in ranked)])
    order = _chosen(columns, places, ranked, tolerance)
    kept = order[:most]
    while kept:
        deviation = {name: _deviations(columns, places, kept)[places[name]].max() for name in kept}
        # Between equals the one preferred least goes first.
        worst = max(reversed(kept), key=lambda name: deviation[name])
        if deviation[worst] <= most_uncertain:
            break
        kept = [name for name in kept if name != worst]
    return _described(columns, parameters, places, kept, tolerance)


def _chosen(
    columns: Array, places: Mapping[str, slice], groups: Sequence[Sequence[str]], tolerance: float
) -> list[str]:
    """Blocks in the order in which they are taken: within a group, the one with most that is new."""
    basis = np.zeros((len(columns), 0))
    chosen: list[str] = []
    for group in groups:
        waiting = list(dict.fromkeys(group))
        while waiting:
            new = {name: columns[:, places[name]] for name in waiting}
            for _ in range(2):  # twice, against rounding
                new = {name: own - basis @ (basis.T @ own) for name, own in new.items()}
            # Rounded, so that equals stay in the order of the parameters whatever their last digits.
            best = max(waiting, key=lambda name: float(f"{np.linalg.norm(new[name]):.9e}"))
            left, values, _ = np.linalg.svd(new[best], full_matrices=False)
            fresh = left[:, values > max(tolerance, _NEW * float(np.linalg.norm(columns[:, places[best]])))]
            if not fresh.shape[1]:
                break
            basis = np.hstack([basis, fresh])
            chosen.append(best)
            waiting.remove(best)
    return chosen


def _described(
    columns: Array, parameters: Parameters, places: Mapping[str, slice], kept: Sequence[str], tolerance: float
) -> MinimalSet:
    names, measures = parameters.coordinate_names, measures_of(parameters)
    inside = np.zeros(len(names), dtype=bool)
    for name in kept:
        inside[places[name]] = True
    redundant: list[Dropped] = []
    left_out: list[Dropped] = []
    imitation = np.linalg.pinv(columns[:, inside], rcond=RANK_TOLERANCE) @ columns
    for i in np.flatnonzero(~inside):
        vector = np.zeros(len(names))
        vector[i], vector[inside] = 1.0, -imitation[:, i]
        left, length = float(np.linalg.norm(columns @ vector)), float(np.linalg.norm(columns[:, i]))
        share = left / length if length > tolerance else 0.0
        combination = named(np.where(np.arange(len(names)) == i, 0.0, vector), names, measures, _NAMED)
        own = named(np.eye(len(names))[i], names, measures, _NAMED)
        whole = Combination(
            own.terms + tuple((n, float(vector[names.index(n)])) for n in combination.names if length > tolerance),
            own.measures + tuple(m for m in combination.measures if length > tolerance),
        )
        dropped = Dropped(names[i], whole, share)
        (left_out if left > max(tolerance, _NEW * length) else redundant).append(dropped)
    deviation = _deviations(columns, places, kept)
    return MinimalSet(
        kept=tuple(name for name in places if name in set(kept)),
        redundant=tuple(redundant),
        left_out=tuple(left_out),
        deviations={names[i]: float(deviation[i]) for i in np.flatnonzero(inside)},
    )


def _deviations(columns: Array, places: Mapping[str, slice], kept: Sequence[str]) -> Array:
    """Standard deviations in typical scales (n) if these blocks are free; infinite where undetermined, or not kept."""
    inside = np.concatenate([np.arange(columns.shape[1])[places[name]] for name in kept]) if kept else np.zeros(0, int)
    deviation = np.full(columns.shape[1], np.inf)
    deviation[inside] = deviations(columns[:, inside])
    return deviation


Cause = Literal["gauge", "values", "poses", "unknown"]
CAUSES: dict[Cause, str] = {
    "gauge": "a gauge: no poses determine it",
    "values": "not seen at these values, only away from them",
    "poses": "these poses do not determine it, others would",
    "unknown": "it could not be found out whether other poses would determine it",
}
_AWAY = 0.1  # How far from the values at hand a point lies where the rank is taken, in typical scales
_HARDLY_AWAY = 1e-3  # And one where undetermined directions are taken: they turn along with the values
_BEYOND = 0.7  # rad, or m: how far random poses go beyond the recorded ones
_WITHIN = 1e-2  # Sine of the angle within which a direction is the one that is undetermined there

UNSEEN_SCALE = "scale is not observable: the same arm, larger or smaller with all it touches, fits as well"
GIVE_A_LENGTH = "give one length: a known distance, a tracker's record, or a dimension of the arm that is held"
_GROWTH_LEFT = 1e-4  # Of the size of the workspace: what may be left of a growth of all tool positions in proportion
_POSES = 60
MOST_LISTED = 5  # So many undetermined combinations are listed in one message


@dataclass(frozen=True)
class Undetermined:
    combination: Combination
    cause: Cause

    def __str__(self) -> str:
        return f"{self.combination}: {CAUSES[self.cause]}"


def identify(problem: Problem, values: Array) -> Identifiability:
    return identify_from(factor_at_zero(problem, values), problem.parameters)


def identify_from(triangle: Array, parameters: Parameters) -> Identifiability:
    return analyse(triangle, parameters.scales(), parameters.coordinate_names, measures_of(parameters))


def explain(problem: Problem, values: Array, known: Identifiability) -> tuple[Undetermined, ...]:
    """Every undetermined combination with its cause: gauges first, as few parameters in each as possible."""
    null = known.null
    if not len(null):
        return ()
    causes: list[Cause] = ["unknown"] * len(null)
    nested: tuple[Array, ...] = ()
    with suppress(NotConvergedError):
        if all(record.count for record in problem.records):
            poses, parameters = at_random_poses(problem), problem.parameters
            at = _scaled(poses, values)
            here = null_rows(at @ null.T, 1e3 * RANK_TOLERANCE * _largest(at)) @ null  # no poses show these here
            away = _scaled(poses, nearby(parameters, values))
            count = len(null_rows(away, RANK_TOLERANCE * _largest(away)))
            near = _scaled(poses, nearby(parameters, values, _HARDLY_AWAY))
            anywhere = np.linalg.svd(near)[2][len(near.T) - count :]
            turn, cosines, _ = np.linalg.svd(here @ anywhere.T)
            gauge = turn.T[: int(np.sum(cosines > np.sqrt(1 - _WITHIN**2)))] @ here
            nested, causes = (gauge, here), ["gauge"] * len(gauge)
            causes += ["values"] * (len(here) - len(gauge))
            causes += ["poses"] * (len(null) - len(here))
    vectors = sparse_basis(null, nested, _WITHIN)
    combinations = [named(vector, known.names, known.measures, _NAMED) for vector in vectors]
    return tuple(Undetermined(*pair) for pair in zip(combinations, causes, strict=True))


def unheld(parameters: Parameters, known: Identifiability) -> Array:
    """Orthonormal rows, in typical scales, of what neither data nor priors determine."""
    null = known.null
    if not len(null):
        return null
    strength = np.sqrt(parameters.prior_information()) * parameters.scales()
    return null_rows((null * strength).T, RANK_TOLERANCE * max(float(strength.max()), 1e-300)) @ null


def nearby(parameters: Parameters, values: Array, away: float = _AWAY, seed: int = 0) -> Array:
    random = np.random.default_rng(seed)
    at, scale = parameters.local(values), parameters.increment_scales()
    lower, upper = parameters.increment_bounds()
    step = away * scale * random.uniform(0.5, 1.0, len(scale)) * random.choice([-1.0, 1.0], len(scale))
    step = np.where((at + step < lower) | (at + step > upper), -step, step)
    return parameters.retract(np.clip(at + step, lower, upper))


def at_random_poses(problem: Problem, seed: int = 0) -> Problem:
    """With random poses about the recorded ones and beyond them, under the recorded loads, from either side."""
    count = int(np.clip(3 * problem.increments, 60, 600))
    result = []
    for kernel, factor_records in zip(problem.kernels, problem.records, strict=True):
        random = np.random.default_rng(seed)
        rows = np.flatnonzero(factor_records.weight[: factor_records.count])
        chosen = random.choice(rows if len(rows) else np.arange(factor_records.count), count)
        (drawn,) = subset([replace(factor_records, correlation=None)], chosen.astype(np.intp))
        record, joints = drawn.record.copy(), list(joint_channels(kernel.factor))
        seen, approaches = factor_records.record[joints, : factor_records.count], list(approach_channels(kernel.factor))
        lowest, highest = seen.min(axis=1) - _BEYOND, seen.max(axis=1) + _BEYOND
        record[joints] = random.uniform(lowest[:, None], highest[:, None], (len(joints), record.shape[1]))
        record[approaches] = random.choice([-1.0, 1.0], (len(approaches), record.shape[1]))
        weight = (np.arange(record.shape[1]) < count).astype(float)
        result.append(replace(drawn, record=record, weight=weight, state=np.zeros_like(drawn.state)))
    return problem.with_records(result)


def _scaled(problem: Problem, values: Array) -> Array:
    fitting = projected(problem, values)
    can = [mask.astype(float) for mask in fits(fitting, values)]
    return fitting.weighted(can).triangular_factor(values) * problem.parameters.scales()


def _largest(matrix: Array) -> float:
    return float(np.linalg.norm(matrix, 2)) if matrix.size else 0.0


def scale_is_unseen(problem: Problem, values: Array, known: Identifiability) -> bool:
    """Whether some undetermined combination makes all tools' positions grow in proportion.

    Contacts fit a smaller arm in a smaller world just as well. Which numbers take part in a growth differs from model
    to model, so the tools decide; a motion of everything, and another point of a tool, may go along with it.
    """
    if not len(known.null):
        return False
    poses = at_random_poses(problem).subset(np.arange(_POSES, dtype=np.intp))
    at, axes = tools(poses, values)
    moves = [along(poses, values, direction) for direction in known.null]
    growth = (at - at.mean(axis=(0, 2), keepdims=True)).ravel()
    left = apart_from(np.array([move.ravel() for move in moves] + unseen_motions(at, axes)).T, growth[:, None])
    return bool(np.linalg.norm(left) < _GROWTH_LEFT * np.linalg.norm(growth))


def require_solvable(problem: Problem, start: Array) -> tuple[str, ...]:
    """Refuse a problem whose answer would be invented.

    Gives warnings of what is left to priors because the records are too few, or see no scale.
    """
    parameters = problem.parameters
    count = problem.equations()
    unknown = problem.increments
    has_prior = parameters.prior_information() > 0
    warnings = []
    if count < unknown:
        poses = max((record.count for record in problem.records), default=0)
        text = f"{count} equations ({poses} records) for {unknown} free parameters"
        if not has_prior.all():
            raise ProblemError(f"{text}.", hint="Measure more poses, fix parameters, or give every one a prior.")
        warnings.append(f"{text}: what the data does not determine comes from the priors.")
    known = identify(problem, start)
    unseen_scale = scale_is_unseen(problem, start, known)
    if len(unheld(parameters, known)):
        explained = explain(problem, start, known)
        listed = "; ".join(str(undetermined) for undetermined in explained[:MOST_LISTED])
        more = len(explained) - MOST_LISTED
        listed += f"; and {more} more, which armcal identify lists" if more > 0 else ""
        first, mend = (f"{UNSEEN_SCALE}; ", f"{GIVE_A_LENGTH}. ") if unseen_scale else ("", "")
        text = f"{first}the data does not determine {len(explained)} combinations: {listed}."
        raise ProblemError(text, hint=_sentence(f"{mend}{_mend(explained)}"))
    if unseen_scale:
        warnings.append(f"{UNSEEN_SCALE}; its priors hold it. To know it, {GIVE_A_LENGTH}.")
    return tuple(warnings)


def _sentence(text: str) -> str:
    return text[:1].upper() + text[1:]


def _mend(undetermined: Sequence[Undetermined]) -> str:
    causes = {combination.cause for combination in undetermined}
    advice = ["fix one parameter of each", "give it a prior"]
    if "values" in causes:
        advice.append("start from other values")
    if causes & {"poses", "unknown"}:
        advice.append("measure poses that separate them")
    return _sentence(f"{', '.join(advice[:-1])}, or {advice[-1]}.")


_FREED_BY_CHANCE = 0.05  # Of naming any parameter though nothing is to be gained
MOST_UNCERTAIN = 0.5  # In typical scales: what the noise leaves less certain than this is not determined
MOST_FREED = 12
_OWN_SHARE = 1e-6  # Of what a parameter does: less than this beside the free ones is theirs
_SINGULAR = 1e-11


@dataclass(frozen=True)
class Candidate:
    name: str  # of the block of a fixed parameter that the records would determine
    sd: Array  # of its coordinates if it were free, by the residuals found (SI)
    change: Array  # by how much it would move, to first order (SI)
    p_value: float  # that it gains nothing, counting that so many were looked at


def candidates(parameters: Parameters) -> tuple[str, ...]:
    return tuple(
        block.name
        for block in parameters.blocks
        if not (block.free or block.nuisance or isinstance(block.domain, Semidefinite))
        and ".links." not in block.name
        and not block.name.startswith("statics.")
    )


def freeing(wide: Problem, own: Sequence[str], values: Array) -> tuple[tuple[Candidate, ...], tuple[Candidate, ...]]:
    """What is worth freeing, in that order, and what else the records would determine beside it.

    Of all that is free in ``wide`` and not among the ``own`` parameters, at a fit of these alone.
    """
    parameters = wide.parameters
    chain = parameters.entries_jacobian(values) * parameters.scales()
    model = wide.normal_equations(values).chained(chain)
    priors = parameters.prior_information() * parameters.scales() ** 2
    off = parameters.coordinates(parameters.local(values)) / parameters.scales()
    model = NormalEquations(model.cost, model.gradient + priors * off, model.hessian + np.diag(priors))
    places = {name: np.arange(own.start, own.stop) for name, own in parameters.coordinates_of.items()}
    search = _FreeingSearch(model, priors, wide.equations(), parameters.scales())
    taken, left = [i for name in own for i in places[name]], [name for name in places if name not in set(own)]
    gaining, count = list[Candidate](), len(left)
    while left and len(gaining) < MOST_FREED:
        judged = [search.judged(name, places[name], taken, count) for name in left]
        best = min((one for one in judged if one is not None), key=lambda one: one.p_value, default=None)
        if best is None or best.p_value > _FREED_BY_CHANCE:
            break
        gaining.append(best)
        taken.extend(places[best.name])
        left.remove(best.name)
    others = [search.judged(name, places[name], taken, count) for name in left]
    return tuple(gaining), tuple(one for one in others if one is not None)


@dataclass(frozen=True)
class _FreeingSearch:
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
        inverse = np.linalg.pinv(inside / units, rcond=_SINGULAR, hermitian=True) / units  # where they are determined
        across = bends[np.ix_(own, beside)] @ inverse
        spread = bends[np.ix_(own, own)] - across @ bends[np.ix_(beside, own)]
        score = slopes[own] - across @ slopes[beside]
        by_data = spread - np.diag(self.priors[own])
        if np.linalg.eigvalsh(by_data)[0] <= _OWN_SHARE * np.diag(bends)[own].max():
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
