"""The value of a plan as poses enter and leave it: for every candidate at once, by updates of low rank.

A pose brings n_r rows H that enter together. With C the inverse of the information, adding it changes

    C by -C H' (I + H C H')^-1 H C,    log det by log det(I + H C H')    [Fedorov1972]

and H C H' of every other candidate likewise, so that nothing is ever decomposed anew for a candidate.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from typing_extensions import override

from armcal.base.arrays import Array, Indices
from armcal.planning.candidates import Candidates
from armcal.planning.criterion import SMALLEST_DETERMINANT, Criterion, packed_log_det, packed_trace

_REFRESH = 64
_TOLERANCE = 1e-9
_DOUBTFUL = -12.0
"""A removal that takes so much of the log determinant would carry rounding into the inverse."""
SHORTLIST = 512


class Tally(Protocol):
    """A plan in the making. Values are the criterion's, averaged over draws."""

    def restart(self, chosen: Indices) -> None:
        """Begin anew with these."""

    def add(self, candidate: int) -> None:
        """Let one in."""

    def remove(self, candidate: int) -> None:
        """Take one out."""

    def if_added(self) -> Array:
        """The change of value with each candidate let in (N)."""

    def if_removed(self, chosen: Indices) -> Array:
        """The change of value without each of these."""

    def if_swapped(self, candidate: int) -> Array:
        """The change of value with each candidate instead of this one (N)."""

    def tolerance(self) -> float:
        """Changes below it may be rounding."""


def tally(candidates: Candidates, criterion: Criterion) -> Tally:
    if criterion.name in ("D", "A"):
        kind = DeterminantTally if criterion.name == "D" else TraceTally
        draws = zip(candidates.base, candidates.rows, strict=True)
        return MeanTally([kind(Candidates(base[None], rows[None])) for base, rows in draws])
    return SpectralTally(candidates, criterion)


class MeanTally(Tally):
    """The mean over draws."""

    def __init__(self, parts: list[DeterminantTally]) -> None:
        self._parts = parts

    @override
    def restart(self, chosen: Indices) -> None:
        for part in self._parts:
            part.restart(chosen)

    @override
    def add(self, candidate: int) -> None:
        for part in self._parts:
            part.add(candidate)

    @override
    def remove(self, candidate: int) -> None:
        for part in self._parts:
            part.remove(candidate)

    @override
    def if_added(self) -> Array:
        return self._mean([part.if_added() for part in self._parts])

    @override
    def if_removed(self, chosen: Indices) -> Array:
        return self._mean([part.if_removed(chosen) for part in self._parts])

    @override
    def if_swapped(self, candidate: int) -> Array:
        return self._mean([part.if_swapped(candidate) for part in self._parts])

    @override
    def tolerance(self) -> float:
        return max(part.tolerance() for part in self._parts)

    @staticmethod
    def _mean(parts: list[Array]) -> Array:
        return parts[0] if len(parts) == 1 else np.asarray(np.mean(parts, axis=0))


class DeterminantTally(Tally):
    """Log determinant, at one draw. Symmetric n_r x n_r matrices of all candidates are kept packed (pairs x N)."""

    def __init__(self, candidates: Candidates) -> None:
        self._candidates = candidates
        self._n_rows, self._count, self._size = candidates.rows.shape[1:]
        self._flat = np.ascontiguousarray(candidates.rows[0].reshape(-1, self._size))
        self._left, self._right = np.triu_indices(self._n_rows)
        self._known = candidates.known()[0] + candidates.ridge() * np.eye(self._size)
        self.restart(np.zeros(0, dtype=np.intp))

    @override
    def restart(self, chosen: Indices) -> None:
        rows = self._candidates.rows[0][:, chosen, :].reshape(-1, self._size)
        self._settle(self._known + rows.T @ rows)

    @override
    def add(self, candidate: int) -> None:
        self._change(candidate, 1.0)

    @override
    def remove(self, candidate: int) -> None:
        self._change(candidate, -1.0)

    @override
    def if_added(self) -> Array:
        return packed_log_det(self._seen, self._n_rows)  # log det(I + H C H')

    @override
    def if_removed(self, chosen: Indices) -> Array:
        return packed_log_det(-self._seen[:, chosen], self._n_rows)  # log det(I - H C H')

    @override
    def if_swapped(self, candidate: int) -> Array:
        loss = self.if_removed(np.array([candidate]))[0]
        half, _ = self._half(candidate, -1.0)
        return packed_log_det(self._seen + self._outer(half, half), self._n_rows) + float(loss)

    @override
    def tolerance(self) -> float:
        return _TOLERANCE

    def _settle(self, information: Array) -> None:
        self._information, self._changes = information, 0
        self._inverse = np.linalg.inv(information)
        self._inverse = (self._inverse + self._inverse.T) / 2
        reached = (self._flat @ self._inverse).reshape(self._n_rows, self._count, -1)
        rows = self._candidates.rows[0]
        pairs = zip(self._left, self._right, strict=True)
        self._seen = np.array([np.einsum("ij,ij->i", reached[a], rows[b]) for a, b in pairs])

    def _change(self, candidate: int, sign: float) -> None:
        rows = self._rows_of(candidate)
        information = self._information + sign * (rows.T @ rows)
        doubtful = sign < 0 and float(packed_log_det(-self._seen[:, [candidate]], self._n_rows)[0]) < _DOUBTFUL
        if doubtful or self._changes >= _REFRESH:
            self._settle(information)
            return
        half, factor = self._half(candidate, sign)
        self._advance(half, factor, sign)
        self._information, self._changes = information, self._changes + 1

    def _advance(self, half: Array, factor: Array, sign: float) -> None:
        self._seen = self._seen - sign * self._outer(half, half)
        self._inverse = self._inverse - sign * (factor @ factor.T)

    def _rows_of(self, candidate: int) -> Array:
        return self._flat[candidate :: self._count]

    def _half(self, candidate: int, sign: float) -> tuple[Array, Array]:
        """W (n_r x n_r x N) and Y (n x n_r) with which H C H' changes by -sign W'W and C by -sign Y Y'."""
        rows = self._rows_of(candidate)
        reached = self._inverse @ rows.T
        middle = np.eye(self._n_rows) + sign * (rows @ reached)
        values, vectors = np.linalg.eigh((middle + middle.T) / 2)
        factor = reached @ (vectors / np.sqrt(np.maximum(values, SMALLEST_DETERMINANT)))
        return self._across(factor), factor

    def _across(self, factor: Array) -> Array:
        """factor' H' of every candidate (columns x n_r x N)."""
        return np.asarray((factor.T @ self._flat.T).reshape(-1, self._n_rows, self._count))

    def _outer(self, first: Array, second: Array) -> Array:
        total = first[0][self._left] * second[0][self._right]
        for a, b in zip(first[1:], second[1:], strict=True):
            total += a[self._left] * b[self._right]
        return np.asarray(total)


