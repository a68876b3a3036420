"""What structure is left in the residuals of a calibration, how much of the error it is, and what would tell.

Dependences are tested all at once (family-wise 5 %). The one that says most for its size [Schwarz1978] is taken into
the model, to first order, and the others are tested again on what is left: so each is named for what the ones before
it do not say. Residuals are those of training, less the drift that was found; what the parameters can take up, each
dependence is freed of first.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.units import display_unit, to_unit
from armcal.solve.blocks import automatic_block_length
from armcal.solve.dependences import Dependence, dependences
from armcal.solve.estimator import Estimate
from armcal.solve.fit_rows import FitRows
from armcal.solve.motion import Motion
from armcal.solve.neighbours import Alikeness, alikeness
from armcal.solve.problem import FactorRecords, Problem
from armcal.solve.score_tests import FamilyTest, Fit, family_test, linear_fit, own_basis

LEVEL = 0.05
MOST_FOUND = 5
WORTHWHILE = 0.01
MOST_RECORDS = 1000
FEWEST_RECORDS = 30
_MOST_BLOCKS, _FEWEST_BLOCKS = 60, 30
_FOLDS = 5
_MM = 1000.0
_MOST_ALIKE = 3
_ALIKE, _SPENT = 0.7, 0.3
"""Another dependence says the same if it takes up 70 % as much, and 30 % of that once the first is in the model."""


@dataclass(frozen=True)
class Structure:
    """A dependence that was found.

    Attributes:
        kind, subject, words, effect, measure: as in ``Dependence``.
        p_value: that the residuals do not depend on it, family-wise.
        share: of the squared residuals left by the ones before it.
        falls_mm: by how much the mean error would fall if it were modelled, judged on records left out.
        size: how large it is, in words; empty if its coefficients have no unit.
        alternatives: dependences that would say nearly the same; only a measurement can tell.
    """

    kind: str
    subject: str
    words: str
    effect: str
    measure: str
    p_value: float
    share: float
    falls_mm: float
    size: str
    alternatives: tuple[str, ...]


@dataclass(frozen=True)
class Leftover:
    """What the residuals of a fit still depend on.

    Attributes:
        structures: in the order in which they were taken into the model.
        more: whether something was significant still when the search ended.
        lag_one: correlation of neighbouring residuals, less what the fit itself makes of it.
        lag_p: its p-value, in the same family.
        lag_after, lag_after_p: the same once the structures found are modelled.
        alike: why neighbours resemble each other even then; None if they do not, or there are too few pairs.
        mean_mm: mean residual of the training records.
        tested: how many dependences were tested.
        records: how many records were looked at.
        block: how many neighbours count as one observation.
        level: family-wise.
    """

    structures: tuple[Structure, ...]
    more: bool
    lag_one: float
    lag_p: float
    lag_after: float
    lag_after_p: float
    alike: Alikeness | None
    mean_mm: float
    tested: int
    records: int
    block: int
    level: float = LEVEL

    @property
    def worthwhile(self) -> tuple[Structure, ...]:
        """Those that would lower the mean error by a hundredth of it."""
        return tuple(s for s in self.structures if s.falls_mm >= WORTHWHILE * self.mean_mm)

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        return asdict(self)


def leftover(
    problem: Problem,
    records: Sequence[FactorRecords],
    estimate: Estimate,
    dataset: Dataset,
    motion: Motion,
    position: NDArray[np.intp],
    modelled: frozenset[str] = frozenset(),
) -> Leftover | None:
    """Test the residuals of a fit.

    Args:
        problem: of the fit.
        records: it was fitted to, with the weights they had.
        estimate: what it found.
        dataset: the same records.
        motion: how the arm stands in them.
        position: how many of all records were recorded before each (N).
        modelled: the types of the effects that the model has.

    Returns:
        None where there are too few records to tell.
    """
    taking_part = np.any([each.weight[: each.count] > 0 for each in records], axis=0)
    chosen = _looked_at(np.flatnonzero(taking_part), position)
    if len(chosen) < FEWEST_RECORDS:
        return None
    records, dataset, position = problem.subset(records, chosen), dataset.subset(chosen), position[chosen]
    rows = FitRows.of(problem, records, estimate)
    block, consecutive = _blocks_of(rows, len(dataset)), np.diff(position) == 1
    fit, basis = _fit_of(rows, block, consecutive)
    found = _search(rows, fit, basis, list(dependences(problem, motion.subset(chosen), dataset)), modelled)
    return Leftover(
        found.structures,
        found.more,
        found.first.lag_one,
        found.first.lag_adjusted,
        found.last.lag_one,
        found.last.lag_adjusted,
        _alike(found, rows, problem.increments, consecutive, block),
        rows.mean_error(fit.residual) * _MM,
        found.tested,
        len(dataset),
        int(np.bincount(block).max()),
    )


def _alike(
    found: _Search, rows: FitRows, count: int, consecutive: NDArray[np.bool_], block: NDArray[np.intp]
) -> Alikeness | None:
    if found.last.lag_adjusted > LEVEL:
        return None
    return alikeness(found.residual[rows.by_record], rows.stance(count), consecutive, block)


def _fit_of(rows: FitRows, block: NDArray[np.intp], consecutive: NDArray[np.bool_]) -> tuple[Fit, Array]:
    """The rows of priors and drifts are dealt out to the blocks in turn."""
    extra = np.arange(len(rows.residual) - len(rows.record_of)) % (block.max() + 1)
    row_block = np.concatenate([block[rows.record_of], extra]).astype(np.intp)
    return linear_fit(rows.slopes, rows.residual, row_block, rows.by_record, consecutive)


def _looked_at(candidates: NDArray[np.intp], position: NDArray[np.intp]) -> NDArray[np.intp]:
    """In recorded order; of very many, runs of neighbours spread over the recording."""
    order = candidates[np.argsort(position[candidates], kind="stable")]
    if len(order) <= MOST_RECORDS:
        return order
    runs = np.array_split(order, 2 * len(order) // MOST_RECORDS)
    most = MOST_RECORDS // len(runs)
    return np.concatenate([run[:most] for run in runs])


def _blocks_of(rows: FitRows, count: int) -> NDArray[np.intp]:
    """Of each record: as long as errors resemble their neighbours', and neither too many nor too few."""
    series = rows.residual[rows.by_record].T
    length = min(automatic_block_length(series), max(1, count // _FEWEST_BLOCKS))
    length = max(length, -(-count // _MOST_BLOCKS))
    return (np.arange(count) // length).astype(np.intp)


@dataclass(frozen=True)
class _Search:
    structures: tuple[Structure, ...]
    more: bool
    first: FamilyTest
    last: FamilyTest
    tested: int
    residual: Array


def _search(
    rows: FitRows, fit: Fit, basis: Array, candidates: Sequence[Dependence], modelled: frozenset[str]
) -> _Search:
    columns = [rows.columns(one.columns) for one in candidates]
    owned = [own_basis(each, basis) for each in columns]
    left = [(i, *own) for i, own in enumerate(owned) if own[0].shape[1]]
    first = test = family_test(fit, [own for _, own, _ in left])
    tested, structures = len(left), list[Structure]()
    while len(structures) < MOST_FOUND:
        chosen = _best(test, [own.shape[1] for _, own, _ in left], fit)
        if chosen is None:
            break
        before, (index, own, coefficients) = test, left[chosen]
        size = _size(candidates[index], -coefficients @ (own.T @ fit.residual))
        falls = rows.mean_error(fit.residual) - rows.mean_error(_left_out(fit, own))
        fit, basis = fit.with_fewer_draws().without(own), np.hstack([basis, own])
        past = [i for i, _, _ in left]
        left = [each for each in ((i, *own_basis(columns[i], basis)) for i in past) if each[1].shape[1]]
        test = family_test(fit, [own for _, own, _ in left])
        same = _saying_the_same(dict(zip(past, before.share, strict=True)), _shares(left, test), index)
        numbers = (float(before.adjusted[chosen]), float(before.share[chosen]), max(0.0, falls) * _MM)
        told = tuple(candidates[i].words for i in same)
        structures.append(_structure(candidates[index], numbers, size, told, modelled))
    return _Search(tuple(structures), bool(np.any(test.adjusted <= LEVEL)), first, test, tested, fit.residual)


def _shares(left: Sequence[tuple[int, Array, Array]], test: FamilyTest) -> dict[int, float]:
    return {i: float(share) for (i, _, _), share in zip(left, test.share, strict=True)}


def _saying_the_same(before: dict[int, float], after: dict[int, float], chosen: int) -> list[int]:
    """What took up nearly as much as the chosen one, and takes up little beside it."""
    taken = before[chosen]
    left = {i: after.get(i, 0.0) * (1 - taken) for i in before}
    same = [i for i, share in before.items() if i != chosen and share >= _ALIKE * taken and left[i] < _SPENT * share]
    return sorted(same, key=lambda i: -before[i])[:_MOST_ALIKE]


def _structure(
    one: Dependence, numbers: tuple[float, float, float], size: str, same: tuple[str, ...], modelled: frozenset[str]
) -> Structure:
    present = one.effect.split(" ")[0] in modelled
    effect = f"{one.effect} (it is in the model: free it, or loosen its prior)" if present else one.effect
    return Structure(one.kind, one.subject, one.words, effect, one.measure, *numbers, size, same)


def _best(test: FamilyTest, sizes: Sequence[int], fit: Fit) -> int | None:
    """Among the significant ones the one with the least Bayesian information criterion, blocks counting as one."""
    significant = np.flatnonzero(test.adjusted <= LEVEL)
    if not len(significant):
        return None
    count = fit.blocks * fit.records.shape[1]
    size = np.array(sizes)[significant]
    left = np.maximum(1 - test.share[significant], 1e-12)
    return int(significant[np.argmin(count * np.log(left) + size * np.log(count))])


def _left_out(fit: Fit, own: Array) -> Array:
    """The residual less what a dependence takes up, its coefficients found without the records that are judged."""
    fold = np.where(fit.block >= 0, fit.block * _FOLDS // fit.blocks, 0)
    left = fit.residual.copy()
    for number in range(_FOLDS):
        judged = fold == number
        gram = own[~judged].T @ own[~judged]
        ridge = 1e-9 * max(float(np.trace(gram)), 1e-300) * np.eye(len(gram))
        coefficients = np.linalg.solve(gram + ridge, own[~judged].T @ fit.residual[~judged])
        left[judged] -= own[judged] @ coefficients
    return left


def _size(one: Dependence, coefficients: Array) -> str:
    """The largest coefficient in a customary unit."""
    if not one.labels or not one.unit:
        return ""
    unit = {"rad": display_unit("angle"), "m": display_unit("length")}.get(one.unit)
    largest = int(np.argmax(np.abs(coefficients)))
    number = float(coefficients[largest])
    shown = f"{to_unit(number, unit.name):.2g} {unit.name}" if unit else f"{number:.2g} {one.unit}"
    if len(one.labels) > 1:
        return f"{shown} off at {one.labels[largest]}, beside its other levels"
    return f"{one.labels[0]}: {shown}"
