"""A belief about an arm, and the most likely values that it allows.

The belief stays the Gaussian that the records make, even beyond bounds: to cut it off at a bound after each record
would count the bound as evidence, again and again. What is handed out is its most likely point within the bounds,
where a fit of all records at once would end, to first order; the covariance is not touched. [Simon2010]

Between records parameters walk at random, and Gauss-Markov states beside them change: stationary processes of unit
standard deviation whose correlation falls by e over a distance (Ornstein-Uhlenbeck [Rasmussen2006]), in records or in
time, coordinates of the belief after those of the parameters. One that is a drift moves a parameter; one of a shared
error, the part of the model's error that neighbouring records have in common, shifts what an instrument reads.

Scaled coordinates about a value vector, and back: the space of a belief about parameters.

Numbers between bounds and entries of semidefinite matrices are moved as they are, even out of their domain: the belief
stays the Gaussian that the records make, and only what is taken from it is brought inside (see ``inside`` and
``belief.most_likely``). Rotations, poses and screw axes are moved within their domain.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from armcal.base.arrays import Array, Indices
from armcal.base.domains import Interval, Semidefinite, symmetric
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.units import amount_in_time
from armcal.config.selection import quantity
from armcal.errors import ConfigError, Location
from armcal.estimate.online import Gaussian, checked
from armcal.problem.records import kept, passed_on
from scipy.optimize import lsq_linear

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


_FLOOR = 1e-14


@dataclass(frozen=True)
class Belief:
    """A Gaussian in scaled coordinates about a value vector: those of the parameters, then the Gauss-Markov states.

    ``origin`` lies within all domains: there the model is evaluated. The mean is off it where the records alone would
    leave the domains.
    """

    origin: Array
    gaussian: Gaussian

    def values(self, space: StateSpace) -> Array:
        return space.moved(self.origin, self.gaussian.mean[: len(space.scales)])

    def updated(self, space: StateSpace, posterior: Gaussian) -> Belief:
        n = len(space.scales)
        step = posterior.mean[:n] - self.gaussian.mean[:n]
        return Belief(self.origin, posterior).about(space, space.inside(space.moved(self.origin, step)))

    def about(self, space: StateSpace, origin: Array) -> Belief:
        n, mean = len(space.scales), self.gaussian.mean.copy()
        mean[:n] = space.left(self.origin, mean[:n], origin)
        return Belief(origin, Gaussian(mean, self.gaussian.covariance))

    def widened(self, count: int, factor: float) -> Belief:
        """The belief with the standard deviations of its first ``count`` coordinates multiplied."""
        scale = np.ones(len(self.gaussian.mean))
        scale[:count] = factor
        return Belief(self.origin, Gaussian(self.gaussian.mean, self.gaussian.covariance * scale[:, None] * scale))


def most_likely(space: StateSpace, belief: Belief) -> Array:
    """The most likely value vector within all domains."""
    values = belief.values(space)
    if np.array_equal(space.inside(values), values):
        return values
    n = len(space.scales)
    covariance = belief.gaussian.covariance[:n, :n]
    # Coordinates with bounds, then those of semidefinite matrices.
    entries, coordinates, lower, upper = space.bounds
    limited = np.concatenate([coordinates, *(np.arange(c.start, c.stop) for _, c in space.cones)]).astype(np.intp)
    scales = space.scales[limited]
    given = np.concatenate([values[entries], *(values[e] for e, _ in space.cones)]) / scales
    ends = lower / scales[: len(entries)], upper / scales[: len(entries)]
    # The nearest point in the metric of the belief.
    own = covariance[np.ix_(limited, limited)]
    size, directions = np.linalg.eigh(own)
    root = (directions / np.sqrt(np.maximum(size, _FLOOR * size[-1]))).T
    if space.cones:
        nearest = _nearest_in_cones(root, given, ends, scales[len(entries) :])
    else:
        nearest = np.array(lsq_linear(root, root @ given, ends, tol=1e-12).x, dtype=float)
    shift = nearest - given
    moved: Array = np.asarray(covariance[:, limited] @ np.linalg.lstsq(own, shift, rcond=_FLOOR)[0])
    moved[limited] = shift
    return space.inside(space.moved(values, moved))


def _nearest_in_cones(root: Array, given: Array, ends: tuple[Array, Array], scales: Array) -> Array:
    """The nearest point whose first numbers lie between bounds, and whose sixes make semidefinite matrices."""
    import cvxpy

    count = len(ends[0])
    x = cvxpy.Variable(len(given))
    limits = [x[:count][np.isfinite(ends[0])] >= ends[0][np.isfinite(ends[0])]]
    limits.append(x[:count][np.isfinite(ends[1])] <= ends[1][np.isfinite(ends[1])])
    for start in range(count, len(given), 6):
        xx, xy, xz, yy, yz, zz = (x[start + i] * scales[start - count + i] / scales[start - count] for i in range(6))
        limits.append(cvxpy.bmat([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) >> 0)
    # Scaled to its largest row, so that the solver's tolerances mean something.
    scale = float(np.abs(root).max())
    posed = cvxpy.Problem(cvxpy.Minimize(cvxpy.sum_squares((root / scale) @ (x - given))), limits)
    try:
        posed.solve(solver=cvxpy.CLARABEL)
    except cvxpy.error.SolverError:
        return given
    return given if x.value is None else np.array(x.value, dtype=float)


@dataclass(frozen=True)
class GaussMarkovState:
    """One process."""

    name: str  # for people
    over: float  # the distance over which it forgets, in units of the channel
    channel: str  # ``sequence`` (places in a recording), ``record`` (one by one) or ``time`` (s)
    coordinate: int | None = None  # of the parameter that it moves; None for a shift of readings
    size: float = 0.0  # its standard deviation: in scaled coordinates of the parameter
    instance: str = ""  # the measurement whose readings it shifts
    shift: tuple[float, ...] = ()  # how it shifts the residual's entries, a standard deviation long (n_r; m or rad)


@dataclass(frozen=True)
class GaussMarkovStates:
    """All of them (m)."""

    states: tuple[GaussMarkovState, ...] = ()

    def __len__(self) -> int:
        return len(self.states)

    @property
    def drifts(self) -> tuple[Indices, Indices, Array]:
        """Of those that move a parameter: their places, the parameters' coordinates, and by how much."""
        drifts = [(i, s.coordinate, s.size) for i, s in enumerate(self.states) if s.coordinate is not None]
        which, coordinate, size = zip(*drifts, strict=True) if drifts else ((), (), ())
        return np.array(which, dtype=np.intp), np.array(coordinate, dtype=np.intp), np.array(size)

    def shifts(self, instance: str, rows: int) -> Array:
        columns = [s.shift if s.instance == instance else (0.0,) * rows for s in self.states]
        return np.array(columns).reshape(len(self.states), rows).T

    def kept(self, passed: Mapping[str, float]) -> Array:
        return kept(np.array([max(passed.get(s.channel, 0.0), 0.0) / s.over for s in self.states]))


