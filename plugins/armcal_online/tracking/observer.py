"""Records as an online estimator needs them: one at a time, linearised at any point about an origin."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from armcal.arm.evaluator import MOST_DEFLECTION
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.estimate.online import Linearised, Observation
from armcal.functions.c_source import LANES
from armcal.measure.groups import NO_GROUP, group_key, group_name, group_numbers, owner_of
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.kernel import HELD, Compiled, Kernel
from armcal.problem.problem import Problem
from scipy.linalg import block_diag
from typing_extensions import override

from armcal_online.tracking.belief import Belief, GaussMarkovStates, StateSpace


class OneRecord:
    """A factor's residuals and Jacobians in buffers for one record or a few; not to be shared between threads.

    The compiled functions work on a whole vector of records; where there are fewer, its last places hold the last
    one. The elastic equilibrium starts from rest each time: what comes out is a function of values and records alone,
    to the last bit.
    """

    def __init__(self, kernel: Kernel) -> None:
        factor = kernel.factor
        self._kernel = kernel
        self._sizes = (factor.rows, factor.values.numel())
        width = LANES if isinstance(kernel.backend, Compiled) else 1
        self._values = np.zeros(self._sizes[1])
        self._record = np.zeros((len(factor.channels), width))
        self._state = np.zeros((factor.state.numel(), width))
        self._residual = np.zeros((self._sizes[0], width))
        self._jacobian = np.zeros((self._sizes[0] * self._sizes[1], width))
        arrays, backend = (self._values, self._record, self._state, self._residual, self._jacobian), kernel.backend
        # Evaluates these buffers again and again, and gives how many records did not settle.
        self._evaluate: Callable[[], int] = partial(backend.linearise, *arrays)

        def over_points() -> int:
            kernel.linearise(*arrays)
            return 0

        if kernel.points is not None:
            self._evaluate = over_points
        elif isinstance(backend, Compiled):
            self._evaluate = backend.prepared(*arrays)

    def linearise(self, values: Array, record: Array) -> tuple[Array, Array]:
        """Residual (n_r) and its Jacobian by the kernel's values (n_r x n_v), in equilibrium.

        Args:
            values: of the kernel (n_v).
            record: its channels (n_c).
        """
        residuals, jacobians = self.linearise_several(values, record[None])
        return residuals[0], jacobians[0]

    def linearise_several(self, values: Array, records: Array) -> tuple[Array, Array]:
        """Residuals (k x n_r) and their Jacobians (k x n_r x n_v) of records (k x n_c), in equilibrium."""
        count, width = len(records), self._record.shape[1]
        residuals, jacobians = np.empty((count, self._sizes[0])), np.empty((count, *self._sizes))
        self._values[:] = values
        for start in range(0, count, width):
            part = records[start : start + width]
            self._record[:] = part[-1][:, None]
            self._record[:, : len(part)] = part.T
            self._state[:] = 0.0
            if self._evaluate() or not np.abs(self._state).max(initial=0.0) <= MOST_DEFLECTION:
                # The rare way: Newton, arranged for many records.
                self._state[:] = 0.0
                self._kernel.linearise(self._values, self._record, self._state, self._residual, self._jacobian)
            done = slice(start, start + len(part))
            residuals[done] = self._residual.T[: len(part)]
            jacobians[done] = self._jacobian.T[: len(part)].reshape(-1, *self._sizes)
        return residuals, jacobians


JointNoise = tuple[Array | None, ...]
"""What noise of the joints' own readings adds to the covariance of each residual (n_r x n_r); None for nothing."""


@dataclass(frozen=True)
class Reading:
    """One record as one measurement reads it."""

    factor: int  # which of the problem's measurements
    record: Array  # its channels in the kernel's order (n_c)
    group: int  # the place of its group; 0 without groups
    noise: Array  # covariance of its own error (n_r x n_r)


