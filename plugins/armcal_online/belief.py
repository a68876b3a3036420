"""A belief about an arm, and the most likely values that it allows.

The belief stays the Gaussian that the records make, even beyond bounds: to cut it off at a bound after each record
would count the bound as evidence, again and again. What is handed out is its most likely point within the bounds,
where a fit of all records at once would end, to first order; the covariance is not touched. [Simon2010]

Between records parameters walk at random, and Gauss-Markov states beside them change: stationary processes of unit
standard deviation whose correlation falls by e over a distance (Ornstein-Uhlenbeck [Rasmussen2006]), in records or in
time, coordinates of the belief after those of the parameters. One that is a drift moves a parameter; one of a shared
error, the part of the model's error that neighbouring records have in common, shifts what an instrument reads.

Numbers between bounds and entries of semidefinite matrices are moved out of their domain too: only what is taken from a
belief is brought inside (``inside``, ``most_likely``). Rotations, poses and screw axes are moved within their domain.
"""

from __future__ import annotations

import fnmatch
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from armcal.arm.evaluator import MOST_DEFLECTION
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.domains import Interval, Semidefinite, symmetric
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.units import amount_in_time
from armcal.config.selection import quantity
from armcal.errors import ConfigError, DataError, Location
from armcal.estimate.online import Gaussian, Linearised, Observation, checked
from armcal.functions.c_source import LANES
from armcal.measure.groups import NO_GROUP, group_key, group_name, group_numbers, owner_of
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.kernel import HELD, Compiled, Kernel
from armcal.problem.problem import Problem
from armcal.problem.records import kept, passed_on
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear
from typing_extensions import override

_ENTRIES = np.triu_indices(3)


@dataclass(frozen=True)
class StateSpace:
    """The free parameters of a problem as scaled coordinates (n)."""

    parameters: Parameters

    @cached_property
    def scales(self) -> Array:
        return self.parameters.scales()

    @cached_property
    def names(self) -> tuple[str, ...]:
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
    name: str  # for people
    over: float  # the distance over which it forgets, in units of the channel
    channel: str  # ``sequence`` (places in a recording), ``record`` (one by one) or ``time`` (s)
    coordinate: int | None = None  # of the parameter that it moves; None for a shift of readings
    size: float = 0.0  # its standard deviation: in scaled coordinates of the parameter
    instance: str = ""  # the measurement whose readings it shifts
    shift: tuple[float, ...] = ()  # how it shifts the residual's entries, a standard deviation long (n_r; m or rad)


@dataclass(frozen=True)
class GaussMarkovStates:
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
    """Variance that each free coordinate gains, in its scaled unit squared per s (n)."""
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


class OneRecord:
    """A factor's residual and Jacobian in buffers for one record; not to be shared between threads.

    The elastic equilibrium starts from rest each time: what comes out is a function of values and record alone, to the
    last bit.
    """

    def __init__(self, kernel: Kernel) -> None:
        factor, backend = kernel.factor, kernel.backend
        self._kernel, self._sizes = kernel, (factor.rows, factor.values.numel())
        counts = (len(factor.channels), factor.state.numel(), factor.rows, self._sizes[0] * self._sizes[1])
        self._values = np.zeros(self._sizes[1])
        # Compiled functions work on a whole vector of records.
        lanes = LANES if isinstance(backend, Compiled) else 1
        self._buffers = channels, state, residual, jacobian = [np.zeros((count, lanes)) for count in counts]
        self._evaluate: Callable[[], int] | None = None  # gives how many records did not settle
        if isinstance(backend, Compiled) and kernel.points is None:
            self._evaluate = backend.prepared(self._values, channels, state, residual, jacobian)

    def linearise(self, values: Array, record: Array) -> tuple[Array, Array]:
        """Residual (n_r) and its Jacobian by the kernel's values (n_r x n_v), in equilibrium."""
        channels, state, residual, jacobian = self._buffers
        self._values[:], channels[:], state[:] = values, record[:, None], 0.0
        if self._evaluate is None or self._evaluate() or not np.abs(state).max(initial=0.0) <= MOST_DEFLECTION:
            state[:] = 0.0
            self._kernel.linearise(self._values, channels, state, residual, jacobian)
        return residual[:, 0].copy(), jacobian[:, 0].reshape(self._sizes).copy()