def shared_error(instance: str, covariance: Array, over: float, channel: str) -> Sequence[GaussMarkovState]:
    """States that make up a covariance of an instrument's readings (n_r x n_r) that neighbours share."""
    size, directions = np.linalg.eigh(covariance)
    roots = directions * np.sqrt(np.maximum(size, 0.0))
    return [
        GaussMarkovState(f"{instance}.shared{i + 1}", over, channel, instance=instance, shift=tuple(column.tolist()))
        for i, column in enumerate(roots.T)
        if float(column @ column) > 0
    ]


@dataclass(frozen=True)
class ProcessNoise:
    """How a belief widens between records."""

    rates: Array  # variance that each parameter's scaled coordinate gains in a second (n)
    gauss_markov: GaussMarkovStates  # the states beside the parameters

    def faded(self, belief: Belief, passed: Mapping[str, float]) -> Belief:
        """The belief after some distance in ``time`` (s), ``record`` and ``sequence`` (records)."""
        n, seconds = len(self.rates), max(passed.get("time", 0.0), 0.0)
        covariance, mean = belief.gaussian.covariance, belief.gaussian.mean
        if seconds > 0 and self.rates.any():
            covariance = covariance.copy()
            covariance[np.arange(n), np.arange(n)] += self.rates * seconds
        if len(self.gauss_markov):
            left = np.ones(len(mean))
            left[n:] = self.gauss_markov.kept(passed)
            covariance = passed_on(covariance, left)
            mean = mean * left
        return Belief(belief.origin, checked(Gaussian(mean, covariance)))


def variance_rates(parameters: Parameters, stated: Mapping[str, str]) -> Array:
    """Variance that each free coordinate gains, in its scaled unit squared per s (n).

    Args:
        parameters: with the free ones.
        stated: by glob, a standard deviation and the time in which it comes about: ``0.05 deg in 30 d``.

    Raises:
        ConfigError: a glob matches nothing, or nothing free; a text is no such rate.
    """
    rates = {block.name: 0.0 for block in parameters.free}
    for glob, text in stated.items():
        where = Location(f"process_noise.{glob}")
        names = [name for name in fnmatch.filter(parameters.names, glob) if name in rates]
        if not names:
            raise ConfigError(
                f"{glob!r} matches no parameter that the calibration found.",
                where=where,
                hint="armcal check -v lists the names; list others under free to let them move.",
            )
        try:
            amount, seconds = amount_in_time(str(text))
        except ValueError as fault:
            message = f"found {text!r}, expected how far a parameter may wander in which time."
            hint = 'Write for example "0.05 deg in 30 d", "0.1 mm in a week" or "0.02 in 1 month".'
            raise ConfigError(message, where=where, hint=hint) from fault
        for name in names:
            size: str | float
            block, size = parameters[name], amount
            if block.unit == "1":
                with suppress(ValueError):
                    size = float(amount)
            deviation = quantity(block, size, None, ())
            rates[name] = (deviation / block.scale) ** 2 / seconds
    return np.array([rates[block.name] for block in parameters.coordinate_blocks])
