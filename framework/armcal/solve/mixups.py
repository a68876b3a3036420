"""Whether measured positions fit the model far better with axes or joints exchanged or reversed, or in other units.

Each way of reading the data is given the same chance: what is left of its residuals once all free parameters have
adapted to first order. A right reading leaves little, a wrong one cannot be mended by any parameters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.measure.partners import OTHER
from armcal.solve.linearised import linearised
from armcal.solve.problem import FactorRecords, Problem

MUCH_BETTER = 3.0
"""A mix-up leaves so many times less than the data as they stand."""
FITS, MISSES = 0.1, 0.03
"""Of the spread of the positions: what a right reading leaves at most, what is worth a look."""
_MOST_RECORDS = 300
_EQUATIONS = 2.0
"""So many numbers a parameter are needed to tell readings apart."""
_ALIKE = 1.5
_TURNED = 0.05
_SMALLEST, _SAME_M = 1e-9, 1e-6
_FAR, _HALVINGS = 3.0, 60
_AXES = "xyz"
_LENGTHS = (10.0, 0.1)
"""What a length is off by that was read in cm for mm; what is off by more shows in how far the arm reaches."""
_DEGREES = 180 / np.pi
_MM = 1000.0


@dataclass(frozen=True)
class Mixup:
    """A reading of the data that fits much better than the data as they stand.

    Attributes:
        measurement: whose positions.
        told: the readings that fit about as well as the best one, in words.
        as_given_mm: what the data leave as they stand (root mean square, free parameters adapted).
        left_mm: what the best reading leaves.
        of_joints: whether it is joints that it reads otherwise; else axes.
    """

    measurement: str
    told: tuple[str, ...]
    as_given_mm: float
    left_mm: float
    of_joints: bool


@dataclass(frozen=True)
class _Reading:
    """What is left of one reading (m)."""

    left: float
    words: str
    of_joints: bool


@dataclass(frozen=True)
class _Seen:
    """Positions of one measurement: which kernel, its records, and what was measured (3 x N, m)."""

    kernel: int
    records: FactorRecords
    measured: Array


@dataclass(frozen=True)
class _Positions:
    """Predicted positions (3 x N, m), and how the free parameters, in ordinary sizes, move them: U S V' (3N x n)."""

    predicted: Array
    ways: Array
    sizes: Array

    def left(self, measured: Array) -> float:
        """Root mean square distance once the free parameters have adapted to first order, not too far (m)."""
        off = (measured - self.predicted).T.ravel()
        along = self.ways.T @ off
        fitted = self.sizes * _within(along, self.sizes, _FAR * np.sqrt(len(self.sizes)))
        left = float(off @ off - along @ along + (along - fitted) @ (along - fitted))
        return float(np.sqrt(3 * max(left, 0.0) / max(1, len(off) - len(self.sizes))))

    def can_turn(self, turn: Array) -> bool:
        """Whether the free parameters move all positions as the beginning of a turn (3 x 3) of the base would."""
        moved = np.cross(Rotation.from_matrix(turn).as_rotvec(), self.predicted.T).ravel()
        along = self.ways.T @ moved
        return float(moved @ moved - along @ along) <= _TURNED**2 * float(moved @ moved)


def _within(along: Array, sizes: Array, radius: float) -> Array:
    """The steps (n) that come nearest to ``along`` times ``sizes``, no longer than a radius. [Nocedal2006]"""
    steps = along / sizes
    if np.linalg.norm(steps) <= radius:
        return np.asarray(steps)
    low, high = 0.0, float(np.linalg.norm(along * sizes)) / radius
    for _ in range(_HALVINGS):
        damping = (low + high) / 2
        steps = along * sizes / (sizes**2 + damping)
        low, high = (damping, high) if np.linalg.norm(steps) > radius else (low, damping)
    return np.asarray(steps)