JointNoise = tuple[Array | None, ...]
"""What noise of the joints' own readings adds to the covariance of each residual (n_r x n_r); None for nothing."""


@dataclass(frozen=True)
class Reading:
    factor: int  # which of the problem's measurements
    record: Array  # its channels in the kernel's order (n_c)
    group: int  # the place of its group; 0 without groups
    noise: Array  # covariance of its own error (n_r x n_r)


class Observer:
    """Makes observations of records, for one problem.

    ``noisy`` are drifts that count as noise: each record has its own. Of ``unfound`` groups records determine nothing.
    """

    def __init__(
        self,
        problem: Problem,
        space: StateSpace,
        gauss_markov: GaussMarkovStates,
        noisy: GaussMarkovStates,
        noise: Mapping[str, Array],
        freedoms: Mapping[str, float],
        defaults: Mapping[str, float],
        unfound: Collection[str] = (),
        joint_scale: float = 1.0,
    ) -> None:
        self.problem, self.space, self.gauss_markov = problem, space, gauss_markov
        self._noise, self._defaults, self._unfound = noise, defaults, frozenset(unfound)
        factors = [kernel.factor for kernel in problem.kernels]
        self._freedoms = [freedoms[factor.name] for factor in factors]
        self._ones = [OneRecord(kernel) for kernel in problem.kernels]
        self._plain = [grouped.entries[0] if grouped.is_plain else None for grouped in problem.grouped]
        self.shifts = [gauss_markov.shifts(factor.name, factor.rows) for factor in factors]
        self.drifts, self.noisy_drifts = gauss_markov.drifts, noisy.drifts
        self._noisy_joints = {
            f"{arm.name}.{joint}": joint_scale * arm.joint_noise
            for arm in problem.blueprint.arms.values()
            for joint, dimension in arm.commanded.items()
            if arm.joint_noise and dimension == "angle"
        }
        self.size = len(space.scales) + len(gauss_markov)

    def readings(self, channels: Mapping[str, float], labels: Mapping[str, str]) -> tuple[Reading, ...]:
        """What the measurements read of a record; empty if none applies, as when its group is not known."""
        known = {**self._defaults, **{name: value for name, value in channels.items() if np.isfinite(value)}}
        readings = []
        for place, kernel in enumerate(self.problem.kernels):
            factor = kernel.factor
            if any(channel not in known for channel in factor.channels):
                continue
            group = self._group(factor.name, known, labels)
            if group == NO_GROUP:
                continue
            noise = self._noise[factor.name]
            stated = [next((c for c in own if c in known), None) for own in factor.noise_channels]
            if any(stated):
                ratio = np.array([known[c] / sd if c else 1.0 for c, sd in zip(stated, factor.noise, strict=True)])
                noise = np.asarray(noise * np.outer(ratio, ratio))
            readings.append(Reading(place, np.array([known[channel] for channel in factor.channels]), group, noise))
        return tuple(readings)

    def _group(self, instance: str, known: Mapping[str, float], labels: Mapping[str, str]) -> int:
        """The number of a record's group; ``NO_GROUP`` for one that is not named or that the calibration lacks."""
        blueprint = self.problem.blueprint
        measurement = blueprint.measurements[instance]
        if not isinstance(measurement, GroupedMeasurement):
            return 0
        alone = Dataset(("",), {n: np.array([v]) for n, v in known.items()}, {n: (v,) for n, v in labels.items()})
        try:
            numbers = group_numbers(alone, instance, measurement, blueprint.groups)
        except DataError:
            return NO_GROUP
        number = NO_GROUP if numbers is None else int(numbers[0])
        if number == NO_GROUP or not self._unfound:
            return number
        owner = owner_of(instance, measurement)
        key = group_key(blueprint.measurements, blueprint.groups, instance, number)
        names = {group_name(owner, key, block.name) for block in measurement.group_parameters(key)}
        return NO_GROUP if names & self._unfound else number

    def freedom(self, readings: Sequence[Reading]) -> float:
        """Degrees of freedom with which the noise of a record is known: those of its least known reading."""
        return min(self._freedoms[reading.factor] for reading in readings)

    def joint_noise(self, values: Array, readings: tuple[Reading, ...]) -> JointNoise:
        if not self._noisy_joints:
            return (None,) * len(readings)
        names, added = tuple(self._noisy_joints), []
        for reading in readings:
            kernel, own, record, state = self._repeated(values, reading)
            rows = kernel.factor.rows
            kernel.residuals(own, record, state, np.empty((rows, LANES)))
            slopes = np.empty((rows * len(names), LANES))
            kernel.channel_slopes(own, record, state, slopes, names)
            carried = slopes[:, 0].reshape(rows, len(names)) * np.array(list(self._noisy_joints.values()))
            added.append(np.asarray(carried @ carried.T))
        return tuple(added)

    def _repeated(self, values: Array, reading: Reading) -> tuple[Kernel, Array, Array, Array]:
        kernel, grouped = self.problem.kernels[reading.factor], self.problem.grouped[reading.factor]
        record = np.repeat(reading.record[:, None], LANES, axis=1)
        return kernel, grouped.values(values, reading.group), record, np.zeros((kernel.factor.state.numel(), LANES))

    def linearise(self, values: Array, reading: Reading) -> tuple[Array, Array]:
        """Innovation (n_r) and the prediction's derivative by scaled coordinates (n_r x n), within the domains."""
        factor = reading.factor
        grouped, evaluator, entries = self.problem.grouped[factor], self._ones[factor], self._plain[factor]
        if entries is not None:
            innovation, jacobian = evaluator.linearise(values[entries], reading.record)
        else:
            innovation, own = evaluator.linearise(grouped.values(values, reading.group), reading.record)
            jacobian = np.zeros((len(innovation), grouped.width))
            moving = np.flatnonzero(grouped.free[reading.group] != HELD)
            jacobian[:, grouped.free[reading.group][moving]] = own[:, moving]
        return innovation, -self.space.by_coordinates(values, jacobian)

    def observation(self, belief: Belief, readings: tuple[Reading, ...], noise: JointNoise = ()) -> RecordObservation:
        return RecordObservation(self, belief.origin, belief.gaussian.mean, readings, noise)