class Observer:
    """Makes observations of records, for one problem.

    Args:
        problem: compiled.
        space: of its free parameters.
        gauss_markov: the states beside them.
        noisy: drifts that count as noise: each record has its own.
        noise: covariance of each measurement's error (n_r x n_r), where a record does not state its own.
        freedoms: degrees of freedom with which each of these is known.
        defaults: channels that a record may leave out, and what then holds.
        unfound: parameters of groups that the calibration did not find: a record there determines nothing.
        joint_scale: of the joints' own noise, against what each arm states.
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
        self._one_record = [OneRecord(kernel) for kernel in problem.kernels]
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
        """What noise of the joints' own readings adds at values.

        Raises:
            NotConvergedError: no equilibrium there.
        """
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
        """Innovation (n_r) and the prediction's derivative by scaled coordinates (n_r x n) at values in their domains.

        Raises:
            NotConvergedError: no equilibrium there.
        """
        innovations, slopes = self.linearise_several(values, [reading])
        return innovations[0], slopes[0]

    def linearise_several(self, values: Array, readings: Sequence[Reading]) -> tuple[Array, Array]:
        """The same of readings of one factor (k x n_r, k x n_r x n).

        Raises:
            NotConvergedError: no equilibrium there.
        """
        factor, count = readings[0].factor, len(readings)
        grouped, evaluator, entries = self.problem.grouped[factor], self._one_record[factor], self._plain[factor]
        records = np.array([reading.record for reading in readings])
        if entries is not None:
            residual, jacobian = evaluator.linearise_several(values[entries], records)
        else:
            rows, groups = grouped.kernel.factor.rows, np.array([reading.group for reading in readings])
            residual, jacobian = np.zeros((count, rows)), np.zeros((count, rows, grouped.width))
            for group in np.unique(groups).tolist():
                at = np.flatnonzero(groups == group)
                residual[at], own = evaluator.linearise_several(grouped.values(values, group), records[at])
                moving: Indices = np.flatnonzero(grouped.free[group] != HELD)
                jacobian[np.ix_(at, np.arange(rows), grouped.free[group][moving])] = own[:, :, moving]
        slope = -self.space.by_coordinates(values, jacobian.reshape(-1, jacobian.shape[2]))
        return residual, slope.reshape(*jacobian.shape[:2], -1)

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
            inside, outside = self._place(point)
            evaluated = [self.observer.linearise(inside, reading) for reading in self.readings]
            self._last.clear()
            self._last[key] = self._assembled(point, outside, evaluated)
        return self._last[key]

    def _place(self, point: Array) -> tuple[Array, Array]:
        observer, space = self.observer, self.observer.space
        n = len(space.scales)
        which, coordinate, size = observer.drifts
        moved = point[:n] - self.base[:n]
        if len(which):
            np.add.at(moved, coordinate, size * point[n:][which])
        values = space.moved(self.origin, moved)
        inside = space.inside(values)
        return inside, self.base[:n] if (inside == values).all() else self.base[:n] + space.between(inside, values)

    def _assembled(self, point: Array, outside: Array, evaluated: Sequence[tuple[Array, Array]]) -> Linearised:
        """What the readings' innovations and slopes where they are evaluated make of a point."""
        observer = self.observer
        beside = point[len(observer.space.scales) :]
        which, coordinate, size = observer.drifts
        innovations, slopes, drifting = [], [], []
        for reading, (innovation, slope) in zip(self.readings, evaluated, strict=True):
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
        single = len(noises) == 1
        noise = noises[0] if single else block_diag(*noises)
        if drifting:
            drifted = np.vstack(drifting)
            noise = noise + drifted @ drifted.T
        if single:
            return Linearised(innovations[0], slopes[0], noise)
        return Linearised(np.concatenate(innovations), np.vstack(slopes), noise)


def linearised(observations: Sequence[RecordObservation], points: Sequence[Array]) -> list[Linearised]:
    """Records of one belief, each at a point; where these are the same values, they are evaluated together.

    Raises:
        NotConvergedError: no equilibrium there.
    """
    distinct = {id(point): point for point in points}
    known = {key: observations[0]._place(point) for key, point in distinct.items()}
    places = [known[id(point)] for point in points]
    inside, observer = places[0][0], observations[0].observer
    if not all(other is inside or np.array_equal(other, inside) for other, _ in places):
        return [one.at(point) for one, point in zip(observations, points, strict=True)]
    evaluated: list[list[tuple[Array, Array]]] = [[] for _ in observations]
    for factor in range(len(observer.problem.kernels)):
        # The readings of a record are in the order of the factors.
        of = [(i, r) for i, one in enumerate(observations) for r in one.readings if r.factor == factor]
        if of:
            innovations, slopes = observer.linearise_several(inside, [reading for _, reading in of])
            for (i, _), innovation, slope in zip(of, innovations, slopes, strict=True):
                evaluated[i].append((innovation, slope))
    made = zip(observations, points, places, evaluated, strict=True)
    return [one._assembled(point, outside, own) for one, point, (_, outside), own in made]