def find_mixup(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> Mixup | None:
    """The first measurement whose positions, as they stand, do not fit, but do with one mix-up undone.

    ``records`` are those of the dataset, their noise as declared.
    """
    for number, kernel in enumerate(problem.kernels):
        seen = _seen(problem, records, dataset, number)
        arms = problem.blueprint.measurements[kernel.factor.name].arms
        found = None if seen is None or len(arms) != 1 else _of(problem, seen, problem.blueprint.arms[arms[0]])
        if found is not None:
            return found
    return None


def _seen(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, number: int) -> _Seen | None:
    """A measurement that gives positions in the base frame, at most so many records of it; None of another."""
    factor = problem.kernels[number].factor
    channels = factor.output_channels[:3]
    positions = [channel.rpartition(".")[2] for channel in channels] == list(_AXES)
    if not positions or factor.dimensions[:3] != ("length",) * 3 or any(OTHER in name for name in factor.channels):
        return None
    if not all(dataset.has(channel) for channel in channels):
        return None
    chosen = np.flatnonzero(records[number].measured)
    chosen = chosen[:: max(1, -(-len(chosen) // _MOST_RECORDS))]
    if 3 * len(chosen) < _EQUATIONS * max(problem.increments, 6):
        return None
    own = replace(problem.subset(records, chosen)[number], whitening=None, correlation=None)
    measured = dataset.stacked(channels)[:, chosen]
    shown = problem.predict(problem.parameters.nominal(), problem.subset(records, chosen))[number][:3]
    residual = problem.residuals(problem.parameters.nominal(), problem.subset(records, chosen))[number][:3]
    return _Seen(number, own, measured) if np.allclose(residual, measured - shown, atol=_SAME_M) else None


def _of(problem: Problem, seen: _Seen, arm: Arm) -> Mixup | None:
    straight = _positions(problem, seen, {})
    if straight is None:
        return None
    as_given, spread = straight.left(seen.measured), max(_spread(seen.measured), _spread(straight.predicted))
    if as_given <= MISSES * spread:
        return None
    enough = min(FITS * spread, as_given / MUCH_BETTER)
    singles = [*_by_axes(straight, seen.measured), *_by_joints(problem, seen, arm)]
    best = min(singles, key=lambda reading: reading.left, default=None)
    if best is None or best.left > enough:
        return None
    alike = [r for r in singles if r.left <= _ALIKE * best.left and r.of_joints == best.of_joints]
    told = tuple(reading.words for reading in sorted(alike, key=lambda reading: reading.left))
    name = problem.kernels[seen.kernel].factor.name
    return Mixup(name, told, as_given * _MM, best.left * _MM, best.of_joints)


def _spread(positions: Array) -> float:
    """Root mean square distance from their middle (m)."""
    return float(np.sqrt(np.sum(np.var(positions, axis=1))))


def _positions(problem: Problem, seen: _Seen, read_as: Mapping[str, tuple[str, float]]) -> _Positions | None:
    """At the nominal values, channels read as others, times a factor; None where a record has no equilibrium."""
    kernel, own, parameters = problem.kernels[seen.kernel], seen.records, problem.parameters
    records = replace(own, record=_rewired(own.record, kernel.factor.channels, read_as), state=np.zeros_like(own.state))
    try:
        blocks = list(linearised(kernel, problem.slots[seen.kernel], records, parameters.nominal()))
    except NotConvergedError:
        return None
    noise = np.array(kernel.factor.noise[:3])[:, None]
    slopes, residual = (np.concatenate(parts, axis=-1)[:3, ..., : own.count] for parts in zip(*blocks, strict=True))
    rows = (slopes * noise[:, :, None]).transpose(2, 0, 1).reshape(3 * own.count, -1)
    rows = rows @ parameters.entries_jacobian(parameters.nominal()) * parameters.scales()
    basis, triangle = np.linalg.qr(rows)
    ways, sizes, _ = np.linalg.svd(triangle, full_matrices=False)
    kept = sizes > _SMALLEST * sizes.max(initial=0.0)
    return _Positions(seen.measured - residual * noise, basis @ ways[:, kept], sizes[kept])


def _rewired(record: Array, channels: Sequence[str], read_as: Mapping[str, tuple[str, float]]) -> Array:
    rewired = record.copy()
    for channel, (other, factor) in read_as.items():
        if channel in channels and other in channels:
            rewired[channels.index(channel)] = factor * record[channels.index(other)]
    return rewired


def _by_axes(straight: _Positions, measured: Array) -> Iterator[_Reading]:
    """All exchanges and signs of axes, but turns that the free parameters make by themselves; and other units."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            proper = np.linalg.det(turn) > 0
            if not np.array_equal(turn, np.eye(3)) and not (proper and straight.can_turn(turn)):
                yield _Reading(straight.left(turn @ measured), _axes_told(order, signs), False)
    for factor in _LENGTHS:
        yield _Reading(straight.left(factor * measured), f"positions {factor:.3g} times as large", False)


def _axes_told(order: Sequence[int], signs: Sequence[float]) -> str:
    moved = [i for i in range(3) if order[i] != i]
    negative = [_AXES[order[i]] for i in range(3) if signs[i] < 0]
    if len(moved) == 2 and not negative:
        return f"{_AXES[moved[0]]} and {_AXES[moved[1]]} exchanged"
    if not moved:
        return f"the sign{'s' * (len(negative) > 1)} of {' and '.join(negative)} reversed"
    taken = (f"{'-' if sign < 0 else ''}{_AXES[axis]}" for axis, sign in zip(order, signs, strict=True))
    return f"({', '.join(taken)}) taken for (x, y, z)"


def _by_joints(problem: Problem, seen: _Seen, arm: Arm) -> Iterator[_Reading]:
    """Each joint's sign, each two joints of a kind exchanged, and all angles in another unit."""
    joints = tuple(arm.commanded)
    angles = {joint: joint for joint, dimension in arm.commanded.items() if dimension == "angle"}
    readings = [(f"the sign of {joint} reversed", _wires(arm, {joint: joint}, -1.0)) for joint in joints]
    for one, other in combinations(joints, 2):
        if arm.commanded[one] == arm.commanded[other]:
            readings.append((f"{one} and {other} exchanged", _wires(arm, {one: other, other: one}, 1.0)))
    for factor in (_DEGREES, 1 / _DEGREES):
        readings.append((f"joint angles {factor:.3g} times as large", _wires(arm, angles, factor)))
    for words, read_as in readings:
        found = _positions(problem, seen, read_as)
        if found is not None:
            yield _Reading(found.left(seen.measured), words, True)


def _wires(arm: Arm, joints: Mapping[str, str], factor: float) -> dict[str, tuple[str, float]]:
    """Commands and approaches of some joints read as those of others, times a factor; of approaches, times its sign."""
    return {
        f"{arm.name}.{part}{joint}": (f"{arm.name}.{part}{other}", scale)
        for joint, other in joints.items()
        for part, scale in (("", factor), ("approach.", float(np.sign(factor))))
    }