class TraceTally(DeterminantTally):
    """Minus the trace of the covariance, at one draw; H C^2 H' is kept beside H C H'."""

    @override
    def if_added(self) -> Array:
        return packed_trace(self._seen, self._squared, self._n_rows)  # tr (I + H C H')^-1 H C^2 H'

    @override
    def if_removed(self, chosen: Indices) -> Array:
        return -packed_trace(-self._seen[:, chosen], self._squared[:, chosen], self._n_rows)

    @override
    def if_swapped(self, candidate: int) -> Array:
        loss = self.if_removed(np.array([candidate]))[0]
        half, factor = self._half(candidate, -1.0)
        seen = self._seen + self._outer(half, half)
        squared = self._squared_after(half, factor, -1.0)
        return packed_trace(seen, squared, self._n_rows) + float(loss)

    @override
    def tolerance(self) -> float:
        return _TOLERANCE * float(np.trace(self._inverse))

    def _settle(self, information: Array) -> None:
        super()._settle(information)
        reached = (self._flat @ self._inverse).reshape(self._n_rows, self._count, -1)
        pairs = zip(self._left, self._right, strict=True)
        self._squared = np.array([np.einsum("ij,ij->i", reached[a], reached[b]) for a, b in pairs])

    def _advance(self, half: Array, factor: Array, sign: float) -> None:
        self._squared = self._squared_after(half, factor, sign)
        super()._advance(half, factor, sign)

    def _squared_after(self, half: Array, factor: Array, sign: float) -> Array:
        """H (C - sign Y Y')^2 H' from H C^2 H'."""
        twice = self._across(self._inverse @ factor)
        mixed = np.tensordot(factor.T @ factor, half, axes=1)
        cross = self._outer(twice, half) + self._outer(half, twice)
        return np.asarray(self._squared - sign * cross + self._outer(mixed, half))


class SpectralTally(Tally):
    """Any function of eigenvalues, by decomposition; beyond ``SHORTLIST`` candidates, of those that promise most."""

    def __init__(self, candidates: Candidates, criterion: Criterion) -> None:
        self._candidates, self._criterion = candidates, criterion
        self._known = candidates.known() + candidates.ridge() * np.eye(candidates.size)
        self.restart(np.zeros(0, dtype=np.intp))

    @override
    def restart(self, chosen: Indices) -> None:
        rows = self._candidates.rows[:, :, chosen, :].reshape(self._candidates.draws, -1, self._candidates.size)
        self._settle(self._known + np.swapaxes(rows, 1, 2) @ rows)

    @override
    def add(self, candidate: int) -> None:
        self._settle(self._information + self._of(np.array([candidate]))[:, 0])

    @override
    def remove(self, candidate: int) -> None:
        self._settle(self._information - self._of(np.array([candidate]))[:, 0])

    @override
    def if_added(self) -> Array:
        return self._tried(self._information)

    @override
    def if_removed(self, chosen: Indices) -> Array:
        return self._values(self._information[:, None] - self._of(chosen)) - self._value

    @override
    def if_swapped(self, candidate: int) -> Array:
        return self._tried(self._information - self._of(np.array([candidate]))[:, 0])

    @override
    def tolerance(self) -> float:
        return _TOLERANCE * abs(self._value)

    def _settle(self, information: Array) -> None:
        self._information = (information + np.swapaxes(information, 1, 2)) / 2
        self._value = float(self._values(self._information[:, None])[0])

    def _values(self, information: Array) -> Array:
        return np.asarray(np.mean(self._criterion.of(information), axis=0))

    def _of(self, chosen: Indices) -> Array:
        rows = self._candidates.rows[:, :, chosen, :]
        return np.asarray(np.einsum("krci,krcj->kcij", rows, rows, optimize=True))

    def _tried(self, information: Array) -> Array:
        count = self._candidates.count
        change = np.full(count, -np.inf)
        few = np.arange(count)
        if count > SHORTLIST:  # those that add most along the directions that are least determined
            values, vectors = np.linalg.eigh(information)
            weight = np.maximum(values, 1e-12 * values[:, -1:]) ** -2.0
            scores = self._candidates.scores((vectors * weight[:, None, :]) @ np.swapaxes(vectors, 1, 2))
            few = np.argpartition(-scores, SHORTLIST)[:SHORTLIST].astype(np.intp)
        change[few] = self._values(information[:, None] + self._of(few)) - self._value
        return change
