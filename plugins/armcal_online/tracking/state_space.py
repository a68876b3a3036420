"""Scaled coordinates about a value vector, and back: the space of a belief about parameters.

Numbers between bounds and entries of semidefinite matrices are moved as they are, even out of their domain: the belief
stays the Gaussian that the records make, and only what is taken from it is brought inside (see ``inside`` and
``belief.most_likely``). Rotations, poses and screw axes are moved within their domain.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from armcal.base.arrays import Array, Indices
from armcal.base.domains import Interval, Semidefinite, symmetric
from armcal.base.parameters import ParameterBlock, Parameters

_ENTRIES = np.triu_indices(3)


@dataclass(frozen=True)
class StateSpace:
    """The free parameters of a problem as scaled coordinates (n)."""

    parameters: Parameters

    @cached_property
    def scales(self) -> Array:
        """The typical scale of each coordinate (n)."""
        return self.parameters.scales()

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the coordinates (n)."""
        return self.parameters.coordinate_names

    @cached_property
    def entries(self) -> Indices:
        return np.array(self.parameters.free_entries, dtype=np.intp)

    @cached_property
    def _blocks(self) -> tuple[tuple[ParameterBlock, slice, slice], ...]:
        own = self.parameters
        return tuple((block, own.entries_of(block.name), own.coordinates_of[block.name]) for block in own.free)

    @cached_property
    def _turning(self) -> tuple[tuple[ParameterBlock, slice, slice], ...]:
        return tuple(b for b in self._blocks if not isinstance(b[0].domain, (Interval, Semidefinite)))

    @cached_property
    def _adding(self) -> tuple[Indices, Indices]:
        adding = [b for b in self._blocks if isinstance(b[0].domain, (Interval, Semidefinite))]
        return _positions(entries for _, entries, _ in adding), _positions(coordinates for _, _, coordinates in adding)

    def moved(self, values: Array, point: Array) -> Array:
        """The value vector at scaled coordinates (n) about another."""
        step = point * self.scales
        moved = values.copy()
        at, of = self._adding
        moved[at] += step[of]
        for block, entries, coordinates in self._turning:
            moved[entries] = block.domain.retract(values[entries], step[coordinates])
        return moved

    def between(self, values: Array, other: Array) -> Array:
        """Scaled coordinates (n) about ``values`` at which ``other`` lies; the inverse of ``moved``."""
        step = np.zeros(len(self.scales))
        at, of = self._adding
        step[of] = other[at] - values[at]
        for block, entries, coordinates in self._turning:
            step[coordinates] = block.domain.local(values[entries], other[entries])
        return step / self.scales

    def left(self, values: Array, point: Array, origin: Array) -> Array:
        """Scaled coordinates about another origin of a point (n) about ``values``; numbers may be out of domain."""
        left = point - self.between(values, origin)
        for block, entries, coordinates in self._turning:
            there = block.domain.retract(values[entries], point[coordinates] * self.scales[coordinates])
            left[coordinates] = block.domain.local(origin[entries], there) / self.scales[coordinates]
        return left

    def by_coordinates(self, values: Array, jacobian: Array) -> Array:
        chain = self.chain(values)
        return np.asarray(jacobian * self.scales if chain is None else jacobian @ chain)

    def chain(self, values: Array) -> Array | None:
        """d free entries / d scaled coordinates at a value vector; None where it is the scales alone."""
        if not self._turning:
            return None
        whole = np.zeros((len(self.entries), len(self.scales)))
        place = {entry: row for row, entry in enumerate(self.entries)}
        at, of = self._adding
        whole[[place[entry] for entry in at], of] = 1.0
        for block, entries, coordinates in self._turning:
            rows = slice(place[entries.start], place[entries.start] + block.size)
            whole[rows, coordinates] = block.domain.retract_jacobian(values[entries], np.zeros(block.domain.dof))
        return whole * self.scales

    def of_entries(self, values: Array, covariance: Array) -> Array:
        """A covariance of the free entries as one of scaled coordinates (n x n)."""
        chain = self.chain(values)
        if chain is None:
            return np.asarray(covariance / np.outer(self.scales, self.scales))
        inverse = np.linalg.pinv(chain)
        return np.asarray(inverse @ covariance @ inverse.T)

    def to_entries(self, values: Array, covariance: Array) -> Array:
        chain = self.chain(values)
        if chain is None:
            return np.asarray(covariance * np.outer(self.scales, self.scales))
        return np.asarray(chain @ covariance @ chain.T)

    @cached_property
    def cones(self) -> tuple[tuple[slice, slice], ...]:
        return tuple((e, c) for block, e, c in self._blocks if isinstance(block.domain, Semidefinite))

    @cached_property
    def bounds(self) -> tuple[Indices, Indices, Array, Array]:
        """Of numbers with bounds: places in a value vector and among the coordinates, lower and upper bounds."""
        bounded = [
            (entries.start, coordinates.start, block.domain.lower, block.domain.upper)
            for block, entries, coordinates in self._blocks
            if isinstance(block.domain, Interval) and np.isfinite([block.domain.lower, block.domain.upper]).any()
        ]
        entry, coordinate, lower, upper = zip(*bounded, strict=True) if bounded else ((), (), (), ())
        return np.array(entry, dtype=np.intp), np.array(coordinate, dtype=np.intp), np.array(lower), np.array(upper)

    def inside(self, values: Array) -> Array:
        """The nearest values within the domains, each block by itself: where the model can be evaluated."""
        place, _, lower, upper = self.bounds
        near = values.copy()
        if len(place):
            near[place] = np.minimum(np.maximum(values[place], lower), upper)
        if len(self._matrices):
            near[self._matrices] = nearest_semidefinite(values[self._matrices])
        return near

    @cached_property
    def _matrices(self) -> Indices:
        """Of semidefinite blocks, the places of their entries in a value vector (blocks x 6)."""
        return _positions(entries for entries, _ in self.cones).reshape(-1, 6)


def _positions(slices: Iterable[slice]) -> Indices:
    return np.array([i for places in slices for i in range(places.start, places.stop)], dtype=np.intp)


def nearest_semidefinite(entries: Array) -> Array:
    """The entries (... x 6) of the nearest semidefinite matrices [Higham1989]; those of such matrices as they are."""
    size, directions = np.linalg.eigh(symmetric(entries))
    outside = size[..., 0] < 0
    if not outside.any():
        return entries
    nearest = (directions * np.maximum(size, 0.0)[..., None, :]) @ np.swapaxes(directions, -1, -2)
    return np.where(outside[..., None], nearest[..., _ENTRIES[0], _ENTRIES[1]], entries)