@dataclass(frozen=True)
class RecordObservation(Observation):
    """One record about an origin.

    Attributes:
        base: scaled coordinates (N) of the belief's mean, which may lie off the origin where that is at a bound: the
            model is evaluated as far from the origin as a point is from the base, and continued in a straight line.
    """

    observer: Observer  # of the problem
    origin: Array  # values within their domains, where the model is evaluated
    base: Array
    readings: tuple[Reading, ...]  # of the record
    joint_noise: JointNoise = ()  # by reading
    _last: dict[bytes, Linearised] = field(default_factory=dict, compare=False, repr=False)

    @override
    def at(self, point: Array) -> Linearised:
        key = point.tobytes()
        if key not in self._last:
            self._last.clear()
            self._last[key] = self._linearised(point)
        return self._last[key]

    def _linearised(self, point: Array) -> Linearised:
        observer, space = self.observer, self.observer.space
        n = len(space.scales)
        which, coordinate, size = observer.drifts
        moved, beside, outside = point[:n] - self.base[:n], point[n:], self.base[:n]
        if len(which):
            np.add.at(moved, coordinate, size * beside[which])
        values = space.moved(self.origin, moved)
        inside = space.inside(values)
        if not (inside == values).all():
            outside = outside + space.between(inside, values)
        innovations, slopes, drifting = [], [], []
        for reading in self.readings:
            innovation, slope = observer.linearise(inside, reading)
            innovation = innovation - slope @ outside
            if len(observer.noisy_drifts[1]):
                drifting.append(slope[:, observer.noisy_drifts[1]] * observer.noisy_drifts[2])
            if len(beside):
                shift = observer.shifts[reading.factor].copy()
                innovation = innovation - shift @ beside
                shift[:, which] = slope[:, coordinate] * size
                slope = np.hstack([slope, shift])
            innovations.append(innovation)
            slopes.append(slope)
        added = self.joint_noise or (None,) * len(self.readings)
        noises = [r.noise if a is None else r.noise + a for r, a in zip(self.readings, added, strict=True)]
        noise = noises[0] if len(noises) == 1 else block_diag(*noises)
        if drifting:
            drifted = np.vstack(drifting)
            noise = noise + drifted @ drifted.T
        return Linearised(np.concatenate(innovations), np.vstack(slopes), noise)
