"""Scaled coordinates about a value vector, and back: where a belief over parameters lives.

Numbers between bounds and entries of semidefinite matrices are moved as they are, even out of their domain: the belief
stays the Gaussian that the records make, and only what is taken from it is brought inside (see ``inside`` and
``projection``). Rotations, poses and screw axes are moved within their domain.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from armcal.base.domains import Array, Interval, Semidefinite, symmetric
from armcal.base.parameters import ParameterBlock, Parameters
from numpy.typing import NDArray

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
        """A name for each coordinate."""
        return self.parameters.coordinate_names

    @cached_property
    def entries(self) -> NDArray[np.intp]:
        """Positions of the free entries in a value vector."""
        return np.array(self.parameters.free_entries, dtype=np.intp)

    @cached_property
    def _turning(self) -> tuple[tuple[ParameterBlock, slice, slice], ...]:
        """Blocks that do not just add, with their places in a value vector and among the coordinates."""
        found, start = [], 0
        for block in self.parameters.free:
            if not isinstance(block.domain, (Interval, Semidefinite)):
                place = self.parameters.entries_of(block.name)
                found.append((block, place, slice(start, start + block.domain.dof)))
            start += block.domain.dof
        return tuple(found)

    @cached_property
    def _adding(self) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
        """Positions in a value vector, and among the coordinates, of numbers that add."""
        of_values, of_coordinates, start = [], [], 0
        for block in self.parameters.free:
            if isinstance(block.domain, (Interval, Semidefinite)):
                of_values += [*range(*self.parameters.entries_of(block.name).indices(1 << 30))]
                of_coordinates += [*range(start, start + block.domain.dof)]
            start += block.domain.dof
        return np.array(of_values, dtype=np.intp), np.array(of_coordinates, dtype=np.intp)

    def moved(self, values: Array, place: Array) -> Array:
        """The value vector at scaled coordinates (n) about another."""
        step = place * self.scales
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

    def left(self, values: Array, place: Array, origin: Array) -> Array:
        """Scaled coordinates about another origin of a place (n) about ``values``; numbers may be out of domain."""
        left = place - self.between(values, origin)
        for block, entries, coordinates in self._turning:
            there = block.domain.retract(values[entries], place[coordinates] * self.scales[coordinates])
            left[coordinates] = block.domain.local(origin[entries], there) / self.scales[coordinates]
        return left

    def by_coordinates(self, values: Array, jacobian: Array) -> Array:
        """A Jacobian by free entries at a value vector (m x n_v) as one by scaled coordinates (m x n)."""
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
        """A covariance of scaled coordinates as one of the free entries."""
        chain = self.chain(values)
        if chain is None:
            return np.asarray(covariance * np.outer(self.scales, self.scales))
        return np.asarray(chain @ covariance @ chain.T)

    @cached_property
    def cones(self) -> tuple[tuple[slice, slice], ...]:
        """Of semidefinite blocks, the places in a value vector and among the coordinates."""
        found, start = [], 0
        for block in self.parameters.free:
            if isinstance(block.domain, Semidefinite):
                found.append((self.parameters.entries_of(block.name), slice(start, start + 6)))
            start += block.domain.dof
        return tuple(found)

    @cached_property
    def bounds(self) -> tuple[NDArray[np.intp], NDArray[np.intp], Array, Array]:
        """Of numbers with bounds: places in a value vector and among the coordinates, lower and upper ones."""
        found, start = [], 0
        for b in self.parameters.free:
            if isinstance(b.domain, Interval) and (np.isfinite(b.domain.lower) or np.isfinite(b.domain.upper)):
                found.append((self.parameters.entries_of(b.name).start, start, b.domain.lower, b.domain.upper))
            start += b.domain.dof
        place, coordinate, lower, upper = zip(*found, strict=True) if found else ((), (), (), ())
        return np.array(place, dtype=np.intp), np.array(coordinate, dtype=np.intp), np.array(lower), np.array(upper)

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
    def _matrices(self) -> NDArray[np.intp]:
        """Of semidefinite blocks, the places of their entries in a value vector (blocks x 6)."""
        return np.array([range(*entries.indices(1 << 30)) for entries, _ in self.cones], dtype=np.intp)


def nearest_semidefinite(entries: Array) -> Array:
    """The entries (... x 6) of the nearest semidefinite matrices [Higham1989]; those of such matrices as they are."""
    size, directions = np.linalg.eigh(symmetric(entries))
    outside = size[..., 0] < 0
    if not outside.any():
        return entries
    nearest = (directions * np.maximum(size, 0.0)[..., None, :]) @ np.swapaxes(directions, -1, -2)
    return np.where(outside[..., None], nearest[..., _ENTRIES[0], _ENTRIES[1]], entries)
