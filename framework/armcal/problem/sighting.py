"""Measured positions of one instrument beside what the nominal arm should show in the same records."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.measure.partners import OTHER
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import Tools
from armcal.problem.tool_motion import spread_of

_SAME_M = 1e-6
_QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Sighting:
    """Records of a measurement that reads positions in a frame, all of one arm.

    Attributes:
        kernel: which measurement.
        chosen: places of its records (n).
        measured: positions (3 x n, m).
        turned: rotations of the body that was measured (n x 3 x 3); None where only positions are.
    """

    kernel: int
    chosen: Indices
    measured: Array
    turned: Array | None = None

    @property
    def size(self) -> float:
        return spread_of(self.measured)

    def subset(self, places: Indices) -> Sighting:
        turned = None if self.turned is None else self.turned[places]
        return Sighting(self.kernel, self.chosen[places], self.measured[:, places], turned)

    def thinned(self, most: int) -> Sighting:
        return self.subset(np.arange(0, len(self.chosen), max(1, -(-len(self.chosen) // most))))

    def off(self, tools: Tools) -> float:
        squares = np.sum((self.measured - tools.places) ** 2, axis=0)
        if self.turned is not None:
            turns = Rotation.from_matrix(np.swapaxes(tools.rotations, 1, 2) @ self.turned).magnitude()
            squares = squares + (self.size * turns) ** 2
        return float(np.sqrt(np.median(squares)))


def sighting_of(
    problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, number: int, most: int
) -> Sighting | None:
    """At most so many records of a measurement; None of one that reads no positions of a single arm in a frame."""
    factor = problem.kernels[number].factor
    channels = factor.position_channels
    if not channels or factor.dimensions[:3] != ("length",) * 3 or not all(map(dataset.has, channels)):
        return None
    if any(OTHER in name for name in factor.channels) or len(problem.blueprint.measurements[factor.name].arms) != 1:
        return None
    whole = np.flatnonzero(records[number].measured)
    chosen = whole[:: max(1, -(-len(whole) // most))] if len(whole) else whole
    if not len(chosen):
        return None
    some, values = problem.subset(records, chosen), problem.parameters.nominal()
    measured, shown = dataset.stacked(channels)[:, chosen], problem.predict(values, some)[number].outputs[:3]
    if not np.allclose(problem.residuals(values, some)[number][:3], measured - shown, atol=_SAME_M):
        return None
    quaternion = [f"{factor.name}.{part}" for part in _QUATERNION]
    reads_turn = set(quaternion) <= set(factor.output_channels) and all(map(dataset.has, quaternion))
    turned = _rotations(dataset.stacked(quaternion)[:, chosen]) if reads_turn else None
    return Sighting(number, chosen, measured, turned)


def tools_of(problem: Problem, values: Array, record: FactorRecords, number: int) -> Tools:
    """What a measurement's arm shows in each of its records: of the body if its rotation is read, else of the tool."""
    shown = problem.grouped[number].predict(values, record)
    parts = [channel.rpartition(".")[2] for channel in problem.kernels[number].factor.output_channels]
    if set(_QUATERNION) <= set(parts):
        return Tools(shown.outputs[:3], _rotations(shown.outputs[[parts.index(part) for part in _QUATERNION]]))
    return Tools(shown.outputs[:3], np.ascontiguousarray(np.transpose(shown.tools[0, :3], (2, 1, 0))))


def _rotations(quaternions: Array) -> Array:
    """Matrices (n x 3 x 3) of quaternions w, x, y, z (4 x n)."""
    return np.asarray(Rotation.from_quat(quaternions[[1, 2, 3, 0]].T).as_matrix())


def shown_instead(problem: Problem, record: FactorRecords, number: int, shown: Tools) -> FactorRecords:
    """A measurement's records as if its instrument had seen this."""
    factor, changed = problem.kernels[number].factor, record.record.copy()
    turned = Rotation.from_matrix(shown.rotations).as_quat()[:, [3, 0, 1, 2]].T
    readings = dict(zip((*"xyz", *_QUATERNION), (*shown.places, *turned), strict=True))
    for row, channel in enumerate(factor.channels):
        name, _, part = channel.rpartition(".")
        if name == factor.name and part in readings and channel in factor.output_channels:
            changed[row, : record.count] = readings[part]
            changed[row, record.count :] = readings[part][-1]
    return FactorRecords(
        record.count, changed, record.weight, record.state.copy(), record.whitening, None, record.group, record.applies
    )
