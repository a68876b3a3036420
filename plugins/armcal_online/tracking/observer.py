"""Records as an online estimator looks at them: one at a time, from any place about an origin."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import DataError
from armcal.estimate.online import Linearised
from armcal.functions.c_source import LANES
from armcal.measure.groups import NO_GROUP, group_key, group_name, group_numbers, owner_of
from armcal.measure.measurement import GroupedMeasurement
from armcal.problem.grouped_kernel import HELD
from armcal.problem.kernel import Kernel
from armcal.problem.one_record import OneRecord
from armcal.problem.problem import Problem
from numpy.typing import NDArray

from armcal_online.tracking.gauss_markov import GaussMarkovStates
from armcal_online.tracking.state_space import StateSpace


@dataclass(frozen=True)
class Reading:
    """One record as one measurement reads it.

    Attributes:
        factor: which of the problem's measurements.
        record: its channels in the kernel's order (n_c).
        group: the place of its group; 0 without groups.
        noise: covariance of its own error (n_r x n_r).
    """

    factor: int
    record: Array
    group: int
    noise: Array


class Observer:
    """Makes observations of records, for one problem.

    Args:
        problem: compiled; its free parameters are the chart's.
        space: of the parameters.
        gauss_markov: what moves beside them.
        noisy: drifts that are not followed: each record has its own.
        noise: covariance of each measurement's error (n_r x n_r), where a record does not say its own.
        freedoms: degrees of freedom with which each of these is known.
        defaults: channels that a record may leave out, and what then holds.
        unfound: parameters of groups that the calibration never found: what is measured there says nothing.
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
        self._freedoms = [freedoms[kernel.factor.name] for kernel in problem.kernels]
        self._factors = [OneRecord(kernel) for kernel in problem.kernels]
        self._plain = [grouped.entries[0] if grouped.is_plain else None for grouped in problem.grouped]
        rows = [kernel.factor.residual.numel() for kernel in problem.kernels]
        names = [kernel.factor.name for kernel in problem.kernels]
        self._shifts = [gauss_markov.shifts(name, count) for name, count in zip(names, rows, strict=True)]
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
        found = []
        for place, kernel in enumerate(self.problem.kernels):
            factor = kernel.factor
            if any(channel not in known for channel in factor.channels):
                continue
            group = self._group(factor.name, known, labels)
            if group == NO_GROUP:
                continue
            record = np.array([known[channel] for channel in factor.channels])
            found.append(Reading(place, record, group, self._own_noise(kernel, known)))
        return tuple(found)

    def freedom(self, readings: Sequence[Reading]) -> float:
        """Degrees of freedom with which the noise of a record is known: those of its least known reading."""
        return min(self._freedoms[reading.factor] for reading in readings)

    def predicted(self, values: Array, channels: Mapping[str, float]) -> tuple[Reading, ...]:
        """Readings of a record with these joints and surroundings, as they are predicted at values.

        Raises:
            NotConvergedError: no equilibrium there.
        """
        measured = {name: 0.0 for kernel in self.problem.kernels for name in kernel.factor.output_channels}
        return tuple(self._as_predicted(values, reading) for reading in self.readings({**measured, **channels}, {}))

    def _as_predicted(self, values: Array, reading: Reading) -> Reading:
        kernel, grouped = self.problem.kernels[reading.factor], self.problem.grouped[reading.factor]
        factor, record = kernel.factor, np.repeat(reading.record[:, None], LANES, axis=1)
        shown = np.empty((factor.outputs.numel() + factor.tools.numel(), LANES))
        state = np.zeros((factor.state.numel(), LANES))
        kernel.predict(grouped.values(values, reading.group), record, state, shown)
        read = reading.record.copy()
        for row, channel in enumerate(factor.output_channels):
            if channel in factor.channels:
                read[factor.channels.index(channel)] = shown[row, 0]
        return replace(reading, record=read)

    def _group(self, instance: str, known: Mapping[str, float], labels: Mapping[str, str]) -> int:
        plan = self.problem.blueprint
        measurement = plan.measurements[instance]
        if not isinstance(measurement, GroupedMeasurement):
            return 0
        alone = Dataset(("",), {n: np.array([v]) for n, v in known.items()}, {n: (v,) for n, v in labels.items()})
        try:
            numbers = group_numbers(alone, instance, measurement, plan.groups)
        except DataError:
            return NO_GROUP
        number = NO_GROUP if numbers is None else int(numbers[0])
        return NO_GROUP if number == NO_GROUP or self._is_unfound(instance, measurement, number) else number

    def _is_unfound(self, instance: str, measurement: GroupedMeasurement, number: int) -> bool:
        """Whether the calibration had no record of a group, and so does not know it."""
        if not self._unfound:
            return False
        plan = self.problem.blueprint
        owner, key = owner_of(instance, measurement), group_key(plan.measurements, plan.groups, instance, number)
        names = (group_name(owner, key, block.name) for block in measurement.group_parameters(key))
        return any(name in self._unfound for name in names)

    def _own_noise(self, kernel: Kernel, known: Mapping[str, float]) -> Array:
        factor = kernel.factor
        covariance = self._noise[factor.name]
        stated = [next((c for c in own if c in known), None) for own in factor.noise_channels]
        if not any(stated):
            return covariance
        ratio = np.array([known[c] / sd if c else 1.0 for c, sd in zip(stated, factor.noise, strict=True)])
        return np.asarray(covariance * np.outer(ratio, ratio))

    def look(self, values: Array, reading: Reading) -> tuple[Array, Array]:
        """Innovation (n_r) and the prediction's derivative by scaled coordinates (n_r x n) at values in their domains.

        Raises:
            NotConvergedError: no equilibrium there.
        """
        grouped, one, entries = (
            self.problem.grouped[reading.factor],
            self._factors[reading.factor],
            self._plain[reading.factor],
        )
        if entries is not None:
            residual, jacobian = one.linearise(values[entries], reading.record)
            return residual, -self.space.by_coordinates(values, jacobian)
        residual, own = one.linearise(grouped.values(values, reading.group), reading.record)
        free = grouped.free[reading.group]
        seen: NDArray[np.intp] = np.flatnonzero(free != HELD)
        jacobian = np.zeros((len(residual), grouped.width))
        jacobian[:, free[seen]] = own[:, seen]
        return residual, -self.space.by_coordinates(values, jacobian)

    def joint_noise(self, values: Array, readings: tuple[Reading, ...]) -> tuple[Array | None, ...]:
        """What noise of the joints' own readings adds to the covariance of each residual, at values; None for nothing.

        Raises:
            NotConvergedError: no equilibrium there.
        """
        if not self._noisy_joints:
            return (None,) * len(readings)
        return tuple(self._carried(values, reading) for reading in readings)

    def _carried(self, values: Array, reading: Reading) -> Array:
        kernel, grouped = self.problem.kernels[reading.factor], self.problem.grouped[reading.factor]
        own, names = grouped.values(values, reading.group), tuple(self._noisy_joints)
        record = np.repeat(reading.record[:, None], LANES, axis=1)
        state = np.zeros((kernel.factor.state.numel(), LANES))
        rows = kernel.factor.residual.numel()
        kernel.residuals(own, record, state, np.empty((rows, LANES)))
        slopes = np.empty((rows * len(names), LANES))
        kernel.channel_slopes(own, record, state, slopes, names)
        carried = slopes[:, 0].reshape(rows, len(names)) * np.array(list(self._noisy_joints.values()))
        return np.asarray(carried @ carried.T)

    def shift(self, factor: int) -> Array:
        """How companions shift one measurement's readings (n_r x m)."""
        return self._shifts[factor]


