"""A minimal set of parameters: which to keep free, and what absorbs each of the others.

QR with column pivoting on the scaled Jacobian [Golub2013], block by block, preferred blocks first; the way in which
base parameters are found numerically [Khalil2002].
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.estimate.combination import Combination, named
from armcal.estimate.identifiability import RANK_TOLERANCE, measures_of

_NAMED = 1e-4
_NEW = 1e-6
"""Of a column's own length: less than this beyond what is kept adds nothing."""


@dataclass(frozen=True)
class Dropped:
    """A coordinate that need not be free.

    Attributes:
        name: of the coordinate.
        absorbed_by: it first, then what the kept ones do instead: the combination that changes no measurement.
        left: the part of its effect that the kept ones cannot imitate, 0 to 1.
    """

    name: str
    absorbed_by: Combination
    left: float


@dataclass(frozen=True)
class MinimalSet:
    """Which blocks to free.

    Attributes:
        kept: block names, in the order of the parameters.
        redundant: coordinates that the kept ones absorb entirely.
        left_out: coordinates that would add something, but were not wanted (too many, or too uncertain).
        deviations: of the kept coordinates, in typical scales, by the declared noise; infinite where a kept block
            has an undetermined combination within it.
    """

    kept: tuple[str, ...]
    redundant: tuple[Dropped, ...]
    left_out: tuple[Dropped, ...]
    deviations: dict[str, float]


def minimal_set(
    triangle: Array,
    parameters: Parameters,
    preferred: Sequence[Sequence[str]] = (),
    most: int | None = None,
    most_uncertain: float = np.inf,
) -> MinimalSet:
    """Choose blocks that determine all that the data determines, and no more.

    Free parameters of groups, sockets and clamps, are tried first: a configuration has them free without naming them.

    Args:
        triangle: R (m x n) with R'R = J'J of the whitened residuals by the coordinates of the free blocks.
        parameters: whose free blocks are chosen from.
        preferred: block names; those of the first group are tried first, then those of the second, and so on.
        most: no more blocks than this.
        most_uncertain: leave out, the most uncertain first, what stays uncertain by more than so many typical scales.
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
    if not len(inside):
        return deviation
    _, values, directions = np.linalg.svd(columns[:, inside], full_matrices=True)
    values = np.concatenate([values, np.zeros(len(inside) - len(values))])
    seen = values > RANK_TOLERANCE * values[0]
    known = np.sqrt(np.sum((directions[seen] / values[seen][:, None]) ** 2, axis=0))
    blurred = np.linalg.norm(directions[~seen], axis=0) > 1e-6
    deviation[inside] = np.where(blurred, np.inf, known)
    return deviation