@dataclass(frozen=True)
class Seen:
    """One record about an origin: what online estimators are handed (an ``Observation``).

    Attributes:
        observer: of the problem.
        origin: values within their domains, where the model is evaluated.
        base: scaled coordinates (N) of the belief's mean, which may lie off the origin where that is at a bound: the
            model is evaluated as far from the origin as a place is from the base, and continued in a straight line.
        readings: of the record.
        joint_noise: what the joints' own noise adds (by reading; n_r x n_r or None).
    """

    observer: Observer
    origin: Array
    base: Array
    readings: tuple[Reading, ...]
    joint_noise: tuple[Array | None, ...] = ()
    _last: dict[bytes, Linearised] = field(default_factory=dict, compare=False, repr=False)

    def at(self, point: Array) -> Linearised:
        """As the protocol says."""
        key = point.tobytes()
        if key not in self._last:
            self._last.clear()
            self._last[key] = self._linearised(point)
        return self._last[key]

    def _linearised(self, place: Array) -> Linearised:
        observer, space = self.observer, self.observer.space
        n = len(space.scales)
        beside = place[n:]
        which, coordinate, size = observer.drifts
        wanted = place[:n] - self.base[:n]
        if len(which):
            np.add.at(wanted, coordinate, size * beside[which])
        values = space.moved(self.origin, wanted)
        inside = space.inside(values)
        outside = self.base[:n] if (inside == values).all() else self.base[:n] + space.between(inside, values)
        innovations, slopes, scattered = [], [], []
        for reading in self.readings:
            innovation, slope = observer.look(inside, reading)
            innovation = innovation - slope @ outside
            if len(observer.noisy_drifts[1]):
                scattered.append(slope[:, observer.noisy_drifts[1]] * observer.noisy_drifts[2])
            if len(beside):
                shift = observer.shift(reading.factor).copy()
                innovation = innovation - shift @ beside
                shift[:, which] = slope[:, coordinate] * size
                slope = np.hstack([slope, shift])
            innovations.append(innovation)
            slopes.append(slope)
        noise = self._noise_of(0) if len(innovations) == 1 else self._all_noise()
        if scattered:
            drifted = np.vstack(scattered)
            noise = noise + drifted @ drifted.T
        if len(innovations) == 1:
            return Linearised(innovations[0], slopes[0], noise)
        return Linearised(np.concatenate(innovations), np.vstack(slopes), noise)

    def _noise_of(self, place: int) -> Array:
        own = self.readings[place].noise
        added = self.joint_noise[place] if self.joint_noise else None
        return own if added is None else own + added

    def _all_noise(self) -> Array:
        parts = [self._noise_of(i) for i in range(len(self.readings))]
        whole, start = np.zeros((sum(len(p) for p in parts),) * 2), 0
        for part in parts:
            whole[start : start + len(part), start : start + len(part)] = part
            start += len(part)
        return whole
